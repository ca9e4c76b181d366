"""A mask as simplified polygons. NumPy and OpenCV only."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["mask_to_polygons"]


def mask_to_polygons(
    mask: NDArray[np.bool_] | NDArray[np.uint8], *, tolerance: float = 1.0, min_area: float = 16.0
) -> list[NDArray[np.float32]]:
    """Return the outer outlines of a mask's regions; holes are filled.

    Args:
        mask: (H, W), non-zero = inside.
        tolerance: The outline leaves the mask's by at most so many pixels (Douglas-Peucker).
        min_area: Regions of fewer square pixels are dropped.

    Returns:
        The largest first: (N, 2) float32 x, y of pixel centres, N >= 3, closed (the first point is not repeated).
    """
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    polygons = []
    for contour in contours:
        # Contours run through pixel centres: half a pixel wide on each side is missing from their area.
        area = cv2.contourArea(contour) + 0.5 * cv2.arcLength(contour, closed=True) + 1.0
        if area < min_area:
            continue
        points = cv2.approxPolyDP(contour, tolerance, closed=True)[:, 0]
        if len(points) < 3:  # a thin region, there and back on one line
            points = contour[:, 0] if len(contour) > 2 else np.resize(contour[:, 0], (4, 2))
        polygons.append((area, points.astype(np.float32)))
    polygons.sort(key=lambda pair: -pair[0])
    return [points for _, points in polygons]
