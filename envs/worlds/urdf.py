"""Meshes from URDF files, at any level of detail: the stock robots that pybullet ships."""

from __future__ import annotations

import os
from xml.etree import ElementTree

import numpy as np

from ..camera import shapes
from ..camera.shapes import Color
from ..camera.stock import load_mesh
from .world import Array, Mesh

GREY: Color = (160, 160, 160)


def urdf_mesh(path: str, *, detail_m: float = 0.0, colors: dict[str, Color] | None = None) -> Mesh:
    """All visual STL meshes of a robot with its joints at zero, in the frame of its root link.

    Args:
        path: of the URDF file; mesh files are found relative to it.
        detail_m: vertices within a cube of this edge become one; 0 keeps every triangle.
        colors: of materials by name, instead of the file's own.

    Raises:
        ValueError: a negative `detail_m`, no STL mesh in the file, a file that is not a binary STL.
    """
    if not detail_m >= 0:
        raise ValueError(f"detail_m must be at least 0, got {detail_m}")
    root = ElementTree.parse(path).getroot()
    poses = _link_poses(root)
    palette = _palette(root) | (colors or {})
    parts = []
    for link in root.iter("link"):
        for visual in link.iter("visual"):
            source = visual.find("geometry/mesh")
            if source is None or not source.attrib["filename"].lower().endswith(".stl"):
                continue
            material = visual.find("material")
            color = palette.get(material.attrib["name"], GREY) if material is not None else GREY
            part = load_mesh(os.path.join(os.path.dirname(path), source.attrib["filename"]), color)
            T = poses[link.attrib["name"]] @ _origin(visual.find("origin"))
            parts.append(Mesh(part.vertices @ T[:3, :3].T + T[:3, 3], part.faces, part.colors))
    if not parts:
        raise ValueError(f"{path} has no visual STL mesh")
    return shapes.merge(*(simplified(part, detail_m) for part in parts))


def simplified(body: Mesh, detail_m: float) -> Mesh:
    """The mesh with all vertices in a cube of edge `detail_m` drawn together to their mean, without collapsed faces.

    Unlike those of `camera.stock.simplify` the cubes lie on the grid of the body frame, whatever the mesh; pictures of
    stock robots in v0 depend on it.
    """
    if detail_m <= 0:
        return body
    cells = np.floor(body.vertices / detail_m).astype(np.int64)
    _, index = np.unique(cells, axis=0, return_inverse=True)
    index = index.ravel()
    n = int(index.max()) + 1
    weight = np.bincount(index, minlength=n)[:, None]
    vertices = np.stack([np.bincount(index, body.vertices[:, k], minlength=n) for k in range(3)], 1) / weight
    faces = index[body.faces]
    a, b, c = faces.T
    kept = (a != b) & (b != c) & (a != c)
    first = np.argmin(faces, axis=1)[:, None]  # two faces on the same corners in the same order are one
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    _, unique = np.unique(turned[kept], axis=0, return_index=True)
    chosen = np.flatnonzero(kept)[np.sort(unique)]
    return Mesh(vertices, faces[chosen].astype(np.int32), body.colors[chosen])


def _link_poses(root: ElementTree.Element) -> dict[str, Array]:
    """T_root_link (4, 4) of every link."""
    joints = {child.attrib["link"]: j for j in root.iter("joint") if (child := j.find("child")) is not None}
    poses: dict[str, Array] = {}

    def pose(link: str) -> Array:
        if link not in poses:
            joint = joints.get(link)
            if joint is None:
                poses[link] = np.eye(4)
            else:
                parent = joint.find("parent")
                assert parent is not None
                poses[link] = pose(parent.attrib["link"]) @ _origin(joint.find("origin"))
        return poses[link]

    used = [link.attrib["name"] for link in root.iter("link") if link.find("visual") is not None]
    return {name: pose(name) for name in used}


def _origin(element: ElementTree.Element | None) -> Array:
    """The pose (4, 4) of an <origin>: xyz in m, rpy in rad about fixed axes."""
    T = np.eye(4)
    if element is None:
        return T
    roll, pitch, yaw = (float(v) for v in element.attrib.get("rpy", "0 0 0").split())
    for axis, angle in ((2, yaw), (1, pitch), (0, roll)):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        R = np.eye(3)
        R[i, i] = R[j, j] = np.cos(angle)
        R[j, i], R[i, j] = np.sin(angle), -np.sin(angle)
        T[:3, :3] = T[:3, :3] @ R
    T[:3, 3] = [float(v) for v in element.attrib.get("xyz", "0 0 0").split()]
    return T


def _palette(root: ElementTree.Element) -> dict[str, Color]:
    """RGB of each named material."""
    out: dict[str, Color] = {}
    for material in root.iter("material"):
        rgba = material.find("color")
        if rgba is not None:
            r, g, b = (round(255 * float(v)) for v in rgba.attrib["rgba"].split()[:3])
            out[material.attrib["name"]] = (r, g, b)
    return out
