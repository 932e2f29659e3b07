"""A robot's memory: landmarks stay where they are while it moves, and together show what single frames cannot."""

import numpy as np
import pytest

from covis.fusion.localmap import LocalMap, MapOptions
from covis.fusion.sequence import PairTracker
from covis.matching import METHODS, ObjectGraph
from covis.matching.pose import Array, exp_se3, invert, transform

UP = np.array([0.0, 0.0, 1.0])
FORWARD = np.array([1.0, 0.0, 0.0])
STD_M = 0.02


def planar(x: float, y: float, heading: float) -> Array:
    """Pose (4, 4), not the exponential of a twist: (x, y) is where it stands."""
    T = exp_se3(np.array([0, 0, 0, 0, 0, heading]))
    T[:2, 3] = x, y
    return T


def graph(positions, *, fov=None):
    return ObjectGraph.from_positions(
        positions,
        covariances=np.tile(STD_M**2 * np.eye(3), (len(positions), 1, 1)),
        up=UP,
        forward=FORWARD,
        horizontal_fov_rad=fov,
    )


def noisy(rng, positions):
    return positions + STD_M * rng.standard_normal(positions.shape) * [1, 1, 0]


def test_landmarks_are_carried_by_odometry_and_seen_again():
    rng = np.random.default_rng(0)
    world = np.array([[3.0, 1.0, 0.0], [4.0, -1.0, 0.0], [5.0, 0.5, 0.0], [2.0, -0.4, 0.0]])
    memory, before = LocalMap(), planar(0, 0, 0)
    for k in range(30):
        T = planar(0.03 * k, 0.0, 0.02 * k)
        memory.predict(invert(before) @ T, UP)
        seen = world if k < 12 or k > 20 else world[:1]
        remembered = memory.see(graph(noisy(rng, transform(invert(T), seen))))
        before = T
    np.testing.assert_allclose(remembered.positions, transform(invert(before), world), atol=0.05)
    assert np.linalg.eigvalsh(memory.covariance).min() > 0


def test_errors_of_the_map_are_what_its_covariance_says():
    """Heading errors swing all landmarks together: over many runs the whole map's NEES is 1 per degree of freedom."""
    world = np.array([[3.0, 1.0, 0.0], [4.0, -1.0, 0.0], [5.0, 3.0, 0.0]])
    nees = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        memory, before = LocalMap(), planar(0, 0, 0)
        memory.see(graph(noisy(rng, world)))
        for k in range(1, 4):
            T = planar(0.05 * k, 0.0, 0.0)
            error = planar(*((0.006 + 0.06 * 0.05) * rng.standard_normal(2)), 0.01 * rng.standard_normal())
            memory.predict(invert(before) @ T @ error, UP)
            before = T
        off = (memory.positions - transform(invert(before), world))[:, :2].ravel()
        flat = np.flatnonzero(np.arange(9) % 3 < 2)
        nees.append(off @ np.linalg.solve(memory.covariance[np.ix_(flat, flat)], off) / 6)
    assert np.mean(nees) == pytest.approx(1.0, abs=0.2)


def test_what_moves_and_what_is_gone_is_not_kept():
    rng = np.random.default_rng(1)
    still = np.array([[3.0, 1.0, 0.0], [4.0, -1.0, 0.0], [5.0, 0.0, 0.0]])
    memory = LocalMap()
    for k in range(15):
        memory.predict(np.eye(4), UP)
        walker = np.array([[2.0, -2.0 + 0.25 * k, 0.0]])
        memory.see(graph(noisy(rng, np.concatenate([still, walker])), fov=2.0))
    for _ in range(5):
        memory.predict(np.eye(4), UP)
        remembered = memory.see(graph(noisy(rng, still), fov=2.0))
    assert len(remembered) == 3
    for _ in range(20):
        memory.predict(np.eye(4), UP)
        remembered = memory.see(graph(noisy(rng, still[1:]), fov=2.0))
    assert len(remembered) == 2


@pytest.mark.parametrize(("option", "value"), [("gate", -1.0), ("trials", 1.5), ("doubt", np.nan), ("moved_m", np.inf)])
def test_bad_options_are_named_with_their_value(option, value):
    with pytest.raises(ValueError, match=f"^{option} must .*, got {value}$"):
        MapOptions(**{option: value})


def test_an_empty_frame_is_survived():
    memory = LocalMap()
    memory.predict(np.eye(4), UP)
    assert len(memory.see(graph(np.zeros((0, 3))))) == 0
    assert len(memory.see(graph(np.ones((1, 3))))) == 1


def sweep(rng, world, T, heading, share=3):
    """Frames of a robot at T that turns round once: the three landmarks most in front, and its odometry."""
    before = None
    for k in range(24):
        now = T @ planar(0, 0, heading + 2 * np.pi * k / 24)
        local = transform(invert(now), world)
        front = np.argsort(-local[:, 0] / np.linalg.norm(local, axis=1))[:share]
        yield graph(noisy(rng, local[front])), np.eye(4) if before is None else invert(before) @ now
        before = now


@pytest.mark.parametrize("by_maps", [True, False])
def test_maps_recognise_what_single_frames_cannot(by_maps):
    """Robots that turn on the spot, see three landmarks of ten at a time, and start looking apart."""
    rng = np.random.default_rng(4)
    world = np.column_stack([rng.uniform(-4, 4, (10, 2)), np.zeros(10)])
    T_a, T_b = planar(-0.5, 0.3, 0.0), planar(0.6, -0.4, 2.0)
    memories, tracker = (LocalMap(), LocalMap()), PairTracker()
    frames = zip(sweep(rng, world, T_a, 0.0), sweep(rng, world, T_b, 1.0), strict=True)
    for (a, step_a), (b, step_b) in frames:
        tracker.predict(step_a, step_b)
        remembered = []
        for memory, seen, step in zip(memories, (a, b), (step_a, step_b), strict=True):
            memory.predict(step, UP)
            remembered.append(memory.see(seen))
        tracker.match(METHODS["bayes"], a, b, maps=tuple(remembered) if by_maps else None)
    found = tracker.filter.best()
    true = invert(T_a) @ T_b
    right = found is not None and found[2] > 0.7 and np.linalg.norm(found[0][:2] - _now(true)[:2]) < 0.3
    assert right == by_maps


def _now(true):
    """Translation (3,) between the robots at the end of their sweeps."""
    last = 2 * np.pi * 23 / 24
    return (invert(planar(0, 0, last)) @ true @ planar(0, 0, 1.0 + last))[:3, 3]
