"""The perception benchmark's figures on cases whose answer is known, and one run from end to end."""

import numpy as np
import pytest

from covis.agents.perception.weights import Calibration, variance_features
from covis.evaluation.perception_benchmark import ence, exact_spearman, perception_benchmark, row, shift, spearman
from covis.evaluation.perception_images import PerceptionTarget
from covis.evaluation.perception_tally import MIN_PIXELS, CocoRecords, Tally, count, match_masks
from covis.evaluation.perception_training import calibrate
from covis.matching import ObjectGraph


def scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Instances (60, 80) of three objects, their masks and pixels; the last object is too small to count."""
    instances = np.full((60, 80), -1, np.int32)
    instances[5:25, 5:25] = 0
    instances[30:50, 40:70] = 1
    instances[55:58, 5:10] = 2
    masks = np.stack([instances == i for i in range(3)])
    return instances, masks, masks.sum(axis=(1, 2))


def test_masks_go_to_objects_one_to_one_best_first():
    instances, masks, pixels = scene()
    half = masks[0].copy()
    half[:, :12] = False
    found = np.stack([masks[1], masks[0], masks[0], half])
    assert match_masks(found, instances, pixels).tolist() == [1, 0, -1, -1]
    assert match_masks(np.zeros((0, 60, 80), bool), instances, pixels).shape == (0,)


def test_ap50_of_perfect_masks_is_one_and_false_ones_cost():
    pytest.importorskip("pycocotools")
    instances, masks, pixels = scene()
    perfect = CocoRecords()
    perfect.add(instances, pixels, masks[:2], np.array([0.9, 0.8]))
    assert perfect.ap50() == pytest.approx(1)
    half = CocoRecords()
    half.add(instances, pixels, masks[:1], np.array([0.9]))
    assert half.ap50() == pytest.approx(0.5, abs=0.01)
    nothing = np.zeros_like(masks[0])
    nothing[0:20, 50:70] = True
    false = CocoRecords()
    false.add(instances, pixels, np.stack([nothing, masks[0], masks[1]]), np.array([0.9, 0.8, 0.7]))
    assert false.ap50() == pytest.approx(2 / 3, abs=0.01)


def test_ap50_neither_wants_nor_forbids_small_objects():
    pytest.importorskip("pycocotools")
    instances, masks, pixels = scene()
    assert pixels[2] < MIN_PIXELS
    records = CocoRecords()
    records.add(instances, pixels, masks, np.array([0.8, 0.7, 0.9]))
    assert records.ap50() == pytest.approx(1)
    only_small = CocoRecords()
    only_small.add(instances, np.array([0, 0, pixels[2]]), masks[2:], np.array([0.5]))
    assert only_small.ap50() is None


def gaussian_tally(scale: float, n: int = 4000, seed: int = 0) -> Tally:
    """Errors whose variance is `scale` times what is reported."""
    rng = np.random.default_rng(seed)
    u = np.exp(rng.normal(0, 1, n))
    across = np.exp(rng.normal(-3, 0.5, n))
    lateral = np.linalg.norm(rng.normal(size=(n, 2)) * np.sqrt(4 * across)[:, None], axis=1)
    p = rng.dirichlet([1, 1, 1], n)
    true = np.array([rng.choice(3, p=q) for q in p])
    distance = rng.uniform(5, 20, n)
    error = np.sqrt(scale * u) * rng.standard_normal(n)
    return Tally(
        objects=n,
        detections=n,
        images=n,
        error=[error],
        u=[u],
        v=[np.full(n, 0.1)],
        across=[across],
        lateral=[lateral],
        attributes=[p],
        true_class=[true],
        right_class=[p.argmax(1) == true],
        distance=[distance],
        true_distance=[distance - error],
        depth_ratio=[np.ones(n)],
        size=[rng.uniform(60, 600, n)],
        known=[variance_features(u / distance**2, np.full(n, 0.2), np.ones(n), distance, rng.uniform(60, 600, n))],
    )


def test_ence_is_small_when_calibrated_and_known_when_not():
    good, bad = gaussian_tally(1), gaussian_tally(4)
    assert ence(good.of("u"), good.of("error") ** 2) < 0.06
    assert ence(bad.of("u"), bad.of("error") ** 2) == pytest.approx(1, abs=0.1)
    assert ence(np.ones(3), np.ones(3)) is None


def test_calibration_recovers_the_factors():
    tallies = [gaussian_tally(4), gaussian_tally(4, seed=1)]
    found = calibrate(tallies)
    for tally in tallies:
        np.testing.assert_allclose(found.variance_factor(tally.of("known")), 4, rtol=0.3)
        assert np.median(found.variance_factor(tally.of("known"))) == pytest.approx(4, rel=0.1)
    assert found.centre == pytest.approx(4, rel=0.15)
    assert found.class_temperature == pytest.approx(1, rel=0.1)


def test_calibration_undoes_a_bias_of_scale():
    biased = gaussian_tally(1)
    biased.distance = [1.1 * d for d in biased.distance]
    biased.depth_ratio = [1.1 * r for r in biased.depth_ratio]
    biased.u = [1.21 * u for u in biased.u]
    found = calibrate([biased])
    assert found.scale == pytest.approx(1 / 1.1, rel=0.03)
    assert found.exponent == pytest.approx(1, abs=0.01)
    assert np.median(found.variance_factor(biased.of("known"))) == pytest.approx(1, rel=0.15)


def test_calibration_straightens_depths():
    bent = gaussian_tally(0.001)
    true = bent.true_distance[0]
    bent.distance = [1.2 * true**0.9 + bent.error[0]]
    bent.depth_ratio = [bent.distance[0] / true]
    found = calibrate([bent])
    np.testing.assert_allclose(found.scale * (1.2 * true**0.9) ** found.exponent, true, rtol=0.01)


def test_calibration_learns_that_doubtful_objects_err_more_than_reported():
    n = 4000
    biased = gaussian_tally(1, n)
    confidence = np.random.default_rng(3).uniform(0.1, 1, n)
    biased.error = [biased.error[0] / confidence]
    biased.true_distance = [biased.distance[0] - biased.error[0]]
    relative = biased.u[0] / biased.distance[0] ** 2
    biased.known = [variance_features(relative, np.full(n, 0.2), confidence, biased.distance[0], np.full(n, 300.0))]
    factor = calibrate([biased]).variance_factor(biased.known[0])
    assert np.corrcoef(np.log(factor), -np.log(confidence))[0, 1] > 0.95
    corrected, squared = factor * biased.u[0], biased.error[0] ** 2
    assert ence(corrected, squared) < 0.5 * ence(biased.u[0], squared)


def test_calibration_without_detections_changes_nothing():
    assert calibrate([Tally()]) == Calibration()


def test_exact_spearman_needs_variances_that_differ():
    rng = np.random.default_rng(0)
    alike, spread = np.exp(0.1 * rng.normal(size=3000)), np.exp(3 * rng.normal(size=3000))
    assert exact_spearman(alike) == pytest.approx(0, abs=0.1)
    assert exact_spearman(spread) > 0.7
    assert exact_spearman(np.ones(5)) is None


def test_spearman_of_orders():
    x = np.arange(10.0)
    assert spearman(x, x**3) == pytest.approx(1)
    assert spearman(x, -x) == pytest.approx(-1)
    assert spearman(x, np.zeros(10)) is None
    assert spearman(x[:2], x[:2]) is None


def test_shift_compares_like_with_like():
    known, strange = gaussian_tally(1), gaussian_tally(1, seed=5)
    for found in (known, strange):
        found.true_distance = found.distance
    far = strange.of("true_distance") > 10
    strange.u = [np.where(far, 50.0, 2 * strange.of("u"))]
    strange.true_distance = [np.where(far, 500.0, strange.of("true_distance"))]  # no such objects are known
    found = shift(known, strange)
    assert found["u_ratio_matched"] == pytest.approx(2, rel=0.15)
    assert found["v_ratio_matched"] == pytest.approx(1)
    assert found["squared_error_ratio_matched"] == pytest.approx(1, rel=0.15)
    assert 0 < found["matched_objects"] < 4000
    assert shift(known, Tally())["u_ratio_matched"] is None


def test_a_row_without_detections_has_no_figures():
    empty = row(PerceptionTarget("multi_robot", ood=True), Tally())
    assert empty["target"] == "multi_robot"
    assert empty["ood"] is True
    assert empty["class_accuracy"] is None
    assert empty["depth_abs_rel"] is None


def test_names_of_targets():
    assert PerceptionTarget("connected_driving", map="racetrack").name == "connected_driving:racetrack"
    assert PerceptionTarget("target_localization", "hard").name == "target_localization:hard"


def test_counting_one_image():
    pytest.importorskip("torch")
    pytest.importorskip("pycocotools")
    from covis.agents.perception.detections import Detections
    from covis.agents.perception.learned import Seen
    from covis.evaluation.perception_images import Image

    instances, masks, pixels = scene()
    centres = np.array([[0.0, 0, 4], [1, 0, 5], [0, 0, 9]])
    graph = ObjectGraph(
        positions=np.array([[0.0, 0, 5], [1.1, 0, 5]]),
        attributes=np.array([[0.9, 0.1], [0.8, 0.2]]),
        position_variance=np.array([1.0, 0.1]),
        attribute_variance=np.array([0.1, 0.2]),
    )
    seen = Seen(
        Detections(graph, np.zeros((2, 4)), masks[:2]),
        np.array([0.9, 0.8]),
        pixels[:2],
        graph.positions[:, 2],
        np.ones(2),
        np.zeros(2),
        {"all": 3.0},
    )
    out = Tally()
    count(out, Image({}, instances, pixels, np.array([0, 1, 0]), centres), seen, 0.5)
    assert (out.objects, out.detections, out.images) == (2, 2, 1)
    assert out.of("right_class").tolist() == [True, False]
    np.testing.assert_allclose(out.of("depth_ratio"), [1.25, 1.0])
    assert out.of("error")[0] == pytest.approx(1)
    figures = row(PerceptionTarget("multi_robot"), out)
    assert figures["depth_abs_rel"] == pytest.approx(0.125)
    assert figures["ap50"] == pytest.approx(1)
    assert figures["recall"] == 1
    assert figures["precision"] == 1


def test_untrained_eyes_give_rows_for_a_known_and_a_held_out_target():
    torch = pytest.importorskip("torch")
    for package in ("safetensors", "pycocotools", "pybullet", "pettingzoo"):
        pytest.importorskip(package)
    from covis.agents.perception.frames import joint_classes
    from covis.agents.perception.network import Eyes, NetworkParams
    from covis.agents.perception.weights import Weights

    params = NetworkParams(joint_classes(), widths=(8, 8, 8, 8, 8), blocks=(0, 0, 0, 0), neck=16, head=16)
    torch.manual_seed(0)
    weights = Weights(Eyes(params).state_dict(), params.to_dict())
    targets = [PerceptionTarget("target_localization"), PerceptionTarget("target_localization", "hard", ood=True)]
    done = []
    rows = perception_benchmark(targets, weights=weights, images=3, samples=2, progress=lambda *at: done.append(at))
    assert [r["ood"] for r in rows] == [False, True]
    assert done[-1] == (6, 6)
    for r in rows:
        assert r["images"] == 3
        assert r["objects"] > 0
        assert {"ap50", "class_accuracy", "depth_abs_rel", "depth_spearman", "depth_only_spearman", "ence"} <= set(r)
    assert "u_ratio_matched" in rows[1]
