"""Peak memory of one solve, each in a process of its own (Linux)."""

from __future__ import annotations

import re
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from ..matching.testing import MatchingProblem
from .progress import Progress, silent
from .timing import row

STATUS = Path("/proc/self/status")


def add_memory(measured: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of `speed_matching`, each with `memory_mib`: peak of a solve above the process's size before it.

    None where the operating system does not tell.
    """
    if not STATUS.exists():
        return [r | {"memory_mib": None} for r in measured]
    context = get_context("spawn")
    # A fresh process for every solve: memory freed by one would hide what the next takes.
    with context.Pool(1, maxtasksperchild=1) as pool:
        used = pool.starmap(peak_mib, [(r["what"], r["n"]) for r in measured], chunksize=1)
    return [r | {"memory_mib": m} for r, m in zip(measured, used, strict=True)]


def rows(progress: Progress = silent) -> list[dict[str, Any]]:
    """One row per built-in method: MiB of a solve at the largest size it accepts, up to the figure's largest.

    All objects are of one class, so that no method can leave candidates out.

    Raises:
        RuntimeError: the operating system does not tell a process's memory.
    """
    from ..matching import METHODS

    if not STATUS.exists():
        raise RuntimeError("memory is measured on Linux only: there is no /proc here")
    out = []
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        for i, name in enumerate(METHODS):
            progress(i, len(METHODS))
            n, used = pool.apply(peak_at_largest, (name,))
            out.append(row("matching", f"memory_{name}", n, used, None, None) | {"unit": "MiB"})
    progress(len(METHODS), len(METHODS))
    return out


def peak_at_largest(method: str) -> tuple[int, float]:
    """Largest number of objects a side, at most the figure's, that a method does not refuse, and MiB of its solve."""
    from .speed_matching import SIZES

    for n in range(max(SIZES), 0, -1):
        try:
            return n, peak_mib(method, n, one_class=True)
        except ValueError:  # it refuses this size, at once
            continue
    raise RuntimeError(f"{method} refuses every size")


def peak_mib(method: str, n: int, *, one_class: bool = False) -> float:
    """MiB that a solve of n objects a side, of several classes or one, takes at its peak; compiled and warm."""
    from .speed_matching import problem, solve_all

    solve_all(method, [problem(5)])
    solve_all(method, [problem(15)])
    task = [_of_one_class(problem(n)) if one_class else problem(n)]
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    before = _kib("VmRSS")
    solve_all(method, task)
    return max(0, _kib("VmHWM") - before) / 1024


def _of_one_class(problem: MatchingProblem) -> MatchingProblem:
    source, target = (replace(graph, attributes=np.ones((len(graph), 1))) for graph in (problem.source, problem.target))
    return replace(problem, source=source, target=target)


def resident_mib() -> float:
    """MiB that this process holds in memory now."""
    return _kib("VmRSS") / 1024


def _kib(field: str) -> int:
    found = re.search(rf"^{field}:\s+(\d+) kB", STATUS.read_text(), re.MULTILINE)
    assert found is not None
    return int(found.group(1))
