"""Peak memory of one solve, each in a process of its own (Linux)."""

from __future__ import annotations

import re
from multiprocessing import get_context
from pathlib import Path
from typing import Any

STATUS = Path("/proc/self/status")


def add_memory(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows of `speed_matching`, each with `memory_mib`: peak of a solve above the process's size before it.

    None where the operating system does not tell.
    """
    if not STATUS.exists():
        return [row | {"memory_mib": None} for row in rows]
    context = get_context("spawn")
    # A fresh process for every solve: memory freed by one would hide what the next takes.
    with context.Pool(1, maxtasksperchild=1) as pool:
        used = pool.starmap(peak_mib, [(row["what"], row["n"]) for row in rows], chunksize=1)
    return [row | {"memory_mib": m} for row, m in zip(rows, used, strict=True)]


def peak_mib(method: str, n: int) -> float:
    """MiB that a solve of n objects a side takes at its peak; compiled and warm."""
    from .speed_matching import problem, solve_all

    solve_all(method, [problem(5)])
    solve_all(method, [problem(15)])
    task = [problem(n)]
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    before = _kib("VmRSS")
    solve_all(method, task)
    return max(0, _kib("VmHWM") - before) / 1024


def resident_mib() -> float:
    """MiB that this process holds in memory now."""
    return _kib("VmRSS") / 1024


def _kib(field: str) -> int:
    found = re.search(rf"^{field}:\s+(\d+) kB", STATUS.read_text(), re.MULTILINE)
    assert found is not None
    return int(found.group(1))
