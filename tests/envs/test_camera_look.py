"""Looks change colours and nothing else: patterns, smooth shading, shadows, contact, clouds, anti-aliasing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from covis.envs.camera import shapes
from covis.envs.camera.frame import Frame
from covis.envs.camera.raster import PLAIN, Look, Rasterizer, intrinsics_from_fov, look_at
from covis.envs.worlds.world import Light, Mesh, Snapshot

K = intrinsics_from_fov(160, 120, np.radians(70))
CAMERA = look_at((-3, 0, 2.0), (3, 0, 0.4))


def snapshot(bodies: list[tuple[int, tuple[float, float, float]]], light: Light | None = None) -> Snapshot:
    """Bodies (mesh, position), each its own object."""
    b = len(bodies)
    poses = np.tile(np.eye(4), (b, 1, 1))
    poses[:, :3, 3] = np.array([position for _, position in bodies]).reshape(b, 3)
    return Snapshot(
        time=0.0,
        identity=np.arange(b),
        object_class=np.zeros(b, np.int64),
        positions=np.zeros((b, 3)),
        velocities=np.zeros((b, 3)),
        headings=np.zeros(b),
        sizes=np.ones((b, 3)),
        body_mesh=np.array([mesh for mesh, _ in bodies], np.int64),
        body_poses=poses,
        body_tints=np.ones((b, 3)),
        body_object=np.arange(b),
        T_world_camera=CAMERA[None],
        robot_object=np.array([-1]),
        robot_velocity=np.zeros((1, 3)),
        robot_state=np.zeros((1, 1)),
        collided=np.zeros(1, bool),
        light=light or Light(),
    )


def draw(meshes: list[Mesh], scene: Snapshot, look: Look) -> Frame:
    return Rasterizer(meshes, 160, 120, look=look).render(scene, 0, K)


def furnished() -> tuple[list[Mesh], Snapshot]:
    meshes = [shapes.texture(shapes.box((0.8, 0.8, 0.8), center=(0, 0, 0.4)), name) for name in shapes.PATTERNS]
    meshes += [shapes.sphere(0.5, center=(0, 0, 0.5)), shapes.husky()]
    bodies = [(i, (0.5 + 1.3 * (i // 4), 1.2 * (i % 4) - 1.8, 0.0)) for i in range(len(meshes))]
    return meshes, snapshot(bodies)


@pytest.mark.parametrize(
    "change",
    [{"smooth": True}, {"patterns": True}, {"shadows": True}, {"contact": 0.8}, {"clouds": 0.8}, {"samples": 2}],
)
def test_each_part_of_a_look_changes_colours_and_no_labels(change: dict[str, object]) -> None:
    meshes, scene = furnished()
    scene.T_world_camera[0] = look_at((-3, 0, 1.6), (3, 0, 1.2))
    plain, rich = draw(meshes, scene, PLAIN), draw(meshes, scene, replace(PLAIN, **change))
    np.testing.assert_array_equal(plain.depth, rich.depth)
    np.testing.assert_array_equal(plain.instances, rich.instances)
    assert (plain.rgb != rich.rgb).any(-1).sum() > 100


@pytest.mark.parametrize("pattern", [p for p in shapes.PATTERNS if p != "plain"])
def test_every_pattern_is_visible_near_by(pattern: str) -> None:
    wall = shapes.box((0.2, 6.0, 6.0), (180, 180, 180), (0, 0, 3.0))
    scene = snapshot([(0, (1.0, 0, 0))])
    flat = draw([wall], scene, Look())
    patterned = draw([shapes.texture(wall, pattern)], scene, Look())
    mask = flat.instances == 0
    spread = [f.rgb[mask].std(0).max() for f in (flat, patterned)]
    assert spread[1] > spread[0] + 2.0


def test_textures_survive_moving_and_merging() -> None:
    brick = shapes.texture(shapes.box((1, 1, 1)), "bricks", lambda centres, normals: normals[:, 2] > 0.5)
    moved = shapes.scale(shapes.rotate(shapes.translate(brick, (1, 2, 3)), (0, 0, 1), 0.3), 2.0)
    both = shapes.merge(shapes.cone(1, 1), shapes.paint(moved, (1, 2, 3)))
    assert both.patterns is not None
    assert (both.patterns == shapes.PATTERNS.index("bricks")).sum() == 2
    assert shapes.merge(shapes.cone(1, 1)).patterns is None
    with pytest.raises(ValueError, match="tartan"):
        shapes.texture(brick, "tartan")


def test_a_shadow_lies_where_the_sun_throws_it() -> None:
    """A plate 2 m up, sun at 45 degrees from -y: its shadow lies 2 m towards +y, and nowhere else."""
    plate = shapes.box((1.0, 1.0, 0.1))
    light = Light(sun_direction=(0.0, -1.0, 1.0), ambient=0.3)
    scene = snapshot([(0, (0.0, 0.0, 2.0))], light)
    camera = Rasterizer([plate], 160, 120, look=replace(PLAIN, shadows=True))
    down = look_at((0, 1.0, 9.0), (0, 1.0, 0.0), (1.0, 0.0, 0.0))
    bare = Rasterizer([plate], 160, 120, look=PLAIN).render_view(scene, down, K)
    shaded = camera.render_view(scene, down, K)
    darker = shaded.rgb[..., 1].astype(float) < 0.7 * bare.rgb[..., 1]
    rows, columns = np.nonzero(darker)
    x = -(rows + 0.5 - K[1, 2]) / K[1, 1] * 9.0
    y = 1.0 - (columns + 0.5 - K[0, 2]) / K[0, 0] * 9.0
    assert abs(x.mean()) < 0.1
    assert y.mean() == pytest.approx(2.0, abs=0.1)
    assert np.ptp(x) == pytest.approx(1.0, abs=0.25)
    assert np.ptp(y) == pytest.approx(1.1, abs=0.25)


def test_flat_bodies_on_the_ground_receive_shadows_and_cast_none() -> None:
    road = shapes.mesh(
        [[-9, -9, 0.02], [9, -9, 0.02], [9, 9, 0.02], [-9, 9, 0.02]], [[0, 1, 2], [0, 2, 3]], (90, 90, 90)
    )
    box = shapes.box((0.8, 0.8, 1.0), center=(0, 0, 0.5))
    light = Light(sun_direction=(0.3, -0.8, 0.6), ambient=0.3)
    look = replace(PLAIN, shadows=True)
    empty = draw([road, box], snapshot([(0, (0, 0, 0))], light), look)
    full = draw([road, box], snapshot([(0, (0, 0, 0)), (1, (2, 0, 0))], light), look)
    ground = (full.instances == 0) & (empty.instances == 0)
    darker = ground & (full.rgb[..., 0] < 0.7 * empty.rgb[..., 0])
    assert darker.sum() > 50
    assert (empty.rgb[empty.instances == 0].std(0) < 15).all()


def test_contact_darkens_the_ground_about_feet_only() -> None:
    box = shapes.box((0.8, 0.8, 0.8), center=(0, 0, 0.4))
    near, far = snapshot([(0, (2, 0, 0))]), snapshot([(0, (2, 0, 1.0))])
    look = replace(PLAIN, contact=0.8)
    on, off = draw([box], near, look), draw([box], near, PLAIN)
    changed = (on.rgb != off.rgb).any(-1)
    assert changed.sum() > 20
    assert (on.instances[changed] == -1).all()
    np.testing.assert_array_equal(draw([box], far, look).rgb, draw([box], far, PLAIN).rgb)


def test_the_buffers_are_clean_after_every_frame() -> None:
    meshes, scene = furnished()
    camera = Rasterizer(meshes, 160, 120)
    first = camera.render(scene, 0, K)
    empty = replace(scene, body_mesh=scene.body_mesh[:0], body_poses=scene.body_poses[:0], body_tints=np.zeros((0, 3)))
    empty = replace(empty, body_object=scene.body_object[:0])
    fresh = Rasterizer(meshes, 160, 120).render(empty, 0, K)
    np.testing.assert_array_equal(camera.render(empty, 0, K).rgb, fresh.rgb)
    np.testing.assert_array_equal(camera.render(scene, 0, K).rgb, first.rgb)


def test_smooth_shading_rounds_a_cylinder_and_keeps_a_box() -> None:
    drum = shapes.cylinder(0.6, 1.2, (200, 200, 200), sides=12, center=(0, 0, 0.6))
    scene = snapshot([(0, (1.0, 0, 0))], Light(sun_direction=(-0.6, 0.7, 0.4)))
    flat, smooth = draw([drum], scene, PLAIN), draw([drum], scene, replace(PLAIN, smooth=True))
    row = 70
    inside = flat.instances[row] == 0
    steps = [np.abs(np.diff(f.rgb[row, inside, 0].astype(int))).max() for f in (flat, smooth)]
    assert steps[1] < 0.5 * steps[0]
    cube = shapes.box((1, 1, 1), center=(0, 0, 0.5))
    flat, smooth = draw([cube], scene, PLAIN), draw([cube], scene, replace(PLAIN, smooth=True))
    np.testing.assert_array_equal(flat.rgb[flat.instances == 0], smooth.rgb[flat.instances == 0])


def test_samples_soften_edges() -> None:
    cube = shapes.rotate(shapes.box((1, 1, 1), (20, 20, 20)), (1, 0.3, 0), 0.4)
    scene = snapshot([(0, (1, 0, 0.8))])
    one, four = draw([cube], scene, PLAIN), draw([cube], scene, replace(PLAIN, samples=4))
    contrast = [np.abs(np.diff(f.rgb[..., 2].astype(int), axis=1)) for f in (one, four)]
    assert (contrast[1] > 60).sum() < (contrast[0] > 60).sum()
    assert np.abs(four.rgb.astype(int).mean() - one.rgb.astype(int).mean()) < 2


def test_night_and_overcast_have_no_shadows_but_contact() -> None:
    box = shapes.box((0.8, 0.8, 0.8), center=(0, 0, 0.4))
    night = snapshot([(0, (2, 0, 0))], Light(sun_direction=(0.0, 0.9, -0.1), ambient=0.4))
    np.testing.assert_array_equal(draw([box], night, replace(PLAIN, shadows=True)).rgb, draw([box], night, PLAIN).rgb)


@pytest.mark.parametrize(
    ("values", "message"),
    [({"contact": 1.5}, "contact"), ({"clouds": -1}, "clouds"), ({"haze_m": 0}, "haze_m"), ({"samples": 9}, "samples")],
)
def test_bad_looks_say_what_is_wrong(values: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Look(**values)  # type: ignore[arg-type]


def test_bad_bodies_and_lights_say_what_is_wrong() -> None:
    meshes = [shapes.box((1, 1, 1))]
    lost = snapshot([(0, (2, 0, 0))])
    lost.body_poses[0, 0, 3] = np.nan
    with pytest.raises(ValueError, match=r"body_poses\[0\]"):
        draw(meshes, lost, PLAIN)
    with pytest.raises(ValueError, match=r"body_mesh\[0\] is 3"):
        draw(meshes, snapshot([(3, (2, 0, 0))]), PLAIN)
    with pytest.raises(ValueError, match="ambient"):
        draw(meshes, snapshot([], Light(ambient=2.0)), PLAIN)
    with pytest.raises(ValueError, match="counts"):
        draw(meshes, replace(snapshot([(0, (2, 0, 0))]), body_tints=np.ones((2, 3))), PLAIN)
    with pytest.raises(ValueError, match="finite"):
        Rasterizer([Mesh(np.full((3, 3), np.nan), np.zeros((1, 3), np.int32), np.zeros((1, 3), np.uint8))], 4, 4)
