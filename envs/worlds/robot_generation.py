"""Robot scenes drawn at random: where robots and obstacles stand, what they look like, how cameras sit on them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .layout import in_disc, observers_around, place_apart, team_layout
from .lighting import sample_light
from .models import Model, models
from .robot_params import RobotSceneParams
from .team import TeamRoutes, draw_routes
from .world import Array, Light

MAX_OBSERVERS = 8
FLEET_COLORS = ((240, 196, 32), (226, 120, 40), (196, 60, 48), (84, 140, 76), (64, 112, 176), (208, 208, 204))
UNIQUE_COLORS = ((230, 60, 160), (40, 200, 210), (150, 80, 210), (120, 220, 60), (250, 250, 250))
CRATE_COLORS = ((190, 150, 100), (128, 132, 140), (110, 140, 120), (170, 90, 70))
UNIQUE_MODELS = ("rover", "carrier", "husky")


@dataclass(frozen=True, eq=False)
class Scene:
    """What stays the same over an episode: r robots (N observers first), s bodies that stand still.

    Attributes:
        robot_model: (r,) index into the world's models.
        obstacles: (k, 3) planar poses.
        static_poses: (s, 4, 4) T_world_body; the obstacles first.
        static_model: (s,) index into the world's models.
        static_objects: how many of the static bodies, from the first, are objects.
        tints: (r + s, 3).
        T_robot_camera: (N, 4, 4).
        light: sun and sky.
        routes: the team's.
    """

    robot_model: NDArray[np.int64]
    obstacles: Array
    static_poses: Array
    static_model: NDArray[np.int64]
    static_objects: int
    tints: Array
    T_robot_camera: Array
    light: Light
    routes: TeamRoutes


class RobotSceneGenerator:
    """Draws the scenes of N observers and their team; the worlds are made of it.

    Attributes:
        params: of the scenes.
        n_robots: N.
        models: bodies that a scene may hold.
    """

    n_flyers = 0
    """Observers that fly: the first ones."""

    def __init__(self, n_robots: int, params: RobotSceneParams) -> None:
        """Raises ValueError for a number of observers that does not fit, TypeError for parameters of something else."""
        if not isinstance(params, RobotSceneParams):
            raise TypeError(f"params must be those of a robot scene, got {type(params).__name__}")
        self.params = params
        self.n_robots = _checked_observers(n_robots, params)
        self.models: tuple[Model, ...] = models(
            params.scale, params.mesh_detail_m if params.meshes == "stock" else None
        )
        self._n_objects = self.n_robots + params.n_team

    def obstacle_sizes(self) -> Array:
        """Length and width (k, 2) m of as many obstacles as a scene can have."""
        name = "container" if self.params.obstacles == "scenery" else self.params.obstacles
        return np.tile(self.models[self._index(name)].size[:2], (self.params.n_obstacles[1], 1))

    def _generate(self, rng: np.random.Generator) -> tuple[Scene, Array, Array]:
        """A scene, planar poses (r - f, 3) of the robots on the ground and (f, 10) of those in the air."""
        p = self.params
        radius = rng.uniform(*p.team_radius_m)
        team = self._place_team(rng, radius)
        grounded = self._place_observers(rng, team)
        flight = self._place_flyers(rng)
        planar = np.vstack([grounded, team])
        obstacles = self._place_obstacles(rng, radius, planar)
        backdrop_poses, backdrop_model, backdrop_tints = self._backdrop(rng)
        routes = draw_routes(
            rng,
            team[:, :2],
            radius,
            moving_share=p.moving_share,
            speed_mps=p.team_speed_mps,
            max_turn=p.max_turn_radps,
            keep_away_m=1.3 * p.separation_m,
            arrived_m=0.6 * p.scale,
        )
        model, tints = self._looks(rng)
        obstacle_model = self._index(self._obstacle_model(rng))
        fleet = tints[-1] if p.n_team else np.array(FLEET_COLORS[0]) / 255.0
        color = fleet if p.obstacles == "husky" else np.array(CRATE_COLORS[int(rng.integers(len(CRATE_COLORS)))]) / 255
        k = len(obstacles)
        scene = Scene(
            robot_model=model,
            obstacles=obstacles,
            static_poses=np.concatenate([planar_poses(obstacles), backdrop_poses]),
            static_model=np.concatenate([np.full(k, obstacle_model, dtype=np.int64), backdrop_model]),
            static_objects=0 if p.obstacles == "scenery" else k,
            tints=np.vstack([tints, np.tile(color, (k, 1)), backdrop_tints]),
            T_robot_camera=self._mounts(rng),
            light=sample_light(rng, p.times_of_day),
            routes=routes,
        )
        return scene, planar, flight

    def _place_team(self, rng: np.random.Generator, radius: float) -> Array:
        p = self.params
        layout = p.layouts[int(rng.integers(len(p.layouts)))]
        proposal = team_layout(rng, layout, radius, p.n_team)
        spots = place_apart(proposal, p.n_team, p.separation_m, "robot")
        spots = spots[rng.permutation(p.n_team)]
        return np.column_stack([spots, rng.uniform(-np.pi, np.pi, p.n_team)])

    def _place_observers(self, rng: np.random.Generator, team: Array) -> Array:
        p = self.params
        low, high = p.observer_angle_deg
        return observers_around(
            rng,
            self.n_robots - self.n_flyers,
            p.observer_distance_m,
            (math.radians(low), math.radians(high)),
            p.observer_gaze_m,
            p.separation_m,
            team[:, :2],
        )

    def _place_flyers(self, rng: np.random.Generator) -> Array:
        return np.zeros((0, 10))

    def _place_obstacles(self, rng: np.random.Generator, radius: float, robots: Array) -> Array:
        p = self.params
        k = int(rng.integers(p.n_obstacles[0], p.n_obstacles[1] + 1))
        name = "husky" if p.obstacles == "husky" else "crate" if p.obstacles == "crate" else "container"
        half = 0.5 * float(np.hypot(*self.models[self._index(name)].size[:2]))
        clearance = max(p.separation_m, half + 0.6 * p.scale)
        observers = robots[: self.n_robots - self.n_flyers, :2]

        def draw(i: int) -> Array:
            for _ in range(20):  # right before a camera, an obstacle would hide everything
                spot = in_disc(rng, radius)
                if (np.hypot(*(observers - spot).T) > p.obstacle_distance_m).all():
                    break
            return spot

        apart = max(p.separation_m, 2.0 * half)
        spots = place_apart(draw, k, apart, "obstacle", taken=robots[:, :2], clearance_m=clearance)
        return np.column_stack([spots, rng.uniform(-np.pi, np.pi, k)])

    def _backdrop(self, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64], Array]:
        """Trees and sheds beyond the arena: poses, models, tints."""
        p = self.params
        if p.backdrop == "lab":
            return self._walls(rng)
        k = int(rng.integers(p.n_backdrop[0], p.n_backdrop[1] + 1))
        angle = rng.uniform(-np.pi, np.pi, k)
        edge = max(p.team_radius_m[1], p.observer_distance_m[1]) + 8.0
        distance = edge + rng.uniform(0.0, 25.0, k)
        heading = rng.uniform(-np.pi, np.pi, k)
        names = np.where(rng.uniform(size=k) < 0.7, self._index("tree"), self._index("shed"))
        tints = np.where(names[:, None] == self._index("tree"), 1.0, rng.uniform(0.55, 0.95, (k, 3)))
        planar = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), heading])
        return planar_poses(planar), names.astype(np.int64), tints

    def _walls(self, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64], Array]:
        """A square room about the arena, of panels 2.5 m long."""
        half = 1.25 * math.ceil((max(self.params.team_radius_m[1], self.params.observer_distance_m[1]) + 1.0) / 1.25)
        along = np.arange(-half + 1.25, half, 2.5)
        sides = [np.column_stack([along, np.full_like(along, half), np.zeros_like(along)])]
        for _ in range(3):
            x, y, heading = sides[-1].T
            sides.append(np.column_stack([-y, x, heading + np.pi / 2]))
        planar = np.vstack(sides)
        tint = np.tile(rng.uniform(0.6, 0.95, 3), (len(planar), 1))
        return planar_poses(planar), np.full(len(planar), self._index("wall"), dtype=np.int64), tint

    def _looks(self, rng: np.random.Generator) -> tuple[NDArray[np.int64], Array]:
        """Model (r,) and tint (r, 3) of each robot: one look for all but the unique ones."""
        p = self.params
        model = np.full(self._n_objects, self._index("husky"), dtype=np.int64)
        model[: self.n_flyers] = self._index("drone")
        fleet = np.array(FLEET_COLORS[int(rng.integers(len(FLEET_COLORS)))], dtype=np.float64)
        tints = np.tile(np.clip(fleet + rng.uniform(-12, 12, 3), 0, 255) / 255.0, (self._n_objects, 1))
        unique = round(p.unique_share * p.n_team)
        for i, color in enumerate(np.resize(rng.permutation(len(UNIQUE_COLORS)), unique)):
            at = self.n_robots + i
            model[at] = self._index(UNIQUE_MODELS[int(rng.integers(len(UNIQUE_MODELS)))])
            tints[at] = np.clip(np.array(UNIQUE_COLORS[int(color)]) + rng.uniform(-12, 12, 3), 0, 255) / 255.0
        return model, tints

    def _obstacle_model(self, rng: np.random.Generator) -> str:
        if self.params.obstacles != "scenery":
            return self.params.obstacles
        return ("container", "barrier")[int(rng.integers(2))]

    def _mounts(self, rng: np.random.Generator) -> Array:
        """T_robot_camera (N, 4, 4) of each observer."""
        p = self.params
        heights = rng.uniform(*p.camera_height_m, size=self.n_robots)
        tilts = np.radians(rng.uniform(*p.camera_tilt_deg, size=self.n_robots))
        return np.stack([camera_mount((0.1 * p.scale, 0.0, h), t) for h, t in zip(heights, tilts, strict=True)])

    def _index(self, name: str) -> int:
        return [model.name for model in self.models].index(name)


def camera_mount(position: tuple[float, float, float], tilt_rad: float) -> Array:
    """T_robot_camera (4, 4) of a camera that looks along x of its robot, tilted down by `tilt_rad`."""
    c, s = math.cos(tilt_rad), math.sin(tilt_rad)
    T = np.eye(4)
    T[:3, 0] = (0.0, -1.0, 0.0)  # right
    T[:3, 1] = (-s, 0.0, -c)  # down
    T[:3, 2] = (c, 0.0, -s)  # forward
    T[:3, 3] = position
    return T


def planar_poses(planar: Array) -> Array:
    """T_world_body (n, 4, 4) of bodies on the ground at planar poses (n, 3)."""
    out = np.zeros((len(planar), 4, 4))
    c, s = np.cos(planar[:, 2]), np.sin(planar[:, 2])
    out[:, 0, 0] = out[:, 1, 1] = c
    out[:, 1, 0], out[:, 0, 1] = s, -s
    out[:, :2, 3] = planar[:, :2]
    out[:, 2, 2] = out[:, 3, 3] = 1.0
    return out


def _checked_observers(n_robots: int, params: RobotSceneParams) -> int:
    if isinstance(n_robots, bool) or not isinstance(n_robots, int | np.integer):
        raise ValueError(f"n_robots must be a whole number, got {n_robots!r}")
    if not 2 <= n_robots <= MAX_OBSERVERS:
        raise ValueError(f"n_robots must be between 2 and {MAX_OBSERVERS}, got {n_robots}")
    around = 2 * math.pi * params.observer_distance_m[1]
    if n_robots * params.separation_m > around:
        raise ValueError(
            f"n_robots = {n_robots} observers do not fit on a circle of {params.observer_distance_m[1]} m with "
            f"separation_m = {params.separation_m}"
        )
    return int(n_robots)
