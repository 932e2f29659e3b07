"""What `covis view` draws, in Rerun's words: ellipsoids, match lines, pictures, and the paths of entities."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..envs.colors import CANVAS, FAINT, RIGHT, WRONG, Color
from ..matching.pose import Array, transform
from .moments import Result, Sighting

CHI = 1.0
"""Ellipsoids are drawn at so many standard deviations."""
MOST_SPREAD_M = 50.0
"""Larger ellipsoids, of depths that are unknown, would hide everything else."""
GAP_PX = 8
"""Between two pictures side by side."""


def rerun() -> Any:
    """The Rerun SDK, imported when it is first needed: it is an extra."""
    import rerun as sdk

    return sdk


def part(name: str) -> str:
    """A name as one part of an entity path."""
    return str(rerun().escape_entity_path_part(name))


def points(size: float) -> Any:
    """A radius in points of the screen instead of metres."""
    return rerun().Radius.ui_points(size)


def faint(color: Color) -> Color:
    """The colour of a curve beside the strong one of its method."""
    r, g, b = ((c + 2 * f) // 3 for c, f in zip(color, FAINT, strict=True))
    return r, g, b


def pair_path(a: str, b: str) -> str:
    """The entity of two robots' cameras side by side."""
    return f"pairs/{part(f'{a}+{b}')}"


def class_labels(classes: Sequence[str], attributes: Array) -> list[str]:
    """The most probable class of each detection, and how probable it is; attributes (n, c)."""
    return [f"{classes[int(a.argmax())]} {a.max():.2f}" for a in attributes]


def world_spread(sighting: Sighting) -> Array:
    """Covariance (3, 3) m^2, world frame, of the reported position (right perturbation: it is in the sensor's)."""
    assert sighting.pose is not None
    assert sighting.pose_covariance is not None
    R = sighting.pose[:3, :3]
    return np.asarray(R @ sighting.pose_covariance[:3, :3] @ R.T)


def ellipsoids(positions: Array, covariances: Array, colors: Sequence[Any], labels: list[str] | None) -> Any:
    """Covariances (n, 3, 3) as ellipsoids of CHI standard deviations."""
    rr = rerun()
    values, vectors = np.linalg.eigh(covariances.reshape(-1, 3, 3))
    # A rotation, not a reflection.
    vectors[np.linalg.det(vectors) < 0, :, 0] *= -1
    return rr.Ellipsoids3D(
        centers=positions.reshape(-1, 3),
        half_sizes=CHI * np.sqrt(np.clip(values, 1e-8, MOST_SPREAD_M**2)),
        quaternions=_quaternions(vectors),
        colors=colors,
        labels=labels,
        show_labels=False,
        fill_mode="solid",
    )


def _quaternions(rotations: Array) -> Array:
    """(n, 4) xyzw of rotations (n, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).as_quat()) if len(rotations) else np.zeros((0, 4))


def match_lines(sightings: Sequence[Sighting], result: Result) -> tuple[list[Array], list[Color]]:
    """From one robot's estimate of an object to the partner's: short where the match is right."""
    strips, colors = [], []
    for (i, j), matching in result.matchings.items():
        a, b = sightings[i], sightings[j]
        if a.place is None or b.place is None:
            continue
        ends = np.stack(
            [
                transform(a.place, a.graph.positions[matching.pairs[:, 0]]),
                transform(b.place, b.graph.positions[matching.pairs[:, 1]]),
            ],
            axis=1,
        )
        strips += list(ends)
        colors += [RIGHT if hit else WRONG for hit in result.hits[i, j]]
    return strips, colors


def identities(sightings: Sequence[Sighting], members: NDArray[np.int64]) -> set[int]:
    """True objects that the detections of a group show; `members` (N,) is each robot's detection, -1 = none."""
    return {int(sightings[robot].identity[k]) for robot, k in enumerate(members) if k >= 0}


def agreed_class(classes: Sequence[str], sightings: Sequence[Sighting], members: NDArray[np.int64]) -> str:
    """The class on which a group's robots agree most; `members` as for `identities`."""
    total = sum(sightings[robot].graph.attributes[k] for robot, k in enumerate(members) if k >= 0)
    return classes[int(np.argmax(total))]


def picture(encoded: bytes) -> Any:
    """A PNG or a JPEG as it is."""
    kind = "image/png" if encoded.startswith(b"\x89PNG") else "image/jpeg"
    return rerun().EncodedImage(contents=encoded, media_type=kind)


def side_by_side(left: bytes, right: bytes) -> bytes:
    """Two pictures as one JPEG, GAP_PX apart."""
    from PIL import Image

    pictures = [Image.open(io.BytesIO(data)).convert("RGB") for data in (left, right)]
    width = sum(p.width for p in pictures) + GAP_PX
    canvas = Image.new("RGB", (width, max(p.height for p in pictures)), CANVAS)
    canvas.paste(pictures[0], (0, 0))
    canvas.paste(pictures[1], (pictures[0].width + GAP_PX, 0))
    stream = io.BytesIO()
    canvas.save(stream, "JPEG", quality=88)
    return stream.getvalue()
