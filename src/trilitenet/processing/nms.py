"""Non-maximum suppression, a class at a time."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.processing.boxes import box_iou

__all__ = ["nms"]

_BLOCK: Final = 512
"""Boxes that OpenCV looks at in one go: it compares all of them, however few may be kept."""


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
    boxes, classes = xyxy[order].astype(np.float64), class_id[order].astype(np.int32)
    kept = np.zeros(0, np.int64)
    for start in range(0, len(order), _BLOCK):
        if len(kept) >= max_boxes:
            break
        block = np.arange(start, min(start + _BLOCK, len(order)))
        if len(kept):
            over = (box_iou(boxes[block], boxes[kept]) > iou) & (classes[block, None] == classes[kept])
            block = block[~over.any(axis=1)]
        kept = np.concatenate([kept, block[_greedy(boxes[block], classes[block], iou)]])
    return order[kept[:max_boxes]].astype(np.int64, copy=False)


def _greedy(boxes: NDArray[np.float64], classes: NDArray[np.int32], iou: float) -> NDArray[np.int64]:
    """Return the positions that stay, of boxes sorted best first."""
    if not len(boxes):
        return np.zeros(0, np.int64)
    empty = (boxes[:, 2:] <= boxes[:, :2]).any(axis=1)
    if empty.any():  # they overlap nothing, but for OpenCV two of them are the same
        full = (~empty).nonzero()[0]
        return np.sort(np.concatenate([empty.nonzero()[0], full[_greedy(boxes[full], classes[full], iou)]]))
    # OpenCV moves the boxes of a class to a place of its own, which takes coordinates from 0 on.
    rectangles = np.concatenate([boxes[:, :2] - boxes[:, :2].min(), boxes[:, 2:] - boxes[:, :2]], axis=1)
    rank = np.arange(len(boxes), 0, -1, dtype=np.float32)  # in place of the scores, to keep the order of equal ones
    if (classes == classes[0]).all():
        stays = cv2.dnn.NMSBoxes(rectangles, rank, 0.0, iou)  # type: ignore[arg-type]
    else:
        stays = cv2.dnn.NMSBoxesBatched(rectangles, rank, classes, 0.0, iou)  # type: ignore[arg-type]
    return np.asarray(stays, np.int64).reshape(-1)
