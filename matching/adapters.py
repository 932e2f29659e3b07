"""Matchers of other packages behind the one signature, if they are installed: pygmtools' solvers and kiss-matcher.

`load_matcher("pygm:rrwm")` gives pygmtools' RRWM on the affinities that our `rrwm` builds; likewise every name of
`PYGM_SOLVERS`. `load_matcher("kiss-matcher")` gives KISS-Matcher's registration (graph-theoretic pruning of candidate
matches, then a robust pose), with the candidates its pruning keeps as matches.
"""

from __future__ import annotations

from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from .candidates import MAX_CANDIDATES, affinity_matrix, assignment, check_size, distance_variance_m2, mean_agreement
from .checks import check_interval
from .graph import Matcher, Matching, ObjectGraph, check_comparable
from .pose import Array, RelativePose
from .rrwm import distance_width
from .similarity import attribute_similarity, distances

PYGM_SOLVERS = ("rrwm", "sm", "ipfp", "ngm")
"""Solvers of Lawler's quadratic assignment in pygmtools; "ngm" is learned, fetches its weights, and needs torch."""


class MissingPackageError(ImportError):
    """The package behind an adapter is not installed."""


def adapter(name: str) -> Matcher:
    """The matcher behind `pygm:<solver>` or `kiss-matcher`.

    Raises:
        ValueError: pygmtools has no such solver among `PYGM_SOLVERS`.
        MissingPackageError: the package is not installed; the message says how to get it.
    """
    if name == "kiss-matcher":
        _need("kiss_matcher", "kiss-matcher", name)
        return kiss_matcher
    solver = name.removeprefix("pygm:")
    if solver not in PYGM_SOLVERS:
        raise ValueError(f"no pygmtools solver is called {solver!r}; known are {', '.join(PYGM_SOLVERS)}")
    _need("pygmtools", "pygmtools", name)
    if solver == "ngm":
        _need("torch", "torch", name)
    return partial(pygm, solver=solver)


def is_adapter(name: str) -> bool:
    """Whether the name belongs to another package's matcher."""
    return name == "kiss-matcher" or name.startswith("pygm:")


def pygm(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    solver: str = "rrwm",
    distance_width_m2: float | None = None,
    distance_width_factor: float = 1.0,
    attribute_weight: float = 1.0,
    **solver_options: Any,
) -> Matching:
    """Solve the pairwise problem of our `rrwm` with one of pygmtools' solvers, then assign.

    Args:
        source, target: the two robots' graphs, n n' <= `MAX_CANDIDATES`.
        prior, rng: not used.
        solver: one of `PYGM_SOLVERS`.
        distance_width_m2, distance_width_factor, attribute_weight: as in `rrwm`.
        solver_options: passed on to pygmtools.

    Returns:
        min(n, n') matches, each scored by its mean affinity with the others.

    Raises:
        ValueError: a parameter out of range, too many objects, different attribute classes.
        RuntimeError: the weights of "ngm" are neither there nor to be had; its option `pretrain=False` does without.
    """
    check_comparable(source, target, prior)
    check_size(f"pygm:{solver}", source, target, MAX_CANDIDATES)
    check_interval("attribute_weight", attribute_weight, "[0, inf)")
    n, m = len(source), len(target)
    if n == 0 or m == 0:
        return Matching.empty()
    s, t = distances(source.positions), distances(target.positions)
    width = distance_width(source, target, s, t, distance_width_m2, distance_width_factor)
    K = affinity_matrix(source, target, s, t, width, attribute_weight)
    if not K.any():
        return Matching.empty()
    soft = np.ones((1, 1)) if n * m == 1 else solve_pygm(solver, K, n, m, **solver_options)
    A = attribute_similarity(source.attributes, target.attributes) ** attribute_weight
    return mean_agreement(assignment(soft), s, t, width, A)


def solve_pygm(solver: str, K: Array, n: int, m: int, **options: Any) -> Array:
    """Soft assignment (n, m) by pygmtools; affinity K (n m, n m) with candidate i * m + i'."""
    package: Any = import_module("pygmtools")
    # pygmtools numbers candidates by columns: i' * n + i.
    by_columns = K.reshape(n, m, n, m).transpose(1, 0, 3, 2).reshape(n * m, n * m)
    if solver != "ngm":
        return _clean(getattr(package, solver)(by_columns, n1=n, n2=m, backend="numpy", **options))
    torch: Any = import_module("torch")
    try:
        soft = package.ngm(torch.from_numpy(by_columns).float(), n1=n, n2=m, backend="pytorch", **options)
    except OSError as error:
        raise RuntimeError(
            f"pygm:ngm lacks its weights, which pygmtools downloads at the first use: {error}"
        ) from error
    return _clean(soft.detach().numpy())


def kiss_matcher(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    resolution_m: float | None = None,
    resolution_sigmas: float = 2.0,
    min_similarity: float = 0.5,
) -> Matching:
    """KISS-Matcher's pruning and pose solver, given all candidate matches of similar attributes.

    Args:
        source, target: the two robots' graphs, n n' <= `MAX_CANDIDATES`.
        prior, rng: not used.
        resolution_m: its voxel size, which sets its noise bounds, m. None: `resolution_sigmas` times the root of the
            median variance of a candidate.
        resolution_sigmas: see above.
        min_similarity: candidates of lower attribute similarity, Eq. (1), are left out.

    Returns:
        Matches it keeps as inliers of one rigid motion, each object once; score 1.

    Raises:
        ValueError: a parameter out of range, too many objects, different attribute classes.
    """
    check_comparable(source, target, prior)
    check_size("kiss-matcher", source, target, MAX_CANDIDATES)
    check_interval("min_similarity", min_similarity, "[0, 1]")
    check_interval("resolution_sigmas", resolution_sigmas, "(0, inf)")
    if resolution_m is not None:
        check_interval("resolution_m", resolution_m, "(0, inf)")
    if min(len(source), len(target)) < 3:
        return Matching.empty()
    package: Any = import_module("kiss_matcher")
    if resolution_m is None:
        variance = distance_variance_m2(source, target, distances(source.positions), distances(target.positions))
        resolution_m = resolution_sigmas * float(np.sqrt(variance))
    candidates = np.argwhere(attribute_similarity(source.attributes, target.attributes) >= min_similarity)
    if len(candidates) < 3:
        return Matching.empty()
    p = source.positions[candidates[:, 0]].astype(np.float32)
    q = target.positions[candidates[:, 1]].astype(np.float32)
    solver = package.KISSMatcher(package.KISSMatcherConfig(resolution_m, enable_noise_bound_clamping=False))
    solution = solver.prune_and_solve(list(q), list(p))
    if not solution.valid:
        return Matching.empty()
    mapped = q @ np.asarray(solution.rotation).T + np.asarray(solution.translation).ravel()
    distance = np.linalg.norm(p - mapped, axis=1)
    return _inliers(candidates, distance, resolution_m)


def _inliers(candidates: Any, distance: Array, gate_m: float) -> Matching:
    """Candidates (k, 2) within the gate after registration, nearest first, each object once."""
    kept: list[Any] = []
    for index in np.argsort(distance, kind="stable"):
        i, j = candidates[index]
        if distance[index] <= gate_m and all(i != a and j != b for a, b in kept):
            kept.append((i, j))
    return Matching(np.array(kept, dtype=np.int64).reshape(-1, 2), np.ones(len(kept)))


def _clean(soft: Any) -> Array:
    """Non-negative, 0 for NaN."""
    return np.nan_to_num(np.maximum(np.asarray(soft, dtype=np.float64), 0.0))


def _need(module: str, package: str, name: str) -> None:
    """Raises MissingPackageError saying how to get `package` unless its module can be imported."""
    try:
        import_module(module)
    except ImportError as error:
        raise MissingPackageError(f"{name} needs {package}, which is not installed: pip install {package}") from error
