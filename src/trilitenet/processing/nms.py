"""Non-maximum suppression, a class at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["nms"]


def nms(
    xyxy: NDArray[np.floating[Any]],
    scores: NDArray[np.floating[Any]],
    class_id: NDArray[np.integer[Any]],
    iou: float,
    max_boxes: int,
) -> NDArray[np.int64]:
    """Keep the best boxes, greedily: a box goes when it overlaps a better one of its own class by more than ``iou``.

    Args:
        xyxy: (N, 4) left, top, right, bottom in pixels.
        scores: (N,) the higher the better; of equal ones the earlier box is taken first.
        class_id: (N,) boxes of different classes never suppress each other.
        iou: Intersection over union in [0, 1].
        max_boxes: Stop after so many boxes.

    Returns:
        (K,) positions of the boxes kept, best first, K <= ``max_boxes``.
    """
    order = np.argsort(-scores, kind="stable")
    left, top, right, bottom = np.ascontiguousarray(xyxy[order].T)
    classes = class_id[order]
    area = (right - left) * (bottom - top)
    one_class = len(classes) == 0 or bool((classes == classes[0]).all())
    kept: list[int] = []
    rest = np.arange(len(order))
    while len(rest) and len(kept) < max_boxes:
        best, rest = rest[0], rest[1:]
        kept.append(int(best))
        width = np.minimum(right[best], right[rest]) - np.maximum(left[best], left[rest])
        height = np.minimum(bottom[best], bottom[rest]) - np.maximum(top[best], top[rest])
        intersection = np.maximum(width, 0) * np.maximum(height, 0)
        stays = intersection <= iou * (area[best] + area[rest] - intersection)
        rest = rest[stays if one_class else stays | (classes[rest] != classes[best])]
    return order[kept].astype(np.int64, copy=False)
