"""The scenes for `gymnasium.make`: `covis/MultiRobot-v0` and so on, importable as `covis.agents:covis/MultiRobot-v0`.

The agent moves; a localizer claims for the whole team. Full claims as actions: `covis.envs.single_agent.RobotView`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from ..envs.scenes import parallel_env
from ..envs.single_agent import Others, RobotView, TeamView
from ..envs.wrappers import SelectObservations
from .controllers import scripted_controls
from .localizer import Localizer
from .perception import make_perceptor
from .wrapper import LocalizeWrapper

EYES = ("depth", "instances", "instance_classes")
"""Leaves that only the localizer's simulated eyes see."""


def make(
    scene: str,
    *,
    view: str = "robot_0",
    others: Others | Literal["scripted"] = "scripted",
    method: str = "hungarian",
    pose: Literal["known", "unknown"] = "known",
    perception: str = "simulated",
    method_options: Mapping[str, Any] | None = None,
    **options: Any,
) -> RobotView | TeamView:
    """A scene as one Gymnasium environment whose actions are controls.

    Args:
        scene: a name in `covis.envs.scenes.SCENES`.
        view: the robot that learns, or `"team"`: all controls end to end in one Box.
        others: how the other robots move: `"scripted"` by the scene's controllers, or as in `RobotView`.
        method, pose, method_options: of the localizer that claims for the team.
        perception: eyes of the localizer.
        options: of `covis.envs.scenes.parallel_env`, e.g. `n_robots`, `preset`, `width`, `height`, `render_mode`.

    Raises:
        ValueError: what the scene, the environment or the localizer refuses.
    """
    sensors = tuple(options.pop("sensors", ("image",)))
    seen_by_eyes = ("depth", "instances") if perception == "simulated" else ()
    env = parallel_env(scene, sensors=tuple(dict.fromkeys((*sensors, *seen_by_eyes))), **options)
    if view not in (robots := env.possible_agents) and view != "team":
        raise ValueError(f"view must be 'team' or one of {', '.join(robots)}, got {view!r}")
    localizer = Localizer(
        make_perceptor(perception, env), method, pose, max_detections=env.max_detections, options=method_options or {}
    )
    hidden = [leaf for leaf in EYES if leaf in env.observation_space("robot_0").spaces]
    hidden = [leaf for leaf in hidden if leaf.replace("instance_classes", "instances") not in sensors]
    wrapped = SelectObservations(LocalizeWrapper(env, localizer), drop=hidden)
    if view == "team":
        return TeamView(wrapped)
    return RobotView(wrapped, view, scripted_controls if others == "scripted" else others)
