"""Block coordinate ascent for hypergraph matching (Nguyen, Gautier and Hein 2015): triples, solved by assignments.

The third-order score T(x, x, x) of matchings is lifted to the symmetric fourth-order form

    F(x, y, z, t) = T(x, y, z) + T(x, y, t) + T(x, z, t) + T(y, z, t),

which (all matchings having equal size) has the same maximisers on x = y = z = t. Each block in turn is set to the best
matching given the other three, a linear assignment. A multiple alpha of <x,y><z,t> + <x,z><y,t> + <x,t><y,z>, which
is constant there, makes the form convex and thereby leads the four blocks together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from .candidates import assignment, check_size
from .checks import check_count
from .graph import Matching, ObjectGraph, check_comparable
from .pose import Array, RelativePose
from .rrwhm import MAX_CANDIDATES, triples
from .similarity import contract


def bcagm(
    source: ObjectGraph,
    target: ObjectGraph,
    *,
    prior: RelativePose | None = None,
    rng: np.random.Generator | None = None,
    iterations: int = 100,
    neighbours_factor: float = 0.3,
    angle_width: float | None = 0.3,
) -> Matching:
    """Match by the angles of triples with tensor block coordinate ascent.

    Args:
        source, target: the two robots' graphs, n n' <= 1024.
        prior, rng: not used.
        iterations: most rounds over the four blocks.
        neighbours_factor, angle_width: as in `rrwhm`.

    Returns:
        min(n, n') matches, none with fewer than 3 objects a side. A score is the match's part in T(x, x, x), relative
        to that of the match with the largest part.

    Raises:
        ValueError: a parameter out of range, too many objects, different attribute classes.
    """
    check_comparable(source, target, prior)
    check_size("bcagm", source, target, MAX_CANDIDATES)
    check_count("iterations", iterations)
    n, m = len(source), len(target)
    if min(n, m) < 3:
        return Matching.empty()
    index, values = triples(source, target, neighbours_factor, angle_width)
    x = block_ascent(index, values, n, m, iterations)
    part = contract(index, values, x, x).reshape(n, m)
    return assignment(x.reshape(n, m), part / max(float((part * x.reshape(n, m)).max()), 1e-300))


def block_ascent(index: NDArray[np.int32], values: Array, n: int, m: int, iterations: int) -> Array:
    """The matching x (n m,) in {0, 1} that ascent from uniform blocks ends in."""
    blocks = [np.full(n * m, 1.0 / max(n, m)) for _ in range(4)]
    alpha, bound = 0.0, convexity_bound(values, min(n, m))
    best, best_value = blocks[0], -np.inf
    for _ in range(iterations):
        before = [b.copy() for b in blocks]
        for k in range(4):
            y, z, t = (blocks[i] for i in range(4) if i != k)
            blocks[k] = best_matching(lifted_gradient(index, values, y, z, t, alpha), n, m)
        for b in blocks:
            value = float(b @ contract(index, values, b, b))
            if value > best_value + 1e-12:
                best, best_value = b, value
        if all((b == blocks[0]).all() for b in blocks):
            return best
        if all((b == a).all() for a, b in zip(before, blocks, strict=True)):
            if alpha >= bound:
                return best
            # Stuck with unequal blocks: go on from the best of them, with the form made convex.
            alpha = bound
            blocks = [best.copy() for _ in range(4)]
    return best


def convexity_bound(values: Array, size: int) -> float:
    """alpha beyond which the lifted form is convex: three times its Frobenius norm (Nguyen 2015).

    Of the 24 n n' arrangements of every entry of T in the lifted form, those that repeat no candidate dominate.
    """
    return 3.0 * float(np.sqrt(24.0 * size * (values**2).sum()))


def lifted_gradient(index: NDArray[np.int32], values: Array, y: Array, z: Array, t: Array, alpha: float) -> Array:
    """Gradient (n m,) of the lifted form by the block that is not y, z or t; terms without that block left out."""
    gradient = contract(index, values, y, z) + contract(index, values, y, t) + contract(index, values, z, t)
    if alpha > 0:
        gradient += alpha * (y * (z @ t) + z * (y @ t) + t * (y @ z))
    return gradient


def best_matching(weight: Array, n: int, m: int) -> Array:
    """The matching (n m,) in {0, 1} of largest total weight, min(n, m) matches."""
    rows, cols = linear_sum_assignment(weight.reshape(n, m), maximize=True)
    x = np.zeros(n * m)
    x[rows * m + cols] = 1.0
    return x
