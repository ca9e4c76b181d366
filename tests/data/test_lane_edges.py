from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from trilitenet.data.lane_edges import centre_line, edge_gap, pair_edges, resample


def marking(
    x: float, *, bend: float = 0.0, near: float = 20.0, far: float = 2.0
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """A marking that narrows towards the horizon, as seen from a car: its centre and both edges, finely sampled."""
    t = np.linspace(0, 1, 2000)
    centre = np.stack([x + (640 - x) * t + bend * t**2, 700 - 340 * t], axis=1)
    along = np.gradient(centre, axis=0)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
    half = (near + (far - near) * t)[:, None] / 2
    return centre, centre + normal * half, centre - normal * half


def distance(line: NDArray[np.float64], curve: NDArray[np.float64]) -> float:
    return float(np.sqrt(((line[:, None] - curve) ** 2).sum(axis=2)).min(axis=1).max())


@pytest.mark.parametrize("x", [100.0, 400.0, 640.0, 1100.0])
@pytest.mark.parametrize("bend", [0.0, 150.0, -200.0])
@pytest.mark.parametrize("reverse", [False, True])
def test_centre_line_lies_within_a_pixel(x: float, bend: float, reverse: bool) -> None:
    centre, one, two = marking(x, bend=bend)
    one, two = one[[*range(0, 2000, 97), -1]], two[[*range(0, 2000, 83), -1]]
    line = centre_line(one, two[::-1] if reverse else two)
    assert distance(line, centre) < 1.0
    assert distance(centre[100:-100:20], resample(line, 0.5)) < 1.0


def test_a_longer_edge_goes_on_alone() -> None:
    centre, one, two = marking(300.0, near=12.0, far=8.0)
    line = centre_line(one[::50], two[:1200:50])
    assert line[-1, 1] < 370  # up to the far end of the longer edge
    assert distance(line, centre) < 2.5
    np.testing.assert_allclose(centre_line(two[:1200:50], one[::50])[-1], line[-1], atol=2.0)


def test_edges_find_their_partner_among_many() -> None:
    lines: list[NDArray[np.float64]] = []
    for x in (60.0, 420.0, 860.0, 1220.0):
        _, one, two = marking(x)
        lines += [one[::200], two[::-200]]
    order = np.random.default_rng(3).permutation(len(lines))
    pairing = pair_edges([lines[index] for index in order])
    assert pairing.single == ()
    assert {frozenset((int(order[a]) // 2, int(order[b]) // 2)) for a, b in pairing.pairs} == {
        frozenset({i}) for i in range(4)
    }


def test_nearest_first_would_be_wrong() -> None:
    """Four lines at 0, 10, 18 and 28: the two in the middle are nearest, but each is an edge of its own marking."""
    lines = [np.array([[x, 0.0], [x, 200.0]]) for x in (0.0, 10.0, 18.0, 28.0)]
    assert pair_edges(lines).pairs == ((0, 1), (2, 3))


def test_far_apart_or_crossing_or_following_lines_stay_alone() -> None:
    wall = np.array([[0.0, 0.0], [0.0, 200.0]])
    assert pair_edges([wall, wall + np.array([60.0, 0.0])]).single == (0, 1)
    assert pair_edges([wall, np.array([[-100.0, 100.0], [100.0, 100.0]])]).pairs == ()
    dashes = [np.array([[0.0, y], [0.0, y + 20.0]]) for y in (0.0, 30.0, 60.0)]
    assert pair_edges(dashes).pairs == ()
    assert edge_gap(wall, wall + np.array([12.0, 0.0])) == pytest.approx(12)


def test_dashes_side_by_side_pair_within_each_dash() -> None:
    lines = [np.array([[x, y], [x, y + 30.0]]) for y in (0.0, 50.0, 100.0) for x in (0.0, 9.0)]
    assert pair_edges(lines).pairs == ((0, 1), (2, 3), (4, 5))


def test_more_lines_than_are_paired_exactly() -> None:
    lines = [np.array([[x + 30.0 * n, 0.0], [x + 30.0 * n, 300.0]]) for n in range(9) for x in (0.0, 6.0)]
    assert pair_edges(lines).pairs == tuple((2 * n, 2 * n + 1) for n in range(9))


def test_of_many_edges_the_nearest_are_paired_first() -> None:
    y = np.arange(0.0, 301.0, 20.0)
    left = [np.stack([np.full_like(y, 14.0 * number), y], axis=1) for number in range(7)]
    right = [line + np.array([4.0, 0.0]) for line in left]
    assert pair_edges([*left, *right], max_gap=20.0).pairs == tuple((number, number + 7) for number in range(7))


@pytest.mark.parametrize("count", [12, 14, 40])
def test_a_chain_of_any_length_leaves_no_edge_alone(count: int) -> None:
    """At about equal distances: nearest first would leave edges alone between the pairs."""
    order = np.random.default_rng(1).permutation(count)
    places = [100 + 20 * k + 0.05 * (k * 7 % 3) for k in order]
    pairing = pair_edges([np.array([[x, 700.0], [x, 300.0]]) for x in places])
    assert pairing.single == ()
    assert all(abs(int(order[a]) - int(order[b])) == 1 for a, b in pairing.pairs)


def test_a_heap_of_edges_is_paired_whole() -> None:
    lines = [np.array([[0.7 * k, 0.0], [0.7 * k, 200.0]]) for k in range(20)]
    assert pair_edges(lines).pairs == tuple((2 * k, 2 * k + 1) for k in range(10))
