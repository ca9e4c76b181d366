from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from trilitenet.data.rasterise import draw_line, fill_polygon, flatten
from trilitenet.errors import DataError


def inside(points: NDArray[np.float64], x: float, y: float) -> bool:
    """Even-odd rule by a ray to the left, one pixel at a time."""
    odd = False
    for (x1, y1), (x2, y2) in zip(points, np.roll(points, -1, axis=0), strict=True):
        if (y1 <= y) != (y2 <= y) and x1 + (y - y1) / (y2 - y1) * (x2 - x1) <= x:
            odd = not odd
    return odd


def test_square_covers_whole_pixels_without_a_seam() -> None:
    mask = np.zeros((12, 12), np.uint8)
    fill_polygon(mask, np.array([[2.0, 3], [7, 3], [7, 9], [2, 9]]), 255)
    assert mask.sum() == 255 * 5 * 6
    assert mask[3:9, 2:7].all()
    # Two squares that share an edge share no pixel and leave none out.
    other = np.zeros((12, 12), np.uint8)
    fill_polygon(other, np.array([[7.0, 3], [10, 3], [10, 9], [7, 9]]))
    assert not (mask.astype(bool) & other.astype(bool)).any()
    assert other[3:9, 7].all()


@pytest.mark.parametrize("seed", range(8))
def test_any_polygon_agrees_with_the_slow_rule(seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-8, 40, (7, 2))  # crosses itself and the borders
    mask = np.zeros((30, 34), np.uint8)
    fill_polygon(mask, points)
    truth = np.array([[inside(points, c + 0.5, r + 0.5) for c in range(34)] for r in range(30)])
    np.testing.assert_array_equal(mask.astype(bool), truth)


def test_polygon_outside_or_degenerate_draws_nothing() -> None:
    mask = np.zeros((8, 8), np.uint8)
    for points in (
        [[20, 20], [30, 20], [25, 30]],
        [[-9, 1], [-3, 1], [-5, 6]],
        [[1, 1], [6, 6]],
        [[2, 2], [2, 2], [2, 2]],
    ):
        fill_polygon(mask, np.array(points, np.float64))
    assert not mask.any()


@pytest.mark.parametrize("width", [2, 5, 8])
def test_line_is_as_wide_as_it_says(width: int) -> None:
    mask = np.zeros((200, 40), np.uint8)
    middle = 20.0 + (width % 2) / 2  # on a pixel's border, or on its centre
    draw_line(mask, np.array([[middle, 10], [middle, 190]]), width)
    assert set(mask[20:180].sum(axis=1).tolist()) == {width}


def test_long_line_agrees_with_the_slow_rule() -> None:
    mask = np.zeros((120, 200), np.uint8)
    draw_line(mask, np.array([[-20.0, 5], [150, 90], [170, 20]]), 7.0)
    truth = np.zeros_like(mask)
    for start, end in (((-20, 5), (150, 90)), ((150, 90), (170, 20))):
        a, b = np.array(start, float), np.array(end, float)
        for row in range(120):
            for column in range(200):
                p = np.array([column + 0.5, row + 0.5])
                run = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
                if np.hypot(*(p - a - run * (b - a))) <= 3.5:
                    truth[row, column] = 1
    np.testing.assert_array_equal(mask, truth)


def test_a_single_point_is_a_disc() -> None:
    mask = np.zeros((10, 10), np.uint8)
    draw_line(mask, np.array([[5.0, 5.0]]), 4.0)
    assert mask.sum() == 12


def test_bezier_lies_on_the_curve() -> None:
    control = np.array([[0.0, 0], [0, 40], [60, 40], [60, 0]])
    line = flatten(np.concatenate([[[-10.0, 0.0]], control]).tolist(), "LLCCC", closed=False)
    np.testing.assert_array_equal(line[:2], [[-10, 0], [0, 0]])
    np.testing.assert_array_equal(line[-1], [60, 0])
    t = np.linspace(0, 1, 20001)[:, None]
    curve = (
        (1 - t) ** 3 * control[0]
        + 3 * t * (1 - t) ** 2 * control[1]
        + 3 * t**2 * (1 - t) * control[2]
        + t**3 * control[3]
    )
    gaps = np.sqrt(((line[2:, None] - curve) ** 2).sum(axis=2)).min(axis=1)
    assert gaps.max() < 0.01
    # Between the samples the chord stays close to the curve as well.
    middles = (line[1:-1] + line[2:]) / 2
    assert np.sqrt(((middles[:, None] - curve) ** 2).sum(axis=2)).min(axis=1).max() < 0.1


@pytest.mark.parametrize("types", ["CCCL", "LCCC"])
def test_both_spellings_of_a_curve_are_one(types: str) -> None:
    """The first vertex is the start, then two control points and the end, whatever the letters of start and end."""
    line = flatten([[0.0, 0.0], [0.0, 40.0], [60.0, 40.0], [60.0, 0.0]], types, closed=False)
    np.testing.assert_array_equal(line[[0, -1]], [[0, 0], [60, 0]])
    assert line[:, 1].max() == pytest.approx(30, abs=0.1)


def test_closed_curve_ends_at_the_start() -> None:
    line = flatten([[0.0, 0], [0.0, 40], [60.0, 40]], "LCC", closed=True)
    np.testing.assert_array_equal(line[0], [0, 0])
    assert np.hypot(*line[-1]) < 4


def test_bad_shapes_are_refused() -> None:
    with pytest.raises(DataError, match="one letter"):
        flatten([[0, 0], [1, 1]], "L", closed=False)
    with pytest.raises(DataError, match="one letter"):
        flatten([[0, 0], [1, 1]], "LX", closed=False)
    for wrong in (float("nan"), float("inf"), 1e9):
        points = np.array([[0, 0], [wrong, 1], [3, 3]])
        with pytest.raises(DataError, match="not a number"):
            flatten(points.tolist(), "LLL", closed=False)
        with pytest.raises(DataError, match="not a number"):
            fill_polygon(np.zeros((8, 8), np.uint8), points)
        with pytest.raises(DataError, match="not a number"):
            draw_line(np.zeros((8, 8), np.uint8), points, 2.0)
