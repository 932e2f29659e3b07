"""Our camera against pybullet's TinyRenderer on the same meshes, poses and sample points."""

from __future__ import annotations

import numpy as np
import pytest

from covis.envs.camera import shapes
from covis.envs.camera.raster import Rasterizer, intrinsics_from_fov, look_at
from covis.envs.worlds.world import Light, Snapshot

pytest.importorskip("pybullet_data", reason="pybullet is not installed")
backends = pytest.importorskip("covis.envs.camera.backends")

MESHES = (shapes.husky(), shapes.box((1.2, 0.7, 0.9), center=(0, 0, 0.45)), shapes.sphere(0.45, rings=9, sides=14))
MIN_PIXELS = 400


def scene(seed: int) -> Snapshot:
    """Fifteen bodies around an arena of 12 m, and one camera that sees most of them."""
    rng = np.random.default_rng(seed)
    n = 15
    poses = np.tile(np.eye(4), (n, 1, 1))
    yaw = rng.uniform(-np.pi, np.pi, n)
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(yaw)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    poses[:, 0, 3], poses[:, 1, 3] = rng.uniform(0, 8, n), rng.uniform(-4, 4, n)
    poses[:, 2, 3] = rng.uniform(0.0, 0.5, n)
    eye = (rng.uniform(-4, -2), rng.uniform(-2, 2), rng.uniform(0.8, 3.0))
    return Snapshot(
        time=0.0,
        identity=np.arange(n),
        object_class=np.zeros(n, np.int64),
        positions=np.zeros((n, 3)),
        velocities=np.zeros((n, 3)),
        headings=yaw,
        sizes=np.ones((n, 3)),
        body_mesh=np.arange(n) % len(MESHES),
        body_poses=poses,
        body_tints=np.ones((n, 3)),
        body_object=rng.permutation(n),
        T_world_camera=look_at(eye, (4, 0, 0.3))[None],
        robot_object=np.array([-1]),
        robot_velocity=np.zeros((1, 3)),
        robot_state=np.zeros((1, 1)),
        collided=np.zeros(1, bool),
        light=Light(),
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("centred", [False, True])
def test_masks_and_depths_agree(seed: int, centred: bool) -> None:
    """The bar is IoU 0.97 per object of at least 400 pixels and 0.5 % of depth, with the sample point shifted."""
    snapshot, (width, height) = scene(seed), (320, 240)
    K = intrinsics_from_fov(width, height, np.radians(70))
    offset = (0.5, 0.5) if centred else backends.TINY_SAMPLE_OFFSET
    tiny = backends.BulletCamera(MESHES, width, height, centred=centred)
    theirs = tiny.render(snapshot, 0, K)
    tiny.close()
    tiny.close()
    ours = Rasterizer(MESHES, width, height, sample_offset=offset).render(snapshot, 0, K)
    large = [k for k in range(15) if (theirs.instances == k).sum() >= MIN_PIXELS]
    assert len(large) >= 4
    for k in large:
        a, b = ours.instances == k, theirs.instances == k
        assert (a & b).sum() >= 0.97 * (a | b).sum()
        both = a & b
        assert np.median(np.abs(ours.depth[both] / theirs.depth[both] - 1)) <= 0.005


def test_without_the_shift_the_masks_disagree() -> None:
    """Guards the test above: it would not pass whatever the renderers draw."""
    snapshot, (width, height) = scene(0), (320, 240)
    K = intrinsics_from_fov(width, height, np.radians(70))
    theirs = backends.BulletCamera(MESHES, width, height, centred=False).render(snapshot, 0, K)
    ours = Rasterizer(MESHES, width, height).render(snapshot, 0, K)
    iou = [
        ((ours.instances == k) & (theirs.instances == k)).sum()
        / ((ours.instances == k) | (theirs.instances == k)).sum()
        for k in range(15)
        if (theirs.instances == k).sum() >= MIN_PIXELS
    ]
    assert min(iou) < 0.97


def test_pybullet_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    camera = backends.BulletCamera(MESHES, 32, 24)
    camera.render(scene(0), 0, intrinsics_from_fov(32, 24, 1.2))
    camera.close()
    assert capfd.readouterr() == ("", "")


def test_egl_draws_the_same_and_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    """OpenGL samples pixel centres, as we do."""
    snapshot, (width, height) = scene(1), (320, 240)
    K = intrinsics_from_fov(width, height, np.radians(70))
    try:
        camera = backends.make_camera("egl", MESHES, width, height)
    except RuntimeError as error:
        pytest.skip(str(error))
    with pytest.raises(RuntimeError, match="one EGL camera"):
        backends.make_camera("egl", MESHES, width, height)
    theirs = camera.render(snapshot, 0, K)
    camera.close()
    ours = backends.make_camera("raster", MESHES, width, height).render(snapshot, 0, K)
    large = [k for k in range(15) if (theirs.instances == k).sum() >= MIN_PIXELS]
    assert len(large) >= 4
    for k in large:
        a, b = ours.instances == k, theirs.instances == k
        assert (a & b).sum() >= 0.97 * (a | b).sum()
        assert np.median(np.abs(ours.depth[a & b] / theirs.depth[a & b] - 1)) <= 0.005
    assert capfd.readouterr() == ("", "")


def test_the_own_body_is_hidden_and_tints_and_moves_follow() -> None:
    snapshot = scene(2)
    K = intrinsics_from_fov(160, 120, np.radians(70))
    camera = backends.make_camera("tiny", MESHES, 160, 120)
    before = camera.render(snapshot, 0, K)
    counts = np.bincount(before.instances[before.instances >= 0], minlength=15)
    seen = int(counts.argmax())
    snapshot.robot_object[0] = seen
    assert not (camera.render(snapshot, 0, K).instances == seen).any()
    snapshot.robot_object[0] = -1
    snapshot.body_tints[:] = (1.0, 0.0, 0.0)
    red = camera.render(snapshot, 0, K)
    assert (red.rgb[red.instances == seen][:, 1] < before.rgb[before.instances == seen][:, 1].mean()).all()
    np.testing.assert_array_equal(red.instances, before.instances)


def test_an_unknown_backend_is_named() -> None:
    with pytest.raises(ValueError, match="'vulkan'"):
        backends.make_camera("vulkan", MESHES, 4, 4)
