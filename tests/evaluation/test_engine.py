"""Runs that are interrupted, spoilt, killed: what is finished stays, what is lost is done again."""

import json
import os
import signal
from pathlib import Path

import pytest

from covis.evaluation import engine, executors, experiments
from covis.evaluation.benchmark import benchmark
from covis.evaluation.engine import UnitFailedError, make_executor, run
from covis.evaluation.executors import Done, Failure, RunOne, WorkerDiedError
from covis.evaluation.experiments import Experiment, Unit, UnitResult
from covis.evaluation.methods import Method
from covis.evaluation.settings import Settings

METHODS = [Method.parse(m) for m in ("oracle", "reid", "random")]


def without_time(rows):
    return [{k: v for k, v in row.items() if k != "match_ms"} for row in rows]


@pytest.fixture
def finished(small_dataset, tmp_path, monkeypatch):
    """A finished run of two units: its target, folder and rows."""
    monkeypatch.setattr(experiments, "FRAMES_PER_UNIT", 1)
    out = tmp_path / "run"
    return str(small_dataset), out, benchmark([str(small_dataset)], METHODS, Settings(), out=out)


def test_the_folder_tells_all_about_the_run(finished):
    _, out, rows = finished
    assert json.loads((out / "rows.json").read_text()) == {"rows": rows}
    about = json.loads((out / "run.json").read_text())
    assert about["format"] == "covis-run"
    (session,) = about["sessions"]
    assert session["versions"]["numpy"]
    assert {"command", "commit", "renderer", "started"} <= set(session)
    assert [u[2] for u in about["plan"]["units"]] == [[0], [1]]
    (cost,) = about["cost"]
    assert (cost["units"], cost["frames"]) == (2, 6)
    assert cost["seconds"] > 0


def spoil_truncate(shard):
    shard.write_bytes(shard.read_bytes()[:-100])


def spoil_empty(shard):
    shard.write_bytes(b"")


def spoil_flip(shard):
    content = bytearray(shard.read_bytes())
    content[40] ^= 0xFF
    shard.write_bytes(content)


def spoil_delete(shard):
    shard.unlink()


@pytest.mark.parametrize("spoil", [spoil_truncate, spoil_empty, spoil_flip, spoil_delete])
def test_a_spoilt_shard_is_done_again(finished, spoil):
    target, out, rows = finished
    shards = sorted((out / "records").glob("*.parquet"))
    untouched = shards[0].stat().st_mtime_ns
    spoil(shards[1])
    seen = []
    again = benchmark(
        [target], METHODS, Settings(), out=out, resume=True, progress=lambda done, total: seen.append(done)
    )
    assert seen == [1, 2]
    assert without_time(again) == without_time(rows)
    assert shards[0].stat().st_mtime_ns == untouched


def test_overwrite_replaces_the_run(finished):
    target, out, _ = finished
    (row,) = benchmark([target], METHODS[:1], Settings(episodes=1), out=out, overwrite=True)
    assert row["pairs"] == 3
    assert len(list((out / "records").iterdir())) == 1


def test_a_failing_unit_is_tried_again_after_the_others(small_dataset, monkeypatch):
    calls = []

    def flaky(unit, pictures):
        calls.append(unit.episodes)
        if unit.episodes == (0,) and calls.count((0,)) < 3:
            raise OSError("no space left")
        return UnitResult([], [])

    monkeypatch.setattr(executors, "run_unit", flaky)
    run(_units(3), make_executor())
    assert calls == [(0,), (1,), (2,), (0,), (0,)]


def test_a_unit_that_never_works_is_named_and_the_others_stay(tmp_path, monkeypatch):
    def broken(unit, pictures):
        if unit.episodes == (1,):
            raise OSError("no space left")
        return UnitResult([], [])

    monkeypatch.setattr(executors, "run_unit", broken)
    shards = engine.Shards(tmp_path, 3)
    shards.open({}, {}, resume=False, overwrite=False)
    with pytest.raises(UnitFailedError, match=r"unit 1 \(it, seed 5, episodes 1\) failed 3 times: OSError: no space"):
        run(_units(3), make_executor(), shards=shards)
    assert shards.finished() == {0, 2}


def test_a_killed_worker_costs_its_unit_one_attempt(tmp_path):
    """Each number's first worker is killed; its second one finds the mark and lives."""
    executor = make_executor(workers=2)
    first = dict(executor(range(4), Mortal(tmp_path)))
    assert set(first) == set(range(4))
    lost = [number for number, outcome in first.items() if isinstance(outcome, Failure)]
    assert lost
    assert all(isinstance(first[number].error, WorkerDiedError) for number in lost)
    second = dict(executor(lost, Mortal(tmp_path)))
    assert all(isinstance(outcome, Done) for outcome in second.values())


class Mortal:
    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __call__(self, number: int):
        mark = self.folder / str(number)
        if number == 1 and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return Done(None)


def test_errors_that_cannot_be_pickled_keep_their_text(monkeypatch):
    class LocalError(Exception):
        pass

    def broken(unit, pictures):
        raise LocalError("no")

    monkeypatch.setattr(executors, "run_unit", broken)
    outcome = RunOne(tuple(_units(1)))(0)
    assert isinstance(outcome, Failure)
    assert str(outcome.error) == "LocalError: no"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"engine": "slurm"}, "engine must be local or ray, got 'slurm'"),
        ({"ray_address": "auto"}, "goes with --engine ray"),
        ({"workers": 0}, "workers must be at least 1"),
    ],
)
def test_engines_that_make_no_sense(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_executor(**arguments)


def _units(n):
    experiment = Experiment("it", "scene", "multi_robot", (), Settings(), (5,))
    return [Unit(experiment, 5, (k,)) for k in range(n)]
