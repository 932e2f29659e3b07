"""Numbers of the paper, to stand beside ours: Table 1 (precision, recall) and the case study of section 4.5."""

from __future__ import annotations

Pair = tuple[float, float]

SCENE_NAMES = {"connected_driving": "CAD", "multi_robot": "S-MRC", "aerial_ground": "R-MRC"}

TABLE_1: dict[str, dict[str, Pair]] = {
    "connected_driving": {
        "rrwm": (0.032, 0.029),
        "icp": (0.061, 0.069),
        "bcagm": (0.154, 0.186),
        "rrwhm": (0.161, 0.173),
        "reid": (0.238, 0.264),
        "mos": (0.571, 0.681),
        "rgm-no-uncertainty": (0.611, 0.641),
        "rgm-no-covisibility": (0.608, 0.684),
        "rgm": (0.659, 0.718),
    },
    "multi_robot": {
        "rrwm": (0.289, 0.291),
        "icp": (0.302, 0.311),
        "bcagm": (0.503, 0.587),
        "rrwhm": (0.524, 0.592),
        "reid": (0.321, 0.472),
        "mos": (0.641, 0.658),
        "rgm-no-uncertainty": (0.678, 0.661),
        "rgm-no-covisibility": (0.685, 0.688),
        "rgm": (0.701, 0.711),
    },
    "aerial_ground": {
        "rrwm": (0.131, 0.106),
        "icp": (0.089, 0.116),
        "bcagm": (0.201, 0.256),
        "rrwhm": (0.219, 0.221),
        "reid": (0.396, 0.508),
        "mos": (0.559, 0.702),
        "rgm-no-uncertainty": (0.563, 0.708),
        "rgm-no-covisibility": (0.565, 0.711),
        "rgm": (0.575, 0.723),
    },
    "target_localization": {"rgm": (0.9986, 0.7268)},
}

CASE_STUDY_ERROR_M = (0.0175322, 0.0120441)
"""Displacement error of one robot alone and fused, section 4.5."""


def published(target: str, method: str) -> Pair | None:
    """Precision and recall that the paper gives for a method on a scene."""
    return TABLE_1.get(target, {}).get(method)


def f1(pair: Pair) -> float:
    """Of the published means; the paper gives no F1."""
    precision, recall = pair
    return 2 * precision * recall / (precision + recall)
