"""Robots on wheels: pybullet's stock Husky, four wheel motors, skid steering on a plane."""

from __future__ import annotations

import os
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from .bullet import CONTACT_M, BodyState, Engine, frozen_state, limbo, silence, wrapped
from .world import Array

WHEEL_RADIUS_M = 0.17775
TRACK_M = 0.5708
SLIP = 2.8
"""Skid steering turns slower than its wheels say: measured yaw rate at equal and opposite wheel speeds."""
MOTOR_NM = 40.0
WHEELS = ("front_left_wheel", "front_right_wheel", "rear_left_wheel", "rear_right_wheel")
LEFT = np.array([True, False, True, False])


def husky_urdf() -> str:
    """Path of the Husky that pybullet ships."""
    import pybullet_data

    return os.path.join(pybullet_data.getDataPath(), "husky", "husky.urdf")


class WheelDynamics(Engine):
    """Stock Huskies whose wheel motors follow the command; they accelerate, slip and push.

    `BodyState.inner` (n, 21): base position (3) and quaternion (4), linear (3) and angular (3) velocity, wheel angles
    (4) and rates (4).
    """

    def __init__(
        self,
        n_robots: int,
        obstacle_sizes: Array,
        *,
        scale: float = 1.0,
        step_seconds: float = 0.2,
        substeps: int = 24,
    ) -> None:
        """`n_robots` Huskies at `scale` and boxes (k, 2) of length and width in m."""
        super().__init__()
        self._n, self._scale = n_robots, scale
        self._obstacle_sizes = np.array(obstacle_sizes, dtype=np.float64).reshape(-1, 2)
        self._step_seconds, self._substeps = step_seconds, substeps
        self._obstacles = np.zeros((0, 3))
        self._joints: list[int] = []

    def build(self, p: ModuleType, client: int) -> None:
        """Bodies 0..n-1 are robots, n..n+k-1 obstacles, the last is the ground."""
        p.setPhysicsEngineParameter(
            fixedTimeStep=self._step_seconds / self._substeps,
            deterministicOverlappingPairs=1,
            solverResidualThreshold=0,
            physicsClientId=client,
        )
        p.setGravity(0, 0, -9.81, physicsClientId=client)
        for body in range(self._n):
            with silence():  # the URDF's links without inertia
                made = p.loadURDF(husky_urdf(), limbo(body), globalScaling=self._scale, physicsClientId=client)
            assert made == body
            p.changeDynamics(body, -1, activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING, physicsClientId=client)
        if self._n:
            names = [p.getJointInfo(0, j, client)[1].decode() for j in range(p.getNumJoints(0, client))]
            self._joints = [names.index(name) for name in WHEELS]
        for k, (length, width) in enumerate(self._obstacle_sizes):
            half = [length / 2, width / 2, 1.0]
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client)
            p.createMultiBody(0.0, shape, -1, limbo(self._n + k), physicsClientId=client)
        plane = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
        p.createMultiBody(0.0, plane, physicsClientId=client)
        self._place_obstacles(p, client)

    def rest(self, planar: Array) -> BodyState:
        """Robots standing still at planar poses (n, 3)."""
        planar = wrapped(planar)
        inner = np.zeros((len(planar), 21))
        inner[:, :2] = planar[:, :2]
        inner[:, 5], inner[:, 6] = np.sin(0.5 * planar[:, 2]), np.cos(0.5 * planar[:, 2])
        return frozen_state(planar, np.zeros_like(planar), inner)

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
        n, joints = self._n, self._joints
        self._set(p, client, state.inner)
        side = np.where(LEFT, -0.5, 0.5) * TRACK_M * SLIP
        rates = (commands[:, :1] / self._scale + commands[:, 1:] * side) / WHEEL_RADIUS_M
        for body, targets in enumerate(rates.tolist()):
            p.setJointMotorControlArray(
                body,
                joints,
                p.VELOCITY_CONTROL,
                targetVelocities=targets,
                forces=[MOTOR_NM] * 4,
                physicsClientId=client,
            )
        touched = np.zeros(n, dtype=bool)
        ground = n + len(self._obstacle_sizes)
        for _ in range(self._substeps):
            p.stepSimulation(client)
        for contact in p.getContactPoints(physicsClientId=client):
            if contact[8] <= CONTACT_M and ground not in contact[1:3] and contact[1] != contact[2]:
                touched[[b for b in contact[1:3] if b < n]] = True
        inner = self._get(p, client)
        heading = 2.0 * np.arctan2(inner[:, 5], inner[:, 6])
        planar = wrapped(np.column_stack([inner[:, :2], heading]))
        moved = wrapped(planar - state.planar) / self._step_seconds
        return frozen_state(planar, moved, inner), touched

    def _set(self, p: ModuleType, client: int, inner: Array) -> None:
        """Set robots to `inner` (n, 21) with an empty contact cache."""
        for body in range(self._n):
            p.resetBasePositionAndOrientation(body, limbo(body), (0, 0, 0, 1), client)
        p.performCollisionDetection(client)
        for body, row in enumerate(inner.tolist()):
            p.resetBasePositionAndOrientation(body, row[:3], row[3:7], client)
            p.resetBaseVelocity(body, row[7:10], row[10:13], client)
            for j, joint in enumerate(self._joints):
                p.resetJointState(body, joint, row[13 + j], row[17 + j], client)

    def _get(self, p: ModuleType, client: int) -> Array:
        rows = []
        for body in range(self._n):
            position, turn = p.getBasePositionAndOrientation(body, client)
            linear, angular = p.getBaseVelocity(body, client)
            wheels = p.getJointStates(body, self._joints, client)
            rows.append([*position, *turn, *linear, *angular, *(w[0] for w in wheels), *(w[1] for w in wheels)])
        return np.array(rows, dtype=np.float64).reshape(self._n, 21)

    def _place_obstacles(self, p: ModuleType, client: int) -> None:
        for k in range(len(self._obstacle_sizes)):
            position, half = limbo(self._n + k), 0.0
            if k < len(self._obstacles):
                x, y, heading = self._obstacles[k].tolist()
                position, half = (x, y, 0.0), 0.5 * heading
            p.resetBasePositionAndOrientation(self._n + k, position, (0.0, 0.0, np.sin(half), np.cos(half)), client)
