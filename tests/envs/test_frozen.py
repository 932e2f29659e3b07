"""Networks are trained on v0's pictures and presets: a change of either makes a v1.

`frozen.json` holds, per scene and preset, every parameter, and the mean colours of the first camera's picture at seed 0
in blocks of 32x32 pixels. Means are compared to within one step of brightness, since processors differ in last bits.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from covis.envs.scenes import SCENES, parallel_env

FROZEN = Path(__file__).with_name("frozen.json")
PRESETS = ("easy", "paper", "hard")
BLOCK = 32


def parameters(scene, preset):
    return {name: repr(value) for name, value in dataclasses.asdict(SCENES[scene].preset(preset)).items()}


def picture(scene, preset):
    """Mean colours (H / BLOCK, W / BLOCK, 3) and where objects are, in the same blocks."""
    env = parallel_env(scene, preset=preset)
    env.reset(seed=0)
    frame = env.camera_frames()[0]
    env.close()
    height, width = (n // BLOCK * BLOCK for n in frame.depth.shape)
    layers = np.dstack([frame.rgb.astype(float), 100.0 * (frame.instances >= 0)])[:height, :width]
    return layers.reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK, 4).mean((1, 3))


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("scene", SCENES)
def test_presets_and_pictures_are_those_of_this_version(scene, preset):
    assert SCENES[scene].version == 0, "a new version needs new frozen pictures"
    frozen = json.loads(FROZEN.read_text())[f"{scene}/{preset}"]
    assert parameters(scene, preset) == frozen["parameters"]
    np.testing.assert_allclose(picture(scene, preset), frozen["picture"], atol=1.0)


if __name__ == "__main__":  # a new version: python tests/envs/test_frozen.py
    rows = {
        f"{scene}/{preset}": {
            "parameters": parameters(scene, preset),
            "picture": picture(scene, preset).round(1).tolist(),
        }
        for scene in SCENES
        for preset in PRESETS
    }
    lines = (f"{json.dumps(name)}: {json.dumps(row, separators=(',', ':'))}" for name, row in rows.items())
    FROZEN.write_text("{\n" + ",\n".join(lines) + "\n}\n")
