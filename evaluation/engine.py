"""Runs units, here or elsewhere, and keeps what they yield.

A unit's records depend on nothing but the unit, so that serial, parallel, distributed and resumed runs agree bit for
bit (`match_ms` aside). What runs the units is an executor, see `executors.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

import pyarrow as pa

from ..matching import PriorRequiredError
from .executors import Done, Executor, RunOne, processes, serial
from .experiments import Unit
from .extras import MissingExtraError
from .progress import Progress, silent
from .records import Tally, tallies
from .shards import RECORDS, Shards, facts

ATTEMPTS = 3
"""How often a unit is tried before it is given up."""

FINAL = (ValueError, PriorRequiredError, MissingExtraError)
"""Errors that a second attempt would only repeat: they end the run at once."""


class UnitFailedError(RuntimeError):
    """Units failed at every attempt; the message names them and the cause."""


@dataclass(frozen=True, eq=False)
class Results:
    """What a run has yielded, unit by unit, from memory or from the run's folder."""

    units: tuple[Unit, ...]
    table: Callable[[int], pa.Table]
    schema: Callable[[int], pa.Schema]

    def tallies(self, experiment: str) -> dict[str, Tally]:
        """By method, what rows need of an experiment's records; one unit's records at a time are in memory."""
        parts: dict[str, list[Tally]] = {}
        for number in self._numbers(experiment):
            for method, tally in tallies(self.table(number)).items():
                parts.setdefault(method, []).append(tally)
        return {method: Tally.pool(own) for method, own in parts.items()}

    def facts(self, experiment: str) -> list[dict[str, Any]]:
        """What was noted about each of its units, see `covis.evaluation.executors.RunOne`."""
        return [facts(self.schema(number)) for number in self._numbers(experiment)]

    def _numbers(self, experiment: str) -> list[int]:
        return [number for number, unit in enumerate(self.units) if unit.experiment.id == experiment]


def run(
    units: Sequence[Unit],
    executor: Executor,
    *,
    shards: Shards | None = None,
    shared_folder: bool = True,
    about: Mapping[str, Any] | None = None,
    progress: Progress = silent,
    complain: Callable[[str], object] = lambda message: None,
) -> Results:
    """Run all units that `shards` does not hold yet.

    Args:
        units: the work.
        executor: what runs it.
        shards: the run's folder, opened; None keeps everything in memory.
        shared_folder: workers see that folder and write their shards themselves.
        about: noted in each unit's records.
        progress: called with (units done, units in all).
        complain: called with what a method failed of, once for each method, as soon as that is known.

    Raises:
        UnitFailedError: units failed ATTEMPTS times; all others are finished.
        Exception: an error of FINAL that a unit raised.
    """
    units = tuple(units)
    kept: dict[int, pa.Table] = {}
    results = Results(units, kept.__getitem__, lambda number: kept[number].schema)
    if shards is not None:
        results = Results(units, shards.read, shards.schema)
    failed: set[str] = set()
    finished = shards.finished() if shards is not None else set()
    run_one = RunOne(units, shards if shared_folder else None, shards is not None, about or {})
    progress(len(finished), len(units))
    todo = [number for number in range(len(units)) if number not in finished]
    for number, tables in _until_done(todo, run_one, executor):
        if tables is not None and shards is not None:
            shards.write(number, tables)
        elif tables is not None:
            kept[number] = tables[RECORDS]
        finished.add(number)
        for method, failure in facts(results.schema(number))["failures"].items():
            if method not in failed:
                complain(failure)
            failed.add(method)
        progress(len(finished), len(units))
    return results


def _until_done(
    todo: Sequence[int], run_one: RunOne, executor: Executor
) -> Iterator[tuple[int, dict[str, pa.Table] | None]]:
    """Every unit once it is done. Units that failed are tried again when the others are through, one by one, so that
    one that takes its worker down takes no other with it."""
    rounds: list[Sequence[int]] = [todo] if todo else []
    failed: dict[int, list[Exception]] = {}
    while rounds:
        for number, outcome in executor(rounds.pop(0), run_one):
            if isinstance(outcome, Done):
                failed.pop(number, None)
                yield number, outcome.tables
                continue
            if isinstance(outcome.error, FINAL):
                raise outcome.error
            failed.setdefault(number, []).append(outcome.error)
            if len(failed[number]) < ATTEMPTS:
                rounds.append([number])
    if failed:
        raise UnitFailedError(_failures(failed, run_one.units))


def _failures(failed: Mapping[int, Sequence[Exception]], units: Sequence[Unit]) -> str:
    shown = [
        f"unit {number} ({units[number]}) failed {len(errors)} times: {type(errors[-1]).__name__}: {errors[-1]}"
        for number, errors in sorted(failed.items())
    ]
    more = f"; and {len(shown) - 3} more" if len(shown) > 3 else ""
    return "; ".join(shown[:3]) + more + f". {len(units) - len(failed)} of {len(units)} units are finished"


def make_executor(engine: str = "local", workers: int = 1, ray_address: str | None = None) -> Executor:
    """The executor of `--engine`.

    Args:
        engine: `local` or `ray`.
        workers: local processes, 1 = this one; on Ray, units at a time, 1 = as many as the cluster has CPUs.
        ray_address: of a running cluster; None starts one here.

    Raises:
        ValueError: an unknown engine, fewer than one worker, or an address without Ray.
        MissingExtraError: `ray` without the package.
    """
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    if engine == "ray":
        # By name, when asked for: Ray is an extra.
        return import_module(".engine_ray", __package__).ray_executor(ray_address, workers)
    if engine != "local":
        raise ValueError(f"engine must be local or ray, got {engine!r}")
    if ray_address is not None:
        raise ValueError(f"--ray-address {ray_address} goes with --engine ray")
    return serial if workers == 1 else partial(processes, workers)
