"""Claims and truth to scores: the rules of docs/reference/scoring.md, in one place.

1. Boxes are tied to true objects one-to-one by IoU >= 0.5 with the tight box of the object's visible pixels in the
   claimant's own image, highest IoU first. What is left over, duplicates included, has no identity.
2. Each unordered pair of robots is scored once, on the union of both robots' asserted matches. An assertion is correct
   when both slots carry the same true object; everything else asserted is retrieved and wrong.
3. Displacement error is Euclidean, in the claimant's camera frame, over correctly matched objects, single and fused on
   the same ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ..matching.metrics import Counts
from ..matching.pose import invert, transform
from .claims import Claims

Array = NDArray[np.float64]
MIN_IOU = 0.5


@dataclass(frozen=True, eq=False)
class Truth:
    """What is true at one instant, for m objects and N robots.

    Attributes:
        identity: (m,) int64, stable over an episode.
        object_class: (m,) int64.
        positions: (m, 3) m, world frame.
        T_world_camera: (N, 4, 4).
        boxes: (N, m, 4) tight boxes [u0, v0, u1, v1] of the visible pixels in each robot's image.
        pixels: (N, m) number of visible pixels.
        min_pixels: an object with fewer visible pixels does not count as visible.
    """

    identity: NDArray[np.int64]
    object_class: NDArray[np.int64]
    positions: Array
    T_world_camera: Array
    boxes: Array
    pixels: NDArray[np.int64]
    min_pixels: int

    @property
    def n_robots(self) -> int:
        return len(self.T_world_camera)

    def visible(self) -> NDArray[np.bool_]:
        """(N, m) objects with at least `min_pixels` visible pixels."""
        return self.pixels >= self.min_pixels

    def positions_in_camera(self, robot: int) -> Array:
        """(m, 3) m, in the camera frame of the robot's true pose."""
        return transform(invert(self.T_world_camera[robot]), self.positions)


@dataclass(frozen=True)
class PairScore:
    """One unordered pair of robots, a < b.

    `counts.common` is the number of objects tied in both robots' claims, `n_visible` that of objects visible in both
    images, detected or not. `assertions` (j, 2) are the asserted slots [of a, of b], `hits` (j,) which are correct,
    `scores` (j,) the higher of the two robots' match scores.
    """

    a: int
    b: int
    counts: Counts
    n_visible: int
    assertions: NDArray[np.int64]
    hits: NDArray[np.bool_]
    scores: Array

    @property
    def scene_recall(self) -> float:
        return self.counts.correct / self.n_visible if self.n_visible else 0.0


@dataclass(frozen=True, eq=False)
class StepScore:
    """Scores of all robots' claims about one instant.

    Attributes:
        pairs: one score per unordered pair.
        tied: (N, K) object index of each slot, -1 = none.
        error_single, error_fused: (N, K) m; NaN for slots that are not correctly matched.
        object_error: (m,) m, best fused error of any robot that localises the object; inf = nobody.
    """

    pairs: tuple[PairScore, ...]
    tied: NDArray[np.int64]
    error_single: Array
    error_fused: Array
    object_error: Array

    @cached_property
    def counts(self) -> Counts:
        return sum((p.counts for p in self.pairs), Counts())

    @cached_property
    def n_visible(self) -> int:
        return sum(p.n_visible for p in self.pairs)


Reward = Callable[[StepScore], float]


@dataclass(frozen=True)
class LocalizationReward:
    """Mean over all objects of the scene of 1 - min(error, cap)/cap, less a penalty per wrong match.

    An object nobody localises counts 0, so looking away or claiming little never pays.

    Attributes:
        cap_m: error at which a localisation is worth nothing.
        wrong_match_penalty: per wrong match of the step.
    """

    cap_m: float = 2.0
    wrong_match_penalty: float = 0.02

    def __call__(self, score: StepScore) -> float:
        counts = score.counts
        gain = 1.0 - np.minimum(score.object_error, self.cap_m) / self.cap_m
        mean_gain = float(gain.mean()) if len(gain) else 0.0
        return mean_gain - self.wrong_match_penalty * (counts.retrieved - counts.correct)


def score(claims: Sequence[Claims], truth: Truth) -> StepScore:
    """Score the claims of all robots, in the order of `truth.T_world_camera`."""
    tied = np.stack([tie(claim.boxes, truth.boxes[i], truth.pixels[i]) for i, claim in enumerate(claims)])
    visible = truth.visible()
    pairs = tuple(_score_pair(a, b, claims, tied, visible) for a, b in combinations(range(len(claims)), 2))
    matched = np.zeros(tied.shape, dtype=bool)
    for pair in pairs:
        if pair.counts.correct:
            right = pair.assertions[pair.hits]
            matched[pair.a, right[:, 0]] = True
            matched[pair.b, right[:, 1]] = True
    single = np.full(tied.shape, np.nan)
    fused = single.copy()
    object_error = np.full(len(truth.identity), np.inf)
    for i, claim in enumerate(claims):
        slots = np.flatnonzero(tied[i] >= 0)
        if len(slots) == 0:
            continue
        objects = tied[i, slots]
        true = truth.positions_in_camera(i)[objects]
        error = np.linalg.norm(claim.positions[slots] - true, axis=1)
        np.minimum.at(object_error, objects, error)
        fused[i, slots] = np.where(matched[i, slots], error, np.nan)
        alone = np.linalg.norm(claim.positions_single[slots] - true, axis=1)
        single[i, slots] = np.where(matched[i, slots], alone, np.nan)
    return StepScore(pairs, tied, single, fused, object_error)


def _score_pair(
    a: int, b: int, claims: Sequence[Claims], tied: NDArray[np.int64], visible: NDArray[np.bool_]
) -> PairScore:
    # Partners are listed in ascending order without self: b is at b - 1 for a, a is at a for b.
    forward, forward_scores = claims[a].matches[b - 1], claims[a].match_scores[b - 1]
    backward, backward_scores = claims[b].matches[a], claims[b].match_scores[a]
    K = len(forward)
    asserted: dict[tuple[int, int], float] = {}
    for k in (forward < K).nonzero()[0].tolist():
        asserted[k, int(forward[k])] = float(forward_scores[k])
    for k in (backward < K).nonzero()[0].tolist():
        key = int(backward[k]), k
        asserted[key] = max(asserted.get(key, 0.0), float(backward_scores[k]))
    common = set(tied[a].tolist()) & set(tied[b].tolist()) - {-1}
    n_visible = int(np.count_nonzero(visible[a] & visible[b]))
    if not asserted:
        return PairScore(a, b, Counts(0, 0, len(common)), n_visible, *_nothing())
    slots = np.array(list(asserted), dtype=np.int64)
    object_a, object_b = tied[a, slots[:, 0]], tied[b, slots[:, 1]]
    hits = (object_a == object_b) & (object_a >= 0)
    counts = Counts(int(np.count_nonzero(hits)), len(slots), len(common))
    return PairScore(a, b, counts, n_visible, slots, hits, np.array(list(asserted.values())))


def _nothing() -> tuple[NDArray[np.int64], NDArray[np.bool_], Array]:
    """Slots, hits and scores of no assertion."""
    return np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=bool), np.zeros(0)


@njit(cache=True)
def tie(boxes: Array, true_boxes: Array, pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Object index (K,) of each claimed box (K, 4), -1 = none; true boxes (m, 4), visible pixels (m,)."""
    K, m = len(boxes), len(true_boxes)
    out = np.full(K, -1, dtype=np.int64)
    if not (boxes[:, 2] > boxes[:, 0]).any():
        return out
    iou = np.zeros((K, m))
    for k in range(K):
        u0, v0, u1, v1 = boxes[k]
        if u1 <= u0 or v1 <= v0:
            continue
        for j in range(m):
            if pixels[j] == 0:
                continue
            t0, w0, t1, w1 = true_boxes[j]
            width, height = min(u1, t1) - max(u0, t0), min(v1, w1) - max(v0, w0)
            if width > 0 and height > 0:
                overlap = width * height
                iou[k, j] = overlap / ((u1 - u0) * (v1 - v0) + (t1 - t0) * (w1 - w0) - overlap)
    for _ in range(min(K, m)):
        best = int(np.argmax(iou))
        k, j = best // m, best % m
        if iou[k, j] < MIN_IOU:
            break
        out[k] = j
        iou[k, :] = 0.0
        iou[:, j] = 0.0
    return out


@njit(cache=True)
def tight_boxes(instances: NDArray[np.int32], m: int) -> tuple[Array, NDArray[np.int64]]:
    """Tight boxes (m, 4) [u0, v0, u1, v1] and pixel counts (m,) of the objects 0..m-1 in an instance image (H, W)."""
    height, width = instances.shape
    boxes = np.zeros((m, 4))
    pixels = np.zeros(m, dtype=np.int64)
    for v in range(height):
        row = instances[v]
        # Most of a picture is background: a row's greatest id is found in vector code.
        if row.max() < 0:
            continue
        u = 0
        while u < width:
            j, first = row[u], u
            while u < width and row[u] == j:
                u += 1
            if j < 0:
                continue
            if pixels[j] == 0:
                boxes[j, 0], boxes[j, 1], boxes[j, 2], boxes[j, 3] = first, v, u, v + 1
            else:
                boxes[j, 0] = min(boxes[j, 0], first)
                boxes[j, 2] = max(boxes[j, 2], u)
                boxes[j, 3] = v + 1
            pixels[j] += u - first
    return boxes, pixels
