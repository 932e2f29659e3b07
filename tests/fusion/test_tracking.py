import numpy as np
import pytest

from covis.fusion.metrics import identity_switches, nees_per_dof
from covis.fusion.tracking import Batch, Tracker, TrackerOptions, Tracks, predict, step

NOISE = 0.1


def moving_objects(rng, n=5, steps=40, dt=0.2, detection=0.9, acceleration=0.5):
    """Batches of noisy positions of objects with white-noise acceleration, their identities, and the true states."""
    x = np.column_stack([rng.uniform(-20, 20, size=(n, 2)), np.zeros(n), rng.normal(size=(n, 3))])
    batches, identities, truth = [], [], []
    for k in range(steps):
        a = acceleration * rng.normal(size=(n, 3))
        x[:, :3] += dt * x[:, 3:] + 0.5 * dt**2 * a
        x[:, 3:] += dt * a
        seen = rng.permutation(np.flatnonzero(rng.random(n) < detection))
        z = x[seen, :3] + NOISE * rng.normal(size=(len(seen), 3))
        batches.append(Batch(k * dt, z, np.tile(NOISE**2 * np.eye(3), (len(seen), 1, 1))))
        identities.append(seen)
        truth.append(x.copy())
    return batches, identities, truth


def options(**changes):
    return TrackerOptions(**{"acceleration_std": 0.5, "initial_speed_std": 1.0, **changes})


def test_the_filter_is_the_textbook_kalman_filter():
    rng = np.random.default_rng(0)
    tracker = Tracker(options(gate=1e9))
    x, P = None, None
    q, dt = 0.5**2, 0.2
    for k in range(10):
        z, R = rng.normal(size=3), np.diag(rng.uniform(0.1, 1, size=3))
        tracker.update(Batch(k * dt, z[None], R[None]))
        if x is None:
            x, P = np.concatenate([z, np.zeros(3)]), np.zeros((6, 6))
            P[:3, :3], P[3:, 3:] = R, np.eye(3)
            continue
        F = np.eye(6)
        F[:3, 3:] = dt * np.eye(3)
        G = np.vstack([0.5 * dt**2 * np.eye(3), dt * np.eye(3)])
        x, P = F @ x, F @ P @ F.T + q * G @ G.T
        H = np.eye(3, 6)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + K @ (z - H @ x), P - K @ H @ P
    np.testing.assert_allclose(tracker.tracks.states[0], x, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(tracker.tracks.covariances[0], P, rtol=1e-5, atol=1e-8)


def test_tracks_are_better_than_measurements_and_consistent():
    rng = np.random.default_rng(1)
    raw, tracked, errors, covariances, switches = [], [], [], [], 0
    for _ in range(10):
        batches, identities, truth = moving_objects(rng)
        tracker = Tracker(options())
        frames = []
        for k, (batch, identity) in enumerate(zip(batches, identities, strict=True)):
            labels = tracker.update(batch)
            frames.append(dict(zip(identity.tolist(), labels.tolist(), strict=True)))
            if k < 10:
                continue
            row = {track: i for i, track in enumerate(tracker.tracks.ids.tolist())}
            rows = [row[track] for track in labels.tolist()]
            error = tracker.tracks.states[rows] - truth[k][identity]
            raw.append(np.linalg.norm(batch.positions - truth[k][identity, :3], axis=1))
            tracked.append(np.linalg.norm(error[:, :3], axis=1))
            errors.append(error)
            covariances.append(tracker.tracks.covariances[rows])
        switches += identity_switches(frames)
    assert np.concatenate(tracked).mean() < 0.75 * np.concatenate(raw).mean()
    assert nees_per_dof(np.concatenate(errors), np.concatenate(covariances)) == pytest.approx(1.0, abs=0.2)
    assert switches < 0.01 * len(np.concatenate(raw))


def test_late_batches_give_the_same_tracks_as_batches_in_order():
    rng = np.random.default_rng(2)
    batches, _, _ = moving_objects(rng, steps=20)
    in_order, late = Tracker(options()), Tracker(options())
    for batch in batches:
        in_order.update(batch)
    shuffled = [batches[i] for i in (0, 1, 3, 2, 5, 4, 8, 7, 6, *range(9, 20))]
    for batch in shuffled:
        late.update(batch)
    a, b = in_order.tracks, late.tracks
    assert a.time == b.time
    order_a, order_b = np.argsort(a.states[:, 0]), np.argsort(b.states[:, 0])
    np.testing.assert_allclose(a.states[order_a], b.states[order_b], atol=1e-9)
    np.testing.assert_allclose(a.covariances[order_a], b.covariances[order_b], atol=1e-9)


def test_a_late_batch_does_not_change_the_tracks_names():
    def batch(time, *x):
        return Batch(time, np.array([[v, 0.0, 0.0] for v in x]), np.tile(0.01 * np.eye(3), (len(x), 1, 1)))

    tracker = Tracker(options())
    first = tracker.update(batch(0.0, 0.0))
    second = tracker.update(batch(0.4, 0.0, 50.0))
    tracker.update(batch(0.2, 0.0))
    third = tracker.update(batch(0.6, 0.0, 50.0))
    assert first[0] == second[0] == third[0]
    assert second[1] == third[1] != first[0]
    assert sorted(tracker.tracks.hits.tolist()) == [2, 4]


def test_a_batch_older_than_the_history_is_dropped():
    tracker = Tracker(options(history_s=1.0))
    one = np.tile(0.01 * np.eye(3), (1, 1, 1))
    tracker.update(Batch(5.0, np.zeros((1, 3)), one))
    before = tracker.tracks
    labels = tracker.update(Batch(3.0, np.ones((1, 3)), one))
    assert labels.tolist() == [-1]
    assert tracker.dropped == 1
    assert tracker.tracks is before


def test_birth_confirmation_and_death():
    tracker = Tracker(options(confirm_hits=2, timeout_s=1.0, tentative_timeout_s=0.3))
    z, C = np.zeros((1, 3)), np.tile(0.01 * np.eye(3), (1, 1, 1))
    none = Batch(0.0, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    tracker.update(Batch(0.0, z, C))
    assert (len(tracker.tracks), len(tracker.confirmed())) == (1, 0)
    tracker.update(Batch(0.2, z, C))
    assert len(tracker.confirmed()) == 1
    tracker.update(Batch(1.1, none.positions, none.covariances))
    assert len(tracker.confirmed()) == 1
    tracker.update(Batch(1.5, none.positions, none.covariances))
    assert len(tracker.tracks) == 0
    tracker.update(Batch(2.0, z, C))
    tracker.update(Batch(2.5, none.positions, none.covariances))
    assert len(tracker.tracks) == 0


def test_classes_keep_tracks_apart():
    tracker = Tracker(options())
    C = np.tile(0.01 * np.eye(3), (1, 1, 1))
    a = tracker.update(Batch(0.0, np.zeros((1, 3)), C, np.array([1])))
    b = tracker.update(Batch(0.1, np.zeros((1, 3)), C, np.array([2])))
    c = tracker.update(Batch(0.2, np.zeros((1, 3)), C, np.array([1])))
    assert a[0] == c[0] != b[0]


def test_a_track_without_a_class_takes_that_of_its_next_measurement():
    tracker = Tracker(options())
    here, C = np.zeros((1, 3)), 0.01 * np.eye(3)[None]
    unknown = tracker.update(Batch(0.0, here, C))
    first = tracker.update(Batch(0.1, here, C, np.array([1])))
    second = tracker.update(Batch(0.2, here, C, np.array([2])))
    assert unknown[0] == first[0] != second[0]


def test_prediction_to_a_later_time():
    C = np.tile(0.01 * np.eye(3), (1, 1, 1))
    tracker = Tracker(options())
    for k in range(10):
        tracker.update(Batch(0.1 * k, np.array([[0.1 * k, 0.0, 0.0]]), C))
    ahead = tracker.at(1.9)
    np.testing.assert_allclose(ahead.positions[0], [1.9, 0, 0], atol=0.05)
    assert ahead.position_covariances[0, 0, 0] > tracker.tracks.position_covariances[0, 0, 0]
    with pytest.raises(ValueError, match="before the last"):
        tracker.at(0.2)


def test_bad_batches_and_options_raise():
    for bad, message in (
        ((0.0, np.zeros((2, 3)), np.zeros((1, 3, 3))), r"covariances must have shape \(2, 3, 3\), got \(1, 3, 3\)"),
        ((0.0, np.zeros((2, 2)), np.zeros((2, 3, 3))), r"positions must have shape \(2, 3\), got \(2, 2\)"),
        ((0.0, 1.0, np.zeros((0, 3, 3))), r"positions must have shape \(0, 3\), got \(\)"),
        ((0.0, [[0.0, np.nan, 0.0]], np.zeros((1, 3, 3))), r"positions must be finite, got nan at \(0, 1\)"),
        ((np.nan, np.zeros((0, 3)), np.zeros((0, 3, 3))), "time must lie in .* got nan"),
        ((0.0, np.zeros((1, 3)), np.zeros((1, 3, 3)), np.zeros(2)), r"classes must have shape \(1,\), got \(2,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            Batch(*bad)
    for field, value in (("timeout_s", -1), ("gate", np.nan), ("confirm_hits", 0)):
        with pytest.raises(ValueError, match=f"^{field} must .*, got {value}$"):
            TrackerOptions(**{field: value})
    labels, tracks = step(Tracks.none(), Batch(0.0, np.zeros((0, 3)), np.zeros((0, 3, 3))), TrackerOptions())
    assert len(labels) == len(tracks) == 0
    assert len(predict(tracks, 1.0, 1.0)) == 0


def test_a_revised_batch_is_as_if_it_had_come_at_once():
    rng = np.random.default_rng(11)
    batches, _, _ = moving_objects(rng, steps=8, detection=1.0)
    better = [Batch(b.time, b.positions + 0.01, 0.5 * b.covariances) for b in batches]
    revised, direct = Tracker(options()), Tracker(options())
    for k, batch in enumerate(batches):
        revised.update(batch)
        if k >= 2:
            revised.revise(better[k - 2], len(batch.positions))
    for batch in [*better[:-2], *batches[-2:]]:
        direct.update(batch)
    np.testing.assert_allclose(revised.tracks.states, direct.tracks.states, atol=1e-9)
    np.testing.assert_array_equal(np.sort(revised.labels(batches[-1].time)), np.sort(revised.tracks.ids))


def test_what_a_revision_refuses():
    tracker = Tracker(options())
    batch = Batch(1.0, np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)))
    tracker.update(batch)
    with pytest.raises(ValueError, match=r"same must lie in 0\.\.2, got 3"):
        tracker.revise(batch, 3)
    with pytest.raises(KeyError, match=r"no batch of time 2"):
        tracker.revise(Batch(2.0, batch.positions, batch.covariances), 2)
    with pytest.raises(KeyError, match=r"no batch of time 3"):
        tracker.labels(3.0)
