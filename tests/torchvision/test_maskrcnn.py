"""The paper's own network, where torchvision is installed: `make test-torchvision`."""

import json
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

if find_spec("torchvision") is None:
    pytest.skip("torchvision has its own virtual environment: make test-torchvision", allow_module_level=True)

import torch
from torchvision.models.detection.image_list import ImageList
from torchvision.ops import box_iou
from typer.testing import CliRunner

from covis.agents.perception import make_perceptor
from covis.agents.perception import weights as stored
from covis.agents.perception.frames import FrameSource, joint_classes
from covis.agents.perception.kinds import open_eyes
from covis.agents.perception.learned import LearnedPerceptionParams
from covis.agents.perception.losses import LossWeights, make_batch
from covis.agents.perception.maskrcnn import MaskRCNNParams, MaskRCNNPerception, PaperNetwork, apart, losses
from covis.agents.perception.targets import object_table
from covis.envs.scenes import parallel_env
from covis.scripts.main import app

SMALL = MaskRCNNParams(joint_classes(), backbone="resnet18", image_size=(160, 120), proposals=16, representation=64)


@pytest.fixture(autouse=True)
def one_thread():
    """Several threads wait for each other where other programs use the cores too."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def network() -> PaperNetwork:
    torch.manual_seed(0)
    return PaperNetwork(SMALL)


def weights(net: PaperNetwork) -> stored.Weights:
    return stored.Weights(net.state_dict(), net.params.to_dict())


def observation():
    env = parallel_env("multi_robot", width=160, height=120)
    observations, _ = env.reset(seed=3)
    return observations["robot_0"], env.classes


def look(**options):
    seen, classes = observation()
    eyes = open_eyes(weights(network()), classes, LearnedPerceptionParams(score=0.0, min_pixels=1, **options))
    assert isinstance(eyes, MaskRCNNPerception)
    return eyes.see(seen, np.random.default_rng(0)), eyes.see(seen, np.random.default_rng(1))


def test_the_loss_falls_on_a_few_frames():
    batch = make_batch(FrameSource(width=160, height=120).chunk(0)[:1], np.random.default_rng(0), masks=True)
    net = network().train()
    optimiser = torch.optim.AdamW(net.parameters(), lr=1e-3)
    rows = []
    for step in range(10):
        optimiser.zero_grad()
        parts = losses(net, batch, LossWeights(), torch.Generator().manual_seed(step))
        parts["total"].backward()
        optimiser.step()
        rows.append({name: float(value.detach()) for name, value in parts.items()})
    assert set(parts) == {"heat", "box", "mask", "classes", "depth", "total"}
    for name, share in (("heat", 0.8), ("classes", 0.8), ("total", 0.9)):
        first, last = (np.mean([row[name] for row in part]) for part in (rows[:2], rows[-2:]))
        assert last < share * first, name


def test_the_same_generator_gives_the_same_loss():
    batch = make_batch(FrameSource(width=160, height=120).chunk(1)[:1], np.random.default_rng(0), masks=True)
    net = network().train()
    a, b = (losses(net, batch, LossWeights(), torch.Generator().manual_seed(5))["total"].item() for _ in range(2))
    assert a == b


def test_features_and_masks_begin_where_they_can_be_learned_from():
    """Unnormalised, they grow with depth: the mask's loss then begins at ten times that of not knowing."""
    batch = make_batch(FrameSource(width=160, height=120).chunk(0)[:1], np.random.default_rng(0), masks=True)
    net = network().train()
    maps = net.detector.backbone(batch.images.permute(0, 3, 1, 2).float() / 255)
    assert all(0.5 < found.std() < 2 for found in maps.values())
    parts = losses(net, batch, LossWeights(), torch.Generator().manual_seed(0))
    assert float(parts["mask"].detach()) == pytest.approx(np.log(2), abs=0.05)


def test_images_without_objects_are_learned_from():
    frame = FrameSource(width=160, height=120).chunk(0)[0][0]
    empty = replace(
        frame,
        instances=np.full_like(frame.instances, -1),
        objects=object_table(np.full_like(frame.instances, -1), 0),
        object_class=np.zeros(0, np.int64),
        centres=np.zeros((0, 3)),
        identity=np.zeros(0, np.int64),
    )
    batch = make_batch([(empty, empty)], np.random.default_rng(0), masks=True)
    parts = losses(network().train(), batch, LossWeights(), None)
    parts["total"].backward()
    assert all(torch.isfinite(value) for value in parts.values())


def test_objects_meet_an_anchor_of_their_size():
    """Of torchvision's own, which begin at 32 pixels, four of ten objects meet none with an IoU of 0.3."""
    net = network()
    images = torch.zeros(1, 3, 240, 320)
    maps = [torch.zeros(1, 1, 240 // s, 320 // s) for s in (4, 8, 16, 32, 64)]
    anchors = net.detector.rpn.anchor_generator(ImageList(images, [(240, 320)]), maps)[0]
    chunks = [FrameSource().chunk(n) for n in range(4)]
    boxes = torch.from_numpy(
        np.concatenate([f.objects.boxes[f.objects.pixels >= 60] for chunk in chunks for pair in chunk for f in pair])
    )
    best = box_iou(boxes, anchors.double()).amax(1)
    assert (best > 0.5).double().mean() > 0.8
    assert best.min() > 0.25


def test_images_of_the_stated_size_are_not_resized():
    small, _ = network().detector.transform([torch.zeros(3, 120, 160)])
    assert small.image_sizes == [(120, 160)]


def test_an_image_is_seen_alike_whatever_else_is_in_the_batch():
    net = network().train()
    images = torch.rand(2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    images[1] *= 0.1
    together, alone = net.depth(images)[0], net.depth(images[:1])[0]
    torch.testing.assert_close(together, alone)
    torch.testing.assert_close(net.eval().depth(images[:1])[0], alone)


def test_detections_have_masks_classes_and_both_uncertainties():
    seen, _ = look(samples=4)
    n = len(seen.detections)
    assert n > 0
    graph = seen.detections.graph
    assert seen.detections.masks.shape == (n, 120, 160)
    assert (seen.detections.masks.sum(axis=0) <= 1).all()
    np.testing.assert_allclose(graph.attributes.sum(axis=1), 1)
    assert (graph.position_variance > 0).all()
    assert (seen.depth_variance > seen.depth_epistemic).all()
    assert (graph.attribute_variance > 0).all()


def test_a_pixel_goes_to_the_surest_of_those_that_claim_it():
    likely = torch.tensor([[0.9, 0.6, 0.6, 0.2], [0.9, 0.9, 0.9, 0.4], [0.0, 0.0, 0.99, 0.99]])[:, None]
    masks = apart(likely, torch.tensor([0.9, 0.8, 0.1]))[:, 0]
    assert masks.tolist() == [[True, False, False, False], [False, True, True, False], [False, False, False, True]]
    assert apart(torch.zeros(0, 3, 4), torch.zeros(0)).shape == (0, 3, 4)


def test_samples_differ_and_one_alone_is_deterministic():
    a, b = look(samples=4)
    assert (a.depth_epistemic > 0).all()
    assert len(a.depth) != len(b.depth) or not np.allclose(a.depth, b.depth)
    a, b = look(samples=1)
    np.testing.assert_array_equal(a.depth, b.depth)
    assert (a.depth_epistemic == 0).all()


def test_sizes_survive_their_manifest():
    assert MaskRCNNParams.from_dict(json.loads(json.dumps(SMALL.to_dict()))) == SMALL
    with pytest.raises(ValueError, match="dropout"):
        MaskRCNNParams(("a",), dropout=1.0)


@pytest.mark.slow
def test_the_command_trains_it_and_its_weights_open(tmp_path):
    arguments = [
        "train",
        "perception",
        "--network",
        "maskrcnn",
        "--steps",
        "1",
        "--workers",
        "1",
        "--out",
        str(tmp_path),
    ]
    result = CliRunner().invoke(app, [*arguments, "--validation-images", "0", "--calibration-images", "0"])
    assert result.exit_code == 0, result.output
    manifest = json.loads((tmp_path / stored.MANIFEST).read_text())
    assert manifest["network"]["kind"] == "maskrcnn"
    env = parallel_env("target_localization")
    observations, _ = env.reset(seed=0)
    eyes = make_perceptor(f"learned:{tmp_path}", env)
    assert isinstance(eyes, MaskRCNNPerception)
    found = eyes(observations["robot_0"], np.random.default_rng(0))
    assert found.graph.attributes.shape[1] == len(env.classes)
