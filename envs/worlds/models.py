"""Models of robots and obstacles: low-poly meshes with their class and bounding box."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

from ..camera import shapes
from .urdf import urdf_mesh
from .wheels import husky_urdf
from .world import Array, Mesh, ObjectClass

ROBOT_CLASSES = (
    ObjectClass("husky", 0.2),
    ObjectClass("rover", 0.2),
    ObjectClass("carrier", 0.3),
    ObjectClass("drone", 0.1),
    ObjectClass("crate", 0.4),
)
"""What detectors call the objects of all robot scenes; shared, so that one detector serves them all. Depths at scale 1,
as measured in the scenes: the visible surface curves towards the middle, so they are less than half of an extent."""

DARK, GREY, LENS = (48, 49, 53), (122, 124, 130), (30, 34, 48)
WOOD, WOOD_DARK = (190, 150, 100), (140, 104, 66)
LEAF, BARK = (74, 116, 62), (96, 74, 54)


@dataclass(frozen=True, eq=False)
class Model:
    """A kind of body: mesh (origin on the ground, x forward) and class (index into `ROBOT_CLASSES`, -1 = scenery)."""

    name: str
    mesh: Mesh
    object_class: int

    @cached_property
    def size(self) -> Array:
        """(3,) m: length, width, height of the bounding box."""
        low, high = shapes.extent(self.mesh)
        return high - low

    @cached_property
    def centre(self) -> Array:
        """(3,) m: centre of the bounding box in the body frame."""
        low, high = shapes.extent(self.mesh)
        return 0.5 * (low + high)


def models(scale: float = 1.0, stock_detail_m: float | None = None) -> tuple[Model, ...]:
    """Every model of the robot scenes, robots and obstacles at `scale`; their order is part of the version.

    With `stock_detail_m` the Husky is pybullet's own mesh, simplified to that detail; None = our low-poly one.
    """
    plain = shapes.husky(sides=10) if stock_detail_m is None else stock_husky(stock_detail_m)
    robots = (
        Model("husky", shapes.scale(plain, scale), 0),
        Model("rover", shapes.scale(rover(), scale), 1),
        Model("carrier", shapes.scale(carrier(), scale), 2),
        Model("drone", shapes.scale(drone(), scale), 3),
        Model("crate", shapes.scale(crate(), scale), 4),
    )
    scenery = (
        Model("container", shapes.scale(container(), scale), -1),
        Model("barrier", shapes.scale(barrier(), scale), -1),
        Model("tree", tree(), -1),
        Model("shed", shed(), -1),
        Model("wall", wall(), -1),
    )
    return robots + scenery


@lru_cache(maxsize=8)
def stock_husky(detail_m: float) -> Mesh:
    """The Husky whose URDF and meshes pybullet ships, its yellow takes the tint; 36,000 triangles at detail 0."""
    return urdf_mesh(husky_urdf(), detail_m=detail_m, colors={"Yellow": shapes.WHITE})


def rover() -> Mesh:
    """A six-wheeled robot with a tall mast, 1.1 x 0.8 x 1.0 m."""
    parts = [
        shapes.box((0.95, 0.46, 0.16), center=(0, 0, 0.36)),
        shapes.box((0.5, 0.4, 0.1), DARK, (-0.15, 0, 0.48)),
        shapes.box((0.05, 0.05, 0.4), GREY, (0.3, 0, 0.64)),
        shapes.box((0.14, 0.26, 0.14), center=(0.3, 0, 0.9)),
        shapes.box((0.02, 0.2, 0.08), LENS, (0.38, 0, 0.9)),
        shapes.box((0.36, 0.74, 0.02), (52, 70, 128), (-0.32, 0, 0.56)),
    ]
    wheels = [shapes.wheel(0.16, 0.14, (x, y, 0.16), sides=8) for x in (-0.38, 0.0, 0.38) for y in (-0.33, 0.33)]
    return shapes.merge(*parts, *wheels)


def carrier() -> Mesh:
    """A long flat-bed robot with a load, 1.4 x 0.8 x 0.75 m."""
    parts = [
        shapes.box((1.4, 0.6, 0.16), center=(0, 0, 0.3)),
        shapes.texture(shapes.box((0.8, 0.56, 0.36), WOOD, (-0.2, 0, 0.56)), "wood"),
        shapes.box((0.82, 0.58, 0.05), WOOD_DARK, (-0.2, 0, 0.56)),
        shapes.box((0.26, 0.5, 0.28), center=(0.5, 0, 0.52)),
        shapes.box((0.02, 0.42, 0.12), LENS, (0.635, 0, 0.56)),
    ]
    wheels = [shapes.wheel(0.2, 0.14, (x, y, 0.2), sides=8) for x in (-0.45, 0.45) for y in (-0.33, 0.33)]
    return shapes.merge(*parts, *wheels)


def drone() -> Mesh:
    """A quadrotor, 0.8 x 0.8 x 0.2 m, its feet at the origin."""
    parts = [shapes.box((0.26, 0.18, 0.09), center=(0, 0, 0.12)), shapes.box((0.08, 0.08, 0.06), LENS, (0.08, 0, 0.05))]
    for x in (-0.27, 0.27):
        for y in (-0.27, 0.27):
            parts.append(shapes.box((0.05, 0.05, 0.16), DARK, (x, y, 0.08)))
            parts.append(shapes.cylinder(0.13, 0.02, GREY, sides=8, center=(x, y, 0.18)))
    arm = shapes.box((0.76, 0.04, 0.03), DARK, (0, 0, 0.13))
    parts += [shapes.rotate(arm, (0, 0, 1), a) for a in (0.785398, -0.785398)]
    return shapes.merge(*parts)


def crate() -> Mesh:
    """A cube of 0.9 m with battens."""
    size = 0.9
    parts = [shapes.texture(shapes.box((size, size, size), center=(0, 0, size / 2)), "wood")]
    for z in (0.06, size - 0.06):
        parts.append(shapes.box((size + 0.03, size + 0.03, 0.1), (205, 195, 180), (0, 0, z)))
    return shapes.merge(*parts)


def container() -> Mesh:
    """A box of 2.4 x 1.2 x 1.3 m with ribs: hides whatever stands behind it."""
    ribs = [shapes.box((0.08, 1.24, 1.3), (200, 200, 200), (x, 0, 0.65)) for x in (-1.1, -0.37, 0.37, 1.1)]
    sides = shapes.texture(shapes.box((2.4, 1.2, 1.3), center=(0, 0, 0.65)), "ribs")
    return shapes.merge(sides, *ribs)


def barrier() -> Mesh:
    """A road barrier, 2 x 0.5 x 0.85 m."""
    outline = [(-0.25, 0.0), (0.25, 0.0), (0.1, 0.85), (-0.1, 0.85)]
    body = shapes.rotate(shapes.side_profile(outline, 2.0), (0, 0, 1), 1.5707963267948966)
    return shapes.texture(body, "grain")


def tree() -> Mesh:
    """A tree of 5 m."""
    return shapes.merge(
        shapes.cylinder(0.16, 2.0, BARK, sides=6, center=(0, 0, 1.0)),
        shapes.texture(shapes.sphere((1.3, 1.3, 1.6), LEAF, rings=5, sides=8, center=(0, 0, 3.4)), "leaves"),
    )


def wall() -> Mesh:
    """A panel of 2.5 x 0.1 x 2.2 m with a dark skirting."""
    return shapes.merge(
        shapes.texture(shapes.box((2.5, 0.1, 2.2), center=(0, 0, 1.1)), "grain"),
        shapes.box((2.5, 0.14, 0.12), DARK, (0, 0, 0.06)),
        shapes.box((0.06, 0.12, 2.2), (190, 190, 190), (1.22, 0, 1.1)),
    )


def shed() -> Mesh:
    """A building of 8 x 5 x 4 m with a gabled roof."""
    gable = [(-2.7, 0.0), (2.7, 0.0), (0.0, 1.3)]
    roof = shapes.rotate(shapes.side_profile(gable, 8.4, (120, 84, 76)), (0, 0, 1), 1.5707963267948966)
    door = shapes.box((1.8, 0.1, 2.2), (96, 100, 108), (0.5, -2.5, 1.1))
    windows = [shapes.box((0.9, 0.1, 0.8), (88, 108, 126), (x, -2.5, 1.9)) for x in (-2.6, 2.8)]
    house = shapes.texture(shapes.box((8, 5, 3), center=(0, 0, 1.5)), "bricks")
    tiles = shapes.texture(shapes.translate(roof, (0, 0, 3)), "tiles")
    return shapes.merge(house, tiles, door, *windows)
