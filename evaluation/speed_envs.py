"""Cameras and environments against pybullet's and highway-env's own, side by side.

Both sides are one thread that never waits, so seconds are the processor's: other work on the machine counts on neither.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from time import process_time
from typing import Any

import numpy as np

from ..agents.controllers import scripted_controls
from ..envs.camera.comparison import contenders
from ..envs.camera.raster import PLAIN
from ..envs.claims import Claims, silent_actions
from ..envs.collaborative import CollaborativeEnv
from ..envs.scenes import SCENES, parallel_env
from ..envs.scoring import score
from ..envs.worlds.driving import ConnectedDrivingWorld
from ..envs.worlds.multi_robot import MultiRobotWorld
from ..envs.worlds.peers import TinyPeer, speed_params
from .progress import Progress, silent
from .timing import rates, row

N_ROBOTS = 15
EPISODES, STOCK_EPISODES = 16, 4
DRIVING_EPISODES = 8
SIZES = ((160, 120), (320, 240), (640, 480))
TEAMS = (15, 30)


def rows(progress: Progress = silent) -> list[dict[str, Any]]:
    """One row per camera size, environment and reset; `n` is the number of robots or vehicles in the scene."""
    jobs: list[Callable[[], dict[str, Any]]] = [
        partial(camera, 160, 120),
        partial(camera, 320, 240),
        partial(multi_robot, stock=True),
        partial(multi_robot, stock=False),
        connected_driving,
        *(partial(reset, scene) for scene in SCENES),
    ]
    several: list[Callable[[], list[dict[str, Any]]]] = [
        *(partial(step_parts, "multi_robot", *size, params=speed_params(n)) for size in SIZES for n in TEAMS),
        *(partial(step_parts, "connected_driving", *size) for size in SIZES),
    ]
    out: list[dict[str, Any]] = []
    total = len(jobs) + len(several)
    for i, job in enumerate(jobs):
        progress(i, total)
        out.append(job())
    for i, parts in enumerate(several):
        progress(len(jobs) + i, total)
        out += parts()
    progress(total, total)
    return out


def step_parts(scene: str, width: int, height: int, params: Any = None) -> list[dict[str, Any]]:
    """What a step of two robots is made of: rows `part_<scene>_<width>x<height>_<part>`, rates of each part alone.

    `world` moves the simulator and takes the snapshot, `cameras` draws both pictures, `scoring` scores empty claims,
    `step` is the whole; the rest of it is decoding actions and making observations.
    """
    env = parallel_env(scene, params=params, width=width, height=height, max_cycles=10**9)
    try:
        env.reset(seed=0)
        now, claims = env.now(), [Claims.empty(env.max_detections, 1)] * 2
        controls = np.zeros((2, env.world.control_size))
        rig, exposures = env.cameras()
        saved, step = env.save_state(), stepper(env, controls)

        def move() -> None:
            env.world.step(controls)
            env.world.snapshot()

        def whole() -> None:
            if not env.agents:  # a collision ended the episode
                env.restore_state(saved)
            step()

        parts: dict[str, Callable[[], object]] = {
            "cameras": lambda: rig.shoot(now.snapshot, exposures),
            "scoring": lambda: score(claims, now.truth),
            "world": move,
            "step": whole,
        }
        out = []
        for part, job in parts.items():
            env.restore_state(saved)
            rate, _ = rates(job, seconds=0.05, rounds=3, clock=process_time)
            what = f"part_{scene}_{width}x{height}_{part}"
            out.append(row("envs", what, len(now.snapshot.identity), rate, None, None))
        return out
    finally:
        env.close()


def camera(width: int, height: int) -> dict[str, Any]:
    """RGB, depth and ids of 15 low-poly robots; TinyRenderer draws the same meshes with shadow=0."""
    ours, tiny, close = contenders(width, height, robots=N_ROBOTS)
    try:
        mine, theirs = rates(ours, tiny, clock=process_time)
    finally:
        close()
    return row("envs", f"camera_{width}x{height}", N_ROBOTS, mine, "TinyRenderer, same meshes, shadow=0", theirs)


def multi_robot(stock: bool) -> dict[str, Any]:
    """Whole steps with two 160x120 cameras, against the scene as plain pybullet users build it.

    Episode by episode: both sides play the same scene with the same controls, an episode's usual number of steps.
    """
    params = speed_params(N_ROBOTS)
    # TinyRenderer runs without shadows; where only the renderer differs, ours does too.
    look = None if stock else PLAIN
    env = parallel_env("multi_robot", params=params, width=160, height=120, look=look)
    peer = TinyPeer(2, params, width=160, height=120, stock=stock)
    controls = np.array([[0.2, 0.1], [0.2, -0.1]])
    world, step = env.world, stepper(env, controls)
    assert isinstance(world, MultiRobotWorld)
    mine, theirs = [], []
    try:
        for seed in range(STOCK_EPISODES if stock else EPISODES):
            env.reset(seed=seed)
            peer.follow(world)
            mine.append(_rate(step, env.max_cycles))
            theirs.append(_rate(partial(peer.step, controls), env.max_cycles))
    finally:
        env.close()
        peer.close()
    if stock:
        name, other = "multi_robot_v0", "stock Husky URDFs, wheel motors, TinyRenderer"
    else:
        name, other = "multi_robot_v0_like_for_like", "same box bodies and meshes, TinyRenderer"
    # The first episode compiled.
    return row("envs", name, N_ROBOTS, float(np.median(mine[1:])), other, float(np.median(theirs[1:])))


def connected_driving() -> dict[str, Any]:
    """Whole steps on the intersection with two 320x240 cameras, against bare highway-env's Kinematics observation.

    Episode by episode, so that both sides have the same traffic: a twin of the scene at its reset, then as many steps.
    How the vehicles' controls are found counts on neither side: the peer's are idle.
    """
    from ..envs.worlds.highway_peer import bare_intersection

    env = parallel_env("connected_driving")
    world = env.world
    assert isinstance(world, ConnectedDrivingWorld)
    mine, theirs, vehicles = [], [], []
    try:
        for seed in range(DRIVING_EPISODES):
            env.reset(seed=seed)
            peer, idle = bare_intersection(world)
            vehicles.append(len(world.traffic()))
            steps, seconds = 0, 0.0
            while env.agents:
                actions = silent_actions(env.agents, scripted_controls(world), env.max_detections)
                start = process_time()
                env.step(actions)
                seconds += process_time() - start
                steps += 1
            mine.append(steps / seconds)
            theirs.append(_rate(partial(peer.step, idle), steps))
            peer.close()
    finally:
        env.close()
    # The first episode compiled.
    return row(
        "envs",
        "connected_driving_v0",
        round(float(np.mean(vehicles))),
        float(np.median(mine[1:])),
        "bare highway-env intersection, same traffic, Kinematics observation",
        float(np.median(theirs[1:])),
    )


def reset(scene: str) -> dict[str, Any]:
    """Resets of one environment, against building it anew for every episode."""
    env = parallel_env(scene)

    def anew() -> None:
        fresh = parallel_env(scene)
        fresh.reset(seed=0)
        fresh.close()

    try:
        mine, theirs = rates(lambda: env.reset(seed=0), anew, seconds=0.5, rounds=3, clock=process_time)
        n = len(env.snapshot().identity)
    finally:
        env.close()
    return row("envs", f"reset_{scene}", n, mine, "building the environment anew", theirs)


def _rate(job: Callable[[], object], times: int) -> float:
    """Runs per second of the processor."""
    start = process_time()
    for _ in range(times):
        job()
    return times / (process_time() - start)


def stepper(env: CollaborativeEnv, controls: Any) -> Callable[[], object]:
    """A step with fixed controls that claims nothing."""
    actions = silent_actions(env.possible_agents, controls, env.max_detections)
    return lambda: env.step(actions)
