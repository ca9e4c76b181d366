"""Shapes to masks, exactly: a pixel belongs to a shape when its centre does.

Coordinates are pixels from the image's corner, so that the pixel in row r and column c covers [c, c+1) x [r, r+1) and
has its centre at (c + 0.5, r + 0.5), as BDD100K's own tools have it. OpenCV's fill and line functions also colour
pixels that a shape's edge merely touches, which makes areas a pixel larger and lines one thicker.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import DataError

__all__ = ["check_finite", "draw_line", "fill_polygon", "flatten"]

_STEP = 2.0
"""A curve is sampled about every so many pixels."""

_PIECE = 16.0
"""A line is drawn in pieces of at most so many pixels."""

_TOGETHER = 1 << 17
"""Pixels that are looked at at once."""

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
    # Long segments go in pieces, so that the boxes looked at stay small.
    steps = np.diff(points, axis=0)
    counts = np.maximum(np.ceil(np.abs(steps).max(axis=1) / _PIECE), 1).astype(np.int64)
    along = np.repeat(steps / counts[:, None], counts, axis=0)
    number = np.arange(len(along)) - np.repeat(np.cumsum(counts) - counts, counts)
    start = np.repeat(points[:-1], counts, axis=0) + number[:, None] * along
    corner = np.floor(np.minimum(start, start + along) - radius - 0.5)
    side = int(np.ceil(np.abs(along).max(initial=0) + width)) + 3
    seen = ((corner < mask.shape[::-1]) & (corner > -side)).all(axis=1)
    start, along, corner = start[seen], along[seen], corner[seen]
    together = max(1, _TOGETHER // side**2)
    for first in range(0, len(start), together):
        part = slice(first, first + together)
        _draw_pieces(mask, start[part], along[part], corner[part], side, radius, value)


def _draw_pieces(
    mask: NDArray[np.uint8],
    start: NDArray[np.float64],
    along: NDArray[np.float64],
    corner: NDArray[np.float64],
    side: int,
    radius: float,
    value: int,
) -> None:
    """Draw pieces of a line, each within a square of ``side`` pixels from its ``corner`` on; all arrays are (N, 2)."""
    columns, rows = (corner[:, axis, None].astype(np.int64) + np.arange(side) for axis in (0, 1))
    x, y = (columns + 0.5 - start[:, :1])[:, None, :], (rows + 0.5 - start[:, 1:])[:, :, None]
    along_x, along_y = along[:, 0, None, None], along[:, 1, None, None]
    length = along_x**2 + along_y**2
    run = np.clip((x * along_x + y * along_y) / np.where(length > 0, length, 1), 0, 1)
    near = (x - run * along_x) ** 2 + (y - run * along_y) ** 2 <= radius * radius + 1e-9
    near &= ((rows >= 0) & (rows < mask.shape[0]))[:, :, None] & ((columns >= 0) & (columns < mask.shape[1]))[:, None]
    piece, row, column = np.nonzero(near)
    mask[rows[piece, row], columns[piece, column]] = value


def _bezier(control: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sample a cubic Bezier curve of (4, 2) points, without its start."""
    length = np.sqrt((np.diff(control, axis=0) ** 2).sum(axis=1)).sum()
    count = int(np.clip(np.ceil(length / _STEP), 4, 400))
    t = np.linspace(0, 1, count + 1)[1:, None]
    weights = np.concatenate([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3], axis=1)
    curve: NDArray[np.float64] = weights @ control
    return curve
