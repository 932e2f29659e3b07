"""A small run made here: two targets, three methods, one of them with a name that is markup."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from covis.evaluation import pictures, records
from covis.evaluation.comparison import Entry, compared
from covis.evaluation.experiments import Experiment
from covis.evaluation.files import write_json
from covis.evaluation.methods import Method
from covis.evaluation.pictures import Page, Result, Sight
from covis.evaluation.records import Record, summarise
from covis.evaluation.settings import Settings
from covis.evaluation.shards import Shards
from covis.evaluation.statistics import episode_sums

METHODS = ("good", "<b>bold</b>", "random")
SKILL = {"good": 0.9, "<b>bold</b>": 0.4, "random": 0.1}
TARGETS = ("multi_robot", 'a "quoted" <i>target</i>')
# One pixel, grey: enough for a browser to show.
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108000000003a7e9b550000000a494441"
    "54789c636800000082008177cd72b60000000049454e44ae426082"
)


def make_record(target: str, method: str, episode: int, frame: int, rng: np.random.Generator) -> Record:
    hits = rng.random(6) < SKILL[method]
    scores = np.clip(0.5 * hits + 0.5 * rng.random(6), 0, 1)
    n = 2 * int(hits.sum())
    return Record(
        target=target,
        method=method,
        episode=episode,
        frame=frame,
        source="robot_0",
        partner="robot_1",
        correct=int(hits.sum()),
        retrieved=6,
        common=8,
        visible=9,
        match_ms=float(rng.uniform(0.5, 2)),
        scores=scores.tolist(),
        hits=hits.tolist(),
        positions_scored=True,
        error_single_m=rng.uniform(0.2, 0.4, n).tolist(),
        error_fused_m=rng.uniform(0.1, 0.3, n).tolist(),
        error_range_m=rng.uniform(2, 20, n).tolist(),
        error_occlusion=rng.uniform(0, 0.5, n).tolist(),
        common_range_m=rng.uniform(2, 20, 8).tolist(),
        common_occlusion=rng.uniform(0, 0.5, 8).tolist(),
        common_found=[k < int(hits.sum()) for k in range(8)],
        experiment=target,
        seed=3,
    )


def make_page(target: str, episode: int, frame: int, role: str, image: bytes | None) -> Page:
    """Two robots that see three objects each; object 1 moves."""
    truth = [[1.0 + 0.3 * frame, 4.0, 0.0], [2.0, 5.0, 0.0], [3.0, 6.0, 0.0]]
    pose = np.eye(4)
    sights = []
    for i in range(2):
        pose[0, 3], pose[1, 3] = 4.0 * i, 0.2 * frame
        boxes = [[10.0 + 20 * k, 10.0, 20.0 + 20 * k, 30.0] for k in range(3)]
        places = [[x + 0.1, y, z] for x, y, z in truth]
        sights.append(Sight(f"robot_{i}", image, pose.ravel().tolist(), boxes, places, [1, 2, 3], list(truth)))
    fused = [[[x + 0.05, y, z] for x, y, z in truth]] * 2
    results = [
        Result(method, [[0, 1]] * 3, [[0, 0], [1, 1], [2, 0]], [0.9, 0.8, 0.2], [True, True, False], 3, fused)
        for method in METHODS
    ]
    return Page(target, episode, frame, role, None if image is None else [100, 80], sights, results)


def make_pages(target: str, image: bytes | None) -> list[Page]:
    pages = [make_page(target, 0, frame, "episode", None) for frame in range(4)]
    return [*pages, make_page(target, 0, 4, "showcase", image), make_page(target, 1, 7, "worst", image)]


def write_run(folder: Path, rows: bool = True) -> Path:
    """A finished run as `covis benchmark` leaves it; without `rows` as if it had been killed at the end."""
    rng = np.random.default_rng(5)
    experiments, units, all_rows = [], [], []
    shards = Shards(folder, 2)
    for number, target in enumerate(TARGETS):
        settings = Settings(episodes=6)
        kind = "scene" if number == 0 else "dataset"
        e = Experiment(target, kind, target, METHODS, settings, (3,))
        experiments.append(vars(e) | {"settings": vars(settings)})
        units.append([target, 3, list(range(6))])
    shards.open(
        {"suite": "trial", "suite_version": 7, "experiments": experiments, "units": units},
        SESSION,
        resume=False,
        overwrite=False,
    )
    for number, target in enumerate(TARGETS):
        made = [
            make_record(target, method, episode, frame, rng)
            for episode in range(6)
            for frame in range(3)
            for method in METHODS
        ]
        pages = make_pages(target, PNG if number == 0 else None)
        shards.write(number, {"records": records.to_table(made), "pictures": pictures.to_table(pages)})
        entries = []
        for method in METHODS:
            own = [r for r in made if r.method == method]
            sums = episode_sums([(r.seed, r.episode) for r in own], [r.counts for r in own])
            head = {"target": target, "method": method, "options": {}, "experiment": target, "episodes": len(sums)}
            entries.append(Entry(Method.parse(method), head | summarise(own), sums))
        all_rows += compared(entries)
    if rows:
        write_json(folder / "rows.json", {"rows": all_rows})
    return folder


SESSION = {
    "command": "covis benchmark multi_robot --method '<script>alert(1)</script>'",
    "commit": "abc1234567",
    "versions": {"python": "3.11.7", "numpy": "2.0"},
    "machine": "Linux x86_64",
    "renderer": "a renderer",
    "started": "2026-01-02T03:04:05+00:00",
}


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("run"))


def rows_of(folder: Path) -> list[dict]:
    return json.loads((folder / "rows.json").read_text())["rows"]
