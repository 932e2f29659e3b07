"""Low-poly meshes are closed, face outwards and have the size they were asked for."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from covis.envs.camera import shapes

SQUARE = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
SHAPES = {
    "box": (shapes.box((1, 2, 3)), 6.0),
    "prism": (shapes.prism(SQUARE, 0.5), 2.0),
    "roof": (shapes.prism(SQUARE, 3.0, top_scale=0.5), 7.0),
    "profile": (shapes.side_profile(SQUARE, 2.0), 8.0),
    "cylinder": (shapes.cylinder(1.0, 2.0, sides=64), 2 * np.pi),
    "lying cylinder": (shapes.cylinder(1.0, 2.0, sides=64, axis="x"), 2 * np.pi),
    "cone": (shapes.cone(1.0, 3.0, sides=64), np.pi),
    "sphere": (shapes.sphere(1.0, rings=48, sides=64), 4 / 3 * np.pi),
    "ellipsoid": (shapes.sphere((1.0, 2.0, 0.5), rings=48, sides=64), 4 / 3 * np.pi),
}


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_closed_and_face_outwards(name: str) -> None:
    body, expected = SHAPES[name]
    edges = Counter((int(f[k]), int(f[(k + 1) % 3])) for f in body.faces for k in range(3))
    assert all(edges[(b, a)] == n == 1 for (a, b), n in edges.items())
    assert shapes.volume(body) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("name", list(SHAPES))
def test_normals_point_away_from_the_inside(name: str) -> None:
    body, _ = SHAPES[name]
    outward = body.vertices[body.faces].mean(1) - body.vertices.mean(0)
    assert (np.einsum("ij,ij->i", outward, shapes.normals(body)) > 0).all()


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_cylinders_lie_along_their_axis(axis: str) -> None:
    low, high = shapes.extent(shapes.cylinder(0.1, 2.0, axis=axis, center=(1, 2, 3)))
    np.testing.assert_allclose((low + high) / 2, (1, 2, 3), atol=1e-9)
    assert int(np.argmax(high - low)) == "xyz".index(axis)


def test_husky_stands_on_the_ground_and_has_its_size() -> None:
    low, high = shapes.extent(shapes.husky())
    np.testing.assert_allclose(low[2], 0.0, atol=2e-3)
    np.testing.assert_allclose((high - low)[:2], (0.97, 0.68), atol=0.03)
    assert len(shapes.husky().faces) < 500


@pytest.mark.parametrize("sides", [8, 12, 30])
def test_corner_normals_of_a_cylinder_point_away_from_its_axis(sides: int) -> None:
    body = shapes.cylinder(1.0, 2.0, sides=sides)
    corners, flat = shapes.corner_normals(body), shapes.normals(body)
    side = np.abs(flat[:, 2]) < 0.5
    radial = body.vertices[body.faces[side]] * (1, 1, 0)
    np.testing.assert_allclose(corners[side], radial, atol=1e-9)
    np.testing.assert_allclose(corners[~side], np.repeat(flat[~side][:, None], 3, axis=1), atol=1e-12)
    sharp = shapes.corner_normals(shapes.cylinder(1.0, 2.0, sides=6))
    np.testing.assert_allclose(sharp, np.repeat(shapes.normals(shapes.cylinder(1.0, 2.0, sides=6))[:, None], 3, axis=1))


def test_move_scale_paint_and_merge() -> None:
    body = shapes.translate(shapes.scale(shapes.box((1, 1, 1)), (2, 1, 1)), (0, 0, 5))
    turned = shapes.rotate(body, (0, 0, 2), np.pi / 2)
    np.testing.assert_allclose(shapes.extent(turned), [(-0.5, -1, 4.5), (0.5, 1, 5.5)], atol=1e-12)
    top = shapes.paint(turned, (1, 2, 3), lambda centres, normals: normals[:, 2] > 0.9)
    assert (top.colors == (1, 2, 3)).all(1).sum() == 2
    both = shapes.merge(top, shapes.cone(1, 1, (9, 9, 9)))
    assert shapes.volume(both) == pytest.approx(shapes.volume(top) + shapes.volume(shapes.cone(1, 1)))
    assert len(both.colors) == len(both.faces)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: shapes.box((1, -1, 1)), "size"),
        (lambda: shapes.prism(SQUARE[::-1], 1.0), "counter-clockwise"),
        (lambda: shapes.cylinder(1, 1, axis="w"), "axis"),
        (lambda: shapes.box((1, 1, 1), (0, 0, 256)), "color"),
        (lambda: shapes.mesh([[0, 0, 0]], [[0, 0, 1]]), "vertex"),
        (lambda: shapes.merge(), "at least one"),
        (lambda: shapes.sphere(1, rings=1), "rings"),
    ],
)
def test_bad_shapes_say_what_is_wrong(build, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        build()
