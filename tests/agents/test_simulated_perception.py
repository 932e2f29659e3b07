"""Simulated eyes: what they see, how they err, and that they say so honestly."""

import numpy as np
import pytest

from covis.agents.perception import SimulatedPerception, SimulatedPerceptionParams
from covis.agents.perception.simulated import measure
from covis.envs.worlds.world import ObjectClass

CLASSES = (ObjectClass("car", 1.0), ObjectClass("person", 0.2))
EXACT = SimulatedPerceptionParams(
    miss_rate=0,
    miss_rate_occluded=0,
    false_positives=0,
    depth_noise=0,
    depth_noise_occluded=0,
    centre_noise=0,
    pixel_noise=0,
    centre_noise_image=0,
    box_noise=0,
    class_noise=0,
    uncertainty_noise=0,
)


def observation(blocks, height=60, width=80):
    """Blocks (id, class, u0, v0, u1, v1, depth), later ones in front."""
    depth = np.full((height, width), 1000.0, dtype=np.float32)
    instances = np.zeros((height, width), dtype=np.int32)
    classes = np.full(10, -1)
    for i, kind, u0, v0, u1, v1, z in blocks:
        depth[v0:v1, u0:u1], instances[v0:v1, u0:u1], classes[i] = z, i, kind
    K = np.array([[80.0, 0, width / 2], [0, 80.0, height / 2], [0, 0, 1]], dtype=np.float32)
    return {
        "depth": depth,
        "instances": instances,
        "instance_classes": classes,
        "intrinsics": K,
        "up": np.array([0.0, -1.0, 0.0], dtype=np.float32),
    }


def test_exact_eyes_see_the_centre():
    look = SimulatedPerception(CLASSES, EXACT)
    found = look(observation([(3, 0, 35, 25, 45, 35, 10.0)]), np.random.default_rng(0))
    np.testing.assert_allclose(found.graph.positions, [[0, 0, 11.0]], atol=1e-6)
    np.testing.assert_allclose(found.boxes, [[35, 25, 45, 35]])
    assert found.graph.attributes[0].argmax() == 0
    assert found.graph.image_size == (80, 60)


def test_position_is_on_the_ray_of_the_box():
    look = SimulatedPerception(CLASSES, EXACT)
    found = look(observation([(1, 1, 60, 10, 70, 20, 8.0)]), np.random.default_rng(0))
    x, y, z = found.graph.positions[0]
    assert (x / z, y / z) == pytest.approx((25 / 80, -15 / 80), rel=1e-5)


def test_small_objects_are_not_seen():
    look = SimulatedPerception(CLASSES, EXACT)
    found = look(observation([(1, 0, 0, 0, 7, 8, 5.0), (2, 0, 20, 0, 28, 8, 5.0)]), np.random.default_rng(0))
    assert len(found) == 1
    assert found.boxes[0, 0] == 20


def test_nothing_in_view_is_an_empty_graph():
    found = SimulatedPerception(CLASSES)(observation([]), np.random.default_rng(0))
    assert len(found) == 0
    assert found.graph.attributes.shape == (0, 2)
    assert found.boxes.shape == (0, 4)


def test_measure_by_hand():
    blocks = [(1, 0, 10, 10, 30, 30, 10.0), (2, 0, 20, 10, 40, 30, 5.0)]
    o = observation(blocks)
    seen = measure(o["instances"], o["depth"], 10)
    assert seen[1, 0] == 200
    assert seen[1, 1] == pytest.approx(10.0)
    np.testing.assert_array_equal(seen[1, 3:], [10, 10, 20, 30])
    # 20 of the 60 edges of the left half are cut off by the nearer block; the nearer block is free.
    assert seen[1, 2] == pytest.approx(20 / 60)
    assert seen[2, 2] == 0.0
    assert seen[3:].sum() == 0


def test_reported_variance_is_the_true_one():
    """Averaged over many looks, the squared error along and across the ray is what the covariance says."""
    look = SimulatedPerception(
        CLASSES, SimulatedPerceptionParams(false_positives=0, miss_rate=0, centre_noise=0, uncertainty_noise=0)
    )
    o = observation([(1, 1, 35, 20, 45, 40, 10.0)])
    rng = np.random.default_rng(0)
    errors, covariances = [], []
    for _ in range(3000):
        graph = look(o, rng).graph
        errors.append(graph.positions[0] - [0, 0, 10.2])
        covariances.append(graph.covariances[0])
    nees = np.mean([e @ np.linalg.solve(c, e) for e, c in zip(errors, covariances, strict=True)]) / 3
    assert 0.8 < nees < 1.2


def test_error_grows_with_range_and_occlusion():
    look = SimulatedPerception(CLASSES, SimulatedPerceptionParams(false_positives=0, miss_rate=0, miss_rate_occluded=0))
    near = observation([(1, 1, 30, 20, 45, 40, 5.0)])
    far = observation([(1, 1, 30, 20, 45, 40, 20.0)])
    hidden = observation([(1, 1, 30, 20, 45, 40, 20.0), (2, 1, 37, 15, 60, 45, 10.0)])

    def variance(o):
        rng = np.random.default_rng(0)
        return np.mean([look(o, rng).graph.position_variance.max() for _ in range(50)])

    assert variance(near) < variance(far) < variance(hidden)


def test_confident_mistakes_happen_but_rarely():
    look = SimulatedPerception(CLASSES, SimulatedPerceptionParams(false_positives=0, miss_rate=0))
    o, rng = observation([(1, 1, 30, 20, 45, 40, 10.0)]), np.random.default_rng(0)
    wrong = np.mean([look(o, rng).graph.attributes[0].argmax() != 1 for _ in range(2000)])
    assert 0.0 < wrong < 0.1


def test_false_positives_come_with_a_box():
    look = SimulatedPerception(CLASSES, SimulatedPerceptionParams(false_positives=3.0, miss_rate=0))
    o, rng = observation([(1, 1, 30, 20, 45, 40, 10.0)]), np.random.default_rng(0)
    sizes = [len(look(o, rng)) for _ in range(300)]
    assert np.mean(sizes) == pytest.approx(4.0, abs=0.3)
    found = look(o, rng)
    assert (found.boxes[:, 2:] > found.boxes[:, :2]).all()


def test_same_stream_same_detections():
    look, o = SimulatedPerception(CLASSES), observation([(1, 1, 30, 20, 45, 40, 10.0)])
    a, b = (look(o, np.random.default_rng(5)).graph.positions for _ in range(2))
    np.testing.assert_array_equal(a, b)


def test_needs_privileged_images():
    with pytest.raises(ValueError, match="simulated perception needs the observation's 'depth'"):
        SimulatedPerception(CLASSES)({"image": np.zeros((4, 4, 3))}, np.random.default_rng(0))


def test_bad_parameters_are_named():
    with pytest.raises(ValueError, match=r"SimulatedPerceptionParams.depth_noise .* got -1"):
        SimulatedPerceptionParams(depth_noise=-1)
