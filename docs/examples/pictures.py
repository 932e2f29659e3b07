"""One picture per scene: python docs/examples/pictures.py FOLDER [SCENE ...]"""

import sys
from pathlib import Path

import cv2
import numpy as np

from covis.agents.controllers import scripted_controls
from covis.agents.localizer import Localizer
from covis.agents.perception import make_perceptor
from covis.agents.wrapper import LocalizeWrapper
from covis.envs.colors import CLASS_COLORS, IDENTITY_COLORS, RIGHT, ROBOT_COLORS, WRONG
from covis.envs.scenes import SCENES, parallel_env

STEPS = 10
COLORS = 256
VIVID = (*ROBOT_COLORS, *IDENTITY_COLORS, *CLASS_COLORS, RIGHT, WRONG)


def picture(scene, seed=1, **options):
    """The scene after some steps of scripted motion, claims by Hungarian assignment on noisy poses."""
    env = parallel_env(scene, sensors=("image", "depth", "instances"), render_mode="rgb_array", **options)
    localizer = Localizer(make_perceptor("simulated", env), "hungarian", "known", max_detections=env.max_detections)
    team = LocalizeWrapper(env, localizer)
    team.reset(seed=seed)
    for _ in range(STEPS):
        if team.agents:
            controls = scripted_controls(env.world).astype(np.float32)
            team.step(dict(zip(team.agents, controls, strict=True)))
    return env.render()


def save(image, file, width=960):
    """As a small PNG: no wider than that, grain smoothed, and few colours where PIL is at hand."""
    smooth = cv2.bilateralFilter(image, 7, 22, 3)
    small = cv2.resize(smooth, (width, image.shape[0] * width // image.shape[1]), interpolation=cv2.INTER_AREA)
    try:
        from PIL import Image
    except ImportError:
        cv2.imwrite(str(file), cv2.cvtColor(small, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    else:
        # The vivid colours of the drawing are few pixels: they must be put into the palette, or they turn grey.
        grown = np.stack([np.array(c) * share for c in VIVID for share in (1.0, 0.75)])
        scenery = Image.fromarray(small).quantize(COLORS - len(grown), dither=Image.Dither.NONE).getpalette()
        palette = Image.new("P", (1, 1))
        palette.putpalette([*grown.astype(int).ravel().tolist(), *scenery])
        Image.fromarray(small).quantize(palette=palette, dither=Image.Dither.NONE).save(file, optimize=True)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[2:] or SCENES:
        save(picture(name), folder / f"{name}.png")
