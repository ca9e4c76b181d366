"""Box arithmetic, the single home of it for NumPy. Boxes are pixels in continuous coordinates, never normalised."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["best_side_ratio", "box_area", "box_iou", "clip_boxes", "cxcywh_to_xyxy", "lie_on_mask", "xyxy_to_cxcywh"]

Floating = NDArray[np.floating[Any]]


def cxcywh_to_xyxy(boxes: Floating) -> NDArray[np.float32]:
    """Turn (..., 4) centre x, centre y, width, height into left, top, right, bottom, as float32."""
    half = boxes[..., 2:] * 0.5
    return np.concatenate([boxes[..., :2] - half, boxes[..., :2] + half], axis=-1).astype(np.float32, copy=False)


def xyxy_to_cxcywh(boxes: Floating) -> NDArray[np.float32]:
    """Turn (..., 4) left, top, right, bottom into centre x, centre y, width, height, as float32."""
    low, high = boxes[..., :2], boxes[..., 2:]
    return np.concatenate([(low + high) * 0.5, high - low], axis=-1).astype(np.float32, copy=False)


def box_area(xyxy: Floating) -> NDArray[np.float32]:
    """Return the (...,) areas of (..., 4) boxes in square pixels; 0 for a box turned inside out."""
    sides = np.maximum(xyxy[..., 2:] - xyxy[..., :2], 0)
    return np.asarray(sides[..., 0] * sides[..., 1], np.float32)


def box_iou(first: Floating, second: Floating) -> NDArray[np.float32]:
    """Return the (N, M) intersection over union of (N, 4) and (M, 4) xyxy boxes; 0 where both are empty."""
    # A coordinate at a time: rows of numbers that lie together are three times as fast as pairs of them.
    left, top, right, bottom = np.ascontiguousarray(first.T)[:, :, None]
    other_left, other_top, other_right, other_bottom = np.ascontiguousarray(second.T)
    width = np.minimum(right, other_right) - np.maximum(left, other_left)
    height = np.minimum(bottom, other_bottom) - np.maximum(top, other_top)
    intersection = np.maximum(width, 0) * np.maximum(height, 0)
    union = box_area(first)[:, None] + box_area(second)[None, :] - intersection
    iou = np.zeros(intersection.shape, np.float32)
    np.divide(intersection, union, out=iou, where=union > 0, casting="unsafe")
    return iou


def best_side_ratio(sizes: Floating, anchors: Floating) -> Floating:
    """Return (N,) the worse side ratio, <= 1, of the best of (A, 2) anchors for each of (N, 2) widths and heights."""
    ratio = sizes[:, None] / anchors[None]
    return np.asarray(np.minimum(ratio, 1 / ratio).min(axis=2).max(axis=1))


def clip_boxes(xyxy: Floating, size: tuple[int, int]) -> NDArray[np.float32]:
    """Return (N, 4) xyxy boxes clipped to an image of ``size`` (height, width), as float32."""
    height, width = size
    return np.clip(xyxy, 0, np.array([width, height, width, height], np.float32)).astype(np.float32, copy=False)


def lie_on_mask(xyxy: Floating, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of (N, 4) xyxy boxes lie by more than half where a (height, width) mask is True."""
    height, width = mask.shape
    sums = cv2.integral(mask.view(np.uint8))
    left, top, right, bottom = np.rint(xyxy).clip(0, (width, height, width, height)).astype(np.intp).T
    inside = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    return np.asarray(2 * inside > (right - left) * (bottom - top))
