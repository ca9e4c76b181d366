"""Pixel-wise scores of a binary mask, from one confusion matrix over the data set ('fair' protocol).

With TP, FP, FN, TN the pixels summed over images:

    IoU        = TP / (TP + FP + FN)
    mIoU       = (IoU of foreground + IoU of background) / 2, background IoU = TN / (TN + FN + FP)
    precision  = TP / (TP + FP)
    recall     = TP / (TP + FN)
    F1         = 2 TP / (2 TP + FP + FN)
    balanced accuracy = (recall + TN / (TN + FP)) / 2

A ratio without a denominator is NaN ("no evidence"), never 0 or 1. Images where prediction and truth are both empty
say nothing about the class; they are left out of the sums and counted.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import ShapeError
from trilitenet.metrics.arithmetic import FloatArray, ratio, weighted_sum
from trilitenet.metrics.rows import Rows

__all__ = [
    "SegmentationMetric",
    "SegmentationScores",
    "as_binary",
    "check_valid",
    "confusion",
    "confusion_figures",
]


def as_binary(mask: NDArray[Any], valid: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
    """Return a mask as (H, W) uint8 of 0 and 1, with 0 wherever ``valid`` is False.

    Args:
        mask: (H, W) bool, or uint8 where above 0 is foreground.
        valid: (H, W) bool.

    Raises:
        ShapeError: If the mask is of another shape or type, or ``valid`` of another type or size.
    """
    if mask.ndim != 2 or mask.dtype not in (np.bool_, np.uint8):
        raise ShapeError(f"a mask must be (H, W) bool or uint8, got {mask.shape} {mask.dtype}")
    check_valid(mask, valid)
    if mask.dtype == np.bool_:
        binary = np.ascontiguousarray(mask).view(np.uint8)
    else:
        binary = np.asarray(cv2.threshold(np.ascontiguousarray(mask, np.uint8), 0, 1, cv2.THRESH_BINARY)[1], np.uint8)
    if valid is not None:
        binary = np.asarray(cv2.bitwise_and(binary, np.ascontiguousarray(valid).view(np.uint8)), np.uint8)
    return binary


def check_valid(mask: NDArray[Any], valid: NDArray[np.bool_] | None) -> None:
    """Check which pixels of an (H, W) mask count.

    Raises:
        ShapeError: If they are not None or (H, W) bool.
    """
    if valid is not None and (valid.dtype != np.bool_ or valid.shape != mask.shape):
        raise ShapeError(f"valid must be {mask.shape} bool like the mask, got {valid.shape} {valid.dtype}")


def confusion(
    prediction: NDArray[np.uint8], truth: NDArray[np.uint8], pixels: int | None = None
) -> tuple[int, int, int, int]:
    """Count pixels: (TP, FP, FN, TN).

    Args:
        prediction: (H, W) uint8 of 0 and 1.
        truth: Likewise.
        pixels: How many pixels count, if not all; the others must be 0 in both.

    Raises:
        ShapeError: If the masks are of different sizes.
    """
    if prediction.shape != truth.shape:
        raise ShapeError(f"prediction of {prediction.shape} against truth of {truth.shape}")
    both = cv2.countNonZero(cv2.bitwise_and(prediction, truth))
    predicted, true = cv2.countNonZero(prediction), cv2.countNonZero(truth)
    total = truth.size if pixels is None else pixels
    return both, predicted - both, true - both, total - predicted - true + both


def confusion_figures(counts: NDArray[Any]) -> dict[str, FloatArray]:
    """Return every ratio of the module's docstring.

    Args:
        counts: (R, 4) TP, FP, FN, TN.

    Returns:
        Name -> (R,) in [0, 1], NaN where undefined.
    """
    tp, fp, fn, tn = np.moveaxis(np.asarray(counts, np.float64), -1, 0)
    iou = ratio(tp, tp + fp + fn)
    background = ratio(tn, tn + fp + fn)
    recall = ratio(tp, tp + fn)
    specificity = ratio(tn, tn + fp)
    miou = np.where(np.isnan(iou), background, np.where(np.isnan(background), iou, (iou + background) / 2))
    return {
        "miou": miou,
        "iou": iou,
        "precision": ratio(tp, tp + fp),
        "recall": recall,
        "f1": ratio(2 * tp, 2 * tp + fp + fn),
        "balanced_accuracy": (recall + specificity) / 2,
    }


@dataclasses.dataclass(frozen=True)
class SegmentationScores:
    """Scores of one binary mask over a data set; ratios in [0, 1], NaN where undefined.

    Attributes:
        images: Images that count.
        both_empty: Labelled images left out because prediction and truth are both empty.
        not_labelled: Images left out because they have no truth, or no prediction.
        miou: Mean of foreground and background IoU.
        iou: Foreground IoU.
        precision: Of foreground pixels.
        recall: Of foreground pixels.
        f1: Of foreground pixels.
        balanced_accuracy: Mean of sensitivity and specificity.
        image_iou: Mean over images of the image's foreground IoU.
        true_positive: Pixels.
        false_positive: Pixels.
        false_negative: Pixels.
        true_negative: Pixels.
    """

    images: int
    both_empty: int
    not_labelled: int
    miou: float
    iou: float
    precision: float
    recall: float
    f1: float
    balanced_accuracy: float
    image_iou: float
    true_positive: int
    false_positive: int
    false_negative: int
    true_negative: int


class SegmentationMetric:
    """Scores of one binary mask, an image at a time; four integers an image are kept."""

    def __init__(self) -> None:
        self._counts = Rows(4)
        self._labelled = Rows(1, np.bool_)

    def __len__(self) -> int:
        return len(self._counts)

    def update(
        self, prediction: NDArray[Any] | None, truth: NDArray[Any] | None, valid: NDArray[np.bool_] | None = None
    ) -> tuple[int, int, int, int] | None:
        """Add an image.

        Args:
            prediction: (H, W) bool, or uint8 with foreground above 0; None if the model gave none.
            truth: Likewise; None = not labelled.
            valid: (H, W) bool: pixels that count.

        Returns:
            TP, FP, FN, TN of the image; None where it does not count.

        Raises:
            ShapeError: If the masks are of different sizes.
        """
        if prediction is None or truth is None:
            self.add(None)
            return None
        counts = confusion(
            as_binary(prediction, valid), as_binary(truth, valid), None if valid is None else int(valid.sum())
        )
        self.add(counts)
        return counts

    def add(self, counts: tuple[int, int, int, int] | None) -> None:
        """Add an image by its TP, FP, FN, TN; None = not labelled."""
        self._counts.append((0, 0, 0, 0) if counts is None else counts)
        self._labelled.append(counts is not None)

    @property
    def counts(self) -> NDArray[np.int64]:
        """(N, 4) TP, FP, FN, TN an image; zeros where the image does not count."""
        counts = self._counts.array
        return np.where(counts[:, :3].any(axis=1, keepdims=True), counts, 0)

    def figures(self, weights: NDArray[Any] | None = None) -> dict[str, FloatArray]:
        """Return scores by name under R weightings of the images at once.

        Args:
            weights: (R, N) how often each image counts; None for once each.

        Returns:
            Name -> (R,).
        """
        return confusion_figures(weighted_sum(self.counts, weights))

    def compute(self) -> SegmentationScores:
        """Return the scores over all images."""
        counts = self._counts.array
        labelled = self._labelled.array[:, 0]
        counted = counts[:, :3].any(axis=1)
        total = [int(value) for value in self.counts.sum(axis=0)]
        figures = {name: float(value[0]) for name, value in self.figures().items()}
        image_iou = ratio(counts[counted, 0], counts[counted, :3].sum(axis=1))
        return SegmentationScores(
            images=int(counted.sum()),
            both_empty=int((labelled & ~counted).sum()),
            not_labelled=int((~labelled).sum()),
            image_iou=float(image_iou.mean()) if len(image_iou) else float("nan"),
            true_positive=total[0],
            false_positive=total[1],
            false_negative=total[2],
            true_negative=total[3],
            **figures,
        )

    def state(self) -> dict[str, Any]:
        """Return the counts an image, as ``json.dumps`` takes them."""
        return {"counts": self._counts.pack(), "labelled": self._labelled.pack()}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> SegmentationMetric:
        """Read what `state` returned."""
        metric = cls()
        metric._counts.unpack(state["counts"])
        metric._labelled.unpack(state["labelled"])
        return metric
