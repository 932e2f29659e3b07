"""The cameras of all robots of an environment: one backend, one look, and effects that each episode draws anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..worlds.world import Array, Mesh, Snapshot
from .backends import Camera, make_camera
from .effects import EffectRanges, SensorCamera, SensorEffects
from .frame import Frame
from .raster import Look, Rasterizer

BACKENDS = ("raster", "tiny", "egl")


@dataclass(frozen=True, eq=False)
class Exposures:
    """One episode's cameras: each robot's effects, and what draws their noise. A deep copy is their saved state."""

    effects: tuple[SensorEffects, ...]
    rng: np.random.Generator


class CameraRig:
    """Cameras of N robots; the renderer is built at the first picture.

    Args:
        meshes: every mesh a snapshot may refer to.
        width, height: pixels.
        intrinsics: (N, 3, 3).
        backend: "raster" (ours), "tiny" or "egl" (pybullet's).
        look: of our camera; None = `Look()`.
        effects: ranges from which every episode draws each camera's character; None = ideal cameras.
        own_body: (N,) whose cameras see the robot they sit on; None = nobody's.

    Raises:
        ValueError: no such backend; a look or effects for a backend other than ours.
    """

    def __init__(
        self,
        meshes: Sequence[Mesh],
        width: int,
        height: int,
        intrinsics: Array,
        *,
        backend: str = "raster",
        look: Look | None = None,
        effects: EffectRanges | None = None,
        own_body: Sequence[bool] | None = None,
    ) -> None:
        if backend not in BACKENDS:
            raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, got {backend!r}")
        if backend != "raster" and (look is not None or effects is not None):
            raise ValueError(f"look and effects are of our own camera, backend 'raster'; got backend={backend!r}")
        self.intrinsics = intrinsics
        self._meshes, self._width, self._height = tuple(meshes), width, height
        self._backend, self._look, self._ranges = backend, look, effects
        self._own_body = None if own_body is None or not any(own_body) else np.array(own_body)
        self._camera: Camera | None = None
        self._sensors: list[SensorCamera] = []
        self._sensors_of: tuple[SensorEffects, ...] = ()

    def begin(self, rng: np.random.Generator) -> Exposures:
        """A new episode's cameras."""
        if self._ranges is None:
            return Exposures((), rng)
        return Exposures(tuple(self._ranges.sample(rng) for _ in self.intrinsics), rng)

    def shoot(self, snapshot: Snapshot, exposures: Exposures, robots: Sequence[int] | None = None) -> tuple[Frame, ...]:
        """A fresh frame of every robot's camera, or of those of `robots`."""
        camera = self._renderer()
        if self._own_body is not None:
            # A renderer leaves out the object that a robot is: to it, these are none.
            snapshot = replace(snapshot, robot_object=np.where(self._own_body, -1, snapshot.robot_object))
        robots = range(len(self.intrinsics)) if robots is None else robots
        if not exposures.effects:
            return tuple(camera.render(snapshot, i, self.intrinsics[i]) for i in robots)
        assert isinstance(camera, Rasterizer)
        if self._sensors_of != exposures.effects:
            self._sensors_of = exposures.effects
            self._sensors = [
                SensorCamera(camera, K, effects) for K, effects in zip(self.intrinsics, exposures.effects, strict=True)
            ]
        return tuple(self._sensors[i].render(snapshot, i, exposures.rng) for i in robots)

    def close(self) -> None:
        """Release a pybullet backend; calling it twice is harmless."""
        close = getattr(self._camera, "close", None)
        if close is not None:
            close()
        self._camera = None

    def _renderer(self) -> Camera:
        if self._camera is None:
            options: dict[str, Any] = {"look": self._look or Look()} if self._backend == "raster" else {}
            self._camera = make_camera(self._backend, self._meshes, self._width, self._height, **options)
        return self._camera
