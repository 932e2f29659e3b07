"""First pass: bodies' triangles into the depth buffer, and their shadows on the ground into two masks, in Numba.

Numba's cache watches one file at a time, so every kernel here calls only kernels of this file. Shadows are projected,
clipped and filled as bodies are, by the same kernels, and stay beside them for that.
"""

from __future__ import annotations

from math import ceil, sqrt

import numpy as np
from numba import njit

TRIANGLE_FIELDS = 20
"""A triangle's record: colour (3), object, kind, and by kind: affine maps of the pixel, below."""

SMOOTH, PATTERNED, RECEIVES = 1, 2, 4
"""Kinds of triangles, added up; 0 is flat and lit evenly. SMOOTH and RECEIVES exclude each other.

SMOOTH: brightness / z - b0 / z is affine in the pixel: fields 5-7, b0 in 8. RECEIVES (shadows): ambient light in 5, sun
in 6. PATTERNED: coordinates s and t in 9-12 and 13-16, likewise; the pattern in 17.
"""

OK, TABLE_FULL, NO_MESH, BAD_POSE = 0, 1, 2, 3

SHADOW_RANGE_M = 150.0
LONG_RUN = 16
"""Pixels of a row from which vector code is worth its start."""

FLAT_M = 0.12
"""Bodies lower than this (roads, markings, pavements) cast no shadow: they receive it."""


@njit(cache=True, error_model="numpy")
def draw_bodies(
    geometry,
    body_mesh,
    body_poses,
    body_tints,
    body_object,
    hidden_object,
    receive,
    camera,
    light,
    projected,
    triangles,
    inverse_depth,
    triangle_at,
    spans,
):
    """Every visible triangle into the two buffers and the table of triangles; returns (status, number).

    `inverse_depth` holds zeros and `spans` (first column drawn, last + 1) of each row (width, 0) beforehand.
    """
    first_vertex, first_face, spheres, _, vertices, faces, planes, colors, kinds, normals, duals, tangents = geometry
    bound = 0
    for b in range(len(body_mesh)):
        m = body_mesh[b]
        if m < 0 or m >= len(first_face) - 1:
            return NO_MESH, b
        total = 0.0
        for i in range(3):
            for j in range(4):
                total += abs(body_poses[b, i, j])
        if not total < 1e12:
            return BAD_POSE, b
        bound += 2 * (first_face[m + 1] - first_face[m])
    if bound > len(triangles):
        return TABLE_FULL, bound
    height, width = inverse_depth.shape
    R_wc = camera[:9].reshape(3, 3)
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    offset_u, offset_v, near = camera[16], camera[17], camera[18]
    sides = _side_planes(fx, fy, cx, cy, width, height)
    R = np.empty((3, 3))
    t = np.empty(3)
    eye = np.empty(3)
    sun = np.empty(3)
    up = np.empty(3)
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
        sphere_x, sphere_y, sphere_z, radius = spheres[mesh, 0], spheres[mesh, 1], spheres[mesh, 2], spheres[mesh, 3]
        if not _in_view(
            R[0, 0] * sphere_x + R[0, 1] * sphere_y + R[0, 2] * sphere_z + t[0],
            R[1, 0] * sphere_x + R[1, 1] * sphere_y + R[1, 2] * sphere_z + t[1],
            R[2, 0] * sphere_x + R[2, 1] * sphere_y + R[2, 2] * sphere_z + t[2],
            radius,
            sides,
            near,
        ):
            continue
        for j in range(3):
            eye[j] = -(R[0, j] * t[0] + R[1, j] * t[1] + R[2, j] * t[2])
            sun[j] = pose[0, j] * light[0] + pose[1, j] * light[1] + pose[2, j] * light[2]
            up[j] = pose[2, j]
        base, end = first_vertex[mesh], first_vertex[mesh + 1]
        body = projected[:, : end - base]
        _project(vertices[:, base:end], R, t, camera, body)
        closest, left, right, top, bottom = _bounds(body, near, float(width), float(height))
        if left >= right or top >= bottom:
            continue
        in_front = closest >= near
        if in_front and _is_hidden(closest, int(left), ceil(right), int(top), ceil(bottom), inverse_depth):
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
            corners = 3
            i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
            if in_front:
                x0, y0 = projected[3, i], projected[4, i]
                x1, y1 = projected[3, j], projected[4, j]
                x2, y2 = projected[3, k], projected[4, k]
                # Most faces of a far body lie between the sample points, or are hidden.
                first, last = max(ceil(min(x0, min(x1, x2))), 0), min(ceil(max(x0, max(x1, x2))), width)
                if first >= last:
                    continue
                high, low = max(ceil(min(y0, min(y1, y2))), 0), min(ceil(max(y0, max(y1, y2))), height)
                if high >= low or _is_hidden(closest, first, last, high, low, inverse_depth):
                    continue
            else:
                corners = _project_face(i, j, k, projected, near, fx, fy, cx, cy, offset_u, offset_v, polygon)
                if corners == 0:
                    continue
                x0, y0 = polygon[0, 0], polygon[0, 1]
                x1, y1 = polygon[1, 0], polygon[1, 1]
                x2, y2 = polygon[2, 0], polygon[2, 1]
            # The face's plane n.p = d in the camera frame gives 1/z as an affine function of the pixel.
            nx = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
            ny = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
            nz = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
            scale = 1.0 / behind
            iz_u = nx * scale / fx
            iz_v = ny * scale / fy
            iz_0 = nz * scale + iz_u * (offset_u - cx) + iz_v * (offset_v - cy)
            drawn = _fill(x0, y0, x1, y1, x2, y2, iz_u, iz_v, iz_0, count, inverse_depth, triangle_at)
            if corners == 4:
                x3, y3 = polygon[3, 0], polygon[3, 1]
                drawn |= _fill(x0, y0, x2, y2, x3, y3, iz_u, iz_v, iz_0, count, inverse_depth, triangle_at)
            if not drawn:
                continue
            kind = int(kinds[f] & (SMOOTH | PATTERNED))
            from_sky = _from_sky(px, py, pz, up, sun, ambient)
            from_sun = (1.0 - ambient) * max(0.0, px * sun[0] + py * sun[1] + pz * sun[2])
            lit = from_sky + from_sun
            if kind & SMOOTH:
                lit = 1.0
                _record_brightness(
                    triangles[count],
                    normals[f],
                    duals[f],
                    vertices,
                    base + faces[f, 0],
                    up,
                    sun,
                    ambient,
                    R,
                    eye,
                    camera,
                )
            elif receive and px * up[0] + py * up[1] + pz * up[2] > 0.98:
                k = base + faces[f, 0]
                if up[0] * vertices[0, k] + up[1] * vertices[1, k] + up[2] * vertices[2, k] + pose[2, 3] < FLAT_M:
                    kind |= RECEIVES
                    lit = 1.0
                    triangles[count, 5] = from_sky
                    triangles[count, 6] = from_sun
            if kind & PATTERNED:
                s, t_ = tangents[f, :3], tangents[f, 3:6]
                _record_affine(triangles[count], 9, s[0], s[1], s[2], 0.0, R, eye, camera)
                _record_affine(triangles[count], 13, t_[0], t_[1], t_[2], 0.0, R, eye, camera)
                triangles[count, 17] = kinds[f] >> 4
            for i in range(3):
                triangles[count, i] = min(255.0, colors[f, i] * body_tints[b, i] * lit)
            triangles[count, 3] = body_object[b]
            triangles[count, 4] = kind
            count += 1
    return OK, count


@njit(cache=True, error_model="numpy")
def draw_shadows(geometry, body_mesh, body_poses, look, camera, light, projected, shadow, contact, spans):
    """Shadows that the sun casts on the ground into `shadow` (0 or 1), darkness around feet into `contact` (0 to 255).

    Both hold zeros and `spans` (width, 0) beforehand. A shadow is the mesh itself, flattened along the sun's rays.
    """
    first_vertex, first_face, spheres, extents, vertices, faces, planes = geometry[:7]
    if camera[11] <= 1e-6:
        return
    height, width = shadow.shape
    contact_strength = look[0]
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    sides = _side_planes(fx, fy, cx, cy, width, height)
    polygon = np.empty((4, 2))
    point = np.empty(3)
    # A low sun would throw shadows without end.
    slope_x, slope_y = light[0] / max(light[2], 0.15), light[1] / max(light[2], 0.15)
    for b in range(len(body_mesh)):
        mesh = body_mesh[b]
        pose = body_poses[b]
        if pose[2, 2] * extents[mesh, 5] + pose[2, 3] < FLAT_M and pose[2, 2] > 0.9:
            continue
        distance = sqrt((pose[0, 3] - camera[9]) ** 2 + (pose[1, 3] - camera[10]) ** 2)
        if distance - spheres[mesh, 3] > SHADOW_RANGE_M:
            continue
        if contact_strength > 0.0 and pose[2, 2] > 0.9:
            _draw_contact(extents[mesh], pose, contact_strength, camera, projected, polygon, contact, spans)
        if look[1] == 0.0 or light[2] < 0.02 or light[3] > 0.99:
            continue
        for i in range(3):
            point[i] = pose[i, 3]
            for j in range(3):
                point[i] += pose[i, j] * spheres[mesh, j]
        # Half the length of the shadow of a body from the ground to the top of its bounding sphere.
        rise = 0.5 * max(point[2] + spheres[mesh, 3], 0.0)
        reach = spheres[mesh, 3] + rise * sqrt(slope_x**2 + slope_y**2)
        _to_camera(point[0] - slope_x * rise, point[1] - slope_y * rise, 0.0, camera, projected, 0)
        if not _in_view(projected[0, 0], projected[1, 0], projected[2, 0], reach, sides, camera[18]):
            continue
        base, end = first_vertex[mesh], first_vertex[mesh + 1]
        body = projected[:, : end - base]
        _project_shadow(vertices[:, base:end], pose, slope_x, slope_y, camera, body)
        closest, left, right, top, bottom = _bounds(body, camera[18], float(width), float(height))
        if left >= right or top >= bottom:
            continue
        in_front = closest >= camera[18]
        for row in range(int(top), ceil(bottom)):
            spans[row, 0] = min(spans[row, 0], int(left))
            spans[row, 1] = max(spans[row, 1], ceil(right))
        sun_x = pose[0, 0] * light[0] + pose[1, 0] * light[1] + pose[2, 0] * light[2]
        sun_y = pose[0, 1] * light[0] + pose[1, 1] * light[1] + pose[2, 1] * light[2]
        sun_z = pose[0, 2] * light[0] + pose[1, 2] * light[1] + pose[2, 2] * light[2]
        for f in range(first_face[mesh], first_face[mesh + 1]):
            # The faces towards the sun cover the same shadow as those away from it.
            if planes[f, 0] * sun_x + planes[f, 1] * sun_y + planes[f, 2] * sun_z <= 0.0:
                continue
            i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
            if in_front:
                x0, y0 = projected[3, i], projected[4, i]
                x1, y1 = projected[3, j], projected[4, j]
                x2, y2 = projected[3, k], projected[4, k]
                if ceil(min(y0, min(y1, y2))) < ceil(max(y0, max(y1, y2))):
                    _fill_mask(x0, y0, x1, y1, x2, y2, shadow)
                continue
            corners = _project_face(i, j, k, projected, camera[18], fx, fy, cx, cy, camera[16], camera[17], polygon)
            for n in range(corners - 2):
                x1, y1, x2, y2 = polygon[n + 1, 0], polygon[n + 1, 1], polygon[n + 2, 0], polygon[n + 2, 1]
                _fill_mask(polygon[0, 0], polygon[0, 1], x1, y1, x2, y2, shadow)


@njit(cache=True, error_model="numpy")
def _draw_contact(extent, pose, strength, camera, projected, polygon, contact, spans):
    """Darken the ground below a body and a margin about its bounding box."""
    low, high = pose[2, 3] + extent[2], pose[2, 3] + extent[5]
    strength *= 1.0 - max(low, 0.0) / 0.3
    if strength <= 0.0 or low < -1.0:
        return
    margin = min(max(0.6 * (high - low), 0.05), 0.7)
    middle_x, middle_y = 0.5 * (extent[0] + extent[3]), 0.5 * (extent[1] + extent[4])
    half_x, half_y = 0.5 * (extent[3] - extent[0]), 0.5 * (extent[4] - extent[1])
    for k in range(4):
        x = middle_x + (half_x + margin) * (1.0 if k == 1 or k == 2 else -1.0)
        y = middle_y + (half_y + margin) * (1.0 if k >= 2 else -1.0)
        _to_camera(
            pose[0, 0] * x + pose[0, 1] * y + pose[0, 3],
            pose[1, 0] * x + pose[1, 1] * y + pose[1, 3],
            0.0,
            camera,
            projected,
            k,
        )
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    # Row of the camera's rotation that gives a world vector along the body's axes, per pixel, times z.
    maps = np.empty((3, 3))
    for axis in range(3):
        if axis < 2:
            wx, wy, wz = pose[0, axis], pose[1, axis], 0.0
        else:
            wx, wy, wz = 0.0, 0.0, -1.0 / camera[11]
        u = (camera[0] * wx + camera[3] * wy + camera[6] * wz) / fx
        v = (camera[1] * wx + camera[4] * wy + camera[7] * wz) / fy
        w = camera[2] * wx + camera[5] * wy + camera[8] * wz
        maps[axis, 0], maps[axis, 1] = u, v
        maps[axis, 2] = w + u * (camera[16] - cx) + v * (camera[17] - cy)
    eye_x = pose[0, 0] * (camera[9] - pose[0, 3]) + pose[1, 0] * (camera[10] - pose[1, 3]) - middle_x
    eye_y = pose[0, 1] * (camera[9] - pose[0, 3]) + pose[1, 1] * (camera[10] - pose[1, 3]) - middle_y
    for i in range(2):
        corners = _project_face(0, i + 1, i + 2, projected, camera[18], fx, fy, cx, cy, camera[16], camera[17], polygon)
        for k in range(corners - 2):
            _fill_contact(
                polygon[0, 0],
                polygon[0, 1],
                polygon[k + 1, 0],
                polygon[k + 1, 1],
                polygon[k + 2, 0],
                polygon[k + 2, 1],
                maps,
                eye_x,
                eye_y,
                half_x,
                half_y,
                margin,
                strength,
                contact,
                spans,
            )


@njit(cache=True, error_model="numpy")
def _project(vertices, R, t, camera, out):
    """Camera coordinates and pixels (5, v) of a body's vertices (3, v); pixels count beyond the near plane only."""
    fx, fy, cx, cy, offset_u, offset_v = camera[12], camera[13], camera[14], camera[15], camera[16], camera[17]
    r00, r01, r02, r10, r11, r12 = R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2]
    r20, r21, r22, t0, t1, t2 = R[2, 0], R[2, 1], R[2, 2], t[0], t[1], t[2]
    for k in range(vertices.shape[1]):
        px, py, pz = vertices[0, k], vertices[1, k], vertices[2, k]
        x = r00 * px + r01 * py + r02 * pz + t0
        y = r10 * px + r11 * py + r12 * pz + t1
        z = r20 * px + r21 * py + r22 * pz + t2
        iz = 1.0 / z
        out[0, k] = x
        out[1, k] = y
        out[2, k] = z
        out[3, k] = fx * x * iz + cx - offset_u
        out[4, k] = fy * y * iz + cy - offset_v


@njit(cache=True, error_model="numpy")
def _project_shadow(vertices, pose, slope_x, slope_y, camera, out):
    """Like `_project`, of the vertices' shadows on the ground."""
    p00, p01, p02, p03 = pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]
    p10, p11, p12, p13 = pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]
    p20, p21, p22, p23 = pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]
    c0, c1, c2, c3, c4, c5 = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    c6, c7, c8, eye_x, eye_y, below = camera[6], camera[7], camera[8], camera[9], camera[10], 0.0 - camera[11]
    fx, fy, cx, cy, offset_u, offset_v = camera[12], camera[13], camera[14], camera[15], camera[16], camera[17]
    for k in range(vertices.shape[1]):
        px, py, pz = vertices[0, k], vertices[1, k], vertices[2, k]
        z = max(p20 * px + p21 * py + p22 * pz + p23, 0.0)
        x = p00 * px + p01 * py + p02 * pz + p03 - slope_x * z - eye_x
        y = p10 * px + p11 * py + p12 * pz + p13 - slope_y * z - eye_y
        depth = c2 * x + c5 * y + c8 * below
        right = c0 * x + c3 * y + c6 * below
        down = c1 * x + c4 * y + c7 * below
        out[0, k] = right
        out[1, k] = down
        out[2, k] = depth
        out[3, k] = fx * right / depth + cx - offset_u
        out[4, k] = fy * down / depth + cy - offset_v


@njit(cache=True, error_model="numpy")
def _bounds(body, near, width, height):
    """Least depth of a projected body (5, v), and its first and last column and row in the image.

    Part of a body before the near plane may be anywhere.
    """
    closest, left, right, top, bottom = body[2, 0], width, 0.0, height, 0.0
    for k in range(body.shape[1]):
        closest = min(closest, body[2, k])
        u, v = body[3, k], body[4, k]
        left, right, top, bottom = min(left, u), max(right, u), min(top, v), max(bottom, v)
    if closest < near:
        return closest, 0.0, width, 0.0, height
    return closest, max(left, 0.0), min(right, width), max(top, 0.0), min(bottom, height)


@njit(cache=True, error_model="numpy")
def _is_hidden(closest, left, right, top, bottom, inverse_depth):
    """Whether every pixel of a rectangle shows something nearer than `closest` m, behind which nothing is seen."""
    nearest = np.float32(1.00001 / closest)
    for row in range(top, bottom):
        for column in range(left, right):
            if inverse_depth[row, column] < nearest:
                return False
    return True


@njit(cache=True, error_model="numpy", inline="always")
def _to_camera(x, y, z, camera, projected, k):
    """Camera coordinates and, beyond the near plane, pixel of a world point into row k of `projected`."""
    x, y, z = x - camera[9], y - camera[10], z - camera[11]
    depth = camera[2] * x + camera[5] * y + camera[8] * z
    right = camera[0] * x + camera[3] * y + camera[6] * z
    down = camera[1] * x + camera[4] * y + camera[7] * z
    projected[0, k] = right
    projected[1, k] = down
    projected[2, k] = depth
    if depth >= camera[18]:
        projected[3, k] = camera[12] * right / depth + camera[14] - camera[16]
        projected[4, k] = camera[13] * down / depth + camera[15] - camera[17]


@njit(cache=True, error_model="numpy", inline="always")
def _from_sky(nx, ny, nz, up, sun, ambient):
    """Light a face gets from sky and ground: the sky gives more than the ground, and more on the sun's side."""
    facing_up, facing_sun = nx * up[0] + ny * up[1] + nz * up[2], nx * sun[0] + ny * sun[1] + nz * sun[2]
    return ambient * (0.95 + 0.2 * facing_up + 0.15 * facing_sun)


@njit(cache=True, error_model="numpy")
def _record_brightness(record, normals, dual, vertices, first, up, sun, ambient, R, eye, camera):
    """Brightness of a smooth face, linear between its corners, into fields 5-8 of its record."""
    b0 = _brightness(normals[0], normals[1], normals[2], up, sun, ambient)
    b1 = _brightness(normals[3], normals[4], normals[5], up, sun, ambient) - b0
    b2 = _brightness(normals[6], normals[7], normals[8], up, sun, ambient) - b0
    gx = b1 * dual[0] + b2 * dual[3]
    gy = b1 * dual[1] + b2 * dual[4]
    gz = b1 * dual[2] + b2 * dual[5]
    b0 -= gx * vertices[0, first] + gy * vertices[1, first] + gz * vertices[2, first]
    _record_affine(record, 5, gx, gy, gz, b0, R, eye, camera)


@njit(cache=True, error_model="numpy", inline="always")
def _brightness(nx, ny, nz, up, sun, ambient):
    return _from_sky(nx, ny, nz, up, sun, ambient) + (1.0 - ambient) * max(0.0, nx * sun[0] + ny * sun[1] + nz * sun[2])


@njit(cache=True, error_model="numpy")
def _record_affine(record, at, gx, gy, gz, constant, R, eye, camera):
    """Fields at..at + 3 so that g.p + constant of a body point p is z (f0 column + f1 row + f2) + f3."""
    u = (R[0, 0] * gx + R[0, 1] * gy + R[0, 2] * gz) / camera[12]
    v = (R[1, 0] * gx + R[1, 1] * gy + R[1, 2] * gz) / camera[13]
    w = R[2, 0] * gx + R[2, 1] * gy + R[2, 2] * gz
    record[at] = u
    record[at + 1] = v
    record[at + 2] = w + u * (camera[16] - camera[14]) + v * (camera[17] - camera[15])
    record[at + 3] = constant + gx * eye[0] + gy * eye[1] + gz * eye[2]


@njit(cache=True, error_model="numpy")
def _side_planes(fx, fy, cx, cy, width, height):
    """Unit inward normals (4, 3) of the planes through the camera and the image's left, right, upper and lower edge."""
    sides = np.array(
        [[fx, 0.0, cx], [-fx, 0.0, width - cx], [0.0, fy, cy], [0.0, -fy, height - cy]],
    )
    for i in range(4):
        sides[i] /= sqrt(sides[i, 0] ** 2 + sides[i, 1] ** 2 + sides[i, 2] ** 2)
    return sides


@njit(cache=True, error_model="numpy")
def _in_view(x, y, z, radius, sides, near):
    """Whether a ball about (x, y, z) of the camera frame may reach into the picture."""
    inside = z + radius >= near
    for i in range(4):
        inside &= sides[i, 0] * x + sides[i, 1] * y + sides[i, 2] * z >= -radius
    return inside


@njit(cache=True, error_model="numpy")
def _project_face(i, j, k, projected, near, fx, fy, cx, cy, offset_u, offset_v, polygon):
    """Put the corners (u, v) of face (i, j, k), cut at the near plane, into `polygon`; returns how many: 0, 3 or 4."""
    in_i, in_j, in_k = projected[2, i] >= near, projected[2, j] >= near, projected[2, k] >= near
    if in_i and in_j and in_k:
        polygon[0, 0], polygon[0, 1] = projected[3, i], projected[4, i]
        polygon[1, 0], polygon[1, 1] = projected[3, j], projected[4, j]
        polygon[2, 0], polygon[2, 1] = projected[3, k], projected[4, k]
        return 3
    if not (in_i or in_j or in_k):
        return 0
    n = 0
    for a, b in ((i, j), (j, k), (k, i)):
        in_a, in_b = projected[2, a] >= near, projected[2, b] >= near
        if in_a:
            polygon[n, 0], polygon[n, 1] = projected[3, a], projected[4, a]
            n += 1
        if in_a != in_b:
            # From the inner to the outer corner, so that two faces cut their common edge at the very same point.
            p, q = (a, b) if in_a else (b, a)
            s = (near - projected[2, p]) / (projected[2, q] - projected[2, p])
            x = projected[0, p] + s * (projected[0, q] - projected[0, p])
            y = projected[1, p] + s * (projected[1, q] - projected[1, p])
            polygon[n, 0] = fx * x / near + cx - offset_u
            polygon[n, 1] = fy * y / near + cy - offset_v
            n += 1
    return n


@njit(cache=True, error_model="numpy", inline="always")
def _edges(x0, y0, x1, y1, x2, y2, width, height):
    """Corners from top to bottom, slopes du/dv of the long, upper and lower edge, first and last + 1 row."""
    if y1 < y0:
        x0, y0, x1, y1 = x1, y1, x0, y0
    if y2 < y0:
        x0, y0, x2, y2 = x2, y2, x0, y0
    if y2 < y1:
        x1, y1, x2, y2 = x2, y2, x1, y1
    low, high = max(min(x0, min(x1, x2)), -1.0), min(max(x0, max(x1, x2)), float(width))
    first, last = ceil(max(min(y0, float(height)), 0.0)), ceil(max(min(y2, float(height)), 0.0))
    if low > width - 1 or ceil(low) >= ceil(high):
        last = first
    long_slope = (x2 - x0) / (y2 - y0) if y2 > y0 else 0.0
    upper_slope = (x1 - x0) / (y1 - y0) if y1 > y0 else 0.0
    lower_slope = (x2 - x1) / (y2 - y1) if y2 > y1 else 0.0
    return x0, y0, x1, y1, long_slope, upper_slope, lower_slope, first, last


@njit(cache=True, error_model="numpy", inline="always")
def _columns(row, x0, y0, x1, y1, long_slope, upper_slope, lower_slope, width):
    """First and last + 1 column of a row of a triangle as `_edges` gives it.

    A pixel belongs to it if left <= u < right and top <= v < bottom, with each edge evaluated from its upper end:
    triangles that share an edge leave no gap and never draw a pixel twice.
    """
    xa = x0 + (row - y0) * long_slope
    xb = x0 + (row - y0) * upper_slope if row < y1 else x1 + (row - y1) * lower_slope
    if xb < xa:
        xa, xb = xb, xa
    return ceil(max(min(xa, float(width)), 0.0)), ceil(max(min(xb, float(width)), 0.0))


@njit(cache=True, error_model="numpy")
def _fill(x0, y0, x1, y1, x2, y2, iz_u, iz_v, iz_0, number, inverse_depth, triangle_at):
    """Fill a triangle whose sample points lie at whole numbers; returns whether any pixel was drawn."""
    height, width = inverse_depth.shape
    x0, y0, x1, y1, long_slope, upper, lower, first, last = _edges(x0, y0, x1, y1, x2, y2, width, height)
    drawn = False
    for row in range(first, last):
        left, right = _columns(row, x0, y0, x1, y1, long_slope, upper, lower, width)
        base = iz_0 + iz_v * row
        if right - left > LONG_RUN:
            drawn |= _fill_run(
                base, iz_u, np.uint64(left), np.uint64(right), np.uint64(row), number, inverse_depth, triangle_at
            )
            continue
        for column in range(left, right):
            iz = np.float32(base + iz_u * column)
            if iz > inverse_depth[row, column]:
                inverse_depth[row, column] = iz
                triangle_at[row, column] = number
                drawn = True
    return drawn


@njit(cache=True, error_model="numpy", inline="always")
def _fill_run(base, iz_u, left, right, row, number, inverse_depth, triangle_at):
    """A long run of a row's pixels: no branches and no indices that might be negative, so it becomes vector code."""
    drawn = np.int32(0)
    number = np.int32(number)
    for column in range(left, right):
        iz = np.float32(base + iz_u * np.int32(column))
        before = inverse_depth[row, column]
        closer = iz > before
        inverse_depth[row, column] = iz if closer else before
        triangle_at[row, column] = number if closer else triangle_at[row, column]
        drawn |= np.int32(closer)
    return drawn > 0


@njit(cache=True, error_model="numpy")
def _fill_mask(x0, y0, x1, y1, x2, y2, mask):
    """Set the pixels of a triangle to 1."""
    height, width = mask.shape
    x0, y0, x1, y1, long_slope, upper, lower, first, last = _edges(x0, y0, x1, y1, x2, y2, width, height)
    for row in range(first, last):
        left, right = _columns(row, x0, y0, x1, y1, long_slope, upper, lower, width)
        for column in range(np.uint64(left), np.uint64(right)):
            mask[np.uint64(row), column] = 1


@njit(cache=True, error_model="numpy")
def _fill_contact(x0, y0, x1, y1, x2, y2, maps, eye_x, eye_y, half_x, half_y, margin, strength, contact, spans):
    """Darken the pixels of a triangle on the ground by their distance from the rectangle of these half sides."""
    height, width = contact.shape
    x0, y0, x1, y1, long_slope, upper, lower, first, last = _edges(x0, y0, x1, y1, x2, y2, width, height)
    for row in range(first, last):
        left, right = _columns(row, x0, y0, x1, y1, long_slope, upper, lower, width)
        if left >= right:
            continue
        spans[row, 0] = min(spans[row, 0], left)
        spans[row, 1] = max(spans[row, 1], right)
        feet = contact[row, left:right]
        x_0, y_0, iz_0 = maps[0, 1] * row, maps[1, 1] * row, maps[2, 1] * row
        for c in range(len(feet)):
            column = left + c
            iz = maps[2, 0] * column + iz_0 + maps[2, 2]
            x = (maps[0, 0] * column + x_0 + maps[0, 2]) / iz + eye_x
            y = (maps[1, 0] * column + y_0 + maps[1, 2]) / iz + eye_y
            away = sqrt(max(abs(x) - half_x, 0.0) ** 2 + max(abs(y) - half_y, 0.0) ** 2)
            dark = max(0.0, 1.0 - away / margin)
            value = np.uint8(255.0 * strength * dark * dark)
            feet[c] = value if iz > 0.0 and value > feet[c] else feet[c]
