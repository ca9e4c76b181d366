"""Shapes to masks, exactly: a pixel belongs to a shape when its centre does.

Coordinates are pixels from the image's corner, so that the pixel in row r and column c covers [c, c+1) x [r, r+1) and
has its centre at (c + 0.5, r + 0.5), as BDD100K's own tools have it. OpenCV's fill and line functions also colour
pixels that a shape's edge merely touches, which makes areas a pixel larger and lines one thicker.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import DataError

__all__ = ["check_finite", "draw_line", "fill_polygon", "flatten"]

_STEP = 2.0
"""A curve is sampled about every so many pixels."""

_FARTHEST = 30_000.0
"""No image is so many pixels wide or high; a line that long would take hours, or all memory."""


def check_finite(points: NDArray[np.float64]) -> None:
    """Refuse coordinates that no pixel has.

    Raises:
        DataError: If one is infinite, not a number, or far out of any image.
    """
    if not (np.abs(points) <= _FARTHEST).all():
        raise DataError(f"a polygon or line with a coordinate that is not a number, or beyond {_FARTHEST:.0f} pixels")


def flatten(vertices: Sequence[Sequence[float]], types: str, *, closed: bool) -> NDArray[np.float64]:
    """Turn BDD100K's ``poly2d`` into a polyline.

    A vertex of type L ends a straight line; three vertices from one of type C on are the two control points and the end
    of a cubic Bezier curve (whatever the type of the third). The first vertex is the start, of either type. A closed
    shape whose last curve lacks its end ends at the start.

    Args:
        vertices: (N, 2) x, y.
        types: N letters, ``L`` or ``C``; empty = all ``L``.
        closed: Whether the shape is closed.

    Returns:
        (M, 2) float64 points; a closed shape's first point is not repeated.

    Raises:
        DataError: If vertices and types do not fit each other, or a coordinate is not finite or far out.
    """
    points = np.asarray(vertices, np.float64)
    types = types or "L" * len(points)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) != len(types) or set(types) - {"L", "C"}:
        raise DataError(f"poly2d needs one letter L or C a vertex, got {len(points)} vertices and {types!r}")
    check_finite(points)
    if closed:
        points = np.concatenate([points, points[:1]])
    parts = [points[:1]]
    index = 1
    while index < len(points):
        letter = types[index] if index < len(types) else "L"
        if letter == "C" and index + 2 < len(points):
            parts.append(_bezier(points[index - 1 : index + 3]))
            index += 3
        else:
            parts.append(points[index : index + 1])
            index += 1
    line = np.concatenate(parts)
    if closed and len(line) > 1 and (line[0] == line[-1]).all():
        line = line[:-1]
    return line


def fill_polygon(mask: NDArray[np.uint8], points: NDArray[np.float64], value: int = 1) -> None:
    """Set the pixels whose centre is inside a polygon (even-odd rule; left and top edges belong to it).

    Args:
        mask: (H, W) uint8, changed in place.
        points: (N, 2) x, y; the last is joined to the first.
        value: What to set.

    Raises:
        DataError: If a coordinate is not finite or far out.
    """
    check_finite(points)
    if len(points) < 3:
        return
    height, width = mask.shape
    first = max(int(np.ceil(points[:, 1].min() - 0.5)), 0)
    last = min(int(np.ceil(points[:, 1].max() - 0.5)), height)
    left = int(np.clip(np.floor(points[:, 0].min()), 0, width))
    right = int(np.clip(np.ceil(points[:, 0].max()) + 1, 0, width))
    if first >= last or left >= right:
        return
    # Each crossing of a row's centre line with an edge toggles all pixels to its right.
    toggle = np.zeros((last - first, right - left + 1), np.uint8)
    start, end = points, np.roll(points, -1, axis=0)
    upper, lower = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    row_from = np.clip(np.ceil(upper - 0.5), first, last).astype(np.int64)
    row_to = np.clip(np.ceil(lower - 0.5), first, last).astype(np.int64)
    counts = np.maximum(row_to - row_from, 0)
    edge = np.repeat(np.arange(len(points)), counts)
    rows = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(row_from, counts)
    run = (rows + 0.5 - start[edge, 1]) / (end[edge, 1] - start[edge, 1])
    crossing = start[edge, 0] + run * (end[edge, 0] - start[edge, 0])
    columns = np.clip(np.ceil(crossing - 0.5), left, right).astype(np.int64) - left
    np.add.at(toggle, (rows - first, columns), 1)
    inside = np.cumsum(toggle[:, :-1], axis=1, dtype=np.uint8) & 1
    mask[first:last, left:right][inside.view(np.bool_)] = value


def draw_line(mask: NDArray[np.uint8], points: NDArray[np.float64], width: float, value: int = 1) -> None:
    """Set the pixels whose centre is at most half a width from a polyline (so joints and ends are round).

    Args:
        mask: (H, W) uint8, changed in place.
        points: (N, 2) x, y; one point is a disc.
        width: Pixels.
        value: What to set.

    Raises:
        DataError: If a coordinate is not finite or far out.
    """
    check_finite(points)
    radius = width / 2
    if len(points) == 1:
        points = np.repeat(points, 2, axis=0)
    for start, end in itertools.pairwise(points):
        # Long segments go in pieces, so that the boxes looked at stay small.
        pieces = max(1, int(np.ceil(np.abs(end - start).max() / 48)))
        stops = start + (end - start) * np.linspace(0, 1, pieces + 1)[:, None]
        for one, two in itertools.pairwise(stops):
            _draw_segment(mask, one, two, radius, value)


def _draw_segment(
    mask: NDArray[np.uint8], start: NDArray[np.float64], end: NDArray[np.float64], radius: float, value: int
) -> None:
    height, width = mask.shape
    low = np.floor(np.minimum(start, end) - radius - 0.5).astype(np.int64)
    high = np.ceil(np.maximum(start, end) + radius + 0.5).astype(np.int64)
    left, top = np.clip(low, 0, (width, height))
    right, bottom = np.clip(high, 0, (width, height))
    if left >= right or top >= bottom:
        return
    x = np.arange(left, right) + 0.5 - start[0]
    y = (np.arange(top, bottom) + 0.5 - start[1])[:, None]
    along = end - start
    length = float(along @ along)
    run = np.clip((x * along[0] + y * along[1]) / length, 0, 1) if length else np.zeros((1, 1))
    near = (x - run * along[0]) ** 2 + (y - run * along[1]) ** 2 <= radius * radius + 1e-9
    mask[top:bottom, left:right][near] = value


def _bezier(control: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sample a cubic Bezier curve of (4, 2) points, without its start."""
    length = np.sqrt((np.diff(control, axis=0) ** 2).sum(axis=1)).sum()
    count = int(np.clip(np.ceil(length / _STEP), 4, 400))
    t = np.linspace(0, 1, count + 1)[1:, None]
    weights = np.concatenate([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3], axis=1)
    curve: NDArray[np.float64] = weights @ control
    return curve
