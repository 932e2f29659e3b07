"""A team on paper: objects on the plane, robots around them, everything drawn from the noise that is reported."""

from dataclasses import replace

import numpy as np
import pytest

from covis.fusion.channel import message_size
from covis.fusion.member import UNPROTECTED, Member, MemberOptions, OdometryNoise, PoseBelief, Report
from covis.fusion.metrics import nees_per_dof
from covis.fusion.tracking import TrackerOptions
from covis.matching.graph import Matching, ObjectGraph
from covis.matching.pose import exp_se3, invert, transform

UP = np.array([0.0, 0.0, 1.0])
POSE_COVARIANCE = np.diag([0.2**2, 0.2**2, 0.2**2, 0.0, 0.0, 0.02**2])
TRACKER = TrackerOptions(acceleration_std=0.3, initial_speed_std=0.1)


def same_order(source, target):
    pairs = np.stack([np.arange(len(source.graph))] * 2, axis=1)
    return Matching(pairs, np.ones(len(pairs)))


class World:
    """Robots that stand around objects that stand; every robot sees all objects in one order."""

    def __init__(self, seed, n_robots=4, n_objects=8):
        self.rng = np.random.default_rng(seed)
        self.objects = np.column_stack([self.rng.uniform(-5, 5, (n_objects, 2)), np.zeros(n_objects)])
        angles = np.linspace(0, 2 * np.pi, n_robots, endpoint=False)
        self.T = [exp_se3(np.array([12 * np.cos(a), 12 * np.sin(a), 0, 0, 0, a + np.pi])) for a in angles]

    def truth(self, robot):
        return transform(invert(self.T[robot]), self.objects)

    def look(self, robot, offset=0.0):
        """Graph, reported pose, its covariance, odometry."""
        x = self.truth(robot)
        ray = x / np.linalg.norm(x, axis=1)[:, None]
        C = 0.05**2 * np.eye(3) + (0.4**2 - 0.05**2) * ray[:, :, None] * ray[:, None, :]
        seen = x + np.einsum("nij,nj->ni", np.linalg.cholesky(C), self.rng.normal(size=x.shape))
        xi = np.sqrt(np.diag(POSE_COVARIANCE)) * self.rng.normal(size=6)
        pose = self.T[robot] @ invert(exp_se3(xi))
        pose[0, 3] += offset
        return ObjectGraph.from_positions(seen, covariances=C, up=UP), pose, POSE_COVARIANCE, np.eye(4)


def run(seed, options, steps=12, n_robots=4, delay=0, offset=0.0, match=same_order):
    """Errors single and now (k, 3), covariances (k, 3, 3) of all robots but the last, which may be wrong."""
    world = World(seed, n_robots)
    members = [Member(i, n_robots, match, options) for i in range(n_robots)]
    sent = []
    single, error, covariances = [], [], []
    for k in range(steps):
        sent.append(
            [m.look(0.2 * k, *world.look(i, offset if i == n_robots - 1 else 0.0)) for i, m in enumerate(members)]
        )
        for i, member in enumerate(members):
            arrived = [r for r in sent[k - delay] if r.robot != i] if k >= delay else []
            own = member.localize(arrived).own
            if i < n_robots - 1 and k >= 2:
                single.append(own.positions_single - world.truth(i))
                error.append(own.positions - world.truth(i))
                covariances.append(own.covariances)
    return tuple(np.concatenate(x) for x in (single, error, covariances)), members


def mean_error(x):
    return float(np.linalg.norm(x, axis=1).mean())


@pytest.mark.parametrize("n_robots", [2, 4])
def test_frame_by_frame_the_covariances_are_honest(n_robots):
    """Partners' measurements share the error of the robot's own pose: that is counted once."""
    runs = [
        run(seed, MemberOptions(tracker=None, filter_pose=False), n_robots=n_robots, steps=5)[0] for seed in range(12)
    ]
    single, error, covariances = (np.concatenate(x) for x in zip(*runs, strict=True))
    assert mean_error(error) < 0.8 * mean_error(single)
    assert nees_per_dof(error, covariances) == pytest.approx(1.0, abs=0.12)


def test_tracking_makes_it_better_still():
    (_, alone, _), _ = run(1, MemberOptions(tracker=None))
    (_, tracked, _), _ = run(1, MemberOptions(tracker=TRACKER))
    assert mean_error(tracked) < 0.9 * mean_error(alone)


def test_late_reports_count_at_their_own_time():
    """The partners' reports of two steps ago still help: standing objects are known almost as well as at once."""
    (single, at_once, _), _ = run(2, MemberOptions(tracker=TRACKER))
    (_, late, _), members = run(2, MemberOptions(tracker=TRACKER), delay=2)
    assert mean_error(late) < 0.6 * mean_error(single)
    assert mean_error(late) < 1.25 * mean_error(at_once)
    assert all(m.dropped == 0 for m in members)


def test_a_report_older_than_the_memory_is_dropped():
    _, members = run(2, MemberOptions(tracker=TrackerOptions(history_s=0.5)), delay=4)
    assert all(m.dropped > 0 for m in members)


def test_a_robot_with_a_wrong_pose_is_left_out():
    options = MemberOptions(tracker=TRACKER)
    (_, sound, _), _ = run(3, options)
    (_, guarded, _), members = run(3, options, offset=5.0)
    (_, open_, _), _ = run(3, UNPROTECTED, offset=5.0)
    assert mean_error(guarded) < 1.25 * mean_error(sound)
    assert mean_error(open_) > 2 * mean_error(sound)
    for member in members[:-1]:
        assert member.agreement[-1] < 0.5
        assert member.agreement[:-1].min() > 0.9


def test_a_robot_leaves_and_comes_back():
    """Its partner goes on alone, better than a single look because of its tracks, and takes the help up again."""
    world = World(4, 2)
    options = MemberOptions(tracker=TRACKER)
    members = [Member(i, 2, same_order, options) for i in range(2)]
    errors = []
    for k in range(30):
        here = members[0].look(0.2 * k, *world.look(0))
        there = members[1].look(0.2 * k, *world.look(1)) if not 10 <= k < 20 else None
        own = members[0].localize([] if there is None else [there]).own
        assert here.robot == 0
        errors.append((mean_error(own.positions - world.truth(0)), mean_error(own.positions_single - world.truth(0))))
    assert len(members[0].matches(there)) == 8
    away, back = np.array(errors[10:20]), np.array(errors[20:])
    assert away[:, 0].mean() < 0.8 * away[:, 1].mean()
    assert back[:, 0].mean() < 0.8 * back[:, 1].mean()


def test_a_partners_objects_become_tracks_before_they_are_seen():
    world = World(5, 2)
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    world.objects = np.column_stack([6 * np.cos(angles), 6 * np.sin(angles), np.zeros(8)])
    member = Member(0, 2, lambda a, b: Matching.empty(), MemberOptions(tracker=TRACKER))
    for k in range(3):
        graph, *pose = world.look(0)
        own = member.look(0.2 * k, graph.take(np.arange(3)), *pose)
        other, T, C, _ = world.look(1)
        hidden = other.take(np.arange(3, 8))
        member.localize([Report(1, 0.2 * k, hidden, hidden, T, C)])
    assert member.tracker is not None
    assert len(member.tracker.confirmed()) == 8
    assert own.size_bytes == 2 * message_size(own.graph) + 37 * 4


def test_own_pose_belief_is_consistent_and_better_than_one_fix():
    rng = np.random.default_rng(6)
    noise = OdometryNoise()
    fixes, errors, covariances = [], [], []
    for _ in range(60):
        T, belief = exp_se3(np.array([3.0, -2.0, 0, 0, 0, 0.4])), PoseBelief(noise)
        for k in range(15):
            motion = exp_se3(np.array([0.3, 0.0, 0, 0, 0, 0.1]))
            drift = np.sqrt(np.diag(noise.covariance(motion, UP))) * rng.normal(size=6)
            T = T @ motion @ exp_se3(drift) if k else T
            xi = np.sqrt(np.diag(POSE_COVARIANCE)) * rng.normal(size=6)
            belief.update(T @ invert(exp_se3(xi)), POSE_COVARIANCE, motion if k else None, UP)
        delta = invert(belief.T) @ T
        planar = [0, 1, 5]
        errors.append(np.array([*delta[:2, 3], np.arctan2(delta[1, 0], delta[0, 0])]))
        covariances.append(belief.P[np.ix_(planar, planar)])
        fixes.append(xi[:3])
    assert nees_per_dof(np.array(errors), np.array(covariances)) == pytest.approx(1.0, abs=0.3)
    assert np.std(np.array(errors)[:, :2]) < 0.5 * np.std(np.array(fixes)[:, :2])


@pytest.mark.parametrize(
    ("options", "option", "value"),
    [
        (MemberOptions, "gate", 1.0),
        (MemberOptions, "least_agreement", 1.5),
        (MemberOptions, "repeated", -0.1),
        (MemberOptions, "gain", "best"),
        (OdometryNoise, "heading_rad", np.nan),
    ],
)
def test_bad_options_are_named_with_their_value(options, option, value):
    with pytest.raises(ValueError, match=f"^{option} must .*, got {value!r}$"):
        options(**{option: value})


def test_time_must_go_on():
    member = Member(0, 2, same_order)
    look = World(7, 2).look(0)
    member.look(1.0, *look)
    with pytest.raises(ValueError, match=r"time 1\.0 is not later"):
        member.look(1.0, *look)


def test_what_is_refused_leaves_no_trace():
    options = MemberOptions(tracker=TRACKER)
    world, team = World(8, 2), [Member(i, 2, same_order, options) for i in range(2)]
    graph, pose, covariance, odometry = world.look(0)
    for bad, words in (
        ((np.nan, graph, pose, covariance, odometry), "time must be finite"),
        ((0.0, graph, pose[:3, :3], covariance, odometry), "pose must"),
        ((0.0, graph, pose, np.eye(3), odometry), "pose_covariance must have shape"),
        ((0.0, graph, pose, covariance, 2 * odometry), "odometry"),
    ):
        with pytest.raises(ValueError, match=words):
            team[0].look(*bad)
    reports = [member.look(0.0, *world.look(i)) for i, member in enumerate(team)]
    for stranger in (0, 2, -1):
        with pytest.raises(ValueError, match=rf"robot 0 of 2 got a report of robot {stranger}"):
            team[0].localize([reports[1], replace(reports[1], robot=stranger)])
    assert (team[0].localize([]).own.n_robots == 1).all()
    assert (team[0].localize([reports[1]]).own.n_robots == 2).all()
