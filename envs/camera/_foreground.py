"""Third pass: the bodies' pixels before the background, each shaded once, in Numba.

A face's pattern is a function of two coordinates s (level) and t (up the face) in metres on it; it returns a factor of
brightness and a shift towards blue. Patterns fade where a pixel covers more than their details.
"""

from __future__ import annotations

import numpy as np
from numba import njit

SMOOTH, PATTERNED, RECEIVES = 1, 2, 4
NOISE_SIZE = 128
FAST = {"contract", "arcp", "nsz"}

BRIGHT, BLUE, S, T, SIZE = range(5)
"""Rows of the scratch memory of a row of pixels: brightness, blueness, place in the pattern, metres a pixel covers."""

PLAIN, GRAIN, LEAVES, WOOD, BRICKS, WINDOWS, STRIPES, CHECKER, RIBS, ASPHALT, TILES = range(11)
PATTERNS = ("plain", "grain", "leaves", "wood", "bricks", "windows", "stripes", "checker", "ribs", "asphalt", "tiles")


@njit(cache=True, error_model="numpy", fastmath=FAST)
def draw_foreground(
    focal,
    light,
    noise,
    triangles,
    inverse_depth,
    triangle_at,
    spans,
    shadow,
    contact,
    shadow_spans,
    rgb,
    depth,
    instances,
):
    """Colour (H, 3 W), depth and instance of the pixels of bodies; `draw_background` took those away that it hides.

    Leaves `inverse_depth`, `shadow`, `contact` and both `spans` cleared for the next frame.
    """
    height, width = inverse_depth.shape
    f32 = np.float32
    one, zero = f32(1.0), f32(0.0)
    haze = f32(light[4])
    metres = f32(1.0 / focal)
    far = (f32(light[8]), f32(light[9]), f32(light[10]))
    most = f32(255.0)
    scratch = np.empty((5, width), np.float32)
    bright, own = scratch[BRIGHT], np.empty((3, width), np.float32)
    red, green, blue = own[0], own[1], own[2]
    sunny, dark = np.empty(width, np.float32), np.empty(width, np.float32)
    for row in range(height):
        c, stop = max(spans[row, 0], 0), spans[row, 1]
        iz, at, ids = inverse_depth[row], triangle_at[row], instances[row]
        lit = False
        while c < stop:
            if iz[c] == zero:
                c += 1
                continue
            segment = c
            while c < stop and iz[c] > zero:
                # A run of pixels of one triangle, often short: what it needs is looked up once.
                first, k = c, at[c]
                while c < stop and at[c] == k and iz[c] > zero:
                    c += 1
                r, g, b, instance = triangles[k, 0], triangles[k, 1], triangles[k, 2], np.int32(triangles[k, 3])
                kind = int(triangles[k, 4])
                if kind == 0:
                    for x in range(first, c):
                        ids[x], red[x], green[x], blue[x] = instance, r, g, b
                    continue
                if kind & RECEIVES and not lit:
                    _light_row(row, shadow, contact, shadow_spans, sunny, dark)
                    lit = True
                _brighten_run(row, first, c, triangles[k], kind, iz, sunny, dark, bright)
                for x in range(first, c):
                    ids[x] = instance
                if kind & PATTERNED:
                    _pattern_run(row, first, c, triangles[k], metres, iz, noise, scratch)
                    for x in range(first, c):
                        red[x] = min(r * bright[x] * (one - scratch[BLUE, x]), most)
                        green[x] = min(g * bright[x], most)
                        blue[x] = min(b * bright[x] * (one + scratch[BLUE, x]), most)
                else:
                    for x in range(first, c):
                        red[x], green[x], blue[x] = (
                            min(r * bright[x], most),
                            min(g * bright[x], most),
                            min(b * bright[x], most),
                        )
            _compose(
                haze,
                far,
                red[segment:c],
                green[segment:c],
                blue[segment:c],
                iz[segment:c],
                depth[row, segment:c],
                rgb[row, 3 * segment : 3 * c],
            )
        spans[row, 0] = width
        spans[row, 1] = 0
    for row in range(height):
        first, stop = shadow_spans[row, 0], shadow_spans[row, 1]
        if first < stop:
            shadow[row, first:stop] = 0
            contact[row, first:stop] = 0
        shadow_spans[row, 0] = width
        shadow_spans[row, 1] = 0


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _compose(haze, far, red, green, blue, inverse_depth, depth, rgb):
    """Depth and final colours of pixels beside each other; clears their inverse depth."""
    one = np.float32(1.0)
    for c in range(len(depth)):
        iz = inverse_depth[c]
        inverse_depth[c] = np.float32(0.0)
        depth[c] = one / iz
        own = iz / (iz + haze)
        fog = one - own
        # The order decides which product is fused with the sum, and with it a last bit; pictures are frozen.
        rgb[3 * c] = np.uint8(np.int32(far[0] * fog + red[c] * own))
        rgb[3 * c + 1] = np.uint8(np.int32(far[1] * fog + green[c] * own))
        rgb[3 * c + 2] = np.uint8(np.int32(far[2] * fog + blue[c] * own))


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _light_row(row, shadow, contact, spans, sunny, dark):
    """Share of the sun that reaches flat ground in each pixel of a row, and the darkness about feet."""
    f32 = np.float32
    height, width = shadow.shape
    above, below = max(row - 1, 0), min(row + 1, height - 1)
    sunny[:] = f32(1.0)
    dark[:] = f32(0.0)
    first = min(spans[above, 0], min(spans[row, 0], spans[below, 0]))
    last = max(spans[above, 1], max(spans[row, 1], spans[below, 1]))
    first, last = max(first - 1, 0), min(last + 1, width)
    for c in (0, width - 1):
        if first <= c < last:
            beside = shadow[row, max(c - 1, 0)] + shadow[row, min(c + 1, width - 1)]
            covered = shadow[row, c] + shadow[above, c] + shadow[below, c] + beside
            sunny[c] = f32(1.0) - f32(0.19) * f32(covered)
            dark[c] = f32(contact[row, c]) * f32(1.0 / 255.0)
    first, last = max(first, 1), min(last, width - 1)
    if first >= last:
        return
    here, left, right = shadow[row, first:last], shadow[row, first - 1 : last - 1], shadow[row, first + 1 : last + 1]
    over, under, feet = shadow[above, first:last], shadow[below, first:last], contact[row, first:last]
    sun, shade = sunny[first:last], dark[first:last]
    for c in range(len(here)):
        covered = np.int32(here[c]) + np.int32(left[c]) + np.int32(right[c]) + np.int32(over[c]) + np.int32(under[c])
        sun[c] = f32(1.0) - f32(0.19) * f32(covered)
        shade[c] = f32(feet[c]) * f32(1.0 / 255.0)


@njit(cache=True, error_model="numpy", inline="always")
def _brighten_run(row, first, last, triangle, kind, inverse_depth, sunny, dark, bright):
    """Brightness of columns first..last - 1, all of one triangle, before any pattern."""
    f32 = np.float32
    one, zero, half = f32(1.0), f32(0.0), f32(0.5)
    if kind & SMOOTH:
        step, start, constant = triangle[5], triangle[6] * f32(row) + triangle[7], triangle[8]
        for c in range(first, last):
            bright[c] = max((step * f32(c) + start) / inverse_depth[c] + constant, zero)
    elif kind & RECEIVES:
        # Light from sky and sun, as `_background` shades the ground itself.
        sky, sun = triangle[5], triangle[6]
        for c in range(first, last):
            bright[c] = sky * (one - dark[c]) + sun * sunny[c] * (one - half * dark[c])
    else:
        for c in range(first, last):
            bright[c] = one


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _pattern_run(row, first, last, triangle, metres, inverse_depth, noise, scratch):
    """Multiply the brightness, and set the blueness, of columns first..last - 1, all of one triangle, in `scratch`."""
    f32 = np.float32
    one, zero, half = f32(1.0), f32(0.0), f32(0.5)
    v = f32(row)
    step, start, constant = triangle[9], triangle[10] * v + triangle[11], triangle[12]
    step_t, start_t, constant_t = triangle[13], triangle[14] * v + triangle[15], triangle[16]
    pattern = int(triangle[17])
    for c in range(first, last):
        z = one / inverse_depth[c]
        scratch[S, c] = (step * f32(c) + start) * z + constant
        scratch[T, c] = (step_t * f32(c) + start_t) * z + constant_t
        scratch[SIZE, c] = z * metres
        scratch[BLUE, c] = zero
    if pattern == GRAIN:
        for c in range(first, last):
            fine = (
                _detail(f32(0.03), scratch[SIZE, c])
                * f32(0.12)
                * _speck(scratch[S, c] * f32(45.0), scratch[T, c] * f32(45.0), noise)
            )
            scratch[BRIGHT, c] *= (
                one + f32(0.1) * _noise(scratch[S, c] * f32(7.0), scratch[T, c] * f32(7.0), noise) + fine
            )
    elif pattern == ASPHALT:
        for c in range(first, last):
            fine = (
                _detail(f32(0.05), scratch[SIZE, c])
                * f32(0.14)
                * _speck(scratch[S, c] * f32(30.0), scratch[T, c] * f32(30.0), noise)
            )
            scratch[BRIGHT, c] *= (
                one + f32(0.1) * _noise(scratch[S, c] * f32(2.0), scratch[T, c] * f32(2.0), noise) + fine
            )
    elif pattern == LEAVES:
        for c in range(first, last):
            fine = (
                _detail(f32(0.25), scratch[SIZE, c])
                * f32(0.45)
                * _noise(scratch[S, c] * f32(8.0), scratch[T, c] * f32(8.0), noise)
            )
            scratch[BRIGHT, c] *= (
                one + f32(0.25) * _noise(scratch[S, c] * f32(2.0), scratch[T, c] * f32(2.0), noise) + fine
            )
    elif pattern == WOOD:
        for c in range(first, last):
            across = scratch[T, c] * f32(1.0 / 0.15)
            plank = _floor(across)
            groove = f32(0.35) if across - plank < f32(0.1) else zero
            grain = _cell(plank, zero, noise) + _noise(scratch[S, c] * f32(6.0), scratch[T, c] * f32(60.0), noise)
            scratch[BRIGHT, c] *= one + _detail(f32(0.15), scratch[SIZE, c]) * (f32(0.12) * grain - groove)
    elif pattern == BRICKS:
        for c in range(first, last):
            up = scratch[T, c] * f32(5.0)
            course = _floor(up)
            across = scratch[S, c] * f32(2.0) + half * (course - f32(2.0) * _floor(half * course))
            brick = _floor(across)
            mortar = up - course < f32(0.12) or across - brick < f32(0.05)
            shift = f32(0.22) if mortar else f32(0.14) * _cell(brick, course, noise) - f32(0.03)
            scratch[BRIGHT, c] *= one + _detail(f32(0.2), scratch[SIZE, c]) * shift
    elif pattern == WINDOWS:
        for c in range(first, last):
            across, up = scratch[S, c] * f32(1.0 / 2.4), scratch[T, c] * f32(1.0 / 3.0)
            bay, storey = _floor(across), _floor(up)
            x, y = across - bay, up - storey
            if x > f32(0.22) and x < f32(0.78) and y > f32(0.32) and y < f32(0.82):
                sky = f32(0.5) * max(y - f32(0.55), zero)
                scratch[BRIGHT, c] *= f32(0.42) + f32(0.2) * _cell(bay, storey, noise) + sky
                scratch[BLUE, c] = f32(0.18)
    elif pattern == STRIPES:
        for c in range(first, last):
            along = (scratch[S, c] + scratch[T, c]) * f32(1.0 / 0.36)
            scratch[BRIGHT, c] *= one if along - _floor(along) < half else f32(0.22)
    elif pattern == CHECKER:
        for c in range(first, last):
            odd = half * (_floor(scratch[S, c] * f32(4.0)) + _floor(scratch[T, c] * f32(4.0)))
            scratch[BRIGHT, c] *= one - f32(0.9) * (odd - _floor(odd))
    elif pattern == RIBS:
        for c in range(first, last):
            along = scratch[S, c] * f32(1.0 / 0.22)
            shift = f32(0.16) if along - _floor(along) < f32(0.4) else f32(-0.12)
            scratch[BRIGHT, c] *= one + _detail(f32(0.22), scratch[SIZE, c]) * shift
    elif pattern == TILES:
        for c in range(first, last):
            x, y = scratch[S, c] * f32(1.0 / 0.6), scratch[T, c] * f32(1.0 / 0.6)
            i, j = _floor(x), _floor(y)
            joint = x - i < f32(0.06) or y - j < f32(0.06)
            shift = f32(-0.2) if joint else f32(0.09) * _cell(i, j, noise)
            scratch[BRIGHT, c] *= one + _detail(f32(0.3), scratch[SIZE, c]) * shift


@njit(cache=True, error_model="numpy", inline="always")
def _floor(x):
    """The floor as float32, for |x| < 2^31, without the library call that `np.floor` makes."""
    whole = np.float32(np.int32(x))
    return whole - np.float32(1.0) if whole > x else whole


@njit(cache=True, error_model="numpy", inline="always")
def _detail(size, metres):
    """How much of a detail of `size` m is left where a pixel covers `metres`: 1 near, 0 far."""
    return min(np.float32(1.0), max(np.float32(0.0), np.float32(1.4) - np.float32(1.4) * metres / size))


@njit(cache=True, error_model="numpy", inline="always")
def _cell(i, j, noise):
    """A number in [-1, 1] for each cell (i, j) of a grid."""
    mask = np.int32(NOISE_SIZE - 1)
    a, b = np.int32(i), np.int32(j)
    column, line = a * np.int32(37) + b * np.int32(11), b * np.int32(29) + a * np.int32(7)
    return noise[np.uint32((column & mask) + np.int32(NOISE_SIZE) * (line & mask))]


@njit(cache=True, error_model="numpy", inline="always")
def _speck(x, y, noise):
    """Noise in [-1, 1] of the cell that (x, y) falls into."""
    mask, size = np.int32(NOISE_SIZE - 1), np.int32(NOISE_SIZE)
    i, j = np.int32(_floor(x)) & mask, np.int32(_floor(y)) & mask
    return noise[np.uint32(i + size * j)]


@njit(cache=True, error_model="numpy", inline="always")
def _noise(x, y, noise):
    """Smooth noise in [-1, 1] at (x, y) cells."""
    f32 = np.float32
    mask, size, one = np.int32(NOISE_SIZE - 1), np.int32(NOISE_SIZE), np.int32(1)
    i, j = _floor(x), _floor(y)
    s, t = x - i, y - j
    left, low = np.int32(i) & mask, np.int32(j) & mask
    right, high = (left + one) & mask, ((low + one) & mask) * size
    low *= size
    lower = noise[np.uint32(low + left)] * (f32(1.0) - s) + noise[np.uint32(low + right)] * s
    upper = noise[np.uint32(high + left)] * (f32(1.0) - s) + noise[np.uint32(high + right)] * s
    return lower * (f32(1.0) - t) + upper * t


@njit(cache=True, error_model="numpy")
def mean_colors(fine, rgb):
    """Colours (H, W, 3) as the means of blocks of pixels of `fine` (s H, s W, 3)."""
    height, width, _ = rgb.shape
    samples = fine.shape[0] // height
    area = samples * samples
    for row in range(height):
        for column in range(width):
            for i in range(3):
                total = area // 2
                for a in range(samples):
                    for b in range(samples):
                        total += fine[samples * row + a, samples * column + b, i]
                rgb[row, column, i] = np.uint8(total // area)
