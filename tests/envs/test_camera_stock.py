"""Stock meshes: files, URDF robots, levels of detail."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from covis.envs.camera import shapes, stock
from covis.envs.worlds.world import Mesh


def write_stl(path: Path, body: Mesh) -> None:
    triangles = np.zeros(len(body.faces), stock.STL_TRIANGLE)
    triangles["corners"] = body.vertices[body.faces]
    path.write_bytes(bytes(80) + np.uint32(len(triangles)).tobytes() + triangles.tobytes())


def test_stl_round_trip(tmp_path: Path) -> None:
    body = shapes.sphere(0.5, rings=9, sides=14)
    write_stl(tmp_path / "ball.stl", body)
    loaded = stock.load_mesh(tmp_path / "ball.stl", (10, 20, 30))
    assert len(loaded.faces) == len(body.faces)
    assert len(loaded.vertices) == len(body.vertices)
    assert shapes.volume(loaded) == pytest.approx(shapes.volume(body), rel=1e-5)
    assert (loaded.colors == (10, 20, 30)).all()


def test_obj_with_quads_normals_and_negative_indices(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1 4//1\nv 0 0 1\nf -1 1 2\n"
    )
    body = stock.load_mesh(tmp_path / "a.obj")
    assert body.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 0, 1]]


@pytest.mark.parametrize("detail", [0.1, 0.2, 0.4])
def test_simplify_keeps_the_shape_with_fewer_faces(detail: float) -> None:
    body = shapes.sphere(1.0, rings=40, sides=60)
    coarse = stock.simplify(body, detail)
    assert len(coarse.faces) < 0.8 * len(body.faces)
    np.testing.assert_allclose(shapes.extent(coarse), shapes.extent(body), atol=detail)
    assert shapes.volume(coarse) == pytest.approx(shapes.volume(body), rel=detail)


def test_less_detail_means_fewer_faces() -> None:
    body = shapes.sphere(1.0, rings=40, sides=60)
    counts = [len(stock.simplify(body, d).faces) for d in (0.05, 0.1, 0.2, 0.4)]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] < 0.1 * counts[0]


def test_the_stock_husky_loads_quietly_in_its_size(capfd: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pybullet_data", reason="pybullet is not installed")
    full = stock.load_urdf("husky/husky.urdf")
    low, high = shapes.extent(full)
    np.testing.assert_allclose(high - low, (0.99, 0.68, 0.41), atol=0.04)
    assert low[2] == pytest.approx(0.0, abs=0.02)
    coarse = stock.load_urdf("husky/husky.urdf", detail_m=0.05)
    assert len(coarse.faces) < 0.1 * len(full.faces)
    np.testing.assert_allclose(shapes.extent(coarse), (low, high), atol=0.05)
    assert len(np.unique(full.colors, axis=0)) > 1
    assert capfd.readouterr() == ("", "")


def test_bad_files_say_what_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "short.stl").write_bytes(b"solid")
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    for name, message in (("short.stl", "binary STL"), ("empty.obj", "no faces"), ("a.dae", r"\.stl or \.obj")):
        with pytest.raises(ValueError, match=message):
            stock.load_mesh(tmp_path / name)
    with pytest.raises(ValueError, match="detail_m"):
        stock.simplify(shapes.box((1, 1, 1)), 0.0)
    with pytest.raises(ValueError, match="nothing is left"):
        stock.simplify(shapes.box((1, 1, 1)), 5.0)


def test_a_missing_urdf_is_named() -> None:
    pytest.importorskip("pybullet_data", reason="pybullet is not installed")
    with pytest.raises(ValueError, match=r"nowhere\.urdf"):
        stock.load_urdf("nowhere.urdf")
