"""Second pass: ground plane and sky, in Numba. Its inner loops are short and plain, so that they become vector code."""

from __future__ import annotations

from math import ceil, floor

import numpy as np
from numba import njit

NOISE_SIZE = 128
"""Side of the tile of noise, a power of two."""

FINE, COARSE = 48.0, 5.0
"""Cells of noise per metre of ground."""

NOISE_SHIFT = 4096.0
"""Metres added before indexing the tile, a multiple of its period, so that indices are positive near the origin."""

FAST = {"contract", "arcp", "nsz"}


@njit(cache=True, error_model="numpy", fastmath=FAST)
def draw_background(camera, light, look, noise, shadow, contact, shadow_spans, rgb, depth, instances):  # type: ignore[no-untyped-def]
    """Colour (H, 3 W), depth and instance of every pixel, as if there were no bodies but their shadows."""
    instances[:] = -1
    height, width = depth.shape
    f32 = np.float32
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    offset_u, offset_v = camera[16], camera[17]
    scale = -1.0 / camera[11] if camera[11] > 1e-6 else 0.0
    step = (f32(camera[0] / fx), f32(camera[3] / fx), f32(camera[6] / fx))
    eye = (f32(camera[9] + NOISE_SHIFT), f32(camera[10] + NOISE_SHIFT))
    iz_step = f32(camera[6] / fx * scale)
    haze = f32(light[4])
    lit = light[3] * (1.15 + 0.15 * light[2]) + (1.0 - light[3]) * max(0.0, light[2])
    far = (f32(light[8]), f32(light[9]), f32(light[10]))
    blue = (f32(light[5] - light[8]), f32(light[6] - light[9]), f32(light[7] - light[10]))
    earth = (f32(light[11] * lit), f32(light[12] * lit), f32(light[13] * lit))
    clouds = f32(look[2])
    # Shares of sky and sun in the ground's light: a shadow takes nearly all of the sun's, feet some of the sky's.
    from_sky = f32(light[3] * (1.15 + 0.15 * light[2]) / max(lit, 1e-9))
    shades = np.empty(width, np.float32)
    cells = np.empty((2, width), np.uint32)
    for row in range(height):
        du, dv = (offset_u - cx) / fx, (row + offset_v - cy) / fy
        ray_x = f32(camera[2] + camera[1] * dv + camera[0] * du)
        ray_y = f32(camera[5] + camera[4] * dv + camera[3] * du)
        ray_z = f32(camera[8] + camera[7] * dv + camera[6] * du)
        iz_0 = f32(ray_z * scale)
        iz_1 = iz_0 + iz_step * f32(width - 1)
        # The horizon may cut the row: columns first..last - 1 are ground.
        first, last = 0, 0
        if iz_0 > 0.0 and iz_1 > 0.0:
            last = width
        elif iz_0 > 0.0:
            last = min(width, ceil(iz_0 / -iz_step))
        elif iz_1 > 0.0:
            first, last = max(0, min(width, floor(-iz_0 / iz_step) + 1)), width
        if first > 0:
            _sky(ray_z, step[2], blue, far, rgb[row, : 3 * first], depth[row, :first])
        if last < width:
            _sky(ray_z + step[2] * f32(last), step[2], blue, far, rgb[row, 3 * last :], depth[row, last:])
        if clouds > 0.0 and (first > 0 or last < width):
            start, stop = (0, first) if first > 0 else (last, width)
            _clouds(ray_x, ray_y, ray_z, step, start, stop, clouds, noise, rgb[row])
        if last > first:
            c = f32(first)
            here = depth[row, first:last]
            near_first = (ray_x + step[0] * c, ray_y + step[1] * c)
            if look[3] > 0.0:
                _smooth_ground(iz_0 + iz_step * c, iz_step, near_first, step, eye, noise, here, shades)
            else:
                _ground_cells(iz_0 + iz_step * c, iz_step, near_first, step, eye, here, cells[0], cells[1])
                _ground_shades(noise, here, cells[0], cells[1], shades)
            if shadow_spans[row, 1] > 0:
                start, stop = max(first, shadow_spans[row, 0]), min(last, shadow_spans[row, 1])
                _shade_ground(row, start, stop, first, from_sky, shadow, contact, shades)
            _ground_colors(haze, earth, far, shades, here, rgb[row, 3 * first : 3 * last])


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _sky(ray_z, step_z, blue, far, rgb, depth):  # type: ignore[no-untyped-def]
    """Part of a row above the horizon; the blue grows with the ray's slope."""
    f32 = np.float32
    for c in range(len(depth)):
        rise = f32(5.0) * max(ray_z + step_z * f32(c), f32(0.0))
        share = rise / (f32(1.0) + rise)
        rgb[3 * c] = np.uint8(np.int32(far[0] + share * blue[0]))
        rgb[3 * c + 1] = np.uint8(np.int32(far[1] + share * blue[1]))
        rgb[3 * c + 2] = np.uint8(np.int32(far[2] + share * blue[2]))
        depth[c] = np.inf


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _ground_cells(iz_0, iz_step, ray, step, eye, depth, fine, coarse):  # type: ignore[no-untyped-def]
    """Depth of part of a row of ground, and the cells of the noise tile its points fall into."""
    f32 = np.float32
    size, mask = np.int32(NOISE_SIZE), np.int32(NOISE_SIZE - 1)
    for c in range(len(depth)):
        z = f32(1.0) / (iz_0 + iz_step * f32(c))
        depth[c] = z
        reach = min(z, f32(1e4))
        x = eye[0] + reach * (ray[0] + step[0] * f32(c))
        y = eye[1] + reach * (ray[1] + step[1] * f32(c))
        fine[c] = (np.int32(x * f32(FINE)) & mask) + size * (np.int32(y * f32(FINE)) & mask)
        coarse[c] = (np.int32(x * f32(COARSE)) & mask) + size * (np.int32(y * f32(COARSE)) & mask)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _ground_shades(noise, depth, fine, coarse, shades):  # type: ignore[no-untyped-def]
    """Brightness of ground points about 1; the fine noise fades with distance, before it would flicker."""
    f32 = np.float32
    for c in range(len(depth)):
        near = min(f32(6.0) / depth[c], f32(1.0))
        shades[c] = f32(1.0) + noise[coarse[c]] * (f32(0.06) + f32(0.1) * near) + noise[fine[c]] * f32(0.16) * near


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _smooth_ground(iz_0, iz_step, ray, step, eye, noise, depth, shades):  # type: ignore[no-untyped-def]
    """Depth and brightness of part of a row of ground, the noise interpolated where its cells would show."""
    f32 = np.float32
    for c in range(len(depth)):
        z = f32(1.0) / (iz_0 + iz_step * f32(c))
        depth[c] = z
        reach = min(z, f32(1e4))
        x = eye[0] + reach * (ray[0] + step[0] * f32(c))
        y = eye[1] + reach * (ray[1] + step[1] * f32(c))
        near = min(f32(6.0) / z, f32(1.0))
        shade = f32(1.0) + _interpolated(x * f32(COARSE), y * f32(COARSE), noise) * (f32(0.06) + f32(0.08) * near)
        if z < f32(5.0):
            shade += _interpolated(x * f32(FINE), y * f32(FINE), noise) * f32(0.13) * near
        elif z < f32(60.0):
            mask, size = np.int32(NOISE_SIZE - 1), np.int32(NOISE_SIZE)
            cell = (np.int32(x * f32(FINE)) & mask) + size * (np.int32(y * f32(FINE)) & mask)
            shade += noise[np.uint32(cell)] * f32(0.13) * near
        shades[c] = shade


@njit(cache=True, error_model="numpy", inline="always")
def _interpolated(x, y, noise):  # type: ignore[no-untyped-def]
    """Noise in [-1, 1] at (x, y) cells, both positive."""
    f32 = np.float32
    mask, size, one = np.int32(NOISE_SIZE - 1), np.int32(NOISE_SIZE), np.int32(1)
    i, j = np.int32(x), np.int32(y)
    s, t = x - f32(i), y - f32(j)
    left, right = i & mask, (i + one) & mask
    low, high = size * (j & mask), size * ((j + one) & mask)
    lower = noise[np.uint32(low + left)] * (f32(1.0) - s) + noise[np.uint32(low + right)] * s
    upper = noise[np.uint32(high + left)] * (f32(1.0) - s) + noise[np.uint32(high + right)] * s
    return lower * (f32(1.0) - t) + upper * t


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _ground_colors(haze, earth, far, shades, depth, rgb):  # type: ignore[no-untyped-def]
    """Colour of part of a row of ground: its brightness, and the horizon's colour by distance."""
    f32 = np.float32
    for c in range(len(depth)):
        own = f32(1.0) / (f32(1.0) + haze * depth[c])
        fog = f32(1.0) - own
        own *= shades[c]
        rgb[3 * c] = np.uint8(np.int32(min(earth[0] * own + far[0] * fog, f32(255.0))))
        rgb[3 * c + 1] = np.uint8(np.int32(min(earth[1] * own + far[1] * fog, f32(255.0))))
        rgb[3 * c + 2] = np.uint8(np.int32(min(earth[2] * own + far[2] * fog, f32(255.0))))


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _shade_ground(row, start, stop, first, from_sky, shadow, contact, shades):  # type: ignore[no-untyped-def]
    """Darken columns start..stop - 1 of a row of ground, whose shades begin at column `first`."""
    height, width = shadow.shape
    f32 = np.float32
    here, above, below = shadow[row], shadow[max(row - 1, 0)], shadow[min(row + 1, height - 1)]
    feet = contact[row]
    sun = f32(1.0) - from_sky
    for c in range(start, stop):
        # The mean of a cross of pixels: a soft edge.
        beside = np.int32(here[max(c - 1, 0)]) + np.int32(here[min(c + 1, width - 1)])
        covered = np.int32(here[c]) + np.int32(above[c]) + np.int32(below[c]) + beside
        dark = f32(feet[c]) * f32(1.0 / 255.0)
        light = from_sky * (f32(1.0) - dark) + sun * (f32(1.0) - f32(0.19) * f32(covered)) * (
            f32(1.0) - f32(0.5) * dark
        )
        shades[c - first] *= light


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _clouds(ray_x, ray_y, ray_z, step, start, stop, strength, noise, rgb):  # type: ignore[no-untyped-def]
    """White clouds of noise on a plane high above columns start..stop - 1 of a row of sky; none near the horizon."""
    f32 = np.float32
    mask = np.int32(NOISE_SIZE - 1)
    one, white = f32(1.0), f32(250.0)
    for c in range(start, stop, 2):
        up = ray_z + step[2] * f32(c)
        if up < f32(0.02):
            continue
        far = one / (up + f32(0.06))
        x = (ray_x + step[0] * f32(c)) * far * f32(5.0) + f32(1024.0)
        y = (ray_y + step[1] * f32(c)) * far * f32(5.0) + f32(1024.0)
        column, line = np.int32(x), np.int32(y)
        s, t = x - f32(column), y - f32(line)
        top, low = NOISE_SIZE * (line & mask), NOISE_SIZE * ((line + 1) & mask)
        here, next_ = column & mask, (column + 1) & mask
        upper = noise[top + here] * (one - s) + noise[top + next_] * s
        lower = noise[low + here] * (one - s) + noise[low + next_] * s
        amount = (upper * (one - t) + lower * t + f32(0.1)) * strength * min(one, f32(6.0) * (up - f32(0.02)))
        if amount <= f32(0.0):
            continue
        # Clouds are soft: two pixels share one amount.
        amount = min(amount, f32(0.85))
        for k in range(3 * c, 3 * min(c + 2, stop)):
            value = f32(rgb[k])
            rgb[k] = np.uint8(np.int32(value + (white - value) * amount))
