"""A scene of one's own: coloured boxes on a plain, robots that turn and drive."""

import numpy as np

from covis.envs.camera.shapes import box
from covis.envs.worlds.world import Light, ObjectClass, Snapshot

CAMERA_HEIGHT_M = 1.0
CAMERA_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # columns: right, down, forward


class BoxWorld:
    classes = (ObjectClass("red", 0.4), ObjectClass("blue", 0.4))
    meshes = (box((0.8, 0.8, 0.8), color=(220, 60, 50)), box((0.8, 0.8, 0.8), color=(50, 90, 220)))
    control_size = 2
    state_size = 2
    step_seconds = 0.2
    ends_on_collision = False

    def __init__(self, n_robots=2, n_boxes=8):
        self.n_robots, self.max_objects = n_robots, n_boxes
        self.horizontal_fov_rad = np.full(n_robots, 1.2)

    def reset(self, rng):
        self.time = 0.0
        self.boxes = np.column_stack([rng.uniform(-4, 4, (self.max_objects, 2)), np.full(self.max_objects, 0.4)])
        self.kinds = rng.integers(0, 2, self.max_objects)
        angle = np.linspace(0, np.pi / 2, self.n_robots)
        self.xy = -8 * np.column_stack([np.cos(angle), np.sin(angle)])
        self.heading, self.speed = angle, np.zeros(self.n_robots)

    def step(self, controls):
        self.speed = 1.5 * controls[:, 0]
        self.heading = self.heading + self.step_seconds * controls[:, 1]
        direction = np.column_stack([np.cos(self.heading), np.sin(self.heading)])
        self.xy = self.xy + self.step_seconds * self.speed[:, None] * direction
        self.time += self.step_seconds

    def snapshot(self):
        m, n = self.max_objects, self.n_robots
        bodies = np.tile(np.eye(4), (m, 1, 1))
        bodies[:, :3, 3] = self.boxes
        cameras = np.tile(np.eye(4), (n, 1, 1))
        for i, heading in enumerate(self.heading):
            c, s = np.cos(heading), np.sin(heading)
            cameras[i, :3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ CAMERA_AXES
            cameras[i, :3, 3] = (*self.xy[i], CAMERA_HEIGHT_M)
        return Snapshot(
            time=self.time,
            identity=np.arange(m),
            object_class=self.kinds.copy(),
            positions=self.boxes.copy(),
            velocities=np.zeros((m, 3)),
            headings=np.zeros(m),
            sizes=np.full((m, 3), 0.8),
            body_mesh=self.kinds.copy(),
            body_poses=bodies,
            body_tints=np.ones((m, 3)),
            body_object=np.arange(m),
            T_world_camera=cameras,
            robot_object=np.full(n, -1),
            robot_velocity=np.zeros((n, 3)),
            robot_state=np.column_stack([self.speed, self.heading]),
            collided=np.zeros(n, dtype=bool),
            light=Light(),
        )

    def close(self):
        pass
