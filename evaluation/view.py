"""A scene or a dataset folder as a Rerun recording: `covis view` (extra `viz`).

Entities: `/world` holds the true objects, every robot with its camera, detections and trajectory, and per method its
matches and fused estimates; `/pairs` holds two cameras side by side with the matches between them; `/metrics` the
figures over time. Green is right, red is wrong, grey is known to be neither.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from .extras import require, require_scene
from .files import replacing
from .methods import Method
from .moments import Source, dataset_source, scene_source
from .progress import Progress, silent
from .settings import SCENE_NAMES, Settings
from .view_shapes import CHI
from .view_writer import Writer


def view(target: str, out: Path, methods: Sequence[Method], settings: Settings, progress: Progress = silent) -> int:
    """Write the recording; the number of frames in it. The file appears when it is whole.

    Args:
        target: a scene, `package.module:World`, or a dataset folder.
        out: file to write, by convention `.rrd`.
        methods: their matches are drawn, the first one's visible at the start.
        settings: as of a benchmark.

    Raises:
        ValueError: a target that is neither, no method, or a dataset that cannot be drawn.
        MissingExtraError: without the packages of `covis[viz]`, or of `covis[envs]` for a scene.
    """
    require("viz")
    import rerun as rr

    if not methods:
        raise ValueError("at least one method is needed")
    for method in methods:
        method.check()
    source = _source(target, methods, settings)
    recording = rr.RecordingStream("covis", recording_id=f"{Path(target).name}-{settings.seed}")
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    labels = [method.label for method in methods]
    out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(out) as temporary:
        recording.save(temporary)
        try:
            writer = Writer(recording, source.classes, labels)
            with _strictly():
                for moment in source.moments:
                    writer.write(moment)
                    progress(writer.frames, source.most_frames)
                writer.finish(_about(target, labels, settings))
        finally:
            recording.disconnect()
    return writer.frames


@contextmanager
def _strictly() -> Iterator[None]:
    """Rerun raises where it would only warn."""
    import rerun as rr

    before = rr.strict_mode()
    rr.set_strict_mode(True)
    try:
        yield
    finally:
        rr.set_strict_mode(before)


def _source(target: str, methods: Sequence[Method], settings: Settings) -> Source:
    if target in SCENE_NAMES or (":" in target and not Path(target).exists()):
        require_scene(settings.perception)
        return scene_source(target, methods, settings)
    if Path(target).is_dir():
        return dataset_source(target, methods, settings)
    raise ValueError(f"{target!r} is neither a dataset folder nor a scene ({', '.join(SCENE_NAMES)})")


def _about(target: str, methods: Sequence[str], settings: Settings) -> str:
    preset = f", preset {settings.preset}" if settings.preset else ""
    return f"""# {Path(target).name}

Made by `covis view`{preset}, seed {settings.seed}, poses {settings.pose} to the matchers.
Methods: {", ".join(methods)}; the first is shown, the others can be made visible in the tree.

- **Green** is a right match or an object fused from right ones, **red** a wrong one, grey what was left alone.
- Boxes or points in the colours of classes are the true objects.
- Ellipsoids are covariances at {CHI:g} standard deviation: in a robot's colour its own detections and its reported
  position, green and red what fusion made of the matches of two robots and more.
- Lines in the world lead from one robot's estimate of an object to its partner's.
- Robots stand at their true pose where it is known, as displacement errors are scored.
"""
