"""The scenes by name: how to build each world, and what its environment assumes by default."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial
from importlib import import_module
from typing import Any

from pettingzoo import AECEnv
from pettingzoo.utils.conversions import parallel_to_aec

from .camera.effects import EffectRanges
from .collaborative import CollaborativeEnv
from .scoring import LocalizationReward
from .sensing import PoseNoise
from .worlds import aerial_ground, driving_params, multi_robot, target_localization
from .worlds.aerial_ground import AerialGroundParams, AerialGroundWorld
from .worlds.driving import ConnectedDrivingWorld, DrivingParams
from .worlds.multi_robot import MultiRobotParams, MultiRobotWorld
from .worlds.target_localization import TargetLocalizationParams, TargetLocalizationWorld
from .worlds.world import World


@dataclass(frozen=True)
class Scene:
    """A world with the defaults of its environment.

    Attributes:
        world: called with (n_robots, params).
        params: the type of `params`, a dataclass; without arguments the generator's own defaults.
        preset: name of a difficulty, and changes of it by name -> params.
        n_robots: default number of robots with cameras.
        pose_noise: errors of the robots' reported poses.
        reward: the team's default reward.
        effects: ranges of the cameras' character; None = ideal cameras.
        version: of rendering and presets; a change that alters results raises it.
    """

    world: Callable[..., World]
    params: type[Any]
    preset: Callable[..., Any]
    n_robots: int
    pose_noise: PoseNoise
    reward: LocalizationReward
    effects: EffectRanges | None = None
    version: int = 0


REAL_CAMERAS = EffectRanges(k1=(0.0, 0.0), k2=(0.0, 0.0))
"""Varied as real cameras vary, but for the lens, which robots rectify."""

SCENES: dict[str, Scene] = {
    "connected_driving": Scene(
        ConnectedDrivingWorld,
        DrivingParams,
        driving_params.preset,
        2,
        PoseNoise(1.0, 0.0175),
        LocalizationReward(cap_m=5.0),
    ),
    "multi_robot": Scene(
        MultiRobotWorld,
        MultiRobotParams,
        multi_robot.preset,
        2,
        PoseNoise(0.3, 0.02),
        LocalizationReward(cap_m=2.0),
    ),
    "aerial_ground": Scene(
        AerialGroundWorld,
        AerialGroundParams,
        aerial_ground.preset,
        2,
        PoseNoise(0.2, 0.02),
        LocalizationReward(cap_m=2.0),
        REAL_CAMERAS,
    ),
    "target_localization": Scene(
        TargetLocalizationWorld,
        TargetLocalizationParams,
        target_localization.preset,
        2,
        PoseNoise(0.02, 0.01),
        LocalizationReward(cap_m=0.5),
    ),
}


def parallel_env(
    scene: str, *, n_robots: int | None = None, preset: str | None = None, params: Any = None, **options: Any
) -> CollaborativeEnv:
    """A scene as a PettingZoo ParallelEnv.

    Args:
        scene: a name in SCENES, or `package.module:World`, a callable that takes (n_robots) or nothing.
        n_robots: robots with cameras; None = the scene's default.
        preset: difficulty, `easy`, `paper` or `hard`; None = the generator's own defaults. The benchmark takes `paper`.
        params: of the world's generator, instead of a preset.
        options: of `CollaborativeEnv`; or parameters of the generator by name, such as `map` or `dynamics`, instead of
            those of the preset or of `params`.

    Raises:
        ValueError: an unknown scene, or what the world or the environment refuses.
        TypeError: an option that neither has.
    """
    if scene not in SCENES and ":" in scene:
        return _own_scene(scene, n_robots, preset, params, options)
    if scene not in SCENES:
        raise ValueError(f"no scene is called {scene!r}; there are {', '.join(SCENES)}, or package.module:World")
    spec = SCENES[scene]
    if params is not None and preset is not None:
        raise ValueError(f"give a preset or params, not both: preset={preset!r}")
    changes = {field.name: options.pop(field.name) for field in fields(spec.params) if field.name in options}
    if preset is not None:
        params = spec.preset(preset, **changes)
    elif changes:
        params = replace(spec.params() if params is None else params, **changes)
    make_world = partial(spec.world, spec.n_robots if n_robots is None else n_robots, params)
    defaults: dict[str, Any] = {
        "name": f"{scene}_v{spec.version}",
        "pose_noise": spec.pose_noise,
        "reward": spec.reward,
        "effects": spec.effects if options.get("backend", "raster") == "raster" else None,
    }
    return CollaborativeEnv(make_world, **(defaults | options))


def _own_scene(
    path: str, n_robots: int | None, preset: str | None, params: Any, options: dict[str, Any]
) -> CollaborativeEnv:
    """A scene from anywhere: the world's class (or any callable that makes one) by its path."""
    module_name, _, attribute = path.partition(":")
    try:
        world = getattr(import_module(module_name), attribute)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"no World at {path!r}: {error}") from error
    if preset is not None:
        raise ValueError(f"{path!r} has no presets, got preset={preset!r}; give params")
    if not callable(world):
        raise ValueError(f"{path!r} is not a World nor anything that makes one, but {world!r}")
    arguments = [a for a in (n_robots, params) if a is not None]
    return CollaborativeEnv(partial(world, *arguments), **({"name": attribute} | options))


def aec_env(scene: str, **options: Any) -> AECEnv:
    """The same scene turn by turn: all claims are scored when the last robot has acted."""
    return parallel_to_aec(parallel_env(scene, **options))


def register(scene: str) -> None:
    """Enter the scene in PettingZoo's registry, where PettingZoo has one."""
    try:
        from pettingzoo import parallel_registry
        from pettingzoo import register as enter
    except ImportError:
        return
    name = f"covis/{scene}-v{SCENES[scene].version}"
    if name not in parallel_registry:
        enter("parallel", name, partial(parallel_env, scene))
        enter("aec", name, partial(aec_env, scene))
