"""Runs units, here or elsewhere, and keeps what they yield.

A unit's records depend on nothing but the unit, so that serial, parallel, distributed and resumed runs agree bit for
bit (`match_ms` aside). What runs the units is an executor, a plain callable `(todo, run_one) -> (number, outcome)...`:
it calls `run_one(number)` for every number in `todo`, wherever and in whichever order it likes, and yields what came of
each as it comes. `run_one` can be pickled. A unit that was lost, because its worker died, is yielded as a `Failure`.
"""

from __future__ import annotations

import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from multiprocessing import get_context, parent_process
from time import perf_counter, process_time
from typing import Any

import pyarrow as pa

from ..matching import PriorRequiredError
from .experiments import Unit, run_unit
from .extras import MissingExtraError
from .matching_run import MatcherFailedError
from .pictures import to_table as pictures_table
from .records import Tally, tallies, to_table
from .shards import PICTURES, RECORDS, Shards, facts, with_facts

ATTEMPTS = 3
"""How often a unit is tried before it is given up."""

FINAL = (ValueError, PriorRequiredError, MatcherFailedError, MissingExtraError)
"""Errors that a second attempt would only repeat: they end the run at once."""


class WorkerDiedError(RuntimeError):
    """The process that ran a unit ended without a word: killed, or out of memory."""


class UnitFailedError(RuntimeError):
    """Units failed at every attempt; the message names them and the cause."""


@dataclass(frozen=True, eq=False)
class Done:
    """A finished unit: its tables by folder, or None where the worker has written the shards itself."""

    tables: dict[str, pa.Table] | None


@dataclass(frozen=True)
class Failure:
    """A unit that failed. `error` can be pickled."""

    error: Exception

    @classmethod
    def of(cls, error: Exception) -> Failure:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            return cls(RuntimeError(f"{type(error).__name__}: {error}"))
        return cls(error)


Outcome = Done | Failure
RunOneUnit = Callable[[int], Outcome]
Executor = Callable[[Sequence[int], RunOneUnit], Iterator[tuple[int, Outcome]]]


@dataclass(frozen=True)
class RunOne:
    """Runs the unit of a number; written to be sent to a worker once.

    Attributes:
        units: all units of the run.
        shards: where to write the tables; None hands them back.
        pictures: also make the frames that a report shows.
        about: kept in each unit's records, together with the `seconds` and `cpu_seconds` that it took.
    """

    units: tuple[Unit, ...]
    shards: Shards | None = None
    pictures: bool = False
    about: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, number: int) -> Outcome:
        start, cpu_start = perf_counter(), process_time()
        try:
            result = run_unit(self.units[number], self.pictures)
            took = {"seconds": perf_counter() - start, "cpu_seconds": process_time() - cpu_start}
            tables = {RECORDS: with_facts(to_table(result.records), **took, **self.about)}
            if self.pictures:
                tables[PICTURES] = pictures_table(result.pages)
            if self.shards is None:
                return Done(tables)
            self.shards.write(number, tables)
        except Exception as error:
            return Failure.of(error)
        return Done(None)


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
        """What was noted about each of its units: `seconds`, `cpu_seconds`, and what `run` was told `about` them."""
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
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Results:
    """Run all units that `shards` does not hold yet.

    Args:
        units: the work.
        executor: what runs it.
        shards: the run's folder, opened; None keeps everything in memory.
        shared_folder: workers see that folder and write their shards themselves.
        about: noted in each unit's records.
        progress: called with (units done, units in all).

    Raises:
        UnitFailedError: units failed ATTEMPTS times; all others are finished.
        Exception: an error of FINAL that a unit raised.
    """
    units = tuple(units)
    kept: dict[int, pa.Table] = {}
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
        progress(len(finished), len(units))
    if shards is not None:
        return Results(units, shards.read, shards.schema)
    return Results(units, kept.__getitem__, lambda number: kept[number].schema)


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


def serial(todo: Sequence[int], run_one: RunOneUnit) -> Iterator[tuple[int, Outcome]]:
    """One unit after the other, in this process."""
    for number in todo:
        yield number, run_one(number)


def processes(workers: int, todo: Sequence[int], run_one: RunOneUnit) -> Iterator[tuple[int, Outcome]]:
    """As many units at a time as there are workers; a worker that dies costs those that were running."""
    waiting = deque(todo)
    while waiting:
        with _pool(min(workers, len(waiting)), run_one) as pool:
            yield from _feed(pool, workers, waiting)


def _feed(pool: ProcessPoolExecutor, workers: int, waiting: deque[int]) -> Iterator[tuple[int, Outcome]]:
    """Until nothing waits any more or the pool is broken."""
    running: dict[Future[Outcome], int] = {}
    broken = False
    while running or (waiting and not broken):
        while waiting and len(running) < workers and not broken:
            try:
                running[pool.submit(_run_here, waiting[0])] = waiting[0]
                waiting.popleft()
            except BrokenProcessPool:
                broken = True
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            number = running.pop(future)
            try:
                yield number, future.result()
            except BrokenProcessPool:
                broken = True
                yield number, Failure(WorkerDiedError("its worker process died (killed, or out of memory?)"))


@contextmanager
def _pool(workers: int, run_one: RunOneUnit) -> Iterator[ProcessPoolExecutor]:
    """Spawned, not forked: Numba's and pybullet's state does not survive a fork."""
    pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=_begin_worker, initargs=(run_one,))
    try:
        yield pool
    except BaseException:
        # Shards appear by rename, so that a worker may be stopped at any moment.
        started = list((getattr(pool, "_processes", None) or {}).values())
        pool.shutdown(wait=False, cancel_futures=True)
        for process in started:
            process.terminate()
        raise
    pool.shutdown()


_run_one: RunOneUnit | None = None


def _begin_worker(run_one: RunOneUnit) -> None:
    global _run_one
    _run_one = run_one
    # An interrupt reaches the whole process group; the parent alone decides what follows from it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """A killed run leaves no workers behind."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run_here(number: int) -> Outcome:
    assert _run_one is not None
    return _run_one(number)
