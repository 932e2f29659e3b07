"""The perception benchmark's figures on cases whose answer is known, and one run from end to end."""

import numpy as np
import pytest
from typer.testing import CliRunner

from covis.agents.perception.weights import TERMS, Calibration, Familiar, calibration_features, with_strangeness
from covis.evaluation.perception_benchmark import (
    consistency,
    ence,
    exact_spearman,
    perception_benchmark,
    row,
    shift,
    shift_columns,
    spearman,
)
from covis.evaluation.perception_images import PerceptionTarget
from covis.evaluation.perception_tally import MIN_PIXELS, CocoRecords, Tally, count, match_masks
from covis.evaluation.perception_training import calibrate
from covis.matching import ObjectGraph
from covis.scripts.main import app


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


def gaussian_tally(
    scale: float | np.ndarray, n: int = 4000, seed: int = 0, across: tuple[float, float] = (4.0, 0.25)
) -> Tally:
    """Errors whose variance along the ray is `scale` times what is reported, and `across` times across it."""
    rng = np.random.default_rng(seed)
    distance = rng.uniform(5, 20, n)
    u = distance**2 * np.exp(rng.normal(-6, 0.5, n))
    lateral = np.exp(rng.normal(-3, 0.5, n))
    p = rng.dirichlet([1, 1, 1], n)
    true = np.array([rng.choice(3, p=q) for q in p])
    variances = np.stack([u, lateral, lateral], axis=1)
    factors = np.stack([np.broadcast_to(scale, n), *(np.full(n, x) for x in across)], axis=1)
    offset = np.sqrt(factors * variances) * rng.standard_normal((n, 3))
    size = rng.uniform(10, 100, (n, 2))
    features = known(u, distance, np.ones(n), size)
    return Tally(
        objects=n,
        detections=n,
        images=n,
        counts=[np.ones(n, bool)],
        error=[-offset[:, 0]],
        u=[u],
        v=[np.full(n, 0.1)],
        u_epistemic=[0.2 * u],
        v_epistemic=[np.full(n, 0.01)],
        offset=[offset],
        variances=[variances],
        attributes=[p],
        true_class=[true],
        right_class=[p.argmax(1) == true],
        distance=[distance],
        true_distance=[distance + offset[:, 0]],
        depth_ratio=[np.ones(n)],
        size=[size.prod(axis=1)],
        features=[features],
    )


def known(u: np.ndarray, distance: np.ndarray, confidence: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Features of objects whose depths have the variances u (n,)."""
    centre_variance = np.full(len(u), 0.02)
    return calibration_features(
        depth=distance,
        depth_variance=u,
        depth_epistemic=0.2 * u,
        centre_variance=centre_variance,
        confidence=confidence,
        size=size,
        class_epistemic=np.full(len(u), 1e-4),
        depth_spread=np.full(len(u), 0.001),
        box_overlap=np.full(len(u), 0.8),
        strangeness=np.ones(len(u)),
    )


def test_ence_is_small_when_calibrated_and_known_when_not():
    good, bad = gaussian_tally(1), gaussian_tally(4)
    assert ence(good.of("u"), good.of("error") ** 2) < 0.06
    assert ence(bad.of("u"), bad.of("error") ** 2) == pytest.approx(1, abs=0.1)
    assert ence(np.ones(3), np.ones(3)) is None


def test_calibration_recovers_the_factors_of_every_axis():
    tallies = [gaussian_tally(4), gaussian_tally(4, seed=1)]
    found = calibrate(tallies)
    for tally in tallies:
        factors = found.factors(tally.of("features"))
        np.testing.assert_allclose(np.median(factors, axis=0), [1, 4, 4, 0.25], rtol=0.1)
        np.testing.assert_allclose(factors, np.broadcast_to([1, 4, 4, 0.25], factors.shape), rtol=0.5)
    assert found.class_temperature == pytest.approx(1, rel=0.1)


def test_calibration_undoes_a_bias_of_scale():
    biased = gaussian_tally(1)
    biased.distance = [1.1 * d for d in biased.distance]
    biased.offset[0][:, 0] = biased.true_distance[0] - biased.distance[0]
    biased.variances = [1.21 * v for v in biased.variances]
    found = calibrate([biased]).factors(biased.of("features"))
    np.testing.assert_allclose(found[:, 0], 1 / 1.1, rtol=0.03)
    assert np.median(found[:, 1]) == pytest.approx(1, rel=0.15)


def test_calibration_straightens_depths():
    bent = gaussian_tally(0.001)
    true = bent.true_distance[0]
    bent.distance = [1.2 * true**0.9]
    bent.offset[0][:, 0] = true - bent.distance[0]
    n = len(true)
    bent.features = [known(bent.u[0], bent.distance[0], np.ones(n), np.full((n, 2), 30.0))]
    found = calibrate([bent])
    np.testing.assert_allclose(found.factors(bent.features[0])[:, 0] * bent.distance[0], true, rtol=0.01)


def test_calibration_learns_that_doubtful_objects_err_more_than_reported():
    n = 4000
    confidence = np.random.default_rng(3).uniform(0.1, 1, n)
    biased = gaussian_tally(confidence**-2, n)
    biased.features = [known(biased.u[0], biased.distance[0], confidence, np.full((n, 2), 30.0))]
    factor = calibrate([biased]).factors(biased.features[0])[:, 1]
    assert np.corrcoef(np.log(factor), -np.log(confidence))[0, 1] > 0.95
    corrected, squared = factor * biased.u[0], biased.error[0] ** 2
    assert ence(corrected, squared) < 0.5 * ence(biased.u[0], squared)


def test_calibration_learns_that_strange_objects_err_more_than_reported():
    rng = np.random.default_rng(4)
    backbone = rng.normal(size=(4000, 6)) * np.exp(rng.normal(0, 0.5, (4000, 1)))
    familiar = Familiar.of(backbone, np.ones(4000))
    strange = familiar.strangeness(backbone)
    assert strange.mean() == pytest.approx(1, rel=0.1)
    plain = gaussian_tally(np.clip(strange, 0.05, 20), 4000)
    plain.backbone = [backbone]
    found = calibrate([plain])
    features = with_strangeness(plain.features[0], found.familiar.strangeness(backbone))
    assert np.corrcoef(np.log(found.factors(features)[:, 1]), np.log(strange))[0, 1] > 0.95
    assert calibrate([gaussian_tally(1)]).familiar is None


def test_calibration_uses_what_does_not_count_in_the_figures():
    small = gaussian_tally(9)
    small.counts = [np.zeros(4000, bool)]
    assert len(small.of("u")) == 0
    assert np.median(calibrate([small]).factors(small.of("features", every=True))[:, 1]) == pytest.approx(9, rel=0.1)


def test_nees_by_axis():
    found = consistency(gaussian_tally(1))
    assert found["nees_along"] == pytest.approx(1, rel=0.1)
    assert found["nees_horizontal"] == pytest.approx(4, rel=0.1)
    assert found["nees_vertical"] == pytest.approx(0.25, rel=0.1)
    assert found["nees"] == pytest.approx((1 + 4 + 0.25) / 3, rel=0.1)
    assert 0.8 * found["nees"] < found["nees_without_1_percent"] < found["nees"]
    assert consistency(Tally())["nees"] is None


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
    strange.u_epistemic = [strange.u_epistemic[0] * 3]
    strange.v_epistemic = [strange.v_epistemic[0] * 4]
    found = shift(known, strange)
    assert found["u_epistemic_ratio_matched"] == pytest.approx(3, rel=0.15)
    assert found["u_aleatoric_ratio_matched"] == pytest.approx((2 - 3 * 0.2) / 0.8, rel=0.15)
    assert found["v_epistemic_ratio_matched"] == pytest.approx(4)
    assert found["v_aleatoric_ratio_matched"] == pytest.approx((0.1 - 0.04) / 0.09)
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
        np.full(2, 0.25),
        np.array([0.01, 0.02]),
        np.zeros((2, TERMS)),
        None,
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
    np.testing.assert_allclose(out.of("offset")[0], [-1, 0, 0], atol=1e-12)
    assert out.of("variances")[0, 0] == pytest.approx(1.0)
    np.testing.assert_allclose(out.of("u_epistemic"), [0.25, 0.025])
    np.testing.assert_allclose(out.of("v_epistemic"), [0.01, 0.02])


def test_detections_that_meet_an_object_by_their_box_alone_count_for_calibration_only():
    pytest.importorskip("torch")
    pytest.importorskip("pycocotools")
    from covis.agents.perception.detections import Detections
    from covis.agents.perception.learned import Seen
    from covis.evaluation.perception_images import Image

    instances, masks, pixels = scene()
    frame = masks[:1].copy()
    frame[0, 7:23, 7:23] = False  # its box is the object's, its mask is not
    graph = ObjectGraph.from_positions(np.array([[0.0, 0, 5]]), attributes=np.array([[0.9, 0.1]]))
    seen = Seen(
        Detections(graph, np.array([[5.0, 5, 25, 25]]), frame),
        np.array([0.9]),
        frame.sum(axis=(1, 2)),
        np.array([5.0]),
        np.ones(1),
        np.zeros(1),
        np.zeros(1),
        np.zeros((1, TERMS)),
        np.ones((1, 5)),
        {"all": 3.0},
    )
    out = Tally()
    count(out, Image({}, instances, pixels, np.array([0, 1, 0]), np.array([[0.0, 0, 4]] * 3)), seen, 0.5)
    assert (out.detections, out.true_detections) == (1, 0)
    assert len(out.of("u")) == 0
    assert out.of("error", every=True) == pytest.approx([1.0])
    assert out.of("backbone", every=True).shape == (1, 5)


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
    assert {key for key, _ in shift_columns()} <= set(rows[1])
    assert rows[1]["known_ap50"] == rows[0]["ap50"]
    assert "known_ap50" not in rows[0]


def test_weights_are_calibrated_anew_without_training(tmp_path, monkeypatch):
    torch = pytest.importorskip("torch")
    for package in ("safetensors", "pycocotools", "pybullet", "pettingzoo"):
        pytest.importorskip(package)
    from covis.agents.perception import weights as stored
    from covis.agents.perception.frames import joint_classes
    from covis.agents.perception.network import Eyes, NetworkParams

    params = NetworkParams(joint_classes(), widths=(8, 8, 8, 8, 8), blocks=(0, 0, 0, 0), neck=16, head=16)
    torch.manual_seed(0)
    first = stored.Weights(
        Eyes(params).state_dict(), params.to_dict(), Calibration(class_temperature=2.0), {"minutes": 3}
    )
    stored.save(first, tmp_path)
    content = (tmp_path / stored.TENSORS).read_bytes()
    asked = []

    def tallies(weights, images, seed):
        asked.append((weights.calibration, images))
        return [(PerceptionTarget("target_localization"), gaussian_tally(4))]

    monkeypatch.setattr("covis.evaluation.perception_training._tallies", tallies)
    result = CliRunner().invoke(
        app, ["train", "perception", "--out", str(tmp_path), "--calibrate", "--calibration-images", "5"]
    )
    assert result.exit_code == 0, result.output
    assert asked == [(Calibration(class_temperature=2.0), 5)]
    renewed = stored.load(tmp_path)
    assert renewed.calibration.along[0] == pytest.approx(np.log(4), abs=1)
    # What was seen had been divided by 2 already, and was right.
    assert renewed.calibration.class_temperature == pytest.approx(2.0, rel=0.1)
    assert renewed.notes == {"minutes": 3, "calibration_images_per_scene": 5}
    assert (tmp_path / stored.TENSORS).read_bytes() == content
    result = CliRunner().invoke(app, ["train", "perception", "--out", str(tmp_path / "none"), "--calibrate"])
    assert result.exit_code == 2
    assert "eyes.json" in result.output.replace("\n", "")
