"""Stock meshes: STL and OBJ files, and whole URDF robots as pybullet reads them, at a level of detail of choice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from ..worlds.bullet import connect, load_pybullet, silence
from ..worlds.world import Array, Mesh
from . import shapes

STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def load_mesh(path: str | Path, color: ArrayLike = shapes.WHITE) -> Mesh:
    """A binary STL or an OBJ file (its triangles and polygons; no materials) in one colour.

    Raises:
        ValueError: neither of the two, or a damaged file.
    """
    path = Path(path)
    if path.suffix.lower() == ".stl":
        return _stl(path, color)
    if path.suffix.lower() == ".obj":
        return _obj(path, color)
    raise ValueError(f"a mesh must be an .stl or .obj file, got {path}")


def simplify(body: Mesh, detail_m: float) -> Mesh:
    """The mesh with details below `detail_m` merged: one vertex for each cell of a grid, faces without area dropped.

    Raises:
        ValueError: `detail_m` is not positive, or so large that nothing is left.
    """
    if not detail_m > 0:
        raise ValueError(f"detail_m must be positive, got {detail_m}")
    low, _ = shapes.extent(body)
    cells = np.floor((body.vertices - low) / detail_m + 1e-9).astype(np.int64)
    _, cluster, size = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    cluster = cluster.reshape(-1)
    vertices = np.zeros((len(size), 3))
    np.add.at(vertices, cluster, body.vertices)
    vertices /= size[:, None]
    faces = cluster[body.faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    # Faces that became one are drawn once; turned so that their smallest corner comes first, equal ones are equal rows.
    first = np.argmin(faces, axis=1)
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    _, kept = np.unique(turned[whole], axis=0, return_index=True)
    kept = np.flatnonzero(whole)[np.sort(kept)]
    if not len(kept):
        raise ValueError(f"nothing is left of the mesh at detail_m = {detail_m}")
    patterns = None if body.patterns is None else body.patterns[kept]
    return Mesh(vertices, faces[kept].astype(np.int32), body.colors[kept], patterns)


def load_urdf(path: str | Path, detail_m: float | None = None) -> Mesh:
    """All visible parts of a URDF robot in its rest pose as one mesh, base frame; `detail_m` simplifies mesh files.

    `path` may name a file of pybullet_data, such as "husky/husky.urdf".

    Raises:
        ImportError: pybullet is not installed.
        ValueError: pybullet cannot read the file, or it shows nothing.
    """
    p = load_pybullet()
    with silence():
        client = connect()
        try:
            p.setAdditionalSearchPath(_data_path(), physicsClientId=client)
            try:
                body = p.loadURDF(str(path), physicsClientId=client)
            except p.error as error:
                raise ValueError(f"pybullet cannot load {path}: {error}") from error
            parts = []
            for _, link, kind, size, file, position, quaternion, rgba, *_ in p.getVisualShapeData(
                body, physicsClientId=client
            ):
                name = file.decode() if isinstance(file, bytes) else str(file)
                part = _part(kind, size, name, np.round(255 * np.array(rgba[:3])), detail_m)
                parts.append(_placed(part, _link_pose(p, client, body, link) @ _pose(position, quaternion)))
        finally:
            p.disconnect(client)
    if not parts:
        raise ValueError(f"{path} shows nothing")
    return shapes.merge(*parts)


def _stl(path: Path, color: ArrayLike) -> Mesh:
    data = path.read_bytes()
    count = int(np.frombuffer(data[80:84], "<u4")[0]) if len(data) >= 84 else -1
    if len(data) < 84 + 50 * max(count, 0) or count < 1:
        raise ValueError(f"{path} is not a binary STL file")
    corners = np.frombuffer(data, STL_TRIANGLE, count, 84)["corners"].reshape(-1, 3).astype(np.float64)
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    return shapes.mesh(vertices, index.reshape(-1, 3), color)


def _obj(path: Path, color: ArrayLike) -> Mesh:
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for line in path.read_text(errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["v"]:
            vertices.append([float(x) for x in words[1:4]])
        elif words[:1] == ["f"]:
            # Indices start at 1; negative ones count from the end.
            corners = [int(word.split("/")[0]) for word in words[1:]]
            corners = [c - 1 if c > 0 else len(vertices) + c for c in corners]
            faces += [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]
    if not faces:
        raise ValueError(f"{path} has no faces")
    return shapes.mesh(vertices, faces, color)


def _part(kind: int, size: ArrayLike, file: str, color: Array, detail_m: float | None) -> Mesh:
    p = load_pybullet()
    lengths = np.asarray(size, dtype=np.float64)
    if kind == p.GEOM_BOX:
        return shapes.box(lengths, color)
    if kind == p.GEOM_SPHERE:
        return shapes.sphere(float(lengths[0]), color)
    if kind in (p.GEOM_CYLINDER, p.GEOM_CAPSULE):
        return shapes.cylinder(float(lengths[1]), float(lengths[0]), color)
    if kind != p.GEOM_MESH:
        raise ValueError(f"a URDF part of pybullet's kind {kind} cannot be drawn")
    part = shapes.scale(load_mesh(file, color), lengths)
    return part if detail_m is None else simplify(part, detail_m)


def _placed(part: Mesh, T: Array) -> Mesh:
    return Mesh(part.vertices @ T[:3, :3].T + T[:3, 3], part.faces, part.colors, part.patterns)


def _link_pose(p: Any, client: int, body: int, link: int) -> Array:
    """T_base_link (4, 4) in the rest pose, between the URDF's frames; pybullet's base pose is its centre of mass."""
    if link < 0:
        position, quaternion = p.getBasePositionAndOrientation(body, physicsClientId=client)
        dynamics = p.getDynamicsInfo(body, -1, physicsClientId=client)
        return _pose(position, quaternion) @ np.linalg.inv(_pose(dynamics[3], dynamics[4]))
    state = p.getLinkState(body, link, computeForwardKinematics=True, physicsClientId=client)
    return _pose(state[4], state[5])


def _pose(position: ArrayLike, quaternion: ArrayLike) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(np.asarray(quaternion, dtype=np.float64)).as_matrix()
    T[:3, 3] = np.asarray(position, dtype=np.float64)
    return T


def _data_path() -> str:
    import pybullet_data

    return str(pybullet_data.getDataPath())
