"""Matchers' solves per second on one thread, warm: every built-in method from 5 to 200 objects a side, and peers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ..matching import METHODS
from ..matching.candidates import affinity_matrix
from ..matching.rrwm import distance_width, reweighted_random_walk
from ..matching.similarity import distances
from ..matching.testing import MatchingProblem, scene
from .timing import rates, row

SIZES = (5, 15, 50, 100, 200)
"""Objects a side."""
RRWM_STEPS = 50
RRWM_HALF_NORMALISATIONS = 20
"""pygmtools' defaults: steps of the walk, and normalisations of rows or columns (two of them are one of ours)."""
LONGEST_SOLVE_S = 10.0
"""A method is not measured at a size after one where a single solve took longer than this."""


def rows(progress: Callable[[int, int], None] = lambda done, total: None) -> list[dict[str, Any]]:
    """One row per method and size it accepts; `n` is the number of objects a side.

    The rows `rrwm_walk` compare the walks alone, ours and pygmtools', on one affinity with equal numbers of steps and
    normalisations. Where pygmtools is not installed they have no peer.
    """
    jobs: list[Callable[[], list[dict[str, Any]]]] = [partial(walk_rows, n) for n in SIZES if n <= 50]
    jobs += [partial(method_rows, name) for name in sorted(METHODS)]
    out: list[dict[str, Any]] = []
    for i, job in enumerate(jobs):
        progress(i, len(jobs))
        out.extend(job())
    progress(len(jobs), len(jobs))
    return out


def problem(n: int, seed: int = 0) -> MatchingProblem:
    """Two views of n objects each, two thirds of them common, one in three seen by one robot only."""
    common = max(1, round(2 * n / 3))
    return scene(
        np.random.default_rng(seed), common=common, source_only=n - common, target_only=n - common, noise_m=0.1
    )


def method_rows(name: str) -> list[dict[str, Any]]:
    """Rows of one method, at every size until it refuses one or becomes too slow."""
    out = []
    for n in SIZES:
        problems = [problem(n, seed) for seed in range(3)]
        try:
            rate, _ = rates(partial(solve_all, name, problems), seconds=0.2, rounds=3)
        except ValueError:  # it refuses this size
            break
        rate *= len(problems)
        out.append(row("matching", name, n, rate, None, None))
        if 1 / rate > LONGEST_SOLVE_S / 8:  # the next size takes eight times as long or more
            break
    return out


def solve_all(name: str, problems: list[MatchingProblem]) -> None:
    for p in problems:
        prior = p.prior if name == "hungarian" else None
        METHODS[name](p.source, p.target, prior=prior, rng=np.random.default_rng(0))


def walk_rows(n: int) -> list[dict[str, Any]]:
    """One row: our random walk against pygmtools' on one affinity, with equal numbers of steps and normalisations."""
    return [rrwm_walk(n)]


def rrwm_walk(n: int) -> dict[str, Any]:
    """Our random walk against pygmtools' on the same affinity, numbers of steps and of normalisations."""
    p = problem(n)
    s, t = distances(p.source.positions), distances(p.target.positions)
    width = distance_width(p.source, p.target, s, t, None, 1.0)
    K = affinity_matrix(p.source, p.target, s, t, width, 1.0)
    share = 0.8 / (0.8 + 0.2 * n)  # what pygmtools' alpha = 0.2 amounts to
    ours = partial(reweighted_random_walk, K, n, n, share, 30.0, RRWM_STEPS, RRWM_HALF_NORMALISATIONS // 2, 0.0, 0.0)
    peer = _pygmtools_walk(K, n)
    mine, theirs = rates(ours, peer, seconds=0.3)
    return row("matching", "rrwm_walk", n, mine, None if peer is None else "pygmtools rrwm, numpy", theirs)


def _pygmtools_walk(K: Any, n: int) -> Callable[[], object] | None:
    try:
        import pygmtools
    except ImportError:
        return None
    by_columns = np.ascontiguousarray(K.reshape(n, n, n, n).transpose(1, 0, 3, 2).reshape(n * n, n * n))
    return partial(
        pygmtools.rrwm,
        by_columns,
        n1=n,
        n2=n,
        max_iter=RRWM_STEPS,
        sk_iter=RRWM_HALF_NORMALISATIONS,
        alpha=0.2,
        beta=30,
        backend="numpy",
    )
