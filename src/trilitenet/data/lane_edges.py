"""BDD100K draws most lane markings as two lines, their edges; this finds the pairs and the centre line of each."""

from __future__ import annotations

import dataclasses
import heapq
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["Pairing", "centre_line", "edge_gap", "pair_edges", "resample"]

_SPACING = 2.0
"""Pixels between the points of a centre line."""

_GAP_POINTS = 24
"""Points a line that gaps are measured at."""

_MIN_OVERLAP = 0.5
"""Two edges of one marking run beside each other over at least this part of the shorter one."""

_MOST_CHOICES = 1000
"""So many ways to pair are followed at once; twelve edges have fewer, and so have more that do not lie in a heap."""


@dataclasses.dataclass(frozen=True)
class Pairing:
    """Which of some edges belong together.

    Attributes:
        pairs: Indices of two edges of one marking.
        single: Indices of edges without a partner.
    """

    pairs: tuple[tuple[int, int], ...]
    single: tuple[int, ...]


def resample(line: NDArray[np.float64], spacing: float = _SPACING) -> NDArray[np.float64]:
    """Return (M, 2) points at equal distances along a polyline, its ends included; M is at least 2."""
    steps = np.sqrt((np.diff(line, axis=0) ** 2).sum(axis=1))
    along = np.concatenate([[0.0], np.cumsum(steps)])
    count = max(int(np.ceil(along[-1] / spacing - 1e-6)), 1) if spacing else 1
    stops = np.linspace(0, along[-1], count + 1)
    return np.stack([np.interp(stops, along, line[:, axis]) for axis in (0, 1)], axis=1)


def edge_gap(one: NDArray[np.float64], two: NDArray[np.float64]) -> float:
    """Return the mean distance in pixels between two lines where they run beside each other.

    Infinite where they hardly do: less than half of the shorter line, or nearer to a crossing than to parallel (the
    gap is not small against the length they share).
    """
    lengths = _length(one), _length(two)
    one, two = resample(one, lengths[0] / _GAP_POINTS), resample(two, lengths[1] / _GAP_POINTS)
    feet_one, inside_one = _feet(one, two)
    feet_two, inside_two = _feet(two, one)
    shared = min(float(inside_one.mean()) * lengths[0], float(inside_two.mean()) * lengths[1])
    if shared < _MIN_OVERLAP * min(lengths):
        return float("inf")
    gaps = np.concatenate(
        [
            np.hypot(*(one - feet_one)[inside_one].T),
            np.hypot(*(two - feet_two)[inside_two].T),
        ]
    )
    gap = float(gaps.mean())
    return gap if gap <= 0.5 * shared else float("inf")


def pair_edges(lines: Sequence[NDArray[np.float64]], max_gap: float = 40.0) -> Pairing:
    """Pair the edges of lane markings of one kind so that the sum of their gaps is least.

    Leaving two edges alone costs ``max_gap``, so that no pair has a wider one; a chain of lines at equal distances is
    paired so that as few as possible stay alone. The sum may be a little above the least where well over a dozen edges
    are all within ``max_gap`` of each other.

    Args:
        lines: (N, 2) x, y each, in pixels: edges of the same type, style and direction.
        max_gap: Mean distance in pixels above which two edges are two markings.
    """
    gaps: dict[tuple[int, int], float] = {}
    for first in range(len(lines)):
        for second in range(first + 1, len(lines)):
            if _boxes_apart(lines[first], lines[second], max_gap):
                continue
            gap = edge_gap(lines[first], lines[second])
            if gap < max_gap:
                gaps[first, second] = gap
    pairs: list[tuple[int, int]] = []
    for group in _groups(len(lines), gaps):
        # From one side to the other, so that partners follow each other closely.
        middles = np.array([lines[index].mean(axis=0) for index in group])
        across = middles[:, np.ptp(middles, axis=0).argmax()]
        pairs += _match([group[place] for place in across.argsort(kind="stable")], gaps, max_gap)
    used = {index for pair in pairs for index in pair}
    return Pairing(tuple(sorted(pairs)), tuple(index for index in range(len(lines)) if index not in used))


def centre_line(one: NDArray[np.float64], two: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the line midway between two edges of a marking.

    Where the edges run beside each other it is midway between each point of the first and the nearest of the second;
    where one is longer, that one goes on, moved sideways by the offset at the last shared point.

    Args:
        one: (N, 2) x, y in pixels.
        two: (M, 2) x, y in pixels, in either direction.

    Returns:
        (K, 2) float64.
    """
    one, two = resample(one), resample(two)
    if _against(one, two):
        two = two[::-1]
    feet, inside = _feet(one, two)
    _, beside = _feet(two, one)
    if not inside.any() or not beside.any():
        count = max(len(one), len(two))
        stops = np.linspace(0, 1, count)
        return (_at(one, stops) + _at(two, stops)) / 2
    middle = (one[inside] + feet[inside]) / 2
    head = _end(one[::-1], inside[::-1], two[::-1], beside[::-1], middle[0])[::-1]
    return np.concatenate([head, middle, _end(one, inside, two, beside, middle[-1])])


def _end(
    one: NDArray[np.float64],
    inside: NDArray[np.bool_],
    two: NDArray[np.float64],
    beside: NDArray[np.bool_],
    middle: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return how the centre line goes on after its last point midway between the edges, ``middle``."""
    rests = []
    for line, shared in ((one, inside), (two, beside)):
        last = int(np.flatnonzero(shared)[-1])
        rests.append((line[last + 1 :], middle - line[last]))
    rest, offset = max(rests, key=lambda item: len(item[0]))
    # Where both edges end together, slanting ends leave a little of one of them over.
    if len(rest) * _SPACING <= max(2 * float(np.hypot(*offset)), _SPACING):
        return (one[-1:] + two[-1:]) / 2
    moved: NDArray[np.float64] = rest + offset
    return moved


def _length(line: NDArray[np.float64]) -> float:
    return float(np.sqrt((np.diff(line, axis=0) ** 2).sum(axis=1)).sum())


def _at(line: NDArray[np.float64], stops: NDArray[np.float64]) -> NDArray[np.float64]:
    own = np.linspace(0, 1, len(line))
    return np.stack([np.interp(stops, own, line[:, axis]) for axis in (0, 1)], axis=1)


def _against(one: NDArray[np.float64], two: NDArray[np.float64]) -> bool:
    """Whether two lines beside each other run in opposite directions."""
    same = np.hypot(*(one[0] - two[0])) + np.hypot(*(one[-1] - two[-1]))
    other = np.hypot(*(one[0] - two[-1])) + np.hypot(*(one[-1] - two[0]))
    return bool(other < same)


def _feet(points: NDArray[np.float64], line: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the nearest point on ``line`` to each point, and whether it is not just an end that the point is past."""
    start, along = line[:-1], np.diff(line, axis=0)
    length = np.maximum((along**2).sum(axis=1), 1e-12)
    # Axis by axis: sums over two numbers would take most of the time.
    x, y = points[:, None, 0] - start[:, 0], points[:, None, 1] - start[:, 1]
    run = (x * along[:, 0] + y * along[:, 1]) / length
    clipped = np.clip(run, 0, 1)
    nearest = ((x - clipped * along[:, 0]) ** 2 + (y - clipped * along[:, 1]) ** 2).argmin(axis=1)
    rows = np.arange(len(points))
    chosen = run[rows, nearest]
    slack = 1e-6
    past = ((nearest == 0) & (chosen < -slack)) | ((nearest == len(start) - 1) & (chosen > 1 + slack))
    return start[nearest] + clipped[rows, nearest, None] * along[nearest], ~past


def _boxes_apart(one: NDArray[np.float64], two: NDArray[np.float64], gap: float) -> bool:
    """Whether the boxes around two lines are further apart than ``gap``."""
    distance = np.maximum(one.min(axis=0) - two.max(axis=0), two.min(axis=0) - one.max(axis=0))
    return bool((distance > gap).any())


def _groups(count: int, gaps: dict[tuple[int, int], float]) -> list[list[int]]:
    """Return the sets of edges that possible pairs join."""
    group = list(range(count))
    for first, second in gaps:
        if group[first] != group[second]:
            old, new = group[second], group[first]
            group = [new if item == old else item for item in group]
    members: dict[int, list[int]] = {}
    for index, item in enumerate(group):
        members.setdefault(item, []).append(index)
    return [items for items in members.values() if len(items) > 1]


def _match(group: list[int], gaps: dict[tuple[int, int], float], max_gap: float) -> list[tuple[int, int]]:
    """Return the pairs of least total gap.

    Each edge in turn stays alone or takes a later one. Of the ways that have taken the same later edges the best goes
    on: the one whose gaps are the most below ``max_gap``, in sum. Of too many ways those go on that could gain most,
    were every edge that is left to find a partner without a gap.
    """
    ways: dict[frozenset[int], tuple[float, tuple[tuple[int, int], ...]]] = {frozenset(): (0.0, ())}
    for place, edge in enumerate(group):
        pairs = [(min(edge, other), max(edge, other)) for other in group[place + 1 :]]
        found: dict[frozenset[int], tuple[float, tuple[tuple[int, int], ...]]] = {}
        for taken, (gain, chosen) in ways.items():
            after = [(taken - {edge}, gain, chosen)]
            if edge not in taken:
                after += [
                    (taken.union(pair) - {edge}, gain + max_gap - gaps[pair], (*chosen, pair))
                    for pair in pairs
                    if pair in gaps and taken.isdisjoint(pair)
                ]
            for key, total, these in after:
                if key not in found or total > found[key][0]:
                    found[key] = total, these
        ways = dict(heapq.nlargest(_MOST_CHOICES, found.items(), key=lambda way: way[1][0] - len(way[0]) * max_gap / 2))
    return list(ways[frozenset()][1])
