"""The main job, small: scenes x methods from pixels to displacement error, with a report."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .benchmark import benchmark
from .extras import require_scene
from .files import write_atomically
from .methods import Method
from .progress import Progress, silent
from .settings import SCENE_NAMES, Settings

METHODS = ("random", "reid", "rgm", "bayes", "oracle")
EPISODES = 2
PRESET = "easy"
COLUMNS = (
    ("method", "method"),
    ("precision", "precision"),
    ("recall", "recall"),
    ("f1", "F1"),
    ("displacement_single_m", "one robot alone, m"),
    ("displacement_fused_m", "fused, m"),
    ("match_ms", "ms a pair"),
)


def demo(out: Path, seed: int = 0, progress: Progress = silent) -> list[dict[str, Any]]:
    """Run the demo into a folder: rows.json, report.md and, per scene, pictures of every method's matches.

    Raises:
        MissingExtraError: without the packages of `covis[envs,learned]`.
        OSError: no folder can be made there.
    """
    settings = Settings(preset=PRESET, seed=seed, episodes=EPISODES)
    require_scene(settings.perception)
    out.mkdir(parents=True, exist_ok=True)
    from .gallery import Picture, correspondence_pictures

    methods = [Method.parse(name) for name in METHODS]
    n_scenes = len(SCENE_NAMES)
    rows = benchmark(SCENE_NAMES, methods, settings, progress=lambda done, total: progress(done, total + n_scenes))
    pictures: dict[str, list[Picture]] = {}
    for i, scene in enumerate(SCENE_NAMES):
        progress(n_scenes + i, 2 * n_scenes)
        pictures[scene] = correspondence_pictures(scene, methods, settings, out / "pictures")
    write_atomically(out / "rows.json", json.dumps({"rows": rows}, indent=1).encode())
    write_atomically(out / "report.md", _report(rows, pictures, out, settings).encode())
    return rows


def _report(rows: Sequence[dict[str, Any]], pictures: dict[str, list[Any]], out: Path, settings: Settings) -> str:
    lines = [
        "# covis demo",
        "",
        f"Seed {settings.seed}, preset {PRESET}, {EPISODES} episodes a scene, {settings.perception} perception, "
        "poses unknown to matchers.",
        "Green lines are right matches, dashed red ones wrong; white corners are detections left unmatched.",
    ]
    for scene, shown in pictures.items():
        lines += ["", f"## {scene}", "", "| " + " | ".join(title for _, title in COLUMNS) + " |"]
        lines += ["|" + " --- |" * len(COLUMNS)]
        lines += [
            "| " + " | ".join(_cell(row.get(key)) for key, _ in COLUMNS) + " |"
            for row in rows
            if row["target"] == scene
        ]
        for picture in shown:
            lines += ["", f"![{picture.caption}]({picture.file.relative_to(out)})"]
    return "\n".join(lines) + "\n"


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return value if isinstance(value, str) else f"{value:.3f}"
