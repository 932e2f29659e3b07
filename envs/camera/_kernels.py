"""The rasteriser's Numba kernels; `raster.py` is their only caller and packs their arguments."""

from __future__ import annotations

from math import ceil, floor, sqrt

import numpy as np
from numba import njit

TRIANGLE_FIELDS = 4
"""A triangle's record: shaded colour (3), object."""

NOISE_SIZE = 128
"""Side of the tile of ground noise, a power of two; the tile must stay in the processor's first cache."""

FINE, COARSE = 24.0, 2.5
"""Cells of noise per metre of ground."""

NOISE_SHIFT = 32768.0
"""Metres added before indexing the tile, a multiple of its period, so that indices are positive near the origin."""


@njit(cache=True, error_model="numpy")
def render_kernel(  # type: ignore[no-untyped-def]
    first_vertex,
    first_face,
    spheres,
    vertices,
    faces,
    planes,
    colors,
    body_mesh,
    body_poses,
    body_tints,
    body_object,
    hidden_object,
    camera,
    light,
    noise,
    projected,
    triangles,
    inverse_depth,
    triangle_at,
    spans,
    rgb,
    depth,
    instances,
):
    """Draw one frame. Returns 0, or n > 0 if `triangles` must hold n records, or -1 - mesh if there is no such mesh.

    `inverse_depth` holds zeros and `spans` (first column drawn, last + 1) of each row (width, 0), before and after.
    """
    bound = 0
    for b in range(len(body_mesh)):
        m = body_mesh[b]
        if m < 0 or m >= len(first_face) - 1:
            return -1 - abs(m)
        bound += 2 * (first_face[m + 1] - first_face[m])
    if bound > len(triangles):
        return bound
    _draw_bodies(
        first_vertex,
        first_face,
        spheres,
        vertices,
        faces,
        planes,
        colors,
        body_mesh,
        body_poses,
        body_tints,
        body_object,
        hidden_object,
        camera,
        light,
        projected,
        triangles,
        inverse_depth,
        triangle_at,
        spans,
    )
    rows = rgb.reshape(rgb.shape[0], 3 * rgb.shape[1])
    instances[:] = -1
    _draw_background(camera, light, noise, rows, depth)
    _draw_foreground(light, triangles, inverse_depth, triangle_at, spans, rows, depth, instances)
    return 0


@njit(cache=True, error_model="numpy")
def _draw_bodies(  # type: ignore[no-untyped-def]
    first_vertex,
    first_face,
    spheres,
    vertices,
    faces,
    planes,
    colors,
    body_mesh,
    body_poses,
    body_tints,
    body_object,
    hidden_object,
    camera,
    light,
    projected,
    triangles,
    inverse_depth,
    triangle_at,
    spans,
):
    """First pass: every visible triangle into the two buffers and, shaded, into the table of triangles."""
    height, width = inverse_depth.shape
    R_wc = camera[:9].reshape(3, 3)
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    offset_u, offset_v, near = camera[16], camera[17], camera[18]
    sides = _side_planes(fx, fy, cx, cy, width, height)
    R = np.empty((3, 3))
    t = np.empty(3)
    eye = np.empty(3)
    sun = np.empty(3)
    polygon = np.empty((4, 2))
    ambient = light[3]
    count = 0
    for b in range(len(body_mesh)):
        if hidden_object >= 0 and body_object[b] == hidden_object:
            continue
        mesh = body_mesh[b]
        pose = body_poses[b]
        for i in range(3):
            for j in range(3):
                R[i, j] = R_wc[0, i] * pose[0, j] + R_wc[1, i] * pose[1, j] + R_wc[2, i] * pose[2, j]
            t[i] = (
                R_wc[0, i] * (pose[0, 3] - camera[9])
                + R_wc[1, i] * (pose[1, 3] - camera[10])
                + R_wc[2, i] * (pose[2, 3] - camera[11])
            )
        if not _in_view(spheres[mesh], R, t, sides, near):
            continue
        for j in range(3):
            eye[j] = -(R[0, j] * t[0] + R[1, j] * t[1] + R[2, j] * t[2])
            sun[j] = pose[0, j] * light[0] + pose[1, j] * light[1] + pose[2, j] * light[2]
        base = first_vertex[mesh]
        left, right, top, bottom = float(width), 0.0, float(height), 0.0
        for k in range(first_vertex[mesh + 1] - base):
            px, py, pz = vertices[base + k, 0], vertices[base + k, 1], vertices[base + k, 2]
            x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0]
            y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1]
            z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2]
            projected[k, 0] = x
            projected[k, 1] = y
            projected[k, 2] = z
            if z >= near:
                iz = 1.0 / z
                u = fx * x * iz + cx - offset_u
                v = fy * y * iz + cy - offset_v
                projected[k, 3] = u
                projected[k, 4] = v
                left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
            else:
                left, right, top, bottom = 0.0, float(width), 0.0, float(height)
        left, right, top, bottom = max(left, 0.0), min(right, float(width)), max(top, 0.0), min(bottom, float(height))
        if left >= right or top >= bottom:
            continue
        for row in range(int(top), ceil(bottom)):
            spans[row, 0] = min(spans[row, 0], int(left))
            spans[row, 1] = max(spans[row, 1], ceil(right))
        for f in range(first_face[mesh], first_face[mesh + 1]):
            px, py, pz = planes[f, 0], planes[f, 1], planes[f, 2]
            # Distance of the eye behind the face; zero for a face without area, which is not drawn either.
            behind = planes[f, 3] - (px * eye[0] + py * eye[1] + pz * eye[2])
            if behind >= 0.0:
                continue
            corners = _project_face(
                faces[f, 0], faces[f, 1], faces[f, 2], projected, near, fx, fy, cx, cy, offset_u, offset_v, polygon
            )
            if corners == 0:
                continue
            # The face's plane n.p = d in the camera frame gives 1/z as an affine function of the pixel.
            nx = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
            ny = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
            nz = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
            scale = 1.0 / behind
            iz_u = nx * scale / fx
            iz_v = ny * scale / fy
            iz_0 = nz * scale + iz_u * (offset_u - cx) + iz_v * (offset_v - cy)
            drawn = _fill(
                polygon[0, 0],
                polygon[0, 1],
                polygon[1, 0],
                polygon[1, 1],
                polygon[2, 0],
                polygon[2, 1],
                iz_u,
                iz_v,
                iz_0,
                count,
                inverse_depth,
                triangle_at,
            )
            if corners == 4:
                drawn |= _fill(
                    polygon[0, 0],
                    polygon[0, 1],
                    polygon[2, 0],
                    polygon[2, 1],
                    polygon[3, 0],
                    polygon[3, 1],
                    iz_u,
                    iz_v,
                    iz_0,
                    count,
                    inverse_depth,
                    triangle_at,
                )
            if not drawn:
                continue
            facing_sun = max(0.0, px * sun[0] + py * sun[1] + pz * sun[2])
            facing_up = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz
            # The sky lights from above more than the ground from below.
            lit = ambient * (0.85 + 0.25 * facing_up) + (1.0 - ambient) * facing_sun
            for i in range(3):
                triangles[count, i] = min(255.0, colors[f, i] * body_tints[b, i] * lit)
            triangles[count, 3] = body_object[b]
            count += 1


@njit(cache=True, error_model="numpy")
def _side_planes(fx, fy, cx, cy, width, height):  # type: ignore[no-untyped-def]
    """Unit inward normals (4, 3) of the planes through the camera and the image's left, right, upper and lower edge."""
    sides = np.array(
        [[fx, 0.0, cx], [-fx, 0.0, width - cx], [0.0, fy, cy], [0.0, -fy, height - cy]],
    )
    for i in range(4):
        sides[i] /= sqrt(sides[i, 0] ** 2 + sides[i, 1] ** 2 + sides[i, 2] ** 2)
    return sides


@njit(cache=True, error_model="numpy")
def _in_view(sphere, R, t, sides, near):  # type: ignore[no-untyped-def]
    """Whether a bounding sphere (centre, radius) of the body frame may reach into the picture."""
    x = R[0, 0] * sphere[0] + R[0, 1] * sphere[1] + R[0, 2] * sphere[2] + t[0]
    y = R[1, 0] * sphere[0] + R[1, 1] * sphere[1] + R[1, 2] * sphere[2] + t[1]
    z = R[2, 0] * sphere[0] + R[2, 1] * sphere[1] + R[2, 2] * sphere[2] + t[2]
    radius = sphere[3]
    if z + radius < near:
        return False
    inside = True
    for i in range(4):
        inside &= sides[i, 0] * x + sides[i, 1] * y + sides[i, 2] * z >= -radius
    return inside


@njit(cache=True, error_model="numpy")
def _project_face(i, j, k, projected, near, fx, fy, cx, cy, offset_u, offset_v, polygon):  # type: ignore[no-untyped-def]
    """Put the corners (u, v) of face (i, j, k), cut at the near plane, into `polygon`; returns how many: 0, 3 or 4."""
    in_i, in_j, in_k = projected[i, 2] >= near, projected[j, 2] >= near, projected[k, 2] >= near
    if in_i and in_j and in_k:
        polygon[0, 0], polygon[0, 1] = projected[i, 3], projected[i, 4]
        polygon[1, 0], polygon[1, 1] = projected[j, 3], projected[j, 4]
        polygon[2, 0], polygon[2, 1] = projected[k, 3], projected[k, 4]
        return 3
    if not (in_i or in_j or in_k):
        return 0
    n = 0
    for a, b in ((i, j), (j, k), (k, i)):
        in_a, in_b = projected[a, 2] >= near, projected[b, 2] >= near
        if in_a:
            polygon[n, 0], polygon[n, 1] = projected[a, 3], projected[a, 4]
            n += 1
        if in_a != in_b:
            # From the inner to the outer corner, so that two faces cut their common edge at the very same point.
            p, q = (a, b) if in_a else (b, a)
            s = (near - projected[p, 2]) / (projected[q, 2] - projected[p, 2])
            x = projected[p, 0] + s * (projected[q, 0] - projected[p, 0])
            y = projected[p, 1] + s * (projected[q, 1] - projected[p, 1])
            polygon[n, 0] = fx * x / near + cx - offset_u
            polygon[n, 1] = fy * y / near + cy - offset_v
            n += 1
    return n


@njit(cache=True, error_model="numpy")
def _fill(x0, y0, x1, y1, x2, y2, iz_u, iz_v, iz_0, number, inverse_depth, triangle_at):  # type: ignore[no-untyped-def]
    """Fill a triangle whose sample points lie at whole numbers; returns whether any pixel was drawn.

    A pixel belongs to it if left <= u < right and top <= v < bottom, with each edge evaluated from its upper end:
    triangles that share an edge leave no gap and never draw a pixel twice.
    """
    height, width = inverse_depth.shape
    if y1 < y0:
        x0, y0, x1, y1 = x1, y1, x0, y0
    if y2 < y0:
        x0, y0, x2, y2 = x2, y2, x0, y0
    if y2 < y1:
        x1, y1, x2, y2 = x2, y2, x1, y1
    low, high = min(x0, min(x1, x2)), max(x0, max(x1, x2))
    if y2 < 0.0 or y0 > height - 1 or high < 0.0 or low > width - 1 or ceil(low) >= ceil(high):
        return False
    first = ceil(max(y0, 0.0))
    last = ceil(min(y2, float(height)))
    if first >= last:
        return False
    long_slope = (x2 - x0) / (y2 - y0)
    upper_slope = (x1 - x0) / (y1 - y0) if y1 > y0 else 0.0
    lower_slope = (x2 - x1) / (y2 - y1) if y2 > y1 else 0.0
    drawn = False
    for row in range(first, last):
        xa = x0 + (row - y0) * long_slope
        xb = x0 + (row - y0) * upper_slope if row < y1 else x1 + (row - y1) * lower_slope
        if xb < xa:
            xa, xb = xb, xa
        if xb <= 0.0 or xa > width - 1:
            continue
        left = ceil(max(xa, 0.0))
        right = ceil(min(xb, float(width)))
        if left >= right:
            continue
        base = iz_0 + iz_v * row
        for column in range(left, right):
            iz = np.float32(base + iz_u * column)
            if iz > inverse_depth[row, column]:
                inverse_depth[row, column] = iz
                triangle_at[row, column] = number
                drawn = True
    return drawn


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _draw_background(camera, light, noise, rgb, depth):  # type: ignore[no-untyped-def]
    """Second pass: ground plane and sky on every pixel. Its inner loops are short, so that they become vector code."""
    height, width = depth.shape
    f32 = np.float32
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    offset_u, offset_v = camera[16], camera[17]
    scale = -1.0 / camera[11] if camera[11] > 1e-6 else 0.0
    step = (f32(camera[0] / fx), f32(camera[3] / fx), f32(camera[6] / fx))
    eye = (f32(camera[9] + NOISE_SHIFT), f32(camera[10] + NOISE_SHIFT))
    iz_step = f32(camera[6] / fx * scale)
    haze = f32(light[4])
    lit = light[3] * 1.1 + (1.0 - light[3]) * max(0.0, light[2])
    far = (f32(light[8]), f32(light[9]), f32(light[10]))
    blue = (f32(light[5] - light[8]), f32(light[6] - light[9]), f32(light[7] - light[10]))
    earth = (f32(light[11] * lit), f32(light[12] * lit), f32(light[13] * lit))
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
        if last > first:
            c = f32(first)
            here = depth[row, first:last]
            near_first = (ray_x + step[0] * c, ray_y + step[1] * c)
            _ground_cells(iz_0 + iz_step * c, iz_step, near_first, step, eye, here, cells[0], cells[1])
            _ground_shades(noise, here, cells[0], cells[1], shades)
            _ground_colors(haze, earth, far, shades, here, rgb[row, 3 * first : 3 * last])


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
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


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
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


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _ground_shades(noise, depth, fine, coarse, shades):  # type: ignore[no-untyped-def]
    """Brightness of ground points about 1; the fine noise fades with distance, before it would flicker."""
    f32 = np.float32
    for c in range(len(depth)):
        near = min(f32(6.0) / depth[c], f32(1.0))
        shades[c] = f32(1.0) + noise[coarse[c]] * (f32(0.06) + f32(0.1) * near) + noise[fine[c]] * f32(0.16) * near


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
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


@njit(cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
def _draw_foreground(light, triangles, inverse_depth, triangle_at, spans, rgb, depth, instances):  # type: ignore[no-untyped-def]
    """Third pass: the bodies, where they are before the background. Leaves `inverse_depth` and `spans` cleared."""
    height, width = inverse_depth.shape
    f32 = np.float32
    one, zero = f32(1.0), f32(0.0)
    haze = f32(light[4])
    far_r, far_g, far_b = f32(light[8]), f32(light[9]), f32(light[10])
    for row in range(height):
        for c in range(spans[row, 0], spans[row, 1]):
            iz = inverse_depth[row, c]
            if iz == zero:
                continue
            inverse_depth[row, c] = zero
            z = one / iz
            if z > depth[row, c]:
                continue
            own = iz / (iz + haze)
            fog = one - own
            k = triangle_at[row, c]
            rgb[row, 3 * c] = np.uint8(np.int32(triangles[k, 0] * own + far_r * fog))
            rgb[row, 3 * c + 1] = np.uint8(np.int32(triangles[k, 1] * own + far_g * fog))
            rgb[row, 3 * c + 2] = np.uint8(np.int32(triangles[k, 2] * own + far_b * fog))
            depth[row, c] = z
            instances[row, c] = np.int32(triangles[k, 3])
        spans[row, 0] = width
        spans[row, 1] = 0
