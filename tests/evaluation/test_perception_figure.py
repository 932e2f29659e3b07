"""The picture of what the eyes saw."""

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("cv2")

from covis.agents.perception.detections import Detections
from covis.evaluation.perception_figure import BAND, figure
from covis.matching import ObjectGraph
from covis.scripts.main import app


def found(masks: bool = True) -> Detections:
    shown = np.zeros((2, 60, 80), bool)
    shown[0, 10:30, 10:30], shown[1, 40:50, 50:70] = True, True
    graph = ObjectGraph.from_positions([[0, 0, 4.0], [1, 0, 8.0]], position_variance=[0.1, 0.9])
    return Detections(graph, np.array([[10, 10, 30, 30], [50, 40, 70, 50]], float), shown if masks else None)


def test_five_panels_and_the_surer_object_is_darker():
    image = np.full((60, 80, 3), 90, np.uint8)
    picture = figure(image, found())
    assert picture.shape == (60 + BAND, 5 * 80, 3)
    np.testing.assert_array_equal(picture[BAND:, :80], image)
    u = picture[BAND:, 320:]
    assert int(u[45, 60].sum()) > int(u[20, 20].sum())
    assert (picture[BAND + 5, 80:160] == 90).all()


def test_no_detections_and_no_masks():
    image = np.zeros((60, 80, 3), np.uint8)
    empty = found()
    nothing = Detections(empty.graph.take(np.zeros(0, int)), np.zeros((0, 4)), np.zeros((0, 60, 80), bool))
    assert figure(image, nothing).shape == (60 + BAND, 400, 3)
    with pytest.raises(ValueError, match="masks"):
        figure(image, found(masks=False))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--figure", "picture.txt"], "picture.txt"),
        (["--json", "nowhere/rows.json"], "no folder"),
        (["--images", "0"], "at least 1"),
        (["--episodes", "3", "--method", "bayes"], "no --episodes, --method"),
        (["--perception", "learned:nowhere"], "eyes.json"),
        (["--perception", "simulated"], "only learned"),
    ],
)
def test_the_benchmark_finds_out_at_its_beginning(options, message, tmp_path, monkeypatch):
    for package in ("torch", "safetensors", "pycocotools", "pybullet", "pettingzoo"):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["benchmark", "perception", *options])
    assert result.exit_code == 2
    assert message in result.output
