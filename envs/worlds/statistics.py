"""What a scene is like, measured on its rendered views: objects per view, how many are covisible, how many are hidden.

No matcher and no perception is involved: this is what presets are judged by.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ..camera.raster import Rasterizer, intrinsics_from_fov
from .world import Array, Snapshot, World

HIDDEN_SHARE = 0.1


@dataclass(frozen=True)
class SceneStatistics:
    """Means over instants, pooled over views or pairs of views.

    Attributes:
        instants: how many were looked at.
        objects: in the scene.
        objects_per_view: with at least `min_pixels` visible pixels.
        objects_per_view_low, objects_per_view_high: 10th and 90th percentile of that.
        views_of_10_to_20: share of views with 10 to 20 objects.
        covisible_per_pair: objects visible in both views.
        non_covisible_per_view: share of a view's objects that the other view of the pair does not see.
        non_covisible_per_pair: share of the objects of either view that only one of them sees.
        pairs_without_covisible: share of pairs that see nothing in common.
        partly_hidden: share of the objects of a view that lose more than a tenth of their pixels to something in front.
        fully_hidden: of the objects that would have `min_pixels` in the image alone, the share that has fewer.
        look_alikes: share of a view's objects that share their look (mesh and colour) with another one in that view.
        classes: distinct classes per view.
        depth_m, depth_high_m: median and 90th percentile of the visible objects' distance along the optical axis.
        pixels: median number of visible pixels of a visible object.
        objects_by_robot: objects per view of each robot.
        partly_hidden_by_robot: `partly_hidden` of each robot's views.
    """

    instants: int
    objects: float
    objects_per_view: float
    objects_per_view_low: float
    objects_per_view_high: float
    views_of_10_to_20: float
    covisible_per_pair: float
    non_covisible_per_view: float
    non_covisible_per_pair: float
    pairs_without_covisible: float
    partly_hidden: float
    fully_hidden: float
    look_alikes: float
    classes: float
    depth_m: float
    depth_high_m: float
    pixels: float
    objects_by_robot: tuple[float, ...]
    partly_hidden_by_robot: tuple[float, ...]

    def as_dict(self) -> dict[str, float | tuple[float, ...]]:
        """Name to number, or to one number per robot."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, eq=False)
class View:
    """What one camera sees of m objects: `pixels` (m,) visible, `alone` (m,) with nothing else, `depth` (m,) m."""

    pixels: NDArray[np.int64]
    alone: NDArray[np.int64]
    depth: Array


def scene_statistics(
    world: World,
    seeds: Iterable[int],
    *,
    steps: tuple[int, ...] = (0, 12, 24),
    width: int = 320,
    height: int = 240,
    min_pixels: int = 60,
    controls: Callable[[World], Array] | None = None,
) -> SceneStatistics:
    """Statistics of `world` at the given `steps` of one episode per seed.

    `controls(world)` gives the controls (N, d) of each step; None = observers stand still. The world is reset but not
    closed.

    Raises:
        ValueError: no seed or no step was given.
    """
    raster = Rasterizer(world.meshes, width, height)
    still = np.zeros((world.n_robots, world.control_size))
    instants: list[tuple[Snapshot, list[View]]] = []
    for seed in seeds:
        world.reset(np.random.default_rng(seed))
        for step in range(max(steps, default=0) + 1):
            if step in steps:
                snapshot = world.snapshot()
                instants.append((snapshot, [view(world, snapshot, raster, k) for k in range(world.n_robots)]))
            world.step(still if controls is None else controls(world))
    if not instants:
        raise ValueError("scene_statistics needs at least one seed and one step")
    return _pooled(instants, min_pixels)


def view(world: World, snapshot: Snapshot, raster: Rasterizer, robot: int) -> View:
    """What the camera of `robot` sees of each object."""
    K = intrinsics_from_fov(raster.width, raster.height, float(world.horizontal_fov_rad[robot]))
    m = len(snapshot.identity)
    seen = raster.render(snapshot, robot, K).instances
    pixels = np.bincount(seen[seen >= 0], minlength=m).astype(np.int64)
    T = np.linalg.inv(snapshot.T_world_camera[robot])
    depth = snapshot.positions @ T[2, :3] + T[2, 3]
    alone = np.zeros(m, dtype=np.int64)
    for i in range(m):
        if depth[i] > 0 and i != snapshot.robot_object[robot]:
            alone[i] = _pixels_alone(raster, snapshot, robot, K, i)
    return View(pixels, alone, depth)


def _pixels_alone(raster: Rasterizer, snapshot: Snapshot, robot: int, K: Array, i: int) -> int:
    own = snapshot.body_object == i
    frame = raster.render_bodies(
        snapshot.body_mesh[own],
        snapshot.body_poses[own],
        snapshot.body_tints[own],
        snapshot.body_object[own],
        snapshot.light,
        snapshot.T_world_camera[robot],
        K,
    )
    return int((frame.instances == i).sum())


def _pooled(instants: list[tuple[Snapshot, list[View]]], min_pixels: int) -> SceneStatistics:
    counts, covered, classes, depths, pixels = [], [], [], [], []
    alone = hidden = alike = only_per_view = in_views = 0
    common, either, empty, pairs = 0, 0, 0, 0
    for snapshot, views in instants:
        visible = [v.pixels >= min_pixels for v in views]
        look = _looks(snapshot)
        for v, seen in zip(views, visible, strict=True):
            counts.append(int(seen.sum()))
            classes.append(len(np.unique(snapshot.object_class[seen])))
            depths.append(v.depth[seen])
            pixels.append(v.pixels[seen])
            covered.append(int((seen & (v.pixels < (1 - HIDDEN_SHARE) * v.alone)).sum()))
            alone += int((v.alone >= min_pixels).sum())
            hidden += int(((v.alone >= min_pixels) & ~seen).sum())
            alike += int((np.bincount(look[seen], minlength=1)[look[seen]] > 1).sum())
        for a, b in combinations(visible, 2):
            both = int((a & b).sum())
            pairs += 1
            empty += both == 0
            common += both
            either += int((a | b).sum())
            in_views += int(a.sum() + b.sum())
            only_per_view += int(a.sum() + b.sum()) - 2 * both
    low, high = np.percentile(counts, [10, 90])
    depth = np.concatenate(depths)
    total = max(sum(counts), 1)
    by_robot = np.reshape(counts, (len(instants), -1)).sum(0)
    covered_by_robot = np.reshape(covered, (len(instants), -1)).sum(0)
    return SceneStatistics(
        instants=len(instants),
        objects=float(np.mean([len(s.identity) for s, _ in instants])),
        objects_per_view=float(np.mean(counts)),
        objects_per_view_low=float(low),
        objects_per_view_high=float(high),
        views_of_10_to_20=float(np.mean([10 <= c <= 20 for c in counts])),
        covisible_per_pair=common / max(pairs, 1),
        non_covisible_per_view=only_per_view / max(in_views, 1),
        non_covisible_per_pair=(either - common) / max(either, 1),
        pairs_without_covisible=empty / max(pairs, 1),
        partly_hidden=sum(covered) / total,
        fully_hidden=hidden / max(alone, 1),
        look_alikes=alike / total,
        classes=float(np.mean(classes)),
        depth_m=float(np.median(depth)) if len(depth) else float("nan"),
        depth_high_m=float(np.percentile(depth, 90)) if len(depth) else float("nan"),
        pixels=float(np.median(np.concatenate(pixels))) if len(depth) else float("nan"),
        objects_by_robot=tuple((by_robot / len(instants)).tolist()),
        partly_hidden_by_robot=tuple((covered_by_robot / np.maximum(by_robot, 1)).tolist()),
    )


def _looks(snapshot: Snapshot) -> NDArray[np.int64]:
    """A number (m,) for each distinct look: mesh and tint of an object's first body."""
    m = len(snapshot.identity)
    first = np.array([int(np.argmax(snapshot.body_object == i)) for i in range(m)], dtype=np.int64)
    keys = [(int(snapshot.body_mesh[b]), *np.round(snapshot.body_tints[b], 6).tolist()) for b in first]
    numbers: dict[tuple[float, ...], int] = {}
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.int64)
