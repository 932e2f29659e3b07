"""A policy that moves the robots, trained by Stable-Baselines3's PPO: `covis train policy` (extra `policy`).

One network moves every robot, each from its own vector of `ClaimObservations`; a localizer claims for the team. Every
iteration begins with fresh episodes and fresh random numbers made from the seed and its own number, so that a training
that was killed and resumed ends with the same weights as one that was not.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..agents.claim_observations import ClaimObservations
from ..agents.controllers import scripted_controls
from ..agents.localizer import Localizer
from ..agents.perception import make_perceptor
from ..agents.wrapper import LocalizeWrapper
from ..envs.scenes import parallel_env
from .files import replacing, write_atomically
from .progress import Progress, silent
from .statistics import bootstrap_mean

Controls = Callable[[ClaimObservations, dict[str, NDArray[np.float32]]], dict[str, NDArray[np.float32]]]
"""From the environment and its observations to the robots' controls."""

COPIES = 2
EPISODES_PER_ITERATION = 4
"""Per copy; all robots of all copies learn from the same network's experience."""
EVALUATION_SEED = 2**20
"""Added to the training's seed: episodes that the policy was not trained on."""


COLUMNS = (
    ("controller", "controller", "{}"),
    ("episode_return", "return", "{:.2f}"),
    ("return_low", "from", "{:.2f}"),
    ("return_high", "to", "{:.2f}"),
    ("policy_gain_low", "policy's gain from", "{:+.2f}"),
    ("policy_gain_high", "to", "{:+.2f}"),
    ("displacement_fused_m", "fused m", "{:.3f}"),
    ("scene_recall", "scene recall", "{:.3f}"),
    ("collided", "collided", "{:.2f}"),
)
"""Key of an evaluation's row, title and form."""


@dataclass(frozen=True)
class PolicyParams:
    """What is trained.

    Attributes:
        scene, preset: as in a benchmark.
        method: the matcher behind the claims; it knows the noisy poses.
        perception: eyes of the robots.
        steps: robot-steps of experience, rounded up to whole iterations.
        seed: of everything.
        options: of the environment, for small tests.
    """

    scene: str
    preset: str | None = "easy"
    method: str = "hungarian"
    perception: str = "simulated"
    steps: int = 50_000
    seed: int = 0
    options: tuple[tuple[str, Any], ...] = ()

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1, got {self.steps}")
        if self.seed < 0:
            raise ValueError(f"seed must be non-negative, got {self.seed}")


def make_env(params: PolicyParams) -> ClaimObservations:
    """The scene with a localizer that claims, and the vectors the policy sees."""
    sensors = ("image",) if params.perception == "learned" else ("depth", "instances")
    env = parallel_env(params.scene, preset=params.preset, sensors=sensors, **dict(params.options))
    eyes = make_perceptor(params.perception, env)
    return ClaimObservations(
        LocalizeWrapper(env, Localizer(eyes, params.method, "known", max_detections=env.max_detections))
    )


def train_policy(
    params: PolicyParams,
    out: Path,
    *,
    resume: bool = False,
    report: Callable[[dict[str, float]], None] = lambda row: None,
) -> Path:
    """Train and write OUT/policy.zip; the checkpoint and the log are kept in OUT, too.

    Raises:
        FileExistsError: OUT holds a training and `resume` is off, or one of other params (more steps are allowed).
        ValueError: an unknown scene, preset, method or perception.
    """
    out.mkdir(parents=True, exist_ok=True)
    checkpoint = out / "checkpoint.zip"
    _claim_folder(params, out, resume)
    vector = _vector(params)
    try:
        model = _model(params, vector, checkpoint)
        per_iteration = model.n_steps * model.n_envs
        log = _log(out)[: model.num_timesteps // per_iteration]
        while model.num_timesteps < params.steps:
            iteration = model.num_timesteps // per_iteration
            _iterate(model, vector, params.seed, iteration)
            row = {
                "iteration": iteration,
                "steps": model.num_timesteps,
                "episode_return": float(np.mean([e["r"] for e in model.ep_info_buffer])),
            }
            log.append(row)
            write_atomically(out / "log.json", json.dumps(log, indent=1).encode())
            _save(model, checkpoint)
            report(row | {"done": min(1.0, model.num_timesteps / params.steps)})
        _save(model, out / "policy.zip")
    finally:
        vector.close()
    return out / "policy.zip"


def _claim_folder(params: PolicyParams, out: Path, resume: bool) -> None:
    file = out / "training.json"
    asked = json.loads(json.dumps(asdict(params)))
    if file.exists():
        there = json.loads(file.read_text())
        if not resume:
            raise FileExistsError(f"{out} holds a training already; give --resume to go on with it")
        differing = [key for key in asked if key != "steps" and there.get(key) != asked[key]]
        if differing:
            key = differing[0]
            raise FileExistsError(f"{out} holds a training with {key} {there.get(key)!r}, not {asked[key]!r}")
    write_atomically(file, json.dumps(asked, indent=1).encode())


def _vector(params: PolicyParams) -> Any:
    """COPIES environments, every robot a row."""
    import supersuit
    from stable_baselines3.common.vec_env import VecMonitor

    one = supersuit.pettingzoo_env_to_vec_env_v1(make_env(params))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="The `render_mode` attribute")  # which nobody needs here
        return VecMonitor(supersuit.concat_vec_envs_v1(one, COPIES, num_cpus=0, base_class="stable_baselines3"))


def _model(params: PolicyParams, vector: Any, checkpoint: Path) -> Any:
    from stable_baselines3 import PPO
    from stable_baselines3.common.utils import set_random_seed

    if checkpoint.exists():
        return PPO.load(checkpoint, env=vector, device="cpu")
    cycles = vector.venv.venv.vec_envs[0].par_env.unwrapped.max_cycles
    n_steps = EPISODES_PER_ITERATION * cycles
    set_random_seed(params.seed)
    return PPO(
        "MlpPolicy",
        vector,
        n_steps=n_steps,
        batch_size=n_steps * vector.num_envs // 4,
        gamma=0.95,
        policy_kwargs={"log_std_init": -0.5},
        device="cpu",
    )


def _iterate(model: Any, vector: Any, seed: int, iteration: int) -> None:
    """One rollout and one update, of the seed and the iteration's number alone."""
    from stable_baselines3.common.utils import set_random_seed

    # Stable-Baselines3 draws from the global generators; SuperSuit's vectors hand no seed on, the inner one takes it.
    episodes, draws = (int(s) >> 1 for s in np.random.SeedSequence([seed, iteration]).generate_state(2))
    set_random_seed(draws)
    vector.venv.venv.reset(seed=episodes)
    model.set_env(vector, force_reset=True)
    model.learn(model.n_steps * model.n_envs, reset_num_timesteps=False)


def _save(model: Any, file: Path) -> None:
    with replacing(file) as temporary:
        model.save(temporary)


def _log(out: Path) -> list[dict[str, float]]:
    file = out / "log.json"
    return json.loads(file.read_text()) if file.exists() else []


def load_policy(file: Path) -> Controls:
    """The controls of a trained policy, its mean action for every robot."""
    from stable_baselines3 import PPO

    model = PPO.load(file, device="cpu")

    def controls(env: ClaimObservations, observations: dict[str, Any]) -> dict[str, Any]:
        actions, _ = model.predict(np.stack(list(observations.values())), deterministic=True)
        return dict(zip(observations, actions, strict=True))

    return controls


def scripted(env: ClaimObservations, observations: dict[str, Any]) -> dict[str, Any]:
    """The scene's own controllers, which know the true state."""
    controls = np.clip(scripted_controls(env.unwrapped.world), -1, 1).astype(np.float32)
    return dict(zip(env.possible_agents, controls, strict=True))


def standing(env: ClaimObservations, observations: dict[str, Any]) -> dict[str, Any]:
    """Zero controls."""
    return {a: np.zeros(env.action_space(a).shape, np.float32) for a in observations}


def uniform(rng: np.random.Generator) -> Controls:
    """Random controls."""
    return lambda env, observations: {
        a: rng.uniform(-1, 1, env.action_space(a).shape).astype(np.float32) for a in observations
    }


def evaluate_policy(
    params: PolicyParams,
    policy: Controls,
    episodes: int = 40,
    progress: Progress = silent,
) -> list[dict[str, Any]]:
    """The policy beside the scripted controllers, random ones and none, on the same episodes, none of the training.

    Returns:
        Per controller: mean return of an episode with its 95 % interval over episodes (bootstrap), the interval of
        what the policy gains over it on the same episodes, fused displacement error (m, over all rightly matched
        objects), scene recall and the share of robot-episodes with a collision.
    """
    controllers = {
        "policy": policy,
        "scripted": scripted,
        "random": uniform(np.random.default_rng([params.seed, EVALUATION_SEED])),
        "standing": standing,
    }
    env = make_env(params)
    played: dict[str, list[dict[str, float]]] = {}
    try:
        for k, (name, controller) in enumerate(controllers.items()):
            played[name] = []
            for episode in range(episodes):
                progress(k * episodes + episode, len(controllers) * episodes)
                played[name].append(_play(env, controller, [EVALUATION_SEED + params.seed, episode]))
    finally:
        env.close()
    return [_row(name, played[name], played["policy"]) for name in controllers]


def _play(env: ClaimObservations, controller: Controls, seed: list[int]) -> dict[str, float]:
    observations, _ = env.reset(seed=seed)
    total, collided = 0.0, dict.fromkeys(env.possible_agents, 0.0)
    infos: dict[str, dict[str, float]] = {}
    while env.agents:
        observations, rewards, _, _, infos = env.step(controller(env, observations))
        total += rewards[env.possible_agents[0]]
        collided = {a: max(c, infos[a]["collided"]) for a, c in collided.items()}
    team = infos[env.possible_agents[0]]
    localized = {a: i["episode_n_localized"] for a, i in infos.items()}
    return {
        "return": total,
        "error": sum(n * infos[a]["episode_displacement_fused_m"] for a, n in localized.items()),
        "localized": sum(localized.values()),
        "correct": team["episode_n_correct"],
        "visible": team["episode_n_visible"],
        "collided": float(np.mean(list(collided.values()))),
    }


def _row(name: str, played: list[dict[str, float]], policy: list[dict[str, float]]) -> dict[str, Any]:
    sums = {key: sum(p[key] for p in played) for key in played[0]}
    returns = np.array([p["return"] for p in played])
    low, high = bootstrap_mean(returns)
    gain = (None, None) if played is policy else bootstrap_mean(np.array([p["return"] for p in policy]) - returns)
    return {
        "controller": name,
        "episodes": len(played),
        "episode_return": float(returns.mean()),
        "return_low": low,
        "return_high": high,
        "policy_gain_low": gain[0],
        "policy_gain_high": gain[1],
        "displacement_fused_m": sums["error"] / sums["localized"] if sums["localized"] else None,
        "scene_recall": sums["correct"] / sums["visible"] if sums["visible"] else 0.0,
        "collided": sums["collided"] / len(played),
    }
