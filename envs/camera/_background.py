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

SHORT_RUN = 8
"""Bodies that hide fewer pixels beside each other than this do not interrupt a row's colouring."""

FEW = 48
"""Bodies that hide fewer pixels of a row than this do not either: looking for them costs as much as colouring them."""

FAST = {"contract", "arcp", "nsz"}


@njit(cache=True, error_model="numpy", fastmath=FAST)
def draw_background(
    camera, light, look, noise, inverse_depth, spans, shadow, contact, shadow_spans, rgb, depth, instances
):
    """Depth and instance of every pixel as if there were no bodies; the colour (H, 3 W) of those that no body hides.

    `inverse_depth`, in the columns `spans` of each row, is that of the bodies; it is set to 0 where they are behind the
    ground.
    """
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
    # Flat ground is coloured faster than one could look for where it is hidden.
    few = FEW if look[3] > 0.0 or clouds > 0.0 else width + 1
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
        c = f32(first)
        depth[row, :first] = np.inf
        depth[row, last:] = np.inf
        if last > first:
            _ground_depth(iz_0 + iz_step * c, iz_step, depth[row, first:last])
        near_first = (ray_x + step[0] * c, ray_y + step[1] * c)
        sky_start, sky_stop = (0, first) if first > 0 else (last, width)
        whole = _hide(inverse_depth[row], depth[row], spans[row, 0], spans[row, 1]) < few
        stop = 0
        while stop < width:
            start, stop = (0, width) if whole else _next_run(inverse_depth[row], stop, spans[row, 0], spans[row, 1])
            if start < first:
                end = min(stop, first)
                _sky(ray_z, step[2], blue, far, start, end - start, rgb[row, 3 * start : 3 * end])
            if stop > last:
                begin = max(start, last)
                right = ray_z + step[2] * f32(last)
                _sky(right, step[2], blue, far, begin - last, stop - begin, rgb[row, 3 * begin : 3 * stop])
            if clouds > 0.0 and start < sky_stop and stop > sky_start:
                # Two pixels share one amount, counted from the sky's first.
                begin = start - ((start - sky_start) & 1) if start > sky_start else sky_start
                end = min(stop, sky_stop)
                _clouds(ray_x, ray_y, ray_z, step, begin, end, clouds, noise, rgb[row])
            begin, end = max(start, first), min(stop, last)
            if begin < end:
                here = depth[row, begin:end]
                if look[3] > 0.0:
                    _smooth_ground(near_first, step, begin - first, eye, noise, here, shades)
                else:
                    _ground_cells(near_first, step, begin - first, eye, here, cells[0], cells[1])
                    _ground_shades(noise, here, cells[0], cells[1], shades)
                if shadow_spans[row, 1] > 0:
                    left, right = max(begin, shadow_spans[row, 0]), min(end, shadow_spans[row, 1])
                    _shade_ground(row, left, right, begin, from_sky, shadow, contact, shades)
                _ground_colors(haze, earth, far, shades, here, rgb[row, 3 * begin : 3 * end])


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _hide(inverse_depth, depth, start, stop):
    """Take away the bodies of a row that are behind the ground; returns how many pixels the others hide."""
    one, zero = np.float32(1.0), np.float32(0.0)
    hidden = np.int32(0)
    if start >= stop:
        return hidden
    iz, ground = inverse_depth[start:stop], depth[start:stop]
    for c in range(len(iz)):
        before = iz[c] > zero and one / iz[c] <= ground[c]
        hidden += np.int32(before)
        iz[c] = iz[c] if before else zero
    return hidden


@njit(cache=True, error_model="numpy")
def _next_run(inverse_depth, start, first, last):
    """The next columns (first, last + 1) to colour; short hidden pieces are coloured too.

    Bodies are in the columns first..last - 1 alone.
    """
    width = len(inverse_depth)
    if start >= first:
        while start < last and inverse_depth[start] > 0.0:
            start += 1
        if start == width:
            return width, width
    stop = max(start, min(first, width))
    seen = stop
    while seen < last and seen - stop < SHORT_RUN:
        if inverse_depth[seen] == 0.0:
            stop = seen + 1
        seen += 1
    return start, width if seen >= last and seen - stop < SHORT_RUN else stop


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _ground_depth(iz_0, iz_step, depth):
    """Depth of part of a row of ground."""
    f32 = np.float32
    for c in range(len(depth)):
        depth[c] = f32(1.0) / (iz_0 + iz_step * f32(c))


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _sky(ray_z, step_z, blue, far, start, n, rgb):
    """n pixels above the horizon, from column `start`; the blue grows with the ray's slope."""
    f32 = np.float32
    for c in range(n):
        rise = f32(5.0) * max(ray_z + step_z * f32(start + c), f32(0.0))
        share = rise / (f32(1.0) + rise)
        rgb[3 * c] = np.uint8(np.int32(far[0] + share * blue[0]))
        rgb[3 * c + 1] = np.uint8(np.int32(far[1] + share * blue[1]))
        rgb[3 * c + 2] = np.uint8(np.int32(far[2] + share * blue[2]))


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _ground_cells(ray, step, start, eye, depth, fine, coarse):
    """The cells of the noise tile that part of a row of ground, from column `start`, falls into."""
    f32 = np.float32
    size, mask = np.int32(NOISE_SIZE), np.int32(NOISE_SIZE - 1)
    for c in range(len(depth)):
        z = depth[c]
        reach = min(z, f32(1e4))
        x = eye[0] + reach * (ray[0] + step[0] * f32(start + c))
        y = eye[1] + reach * (ray[1] + step[1] * f32(start + c))
        fine[c] = (np.int32(x * f32(FINE)) & mask) + size * (np.int32(y * f32(FINE)) & mask)
        coarse[c] = (np.int32(x * f32(COARSE)) & mask) + size * (np.int32(y * f32(COARSE)) & mask)


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _ground_shades(noise, depth, fine, coarse, shades):
    """Brightness of ground points about 1; the fine noise fades with distance, before it would flicker."""
    f32 = np.float32
    for c in range(len(depth)):
        near = min(f32(6.0) / depth[c], f32(1.0))
        shades[c] = f32(1.0) + noise[coarse[c]] * (f32(0.06) + f32(0.1) * near) + noise[fine[c]] * f32(0.16) * near


@njit(cache=True, error_model="numpy", fastmath=FAST)
def _smooth_ground(ray, step, start, eye, noise, depth, shades):
    """Brightness of part of a row of ground, from column `start`, the noise interpolated where its cells would show."""
    f32 = np.float32
    for c in range(len(depth)):
        z = depth[c]
        reach = min(z, f32(1e4))
        x = eye[0] + reach * (ray[0] + step[0] * f32(start + c))
        y = eye[1] + reach * (ray[1] + step[1] * f32(start + c))
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
def _interpolated(x, y, noise):
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
def _ground_colors(haze, earth, far, shades, depth, rgb):
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
def _shade_ground(row, start, stop, first, from_sky, shadow, contact, shades):
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
def _clouds(ray_x, ray_y, ray_z, step, start, stop, strength, noise, rgb):
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
