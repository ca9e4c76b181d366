from __future__ import annotations

import numpy as np
import pytest

from trilitenet.metrics.arithmetic import box_cover, box_overlap, mean_known, ratio, weighted_sum
from trilitenet.metrics.rows import Rows


def test_ratios_without_a_denominator_are_nan() -> None:
    np.testing.assert_array_equal(ratio([1, 0, 3], [2, 0, 0]), [0.5, np.nan, np.nan])
    assert mean_known(np.array([[1.0, np.nan, 3.0], [np.nan, np.nan, np.nan]])).tolist()[0] == 2.0
    assert np.isnan(mean_known(np.array([np.nan])))


def test_sums_over_weighted_images() -> None:
    rows = np.array([[1, 10], [2, 20]])
    assert weighted_sum(rows, None).tolist() == [[3, 30]]
    assert weighted_sum(rows, np.array([[2, 0], [1, 3]])).tolist() == [[2, 20], [7, 70]]


def test_overlap_and_cover_by_hand() -> None:
    boxes = np.array([[0, 0, 4, 2], [5, 5, 5, 5]], np.float64)
    others = np.array([[2, 0, 6, 2]], np.float64)
    assert box_overlap(boxes, others).tolist() == [[pytest.approx(4 / 12)], [0.0]]
    assert box_cover(boxes, others).tolist() == [[0.5], [0.0]]


def test_rows_grow_and_are_compact() -> None:
    rows = Rows(2, np.int16)
    rows.append((1, 2))
    rows.append(np.arange(400).reshape(200, 2))
    assert len(rows) == 201
    assert rows.array.dtype == np.int16
    assert rows.array[-1].tolist() == [398, 399]
