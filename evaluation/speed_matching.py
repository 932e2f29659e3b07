"""Matchers' solves per second on one thread, warm: every built-in method from 5 to 200 objects a side, and peers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from ..matching import METHODS
from ..matching.adapters import pygm
from ..matching.testing import MatchingProblem, scene
from .progress import Progress, silent
from .timing import rates, row

SIZES = (5, 15, 50, 100, 200)
"""Objects a side."""
RRWM_STEPS = 50
RRWM_HALF_NORMALISATIONS = 20
"""pygmtools' defaults: steps of the walk, and normalisations of rows or columns (two of them are one of ours)."""
PEER = "pygmtools rrwm (numpy), same affinity, steps and normalisations"
LARGEST_PEER = 50
"""Objects a side up to which the peer is measured, too."""
LONGEST_SOLVE_S = 10.0
"""A method is not measured at a size after one where a single solve took longer than this."""


def rows(progress: Progress = silent) -> list[dict[str, Any]]:
    """One row per method and size it accepts; `n` is the number of objects a side.

    The rows `rrwm` run a fixed number of steps and normalisations, the same as their peer, pygmtools' RRWM on the same
    graphs: affinities, walk and assignment on both sides. Where pygmtools is not installed they have no peer.
    """
    out: list[dict[str, Any]] = []
    for i, name in enumerate(METHODS):
        progress(i, len(METHODS))
        out.extend(method_rows(name))
    progress(len(METHODS), len(METHODS))
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
        problems = [problem(n, seed) for seed in range(3 if n < 50 else 1)]
        peer = pygmtools_rrwm(problems) if name == "rrwm" and n <= LARGEST_PEER else None
        ours = rrwm_like_peer(problems) if name == "rrwm" else partial(solve_all, name, problems)
        try:
            rate, peer_rate = rates(ours, peer, seconds=0.2, rounds=3)
        except ValueError:  # it refuses this size
            break
        rate *= len(problems)
        peer_rate = None if peer_rate is None else peer_rate * len(problems)
        out.append(row("matching", name, n, rate, None if peer is None else PEER, peer_rate))
        if 1 / rate > LONGEST_SOLVE_S / 8:  # the next size takes eight times as long or more
            break
    return out


def solve_all(name: str, problems: list[MatchingProblem]) -> None:
    for p in problems:
        prior = p.prior if name == "hungarian" else None
        METHODS[name](p.source, p.target, prior=prior, rng=np.random.default_rng(0))


def rrwm_like_peer(problems: list[MatchingProblem]) -> Callable[[], object]:
    """Our RRWM with pygmtools' defaults: all steps, all normalisations."""
    options = {
        "iterations": RRWM_STEPS,
        "sinkhorn_iterations": RRWM_HALF_NORMALISATIONS // 2,
        "tolerance": 0.0,
        "sinkhorn_tolerance": 0.0,
    }
    return lambda: [METHODS["rrwm"](p.source, p.target, **options) for p in problems]


def pygmtools_rrwm(problems: list[MatchingProblem]) -> Callable[[], object] | None:
    if find_spec("pygmtools") is None:
        return None
    options: dict[str, Any] = {
        "max_iter": RRWM_STEPS,
        "sk_iter": RRWM_HALF_NORMALISATIONS,
        "distance_width_factor": 2.0,
    }
    return lambda: [pygm(p.source, p.target, solver="rrwm", **options) for p in problems]
