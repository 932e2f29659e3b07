"""What a robot asserts in its action: boxes, matches, positions; and how it travels in the action's flat leaves.

Slots: a robot has K slots (`max_detections`), one detection each. Leaves that concern partners are partner-major:
element p * K + k is slot k towards the p-th partner, partners in ascending order, self omitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numba import njit
from numpy.typing import ArrayLike, NDArray

POSITION_BOUND_M = 1000.0
"""Farthest position along each axis that can be claimed."""
VARIANCE_BOUND_M2 = 1e6
"""Largest variance that can be claimed."""


@dataclass(frozen=True, eq=False)
class Claims:
    """One robot's claims about one instant.

    Attributes:
        boxes: (K, 4) [u0, v0, u1, v1] of the visible pixels; a box without area is an empty slot.
        positions: (K, 3) m fused estimate, this robot's camera frame.
        positions_single: (K, 3) m this robot's estimate alone.
        position_variance: (K,) m^2 of the fused estimate, mean over axes.
        matches: (N-1, K) partner's slot of the same step; K = none.
        match_scores: (N-1, K) in [0, 1].
    """

    boxes: NDArray[np.float64]
    positions: NDArray[np.float64]
    positions_single: NDArray[np.float64]
    position_variance: NDArray[np.float64]
    matches: NDArray[np.int64]
    match_scores: NDArray[np.float64]

    @classmethod
    def empty(cls, max_detections: int, n_partners: int) -> Claims:
        """Those of a robot that claims nothing: K empty slots, matched with no slot of any of N-1 partners."""
        K = max_detections
        return cls(
            np.zeros((K, 4)),
            np.zeros((K, 3)),
            np.zeros((K, 3)),
            np.zeros(K),
            np.full((n_partners, K), K, dtype=np.int64),
            np.zeros((n_partners, K)),
        )

    def filled(self) -> NDArray[np.bool_]:
        """(K,) slots whose box has area."""
        return (self.boxes[:, 2] > self.boxes[:, 0]) & (self.boxes[:, 3] > self.boxes[:, 1])


def claims_to_action(claims: Claims, control: ArrayLike) -> dict[str, NDArray[Any]]:
    """The action that makes these claims; positions and variances are clipped to the action space's bounds."""
    bound = POSITION_BOUND_M
    return {
        "control": np.asarray(control, dtype=np.float32),
        "boxes": claims.boxes.astype(np.float32).ravel(),
        "positions": np.clip(claims.positions, -bound, bound).astype(np.float32).ravel(),
        "positions_single": np.clip(claims.positions_single, -bound, bound).astype(np.float32).ravel(),
        "position_variance": np.clip(claims.position_variance, 0, VARIANCE_BOUND_M2).astype(np.float32),
        "matches": claims.matches.astype(np.int64).ravel(),
        "match_scores": claims.match_scores.astype(np.float32).ravel(),
    }


def silent_actions(
    agents: Sequence[str], controls: ArrayLike, max_detections: int
) -> dict[str, dict[str, NDArray[Any]]]:
    """Actions of all robots by controls (N, d), that claim nothing."""
    nothing = Claims.empty(max_detections, len(agents) - 1)
    rows = np.asarray(controls)
    return {agent: claims_to_action(nothing, row) for agent, row in zip(agents, rows, strict=True)}


def action_space(control_size: int, max_detections: int, n_partners: int, width: int, height: int) -> spaces.Dict:
    """The action space of one robot; every leaf is one-dimensional, because trainers demand it."""
    K = max_detections
    bound = POSITION_BOUND_M
    corner = np.tile(np.array([width, height, width, height], dtype=np.float32), K)
    return spaces.Dict(
        {
            "control": spaces.Box(-1.0, 1.0, (control_size,), np.float32),
            "boxes": spaces.Box(np.zeros_like(corner), corner, dtype=np.float32),
            "positions": spaces.Box(-bound, bound, (3 * K,), np.float32),
            "positions_single": spaces.Box(-bound, bound, (3 * K,), np.float32),
            "position_variance": spaces.Box(0.0, VARIANCE_BOUND_M2, (K,), np.float32),
            "matches": spaces.MultiDiscrete(np.full(K * n_partners, K + 1, dtype=np.int64)),
            "match_scores": spaces.Box(0.0, 1.0, (K * n_partners,), np.float32),
        }
    )


def decode(agent: str, action: Any, space: spaces.Dict) -> tuple[NDArray[np.float64], Claims]:
    """Control (d,) and claims of an action.

    Raises:
        ValueError: a missing or unknown leaf, a wrong shape or type, a NaN, a value outside the space; the message
            names agent and leaf.
    """
    if not isinstance(action, Mapping):
        raise ValueError(f"{agent}: the action must be a dict of leaves, got {type(action).__name__}")
    unknown = action.keys() - space.spaces.keys()
    if unknown:
        raise ValueError(f"{agent}: the action has no leaf {min(unknown, key=str)!r}; it has {', '.join(space.spaces)}")
    leaf = {name: _leaf(agent, name, action, leaf_space) for name, leaf_space in space.spaces.items()}
    K = len(leaf["position_variance"])
    return leaf["control"], Claims(
        leaf["boxes"].reshape(K, 4),
        leaf["positions"].reshape(K, 3),
        leaf["positions_single"].reshape(K, 3),
        leaf["position_variance"],
        leaf["matches"].reshape(-1, K),
        leaf["match_scores"].reshape(-1, K),
    )


def _leaf(agent: str, name: str, action: Mapping[str, Any], space: spaces.Space) -> NDArray[Any]:
    if name not in action:
        raise ValueError(f"{agent}: leaf {name!r} is missing")
    value = np.asarray(action[name])
    discrete = isinstance(space, spaces.MultiDiscrete)
    kinds = "iu" if discrete else "fiu"
    if value.dtype.kind not in kinds:
        raise ValueError(f"{agent}: leaf {name!r} must hold {'integers' if discrete else 'numbers'}, got {value.dtype}")
    if value.shape != space.shape:
        raise ValueError(f"{agent}: leaf {name!r} must have shape {space.shape}, got {value.shape}")
    out = np.array(value, dtype=np.int64 if discrete else np.float64)
    if discrete:
        nvec = space.nvec
        if _counted(out, nvec):
            return out
        low, high = np.zeros_like(nvec), nvec - 1
    else:
        low, high = space.low, space.high
        if _within(out, low, high):
            return out
    if not discrete and np.isnan(out).any():
        raise ValueError(f"{agent}: leaf {name!r} holds NaN at {int(np.argmax(np.isnan(out)))}")
    bad = int(np.argmin((out >= low) & (out <= high)))
    raise ValueError(f"{agent}: leaf {name!r} holds {value[bad]} at {bad}, outside the action space")


@njit(cache=True)
def _within(values: NDArray[np.float64], low: NDArray[np.float32], high: NDArray[np.float32]) -> bool:
    """Whether all values (n,) are in [low, high]; NaN is not."""
    for i in range(len(values)):  # noqa: SIM110 - Numba knows no all()
        if not low[i] <= values[i] <= high[i]:
            return False
    return True


@njit(cache=True)
def _counted(values: NDArray[np.int64], counts: NDArray[np.int64]) -> bool:
    """Whether all values (n,) are in 0..counts-1."""
    for i in range(len(values)):  # noqa: SIM110
        if not 0 <= values[i] < counts[i]:
            return False
    return True
