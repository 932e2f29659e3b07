"""What `covis record` writes of a scene: the rows of each step of an episode, table by table."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .dataset_schemas import TABLES
from .settings import Settings

Rows = dict[str, list[dict[str, Any]]]
"""Table -> rows; a row's `frame` and `episode` are the recording's to add."""


def frames(env: Any, episode: int, settings: Settings) -> Iterator[Rows]:
    """The rows of each step."""
    from .run_scene import identity, look_around, make_eyes, step_scripted

    perceive = make_eyes(settings, env)
    observations, _ = env.reset(seed=[settings.seed, episode])
    step = 0
    while env.agents:
        views = look_around(env, perceive, observations, (settings.seed, episode, step))
        rows: Rows = {table: [] for table in TABLES}
        for i, (agent, view) in enumerate(zip(env.agents, views, strict=True)):
            rows["robots"].append(_robot_row(env, i, agent, observations[agent]))
            rows["detections"] += _detection_rows(env, agent, view, identity(view, i, env))
            rows["objects"] += _object_rows(env, i, agent)
        yield rows
        observations = step_scripted(env)
        step += 1


def _robot_row(env: Any, i: int, agent: str, seen: dict[str, Any]) -> dict[str, Any]:
    import cv2

    image = cv2.imencode(".png", cv2.cvtColor(seen["image"], cv2.COLOR_RGB2BGR))[1].tobytes()
    return {
        "time": env.snapshot().time,
        "robot": agent,
        "pose_truth": _flat(env.ground_truth().T_world_camera[i]),
        "image": image,
    } | {name: _flat(seen[name]) for name in ("pose", "odometry", "intrinsics", "up")}


def _detection_rows(env: Any, agent: str, view: Any, identities: NDArray[np.int64]) -> list[dict[str, Any]]:
    truth, graph, masks = env.ground_truth(), view.detections.graph, view.detections.masks
    place = dict(zip(truth.identity.tolist(), truth.positions.tolist(), strict=True))
    covariances = graph.full_covariances()
    return [
        {
            "robot": agent,
            "detection": k,
            "identity": int(identities[k]),
            "position": _flat(graph.positions[k]),
            "position_variance": float(graph.position_variance[k]),
            "attribute": _flat(graph.attributes[k]),
            "attribute_variance": float(graph.attribute_variance[k]),
            "covariance": _flat(covariances[k]),
            "embedding": None if graph.embedding is None else _flat(graph.embedding[k]),
            "box": _flat(view.detections.boxes[k]),
            "mask": None if masks is None else run_lengths(masks[k]),
            "truth": place.get(int(identities[k])),
        }
        for k in range(len(graph))
    ]


def _object_rows(env: Any, i: int, agent: str) -> list[dict[str, Any]]:
    """What the i-th robot's image really shows, of every object with a visible pixel."""
    truth, instances = env.ground_truth(), env.camera_frames()[i].instances
    return [
        {
            "robot": agent,
            "identity": int(truth.identity[k]),
            "class": env.classes[truth.object_class[k]],
            "position": _flat(truth.positions[k]),
            "pixels": int(truth.pixels[i, k]),
            "box": _flat(truth.boxes[i, k]),
            "mask": run_lengths(instances == k),
        }
        for k in np.flatnonzero(truth.pixels[i])
    ]


def run_lengths(mask: NDArray[np.bool_]) -> list[int]:
    """COCO's run lengths of a mask (H, W): column by column, in turn outside and inside, outside first."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    lengths = np.diff([0, *changes.tolist(), len(flat)]).tolist()
    return [0, *lengths] if flat[0] else lengths


def _flat(values: Any) -> list[float]:
    return np.asarray(values, dtype=np.float64).ravel().tolist()
