"""The rasteriser against a brute-force ray caster, and its promises: clipping, occlusion, ground, own body, arrays."""

from __future__ import annotations

import numpy as np
import pytest

from covis.envs.camera import shapes
from covis.envs.camera.frame import Frame
from covis.envs.camera.raster import Rasterizer, intrinsics_from_fov, look_at
from covis.envs.worlds.world import Light, Mesh, Snapshot

FOV = np.radians(70)


def pose(x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, z
    return T


def snapshot(
    bodies: list[tuple[int, np.ndarray]], cameras: list[np.ndarray], *, objects=None, robot_object=None
) -> Snapshot:  # type: ignore[no-untyped-def]
    """Bodies (mesh, pose), each an object of its own unless `objects` says otherwise."""
    b, n = len(bodies), len(cameras)
    objects = np.arange(b) if objects is None else np.asarray(objects)
    m = int(objects.max(initial=-1)) + 1
    return Snapshot(
        time=0.0,
        identity=np.arange(m),
        object_class=np.zeros(m, np.int64),
        positions=np.zeros((m, 3)),
        velocities=np.zeros((m, 3)),
        headings=np.zeros(m),
        sizes=np.ones((m, 3)),
        body_mesh=np.array([mesh for mesh, _ in bodies], np.int64),
        body_poses=np.array([T for _, T in bodies]).reshape(b, 4, 4),
        body_tints=np.ones((b, 3)),
        body_object=objects,
        T_world_camera=np.array(cameras),
        robot_object=np.full(n, -1) if robot_object is None else np.asarray(robot_object),
        robot_velocity=np.zeros((n, 3)),
        robot_state=np.zeros((n, 1)),
        collided=np.zeros(n, bool),
        light=Light(),
    )


def cast(meshes: list[Mesh], scene: Snapshot, T: np.ndarray, K: np.ndarray, width: int, height: int):  # type: ignore[no-untyped-def]
    """Depth (H, W) and object (H, W) by intersecting every pixel's ray with every triangle and the ground."""
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1) @ T[:3, :3].T
    eye = T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
        objects = np.full(depth.shape, -1)
        for mesh, T_wb, number in zip(scene.body_mesh, scene.body_poses, scene.body_object, strict=True):
            corners = (meshes[mesh].vertices @ T_wb[:3, :3].T + T_wb[:3, 3])[meshes[mesh].faces]
            for a, b, c in corners:
                normal = np.cross(b - a, c - a)
                z = normal @ (a - eye) / (rays @ normal)
                hit = eye + z[..., None] * rays
                inside = (rays @ normal < 0) & (z > 0.05) & (z < depth)
                for p, q in ((a, b), (b, c), (c, a)):
                    inside &= np.cross(q - p, hit - p) @ normal >= 0
                depth[inside], objects[inside] = z[inside], number
    return depth, objects


def clutter(rng: np.random.Generator) -> tuple[list[Mesh], Snapshot]:
    meshes = [shapes.box((1, 0.6, 0.5)), shapes.sphere(0.4), shapes.cone(0.3, 1.0), shapes.husky(sides=6)]
    bodies = []
    for i in range(9):
        T = pose(rng.uniform(1, 6), rng.uniform(-2, 2), rng.uniform(-0.1, 0.6), rng.uniform(-3, 3))
        bodies.append((i % 4, T))
    return meshes, snapshot(bodies, [look_at((-1, 0, 1.2), (4, 0, 0.3))])


@pytest.mark.parametrize("seed", range(3))
def test_depth_and_ids_equal_a_ray_caster(seed: int) -> None:
    width, height = 72, 54
    meshes, scene = clutter(np.random.default_rng(seed))
    K = intrinsics_from_fov(width, height, FOV)
    frame = Rasterizer(meshes, width, height).render(scene, 0, K)
    depth, objects = cast(meshes, scene, scene.T_world_camera[0], K, width, height)
    assert (frame.instances == objects).mean() > 0.999
    same = (frame.instances == objects) & np.isfinite(depth)
    np.testing.assert_allclose(frame.depth[same], depth[same], rtol=2e-4)
    assert (np.isinf(frame.depth) == np.isinf(depth)).mean() > 0.999
    assert len(np.unique(objects)) >= 6


def test_rolled_camera_sees_the_same_as_a_ray_caster() -> None:
    width, height = 64, 48
    meshes, scene = clutter(np.random.default_rng(7))
    T = look_at((-1, 0.5, 1.5), (4, 0, 0.5), (0.0, 0.8, 0.6))
    K = intrinsics_from_fov(width, height, FOV)
    frame = Rasterizer(meshes, width, height).render_view(scene, T, K)
    depth, objects = cast(meshes, scene, T, K, width, height)
    assert (frame.instances == objects).mean() > 0.998
    assert np.isinf(depth).any()
    assert (np.isinf(frame.depth) == np.isinf(depth)).mean() > 0.998


def test_triangles_that_cross_the_near_plane_are_clipped_not_dropped() -> None:
    # One long thin wedge of a floor that begins behind the camera and passes below it.
    strip = shapes.mesh([[-5, -1, 0.5], [10, -1, 0.5], [10, 1, 0.5], [-5, 1, 0.5]], [[0, 1, 2], [0, 2, 3]])
    T = look_at((0, 0, 1.0), (5, 0, 1.0))
    K = intrinsics_from_fov(64, 48, FOV)
    scene = snapshot([(0, np.eye(4))], [T])
    frame = Rasterizer([strip], 64, 48).render(scene, 0, K)
    depth, objects = cast([strip], scene, T, K, 64, 48)
    assert (objects[-1] == 0).any()
    np.testing.assert_array_equal(frame.instances, objects)
    np.testing.assert_allclose(frame.depth[objects == 0], depth[objects == 0], rtol=1e-5)


def test_a_camera_inside_a_room_sees_walls_everywhere() -> None:
    room = shapes.box((6, 6, 4))
    inside_out = Mesh(room.vertices, room.faces[:, ::-1].copy(), room.colors)
    scene = snapshot([(0, pose(0, 0, 3))], [look_at((1, 0.5, 3.2), (2, 2, 2.4))])
    K = intrinsics_from_fov(80, 60, np.radians(120))
    frame = Rasterizer([inside_out], 80, 60).render(scene, 0, K)
    assert (frame.instances == 0).all()
    depth, _ = cast([inside_out], scene, scene.T_world_camera[0], K, 80, 60)
    np.testing.assert_allclose(frame.depth, depth, rtol=1e-5)
    outside = Rasterizer([room], 80, 60).render(scene, 0, K)
    assert (outside.instances == -1).all(), "faces seen from behind are not drawn"


def test_nearer_hides_farther_in_any_drawing_order() -> None:
    boxes = [shapes.box((1, 1, 1)), shapes.box((1, 3, 3))]
    far, near = (1, pose(8, 0, 1)), (0, pose(4, 0, 1))
    K = intrinsics_from_fov(60, 60, FOV)
    camera = look_at((0, 0, 1), (1, 0, 1))
    one = Rasterizer(boxes, 60, 60).render(snapshot([near, far], [camera]), 0, K)
    two = Rasterizer(boxes, 60, 60).render(snapshot([far, near], [camera]), 0, K)
    assert one.instances[30, 30] == 0
    assert two.instances[30, 30] == 1
    np.testing.assert_array_equal(one.depth, two.depth)
    assert {0, 1} <= set(one.instances.ravel().tolist())


def test_ground_depth_is_that_of_the_plane() -> None:
    height_m, width, height = 1.7, 100, 80
    T = look_at((3, -2, height_m), (10, 4, 0))
    K = intrinsics_from_fov(width, height, FOV)
    frame = Rasterizer([], width, height).render(snapshot([], [T]), 0, K)
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    rise = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1) @ T[2, :3]
    expected = np.where(rise < 0, -height_m / np.where(rise < 0, rise, 1), np.inf)
    np.testing.assert_allclose(frame.depth, expected, rtol=1e-4)
    assert (frame.instances == -1).all()
    assert frame.rgb.std(axis=(0, 1)).min() > 2, "ground and sky are not flat"


def test_bodies_below_the_ground_are_hidden_by_it() -> None:
    scene = snapshot([(0, pose(4, 0, -0.6))], [look_at((0, 0, 1), (4, 0, 0))])
    frame = Rasterizer([shapes.box((1, 1, 1))], 40, 30).render(scene, 0, intrinsics_from_fov(40, 30, FOV))
    assert (frame.instances == -1).all()


def test_a_closed_surface_has_no_holes_and_no_pixel_twice() -> None:
    # Many small triangles on a big sphere: a gap at a shared edge would show the sky behind it.
    ball = shapes.sphere(3.0, rings=40, sides=80)
    scene = snapshot([(0, pose(6, 0, 4))], [look_at((0, 0, 4), (6, 0, 4))])
    frame = Rasterizer([ball], 200, 200).render(scene, 0, intrinsics_from_fov(200, 200, np.radians(70)))
    mask = frame.instances == 0
    _, u = np.nonzero(mask)
    disc = np.hypot(np.arange(200)[:, None] - 99.5, np.arange(200)[None] - 99.5) < 0.5 * (u.max() - u.min()) - 3
    assert disc.sum() > 5000
    assert mask[disc].all()


def test_the_own_body_is_hidden_from_its_own_camera_only() -> None:
    bodies = [(0, pose(2, 0)), (0, pose(4, 1))]
    cameras = [look_at((0, 0, 1), (4, 0, 0)), look_at((0, 0, 1), (4, 0, 0))]
    scene = snapshot([*bodies, (0, pose(3, -1))], cameras, objects=[0, 1, 0], robot_object=[0, -1])
    K = intrinsics_from_fov(80, 60, FOV)
    camera = Rasterizer([shapes.box((0.5, 0.5, 0.5))], 80, 60)
    assert set(np.unique(camera.render(scene, 0, K).instances)) == {-1, 1}
    assert set(np.unique(camera.render(scene, 1, K).instances)) == {-1, 0, 1}
    mounted = Rasterizer([shapes.box((0.5, 0.5, 0.5))], 80, 60, own_body=True)
    assert set(np.unique(mounted.render(scene, 0, K).instances)) == {-1, 0, 1}


def test_scenery_hides_objects_and_has_no_id() -> None:
    scene = snapshot([(0, pose(4, 0)), (0, pose(2, 0))], [look_at((0, 0, 0.5), (4, 0, 0.5))], objects=[0, -1])
    frame = Rasterizer([shapes.box((0.5, 0.5, 2))], 60, 60).render(scene, 0, intrinsics_from_fov(60, 60, FOV))
    assert (frame.instances == -1).all()


def test_the_same_snapshot_gives_the_same_bits_and_fresh_arrays() -> None:
    meshes, scene = clutter(np.random.default_rng(3))
    K = intrinsics_from_fov(160, 120, FOV)
    camera = Rasterizer(meshes, 160, 120)
    first = camera.render(scene, 0, K)
    kept = first.copy()
    camera.render_view(scene, look_at((8, 0, 3), (0, 0, 0)), K)
    second = camera.render(scene, 0, K)
    other = Rasterizer(meshes, 160, 120).render(scene, 0, K)
    for name in ("rgb", "depth", "instances"):
        np.testing.assert_array_equal(getattr(first, name), getattr(kept, name))
        np.testing.assert_array_equal(getattr(second, name), getattr(kept, name))
        np.testing.assert_array_equal(getattr(other, name), getattr(kept, name))
        assert not np.shares_memory(getattr(first, name), getattr(second, name))


def test_out_is_filled_and_returned() -> None:
    meshes, scene = clutter(np.random.default_rng(4))
    K = intrinsics_from_fov(60, 40, FOV)
    camera = Rasterizer(meshes, 60, 40)
    out = Frame.empty(60, 40)
    assert camera.render(scene, 0, K, out=out) is out
    np.testing.assert_array_equal(out.rgb, camera.render(scene, 0, K).rgb)


def test_faces_towards_the_sun_are_brighter_and_tints_colour() -> None:
    camera = look_at((0, 0, 3), (4, 0, 0.5))
    scene = snapshot([(0, pose(4, 0, 0.5))], [camera])
    K = intrinsics_from_fov(80, 60, np.radians(40))
    frame = Rasterizer([shapes.box((1, 1, 1), (200, 200, 200))], 80, 60).render(scene, 0, K)
    faces = frame.rgb[frame.instances == 0]
    assert faces.max() > 1.4 * faces.min()
    scene.body_tints[:] = (1.0, 0.2, 0.1)
    red = Rasterizer([shapes.box((1, 1, 1), (200, 200, 200))], 80, 60).render(scene, 0, K)
    assert (red.rgb[red.instances == 0, 0] > 2 * red.rgb[red.instances == 0, 2]).all()


def test_many_bodies_outgrow_the_first_table() -> None:
    mesh = shapes.sphere(0.1, rings=8, sides=12)
    bodies = [(0, pose(2 + 0.3 * i, 0.3 * (j - 4), 0.1)) for i in range(9) for j in range(9)]
    scene = snapshot(bodies, [look_at((0, 0, 2), (3, 0, 0))])
    frame = Rasterizer([mesh], 160, 120).render(scene, 0, intrinsics_from_fov(160, 120, FOV))
    assert len(np.unique(frame.instances)) > 60


def test_looking_straight_down_shows_the_map() -> None:
    T = look_at((0, 0, 10), (0, 0, 0), (1, 0, 0))
    scene = snapshot([(0, pose(2, 0)), (0, pose(0, 3))], [T])
    frame = Rasterizer([shapes.box((0.5, 0.5, 0.5))], 100, 100).render(scene, 0, intrinsics_from_fov(100, 100, 1.2))
    rows, columns = np.nonzero(frame.instances == 0)
    assert rows.mean() < 40
    assert abs(columns.mean() - 49.5) < 1
    rows, columns = np.nonzero(frame.instances == 1)
    assert columns.mean() < 40, "world y is to the left when x is up"


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda c, s, K: c.render(s, 5, K), "robot must be in 0..0, got 5"),
        (lambda c, s, K: c.render(s, 0, np.zeros((3, 3))), "intrinsics"),
        (lambda c, s, K: c.render(s, 0, K, out=Frame.empty(3, 3)), "out.rgb"),
        (lambda c, s, K: c.render_view(s, np.eye(3), K), "T_world_camera"),
        (lambda c, s, K: c.render_view(s, np.full((4, 4), np.nan), K), "finite"),
        (lambda c, s, K: Rasterizer([], 10, 10).render(s, 0, K), "mesh"),
        (lambda c, s, K: Rasterizer([], 0, 10), "0x10"),
        (lambda c, s, K: Rasterizer([], 10, 10, near_m=0.0), "near_m"),
        (lambda c, s, K: intrinsics_from_fov(10, 10, 4.0), "4.0"),
        (lambda c, s, K: look_at((0, 0, 0), (0, 0, 1)), "up"),
    ],
)
def test_bad_input_says_what_is_wrong(act, message: str) -> None:  # type: ignore[no-untyped-def]
    scene = snapshot([(0, pose(4, 0))], [look_at((0, 0, 1), (4, 0, 0))])
    camera = Rasterizer([shapes.box((1, 1, 1))], 20, 10)
    with pytest.raises(ValueError, match=message):
        act(camera, scene, intrinsics_from_fov(20, 10, FOV))
