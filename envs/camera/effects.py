"""What a real camera adds to a picture: lens distortion, blur, vignette, exposure, noise; drawn anew for each episode.

Geometry first (the lens bends colours, depth and instances alike), then light. `SensorEffects()` changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ..worlds.world import Array, Snapshot
from .frame import Frame
from .raster import Rasterizer

NOISE_TABLE = 1 << 15
Range = tuple[float, float]


@dataclass(frozen=True)
class SensorEffects:
    """One camera's character.

    Attributes:
        exposure: factor on all colours.
        white_balance: factors on red, green and blue.
        contrast: factor on the distance from middle grey.
        blur_px: standard deviation of a Gaussian blur, pixels.
        vignette: loss of light in the image's corners, in [0, 1); it grows with the square of the radius.
        read_noise: standard deviation, in counts of 0 to 255, of noise that is everywhere.
        shot_noise: standard deviation at full brightness, in counts, of noise that grows with the root of the light.
        k1, k2: radial distortion: a ray at radius r from the axis (tangent) is seen at r (1 + k1 r^2 + k2 r^4).

    Raises:
        ValueError: a value out of its range.
    """

    exposure: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    contrast: float = 1.0
    blur_px: float = 0.0
    vignette: float = 0.0
    read_noise: float = 0.0
    shot_noise: float = 0.0
    k1: float = 0.0
    k2: float = 0.0

    def __post_init__(self) -> None:
        for name in ("exposure", "contrast"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("blur_px", "read_noise", "shot_noise"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if len(self.white_balance) != 3 or not min(self.white_balance) > 0:
            raise ValueError(f"white_balance must be three positive factors, got {self.white_balance}")
        if not 0 <= self.vignette < 1:
            raise ValueError(f"vignette must be in [0, 1), got {self.vignette}")
        if not (np.isfinite(self.k1) and np.isfinite(self.k2)):
            raise ValueError(f"k1 and k2 must be finite, got {self.k1}, {self.k2}")

    @property
    def distorts(self) -> bool:
        """Whether the lens bends anything."""
        return self.k1 != 0.0 or self.k2 != 0.0


@dataclass(frozen=True)
class EffectRanges:
    """Ranges (low, high) from which each episode's effects are drawn, uniformly and independently.

    `exposure_stops` is in powers of two; `color_cast` is the largest relative change of a colour channel.

    Raises:
        ValueError: a range that runs backwards.
    """

    exposure_stops: Range = (-0.5, 0.5)
    color_cast: Range = (0.0, 0.08)
    contrast: Range = (0.85, 1.15)
    blur_px: Range = (0.0, 0.8)
    vignette: Range = (0.0, 0.35)
    read_noise: Range = (0.5, 4.0)
    shot_noise: Range = (0.0, 6.0)
    k1: Range = (-0.12, 0.04)
    k2: Range = (0.0, 0.02)

    def __post_init__(self) -> None:
        for field in fields(self):
            low, high = getattr(self, field.name)
            if not low <= high:
                raise ValueError(f"{field.name} must be (low, high), got {(low, high)}")

    def sample(self, rng: np.random.Generator) -> SensorEffects:
        """One camera's effects."""
        cast = rng.uniform(*self.color_cast) * rng.uniform(-1.0, 1.0, 3)
        return SensorEffects(
            exposure=float(2.0 ** rng.uniform(*self.exposure_stops)),
            white_balance=(1.0 + float(cast[0]), 1.0 + float(cast[1]), 1.0 + float(cast[2])),
            contrast=float(rng.uniform(*self.contrast)),
            blur_px=float(rng.uniform(*self.blur_px)),
            vignette=float(rng.uniform(*self.vignette)),
            read_noise=float(rng.uniform(*self.read_noise)),
            shot_noise=float(rng.uniform(*self.shot_noise)),
            k1=float(rng.uniform(*self.k1)),
            k2=float(rng.uniform(*self.k2)),
        )


def distort(pixels: ArrayLike, intrinsics: Array, effects: SensorEffects) -> Array:
    """Where the lens puts what an ideal camera would see at pixels (n, 2)."""
    x = _normalised(pixels, intrinsics)
    r2 = np.sum(x * x, axis=1, keepdims=True)
    return _pixels(x * (1.0 + effects.k1 * r2 + effects.k2 * r2 * r2), intrinsics)


def undistort(pixels: ArrayLike, intrinsics: Array, effects: SensorEffects) -> Array:
    """The inverse of `distort`, (n, 2), by Newton's method on the radius.

    Raises:
        ValueError: a pixel beyond the radius at which the distortion stops being one-to-one.
    """
    x = _normalised(pixels, intrinsics)
    seen = np.linalg.norm(x, axis=1)
    radius = seen.copy()
    for _ in range(30):
        radius = np.clip(radius, 0.0, 1e3)
        r2 = radius * radius
        slope = 1.0 + 3.0 * effects.k1 * r2 + 5.0 * effects.k2 * r2 * r2
        step = (radius * (1.0 + effects.k1 * r2 + effects.k2 * r2 * r2) - seen) / np.where(slope > 0.05, slope, 0.05)
        radius = radius - step
        if np.all(np.abs(step) < 1e-13):
            break
    r2 = radius * radius
    right = np.abs(radius * (1.0 + effects.k1 * r2 + effects.k2 * r2 * r2) - seen) <= 1e-9
    wrong = ~(right & (1.0 + 3.0 * effects.k1 * r2 + 5.0 * effects.k2 * r2 * r2 > 0))
    if wrong.any():
        raise ValueError(f"k1 = {effects.k1}, k2 = {effects.k2} cannot be undone at radius {seen[wrong].min():.3g}")
    return _pixels(x * np.where(seen > 0, radius / np.maximum(seen, 1e-300), 1.0)[:, None], intrinsics)


def wide_view(
    effects: SensorEffects, intrinsics: Array, width: int, height: int, margin_limit: int = 4096
) -> tuple[int, int, Array]:
    """Width, height and intrinsics of the ideal picture that holds all a distorted one of (width, height) shows.

    Raises:
        ValueError: a margin of more than `margin_limit` pixels.
    """
    if not effects.distorts:
        return width, height, intrinsics
    u, v = np.linspace(0.0, width, 65), np.linspace(0.0, height, 65)
    border = np.vstack([np.column_stack([u, np.full(65, e)]) for e in (0.0, float(height))])
    border = np.vstack([border, *(np.column_stack([np.full(65, e), v]) for e in (0.0, float(width)))])
    source = undistort(border, intrinsics, effects)
    low = np.maximum(np.ceil(-source.min(0)), 0).astype(int) + 1
    high = np.maximum(np.ceil(source.max(0) - (width, height)), 0).astype(int) + 1
    if max(*low, *high) > margin_limit:
        raise ValueError(f"k1 = {effects.k1}, k2 = {effects.k2} need a margin of {max(*low, *high)} pixels")
    K = np.array(intrinsics, dtype=np.float64)
    K[0, 2] += low[0]
    K[1, 2] += low[1]
    return width + int(low[0] + high[0]), height + int(low[1] + high[1]), K


class Lens:
    """Bends an ideal picture as a lens does; looks every pixel up once, at construction.

    Args:
        effects: `k1` and `k2` count.
        intrinsics: (3, 3) of the distorted picture.
        width, height: of the distorted picture, pixels.

    Attributes:
        wide_width, wide_height, wide_intrinsics: of the ideal picture that `bend` takes.
    """

    def __init__(self, effects: SensorEffects, intrinsics: Array, width: int, height: int) -> None:
        self.wide_width, self.wide_height, self.wide_intrinsics = wide_view(effects, intrinsics, width, height)
        v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
        centres = undistort(np.column_stack([u.ravel(), v.ravel()]), intrinsics, effects)
        centres += self.wide_intrinsics[:2, 2] - np.asarray(intrinsics)[:2, 2]
        self._source = centres.reshape(height, width, 2).astype(np.float32)

    def bend(self, wide: Frame, out: Frame | None = None) -> Frame:
        """The distorted frame: colours interpolated, depth and instances of the nearest pixel."""
        height, width, _ = self._source.shape
        if wide.depth.shape != (self.wide_height, self.wide_width):
            raise ValueError(f"the lens takes {(self.wide_height, self.wide_width)} pixels, got {wide.depth.shape}")
        frame = Frame.empty(width, height) if out is None else out
        _bend(self._source, wide.rgb, wide.depth, wide.instances, frame.rgb, frame.depth, frame.instances)
        return frame


class SensorCamera:
    """One robot's camera with its effects: an ideal picture, bent by the lens, then exposed.

    Args:
        ideal: draws the world at the picture's size; its meshes are shared, so a camera an episode costs little.
        intrinsics: (3, 3) of the picture, that is of the camera without its distortion.
        effects: this camera's character.
    """

    def __init__(self, ideal: Rasterizer, intrinsics: Array, effects: SensorEffects) -> None:
        self.intrinsics, self.effects = intrinsics, effects
        self._ideal = ideal
        self._lens: Lens | None = None
        self._wide: Frame | None = None
        if effects.distorts:
            self._lens = Lens(effects, intrinsics, ideal.width, ideal.height)
            self._ideal = ideal.resized(self._lens.wide_width, self._lens.wide_height)
            self._wide = Frame.empty(self._lens.wide_width, self._lens.wide_height)

    def render(self, snapshot: Snapshot, robot: int, rng: np.random.Generator, *, out: Frame | None = None) -> Frame:
        """The frame of one robot's camera; `rng` draws the noise. Depth and instances are bent like the colours."""
        if self._lens is None:
            frame = self._ideal.render(snapshot, robot, self.intrinsics, out=out)
        else:
            wide = self._ideal.render(snapshot, robot, self._lens.wide_intrinsics, out=self._wide)
            frame = self._lens.bend(wide, out)
        expose(frame.rgb, self.effects, rng, out=frame.rgb)
        return frame


def expose(
    rgb: NDArray[np.uint8], effects: SensorEffects, rng: np.random.Generator, out: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Blur, vignette, exposure, colour and noise on a picture (H, W, 3); a fresh one, or `out`, which may be `rgb`."""
    result = np.empty_like(rgb) if out is None else out
    source = rgb
    if effects.blur_px > 0.05:
        source = _blurred(rgb, effects.blur_px)
    # One draw of normal numbers for all rows, each of which starts anywhere in it: many times faster than fresh ones.
    noisy = effects.read_noise > 0 or effects.shot_noise > 0
    normal = rng.standard_normal(NOISE_TABLE if noisy else 1, dtype=np.float32)
    offsets = rng.integers(0, len(normal), len(rgb))
    gain = np.array(effects.white_balance) * effects.exposure
    _expose(
        source,
        gain,
        effects.contrast,
        effects.vignette,
        effects.read_noise,
        effects.shot_noise,
        normal,
        offsets,
        result,
    )
    return result


def _normalised(pixels: ArrayLike, K: Array) -> Array:
    p = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    return (p - K[:2, 2]) / np.array([K[0, 0], K[1, 1]])


def _pixels(x: Array, K: Array) -> Array:
    return x * np.array([K[0, 0], K[1, 1]]) + K[:2, 2]


def _blurred(rgb: NDArray[np.uint8], sigma: float) -> NDArray[np.uint8]:
    reach = int(np.ceil(2.5 * sigma))
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    blurred = np.empty_like(rgb)
    _blur(rgb, (weights / weights.sum()).astype(np.float32), blurred)
    return blurred


@njit(cache=True, error_model="numpy")
def _bend(
    source: NDArray[np.float32],
    wide_rgb: NDArray[np.uint8],
    wide_depth: NDArray[np.float32],
    wide_instances: NDArray[np.int32],
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    instances: NDArray[np.int32],
) -> None:
    """Look pixels up at (u, v) = source (H, W, 2) of the wide picture: colours between four, else the nearest."""
    height, width = depth.shape
    tall, wide = wide_depth.shape
    f32 = np.float32
    for row in range(height):
        for column in range(width):
            u, v = source[row, column, 0], source[row, column, 1]
            i, j = min(max(int(u), 0), wide - 1), min(max(int(v), 0), tall - 1)
            depth[row, column] = wide_depth[j, i]
            instances[row, column] = wide_instances[j, i]
            x, y = max(u - f32(0.5), f32(0.0)), max(v - f32(0.5), f32(0.0))
            left, top = min(int(x), wide - 1), min(int(y), tall - 1)
            right, low = min(left + 1, wide - 1), min(top + 1, tall - 1)
            s, t = x - f32(left), y - f32(top)
            for k in range(3):
                upper = f32(wide_rgb[top, left, k]) * (f32(1.0) - s) + f32(wide_rgb[top, right, k]) * s
                lower = f32(wide_rgb[low, left, k]) * (f32(1.0) - s) + f32(wide_rgb[low, right, k]) * s
                rgb[row, column, k] = np.uint8(np.int32(upper * (f32(1.0) - t) + lower * t + f32(0.5)))


@njit(cache=True, error_model="numpy")
def _blur(rgb: NDArray[np.uint8], weights: NDArray[np.float32], out: NDArray[np.uint8]) -> None:
    """Separable blur, first along rows and then along columns; the border repeats."""
    height, width, _ = rgb.shape
    reach = len(weights) // 2
    f32 = np.float32
    half = np.zeros((height, width, 3), np.float32)
    for row in range(height):
        for n in range(-reach, reach + 1):
            w = weights[n + reach]
            for column in range(width):
                c = min(max(column + n, 0), width - 1)
                for k in range(3):
                    half[row, column, k] += w * f32(rgb[row, c, k])
    line = np.empty((width, 3), np.float32)
    for row in range(height):
        line[:] = f32(0.5)
        for n in range(-reach, reach + 1):
            w = weights[n + reach]
            r = min(max(row + n, 0), height - 1)
            for column in range(width):
                for k in range(3):
                    line[column, k] += w * half[r, column, k]
        for column in range(width):
            for k in range(3):
                out[row, column, k] = np.uint8(np.int32(min(line[column, k], f32(255.0))))


@njit(cache=True, error_model="numpy")
def _expose(
    rgb: NDArray[np.uint8],
    gain: Array,
    contrast: float,
    vignette: float,
    read_noise: float,
    shot_noise: float,
    normal: NDArray[np.float32],
    offsets: NDArray[np.int64],
    out: NDArray[np.uint8],
) -> None:
    """Vignette, gain (3,), contrast and noise; row r takes its normal numbers from place `offsets[r]` on."""
    height, width, _ = rgb.shape
    f32 = np.float32
    read, shot = f32(read_noise**2), f32(shot_noise**2 / 255.0)
    noisy = read_noise > 0.0 or shot_noise > 0.0
    corner = f32(vignette / (0.25 * (width * width + height * height)))
    slope, middle = f32(contrast), f32(127.5)
    red, green, blue = f32(gain[0]), f32(gain[1]), f32(gain[2])
    table = len(normal)
    for row in range(height):
        y = f32(row + 0.5 - 0.5 * height)
        n = offsets[row]
        for column in range(width):
            x = f32(column + 0.5 - 0.5 * width)
            light = f32(1.0) - corner * (x * x + y * y)
            for k in range(3):
                factor = red if k == 0 else (green if k == 1 else blue)
                value = middle + slope * (f32(rgb[row, column, k]) * factor * light - middle)
                value = min(max(value, f32(0.0)), f32(255.0))
                if noisy:
                    value += np.sqrt(read + shot * value) * normal[n]
                    n += 1
                    if n == table:
                        n = 0
                out[row, column, k] = np.uint8(np.int32(min(max(value, f32(0.0)), f32(255.0)) + f32(0.5)))
