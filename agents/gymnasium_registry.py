"""Names of the scenes in Gymnasium's registry; light, so that `import covis.agents` may enter them."""

from __future__ import annotations

import gymnasium

VERSIONS = {"connected_driving": 0, "multi_robot": 0, "aerial_ground": 0, "target_localization": 0}
"""Of the scenes; a test compares them with `covis.envs.scenes.SCENES`, which is too heavy to import here."""


def gymnasium_id(scene: str) -> str:
    """`covis/MultiRobot-v0` of `multi_robot`."""
    return f"covis/{''.join(word.title() for word in scene.split('_'))}-v{VERSIONS[scene]}"


def register() -> None:
    """Enter every scene in Gymnasium's registry; doing it twice is harmless."""
    for scene in VERSIONS:
        if gymnasium_id(scene) not in gymnasium.registry:
            gymnasium.register(
                gymnasium_id(scene), entry_point="covis.agents.gymnasium_env:make", kwargs={"scene": scene}
            )
