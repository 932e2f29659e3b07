"""Pictures: form, stability, and that what matters is really drawn."""

from dataclasses import replace

import numpy as np
import pytest

from covis.envs import colors, paint
from covis.envs.claims import Claims, claims_to_action
from covis.envs.map_view import Area, MapPainter, area_of, field_of_view
from covis.envs.render import compose, draw_correspondences, matched_slots
from covis.envs.scenes import SCENES, parallel_env
from covis.envs.scoring import score

SMALL = {"width": 96, "height": 72, "max_detections": 24}
MANY = {"width": 200, "height": 150, "max_detections": 24, "min_pixels": 12}


def true_claims(env, wrong=False):
    """Claims of perfect eyes; matches right, or each one object further."""
    truth = env.ground_truth()
    n, K = truth.n_robots, env.max_detections
    seen = [np.flatnonzero(v)[:K] for v in truth.visible()]
    out = []
    for i in range(n):
        claim = Claims.empty(K, n - 1)
        claim.boxes[: len(seen[i])] = truth.boxes[i, seen[i]]
        claim.positions[: len(seen[i])] = truth.positions_in_camera(i)[seen[i]] + 0.2
        claim.position_variance[: len(seen[i])] = 0.04
        for p, j in enumerate(k for k in range(n) if k != i):
            slots = {int(o): k for k, o in enumerate(np.roll(seen[j], 1) if wrong else seen[j])}
            claim.matches[p, : len(seen[i])] = [slots.get(int(o), K) for o in seen[i]]
        out.append(claim)
    return out


def stepped(env, wrong=False):
    d = env.action_space("robot_0")["control"].shape
    claims = true_claims(env, wrong)
    env.step({a: claims_to_action(c, np.zeros(d)) for a, c in zip(env.agents, claims, strict=True)})


def changed(a, b):
    return float((a != b).any(axis=-1).mean())


@pytest.mark.parametrize("scene", SCENES)
def test_every_scene_is_drawn(scene):
    env = parallel_env(scene, render_mode="rgb_array", **SMALL)
    with pytest.raises(RuntimeError, match="reset"):
        env.render()
    env.reset(seed=1)
    picture = env.render()
    assert picture.dtype == np.uint8
    assert picture.flags.c_contiguous
    assert picture.shape[0] < picture.shape[1]
    assert picture.std() > 20
    np.testing.assert_array_equal(env.render(), picture, "drawing changes nothing")
    np.testing.assert_array_equal(compose(env), picture)
    stepped(env)
    assert env.render().shape == picture.shape, "every picture of a film has one size"


def test_without_a_mode_nothing_is_drawn():
    env = parallel_env("multi_robot", **SMALL)
    env.reset(seed=0)
    assert env.render() is None


@pytest.mark.parametrize("n_robots", [2, 3, 4, 5, 6])
@pytest.mark.parametrize("size", [(96, 72), (128, 64), (33, 47)])
def test_any_number_of_robots_and_any_shape_of_image(n_robots, size):
    width, height = size
    env = parallel_env("multi_robot", n_robots=n_robots, width=width, height=height, render_mode="rgb_array")
    env.reset(seed=0)
    stepped(env)
    picture = env.render()
    assert 700 < picture.shape[0] < 900
    for i in range(n_robots):  # every robot's colour is there, in a frame and on the map
        assert (picture == colors.robot_color(i)).all(axis=-1).sum() > 100


def test_right_and_wrong_matches_are_told_apart():
    pictures = {}
    for wrong in (False, True):
        env = parallel_env("multi_robot", render_mode="rgb_array", **MANY)
        env.reset(seed=2)
        stepped(env, wrong)
        counts = env.last_score().counts
        assert counts.retrieved > 2
        assert counts.correct == (0 if wrong else counts.retrieved)
        pictures[wrong] = env.render()
    red = {k: (p == colors.WRONG).all(axis=-1).sum() for k, p in pictures.items()}
    assert red[True] > 5 * red[False] + 100


def test_claims_are_drawn_on_the_instant_they_are_about():
    env = parallel_env("multi_robot", render_mode="rgb_array", **MANY)
    env.reset(seed=2)
    before = env.render()
    stepped(env)
    after = env.render()
    assert env.answered().instant.snapshot.time == 0
    head = slice(0, 44)
    assert changed(before[head], after[head]) > 0, "figures"
    assert 0 < changed(before, after) < 0.3, "the same instant, with claims on it"
    d = env.action_space("robot_0")["control"].shape
    empty = claims_to_action(Claims.empty(env.max_detections, 1), np.zeros(d))
    env.step(dict.fromkeys(env.agents, empty))
    assert changed(after, env.render()) > 0.02, "without claims the present instant is shown"


def test_matched_slots():
    env = parallel_env("multi_robot", n_robots=3, **MANY)
    env.reset(seed=2)
    result = score(true_claims(env), env.ground_truth())
    for i in range(3):
        right, wrong = matched_slots(i, result)
        assert not wrong
        assert right == set(np.flatnonzero(np.isfinite(result.error_fused[i])))
    result = score(true_claims(env, wrong=True), env.ground_truth())
    assert not matched_slots(0, result)[0]


def test_correspondences_of_two_cameras():
    env = parallel_env("multi_robot", **MANY)
    env.reset(seed=2)
    images = [f.rgb for f in env.camera_frames()]
    for wrong, color in ((False, colors.RIGHT), (True, colors.WRONG)):
        claims = true_claims(env, wrong)
        picture = draw_correspondences(images, claims, score(claims, env.ground_truth()), "mine")
        assert (picture == color).all(axis=-1).sum() > 50
    nothing = [Claims.empty(env.max_detections, 1)] * 2
    draw_correspondences(images, nothing, score(nothing, env.ground_truth()), "empty")


class TestMap:
    def test_pixels_of_an_area(self):
        area = Area((2.0, -1.0), 10.0, 100)
        np.testing.assert_allclose(area.pixels(np.array([[2.0, -1.0], [7.0, 4.0]])), [[50, 50], [100, 0]])
        x, y = area.grid()
        np.testing.assert_allclose(area.pixels(np.array([x[0, 30], y[70, 0]])), [30.5, 70.5], atol=1e-4)

    def test_the_ground_is_drawn_where_the_lines_are(self):
        env = parallel_env("multi_robot", **SMALL)
        env.reset(seed=3)
        snapshot = env.snapshot()
        area = area_of(snapshot, env.ground_truth().visible().any(axis=0), env.trail(), 400)
        painter = MapPainter(env.world.meshes, 400)
        picture = painter.ground(snapshot, area)
        empty = {k: getattr(snapshot, k)[:0] for k in ("body_mesh", "body_poses", "body_tints", "body_object")}
        bare = painter.ground(replace(snapshot, **empty), area)
        different = (picture != bare).any(axis=-1)
        centres = np.round(area.pixels(snapshot.positions) - 0.5).astype(int)
        inside = ((centres >= 0) & (centres < 400)).all(axis=1)
        assert inside.sum() > 5
        assert different[centres[inside, 1], centres[inside, 0]].mean() > 0.95

    def test_field_of_view_agrees_with_the_camera(self):
        area = Area((0.0, 0.0), 20.0, 200)
        T = np.eye(4)
        T[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # looks along x, level
        T[:3, 3] = -5, 0, 1
        field, rim = field_of_view(T, np.pi / 2, area)

        def at(x, y):
            u, v = area.pixels(np.array([x, y])).astype(int)
            return field[v, u]

        assert at(0, 0) > at(4, 0) > 0
        assert at(0, 4.8) > 0 == at(0, 5.2)
        assert at(-7, 0) == 0
        assert rim.max() > 0.5
        down = np.eye(4)
        down[:3, :3] = np.diag([1.0, -1, -1])
        down[:3, 3] = 0, 0, 4
        field, _ = field_of_view(down, np.pi / 2, area)
        assert at(3.8, 0) > 0 == at(4.2, 0)
        assert at(0, 2.8) > 0 == at(0, 3.2)

    def test_the_area_holds_robots_and_trails_and_changes_in_steps(self):
        env = parallel_env("connected_driving", **SMALL)
        env.reset(seed=3)
        snapshot, seen = env.snapshot(), env.ground_truth().visible().any(axis=0)
        area = area_of(snapshot, seen, env.trail(), 300)
        for points in (snapshot.T_world_camera[:, :2, 3], snapshot.positions[seen]):
            pixels = area.pixels(points)
            assert ((pixels > 0) & (pixels < 300)).all()
        longer = np.concatenate([env.trail(), env.trail() + [[[0.01, 0.0]]]])
        assert area_of(snapshot, seen, longer, 300).metres == area.metres


class TestPaint:
    def test_identity_colors_differ_and_stay(self):
        few = colors.identity_colors([4, 9, 9, 30])
        assert set(few) == {4, 9, 30}
        assert len(set(few.values())) == 3
        many = colors.identity_colors(range(14))
        assert len(set(many.values())) == 14
        assert colors.identity_colors([7]) == {7: colors.identity_colors([7, 100])[7]}
        assert len(colors.identity_colors(range(50))) == 50

    def test_blend_agrees_with_the_formula(self):
        rng = np.random.default_rng(0)
        picture = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
        mask = rng.random((20, 30)).astype(np.float32)
        color = (10, 250, 100)
        expected = picture + 0.5 * mask[..., None] * (np.array(color) - picture)
        paint.blend(picture, mask, color, 0.5)
        assert np.abs(picture - expected).max() <= 0.51

    @pytest.mark.parametrize(("length", "expected"), [(1, 1), (4.99, 2), (5, 5), (0.3, 0.2), (2400, 2000)])
    def test_round_length(self, length, expected):
        assert paint.round_length(length) == pytest.approx(expected)

    def test_text_without_truetype_fonts(self, monkeypatch):
        plain = paint.blank(200, 40)
        paint.text(plain, "covis", (5, 25), 18)
        monkeypatch.setattr(paint, "_font", lambda: None)
        stroke = paint.blank(200, 40)
        assert paint.text(stroke, "covis", (5, 25), 18) > 20
        assert (stroke != paint.CANVAS).any()
        assert paint.text_width("covis") > 10


def test_human_mode_shows_each_step_in_a_window(monkeypatch):
    """Without a screen, in SDL's dummy one."""
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env, still = (parallel_env("multi_robot", render_mode=mode, **SMALL) for mode in ("human", "rgb_array"))
    actions = {a: env.action_space(a).sample() for a in env.possible_agents}
    for one in (env, still):
        one.reset(seed=0)
        one.step(actions)
    assert env.render() is None
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, still.render())
    env.close()
    assert not pygame.display.get_init()
    env.close()
