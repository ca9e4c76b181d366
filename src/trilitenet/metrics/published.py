"""The published evaluation ('paper' protocol), kept so that its figures can be reproduced and compared with.

Its conventions, which differ from those of the 'fair' protocol:

- Masks are compared at the size the image has inside the canvas (640x360 for 1280x720). Figures are computed a batch
  and averaged over batches, each weighing as many images as it holds; 0/0 counts as 0. So they hang on the batch size
  and on the order of the images; the value over the whole data set stands beside each.

      mIoU = (IoU of background + IoU of foreground) / 2      IoU = TP / (TP + FP + FN)
      Acc  = (TP / (TP + FN) + TN / (TN + FP)) / 2            ('balanced accuracy'; other papers call recall 'Acc')

- A box tries only the true box it overlaps most, and is right when the IoU is strictly above the threshold and no
  better box took that one. Ignored regions are unknown to it: in its files they are objects like any other.

      Recall = recall of all boxes down to confidence 0.001, at IoU 0.5
      AP     = area under the precision envelope at recall 0, 0.01, ..., 1 by the trapezoid rule, where the curve
               starts at precision 1 and falls, linearly, to precision 0 at the last recall + 0.001
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import ConfigError
from trilitenet.metrics.arithmetic import FloatArray, box_overlap, mean_known, ratio, weighted_sum
from trilitenet.metrics.detection import (
    IOU_THRESHOLDS,
    DetectionCurve,
    check_image,
    confidence_histogram,
    precision_recall_curve,
)
from trilitenet.metrics.ranking import RankedBoxes, RankedSums
from trilitenet.metrics.rows import Rows, pack_tables, unpack_tables
from trilitenet.metrics.segmentation import as_binary, confusion

__all__ = [
    "PublishedDetection",
    "PublishedDetectionScores",
    "PublishedSegmentation",
    "PublishedSegmentationScores",
    "published_average_precision",
]


def _zero_ratio(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Divide; 0 where the denominator is 0, as published."""
    return np.nan_to_num(ratio(numerator, denominator))


def _batch_figures(counts: FloatArray) -> dict[str, FloatArray]:
    """Return the published figures of (..., 4) TP, FP, FN, TN."""
    tp, fp, fn, tn = np.moveaxis(counts, -1, 0)
    iou = _zero_ratio(tp, tp + fp + fn)
    sensitivity = _zero_ratio(tp, tp + fn)
    return {
        "miou": (iou + _zero_ratio(tn, tn + fp + fn)) / 2,
        "acc": (sensitivity + _zero_ratio(tn, tn + fp)) / 2,
        "iou": iou,
        "recall": sensitivity,
    }


@dataclasses.dataclass(frozen=True)
class PublishedSegmentationScores:
    """Published scores of one mask, in [0, 1]; NaN without a labelled image.

    Attributes:
        images: Labelled images.
        not_labelled: Images without truth, left out.
        miou: Mean of foreground and background IoU, averaged over batches.
        acc: Balanced accuracy, averaged over batches.
        iou: Foreground IoU, averaged over batches.
        recall: Sensitivity, averaged over batches.
        dataset_miou: The same from one confusion matrix over the data set.
        dataset_acc: Likewise.
        dataset_iou: Likewise.
        dataset_recall: Likewise.
        true_positive: Pixels at the size inside the canvas.
        false_positive: Likewise.
        false_negative: Likewise.
        true_negative: Likewise.
    """

    images: int
    not_labelled: int
    miou: float
    acc: float
    iou: float
    recall: float
    dataset_miou: float
    dataset_acc: float
    dataset_iou: float
    dataset_recall: float
    true_positive: int
    false_positive: int
    false_negative: int
    true_negative: int


class PublishedSegmentation:
    """The published figures of one mask, an image at a time, in the order that batches are made of.

    Args:
        batch_size: Images a batch.

    Raises:
        ConfigError: If it is below 1.
    """

    def __init__(self, batch_size: int = 16) -> None:
        if batch_size < 1:
            raise ConfigError(f"batch_size must be at least 1, got {batch_size}")
        self.batch_size = batch_size
        self._counts = Rows(4)
        self._labelled = Rows(1, np.bool_)

    def __len__(self) -> int:
        return len(self._counts)

    def update(self, prediction: NDArray[Any] | None, truth: NDArray[Any] | None) -> None:
        """Add an image.

        Args:
            prediction: (h, w) bool, or uint8 with foreground above 0, at the size inside the canvas; None if the
                model gave none.
            truth: Likewise, resized by area with everything above 1 of 255 foreground; None = not labelled.

        Raises:
            ShapeError: If the masks are of different sizes.
        """
        counts = None
        if prediction is not None and truth is not None:
            counts = confusion(as_binary(prediction), as_binary(truth))
        self._counts.append(counts or (0, 0, 0, 0))
        self._labelled.append(counts is not None)

    def figures(self, weights: NDArray[Any] | None = None) -> dict[str, FloatArray]:
        """Return figures by name under R weightings of the images at once.

        Args:
            weights: (R, N) how often each image counts, whole numbers; batches are made of the images so repeated, in
                order. None for once each.

        Returns:
            Name -> (R,).
        """
        counts = self._counts.array.astype(np.float64)
        labelled = self._labelled.array[:, 0]
        repeats = np.ones((1, len(counts)), np.int64) if weights is None else np.asarray(weights).astype(np.int64)
        rows = [self._averages(counts, labelled, repeat) for repeat in repeats]
        figures = {name: np.array([row[name] for row in rows]) for name in ("miou", "acc", "iou", "recall")}
        whole = weighted_sum(self._counts.array, weights)
        empty = whole.sum(axis=1) == 0
        for name, value in _batch_figures(whole).items():
            figures[f"dataset_{name}"] = np.where(empty, np.nan, value)
        return figures

    def _averages(self, counts: FloatArray, labelled: NDArray[np.bool_], repeat: NDArray[np.int64]) -> dict[str, float]:
        order = np.repeat(np.arange(len(counts)), repeat)
        starts = np.arange(0, len(order), self.batch_size)
        images = np.add.reduceat(labelled[order].astype(np.float64), starts) if len(order) else np.zeros(0)
        if not images.sum():
            return dict.fromkeys(("miou", "acc", "iou", "recall"), float("nan"))
        batches = _batch_figures(np.add.reduceat(counts[order], starts, axis=0))
        return {name: float((value * images).sum() / images.sum()) for name, value in batches.items()}

    def compute(self) -> PublishedSegmentationScores:
        """Return the scores over all images."""
        labelled = self._labelled.array[:, 0]
        total = [int(value) for value in self._counts.array.sum(axis=0)]
        return PublishedSegmentationScores(
            images=int(labelled.sum()),
            not_labelled=int((~labelled).sum()),
            true_positive=total[0],
            false_positive=total[1],
            false_negative=total[2],
            true_negative=total[3],
            **{name: float(value[0]) for name, value in self.figures().items()},
        )

    def state(self) -> dict[str, Any]:
        """Return the counts an image, as ``json.dumps`` takes them."""
        return {
            "batch_size": self.batch_size,
            "counts": self._counts.pack(),
            "labelled": self._labelled.pack(),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> PublishedSegmentation:
        """Read what `state` returned."""
        metric = cls(state["batch_size"])
        metric._counts.unpack(state["counts"])
        metric._labelled.unpack(state["labelled"])
        return metric


@dataclasses.dataclass(frozen=True)
class PublishedDetectionScores:
    """Published detection scores, in [0, 1]; NaN without a true box.

    Attributes:
        images: Labelled images.
        not_labelled: Images without truth, left out.
        objects: True boxes.
        boxes: Predicted boxes.
        recall: Of all boxes at IoU 0.5, mean over classes.
        precision: Of all boxes at IoU 0.5, mean over classes.
        map50: AP at IoU 0.5, mean over classes.
        map: Mean AP over IoU 0.50, 0.55, ..., 0.95 and classes.
    """

    images: int
    not_labelled: int
    objects: int
    boxes: int
    recall: float
    precision: float
    map50: float
    map: float


class PublishedDetection:
    """The published detection figures, an image at a time.

    Args:
        classes: Number of classes.
    """

    def __init__(self, classes: int = 1) -> None:
        self.classes = classes
        self._thresholds = np.array(IOU_THRESHOLDS)
        self._scores = Rows(1, np.float32)
        self._image = Rows(1, np.int32)
        self._class = Rows(1, np.int16)
        self._right = Rows(1, np.uint16)  # one bit an IoU threshold
        self._objects = Rows(self.classes, np.int32)
        self._labelled = Rows(1, np.bool_)
        self._ranked: dict[int, RankedBoxes] = {}

    def __len__(self) -> int:
        return len(self._labelled)

    def update(
        self,
        boxes: NDArray[Any] | None,
        scores: NDArray[Any] | None,
        class_id: NDArray[Any] | None,
        truth: NDArray[Any] | None,
        truth_class: NDArray[Any] | None,
    ) -> None:
        """Add an image.

        Args:
            boxes: (D, 4) predicted left, top, right, bottom in pixels of the image; None if the model gave none.
            scores: (D,) objectness x class score.
            class_id: (D,)
            truth: (G, 4) true boxes; None = not labelled.
            truth_class: (G,)

        Raises:
            ShapeError: See `trilitenet.metrics.detection.check_image`; nothing is added then.
        """
        check_image(boxes, scores, class_id, truth, truth_class, self.classes)
        self._ranked.clear()
        if boxes is None or scores is None or class_id is None or truth is None or truth_class is None:
            self._objects.append(np.zeros(self.classes, np.int32))
            self._labelled.append(False)
            return
        order = np.argsort(-np.asarray(scores, np.float32), kind="stable")
        boxes = np.asarray(boxes, np.float64).reshape(-1, 4)[order]
        scores, class_id = np.asarray(scores)[order], np.asarray(class_id)[order]
        right = np.zeros(len(boxes), np.uint16)
        bits = (1 << np.arange(len(self._thresholds))).astype(np.uint16)
        for number in np.unique(truth_class):
            targets = np.asarray(truth, np.float64)[np.asarray(truth_class) == number]
            picked = np.flatnonzero(np.asarray(class_id) == number)
            overlap = box_overlap(boxes[picked], targets)
            best = overlap.argmax(axis=1)
            value = overlap[np.arange(len(picked)), best]
            tries = np.flatnonzero(value > self._thresholds[0])
            _, first = np.unique(best[tries], return_index=True)  # the best-scored box of those that want one target
            for row in tries[first]:
                right[picked[row]] = (bits * (value[row] > self._thresholds)).sum()
        if len(boxes):
            self._scores.append(np.asarray(scores, np.float32)[:, None])
            self._class.append(np.asarray(class_id)[:, None])
            self._right.append(right[:, None])
            self._image.append(np.full((len(boxes), 1), len(self._labelled)))
        self._objects.append(np.bincount(np.asarray(truth_class, np.int64), minlength=self.classes))
        self._labelled.append(True)

    def figures(self, weights: NDArray[Any] | None = None) -> dict[str, FloatArray]:
        """Return figures by name under R weightings of the images at once.

        Args:
            weights: (R, N) how often each image counts; None for once each.

        Returns:
            Name -> (R,).
        """
        objects = weighted_sum(self._objects.array, weights)  # (R, classes)
        rounds = len(objects)
        shape = (rounds, self.classes)
        recall, precision = np.full(shape, np.nan), np.full(shape, np.nan)
        ap = np.full((*shape, len(self._thresholds)), np.nan)
        for number in range(self.classes):
            ranked = self._ranking(number)
            for sums in ranked.sums(weights, len(self)):
                count = objects[sums.rows, number]
                for level in range(len(self._thresholds)):
                    hit = (ranked.right & np.uint16(1 << level)) != 0
                    ap[sums.rows, number, level] = _published_ap(sums, hit, count)
                    if level == 0:
                        found = (sums.weight * hit).sum(axis=1)
                        boxes = sums.weight.sum(axis=1) + sums.wrong
                        recall[sums.rows, number] = ratio(found, count)
                        precision[sums.rows, number] = np.where(count > 0, np.nan_to_num(ratio(found, boxes)), np.nan)
        return {
            "recall": mean_known(recall),
            "precision": mean_known(precision),
            "map50": mean_known(ap[:, :, 0]),
            "map": mean_known(ap.reshape(rounds, -1)),
        }

    def curve(self) -> DetectionCurve:
        """Return precision and recall at IoU 0.5 along falling confidence, all classes together."""
        right = self._verdicts()
        return precision_recall_curve(self._scores.array[:, 0], right, ~right, int(self._objects.array.sum()))

    def histogram(self, bins: int = 20) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return how many right and wrong boxes (IoU 0.5) fall into equal bins of confidence from 0 to 1."""
        right = self._verdicts()
        return confidence_histogram(self._scores.array[:, 0], right, ~right, bins)

    def _verdicts(self) -> NDArray[np.bool_]:
        """Return whether each box is right at IoU 0.5; the others are wrong."""
        return np.asarray((self._right.array[:, 0] & np.uint16(1)) != 0)

    def _ranking(self, number: int) -> RankedBoxes:
        """Return the boxes of a class, ranked: once for all weightings."""
        ranked = self._ranked.get(number)
        if ranked is None:
            mine = np.flatnonzero(self._class.array[:, 0] == number)
            ranked = self._ranked[number] = RankedBoxes(
                self._scores.array[mine, 0],
                self._image.array[mine, 0],
                self._right.array[mine, 0],
                np.zeros(len(mine), np.uint16),
                len(self),
                (1 << len(self._thresholds)) - 1,
            )
        return ranked

    def compute(self) -> PublishedDetectionScores:
        """Return the scores over all images."""
        labelled = self._labelled.array[:, 0]
        return PublishedDetectionScores(
            images=int(labelled.sum()),
            not_labelled=int((~labelled).sum()),
            objects=int(self._objects.array.sum()),
            boxes=len(self._scores),
            **{name: float(value[0]) for name, value in self.figures().items()},
        )

    def _tables(self) -> dict[str, Rows]:
        return {
            "scores": self._scores,
            "image": self._image,
            "class_id": self._class,
            "right": self._right,
            "objects": self._objects,
            "labelled": self._labelled,
        }

    def state(self) -> dict[str, Any]:
        """Return what was kept, as ``json.dumps`` takes it."""
        return {
            "classes": self.classes,
            **pack_tables(self._tables()),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> PublishedDetection:
        """Read what `state` returned."""
        metric = cls(state["classes"])
        unpack_tables(metric._tables(), state)
        return metric


def _published_ap(sums: RankedSums, hit: NDArray[np.bool_], objects: FloatArray) -> FloatArray:
    """Return the (B,) published average precision, NaN without objects.

    Args:
        sums: Of the ranked boxes, under B weightings.
        hit: (K,) whether each is right.
        objects: (B,) weight of the true boxes.
    """
    right = np.cumsum(sums.weight * hit, axis=1)
    wrong = sums.before + np.cumsum(sums.weight * ~hit, axis=1)
    right, wrong, last = right[:, hit], wrong[:, hit], (sums.wrong + (sums.weight * ~hit).sum(axis=1))
    out = np.full(len(objects), np.nan)
    for row in np.flatnonzero(objects > 0):
        found, bad = right[row], wrong[row]
        if found.size == 0 or found[-1] == 0:
            out[row] = 0.0
            continue
        # Wherever wrong boxes follow a right one the curve has a second point at the same recall, just before the
        # next right box; the last of them ends the curve.
        recall = np.repeat(found / objects[row], 2)
        precision = np.empty(2 * len(found))
        precision[0::2] = found / np.maximum(found + bad, 1)
        following = np.append(bad[1:], last[row])
        precision[1::2] = found / np.maximum(found + following, 1)
        if bad[0] > 0:
            recall, precision = np.insert(recall, 0, 0.0), np.insert(precision, 0, 0.0)
        out[row] = published_average_precision(recall, precision)
    return out


def published_average_precision(recall: FloatArray, precision: FloatArray) -> float:
    """Return the published average precision of one curve.

    Args:
        recall: (K,) rising, K at least 1.
        precision: (K,)

    Returns:
        In [0, 1].
    """
    along = np.concatenate([[0.0], recall, [recall[-1] + 1e-3]])
    envelope = np.concatenate([[1.0], precision, [0.0]])
    envelope = np.maximum.accumulate(envelope[::-1])[::-1]
    points = np.linspace(0, 1, 101)
    values = np.interp(points, along, envelope)
    return float(((values[1:] + values[:-1]) / 2 * np.diff(points)).sum())
