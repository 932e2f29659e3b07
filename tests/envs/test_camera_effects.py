"""Sensor effects: each does what it says, the lens and its inverse agree, and everything is drawn from the rng."""

from __future__ import annotations

import numpy as np
import pytest

from covis.envs.camera import effects as fx
from covis.envs.camera import shapes
from covis.envs.camera.frame import Frame
from covis.envs.camera.mount import Mount
from covis.envs.camera.raster import Rasterizer, intrinsics_from_fov, look_at
from covis.envs.worlds.world import Light, Snapshot

WIDTH, HEIGHT = 120, 90
K = intrinsics_from_fov(WIDTH, HEIGHT, np.radians(80))
GREY = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
LENSES = [fx.SensorEffects(k1=-0.15, k2=0.02), fx.SensorEffects(k1=0.08), fx.SensorEffects(k1=-0.05, k2=-0.01)]


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.mark.parametrize("lens", LENSES)
def test_undistort_inverts_distort(lens: fx.SensorEffects) -> None:
    pixels = rng().uniform((0, 0), (WIDTH, HEIGHT), (200, 2))
    np.testing.assert_allclose(fx.undistort(fx.distort(pixels, K, lens), K, lens), pixels, atol=1e-8)
    np.testing.assert_allclose(fx.distort(fx.undistort(pixels, K, lens), K, lens), pixels, atol=1e-8)
    centre = K[:2, 2]
    np.testing.assert_allclose(fx.distort(centre, K, lens)[0], centre)


def test_a_lens_that_cannot_be_undone_says_so() -> None:
    with pytest.raises(ValueError, match="k1 = -2"):
        fx.undistort([[0.0, 0.0]], K, fx.SensorEffects(k1=-2.0))


@pytest.mark.parametrize("lens", LENSES)
def test_a_bent_picture_shows_points_where_distort_puts_them(lens: fx.SensorEffects) -> None:
    """Small boxes: the centre of each one's mask lies at the distorted projection of its centre."""
    places = [(4.0, y, z) for y in (-2.2, 0.0, 1.5) for z in (-0.9, 0.0, 1.4)]
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = np.array(places) + (0, 0, 3)
    T = look_at((0, 0, 3), (1, 0, 3))
    optics = fx.Lens(lens, K, WIDTH, HEIGHT)
    camera = Rasterizer([shapes.sphere(0.12)], optics.wide_width, optics.wide_height)
    n = len(places)
    wide = camera.render_bodies(
        np.zeros(n, np.int64), poses, np.ones((n, 3)), np.arange(n), Light(), T, optics.wide_intrinsics
    )
    frame = optics.bend(wide)
    assert frame.depth.shape == (HEIGHT, WIDTH)
    for i, (x, y, z) in enumerate(places):
        ideal = np.array([[K[0, 2] - K[0, 0] * y / x, K[1, 2] - K[1, 1] * z / x]])
        rows, columns = np.nonzero(frame.instances == i)
        seen = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        np.testing.assert_allclose(seen, fx.distort(ideal, K, lens)[0], atol=0.6)
        assert np.median(frame.depth[frame.instances == i]) == pytest.approx(4.0, abs=0.13)


def test_no_effects_change_nothing() -> None:
    picture = rng().integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    np.testing.assert_array_equal(fx.expose(picture, fx.SensorEffects(), rng()), picture)
    assert fx.wide_view(fx.SensorEffects(), K, WIDTH, HEIGHT)[:2] == (WIDTH, HEIGHT)
    optics = fx.Lens(fx.SensorEffects(), K, WIDTH, HEIGHT)
    frame = Frame(
        picture, np.ones((HEIGHT, WIDTH), np.float32), np.arange(HEIGHT * WIDTH, dtype=np.int32).reshape(HEIGHT, -1)
    )
    np.testing.assert_array_equal(optics.bend(frame).instances, frame.instances)
    np.testing.assert_array_equal(optics.bend(frame).rgb, picture)


def test_each_light_effect_does_what_it_says() -> None:
    assert (fx.expose(GREY, fx.SensorEffects(exposure=1.5), rng()) == 180).all()
    assert (fx.expose(GREY, fx.SensorEffects(exposure=9.0), rng()) == 255).all()
    assert (fx.expose(GREY, fx.SensorEffects(white_balance=(1.1, 1.0, 0.9)), rng())[0, 0] == (132, 120, 108)).all()
    assert (fx.expose(GREY, fx.SensorEffects(contrast=2.0), rng()) == 113).all()
    dim = fx.expose(GREY, fx.SensorEffects(vignette=0.5), rng())
    assert dim[HEIGHT // 2, WIDTH // 2, 0] == 120
    assert int(dim[0, 0, 0]) == pytest.approx(60, abs=2)


def test_noise_has_the_stated_strength() -> None:
    read = fx.expose(GREY, fx.SensorEffects(read_noise=5.0), rng()).astype(float)
    assert read.std() == pytest.approx(5.0, rel=0.05)
    assert read.mean() == pytest.approx(120, abs=0.3)
    shot = fx.expose(GREY, fx.SensorEffects(shot_noise=8.0), rng()).astype(float)
    assert shot.std() == pytest.approx(8.0 * np.sqrt(120 / 255), rel=0.05)
    neighbours = np.corrcoef(read[:, :-1].ravel(), read[:, 1:].ravel())[0, 1]
    assert abs(neighbours) < 0.03


def test_blur_spreads_an_edge_and_keeps_the_mean() -> None:
    edge = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    edge[:, WIDTH // 2 :] = 200
    soft = fx.expose(edge, fx.SensorEffects(blur_px=2.0), rng()).astype(float)
    assert np.abs(np.diff(soft[:, :, 0], axis=1)).max() < 60
    assert soft.mean() == pytest.approx(100, abs=1)
    kernel = np.diff(soft[HEIGHT // 2, :, 0]) / 200
    at = np.arange(len(kernel)) - (kernel * np.arange(len(kernel))).sum()
    assert np.sqrt((kernel * at**2).sum()) == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("effects", [fx.SensorEffects(exposure=0.5), fx.SensorEffects(k1=-0.1, read_noise=2.0)])
def test_a_sensor_camera_renders_bends_and_exposes(effects: fx.SensorEffects) -> None:
    poses = np.eye(4)[None].copy()
    scene = Snapshot(
        time=0.0,
        identity=np.arange(1),
        object_class=np.zeros(1, np.int64),
        positions=np.zeros((1, 3)),
        velocities=np.zeros((1, 3)),
        headings=np.zeros(1),
        sizes=np.ones((1, 3)),
        body_mesh=np.zeros(1, np.int64),
        body_poses=poses,
        body_tints=np.ones((1, 3)),
        body_object=np.zeros(1, np.int64),
        T_world_camera=look_at((-3, 0, 1.5), (0, 0, 0.3))[None],
        robot_object=np.array([-1]),
        robot_velocity=np.zeros((1, 3)),
        robot_state=np.zeros((1, 1)),
        collided=np.zeros(1, bool),
        light=Light(),
    )
    ideal = Rasterizer([shapes.husky()], WIDTH, HEIGHT)
    frame = fx.SensorCamera(ideal, K, effects).render(scene, 0, rng())
    plain = ideal.render(scene, 0, K)
    if not effects.distorts:
        np.testing.assert_array_equal(frame.instances, plain.instances)
        assert frame.rgb.mean() == pytest.approx(0.5 * plain.rgb.mean(), rel=0.02)
    else:
        optics = fx.Lens(effects, K, WIDTH, HEIGHT)
        wide = Rasterizer([shapes.husky()], optics.wide_width, optics.wide_height)
        bent = optics.bend(wide.render(scene, 0, optics.wide_intrinsics))
        np.testing.assert_array_equal(frame.depth, bent.depth)
        np.testing.assert_array_equal(frame.rgb, fx.expose(bent.rgb, effects, rng()))
    again = fx.SensorCamera(ideal, K, effects).render(scene, 0, rng())
    np.testing.assert_array_equal(frame.rgb, again.rgb)


def test_draws_come_from_the_rng_and_stay_in_range() -> None:
    ranges = fx.EffectRanges()
    first, again = ranges.sample(rng()), ranges.sample(rng())
    assert first == again
    many = [ranges.sample(np.random.default_rng(i)) for i in range(50)]
    assert len({m.exposure for m in many}) == 50
    assert all(ranges.k1[0] <= m.k1 <= ranges.k1[1] for m in many)
    picture = rng().integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    np.testing.assert_array_equal(fx.expose(picture, first, rng()), fx.expose(picture, first, rng()))
    other = fx.expose(picture, first, np.random.default_rng(6))
    assert (fx.expose(picture, first, rng()) != other).any()
    for m in many:
        fx.wide_view(m, K, WIDTH, HEIGHT)


def test_expose_in_place() -> None:
    picture = GREY.copy()
    assert fx.expose(picture, fx.SensorEffects(exposure=0.5, blur_px=1.0), rng(), out=picture) is picture
    assert (picture == 60).all()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"exposure": 0.0}, "exposure"),
        ({"blur_px": -1.0}, "blur_px"),
        ({"vignette": 1.0}, "vignette"),
        ({"white_balance": (1.0, 0.0, 1.0)}, "white_balance"),
        ({"k1": np.nan}, "k1"),
    ],
)
def test_bad_effects_say_what_is_wrong(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fx.SensorEffects(**values)  # type: ignore[arg-type]


def test_bad_ranges_say_what_is_wrong() -> None:
    with pytest.raises(ValueError, match="contrast"):
        fx.EffectRanges(contrast=(2.0, 1.0))


def test_a_mount_places_the_camera() -> None:
    T = Mount(forward_m=0.4, height_m=1.2).T_body_camera
    np.testing.assert_allclose(T, look_at((0.4, 0, 1.2), (5, 0, 1.2)), atol=1e-12)
    tilted = Mount(height_m=2.0, tilt_rad=0.5).T_body_camera
    np.testing.assert_allclose(tilted, look_at((0, 0, 2), (1, 0, 2 - np.tan(0.5))), atol=1e-12)
    left = Mount(pan_rad=np.pi / 2).T_body_camera
    np.testing.assert_allclose(left[:3, 2], (0, 1, 0), atol=1e-12)
    down = Mount(tilt_rad=np.pi / 2).T_body_camera
    np.testing.assert_allclose(down[:3, 2], (0, 0, -1), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(down[:3, :3]), 1.0)


def test_a_mount_takes_pictures_at_its_rate() -> None:
    due = [Mount(rate_hz=2.0).is_due(step, 0.2) for step in range(11)]
    assert due == [True, False, False, True, False, True, False, False, True, False, True]
    assert all(Mount().is_due(step, 0.2) for step in range(5))


@pytest.mark.parametrize(
    "values",
    [{"horizontal_fov_rad": 4.0}, {"tilt_rad": 2.0}, {"rate_hz": 0.0}, {"height_m": None}, {"pan_rad": np.nan}],
)
def test_bad_mounts_say_what_is_wrong(values: dict[str, float | None]) -> None:
    with pytest.raises(ValueError, match=next(iter(values))):
        Mount(**values)  # type: ignore[arg-type]
