"""Training of the learned eyes: what is learned from, that it learns, that it resumes."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")
pytest.importorskip("highway_env")
pytest.importorskip("pybullet")

from covis.agents.perception import frames as source  # noqa: E402
from covis.agents.perception.frames import FrameSource, Variant, training_variants  # noqa: E402
from covis.agents.perception.losses import LossWeights, iou, losses, make_batch, overlap_loss  # noqa: E402
from covis.agents.perception.network import Eyes, NetworkParams  # noqa: E402
from covis.agents.perception.training import train  # noqa: E402
from covis.agents.perception.training_step import (  # noqa: E402
    CHECKPOINT,
    Pool,
    TrainingParams,
    fresh,
    load_checkpoint,
    save_checkpoint,
    schedule,
    train_step,
)

ROBOTS = (Variant("multi_robot", "easy"),)


def tiny() -> NetworkParams:
    return NetworkParams(
        source.joint_classes(), widths=(8, 16, 16, 16, 16), blocks=(0, 0, 0, 0), neck=16, head=32, embedding=8
    )


def quick(**changes) -> TrainingParams:
    values = {"minutes": None, "steps": 4, "pairs": 1, "pool_chunks": 2, "steps_per_chunk": 2, "variants": ROBOTS}
    return TrainingParams(**(values | changes))


@pytest.fixture(autouse=True)
def one_thread():
    """Small tensors gain nothing from threads, and threads that wait for each other cost other tests their time."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def pairs():
    return FrameSource(variants=ROBOTS, snapshots=2, width=160, height=120).chunk(0)


def test_classes_of_all_scenes_come_once():
    classes = source.joint_classes()
    assert len(set(classes)) == len(classes)
    assert {"car", "pedestrian", "husky", "crate"} <= set(classes)


def test_nothing_held_out_is_trained_on_and_the_splits_are_apart():
    variants = training_variants()
    assert not any(v.held_out for v in variants)
    assert {v.scene for v in variants} == set(source.SCENES)
    assert source.HELD_OUT_MAP not in {v.map for v in variants}
    assert source.HELD_OUT_PRESET not in {(v.scene, v.preset) for v in variants}
    assert len({source.TRAINING_KEY, source.VALIDATION_KEY, source.TEST_KEY}) == 3


def test_a_chunk_follows_from_its_number_alone():
    a = FrameSource(variants=ROBOTS, snapshots=1, width=64, height=64)
    b = FrameSource(variants=ROBOTS, snapshots=1, width=64, height=64)
    a.chunk(3)
    first, again, other = a.chunk(5)[0][0], b.chunk(5)[0][0], a.chunk(6)[0][0]
    np.testing.assert_array_equal(first.image, again.image)
    np.testing.assert_array_equal(first.centres, again.centres)
    assert (first.image != other.image).any()


def test_centres_project_into_their_boxes(pairs):
    for frame in pairs[0]:
        for i in np.flatnonzero(frame.objects.pixels > 100):
            x, y, z = frame.centres[i]
            K = frame.intrinsics
            at = np.array([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])
            box = frame.objects.boxes[i]
            size = box[2:] - box[:2]
            assert (at > box[:2] - size - 2).all()
            assert (at < box[2:] + size + 2).all()


def test_mirroring_twice_is_nothing_and_once_mirrors_the_truth(pairs):
    frame = pairs[0][0]
    mirrored = frame.mirrored()
    np.testing.assert_array_equal(mirrored.mirrored().image, frame.image)
    np.testing.assert_array_equal(mirrored.mirrored().objects.boxes, frame.objects.boxes)
    np.testing.assert_array_equal(mirrored.centres[:, 0], -frame.centres[:, 0])
    np.testing.assert_array_equal(mirrored.instances[:, ::-1], frame.instances)
    x, _, z = frame.centres[0]
    u = frame.intrinsics[0, 0] * x / z + frame.intrinsics[0, 2]
    flipped = mirrored.intrinsics[0, 0] * -x / z + mirrored.intrinsics[0, 2]
    assert flipped == pytest.approx(160 - u)


def test_batches_tell_the_truth_about_their_points(pairs):
    batch = make_batch(pairs, np.random.default_rng(0), augment=False)
    frames = [f for pair in pairs for f in pair]
    assert len(batch.images) == len(frames) == 4
    assert len(batch.image) > 0
    for k in range(len(batch.image)):
        instances = frames[int(batch.image[k])].instances
        points = batch.mask_points[k].numpy().astype(int)
        objects = np.unique(instances[points[:, 1], points[:, 0]][batch.mask_labels[k].numpy() > 0])
        assert len(objects) == 1
        inside = batch.depth_points[k].numpy().astype(int)
        assert (instances[inside[:, 1], inside[:, 0]] == objects[0]).all()


def test_iou_of_boxes():
    a = torch.tensor([[0.0, 0, 4, 4], [0, 0, 1, 1]])
    b = torch.tensor([[2.0, 0, 6, 4], [5, 5, 6, 6]])
    torch.testing.assert_close(iou(a, b), torch.tensor([1 / 3, 0.0]))


def test_a_batch_without_objects_still_trains(pairs):
    frame = pairs[0][0]
    empty = source.Frame(
        image=frame.image,
        instances=np.full_like(frame.instances, -1),
        objects=source.object_table(np.full_like(frame.instances, -1), 0),
        object_class=np.zeros(0, np.int64),
        centres=np.zeros((0, 3)),
        identity=np.zeros(0, np.int64),
        intrinsics=frame.intrinsics,
        up=frame.up,
        camera_height_m=1.0,
        height_sigma_m=0.1,
    )
    parts = losses(Eyes(tiny()), make_batch([(empty, empty)], np.random.default_rng(0)), LossWeights(), None)
    assert set(parts) == {"heat", "total"}
    parts["total"].backward()


def test_the_loss_falls_on_a_few_frames(pairs):
    params = quick(steps=30, pairs=2, learning_rate=4e-3, bf16=False)
    state = fresh(params, tiny())
    pool = Pool(FrameSource(variants=ROBOTS), params.pool_chunks)
    kept = pairs

    class Fixed(Pool):
        def draw(self, newest, number, rng):
            return kept

    fixed = Fixed(pool.source, 1)
    values = [train_step(state, fixed, params, 0.3) for _ in range(30)]
    first, last = (np.mean([v["total"] for v in part]) for part in (values[:5], values[-5:]))
    assert last < 0.7 * first
    for name in ("heat", "mask", "box", "classes"):
        assert np.mean([v[name] for v in values[-5:]]) < np.mean([v[name] for v in values[:5]])


def test_a_pool_renders_what_is_drawn_and_draws_the_same_however_long_it_has_run():
    rendered = []

    class Counted(FrameSource):
        def chunk(self, number):
            rendered.append(number)
            return [(number, i) for i in range(self.snapshots)]

    pool = Pool(Counted(), 10, worker=1, workers=2)
    draws = [pool.draw(9 + step, 3, np.random.default_rng(step)) for step in range(40)]
    assert len(rendered) == len(set(rendered)) == len({chunk for draw in draws for chunk, _ in draw})
    for step, draw in enumerate(draws):
        assert len(set(draw)) == 3
        assert all(chunk % 2 == 1 and step <= chunk // 2 <= 9 + step for chunk, _ in draw)
        assert Pool(Counted(), 10, 1, 2).draw(9 + step, 3, np.random.default_rng(step)) == draw
    assert len(set(Pool(Counted(), 2).draw(1, 100, np.random.default_rng(0)))) == 8


def test_a_batch_is_as_large_as_suits_the_network():
    state = fresh(quick(pairs=None, bf16=False), tiny())
    train_step(state, Pool(FrameSource(variants=ROBOTS), 1), quick(pairs=None, pool_chunks=1, bf16=False), 0.1)
    assert state.images == 8


def test_resuming_gives_what_an_unbroken_training_gives(tmp_path):
    whole = train(quick(), tmp_path / "whole", network=tiny())

    class Killed(Exception):
        pass

    def kill(row):
        raise Killed

    with pytest.raises(Killed):
        train(
            quick(checkpoint_s=1e-9), tmp_path / "broken", network=tiny(), report=kill, report_s=1e-9
        )  # dies before its first checkpoint
    train(quick(steps=2), tmp_path / "broken", network=tiny(), resume=True)
    resumed = train(quick(), tmp_path / "broken", network=tiny(), resume=True)
    assert resumed.step == whole.step == 4
    assert resumed.images == whole.images
    # The learning rate follows the share done, so only data and order are the same here; compare a like schedule.
    again = fresh(quick(), tiny())
    load_checkpoint(tmp_path / "broken" / CHECKPOINT, again)
    for a, b in zip(resumed.network.state_dict().values(), again.network.state_dict().values(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)


def test_steps_go_on_bit_for_bit_after_loading(tmp_path):
    params = quick(bf16=False)
    pool = Pool(FrameSource(variants=ROBOTS), params.pool_chunks)
    one = fresh(params, tiny())
    train_step(one, pool, params, 0.1)
    save_checkpoint(tmp_path / CHECKPOINT, one)
    two = fresh(params, tiny())
    load_checkpoint(tmp_path / CHECKPOINT, two)
    a = train_step(one, pool, params, 0.2)
    b = train_step(two, Pool(FrameSource(variants=ROBOTS), params.pool_chunks), params, 0.2)
    assert a == b
    for x, y in zip(one.averaged.state_dict().values(), two.averaged.state_dict().values(), strict=True):
        torch.testing.assert_close(x, y, rtol=0, atol=0)


def test_a_checkpoint_is_not_overwritten_by_accident(tmp_path):
    train(quick(steps=1), tmp_path, network=tiny())
    with pytest.raises(FileExistsError, match="resume"):
        train(quick(steps=1), tmp_path, network=tiny())
    with pytest.raises(ValueError, match="another network"):
        train(quick(steps=2), tmp_path, network=NetworkParams(("a", "b")), resume=True)
    assert not list(tmp_path.glob("*.partial"))


def test_validation_and_rows_of_progress(tmp_path):
    rows = []
    train(
        quick(steps=2), tmp_path, network=tiny(), report=rows.append, report_s=0, validate=lambda network: {"ap50": 0.5}
    )
    assert rows[-1]["step"] == 2
    assert rows[-1]["val_ap50"] == 0.5
    assert rows[-1]["images"] == 4
    assert len((tmp_path / "training.jsonl").read_text().splitlines()) == len(rows)


def test_progress_goes_to_tensorboard(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    rows = []
    train(quick(steps=2), tmp_path, network=tiny(), report=rows.append, report_s=0)
    logged = accumulator.EventAccumulator(str(tmp_path / "tensorboard"))
    logged.Reload()
    losses = [(event.step, event.value) for event in logged.Scalars("total")]
    assert losses == [(row["step"], pytest.approx(row["total"], rel=1e-6)) for row in rows]


def test_the_learning_rate_rises_and_falls():
    rates = [schedule(x, 0.1) for x in np.linspace(0, 1, 101)]
    assert np.argmax(rates) == 10
    assert rates[10] == pytest.approx(1)
    assert rates[-1] == pytest.approx(0.01)
    assert (np.diff(rates[10:]) < 0).all()


@pytest.mark.parametrize(
    "change", [{"minutes": 1.0}, {"steps": None}, {"pairs": 0}, {"seed": -1}, {"learning_rate": 0.0}]
)
def test_bad_parameters_are_refused(change):
    with pytest.raises(ValueError, match="|".join(change)):
        quick(**change)


@pytest.mark.parametrize("change", [{"classes": ()}, {"classes": ("a", "a")}, {"dropout": 1.0}, {"widths": (8, 8)}])
def test_bad_networks_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        NetworkParams(**({"classes": ("a",)} | change))


def test_two_workers_average_their_weights(tmp_path):
    rows = []
    params = quick(steps=2, workers=2, meet_every=2)
    state = train(params, tmp_path, network=tiny(), report=rows.append, report_s=0)
    assert state.step == 2
    assert state.images == rows[-1]["images"] == 8
    alone = train(quick(steps=2), tmp_path / "alone", network=tiny())
    pairs = zip(state.network.parameters(), alone.network.parameters(), strict=True)
    assert any((a != b).any() for a, b in pairs)


def test_a_team_that_goes_on_ends_like_one_that_never_stopped(tmp_path):
    def stop(row):
        if row["step"] == 6:
            raise KeyboardInterrupt

    params = quick(steps=7, workers=2, meet_every=2, checkpoint_s=0.0)
    whole = train(params, tmp_path / "whole", network=tiny())
    assert whole.step == 7  # the last round is cut short
    assert whole.others is not None
    with pytest.raises(KeyboardInterrupt):
        train(params, tmp_path / "stopped", network=tiny(), report=stop, report_s=0)
    kept = fresh(params, tiny())
    load_checkpoint(tmp_path / "stopped" / CHECKPOINT, kept)
    assert kept.step == 4  # of the last meeting
    resumed = train(params, tmp_path / "stopped", network=tiny(), resume=True)
    for a, b in zip(resumed.averaged.state_dict().values(), whole.averaged.state_dict().values(), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0)
    torch.testing.assert_close(resumed.others, whole.others, rtol=0, atol=0)


def test_expected_overlap_is_learned_from_evenly_spread_points():
    labels = torch.zeros(2, 8)
    labels[:, :3] = 1
    logits = torch.where(labels > 0, 5.0, -5.0)
    logits[1] = -logits[1]  # the first mask is right, the second wrong everywhere
    sure = overlap_loss(torch.tensor([4.0, -4.0]), logits, labels)
    assert sure < overlap_loss(torch.tensor([0.0, 0.0]), logits, labels)
    assert sure < overlap_loss(torch.tensor([-4.0, 4.0]), logits, labels)


def test_heights_are_reported_with_their_noise_and_sometimes_not_at_all():
    pairs = source.FrameSource(width=64, height=64).chunk(0)
    batches = [make_batch(pairs, np.random.default_rng(i)) for i in range(40)]
    true = torch.tensor([f.camera_height_m for pair in pairs for f in pair])
    height, std = torch.stack([b.height for b in batches]), torch.stack([b.height_std for b in batches])
    known = std.isfinite()
    assert 0.03 < 1 - known.float().mean() < 0.2
    assert ((height - true) / std)[known].std() == pytest.approx(1, abs=0.15)
