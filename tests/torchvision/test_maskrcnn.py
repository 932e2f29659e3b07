"""The paper's own network, where torchvision is installed: `make test-torchvision`."""

import json
from importlib.util import find_spec

import numpy as np
import pytest

if find_spec("torchvision") is None:
    pytest.skip("torchvision has its own virtual environment: make test-torchvision", allow_module_level=True)

import torch
from typer.testing import CliRunner

from covis.agents.perception import make_perceptor
from covis.agents.perception import weights as stored
from covis.agents.perception.frames import FrameSource, joint_classes
from covis.agents.perception.kinds import open_eyes
from covis.agents.perception.learned import LearnedPerceptionParams
from covis.agents.perception.losses import LossWeights, make_batch
from covis.agents.perception.maskrcnn import MaskRCNNParams, MaskRCNNPerception, PaperNetwork, losses
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
    batch = make_batch(FrameSource(width=160, height=120).chunk(0)[:2], np.random.default_rng(0), masks=True)
    net = network().train()
    optimiser = torch.optim.AdamW(net.parameters(), lr=1e-3)
    totals = []
    for step in range(8):
        optimiser.zero_grad()
        parts = losses(net, batch, LossWeights(), torch.Generator().manual_seed(step))
        parts["total"].backward()
        optimiser.step()
        totals.append(float(parts["total"].detach()))
    assert set(parts) == {"heat", "box", "mask", "classes", "depth", "total"}
    assert np.mean(totals[-2:]) < 0.8 * np.mean(totals[:2])


def test_the_same_generator_gives_the_same_loss():
    batch = make_batch(FrameSource(width=160, height=120).chunk(1)[:1], np.random.default_rng(0), masks=True)
    net = network().train()
    a, b = (losses(net, batch, LossWeights(), torch.Generator().manual_seed(5))["total"].item() for _ in range(2))
    assert a == b


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
