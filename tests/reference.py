"""Slow numpy twins of every numba kernel, written to be read; the kernels are tested against them."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from itertools import pairwise

import numpy as np

# --- points ----------------------------------------------------------------------------------------------------------


def unpack_lzf(packed, size):
    """Twin of `edgeperc.readers.pcd.fill_unpacked_lzf`: the bytes, or None where the data is damaged."""
    packed, out = list(packed), []
    try:
        while packed:
            control = packed.pop(0)
            if control < 32:
                run = packed[: control + 1]
                del packed[: control + 1]
                if len(run) != control + 1:
                    return None
                out += run
            else:
                length = (control >> 5) + 2
                if length == 9:
                    length += packed.pop(0)
                start = len(out) - ((control & 31) << 8) - packed.pop(0) - 1
                if start < 0:
                    return None
                for k in range(length):
                    out.append(out[start + k])
            if len(out) > size:
                return None
    except IndexError:
        return None
    return bytes(out)


# --- sensors ---------------------------------------------------------------------------------------------------------


def scan_sums(points, step, beam_step, view_right, view_left):
    """Twin of `edgeperc.fitness.fill_scan_sums`: its outputs in their order, but ``rows`` as eight lists."""

    def finite(rows):
        return rows[np.isfinite(rows).all(axis=1)].astype(np.float64)

    remissions, elevations, ranges = np.zeros(258, int), np.zeros(360, int), np.zeros(200, int)
    heights, seen, n_near, n_view = np.zeros((3, 100), int), np.zeros(64, bool), 0, 0
    sample = finite(points[::step])
    for x, y, z, remission in sample:
        remissions[0 if remission <= 0 else 257 if remission > 1 else 1 + min(int(remission * 256), 255)] += 1
        if x == 0 and y == 0:
            continue
        azimuth = y / (abs(x) + abs(y))
        if x < 0:
            azimuth = (2 if y >= 0 else -2) - azimuth
        seen[min(int((azimuth + 2) * 16), 63)] = True
        n_view += view_right <= azimuth <= view_left
        horizontal = math.sqrt(x * x + y * y)
        elevations[min(int((math.atan(z / horizontal) * (180 / math.pi) + 90) * 2), 359)] += 1
        ranges[min(max(int((math.log10(horizontal) + 3) * 20), 0), 199)] += 1
        if 9 < x * x + y * y + z * z < 625:
            n_near += 1
            for axis, value in enumerate((x, y, z)):
                if -10 <= value < 10:
                    heights[axis, min(int((value + 10) * 5), 99)] += 1
    middles = (np.arange(64) + 0.5) / 16 - 2
    viewed = (middles >= view_right) & (middles <= view_left)

    x, y, z, remission = sample.T
    above = z - (heights[2].argmax() * 0.2 - 9.9)
    stands = (above > 0.5) & (above < 6) & (abs(x) < 30) & (abs(y) < 30)
    x, y = x[stands], y[stands]
    in_the_way = [(abs(y) < 2) & (x > 3), (abs(y) < 2) & (x < -3), (abs(x) < 2) & (y > 3), (abs(x) < 2) & (y < -3)]
    ahead, behind, left, right = (way.sum() + 0.002 * max(len(sample), 1) for way in in_the_way)
    along_x, along_y = (np.histogram(v, np.arange(-30, 30.1, 0.5))[0] for v in (x, y))
    alignment = np.log(max(left, right) / max(ahead, behind))
    alignment += 0.5 * np.log(((along_y**2).sum() + 1) / ((along_x**2).sum() + 1))

    rows = [[] for _ in range(8)]
    for x, y, z, _ in finite(points[::beam_step]):
        more, less = max(abs(x), abs(y)), min(abs(x), abs(y))
        if more > 1 and (less < 0.0044 * more or more - less < 0.0087 * more):
            direction = round(math.degrees(math.atan2(y, x)) / 45) % 8
            if len(rows[direction]) < 1024:
                rows[direction].append(math.degrees(math.atan(z / math.sqrt(x * x + y * y))))
    lowest, highest = (remission.min(), remission.max()) if len(sample) else (np.inf, -np.inf)
    sums = [len(sample), n_view, seen.sum(), seen[viewed].sum() / max(viewed.sum(), 1)]
    return remissions, elevations, ranges, heights, rows, [*sums, alignment, lowest, highest, n_near]


# --- projection ------------------------------------------------------------------------------------------------------


def top_view_pixel(point, view):
    """Flat pixel of one point and its rank, the smaller the better; (-1, None) out of view."""
    x, y, z, remission = point
    (x_min, x_max), (y_min, y_max), (z_min, z_max) = np.float32([view.x_range_m, view.y_range_m, view.z_range_m])
    if not (x_min <= x < x_max and y_min <= y < y_max and z_min <= z <= z_max and np.isfinite(remission)):
        return -1, None
    cells_per_m = np.float32(1.0 / view.cell_m)
    ahead = min(int((x - x_min) * cells_per_m), view.height - 1)
    left = min(int((y - y_min) * cells_per_m), view.width - 1)
    return (view.height - 1 - ahead) * view.width + view.width - 1 - left, -z


def range_image_pixel(point, view, row_edges, col_edges):
    """Flat pixel of one point and its rank, the smaller the better; (-1, None) out of view."""
    if not np.isfinite(point).all():
        return -1, None
    x, y, z, _ = point
    squared_distance = x * x + y * y
    squared_range = squared_distance + z * z
    if squared_distance == 0 or not np.isfinite(squared_range):
        return -1, None
    azimuth = y / (abs(x) + abs(y))
    if x < 0:
        azimuth = np.float32(2 if y >= 0 else -2) - azimuth
        if azimuth == -2:  # rounded onto the far side of straight behind
            azimuth = np.nextafter(np.float32(-2), np.float32(0))
    elevation = z / (np.sqrt(squared_distance) + abs(z))
    row = np.count_nonzero(elevation <= row_edges) - 1
    col = np.count_nonzero(azimuth <= col_edges) - 1
    if not (0 <= row < view.height and 0 <= col < view.width):
        return -1, None
    return row * view.width + col, squared_range


def project(points, view, edges, spec, remission_offset, remission_scale):
    """Twin of `edgeperc.projection`'s kernels: image, index, pixel. ``edges``: a range image's, of rows and columns."""
    image = np.zeros((len(spec.channels), view.height * view.width), np.float32)
    index = np.full(view.height * view.width, -1, np.int32)
    pixel = np.full(len(points), -1, np.int32)
    best = {}
    mean, std = np.float32(spec.mean), np.float32(spec.std)
    with np.errstate(all="ignore"):
        for i, point in enumerate(points):
            flat, rank = (
                top_view_pixel(point, view) if view.kind == "top_view" else range_image_pixel(point, view, *edges)
            )
            pixel[i] = flat
            if flat < 0 or (flat in best and not rank < best[flat]):
                continue
            best[flat] = rank
            index[flat] = i
            x, y, z, remission = point
            distance = np.sqrt(x * x + y * y)
            raw = {
                "x": x, "y": y, "z": z, "height": z, "distance": distance, "range": np.sqrt(x * x + y * y + z * z),
                "remission": (remission + np.float32(remission_offset)) * np.float32(remission_scale),
            }  # fmt: skip
            image[:, flat] = (np.array([raw[name] for name in spec.channels], np.float32) - mean) / std
    return image.reshape(-1, view.height, view.width), index.reshape(view.height, view.width), pixel


# --- adapt -----------------------------------------------------------------------------------------------------------


def rendered(points, function, remission_range):
    """Twin of `edgeperc.adapt.render`."""
    low, high = remission_range
    out = points.copy()
    for i, raw in enumerate(points[:, 3].astype(np.float64)):
        x = (raw - low) / (high - low) * function.full_scale
        if not np.isfinite(x):
            out[i, 3] = np.nan
        elif function.kind == "logarithm":
            a, b = function.coefficients
            out[i, 3] = np.clip(a + b * np.log1p(max(x, 0.0)), 0.0, 1.0)
        else:
            out[i, 3] = np.clip(sum(c * x**k for k, c in enumerate(function.coefficients)), 0.0, 1.0)
    return out


def one_surface(p, q, ground_z):
    """Whether a point may be put between two: KUL-Seg 5, never across a depth edge."""
    far, near = max(np.linalg.norm(p[:3]), np.linalg.norm(q[:3])), min(np.linalg.norm(p[:3]), np.linalg.norm(q[:3]))
    apart = np.linalg.norm(q[:3] - p[:3])
    if far - near <= 0.5 and far - near <= np.cos(np.radians(5.0)) * apart:
        return True
    at_ground = all(abs(r[2] - ground_z) <= 0.3 + 0.02 * np.linalg.norm(r[:3]) for r in (p, q))
    return at_ground and abs(q[2] - p[2]) <= 0.1 * apart


def between(points, index, elevations, azimuths, row_reach, col_reach, ground_z):
    """Twin of `edgeperc.adapt.Interpolator.fill`: points, index, and the two neighbours of every new point."""
    points, index, parents = [p.astype(np.float64) for p in points], index.copy(), []
    height, width = index.shape

    def fill(line, reach, offset):
        """Along one line of pixels (row, col); ``offset`` is how far a point lies from the middle of a pixel."""
        full = [k for k, at in enumerate(line) if index[at] >= 0]
        for start, stop in pairwise(full):
            i, j = index[line[start]], index[line[stop]]
            if not 1 < stop - start <= reach(line[start]) or not one_surface(points[i], points[j], ground_z):
                continue
            for at in line[start + 1 : stop]:
                one, other = offset(points[i], at), offset(points[j], at)
                if one * other < 0.0:
                    mixed = points[i] + one / (one - other) * (points[j] - points[i])
                    index[at] = len(points)
                    points.append(mixed.astype(np.float32).astype(np.float64))
                    parents.append((i, j))

    for row in range(height):
        fill(
            [(row, col) for col in range(width)],
            lambda at: col_reach,
            lambda p, at: p[0] * np.sin(azimuths[at[1]]) - p[1] * np.cos(azimuths[at[1]]),
        )
    for col in range(width):
        fill(
            [(row, col) for row in range(height)],
            lambda at: row_reach[at[0]],
            lambda p, at: p[2] - np.tan(elevations[at[0]]) * np.hypot(p[0], p[1]),
        )
    return np.array(points, np.float32).reshape(-1, 4), index, parents


# --- decode ----------------------------------------------------------------------------------------------------------


def rectangle_corners(rectangle):
    """Corners of x, y, length, width, yaw, counter-clockwise, (4, 2)."""
    x, y, length, width, yaw = rectangle
    local = 0.5 * np.array([[length, width], [-length, width], [-length, -width], [length, -width]])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return local @ turn.T + [x, y]


def polygon_area(corners):
    """Shoelace formula; 0 for fewer than three corners."""
    if len(corners) < 3:
        return 0.0
    x, y = np.asarray(corners, dtype=np.float64).T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def clip_polygon(subject, clip):
    """Sutherland and Hodgman: the part of polygon ``subject`` inside the convex, counter-clockwise ``clip``."""
    for start, end in zip(clip, np.roll(clip, -1, axis=0), strict=True):
        edge = end - start

        def side(p, start=start, edge=edge):
            return edge[0] * (p[1] - start[1]) - edge[1] * (p[0] - start[0])

        inside = []
        for k, corner in enumerate(subject):
            last = subject[k - 1]
            if (side(corner) >= 0.0) != (side(last) >= 0.0):
                share = side(last) / (side(last) - side(corner))
                inside.append(last + share * (corner - last))
            if side(corner) >= 0.0:
                inside.append(corner)
        subject = inside
    return subject


def oriented_iou(a, b):
    """Twin of `edgeperc.geometry.fill_oriented_iou`."""
    iou = np.zeros((len(a), len(b)))
    for i, first in enumerate(np.asarray(a, dtype=np.float64)):
        for j, second in enumerate(np.asarray(b, dtype=np.float64)):
            if not (np.isfinite([*first, *second]).all() and min(*first[2:4], *second[2:4]) > 0.0):
                continue
            shared = polygon_area(clip_polygon(list(rectangle_corners(first)), rectangle_corners(second)))
            union = first[2] * first[3] + second[2] * second[3] - shared
            iou[i, j] = shared / union
    return iou


def nms(rectangles, iou_threshold):
    """Twin of `edgeperc.geometry.mark_nms`."""
    iou = oriented_iou(rectangles, rectangles)
    keep = np.ones(len(rectangles), dtype=bool)
    for i in range(len(rectangles)):
        keep[i] = not (iou[i, :i][keep[:i]] > iou_threshold).any()
    return keep


def softmax(logits):
    """Probabilities along axis 0, in float64."""
    logits = np.asarray(logits, dtype=np.float64)
    e = np.exp(logits - logits.max(axis=0, keepdims=True))
    return e / e.sum(axis=0, keepdims=True)


def classes(values, are_logits):
    """Twin of `edgeperc.decode.fill_classes`: labels, scores and the number of values that are not finite."""
    labels = np.argmax(values, axis=0).astype(np.uint8)
    probabilities = softmax(values) if are_logits else values
    return labels, probabilities.max(axis=0), int((~np.isfinite(values)).sum())


def peaks(heat, threshold):
    """Twin of `edgeperc.decode.mark_peaks`."""
    padded = np.pad(heat.astype(np.float64), 1, constant_values=-np.inf)
    height, width = heat.shape
    peak = heat >= threshold
    for d_row in (-1, 0, 1):
        for d_col in (-1, 0, 1):
            other = padded[1 + d_row : 1 + d_row + height, 1 + d_col : 1 + d_col + width]
            if (d_row, d_col) < (0, 0):
                peak = peak & (heat > other)
            elif (d_row, d_col) > (0, 0):
                peak = peak & (heat >= other)
    return peak


def footprint_sums(values, are_logits, rectangles, x_far, y_left, cell):
    """Twin of `edgeperc.decode.fill_footprint_sums`."""
    probabilities = softmax(values) if are_logits else values.astype(np.float64)
    _, height, width = values.shape
    x = x_far - (np.arange(height)[:, None] + 0.5) * cell
    y = y_left - (np.arange(width)[None, :] + 0.5) * cell
    sums = np.zeros((len(rectangles), len(values)))
    for i, (at_x, at_y, length, across, yaw) in enumerate(rectangles):
        along = (x - at_x) * np.cos(yaw) + (y - at_y) * np.sin(yaw)
        aside = (y - at_y) * np.cos(yaw) - (x - at_x) * np.sin(yaw)
        inside = (abs(along) <= length / 2) & (abs(aside) <= across / 2)
        if not inside.any():
            row = min(max(int(np.floor((x_far - at_x) / cell)), 0), height - 1)
            col = min(max(int(np.floor((y_left - at_y) / cell)), 0), width - 1)
            inside[row, col] = True
        sums[i] = probabilities[:, inside].sum(axis=1)
    return sums


# --- refine ----------------------------------------------------------------------------------------------------------


def neighbours(row, col, reach, shape, full_turn):
    """Pixels at most ``reach`` rows and columns away, row by row."""
    for r in range(max(row - reach, 0), min(row + reach + 1, shape[0])):
        for c in range(col - reach, col + reach + 1):
            if full_turn or 0 <= c < shape[1]:
                yield r, c % shape[1]


def without_outliers(points, index, labels, radii, full_turn):
    """Twin of `edgeperc.refine.fill_without_outliers`."""
    cleaned = labels.copy()
    seen = np.zeros(labels.shape, dtype=bool)
    for first in np.ndindex(*labels.shape):
        radius = radii[labels[first]]
        if radius <= 0.0 or seen[first]:
            continue
        found = [first]
        seen[first] = True
        for pixel in found:
            for other in neighbours(*pixel, 1, labels.shape, full_turn):
                if not seen[other] and labels[other] == labels[first]:
                    seen[other] = True
                    found.append(other)
        left = [pixel for pixel in found if index[pixel] >= 0]
        draw = first[0] * labels.shape[1] + first[1]
        rim = set()
        for n_objects in range(64):
            if not left:
                break
            ground = np.array([points[index[pixel], :2] for pixel in left], dtype=np.float64)
            tested = ground[:: -(-len(left) // 512)]
            most, center = 0, None
            for _ in range(16):
                draw = (draw * 1103515245 + 12345) % 2**31
                hypothesis = tested[draw * len(tested) // 2**31]
                near = ((tested - hypothesis) ** 2).sum(axis=1) <= radius**2
                if not near.any():  # not finite
                    continue
                hypothesis = tested[near].mean(axis=0)
                near = ((tested - hypothesis) ** 2).sum(axis=1) <= radius**2
                if near.sum() > most:
                    most, center = near.sum(), hypothesis
            inside = np.zeros(len(left), dtype=bool)
            if center is not None:
                inside = ((ground - center) ** 2).sum(axis=1) <= radius**2
            members = [pixel for pixel, near in zip(left, inside, strict=True) if near]
            beyond = [pixel for pixel in members if pixel not in rim]
            is_object = len(members) >= 5 and len(beyond) >= 0.1 * len(members)
            if not members or (n_objects > 0 and not is_object):
                for pixel in left:
                    cleaned[pixel] = 0
                break
            for pixel in members:
                rim.update(neighbours(*pixel, 2, labels.shape, full_turn))
            left = [pixel for pixel, near in zip(left, inside, strict=True) if not near]
    return cleaned


def point_labels(points, pixel, index, labels, full_turn):
    """Twin of `edgeperc.refine.fill_point_labels`."""
    ranges = np.sqrt((points[:, :3].astype(np.float64) ** 2).sum(axis=1))
    out = np.zeros(len(points), dtype=np.uint8)
    for i, flat in enumerate(pixel):
        if flat < 0:
            continue
        at = divmod(int(flat), labels.shape[1])
        if index[at] == i:
            out[i] = labels[at]
            continue
        around = [p for p in neighbours(*at, 2, labels.shape, full_turn) if index[p] >= 0]
        gaps = [(abs(ranges[index[p]] - ranges[i]), k) for k, p in enumerate(around)]
        votes = [labels[around[k]] for gap, k in sorted(g for g in gaps if g[0] <= 1.0)[:5]]
        out[i] = max(votes, key=votes.count) if votes else 0
    return out


# --- simulation ------------------------------------------------------------------------------------------------------


def mixed(value: int) -> int:
    """splitmix64."""
    mask = 2**64 - 1
    value = (value + 0x9E3779B97F4A7C15) & mask
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & mask
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & mask
    return value ^ (value >> 31)


def uniform_draw(bits: int) -> float:
    return ((bits >> 11) + 0.5) / 2.0**53


def crossing(primitive: np.ndarray, direction: np.ndarray) -> tuple[float, float] | None:
    """Where a ray from the origin enters and leaves one primitive of `edgeperc.simulation.raycast`."""
    kind, matrix = int(primitive[0]), primitive[7:16].reshape(3, 3)
    front, rear, side = primitive[16:19] / 2.0
    start, way = matrix @ -primitive[4:7], matrix @ direction
    if kind == 2:  # the unit ball
        normals, curved = np.zeros((0, 3)), [0, 1, 2]
    elif kind == 1:  # the unit cylinder
        normals, curved = np.array([[0, 0, -1], [0, 0, 1.0]]), [0, 1]
    else:
        curved = []
        normals = np.array(
            [[0, 0, -1], [0, 0, 1], [1, 0, front], [-1, 0, rear], [0, 1, side], [0, -1, side]], dtype=float
        )
    offsets = 1.0 - np.concatenate([[0.0, 0.0], [front, rear, side, side]])[: len(normals)]
    enter, leave = -np.inf, np.inf
    for normal, offset in zip(normals, offsets, strict=True):
        rate, gap = normal @ way, offset - normal @ start
        if rate > 0:
            leave = min(leave, gap / rate)
        elif rate < 0:
            enter = max(enter, gap / rate)
        elif gap < 0:
            return None
    if curved:
        o, d = start[curved], way[curved]
        roots = np.roots([d @ d, 2 * o @ d, o @ o - 1])
        if np.iscomplex(roots).any():
            return None
        enter, leave = max(enter, roots.real.min()), min(leave, roots.real.max())
    return (enter, leave) if enter <= leave else None


def ground(scene, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height of the ground, and how far out of the roads, for arrays of x and y."""
    slope_x, slope_y, ax, kx, px, ay, ky, py = scene.terrain[:8]
    kerb, pavement, crown, bank, rise, rough, ditch, rounding = scene.terrain[8:16]
    outside, bays = np.full(np.shape(x), np.inf), np.full(np.shape(x), np.inf)
    for k, (x0, y0, cos, sin, curvature, right, left, first, last, is_bay) in enumerate(scene.strips):
        s, across = cos * (x - x0) + sin * (y - y0), cos * (y - y0) - sin * (x - x0)
        u = (across - curvature * s * s / 2) / np.sqrt(1 + (curvature * s) ** 2)
        d = np.max([u - left, right - u, first - s, s - last], axis=0)
        if is_bay:
            bays = np.minimum(bays, d)
        elif k == 0:
            outside, along = d, s
        else:
            outside = np.minimum(outside, d) - np.maximum(rounding - abs(outside - d), 0) ** 2 / (4 * rounding)
    z = slope_x * x + slope_y * y + ax * np.sin(kx * x + px) + ay * np.sin(ky * y + py)
    d = np.minimum(outside, bays)
    inside = crown * np.minimum(-d, 4.0) + scene.terrain[23] * (outside > 0)
    dropped = ((along + scene.terrain[21]) / 23.0) % 1.0 < 0.15
    verge = kerb * np.where(dropped, 0.25, 1.0) * np.minimum(d / 0.05, 1.0) + 0.02 * np.minimum(d, pavement)
    e = d - pavement
    slope = np.minimum(bank * e, rise) if rise > 0 else np.maximum(-bank * e, rise)
    size = len(scene.tile)
    row, column = np.floor(y / 0.3).astype(int), np.floor(x / 0.3).astype(int)
    b, a = y / 0.3 - row, x / 0.3 - column
    noise = sum(
        wy * wx * scene.tile[(row + i) % size, (column + j) % size]
        for i, wy in ((0, 1 - b), (1, b))
        for j, wx in ((0, 1 - a), (1, a))
    )
    grass = slope - ditch * np.maximum(1 - ((e - 1.6) / 1.2) ** 2, 0) + np.minimum(e / 0.3, 1) * rough * (1 + noise)
    return z + np.where(d <= 0, inside, verge + np.where(e > 0, grass, 0.0)), outside


def cast(primitives, scene, pose, elevations, azimuths, reach, key):
    """What each ray meets first, by trying every primitive and walking over the ground in steps of 5 mm."""
    shape = (len(elevations), len(azimuths))
    ranges, hits = np.full(shape, float(reach)), np.full(shape, -2)
    for b, elevation in enumerate(elevations):
        for column, azimuth in enumerate(azimuths):
            level = np.array([np.cos(azimuth), np.sin(azimuth)]) * np.cos(elevation)
            direction = np.array([*level, np.sin(elevation)])
            steps = np.arange(0.0, reach, 0.005)
            world = pose[:3, :3] @ np.outer(direction, steps) + pose[:3, 3:4]
            below = np.flatnonzero(world[2] < ground(scene, world[0], world[1])[0])
            if len(below):
                ranges[b, column], hits[b, column] = steps[below[0]], -1
            ray = mixed((int(key) + b * len(azimuths) + column) & (2**64 - 1))
            for k, primitive in enumerate(primitives):
                found = crossing(primitive, direction)
                if found is None or found[1] <= 0:
                    continue
                t, draw = found[0], uniform_draw(mixed(ray ^ (k + 1)))
                if primitive[1] == 4:  # leaves: a free path
                    t = max(t, 0.0) - np.log(draw) / primitive[3]
                    if t >= found[1]:
                        continue
                elif t <= 0 or (primitive[1] == 5 and draw > primitive[3]):  # inside it, or through a gap
                    continue
                if t < ranges[b, column]:
                    ranges[b, column], hits[b, column] = t, k
    return ranges, hits


# --- tracking --------------------------------------------------------------------------------------------------------


def moved(mode, state, dt):
    """Twin of `edgeperc.tracking.ukf.move`."""
    x, y, v, heading, turn = state
    if mode == 0:
        return np.array([x + v * math.cos(heading) * dt, y + v * math.sin(heading) * dt, v, heading, 0.0])
    if mode == 2:
        return np.array([x, y, 0.0, heading, 0.0])
    if abs(turn) < 1e-4:
        middle = heading + turn * dt / 2
        x, y = x + v * dt * math.cos(middle), y + v * dt * math.sin(middle)
    else:
        x += v / turn * (math.sin(heading + turn * dt) - math.sin(heading))
        y -= v / turn * (math.cos(heading + turn * dt) - math.cos(heading))
    return np.array([x, y, v, heading + turn * dt, turn])


def process_noise(mode, heading, noise, dt):
    """Twin of `edgeperc.tracking.ukf.fill_process_noise`."""
    acceleration, turn, walk, wander, speed = noise
    if mode == 2:
        return np.diag([walk**2 * dt, walk**2 * dt, speed**2, wander**2 * dt, 0.01 * turn**2])
    push = np.array([dt**2 / 2 * math.cos(heading), dt**2 / 2 * math.sin(heading), dt, 0, 0])
    swing = np.array([0, 0, 0, dt**2 / 2, dt])
    Q = acceleration**2 * np.outer(push, push) + np.diag([0.01 * walk**2 * dt] * 2 + [0, wander**2 * dt, 0])
    return Q + turn**2 * (np.outer(swing, swing) if mode == 1 else np.diag([0, 0, 0, 0, 0.01]))


def unscented_prediction(mode, state, covariance, noise, dt):
    """Twin of `edgeperc.tracking.ukf.fill_predictions`, for one motion of one track."""
    root = np.linalg.cholesky(6.0 * covariance)
    points = [state, *(state + root.T), *(state - root.T)]
    weights = np.array([1 / 6] + [1 / 12] * 10)
    points = np.array([moved(mode, point, dt) for point in points])
    mean = weights @ points
    return mean, (points - mean).T @ np.diag(weights) @ (points - mean) + process_noise(mode, state[3], noise, dt)


def innovation(mean, covariance, sigmas, detection):
    """A detection's deviation from a prediction, and its covariance: heading modulo pi, three deviations at most."""
    H = np.eye(5)[[0, 1, 3]]
    cos, sin = math.cos(mean[3]), math.sin(mean[3])
    turned = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    S = H @ covariance @ H.T + turned @ np.diag(np.square(sigmas)) @ turned.T
    off = detection - H @ mean
    off[2] = (off[2] + math.pi / 2) % math.pi - math.pi / 2
    off[2] = np.clip(off[2], -3 * math.sqrt(S[2, 2]), 3 * math.sqrt(S[2, 2]))
    return off, S


def pda_update(mean, covariance, sigmas, detections, beta):
    """Twin of `edgeperc.tracking.ukf.fill_updates`, for one motion of one track: the books' PDA filter."""
    _, S = innovation(mean, covariance, sigmas, np.zeros(3))
    offs = [innovation(mean, covariance, sigmas, detection)[0] for detection in detections]
    K = covariance @ np.eye(5)[[0, 1, 3]].T @ np.linalg.inv(S)
    off = sum((b * o for b, o in zip(beta[1:], offs, strict=True)), np.zeros(3))
    spread = sum((b * np.outer(o, o) for b, o in zip(beta[1:], offs, strict=True)), np.zeros((3, 3)))
    updated = covariance - K @ S @ K.T
    total = beta[0] * covariance + (1 - beta[0]) * updated + K @ (spread - np.outer(off, off)) @ K.T
    return mean + K @ off, total


def likelihoods(means, predicted, sigmas, groups, detections, detection_groups, gates):
    """Twin of `edgeperc.tracking.jpda.fill_likelihoods`, without the weights."""
    out = np.zeros((len(groups), 3, len(detections)))
    for i, j in np.ndindex(len(groups), len(detections)):
        if groups[i] != detection_groups[j]:
            continue
        inside = False
        for mode in range(3):
            off, S = innovation(means[i, mode], predicted[i, mode], sigmas[i], detections[j])
            inside |= bool(off[:2] @ np.linalg.inv(S[:2, :2]) @ off[:2] <= gates[i] ** 2)
            density = math.sqrt((2 * math.pi) ** 3 * np.linalg.det(S))
            out[i, mode, j] = math.exp(-off @ np.linalg.inv(S) @ off / 2) / density
        out[i, :, j] *= inside
    return out


def association(weights):
    """Twin of `edgeperc.tracking.jpda.fill_association`: every joint event written out."""
    n, m = weights.shape
    beta = np.zeros((n, m + 1))
    for event in itertools.product(range(-1, m), repeat=n):
        taken = [j for j in event if j >= 0]
        if len({*taken}) == len(taken):
            probability = math.prod(1.0 if j < 0 else weights[i, j] for i, j in enumerate(event))
            for i, j in enumerate(event):
                beta[i, j + 1] += probability
    return beta / beta.sum(axis=1, keepdims=True)


def propagation(weights, rounds=2000):
    """Twin of `edgeperc.tracking.jpda.fill_by_propagation`."""
    to_track = np.ones(weights.shape)
    for _ in range(rounds):
        sent = weights * to_track
        to_detection = weights / (1 + sent.sum(axis=1, keepdims=True) - sent)
        to_track = 1 / (1 + to_detection.sum(axis=0) - to_detection)
    sent = weights * to_track
    total = 1 + sent.sum(axis=1, keepdims=True)
    return np.hstack([1 / total, sent / total])


def interaction(states, covariances, probabilities, stay):
    """Twin of `edgeperc.tracking.imm.fill_interaction`, for one track."""
    k = len(states)
    chain = np.where(np.eye(k, dtype=bool), stay, (1 - stay) / (k - 1))
    prior = probabilities @ chain
    pairs = [combination(states, covariances, chain[:, j] * probabilities / prior[j]) for j in range(k)]
    return np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs]), prior


def combination(states, covariances, probabilities):
    """Twin of `edgeperc.tracking.imm.fill_combined`, for one track."""
    mean = probabilities @ states
    off = states - mean
    return mean, np.einsum("k,kab->ab", probabilities, covariances + off[:, :, None] * off[:, None, :])


def mode_probabilities(prior, likelihoods, beta):
    """Twin of `edgeperc.tracking.imm.fill_mode_probabilities`, for one track: shares and probabilities."""
    mixture = prior @ likelihoods
    joint = np.hstack(
        [
            (beta[0] * prior)[:, None],
            beta[1:] * prior[:, None] * likelihoods / np.where(mixture > 0, mixture, 1.0),
        ]
    )
    return joint / joint.sum(axis=1, keepdims=True), joint.sum(axis=1) / joint.sum()


def motion_support(landmarks, detections, prior, spread, motion):
    """Twin of `edgeperc.tracking.egomotion.support`."""
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    turned = detections[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + motion[:2]
    total = -0.5 * ((motion - prior) ** 2 / spread).sum()
    for x, y, variance, group in landmarks:
        r2 = ((turned - [x, y]) ** 2).sum(axis=1) / (variance + detections[:, 2])
        r2 = r2[detections[:, 3] == group]
        total -= 0.5 * r2.min() / (1 + r2.min() / 9) if len(r2) else 4.5
    return total


def hidden(state, shape, seen, sensor):
    """Twin of `edgeperc.tracking.lives.fill_hidden`."""
    off = state[:, :2] - sensor
    azimuth, distance = np.arctan2(off[:, 1], off[:, 0]), np.hypot(off[:, 0], off[:, 1])
    turned = state[:, 3] - azimuth
    half = np.arctan2(np.abs(shape[:, 1] * np.sin(turned)) + np.abs(shape[:, 2] * np.cos(turned)), 2 * distance)
    shares = np.zeros(len(state))
    for i in np.flatnonzero(~seen):
        rays = azimuth[i] + np.linspace(-half[i], half[i], 9)
        before = np.flatnonzero(seen & (distance < distance[i] - 1))
        apart = np.abs(np.angle(np.exp(1j * (rays[:, None] - azimuth[before]))))
        shares[i] = (apart <= half[before]).any(axis=1).mean()
    return shares


def updated_shapes(state, beta, detections, shapes, sigmas, walk, shape, variance, front):
    """Twin of `edgeperc.tracking.lives.update_shapes`: the new shape, variance and front."""
    variance = variance + walk**2
    detected = 1 - beta[:, :1]
    gain = variance / (variance + sigmas**2)
    votes = beta[:, 1:] * np.cos(detections[None, :, 2] - state[:, 3:4])
    front = np.clip(front + votes.sum(axis=1) + 0.5 * np.tanh(state[:, 2] / 3), -10, 10)
    return shape + gain * (beta[:, 1:] @ shapes - detected * shape), variance * (1 - gain * detected), front


def lives(tracks, classes, beta, hidden, logits, kinds, dt, most_hidden, expected, most):
    """Twin of `edgeperc.tracking.lives.update_lives`: the tracks as they are then."""
    tracks = tracks.copy()
    hit = beta[:, 0] < 0.5
    best = np.argmax(beta[hit, 1:], axis=1) if hit.any() else np.zeros(0, int)
    existence = tracks["existence"] + np.log1p(-classes["detection"] * (1 - most_hidden * hidden))
    again = np.maximum(tracks["existence"][hit], -classes["sure_logit"][hit])
    existence[hit] = np.minimum(again + np.maximum(logits[best], 0) + expected, most)
    tracks["existence"] = existence
    tracks["chances"] += np.where(hit, 1, 1 - most_hidden * hidden)
    tracks["age_s"] += dt
    tracks["hits"] += hit
    tracks["misses"] = np.where(hit, 0, tracks["misses"] + 1)
    tracks["missed_s"] = np.where(hit, 0, tracks["missed_s"] + dt)
    tracks["logit_sum"][hit] += logits[best]
    weight = tracks["label_weight"][hit] + np.where(tracks["label"][hit] == kinds[best], 1, -1)
    tracks["label"][hit] = np.where(weight < 0, kinds[best], tracks["label"][hit])
    tracks["label_weight"][hit] = np.minimum(np.abs(weight), 20)
    return tracks


def newborn(first_id, kinds, classes, detections, shapes, logits, ranges, most, dtype):
    """Twin of `edgeperc.tracking.lives.fill_newborn`."""
    tracks = np.zeros(len(kinds), dtype)
    for track, kind, of, detection, shape, logit, distance in zip(
        tracks, kinds, classes, detections, shapes, logits, ranges, strict=True
    ):
        farther = 1 + distance / of["range_m"]
        turned = np.array(
            [[math.cos(detection[2]), -math.sin(detection[2])], [math.sin(detection[2]), math.cos(detection[2])]]
        )
        spread = np.zeros((5, 5))
        spread[:2, :2] = turned @ np.diag((of["sigmas"][:2] * farther) ** 2) @ turned.T
        spread[[2, 3, 4], [2, 3, 4]] = of["birth"][0] ** 2, (of["sigmas"][2] * farther) ** 2, of["birth"][1] ** 2
        track["label"], track["group"], track["label_weight"], track["front"] = kind, of["group"], 1, 1
        track["states"][:, [0, 1, 3]] = detection
        track["covariances"] = spread
        track["covariances"][2, 2, 2] = of["still_mps"] ** 2
        track["modes"] = 1 / 3
        track["state"], track["covariance"] = combination(track["states"], track["covariances"], track["modes"])
        track["shape"], track["shape_variance"] = shape, (of["shape"] * farther) ** 2
        track["logit_sum"], track["chances"], track["hits"] = logit, 1, 1
        track["existence"] = min(logit - of["sure_logit"], most)
    tracks["id"] = first_id + np.arange(len(tracks))
    return tracks


def in_view(tracks, pose, left, right):
    """Twin of `edgeperc.tracking.lives.mark_out_of_view`, of tracks that were not detected."""
    along = 0.5 * tracks["shape"][:, 1:2] * [1, -1, -1, 1]
    across = 0.5 * tracks["shape"][:, 2:3] * [1, 1, -1, -1]
    corners = (along + 1j * across) * np.exp(1j * tracks["state"][:, 3:4]) + tracks["state"][:, 0:1]
    corners = corners + 1j * tracks["state"][:, 1:2] - (pose[0, 3] + 1j * pose[1, 3])
    azimuth = np.angle(corners / (pose[0, 0] + 1j * pose[1, 0]))
    return ((azimuth <= left) & (azimuth >= right)).all(axis=1)


def rivals(state, shape, strength, told):
    """Twin of `edgeperc.tracking.lives.mark_rivals`: which are told of."""
    kept = []
    for i in sorted(np.flatnonzero(told), key=lambda i: -strength[i]):
        for j in kept:
            off = state[i, :2] - state[j, :2]
            for k in (i, j):
                ahead = np.array([math.cos(state[k, 3]), math.sin(state[k, 3])])
                aside = np.array([-ahead[1], ahead[0]])
                if abs(off @ ahead) < shape[k, 1] / 2 and abs(off @ aside) < shape[k, 2] / 2:
                    break
            else:
                continue
            break
        else:
            kept.append(i)
    return sorted(kept)


def breaks(truth, ids, ignored):
    """Twin of `edgeperc.evaluation.tracking_metrics.count_breaks`: ID switches and fragments, as KITTI counts them."""
    switches = fragments = 0
    for one in {*truth.tolist()}:
        own, hidden = ids[truth == one].tolist(), ignored[truth == one].tolist()
        if all(hidden):
            continue
        last = own[0]
        for f in range(1, len(own)):
            if hidden[f]:
                last = -1
                continue
            following = own[f + 1] if f + 1 < len(own) else own[f]
            switches += last != own[f] and -1 not in (last, own[f], own[f - 1])
            fragments += own[f - 1] != own[f] and -1 not in (last, own[f], following)
            last = own[f] if own[f] != -1 else last
    return switches, fragments


def thresholds_by_walking(scores, n_truth):
    """Twin of `tracking_metrics.recall_thresholds`: KITTI's walk down the scores, in fractions for ties."""
    found, wanted = [], Fraction(0)
    scores = sorted(scores, reverse=True)
    for k, score in enumerate(scores):
        here, following = Fraction(k + 1, n_truth), Fraction(k + 2, n_truth)
        if k < len(scores) - 1 and following - wanted < wanted - here:
            continue
        found.append((score, wanted))
        wanted += Fraction(1, 40)
        if wanted > 1:
            break
    return [score for score, _ in found[1:]], [float(recall) for _, recall in found[1:]]


# --- ground ----------------------------------------------------------------------------------------------------------


def draws(draw):
    """Twin of the draws in `edgeperc.ground.find_plane`: numbers in 0..1 without end."""
    while True:
        draw = (draw * 1103515245 + 12345) & 0x7FFFFFFF
        yield draw / 2**31


def consensus_plane(residuals, max_slope, max_shift, n_hypotheses, seed):
    """Twin of `edgeperc.ground.find_plane`."""
    tested = residuals[:: -(-len(residuals) // 1024) or 1]

    def support(plane):
        gap = tested[:, 2] - plane[0] * tested[:, 0] - plane[1] * tested[:, 1] - plane[2]
        return (abs(gap) <= 0.1).sum() - (gap < -0.1).sum()

    best = np.zeros(3)
    draw = draws(seed)
    for _ in range(n_hypotheses if len(tested) else 0):
        p, q, r = tested[[int(next(draw) * len(tested)) for _ in range(3)]]
        (x1, y1, z1), (x2, y2, z2) = q - p, r - p
        area = x1 * y2 - x2 * y1
        if abs(area) < 1.0:
            continue
        a, b = (z1 * y2 - z2 * y1) / area, (x1 * z2 - x2 * z1) / area
        plane = np.array([a, b, p[2] - a * p[0] - b * p[1]])
        if (abs(plane) <= [max_slope, max_slope, max_shift]).all() and support(plane) > support(best):
            best = plane
    return best


def refined_plane(residuals, prior, max_slope, max_shift, plane):
    """Twin of `edgeperc.ground.refine_plane`: support and plane, by two more rows that say what no slope weighs."""
    on = abs(residuals[:, 2] - residuals[:, :2] @ plane[:2] - plane[2]) <= 0.1
    if not on.any():
        return 0, plane
    middle = residuals[on].mean(axis=0)
    rows = np.r_[residuals[on] - middle, np.sqrt(prior) * np.eye(3)[:2]]
    moments = rows[:, :2].T @ rows[:, :2]
    product = moments[0, 0] * moments[1, 1]
    if product == 0 or np.linalg.det(moments) < 1e-3 * product:
        return 0, plane
    slope = np.linalg.lstsq(rows[:, :2], rows[:, 2], rcond=None)[0]
    refined = np.array([*slope, middle[2] - slope @ middle[:2]])
    return on.sum(), refined if (abs(refined) <= [max_slope, max_slope, max_shift]).all() else plane


def ground_heights(points, mount_height_m, regions=True):
    """Twin of `edgeperc.ground.find_ground`: heights (n,), and the first plane or None."""
    xyz = points[:, :3].astype(np.float64)
    finite = np.isfinite(xyz).all(axis=1)
    inside = finite & (abs(points[:, :2]) < np.float32(64.0)).all(axis=1)
    cell = np.full((len(points), 2), -1)
    cell[inside] = np.minimum(((points[inside, :2] + np.float32(64.0)) * np.float32(2.0)).astype(int), 255)
    lowest = {}
    for i in np.flatnonzero(inside):
        at = tuple(cell[i].tolist())
        if at not in lowest or points[i, 2] < points[lowest[at], 2]:
            lowest[at] = i

    def residuals(first_row, first_col, size, middle, expected, band, cone):
        area = [(r, c) for r in range(first_row, first_row + size) for c in range(first_col, first_col + size)]
        rows = xyz[[lowest[at] for at in area if at in lowest]].reshape(-1, 3)
        rows[:, :2] -= middle
        rows[:, 2] -= expected[0] * rows[:, 0] + expected[1] * rows[:, 1] + expected[2]
        return rows[abs(rows[:, 2]) <= band + cone * np.hypot(rows[:, 0], rows[:, 1])]

    first = np.array([0.0, 0.0, -mount_height_m])
    near = residuals(88, 88, 80, np.zeros(2), first, 0.5, 0.3)
    support, fitted = refined_plane(near, 0.0, 0.3, 0.5, consensus_plane(near, 0.3, 0.5, 100, 1))
    found = support >= 30
    if found:
        first = first + fitted
    if not (found and regions):
        heights = np.full(len(points), np.nan)
        heights[finite] = xyz[finite, 2] - xyz[finite, :2] @ first[:2] - first[2]
        return heights, first if found else None

    middles = (np.arange(16) + 0.5) * 8.0 - 64.0
    planes, solved = np.zeros((16, 16, 3)), np.zeros((16, 16))
    by_ring = sorted(np.ndindex(16, 16), key=lambda at: (max(abs(2 * at[0] - 15), abs(2 * at[1] - 15)), at))
    for r, q in by_ring:
        middle = middles[[r, q]]
        around = [at for at in np.ndindex(16, 16) if max(abs(at[0] - r), abs(at[1] - q)) <= 1 and solved[at]]
        expected = np.array([*first[:2], first[2] + first[:2] @ middle])
        if around:
            moved = [[*planes[at][:2], planes[at][2] + planes[at][:2] @ (middle - middles[list(at)])] for at in around]
            expected = np.average(moved, axis=0, weights=[solved[at] for at in around])
        near = residuals(16 * r, 16 * q, 16, middle, expected, 0.8, 0.0)
        planes[r, q], solved[r, q] = expected, 1.0
        if len(near) >= 6:
            fitted = consensus_plane(near, 0.12, 0.5, 24, 16 * r + q)
            support, fitted = refined_plane(near, 4 * 64.0 / 12.0, 0.12, 0.5, fitted)
            if support >= 6:
                planes[r, q] += fitted
                solved[r, q] += support

    level, step = {}, {}
    for at, i in lowest.items():
        place = (np.array(at) + 0.5) * 0.5 - 64.0
        u, v = np.clip((place + 64.0) / 8.0 - 0.5, 0.0, 15.0)
        ground, slope = 0.0, np.zeros(2)
        for r, q in itertools.product({int(u), min(int(u) + 1, 15)}, {int(v), min(int(v) + 1, 15)}):
            weight = max(1 - abs(u - r), 0) * max(1 - abs(v - q), 0)
            ground += weight * (planes[r, q, 2] + planes[r, q, :2] @ (place - middles[[r, q]]))
            slope += weight * planes[r, q, :2]
        level[at] = ground
        off = xyz[i, 2] - ground - slope @ (xyz[i, :2] - place)
        if abs(off) <= 0.3:
            step[at] = off
    heights = np.full(len(points), np.nan)
    for i in np.flatnonzero(finite):
        at = tuple(cell[i].tolist())
        if inside[i]:
            window = [(r, c) for r in range(at[0] - 2, at[0] + 3) for c in range(at[1] - 2, at[1] + 3)]
            near = [step[r, c] for r, c in window if (r, c) in step]
            region, place = (at[0] // 16, at[1] // 16), (np.array(at) + 0.5) * 0.5 - 64.0
            ground = level[at] + (sum(near) / (len(near) + 1) if len(near) >= 3 else 0.0)
        else:
            region = tuple(np.clip((xyz[i, :2] + 64.0) / 8.0, 0, 15).astype(int))
            place, ground = middles[list(region)], planes[region][2]
        heights[i] = xyz[i, 2] - ground - planes[region][:2] @ (xyz[i, :2] - place)
    return heights, first


# --- cluster ---------------------------------------------------------------------------------------------------------


def clusters(points, among, min_distance, distance_per_m, max_range, min_points):
    """Twin of `edgeperc.cluster.fill_clusters`: every pair is looked at."""
    xyz = points[:, :3].astype(np.float64)
    used = np.flatnonzero(among & np.isfinite(xyz).all(axis=1) & (abs(xyz[:, :2]) <= max_range).all(axis=1))
    x, y, z = xyz[used].T
    reach = np.maximum(min_distance, distance_per_m * np.sqrt(x * x + y * y + z * z))
    dx, dy, dz = (np.subtract.outer(v, v) for v in (x, y, z))
    linked = dx * dx + dy * dy + dz * dz <= np.minimum.outer(reach, reach) ** 2
    found, number = np.full(len(points), -1), 0
    seen = np.zeros(len(used), bool)
    for k in range(len(used)):
        if seen[k]:
            continue
        members = np.zeros(len(used), bool)
        members[k] = True
        while (more := linked[members].any(axis=0) & ~members).any():
            members |= more
        seen |= members
        if members.sum() >= min_points:
            found[used[members]] = number
            number += 1
    return found


def rectangle(members, l_shaped):
    """Twin of `edgeperc.cluster.fill_rectangle`: x, y, extent along, across, heading."""
    voting = members[:: -(-len(members) // 256)]

    def turned(points, angle):
        cos, sin = np.cos(angle), np.sin(angle)
        return np.c_[cos * points[:, 0] + sin * points[:, 1], cos * points[:, 1] - sin * points[:, 0]]

    def merit(angle):
        p = turned(voting, angle)
        low, high = p.min(axis=0), p.max(axis=0)
        if l_shaped:
            return (1 / np.maximum(np.minimum(p - low, high - p).min(axis=1), 0.05)).sum()
        return -np.prod(high - low)

    angles = np.pi / 2 * np.arange(90) / 90
    merits = np.array([merit(angle) for angle in angles])
    angle = angles[np.flatnonzero(merits >= merits.max() - 1e-9 * abs(merits.max()))[0]]
    p = turned(members, angle)
    low, high = p.min(axis=0), p.max(axis=0)
    x, y = turned((low + high)[None] / 2, -angle)[0]
    return np.array([x, y, *(high - low), angle])


# --- export.topview_database -----------------------------------------------------------------------------------------


def picture(points):
    """Twin of `edgeperc_export.database.files.picture`, point by point: round, clamp, keep the highest."""
    image, highest = np.zeros((400, 200, 3), np.uint8), {}
    for x, y, z, remission in points.astype(np.float64):
        if not (6 <= x <= 46 and -10 <= y <= 10 and -2.5 <= z <= 2.5 and np.isfinite(remission)):
            continue
        row = 399 - min(max(math.floor((x - 6) / 0.1 + 0.5), 0), 399)
        col = 199 - min(max(math.floor((y + 10) / 0.1 + 0.5), 0), 199)
        if z > highest.get((row, col), -math.inf):
            highest[row, col] = z
            shares = (math.hypot(x, y) / math.hypot(46, 10), (z + 2.5) / 5, min(max(remission, 0.0), 1.0))
            image[row, col] = [round(255 * share) for share in shares]
    return image


# --- drivable --------------------------------------------------------------------------------------------------------


def free_cells(drivable):
    """Twin of `edgeperc.drivable.fill_free`."""
    return [len(list(itertools.takewhile(bool, column[::-1]))) for column in drivable.T]


def corridor(drivable, first, last):
    """Twin of `edgeperc.drivable.fill_corridor`: runs of every row, and how much of the last one they share."""
    bounds = np.full((len(drivable), 2), -1)
    before, begun = (first, last), False
    for row in reversed(range(len(drivable))):
        edges = np.flatnonzero(np.diff(drivable[row].astype(int), prepend=0, append=0)).reshape(-1, 2).tolist()
        shared = [min(b, before[1]) - max(a, before[0]) for a, b in edges]
        if shared and max(shared) > 0:
            before, begun = edges[shared.index(max(shared))], True
            bounds[row] = before
        elif begun:
            break
    return bounds


def connected(cells, row, col):
    """Twin of `edgeperc.drivable.mark_connected`: the part grows until it no longer does."""
    part = np.zeros_like(cells)
    part[row, col] = True
    while True:
        padded = np.pad(part, 1)
        grown = part | padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
        grown &= cells
        if (grown == part).all():
            return part
        part = grown


def sides(cells):
    """What the rings of `edgeperc.drivable.fill_rings` consist of: sides from corner to corner, cells to the left."""
    found = set()
    for row, col in np.argwhere(cells).tolist():
        square = [(row + 1, col), (row + 1, col + 1), (row, col + 1), (row, col)]
        for k, (dr, dc) in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)]):
            if not cells[row + dr, col + dc]:
                found.add((square[k], square[(k + 1) % 4]))
    return found


def simplified(line, tolerance):
    """Douglas and Peucker's corners of an open line, as indices: twin of half of `edgeperc.drivable.mark_kept`."""
    (x, y), (ex, ey) = line[0], line[-1]
    dx, dy = ex - x, ey - y
    length2 = dx * dx + dy * dy
    offs = []
    for px, py in line[1:-1]:
        along = min(max(((px - x) * dx + (py - y) * dy) / length2, 0.0), 1.0) if length2 > 0 else 0.0
        offs.append(math.hypot(px - x - along * dx, py - y - along * dy))
    if not offs or max(offs) <= tolerance:
        return [0, len(line) - 1]
    worst = offs.index(max(offs)) + 1
    return simplified(line[: worst + 1], tolerance) + [worst + k for k in simplified(line[worst:], tolerance)[1:]]
