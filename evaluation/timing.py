"""Rates measured side by side: two jobs in turn, in one process, so that a drifting machine hits both."""

from __future__ import annotations

import gc
from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Any

Job = Callable[[], object]


def rates(
    ours: Job,
    peer: Job | None = None,
    *,
    seconds: float = 1.0,
    rounds: int = 5,
    clock: Callable[[], float] = perf_counter,
) -> tuple[float, float | None]:
    """Runs per second (median over rounds) of two jobs, alternately; each job is warmed up once.

    Args:
        ours, peer: called without arguments.
        seconds: least time per job and round, so that short jobs are repeated.
        rounds: measurements of each.
        clock: seconds; `process_time` for jobs of one thread that never wait, so that other work on the machine counts
            on neither side.
    """
    jobs = [ours] if peer is None else [ours, peer]
    repeats = [_repeats(job, seconds, clock) for job in jobs]
    measured: list[list[float]] = [[] for _ in jobs]
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        for _ in range(rounds):
            for job, n, rate in zip(jobs, repeats, measured, strict=True):
                start = clock()
                for _ in range(n):
                    job()
                rate.append(n / (clock() - start))
            gc.collect()
    finally:
        if was_enabled:
            gc.enable()
    return median(measured[0]), None if peer is None else median(measured[1])


def _repeats(job: Job, seconds: float, clock: Callable[[], float]) -> int:
    job()
    start = clock()
    job()
    once = max(clock() - start, 1e-7)
    return max(1, round(seconds / once))


def row(area: str, what: str, n: int | None, ours: float, peer: str | None, peer_value: float | None) -> dict[str, Any]:
    """One row of `covis speed`; rates are per second, larger is better."""
    ratio = ours / peer_value if peer_value else None
    return {
        "area": area,
        "what": what,
        "n": n,
        "ours": ours,
        "peer": peer,
        "peer_value": peer_value,
        "ratio": ratio,
        "unit": "1/s",
    }
