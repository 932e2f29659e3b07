"""The learned eyes: kernels against plain references, Monte Carlo dropout, weights on disk, bad input."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

from covis.agents.perception import make_perceptor  # noqa: E402
from covis.agents.perception import weights as stored  # noqa: E402
from covis.agents.perception.decode import (  # noqa: E402
    draw_masks,
    find_peaks,
    full_masks,
    mask_quality,
    spread_pixels,
    suppress,
)
from covis.agents.perception.detections import ray_covariances, ray_frames  # noqa: E402
from covis.agents.perception.kinds import kind, open_eyes  # noqa: E402
from covis.agents.perception.learned import LearnedPerception, LearnedPerceptionParams, build, camera_height  # noqa: E402
from covis.agents.perception.network import (  # noqa: E402
    Eyes,
    Geometry,
    NetworkParams,
    bilinear,
    boxes_from,
    dropout,
    mask_logits,
    normalised,
)
from covis.agents.perception.targets import draw_heat, object_table, points_around  # noqa: E402
from covis.envs.scenes import parallel_env  # noqa: E402

CLASSES = ("car", "van", "husky", "crate")
TINY = NetworkParams(CLASSES, widths=(8, 8, 16, 16, 16), blocks=(1, 0, 0, 0), neck=16, head=16, embedding=4)
STORED = Path(__file__).parents[1] / "data" / "learned_prediction.npz"


@pytest.fixture(autouse=True)
def one_thread():
    """Small tensors gain nothing from threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def tiny_weights(seed: int = 0, params: NetworkParams = TINY) -> stored.Weights:
    """An untrained network that sees something: its heat map is lifted."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = Eyes(params)
        last = network.to_heat[-1]
        torch.nn.init.normal_(last.weight, std=0.5)
        torch.nn.init.constant_(last.bias, 0.0)
        torch.nn.init.normal_(network.object_out.weight, std=0.1)
        with torch.no_grad():
            network.object_out.bias[7 + params.mask_weights] = 1.0  # the last number of the mask heads: all inside
    return stored.Weights(network.state_dict(), params.to_dict())


def familiar_weights() -> stored.Weights:
    d = 3 * TINY.neck
    familiar = stored.Familiar(np.zeros(d, np.float32), np.eye(d, dtype=np.float32))
    return replace(tiny_weights(), calibration=stored.Calibration(familiar=familiar))


def observation(seed: int = 0, width: int = 128, height: int = 96) -> dict:
    rng = np.random.default_rng(seed)
    image = np.repeat(np.repeat(rng.integers(0, 255, (height // 8, width // 8, 3)), 8, 0), 8, 1).astype(np.uint8)
    K = np.array([[100.0, 0, width / 2], [0, 100.0, height / 2], [0, 0, 1]], dtype=np.float32)
    return {"image": image, "intrinsics": K, "up": np.array([0, -1, 0], dtype=np.float32)}


def eyes(classes=CLASSES, samples: int = 8, **options) -> LearnedPerception:
    params = LearnedPerceptionParams(samples=samples, score=0.1, min_pixels=1)
    return LearnedPerception(classes, tiny_weights(), params, **options)


# Kernels


def test_object_table_equals_a_plain_reference():
    rng = np.random.default_rng(3)
    instances = np.repeat(np.repeat(rng.integers(-1, 5, (6, 8)), 4, 0), 4, 1).astype(np.int32)
    table = object_table(instances, 6)
    for i in range(6):
        v, u = np.nonzero(instances == i)
        assert table.pixels[i] == len(u)
        assert set(table.order[table.start[i] : table.start[i + 1]]) == set(v * 32 + u)
        if len(u) == 0:
            assert not table.boxes[i].any()
            continue
        np.testing.assert_array_equal(table.boxes[i], [u.min(), v.min(), u.max() + 1, v.max() + 1])
        away = (u - u.mean()) ** 2 + (v - v.mean()) ** 2
        column, row = (table.centres[i] - 0.5).astype(int)
        assert instances[row, column] == i
        assert (column - u.mean()) ** 2 + (row - v.mean()) ** 2 == pytest.approx(away.min())


def test_mirrored_table_is_the_table_of_the_mirrored_image():
    rng = np.random.default_rng(4)
    instances = rng.integers(-1, 3, (12, 20)).astype(np.int32)
    mirrored = object_table(instances, 3).mirrored(20)
    direct = object_table(np.ascontiguousarray(instances[:, ::-1]), 3)
    np.testing.assert_array_equal(mirrored.boxes, direct.boxes)
    for i in range(3):
        part = slice(mirrored.start[i], mirrored.start[i + 1])
        assert set(mirrored.order[part]) == set(direct.order[part])


def test_heat_is_one_at_centres_and_small_objects_neither_wanted_nor_forbidden():
    instances = np.full((40, 60), -1, np.int32)
    instances[4:16, 4:20] = 0
    instances[30:33, 50:53] = 1
    table = object_table(instances, 2)
    heat, weight = np.zeros((20, 30), np.float32), np.ones((20, 30), np.float32)
    draw_heat(heat, weight, table.centres, table.boxes, table.pixels, 20, 2)
    assert (heat == 1).sum() == 1
    row, column = np.unravel_index(heat.argmax(), heat.shape)
    np.testing.assert_array_equal(np.floor(table.centres[0] / 2), [column, row])
    assert weight[15, 25] == 0
    assert weight[row, column] == 1


def test_points_lie_in_the_image_and_half_of_them_near_the_object():
    instances = np.full((48, 64), -1, np.int32)
    instances[10:30, 50:64] = 0
    points = points_around(object_table(instances, 1), 0, 100, 64, 48, np.random.default_rng(0))
    assert points.min() > 0
    assert (points < [64, 48]).all()
    inside = instances[points[:, 1].astype(int), points[:, 0].astype(int)] == 0
    assert 0.3 < inside.mean() < 0.95


def test_peaks_are_local_maxima_and_equal_neighbours_give_one():
    heat = np.zeros((8, 9), np.float32)
    heat[2, 3], heat[2, 4], heat[5, 0], heat[7, 8] = 0.9, 0.9, 0.4, 0.1
    at, value = find_peaks(heat, 0.2)
    assert at.tolist() == [[2, 3], [5, 0]]
    np.testing.assert_allclose(value, [0.9, 0.4])


def test_mask_kernel_equals_the_torch_head():
    rng = np.random.default_rng(5)
    features = rng.normal(size=(12, 16, TINY.mask_channels)).astype(np.float32)
    weights = rng.normal(size=(3, TINY.mask_weights)).astype(np.float32)
    at = np.array([[5.0, 7.0], [20.0, 9.0], [31.0, 23.0]], np.float32)
    half = np.array([[6.0, 4.0], [9.0, 9.0], [3.0, 5.0]], np.float32)
    boxes = np.tile([0, 0, 16, 12], (3, 1))
    drawn = draw_masks(features, weights, TINY.mask_hidden, at, half, boxes, 2)
    v, u = np.meshgrid(np.arange(12) * 2 + 1.0, np.arange(16) * 2 + 1.0, indexing="ij")
    points = np.stack([u, v], axis=-1).reshape(1, -1, 2)
    coordinates = np.clip((points - at[:, None]) / half[:, None], -4, 4).astype(np.float32)
    expected = mask_logits(
        torch.from_numpy(weights),
        torch.from_numpy(features.reshape(1, -1, TINY.mask_channels)).expand(3, -1, -1),
        torch.from_numpy(coordinates),
        TINY,
    )
    np.testing.assert_allclose(drawn.reshape(3, -1), expected.numpy(), rtol=2e-4, atol=2e-3)


def test_masks_outside_their_boxes_stay_empty():
    logits = draw_masks(
        np.zeros((6, 6, TINY.mask_channels), np.float32),
        np.full((1, TINY.mask_weights), 1.0, np.float32),
        TINY.mask_hidden,
        np.array([[6.0, 6.0]], np.float32),
        np.array([[4.0, 4.0]], np.float32),
        np.array([[1, 2, 4, 5]]),
        2,
    )
    inside = np.zeros((6, 6), bool)
    inside[2:5, 1:4] = True
    np.testing.assert_array_equal(logits[0] > 0, inside)


def test_the_better_of_two_claims_to_one_thing_stays():
    logits = np.full((3, 10, 10), -20.0, np.float32)
    logits[0, 1:6, 1:6] = 3
    logits[1, 1:6, 1:7] = 4
    logits[2, 7:10, 7:10] = 5
    boxes = np.tile([0, 0, 10, 10], (3, 1))
    cells, quality = mask_quality(logits, boxes)
    assert cells.tolist() == [25, 30, 9]
    np.testing.assert_allclose(quality, 1 / (1 + np.exp([-3.0, -4.0, -5.0])))
    assert suppress(logits, boxes, cells, np.array([0.5, 0.9, 0.7]), 0.5, 0.75).tolist() == [1, 2]


def test_full_masks_share_no_pixel_and_have_tight_boxes():
    rng = np.random.default_rng(6)
    logits = rng.normal(size=(4, 12, 16)).astype(np.float32)
    masks, pixels, tight = full_masks(logits, np.tile([0, 0, 16, 12], (4, 1)), 24, 32)
    assert masks.sum(axis=0).max() == 1
    for i in range(4):
        v, u = np.nonzero(masks[i])
        assert pixels[i] == len(u)
        np.testing.assert_array_equal(tight[i], [u.min(), v.min(), u.max() + 1, v.max() + 1])


def test_spread_pixels_lie_in_their_masks_and_small_masks_repeat():
    masks = np.zeros((2, 10, 12), bool)
    masks[0, 2:8, 3:9] = True
    masks[1, 4, 4] = True
    pixels, tight = np.array([36, 1]), np.array([[3, 2, 9, 8], [4, 4, 5, 5]], float)
    spread = spread_pixels(masks, pixels, tight, 9)
    for i in range(2):
        at = spread[i].astype(int)
        assert masks[i, at[:, 1], at[:, 0]].all()
    assert len(np.unique(spread[0], axis=0)) == 9
    assert spread[0, :, 1].min() < 4
    assert spread[0, :, 1].max() > 6


def test_bilinear_equals_grid_sample():
    torch.manual_seed(0)
    maps = torch.randn(2, 6, 7, 3)
    pixels = torch.rand(20, 2) * torch.tensor([28.0, 24.0])
    image = torch.randint(0, 2, (20,))
    grid = (2 * pixels / torch.tensor([28.0, 24.0]) - 1)[:, None, None]
    expected = torch.nn.functional.grid_sample(
        maps.permute(0, 3, 1, 2)[image], grid, align_corners=False, padding_mode="border"
    )[:, :, 0, 0]
    torch.testing.assert_close(bilinear(maps, image, pixels, 4), expected, atol=1e-5, rtol=1e-5)


def test_geometry_maps_agree_with_rays():
    K = torch.tensor([[[90.0, 0, 30], [0, 90.0, 25], [0, 0, 1]]])
    up = torch.nn.functional.normalize(torch.tensor([[0.1, -1.0, 0.2]]))
    geometry = Geometry.of(K, up, torch.tensor([1.0]), torch.tensor([0.1]))
    maps = geometry.maps(50, 60)
    pixels = torch.tensor([[10.5, 20.5], [59.5, 0.5]])
    image = torch.zeros(2, dtype=torch.int64)
    rays = geometry.rays(image, pixels)
    for k, (u, v) in enumerate([(10, 20), (59, 0)]):
        torch.testing.assert_close(maps[0, :2, v, u], rays[k, :2])
        torch.testing.assert_close(maps[0, 2, v, u], 2 * geometry.elevation(image, rays)[k])


def test_boxes_are_read_from_their_centre():
    edges = torch.log(torch.tensor([[4.0, 6.0, 8.0, 10.0]]) / 16)
    torch.testing.assert_close(
        boxes_from(edges, torch.tensor([[50.0, 40.0]])), torch.tensor([[46.0, 34.0, 58.0, 50.0]])
    )


def test_dropout_keeps_the_mean_and_repeats_with_its_generator():
    x = torch.ones(20_000)
    a = dropout(x, 0.3, torch.Generator().manual_seed(1))
    assert a.mean() == pytest.approx(1, abs=0.03)
    assert (a == 0).float().mean() == pytest.approx(0.3, abs=0.02)
    torch.testing.assert_close(a, dropout(x, 0.3, torch.Generator().manual_seed(1)), rtol=0, atol=0)
    assert dropout(x, 0.0, None) is x


# The eyes


def test_detections_fit_the_observation_and_the_scene():
    look = eyes(classes=("husky", "crate"), samples=4)
    found = look(observation(), np.random.default_rng(0))
    n = len(found)
    assert n > 0
    assert found.graph.attributes.shape == (n, 2)
    np.testing.assert_allclose(found.graph.attributes.sum(axis=1), 1)
    assert (found.graph.position_variance > 0).all()
    assert found.graph.covariances.shape == (n, 3, 3)
    assert (np.linalg.eigvalsh(found.graph.covariances) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(found.graph.embedding, axis=1), 1, rtol=1e-5)
    assert found.masks.shape == (n, 96, 128)
    for mask, box in zip(found.masks, found.boxes, strict=True):
        v, u = np.nonzero(mask)
        np.testing.assert_array_equal(box, [u.min(), v.min(), u.max() + 1, v.max() + 1])
    assert set(look.last.milliseconds) == {"backbone", "masks", "classes", "depth", "graph"}


def test_position_uncertainty_runs_along_the_ray():
    graph = eyes()(observation(), np.random.default_rng(0)).graph
    ray = graph.positions / np.linalg.norm(graph.positions, axis=1)[:, None]
    along = np.einsum("ni,nij,nj->n", ray, graph.covariances, ray)
    np.testing.assert_allclose(along, graph.position_variance, rtol=1e-6)


def test_samples_differ_and_repeat_with_their_generator():
    look = eyes(samples=8)
    a, b, c = (look.see(observation(), np.random.default_rng(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(a.depth, b.depth)
    np.testing.assert_array_equal(a.detections.graph.attributes, b.detections.graph.attributes)
    assert (a.depth != c.depth).any()
    assert (a.depth_epistemic > 0).all()
    assert (a.depth_epistemic < a.depth_variance).all()


def test_one_sample_is_without_dropout_and_deterministic():
    look = eyes(samples=1)
    a, b = (look.see(observation(), np.random.default_rng(seed)) for seed in (0, 1))
    np.testing.assert_array_equal(a.depth, b.depth)
    np.testing.assert_array_equal(a.detections.graph.attributes, b.detections.graph.attributes)
    assert (a.depth_epistemic == 0).all()


def test_calibration_scales_depths_and_the_variance_along_each_axis():
    def always(factor: float) -> tuple[float, ...]:
        return (np.log(factor), *[0.0] * (stored.TERMS - 1))

    calibration = stored.Calibration(always(1.1), always(4.0), always(9.0), always(0.25))
    plain, scaled = tiny_weights(), replace(tiny_weights(), calibration=calibration)
    params = LearnedPerceptionParams(samples=2, score=0.1, min_pixels=1)
    a, b = (
        LearnedPerception(CLASSES, w, params)(observation(), np.random.default_rng(0)).graph for w in (plain, scaled)
    )
    np.testing.assert_allclose(b.positions, 1.1 * a.positions)
    np.testing.assert_allclose(b.position_variance, 1.21 * 4 * a.position_variance)
    frames = ray_frames(a.positions)
    before, after = (np.einsum("nki,nij,nlj->nkl", frames, graph.full_covariances(), frames) for graph in (a, b))
    np.testing.assert_allclose(after, 1.21 * np.sqrt(np.outer([4, 9, 0.25], [4, 9, 0.25])) * before, atol=1e-9)


def test_strange_objects_are_less_sure():
    def strange(weight: float) -> stored.Calibration:
        d = 3 * TINY.neck
        familiar = stored.Familiar(np.zeros(d, np.float32), 10 * np.eye(d, dtype=np.float32))
        return stored.Calibration(along=(*[0.0] * (stored.TERMS - 1), weight), familiar=familiar)

    params = LearnedPerceptionParams(samples=2, score=0.1, min_pixels=1)
    seen = [
        LearnedPerception(CLASSES, replace(tiny_weights(), calibration=calibration), params).see(
            observation(), np.random.default_rng(0)
        )
        for calibration in (stored.Calibration(), strange(1.0))
    ]
    expected = (10 * seen[0].backbone) ** 2
    np.testing.assert_allclose(
        seen[1].features[:, -1], np.clip(np.log(expected.mean(axis=1)), -stored.FARTHEST, stored.FARTHEST), rtol=1e-5
    )
    assert (seen[0].features[:, -1] == 0).all()
    ratio = seen[1].depth_variance / seen[0].depth_variance
    np.testing.assert_allclose(np.log(ratio), seen[1].features[:, -1], rtol=1e-5)


def test_what_differs_between_samples_is_unknown_of_a_single_one():
    def features(epistemic: float, class_epistemic: float) -> np.ndarray:
        one = np.ones(1)
        return stored.calibration_features(
            depth=8 * one,
            depth_variance=0.2 * one,
            depth_epistemic=epistemic * one,
            centre_variance=0.02 * one,
            confidence=one,
            size=np.full((1, 2), 30.0),
            class_epistemic=class_epistemic * one,
            depth_spread=0.001 * one,
            box_overlap=0.8 * one,
            strangeness=one,
        )

    usual = stored.QUANTITIES["epistemic"] * 0.2, stored.ADDED["class epistemic"]
    np.testing.assert_allclose(features(0, 0), features(*usual), atol=1e-12)
    assert (features(0.1, 0.01) != features(*usual)).any()


def test_covariances_lie_along_the_ray_and_the_axes_of_the_image():
    rng = np.random.default_rng(0)
    positions = np.concatenate([rng.normal(size=(5, 3)) + [0, 0, 4], [[0, 0, 2]]])
    frames = ray_frames(positions)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape), atol=1e-12)
    np.testing.assert_allclose(frames[-1], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(frames[:, 0], positions / np.linalg.norm(positions, axis=1)[:, None])
    np.testing.assert_allclose(frames[:, 1, 1], 0, atol=1e-12)
    C = ray_covariances(positions, np.full(6, 4.0), np.tile([9.0, 0.25], (6, 1)))
    np.testing.assert_allclose(C[-1], np.diag([9, 0.25, 4]), atol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(C), np.tile([0.25, 4, 9], (6, 1)))


def test_folding_the_normalisation_changes_nothing():
    folded = build(tiny_weights())
    plain = Eyes(TINY)
    plain.load_state_dict(tiny_weights().tensors)
    plain.eval()
    seen = observation()
    height, height_std = torch.tensor([1.0]), torch.tensor([0.1])
    geometry = Geometry.of(
        torch.from_numpy(seen["intrinsics"][None]), torch.from_numpy(seen["up"][None]), height, height_std
    )
    with torch.inference_mode():
        x = normalised(torch.from_numpy(seen["image"][None]))
        torch.testing.assert_close(folded(x, geometry).mask, plain(x, geometry).mask, atol=1e-4, rtol=1e-4)


def test_an_image_without_objects_gives_an_empty_graph():
    look = LearnedPerception(CLASSES, tiny_weights(), LearnedPerceptionParams(score=1.0))
    found = look(observation(), np.random.default_rng(0))
    assert len(found) == 0
    assert found.boxes.shape == (0, 4)
    assert found.graph.attributes.shape == (0, 4)


def test_a_robot_reads_its_height_and_how_sure_it_is_from_its_pose():
    tilted = np.array([[0, 0.6, 0.8, 1], [-1, 0, 0, 2], [0, -0.8, 0.6, 0.7], [0, 0, 0, 1]])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag([9.0, 0.04, 0.09])  # camera frame: right, down, forward
    height, std = camera_height({"pose": tilted, "pose_covariance": covariance})
    assert height == 0.7
    assert std == pytest.approx(np.sqrt(0.64 * 0.04 + 0.36 * 0.09))
    assert camera_height({}) == (0.0, np.inf)
    with pytest.raises(ValueError, match="pose must be finite"):
        camera_height({"pose": np.full((4, 4), np.nan)})
    with pytest.raises(ValueError, match="pose_covariance"):
        camera_height({"pose": tilted, "pose_covariance": np.zeros(6)})


def test_the_height_moves_the_depth_as_far_as_it_can_be_trusted():
    look = eyes(samples=1)
    pose = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 2.0], [0, 0, 0, 1.0]])
    sure = {"pose": pose, "pose_covariance": np.zeros((6, 6))}
    unsure = {"pose": pose, "pose_covariance": 1e8 * np.eye(6)}
    depths = [look.see(observation() | more, np.random.default_rng(0)).depth for more in ({}, unsure, sure)]
    np.testing.assert_allclose(depths[0], depths[1], rtol=1e-4)
    assert np.abs(depths[0] / depths[2] - 1).max() > 1e-3


# Weights and bad input


def test_weights_come_back_as_they_were_saved(tmp_path):
    terms = (tuple(k * i for i in range(stored.TERMS)) for k in (0.1, 0.2, 0.3, 0.4))
    familiar = stored.Familiar(np.arange(3, dtype=np.float32), np.eye(3, dtype=np.float32))
    saved = replace(tiny_weights(), calibration=stored.Calibration(*terms, 1.5, familiar), notes={"minutes": 1})
    stored.save(saved, tmp_path)
    loaded = stored.load(tmp_path)
    assert loaded.classes == CLASSES
    assert loaded.calibration == saved.calibration
    np.testing.assert_array_equal(loaded.calibration.familiar.mean, familiar.mean)
    np.testing.assert_array_equal(loaded.calibration.familiar.whitening, familiar.whitening)
    assert loaded.notes == {"minutes": 1}
    for name, tensor in saved.tensors.items():
        torch.testing.assert_close(loaded.tensors[name], tensor, rtol=0, atol=0)
    assert NetworkParams.from_dict(dict(loaded.network)) == TINY


@pytest.mark.parametrize("name", [stored.TENSORS, stored.FAMILIAR])
def test_altered_weights_are_refused(tmp_path, name):
    stored.save(familiar_weights(), tmp_path)
    path = tmp_path / name
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(stored.WeightsError, match="altered"):
        stored.load(tmp_path)


@pytest.mark.parametrize("name", [stored.TENSORS, stored.MANIFEST, stored.FAMILIAR])
def test_missing_weights_are_named(tmp_path, name):
    stored.save(familiar_weights(), tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(stored.WeightsError, match=name):
        stored.load(tmp_path)


def test_another_format_is_refused(tmp_path):
    stored.save(tiny_weights(), tmp_path)
    path = tmp_path / stored.MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": 99}))
    with pytest.raises(stored.WeightsError, match="version"):
        stored.load(tmp_path)
    path.write_text("no json")
    with pytest.raises(stored.WeightsError, match="cannot be read"):
        stored.load(tmp_path)


def test_weights_with_an_older_calibration_say_how_to_renew_it(tmp_path):
    stored.save(tiny_weights(), tmp_path)
    path = tmp_path / stored.MANIFEST
    old = {"version": stored.SAME_TENSORS[0], "calibration": {"scale": 1.0}}
    path.write_text(json.dumps(json.loads(path.read_text()) | old))
    with pytest.raises(stored.WeightsError, match="--calibrate"):
        stored.load(tmp_path)
    assert stored.load(tmp_path, calibrated=False).calibration == stored.Calibration()
    old = {"version": 4, "calibration": {"class_temperature": 0.9, "along": [1.0]}}
    path.write_text(json.dumps(json.loads(path.read_text()) | old))
    assert stored.load(tmp_path, calibrated=False).calibration == stored.Calibration(class_temperature=0.9)


def test_unknown_classes_are_named():
    with pytest.raises(ValueError, match="submarine"):
        LearnedPerception(("car", "submarine"), tiny_weights())
    with pytest.raises(ValueError, match="class"):
        LearnedPerception((), tiny_weights())


def test_weights_of_an_unknown_network_are_refused():
    strange = replace(tiny_weights(), network=TINY.to_dict() | {"kind": "crystal ball"})
    with pytest.raises(ValueError, match="crystal ball"):
        open_eyes(strange, CLASSES)
    with pytest.raises(ValueError, match="compact, maskrcnn"):
        kind("")


def test_weights_of_a_network_that_is_not_installed_say_what_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchvision", None)
    monkeypatch.delitem(sys.modules, "covis.agents.perception.maskrcnn", raising=False)
    with pytest.raises(stored.WeightsError, match=r"covis\[torchvision\]"):
        open_eyes(replace(tiny_weights(), network={"kind": "maskrcnn", "classes": list(CLASSES)}), CLASSES)


def test_eyes_of_a_folder(tmp_path):
    env = parallel_env("target_localization", width=128, height=96)
    with pytest.raises(stored.WeightsError, match="needs"):
        make_perceptor(f"learned:{tmp_path}", env)
    with pytest.raises(ValueError, match="learned:FOLDER"):
        make_perceptor("learned:", env)
    names = (*env.classes, "unicorn")
    stored.save(tiny_weights(params=replace(TINY, classes=names)), tmp_path)
    eyes = make_perceptor(f"learned:{tmp_path}", env)
    assert isinstance(eyes, LearnedPerception)
    assert eyes.network.params.classes == names


@pytest.mark.parametrize("samples", [0, -1, 2.5])
def test_fewer_than_one_sample_is_refused(samples):
    with pytest.raises(ValueError, match="samples"):
        LearnedPerceptionParams(samples=samples)


def test_an_unknown_precision_is_refused():
    with pytest.raises(ValueError, match="precision must be one of auto, bfloat16, float32, got 'int8'"):
        LearnedPerceptionParams(precision="int8")


def test_only_what_runs_once_per_image_computes_in_bfloat16():
    params = LearnedPerceptionParams(precision="bfloat16")
    types = {name: p.dtype for name, p in LearnedPerception(CLASSES, tiny_weights(), params).network.named_parameters()}
    heads = ("object_", "class_", "depth_")
    assert {t for name, t in types.items() if name.startswith(heads)} == {torch.float32}
    assert {t for name, t in types.items() if not name.startswith(heads)} == {torch.bfloat16}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": np.zeros((96, 128, 3), np.float32)}, "uint8"),
        ({"image": np.zeros((96, 128), np.uint8)}, "shape"),
        ({"image": np.zeros((90, 127, 3), np.uint8)}, "multiples of 4"),
        ({"image": np.zeros((32, 32, 3), np.uint8)}, "at least 64"),
        ({"intrinsics": np.full((3, 3), np.nan)}, "intrinsics must be finite"),
        ({"up": np.zeros(2)}, "up must be finite"),
        ({"pose": np.eye(4)}, "pose_covariance"),
    ],
)
def test_wrong_images_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        eyes()(observation() | change, np.random.default_rng(0))


def test_a_wrong_size_or_no_image_is_refused():
    with pytest.raises(ValueError, match="320x240"):
        eyes(image_size=(320, 240))(observation(), np.random.default_rng(0))
    without = observation()
    del without["image"]
    with pytest.raises(ValueError, match="image"):
        eyes()(without, np.random.default_rng(0))


@pytest.mark.skipif(
    not (stored.SHIPPED / stored.MANIFEST).is_file() or not STORED.is_file(), reason="no weights in this tree"
)
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_shipped_weights_reproduce_a_stored_prediction(precision):
    with np.load(STORED) as kept:
        seen = {name: kept[name] for name in ("image", "intrinsics", "up", "pose", "pose_covariance")}
        params = LearnedPerceptionParams(samples=1, precision=precision)
        look = LearnedPerception(kept["classes"].tolist(), params=params)
        found = look(seen, np.random.default_rng(0))
        assert len(found) == len(kept["positions"]) > 3
        # Of two that are equally sure either may come first.
        order, before = np.argsort(found.boxes[:, 0]), np.argsort(kept["boxes"][:, 0])
        np.testing.assert_allclose(found.graph.positions[order], kept["positions"][before], rtol=0.02, atol=0.02)
        np.testing.assert_allclose(found.graph.attributes[order], kept["attributes"][before], atol=0.02)
        np.testing.assert_allclose(found.boxes[order], kept["boxes"][before], atol=2)
