"""What runs units, here: one after the other, or several at a time in processes; `engine_ray.py` does it elsewhere.

An executor is a plain callable `(todo, run_one) -> (number, outcome)...`: it calls `run_one(number)` for every number
in `todo`, wherever and in whichever order it likes, and yields what came of each as it comes. `run_one` can be
pickled. A unit that was lost, because its worker died, is yielded as a `Failure`.
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
from multiprocessing import get_context, parent_process
from time import perf_counter, process_time
from typing import Any

import pyarrow as pa

from .experiments import Unit, run_unit
from .pictures import to_table as pictures_table
from .records import failures, to_table
from .shards import PICTURES, RECORDS, Shards, with_facts


class WorkerDiedError(RuntimeError):
    """The process that ran a unit ended without a word: killed, or out of memory."""


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
        about: kept in each unit's records, together with the `seconds` and `cpu_seconds` that it took and the
            `failures` of methods.
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
            failed = failures(result.records)
            tables = {RECORDS: with_facts(to_table(result.records), **took, failures=failed, **self.about)}
            if self.pictures:
                tables[PICTURES] = pictures_table(result.pages)
            if self.shards is None:
                return Done(tables)
            self.shards.write(number, tables)
        except Exception as error:
            return Failure.of(error)
        return Done(None)


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
