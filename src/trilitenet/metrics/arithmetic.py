"""Arithmetic that several metrics share: ratios that may be undefined, sums over weighted images, box overlaps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["FloatArray", "box_area", "box_cover", "box_overlap", "mean_known", "ratio", "weighted_sum"]

FloatArray = NDArray[np.float64]


def ratio(numerator: Any, denominator: Any) -> FloatArray:
    """Divide element by element; NaN where the denominator is 0."""
    top, bottom = np.broadcast_arrays(np.asarray(numerator, np.float64), np.asarray(denominator, np.float64))
    out = np.full(bottom.shape, np.nan)
    np.divide(top, bottom, out=out, where=bottom > 0)
    return out


def mean_known(values: FloatArray) -> FloatArray:
    """Return the mean over the last axis of what is not NaN; NaN where nothing is."""
    known = ~np.isnan(values)
    return ratio(np.where(known, values, 0).sum(axis=-1), known.sum(axis=-1))


def weighted_sum(rows: NDArray[Any], weights: NDArray[Any] | None) -> FloatArray:
    """Sum rows over images.

    Args:
        rows: (N, columns), one row an image.
        weights: (R, N) how often each image counts, R weightings at once; None for once each (R = 1).

    Returns:
        (R, columns) float64.
    """
    if weights is None:
        return np.asarray(rows.sum(axis=0, dtype=np.float64))[None]
    return np.asarray(np.asarray(weights, np.float64) @ rows.astype(np.float64))


def box_area(boxes: FloatArray) -> FloatArray:
    """Return the (N,) areas of (N, 4) xyxy boxes in square pixels."""
    sides = np.maximum(boxes[:, 2:] - boxes[:, :2], 0)
    return np.asarray(sides[:, 0] * sides[:, 1], np.float64)


def _intersection(boxes: FloatArray, others: FloatArray) -> FloatArray:
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    sides = np.maximum(high - low, 0)
    return np.asarray(sides[..., 0] * sides[..., 1], np.float64)


def box_overlap(boxes: FloatArray, others: FloatArray) -> FloatArray:
    """Return (N, M) intersection over union, in float64 because thresholds on it are exact; 0 for empty boxes."""
    shared = _intersection(boxes, others)
    return np.nan_to_num(ratio(shared, box_area(boxes)[:, None] + box_area(others)[None] - shared))


def box_cover(boxes: FloatArray, regions: FloatArray) -> FloatArray:
    """Return (N, M) intersection over the area of the box: how much of it lies in each region."""
    return np.nan_to_num(ratio(_intersection(boxes, regions), box_area(boxes)[:, None]))
