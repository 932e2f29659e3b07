"""Planar robots that pybullet moves: box bodies driven like unicycles, collisions on.

pybullet is used as a function: poses in, poses out. Before an environment step each body is set to the given pose; if
the engine still caches contacts, it first takes the bodies apart, which empties the cache. So a step depends on nothing
but its arguments. That is what makes episodes, saved states and worlds in other processes agree bit for bit.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import sys
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import atan2, cos, sin
from types import ModuleType
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .world import Array

LIMBO_M = 1000.0
TALL_M = 10.0
"""Height of a collision box: so tall that the shortest way out of a penetration is always horizontal."""
CONTACT_M = 1e-4


@contextlib.contextmanager
def silence() -> Iterator[None]:
    """Send file descriptors 1 and 2 to nowhere: C libraries print there, past `sys.stdout`."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    saved = []
    sink = os.open(os.devnull, os.O_WRONLY)
    try:
        for fd in (1, 2):
            with contextlib.suppress(OSError):
                saved.append((fd, os.dup(fd)))
                os.dup2(sink, fd)
        yield
    finally:
        with contextlib.suppress(Exception):
            ctypes.CDLL(None).fflush(None)  # what C still buffers must not come out after descriptor 1 is back
        for fd, copy in saved:
            os.dup2(copy, fd)
            os.close(copy)
        os.close(sink)


@functools.lru_cache(maxsize=1)
def load_pybullet() -> ModuleType:
    """The pybullet module, imported without its banner. Raises ImportError naming the extra to install."""
    try:
        with silence():
            import pybullet
    except ImportError as error:
        raise ImportError("this scene needs pybullet: pip install covis[envs]") from error
    return pybullet


def connect() -> int:
    """The client id of a new headless engine."""
    client = load_pybullet().connect(load_pybullet().DIRECT)
    if client < 0:
        raise RuntimeError("pybullet gave no client: too many worlds are open, close some")
    return int(client)


def _disconnect(client: int) -> None:
    p = load_pybullet()
    if p.isConnected(client):
        p.disconnect(client)


@dataclass(frozen=True, eq=False)
class BodyState:
    """Where n robots are; arrays are never written to.

    Attributes:
        planar: (n, 3) x m, y m, heading rad in [-pi, pi].
        velocity: (n, 3) m/s, m/s, rad/s, world frame, mean over the last step.
        inner: (n, k) what the dynamics need besides; k = 0 for box bodies.
    """

    planar: Array
    velocity: Array
    inner: Array


class Dynamics(Protocol):
    """How commands move robots. Everything that changes is in the `BodyState`; the engine remembers only shapes."""

    def rest(self, planar: Array) -> BodyState:
        """Robots standing still at planar poses (n, 3)."""

    def set_obstacles(self, planar: Array) -> None:
        """Put the first k obstacles at planar poses (k, 3), the others out of the way."""

    def advance(self, state: BodyState, commands: Array) -> tuple[BodyState, NDArray[np.bool_]]:
        """One environment step under commands (n, 2) = m/s forward, rad/s: new state, and who touched a thing (n,)."""

    def close(self) -> None:
        """End the engine; calling it twice is harmless."""


class Engine:
    """A lazily connected pybullet client that survives pickling (the copy connects to one of its own)."""

    def __init__(self) -> None:
        self._client: int | None = None
        self._finalizer: weakref.finalize | None = None

    @property
    def client(self) -> int:
        """The client id; connects and builds the bodies on first use."""
        if self._client is None:
            self._client = connect()
            self._finalizer = weakref.finalize(self, _disconnect, self._client)
            self.build(self.pybullet, self._client)
        return self._client

    @property
    def pybullet(self) -> ModuleType:
        """The module; not held, so that engines can be pickled."""
        return load_pybullet()

    def build(self, p: ModuleType, client: int) -> None:
        """Load every shape and body, once per client."""
        raise NotImplementedError

    def close(self) -> None:
        """End the engine; calling it twice is harmless."""
        if self._finalizer is not None:
            self._finalizer()
        self._client = self._finalizer = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_client": None, "_finalizer": None}


class BoxDynamics(Engine):
    """Box bodies whose base velocity follows the command (a unicycle); a body stops where another one stands."""

    def __init__(
        self,
        robot_sizes: Array,
        obstacle_sizes: Array,
        *,
        step_seconds: float = 0.2,
        updates: int = 2,
        substeps: int = 4,
    ) -> None:
        """Robots (n, 2) and obstacles (k, 2) of length and width in m.

        A step holds `updates` velocity commands, each of `substeps` engine steps.
        """
        super().__init__()
        self._robot_sizes = np.array(robot_sizes, dtype=np.float64).reshape(-1, 2)
        self._obstacle_sizes = np.array(obstacle_sizes, dtype=np.float64).reshape(-1, 2)
        self._step_seconds, self._updates, self._substeps = step_seconds, updates, substeps
        self._obstacles = np.zeros((0, 3))
        self._cache_empty = False

    def build(self, p: ModuleType, client: int) -> None:
        """One body per robot, then one per obstacle: body ids are 0..n-1 and n..n+k-1."""
        p.setPhysicsEngineParameter(
            fixedTimeStep=self._step_seconds / self._updates,
            numSubSteps=self._substeps,
            deterministicOverlappingPairs=1,
            solverResidualThreshold=0,  # else the number of iterations depends on which bodies share an island
            numSolverIterations=20,
            physicsClientId=client,
        )
        p.setGravity(0, 0, 0, physicsClientId=client)
        n = len(self._robot_sizes)
        for body, (length, width) in enumerate(np.vstack([self._robot_sizes, self._obstacle_sizes])):
            half = [length / 2, width / 2, TALL_M / 2]
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client)
            mass = 50.0 if body < n else 0.0
            made = p.createMultiBody(
                mass, shape, self.visual_shape(p, client, body), limbo(body), physicsClientId=client
            )
            assert made == body
            if mass:
                turning = mass * (length**2 + width**2) / 12
                p.changeDynamics(
                    body,
                    -1,
                    lateralFriction=0.2,
                    restitution=0,
                    linearDamping=0,
                    angularDamping=0,
                    localInertiaDiagonal=[1e5, 1e5, turning],  # robots turn about z alone
                    activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING,
                    physicsClientId=client,
                )
        self._place_obstacles(p, client)

    def visual_shape(self, p: ModuleType, client: int, body: int) -> int:
        """What pybullet's own renderers draw for a body: nothing."""
        return -1

    def rest(self, planar: Array) -> BodyState:
        """Robots standing still at planar poses (n, 3)."""
        planar = wrapped(planar)
        return frozen_state(planar, np.zeros_like(planar), np.zeros((len(planar), 0)))

    def set_obstacles(self, planar: Array) -> None:
        """Put the first k obstacles at planar poses (k, 3), the others out of the way."""
        if len(planar) > len(self._obstacle_sizes):
            raise ValueError(f"{len(planar)} obstacles given, built for {len(self._obstacle_sizes)}")
        self._obstacles = np.array(planar, dtype=np.float64).reshape(-1, 3)
        if self._client is not None:
            self._place_obstacles(self.pybullet, self._client)

    def advance(self, state: BodyState, commands: Array) -> tuple[BodyState, NDArray[np.bool_]]:
        """See `Dynamics.advance`."""
        client, p = self.client, self.pybullet
        set_velocity, get_pose = p.resetBaseVelocity, p.getBasePositionAndOrientation
        self._set_poses(p, client, state.planar)
        n = len(state.planar)
        interval = self._step_seconds / self._updates
        speed, rate = commands[:, 0].tolist(), commands[:, 1].tolist()
        angular = [(0.0, 0.0, r) for r in rate]
        heading = state.planar[:, 2].tolist()
        touching: set[int] = set()
        for _ in range(self._updates):
            for body in range(n):
                chord = heading[body] + 0.5 * interval * rate[body]
                set_velocity(body, (speed[body] * cos(chord), speed[body] * sin(chord), 0.0), angular[body], client)
            p.stepSimulation(client)
            heading = [h + interval * r for h, r in zip(heading, rate, strict=True)]
            contacts = p.getContactPoints(physicsClientId=client)
            turned: set[int] = set()
            for contact in contacts:
                bodies = contact[1:3]
                turned.update(bodies)
                if contact[8] <= CONTACT_M:
                    touching.update(bodies)
            for body in turned:
                if body < n:  # a contact may have turned it
                    heading[body] = _heading(get_pose(body, client)[1])
        self._cache_empty = not contacts
        touched = np.array([body in touching for body in range(n)], dtype=bool)
        planar = wrapped([_planar(*get_pose(body, client)) for body in range(n)])
        moved = wrapped(planar - state.planar) / self._step_seconds
        return frozen_state(planar, moved, state.inner), touched

    def _set_poses(self, p: ModuleType, client: int, planar: Array) -> None:
        """Set robots to planar poses (n, 3) with an empty contact cache."""
        set_pose = p.resetBasePositionAndOrientation
        if not self._cache_empty:
            for body in range(len(planar)):
                set_pose(body, limbo(body), (0.0, 0.0, 0.0, 1.0), client)
            p.performCollisionDetection(client)
            self._cache_empty = True
        for body, (x, y, heading) in enumerate(planar.tolist()):
            set_pose(body, (x, y, 0.0), (0.0, 0.0, sin(0.5 * heading), cos(0.5 * heading)), client)

    def _place_obstacles(self, p: ModuleType, client: int) -> None:
        n = len(self._robot_sizes)
        for k in range(len(self._obstacle_sizes)):
            position, turn = limbo(n + k), (0.0, 0.0, 0.0, 1.0)
            if k < len(self._obstacles):
                x, y, heading = self._obstacles[k].tolist()
                position, turn = (x, y, 0.0), (0.0, 0.0, np.sin(heading / 2), np.cos(heading / 2))
            p.resetBasePositionAndOrientation(n + k, position, turn, client)


def frozen_state(planar: Array, velocity: Array, inner: Array) -> BodyState:
    """A `BodyState` whose arrays refuse to be written to."""
    for array in (planar, velocity, inner):
        array.setflags(write=False)
    return BodyState(planar, velocity, inner)


def wrapped(planar: ArrayLike) -> Array:
    """A copy of (n, 3), its third column brought into [-pi, pi] rad; what is inside stays the same bit for bit."""
    out = np.array(planar, dtype=np.float64).reshape(-1, 3)
    out[:, 2] -= 2 * np.pi * np.round(out[:, 2] / (2 * np.pi))
    return out


def _planar(position: Sequence[float], turn: Sequence[float]) -> tuple[float, float, float]:
    """x m, y m, heading rad of a position and a quaternion."""
    return position[0], position[1], _heading(turn)


def _heading(turn: Sequence[float]) -> float:
    """Heading in rad of a quaternion (x, y, z, w) that turns about z."""
    return 2.0 * atan2(turn[2], turn[3])


def limbo(body: int) -> tuple[float, float, float]:
    """Where body number `body` stands while it is out of the way: far from everything and from every other one."""
    return (LIMBO_M + 20.0 * body, LIMBO_M, 0.5 * LIMBO_M)
