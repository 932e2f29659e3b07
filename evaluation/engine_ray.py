"""`--engine ray`: the units of a run on a Ray cluster (extra `covis[ray]`).

A unit is one task, so that Ray places, spreads and, when a worker or a node dies, repeats it elsewhere. What a unit
yields comes back through Ray and is written by the driver: nodes need not share a file system. They need the same
covis and the same versions of what can alter results, and dataset folders under the same (absolute) paths.
"""

from __future__ import annotations

import os
import socket
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from .executors import Executor, Failure, Outcome, RunOne, RunOneUnit, WorkerDiedError
from .experiments import Unit
from .extras import require
from .provenance import PACKAGES, versions

RETRIES = 2
"""How often Ray itself repeats a task whose worker or node died; after that the run's own attempts begin."""

REACH_S = 5.0

AHEAD = 2
"""Tasks handed to Ray per unit that can run at once, so that no CPU waits for the driver."""


def ray_executor(address: str | None = None, workers: int = 1) -> Executor:
    """An executor on Ray.

    Args:
        address: of a running cluster, `auto` or HOST:PORT; None starts one on this machine for the run.
        workers: units at a time; 1 = as many as the cluster has CPUs.

    Raises:
        MissingExtraError: Ray is not installed.
    """
    require("ray")
    return partial(_on_cluster, address, workers)


def _on_cluster(
    address: str | None, workers: int, todo: Sequence[int], run_one: RunOneUnit
) -> Iterator[tuple[int, Outcome]]:
    import ray

    with _connected(address):
        at_once = workers if workers > 1 else max(1, int(ray.cluster_resources().get("CPU", 1)))
        # SPREAD: a node's worth of units is not lost with the node while others idle.
        task = ray.remote(num_cpus=1, max_retries=RETRIES, scheduling_strategy="SPREAD")(_run_there)
        shared = ray.put(run_one)
        yield from _feed(lambda number: task.remote(shared, number, _versions()), at_once, workers > 1, deque(todo))


@contextmanager
def _connected(address: str | None) -> Iterator[None]:
    """Connected to the cluster; a connection that the caller has already is used and left as it is."""
    import ray

    if ray.is_initialized():
        yield
        return
    _reach(address)
    # Nothing calls home from a benchmark.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    own = {"include_dashboard": False} if address is None else {}
    try:
        ray.init(address or "local", log_to_driver=False, logging_level="ERROR", **own)
    except Exception as error:  # Ray raises plain Exception, too, when a cluster does not come up in time
        raise RuntimeError(f"no Ray cluster at {address or 'this machine'}: {error}") from error
    try:
        yield
    finally:
        ray.shutdown()


def _reach(address: str | None) -> None:
    """Raises RuntimeError when nobody listens at HOST:PORT; Ray itself would go on trying for minutes."""
    host, _, port = (address or "").rpartition(":")
    if not host or not port.isdigit():
        return
    try:
        socket.create_connection((host.removeprefix("ray://"), int(port)), timeout=REACH_S).close()
    except OSError as error:
        raise RuntimeError(f"no Ray cluster at {address}: {error}") from error


def _feed(start: Any, at_once: int, strict: bool, waiting: deque[int]) -> Iterator[tuple[int, Outcome]]:
    """Each unit as it comes; `strict` keeps no task in reserve."""
    import ray

    running: dict[Any, int] = {}
    limit = at_once if strict else AHEAD * at_once
    try:
        while waiting or running:
            while waiting and len(running) < limit:
                number = waiting.popleft()
                running[start(number)] = number
            done, _ = ray.wait(list(running), num_returns=1)
            for reference in done:
                yield running.pop(reference), _outcome(reference)
    finally:
        for reference in running:
            ray.cancel(reference, force=True)


def _outcome(reference: Any) -> Outcome:
    """What a task has brought; a unit that its nodes have lost is a failure, an error of the task itself is raised."""
    import ray
    from ray.exceptions import RayError, RayTaskError

    try:
        return ray.get(reference)
    except RayTaskError as error:
        raise error.cause if isinstance(error.cause, Exception) else RuntimeError(str(error)) from error
    except RayError as error:
        what = str(error).strip().splitlines()
        return Failure(WorkerDiedError(f"its worker or node died: {type(error).__name__}: {what[0] if what else ''}"))


def _run_there(run_one: RunOneUnit, number: int, expected: dict[str, str]) -> Outcome:
    """In a worker, anywhere."""
    here = _versions()
    if here != expected:
        differing = [
            f"{name} {here.get(name)} instead of {expected.get(name)}"
            for name in PACKAGES
            if here.get(name) != expected.get(name)
        ]
        raise RuntimeError(f"node {os.uname().nodename} would give other results: it has {', '.join(differing)}")
    if isinstance(run_one, RunOne):
        _need_files(run_one.units[number])
    return run_one(number)


def _need_files(unit: Unit) -> None:
    """Raises RuntimeError where this node lacks the dataset folder of a unit."""
    target = unit.experiment.target
    if unit.experiment.kind == "dataset" and not Path(target).is_dir():
        raise RuntimeError(
            f"node {os.uname().nodename} has no dataset folder {target}: put it there under the same path on every node"
        )


@lru_cache(maxsize=1)
def _versions() -> dict[str, str]:
    return versions()
