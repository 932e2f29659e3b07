"""A scene or a dataset folder as a Rerun recording: `covis view` (extra `viz`).

Entities: `/world` holds the true objects, every robot with its camera, detections and trajectory, and per method its
matches and fused estimates; `/pairs` holds two cameras side by side with the matches between them; `/metrics` the
figures over time. Green is right, red is wrong, grey is known to be neither.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..envs.colors import CANVAS, FAINT, RIGHT, WRONG, Color, class_color, robot_color
from ..matching.pose import Array, transform
from .extras import require, require_scene
from .methods import Method
from .moments import Moment, Result, Sighting, Source, Things, dataset_source, scene_source
from .settings import SCENE_NAMES, Settings

if TYPE_CHECKING:
    import rerun as rr

TRAIL = 100
"""Instants of a trajectory that are drawn."""
CHI = 1.0
"""Ellipsoids are drawn at so many standard deviations."""
MOST_SPREAD_M = 50.0
"""Larger ellipsoids, of depths that are unknown, would hide everything else."""
GAP_PX = 8
MOST_LABELS = 8
"""More labels in one picture would cover one another; they show under the pointer."""
EPISODE_PAUSE_S = 0.2
FIGURES = {
    "precision": ("precision", True),
    "recall": ("recall", False),
    "fused": ("fused", True),
    "single": ("one robot", False),
}
"""Figure -> its name in the legend, and whether its curve is the strong one of its plot."""
LINES: tuple[Color, ...] = ((64, 156, 255), (255, 140, 46), (46, 204, 134), (226, 122, 196), (245, 200, 66))


def view(
    target: str,
    out: Path,
    methods: Sequence[Method],
    settings: Settings,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
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
    temporary = out.with_name(f"{out.name}.{os.getpid()}.tmp")
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        recording.save(temporary)
        writer = _Writer(recording, source.classes, [m.label for m in methods])
        with _strictly():
            for moment in source.moments:
                writer.write(moment)
                progress(writer.frames, source.most_frames)
            writer.finish(target, settings)
        recording.disconnect()
        os.replace(temporary, out)
    finally:
        recording.disconnect()
        temporary.unlink(missing_ok=True)
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


@dataclass
class _Writer:
    """Logs moments one after another; every entity anew at each, so that nothing old stays on screen."""

    recording: rr.RecordingStream
    classes: tuple[str, ...]
    methods: list[str]
    robots: list[str] = field(default_factory=list)
    pairs: list[tuple[str, str]] = field(default_factory=list)
    trails: dict[str, list[Array]] = field(default_factory=dict)
    frames: int = 0
    episode: int | None = None
    clock: float = 0.0
    offset: float = 0.0
    eye: tuple[Array, Array] | None = None
    scale: float = 1.0
    figures: set[str] = field(default_factory=set)

    def write(self, moment: Moment) -> None:
        if self.episode is None:
            self._begin(moment)
        self._set_time(moment)
        self._log_things(moment.things)
        for sighting in moment.sightings:
            self._log_robot(sighting)
        for absent in set(self.robots) - {s.robot for s in moment.sightings}:
            self._log(f"world/{_part(absent)}", _rr().Clear(recursive=True))
        for label in self.methods:
            self._log_result(label, moment, moment.results[label])

    def _log(self, path: str, *what: Any, static: bool = False) -> None:
        self.recording.log(path, *what, static=static)

    def _begin(self, moment: Moment) -> None:
        """What never changes: axes, names of the curves; and where to look from."""
        rr = _rr()
        self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, (title, strong) in FIGURES.items():
            for k, label in enumerate(self.methods):
                color = LINES[k % len(LINES)]
                if not strong:
                    color = _faint(color)
                style = rr.SeriesLines(colors=[color], names=[f"{label} {title}"], widths=[2.5 if strong else 1.5])
                self._log(f"metrics/{name}/{_part(label)}", style, static=True)
        places = [s.place[:3, 3] for s in moment.sightings if s.place is not None]
        for s in moment.sightings:
            if s.place is not None and len(s.graph):
                places += list(transform(s.place, s.graph.positions))
        low, high = np.quantile(np.array(places or [np.zeros(3)]), (0.05, 0.95), axis=0)
        centre = 0.5 * (low + high)
        reach = max(2.0, 0.5 * float(np.linalg.norm(high - low)))
        self.eye = (centre + reach * np.array([-1.1, -1.1, 1.6]), centre)
        self.scale = reach

    def _set_time(self, moment: Moment) -> None:
        """`frame` counts through, `dataset_frame` is as numbered, `time` runs on over episodes with a short pause."""
        self.recording.set_time("frame", sequence=self.frames)
        self.recording.set_time("dataset_frame", sequence=moment.frame)
        self.frames += 1
        if moment.episode != self.episode:
            self.episode, self.trails = moment.episode, {}
            if moment.time is not None:
                self.offset = 0.0 if moment.time > self.clock else self.clock + EPISODE_PAUSE_S - moment.time
        if moment.time is not None:
            self.clock = moment.time + self.offset
            self.recording.set_time("time", duration=self.clock)
        self._log("metrics/episode", _rr().Scalars(moment.episode))

    def _log_things(self, things: Things) -> None:
        rr = _rr()
        colors = [class_color(int(kind)) for kind in things.kind]
        labels = [f"{self.classes[kind]} {name}" for kind, name in zip(things.kind, things.identity, strict=True)]
        if things.sizes is None or things.headings is None:
            shown: Any = rr.Points3D(
                things.positions, colors=colors, labels=labels, show_labels=False, radii=0.015 * self.scale
            )
        else:
            half = np.zeros((len(things.headings), 4))
            half[:, 2], half[:, 3] = np.sin(things.headings / 2), np.cos(things.headings / 2)
            shown = rr.Boxes3D(
                centers=things.positions,
                half_sizes=things.sizes / 2,
                quaternions=half,
                colors=colors,
                labels=labels,
                show_labels=False,
            )
        self._log("world/objects", shown)

    def _log_robot(self, sighting: Sighting) -> None:
        rr = _rr()
        if sighting.robot not in self.robots:
            self.robots.append(sighting.robot)
        base = f"world/{_part(sighting.robot)}"
        color = robot_color(self.robots.index(sighting.robot))
        if sighting.place is None:
            self._log(base, rr.Clear(recursive=True))
            return
        T = sighting.place
        self._log(f"{base}/sensor", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        self._log_camera(f"{base}/sensor", sighting, color)
        self._log_detections(f"{base}/sensor", sighting, color)
        trail = self.trails.setdefault(sighting.robot, [])
        trail.append(T[:3, 3])
        del trail[:-TRAIL]
        self._log(f"{base}/trajectory", rr.LineStrips3D([np.array(trail)], colors=[color], radii=_points(2.5)))
        if sighting.pose is not None and sighting.pose_truth is not None:
            reported = sighting.pose[:3, 3]
            spread = _ellipsoids(reported[None], _world_spread(sighting)[None], [(*color, 120)], None)
            self._log(f"{base}/reported_position", spread)

    def _log_camera(self, base: str, sighting: Sighting, color: Color) -> None:
        rr = _rr()
        if sighting.graph.intrinsics is None or sighting.size is None:
            self._log(base, rr.TransformAxes3D(0.1 * self.scale))
            return
        pinhole = rr.Pinhole(
            image_from_camera=sighting.graph.intrinsics,
            resolution=sighting.size,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.25 * self.scale,
            color=color,
            line_width=0.002 * self.scale,
        )
        self._log(f"{base}/camera", pinhole)
        if sighting.image is not None:
            self._log(f"{base}/camera/image", _picture(sighting.image))

    def _log_detections(self, base: str, sighting: Sighting, color: Color) -> None:
        rr = _rr()
        graph = sighting.graph
        labels = _names(self.classes, graph.attributes)
        ellipsoids = _ellipsoids(graph.positions, graph.full_covariances(), [(*color, 90)] * len(graph), labels)
        self._log(f"{base}/detections", ellipsoids)
        if sighting.boxes is None or sighting.size is None:
            return
        kinds = graph.attributes.argmax(axis=1) if len(graph) else []
        colors = [class_color(int(k)) for k in kinds]
        boxes = rr.Boxes2D(
            array=sighting.boxes,
            array_format=rr.Box2DFormat.XYXY,
            labels=labels,
            show_labels=len(labels) <= MOST_LABELS,
            colors=colors,
            radii=0.75,
        )
        self._log(f"{base}/camera/boxes", boxes)

    def _log_result(self, label: str, moment: Moment, result: Result) -> None:
        rr = _rr()
        name = _part(label)
        strips, colors = _match_lines(moment.sightings, result)
        self._log(f"world/matches/{name}", rr.LineStrips3D(strips, colors=colors, radii=_points(2.0)))
        self._log_estimates(f"world/estimates/{name}", moment, result)
        for pair in result.matchings:
            self._log_pair(label, pair, moment, result)
        self.figures |= set(result.figures)
        for figure in FIGURES:
            path = f"metrics/{figure}/{name}"
            value = result.figures.get(figure)
            self._log(path, rr.Clear(recursive=False) if value is None else rr.Scalars(value))

    def _log_estimates(self, base: str, moment: Moment, result: Result) -> None:
        """Fused objects of two robots and more; they hang on the place of the robot in whose frame they are."""
        fused = result.fused
        if fused is None:
            return
        place = moment.sightings[fused.frame].place
        assert place is not None
        shared = np.flatnonzero((fused.members >= 0).sum(axis=1) >= 2)
        R = place[:3, :3]
        positions = transform(place, fused.positions[shared])
        names = [_identities(moment.sightings, row) for row in fused.members[shared]]
        colors = [(*(RIGHT if len(n) == 1 and min(n) >= 0 else WRONG), 110) for n in names]
        labels = [_label(self.classes, moment.sightings, row) for row in fused.members[shared]]
        self._log(base, _ellipsoids(positions, R @ fused.covariances[shared] @ R.T, colors, labels))

    def _log_pair(self, label: str, pair: tuple[int, int], moment: Moment, result: Result) -> None:
        """Two cameras side by side, and the matches between them."""
        rr = _rr()
        a, b = (moment.sightings[i] for i in pair)
        if a.boxes is None or b.boxes is None or a.size is None or b.size is None:
            return
        if (a.robot, b.robot) not in self.pairs:
            self.pairs.append((a.robot, b.robot))
        base = _pair_path(a.robot, b.robot)
        if label == self.methods[0] and a.image is not None and b.image is not None:
            self._log(
                f"{base}/image", rr.EncodedImage(contents=_side_by_side(a.image, b.image), media_type="image/jpeg")
            )
        shift = np.array([a.size[0] + GAP_PX, 0, a.size[0] + GAP_PX, 0])
        matching, hits = result.matchings[pair], result.hits[pair]
        boxes = [a.boxes, b.boxes + shift]
        ends = [0.5 * (side[:, :2] + side[:, 2:]) for side in boxes]
        lines = np.stack([ends[0][matching.pairs[:, 0]], ends[1][matching.pairs[:, 1]]], axis=1)
        colors = [RIGHT if hit else WRONG for hit in hits]
        scores = [f"{s:.2f}" for s in matching.scores]
        strips = rr.LineStrips2D(lines, colors=colors, radii=1.0, labels=scores, show_labels=False)
        self._log(f"{base}/{_part(label)}/matches", strips)
        shades: list[Color] = [FAINT] * (len(boxes[0]) + len(boxes[1]))
        for (i, j), color in zip(matching.pairs.tolist(), colors, strict=True):
            shades[i] = shades[len(boxes[0]) + j] = color
        outlines = rr.Boxes2D(array=np.concatenate(boxes), array_format=rr.Box2DFormat.XYXY, colors=shades, radii=0.75)
        self._log(f"{base}/{_part(label)}/boxes", outlines)

    def finish(self, target: str, settings: Settings) -> None:
        """The text that explains the recording, and the layout it opens with."""
        rr = _rr()
        about = rr.TextDocument(_about(target, self.methods, settings), media_type="text/markdown")
        self._log("about", about, static=True)
        self.recording.send_blueprint(self._blueprint())

    def _blueprint(self) -> Any:
        import rerun.blueprint as rrb

        hidden = {
            f"{kind}/{_part(label)}": rrb.EntityBehavior(visible=False)
            for label in self.methods[1:]
            for kind in ("/world/matches", "/world/estimates")
        }
        eye = None
        if self.eye is not None:
            eye = rrb.EyeControls3D(position=self.eye[0], look_target=self.eye[1], eye_up=(0, 0, 1))
        flat = [f"- /world/{_part(robot)}/sensor/camera/boxes" for robot in self.robots]
        world = rrb.Spatial3DView(
            origin="/world",
            name="World",
            contents=["+ /world/**", *flat],
            overrides=hidden,
            eye_controls=eye,
            background=list(CANVAS),
        )
        left = rrb.Tabs(world, rrb.TextDocumentView(origin="/about", name="About"), active_tab="World")
        pairs = [
            rrb.Spatial2DView(
                origin=_pair_path(a, b),
                name=f"{a} and {b}",
                overrides={
                    f"/{_pair_path(a, b)}/{_part(m)}": rrb.EntityBehavior(visible=False) for m in self.methods[1:]
                },
            )
            for a, b in self.pairs
        ]
        cameras = [
            rrb.Spatial2DView(origin=f"/world/{_part(r)}/sensor/camera", name=r) for r in self.robots if self.pairs
        ]
        plots = [
            rrb.TimeSeriesView(
                origin="/metrics",
                name=name,
                contents=[f"+ /metrics/{figure}/**" for figure in figures],
                axis_y=None if span is None else rrb.ScalarAxis(range=span),
                plot_legend=rrb.PlotLegend(corner),
            )
            for name, figures, span, corner in (
                ("Precision and recall", ("precision", "recall"), (0.0, 1.05), "LeftBottom"),
                ("Displacement error, m", ("fused", "single"), None, "LeftTop"),
            )
            if self.figures & set(figures)
        ]
        pictures = [rrb.Tabs(*pairs)] if pairs else []
        pictures += [rrb.Horizontal(*cameras)] if 0 < len(cameras) <= 3 else [rrb.Tabs(*cameras)] if cameras else []
        right = rrb.Vertical(*pictures, rrb.Horizontal(*plots))
        return rrb.Blueprint(
            rrb.Horizontal(left, right, column_shares=[1, 1]),
            rrb.TimePanel(timeline="frame", state="collapsed", fps=5, play_state="playing", loop_mode="all"),
            collapse_panels=True,
        )


def _rr() -> Any:
    import rerun

    return rerun


def _part(name: str) -> str:
    """A name as one part of an entity path."""
    return str(_rr().escape_entity_path_part(name))


def _points(size: float) -> Any:
    """A radius in points of the screen instead of metres."""
    return _rr().Radius.ui_points(size)


def _faint(color: Color) -> Color:
    r, g, b = ((c + 2 * f) // 3 for c, f in zip(color, FAINT, strict=True))
    return r, g, b


def _pair_path(a: str, b: str) -> str:
    return f"pairs/{_part(f'{a}+{b}')}"


def _names(classes: Sequence[str], attributes: Array) -> list[str]:
    return [f"{classes[int(a.argmax())]} {a.max():.2f}" for a in attributes]


def _world_spread(sighting: Sighting) -> Array:
    """Covariance (3, 3) m^2, world frame, of the reported position (right perturbation: it is in the sensor's)."""
    assert sighting.pose is not None
    assert sighting.pose_covariance is not None
    R = sighting.pose[:3, :3]
    return np.asarray(R @ sighting.pose_covariance[:3, :3] @ R.T)


def _ellipsoids(positions: Array, covariances: Array, colors: Sequence[Any], labels: list[str] | None) -> Any:
    """Covariances (n, 3, 3) as ellipsoids of CHI standard deviations."""
    rr = _rr()
    values, vectors = np.linalg.eigh(covariances.reshape(-1, 3, 3))
    # A rotation, not a reflection.
    vectors[np.linalg.det(vectors) < 0, :, 0] *= -1
    return rr.Ellipsoids3D(
        centers=positions.reshape(-1, 3),
        half_sizes=CHI * np.sqrt(np.clip(values, 1e-8, MOST_SPREAD_M**2)),
        quaternions=_quaternions(vectors),
        colors=colors,
        labels=labels,
        show_labels=False,
        fill_mode="solid",
    )


def _quaternions(rotations: Array) -> Array:
    """(n, 4) xyzw of rotations (n, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).as_quat()) if len(rotations) else np.zeros((0, 4))


def _match_lines(sightings: Sequence[Sighting], result: Result) -> tuple[list[Array], list[Color]]:
    """From one robot's estimate of an object to the partner's: short where the match is right."""
    strips, colors = [], []
    for (i, j), matching in result.matchings.items():
        a, b = sightings[i], sightings[j]
        if a.place is None or b.place is None:
            continue
        ends = np.stack(
            [
                transform(a.place, a.graph.positions[matching.pairs[:, 0]]),
                transform(b.place, b.graph.positions[matching.pairs[:, 1]]),
            ],
            axis=1,
        )
        strips += list(ends)
        colors += [RIGHT if hit else WRONG for hit in result.hits[i, j]]
    return strips, colors


def _identities(sightings: Sequence[Sighting], members: NDArray[np.int64]) -> set[int]:
    return {int(sightings[robot].identity[k]) for robot, k in enumerate(members) if k >= 0}


def _label(classes: Sequence[str], sightings: Sequence[Sighting], members: NDArray[np.int64]) -> str:
    """The class on which the group's robots agree most."""
    total = sum(sightings[robot].graph.attributes[k] for robot, k in enumerate(members) if k >= 0)
    return classes[int(np.argmax(total))]


def _picture(encoded: bytes) -> Any:
    kind = "image/png" if encoded.startswith(b"\x89PNG") else "image/jpeg"
    return _rr().EncodedImage(contents=encoded, media_type=kind)


def _side_by_side(left: bytes, right: bytes) -> bytes:
    from PIL import Image

    pictures = [Image.open(io.BytesIO(data)).convert("RGB") for data in (left, right)]
    width = sum(p.width for p in pictures) + GAP_PX
    canvas = Image.new("RGB", (width, max(p.height for p in pictures)), CANVAS)
    canvas.paste(pictures[0], (0, 0))
    canvas.paste(pictures[1], (pictures[0].width + GAP_PX, 0))
    stream = io.BytesIO()
    canvas.save(stream, "JPEG", quality=88)
    return stream.getvalue()


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
