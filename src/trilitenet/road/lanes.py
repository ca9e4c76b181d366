"""Lane mask -> lines: runs of a few rows are linked into pieces, pieces are joined over gaps, and each becomes a curve.

Everything happens in image space, so that it needs no camera. A line is cut where it merges with another (far away, two
lines are one blob), and a double line counts as one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.processing.geometry import Camera
from trilitenet.road.structures import LaneLine

__all__ = ["VanishingPoint", "assign_positions", "find_lines", "vanishing_point"]

WORK_WIDTH: Final = 640
"""Masks are searched at this width in pixels; all distances below are at this width."""
ROW_STEPS: Final = (2, 4)
"""Every so many rows are looked at, in the upper and in the lower half of the picture, where lines are long."""
DEGREE: Final = 5
"""Of a long line's curve: what bends evenly on the road bends ever more towards the horizon."""
MIN_ROWS: Final = 7
"""A line has at least so many of those rows."""
MIN_SPAN: Final = 16.0
"""A line reaches over at least so many pixels."""
MAX_RESIDUAL: Final = 3.5
"""A curve fits to within so many pixels, or it is no line."""
STIFFNESS: Final = np.array([1e-9, 1e-9, 1e-6, 1e-5, 1e-4, 1e-4])
"""Ridge on the curve's coefficients: it calms the high ones where gaps leave them free."""
MAX_LINES: Final = 16
"""At most so many lines, the surest ones."""


class VanishingPoint(NamedTuple):
    """Where lines meet.

    Attributes:
        u: Column in pixels.
        v: Row in pixels.
        error: One standard deviation of the row in pixels.
        lines: How many lines tell it.
    """

    u: float
    v: float
    error: float
    lines: int


@dataclasses.dataclass
class _Piece:
    """Runs linked from the bottom upwards.

    Attributes:
        rows: Pixels, falling.
        centres: Middles of the runs in pixels.
        widths: Of the runs in pixels.
        seen: Index of the last row among those looked at.
        slope: Columns a row downwards at the upper end; None before the second run.
    """

    rows: list[int]
    centres: list[float]
    widths: list[float]
    seen: int
    slope: float | None = None

    @property
    def middle_width(self) -> float:
        last = sorted(self.widths[-7:])
        return last[len(last) // 2]


def find_lines(mask: NDArray[np.bool_] | NDArray[np.uint8]) -> list[LaneLine]:
    """Return the lines in a lane mask.

    Args:
        mask: (H, W) bool or {0, 1}: lane marking.

    Returns:
        Lines in pixels of the mask, the surest first; their identity is their index and their position is 0.
    """
    height, width = mask.shape
    scale = max(1.0, width / WORK_WIDTH)
    small = mask.astype(np.uint8)
    if scale > 1.0:
        size = (WORK_WIDTH, max(1, round(height / scale)))
        small = (np.asarray(cv2.resize(small * 255, size, interpolation=cv2.INTER_AREA)) > 127).astype(np.uint8)
    scales = (scale, height / small.shape[0])  # which differ where the height is no multiple
    lines = [line for chain in _join(_link(small)) if (line := _fit(chain, scales, small.shape[0])) is not None]
    lines.sort(key=lambda line: -line.confidence)
    kept: list[LaneLine] = []
    for line in lines:
        if len(kept) < MAX_LINES and not any(_same(line, other, scale) for other in kept):
            kept.append(line)
    return [dataclasses.replace(line, id=number) for number, line in enumerate(kept)]


def _link(mask: NDArray[np.uint8]) -> list[_Piece]:
    """Link the runs of neighbouring rows into pieces that neither branch nor merge."""
    height, width = mask.shape
    fine, coarse = ROW_STEPS
    half = height // 2
    rows = np.concatenate([np.arange(height - 1, half, -coarse), np.arange(half, -1, -fine)])
    padded = np.zeros((len(rows), width + 2), np.int8)
    padded[:, 1:-1] = mask[rows]
    steps = np.diff(padded, axis=1)
    at, first = np.nonzero(steps == 1)
    _, last = np.nonzero(steps == -1)
    runs: list[list[tuple[float, float, float]]] = [[] for _ in rows]
    for index, start, end in zip(at.tolist(), first.tolist(), last.tolist(), strict=True):
        if start > 0 and end < width:  # a run that the image's edge cuts has no middle
            runs[index].append(((start + end - 1) / 2, start, end))
    done: list[_Piece] = []
    active: list[_Piece] = []
    for index, (row, found) in enumerate(zip(rows.tolist(), runs, strict=True)):
        if found or active:
            active = _extend(active, found, index, row, done)
    done.extend(active)
    return [piece for piece in done if len(piece.rows) >= 2]


def _extend(
    active: list[_Piece], found: list[tuple[float, float, float]], index: int, row: int, done: list[_Piece]
) -> list[_Piece]:
    """Add the runs of one row to the pieces that they continue; start pieces with the others."""
    pairs: list[tuple[float, int, int]] = []
    claims: dict[int, int] = {}
    for p, piece in enumerate(active):
        up = row - piece.rows[-1]
        half = piece.widths[-1] / 2
        slope = piece.slope
        if slope is None:
            expected, reach = piece.centres[-1], 3.0 + 2 * half
        else:
            expected, reach = piece.centres[-1] + slope * up, 2.5 + 0.35 * half - 0.2 * abs(slope) * up
        near = index - piece.seen == 1
        for r, (centre, start, end) in enumerate(found):
            overlap = start - 2 <= expected <= end + 1
            distance = abs(centre - expected)
            if distance <= (reach if slope is not None else reach + (end - start) / 2) or (overlap and near):
                pairs.append((distance, p, r))
                if overlap:
                    claims[r] = claims.get(r, 0) + 1
    pairs.sort()
    used_pieces: set[int] = set()
    used_runs: set[int] = set()
    for _, p, r in pairs:
        if p in used_pieces or r in used_runs:
            continue
        piece = active[p]
        centre, start, end = found[r]
        used_pieces.add(p)
        used_runs.add(r)
        count = len(piece.rows)
        if claims.get(r, 0) > 1 or (count > 4 and end - start > 2.2 * piece.middle_width + 3):
            # Two lines have become one blob: neither goes on into it.
            used_pieces.update(q for q, other in enumerate(active) if start - 3 <= other.centres[-1] <= end + 2)
            continue
        # Over a longer base the slope is not shaken by whole pixels.
        base = max(0, count - 8)
        piece.slope = (centre - piece.centres[base]) / (row - piece.rows[base])
        piece.rows.append(row)
        piece.centres.append(centre)
        piece.widths.append(end - start)
        piece.seen = index
    alive = []
    for p, piece in enumerate(active):
        if piece.seen == index or (p not in used_pieces and index - piece.seen <= 2):
            alive.append(piece)
        else:
            done.append(piece)
    for r, (centre, start, end) in enumerate(found):
        if r not in used_runs:
            alive.append(_Piece([row], [centre], [end - start], index))
    return alive


class _End(NamedTuple):
    row: float
    column: float
    slope: float


def _ends(piece: _Piece) -> tuple[_End, _End]:
    """Return the lower and the upper end of a piece with its slope there (columns a pixel downwards)."""
    rows, centres = piece.rows, piece.centres
    span = min(12, len(rows) - 1)
    low = (centres[span] - centres[0]) / (rows[span] - rows[0])
    high = (centres[-1] - centres[-1 - span]) / (rows[-1] - rows[-1 - span])
    return _End(rows[0], centres[0], low), _End(rows[-1], centres[-1], high)


def _join(pieces: list[_Piece]) -> list[list[_Piece]]:
    """Join pieces that are one line with gaps: each is followed by at most one that lies farther up."""
    ends = [_ends(piece) for piece in pieces]
    pairs: list[tuple[float, int, int]] = []
    for a, (_, top) in enumerate(ends):
        for b, (bottom, _) in enumerate(ends):
            gap = top.row - bottom.row
            if a == b or gap <= 0 or gap > 130:
                continue
            if len(pieces[a].rows) < 4 and len(pieces[b].rows) < 4:
                continue
            # A parabola's mean slope is the mean of the slopes at its ends; a short piece's slope counts less.
            wa, wb = min(12, len(pieces[a].rows)), min(12, len(pieces[b].rows))
            slope = (wa * top.slope + wb * bottom.slope) / (wa + wb)
            missed = abs(top.column - slope * gap - bottom.column)
            bend = abs(top.slope - bottom.slope) * gap
            allowed = 2.5 + 0.10 * gap * math.sqrt(1 + slope * slope)
            if missed < allowed and bend < 4.0 + 0.5 * gap * math.sqrt(1 + slope * slope):
                pairs.append((missed / allowed + gap / 100, a, b))
    pairs.sort()
    after: dict[int, int] = {}
    before: dict[int, int] = {}
    for _, a, b in pairs:
        if a not in after and b not in before:
            after[a], before[b] = b, a
    chains = []
    for index in range(len(pieces)):
        if index in before:
            continue
        chain, at = [pieces[index]], index
        while at in after:
            at = after[at]
            chain.append(pieces[at])
        chains.append(chain)
    return chains


def _fit(chain: list[_Piece], scales: tuple[float, float], height: int) -> LaneLine | None:
    """Return the curve through a chain of pieces; None if it is too short or fits badly.

    Args:
        chain: Pieces of a mask as it was searched.
        scales: Columns and rows of the picture to one of that mask.
        height: Rows of that mask.
    """
    rows = np.concatenate([piece.rows for piece in chain]).astype(np.float64)
    columns = np.concatenate([piece.centres for piece in chain])
    widths = np.concatenate([piece.widths for piece in chain])
    count = len(rows)
    if count < MIN_ROWS:
        return None
    tall = float(rows[0] - rows[-1])
    span = math.hypot(tall, float(columns[0] - columns[-1]))
    if span < MIN_SPAN:
        return None
    degree = 1 if count < 12 else 2 if tall < 40 else 3 if tall < 80 else DEGREE
    t = (rows - rows[0]) / (rows[-1] - rows[0])
    basis = np.vander(t, degree + 1, increasing=True)
    # A wide run tells its middle less surely, and one off the curve may be something else.
    weight = 1 / (1 + widths / 8)
    base = weight.copy()
    solution = np.zeros(degree + 1)
    for _ in range(3):
        moments = basis.T * weight
        solution = np.linalg.solve(moments @ basis + np.diag(STIFFNESS[: degree + 1]), moments @ columns)
        missed = columns - basis @ solution
        weight = base / np.maximum(1.0, np.abs(missed) / 1.5)
    # Across the line, not along the row: a flat line's error in u is larger than its distance.
    slope = (columns[-1] - columns[0]) / tall
    residual = float(np.sqrt(np.average(missed**2, weights=base)) / math.sqrt(1 + slope * slope))
    if residual > MAX_RESIDUAL:
        return None
    half = height // 2
    low_rows, high_rows = max(0.0, rows[0] - max(half, rows[-1])), max(0.0, min(half, rows[0]) - rows[-1])
    covered = min(1.0, count / (1 + high_rows / ROW_STEPS[0] + low_rows / ROW_STEPS[1]))
    confidence = min(1.0, span / (0.22 * height)) ** 0.5 * (0.4 + 0.6 * covered) * math.exp(-residual / 3.0)
    across, down = scales
    polynomial = np.zeros(DEGREE + 1)
    polynomial[: degree + 1] = solution * across
    polynomial[0] += (across - 1) / 2
    low, high = (row * down + (down - 1) / 2 for row in (rows[0], rows[-1]))
    origin = (low, high - low)
    sampled = np.linspace(0.0, 1.0, int(np.clip(tall // 6, 4, 24)))
    points = np.stack(
        [np.vander(sampled, DEGREE + 1, increasing=True) @ polynomial, low + sampled * (high - low)], axis=1
    )
    return LaneLine(0, 0, points.astype(np.float32), polynomial, origin, residual * across, confidence)


def _same(line: LaneLine, other: LaneLine, scale: float) -> bool:
    """Tell whether two curves run side by side closer than two lines of a lane ever do: a double line, or a branch."""
    low = min(line.origin[0], other.origin[0])
    high = max(line.origin[0] + line.origin[1], other.origin[0] + other.origin[1])
    if low - high < 4 * scale:
        return False
    rows = np.linspace(low, high, 5)
    slope = abs(float(line.column(high) - line.column(low))) / (low - high)
    apart = np.abs(line.column(rows) - other.column(rows)) / math.sqrt(1 + slope * slope)
    share = (low - high) / max(1.0, min(-line.origin[1], -other.origin[1]))
    near = 6.0 * scale + 0.035 * np.maximum(0.0, rows - high)
    return bool(share > 0.3 and (apart < near).all())


def vanishing_point(
    lines: Sequence[LaneLine], size: tuple[int, int], camera: Camera | None = None
) -> VanishingPoint | None:
    """Return where the near parts of the lines meet.

    Args:
        lines: Lines of one picture.
        size: (height, width) of the picture in pixels.
        camera: The camera, if its lens is known: lines that it bends are straightened, and the point is an ideal
            lens's.

    Returns:
        None with fewer than two good lines, or when they are too parallel in the picture to tell.
    """
    height, width = size
    slopes: list[float] = []
    bases: list[float] = []
    weights: list[float] = []
    for line in lines:
        v0, span = line.origin
        if line.confidence < 0.35 or v0 < 0.6 * height or -span < 0.12 * height:
            continue
        rows = v0 + span * np.array([0.0, 0.3, 0.6])
        near = np.stack([line.column(rows), rows], axis=1)
        (u, v), (u_middle, v_middle), (u_far, v_far) = near if camera is None else camera.undistorted(near)
        slope = float((u_far - u) / (v_far - v))
        if not abs(u_middle - u - slope * (v_middle - v)) <= 0.012 * width * math.sqrt(1 + slope * slope):
            continue  # the near part is bent, or not of the lens
        slopes.append(slope)
        bases.append(float(u - slope * v))
        weights.append(line.confidence / (1 + slope * slope))
    if len(slopes) < 2:
        return None
    b, a, w = np.array(slopes), np.array(bases), np.array(weights)
    if b.max() - b.min() < 0.5:
        return None
    # Each line: u0 - b v0 = a.
    basis = np.stack([np.ones_like(b), -b], axis=1)
    moments = basis.T * w
    normal = moments @ basis
    u, v = np.linalg.solve(normal, moments @ a)
    missed = basis @ (u, v) - a
    noise = max(1.0, float(np.sum(w * missed**2)) / max(len(b) - 2, 1))
    error = math.sqrt(noise * float(np.linalg.inv(normal)[1, 1]))
    return VanishingPoint(float(u), float(v), error, len(b))


def assign_positions(lines: Sequence[LaneLine], where: Sequence[float | None]) -> list[LaneLine]:
    """Number the lines from the vehicle outwards and sort them left to right.

    Args:
        lines: The lines.
        where: How far right of the vehicle's axis each one passes the vehicle, in any unit; None = not known.
    """
    known = sorted(((x, line) for x, line in zip(where, lines, strict=True) if x is not None), key=lambda pair: pair[0])
    left = [line for x, line in known if x < 0]
    right = [line for x, line in known if x >= 0]
    numbered: list[LaneLine] = []
    numbered += [dataclasses.replace(line, position=i - len(left)) for i, line in enumerate(left)]
    numbered += [dataclasses.replace(line, position=i + 1) for i, line in enumerate(right)]
    unknown: list[Any] = [
        dataclasses.replace(line, position=0) for x, line in zip(where, lines, strict=True) if x is None
    ]
    return numbered + unknown
