"""Detection by COCO matching ('fair' protocol): average precision, and precision, recall and F1 at a confidence.

Per image and class the boxes, best first and at most ``max_boxes``, each take the free true box of highest IoU not
below the threshold. A box that can only take an ignored region (its intersection over the *box's* area reaches the
threshold), or a true box outside the area range, counts neither way; an ignored region can take any number of boxes.

    AP        = mean over recall 0, 0.01, ..., 1 of the highest precision at that recall or above
    AP50:95   = mean of AP over IoU thresholds 0.50, 0.55, ..., 0.95
    F1        = 2 precision recall / (precision + recall), at IoU 0.5

This is what pycocotools computes (Lin et al., ECCV 2014, with ``iscrowd`` for ignored regions); the two are compared
in the tests. Here an image leaves a few bytes a box instead of a dictionary, and images can be weighted, which is how
intervals and the tables by condition are made.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import ShapeError
from trilitenet.metrics.arithmetic import FloatArray, box_area, box_cover, box_overlap, mean_known, ratio, weighted_sum
from trilitenet.metrics.ranking import RankedBoxes, RankedSums
from trilitenet.metrics.rows import Rows, pack_tables, unpack_tables

__all__ = [
    "AREAS",
    "COMMON_CONFIDENCE",
    "IOU_THRESHOLDS",
    "DetectionCurve",
    "DetectionMetric",
    "DetectionScores",
    "OperatingPoint",
    "check_image",
    "confidence_histogram",
    "in_regions",
    "is_cut_off",
    "match_boxes",
    "precision_recall_curve",
]

IOU_THRESHOLDS: Final = tuple(round(0.5 + 0.05 * step, 2) for step in range(10))
"""IoU a box must reach, for AP50:95."""
AREAS: Final[dict[str, tuple[float, float]]] = {
    "all": (0.0, 1e10),
    "small": (0.0, 32.0**2),
    "medium": (32.0**2, 96.0**2),
    "large": (96.0**2, 1e10),
}
"""Box areas, in square pixels of the image as stored, both ends included (COCO's)."""
COMMON_CONFIDENCE: Final = 0.25
"""Precision, recall and F1 are given here too, whatever a model's own confidence."""
_CUT_SLACK: Final = 0.01
"""Boxes that were cut off at a confidence end a little above it."""
_RECALLS: Final[FloatArray] = np.linspace(0.0, 1.0, 101)
_ALL_BITS: Final = (1 << len(IOU_THRESHOLDS)) - 1
_EPS: Final = float(np.spacing(1))


@dataclasses.dataclass(frozen=True)
class OperatingPoint:
    """Detection at one confidence threshold and IoU 0.5, all classes together.

    Attributes:
        confidence: Boxes above this count (at or above, for the best F1).
        precision: Share of boxes that are right.
        recall: Share of true boxes found.
        f1: Harmonic mean of the two.
    """

    confidence: float
    precision: float
    recall: float
    f1: float


@dataclasses.dataclass(frozen=True, eq=False)
class DetectionCurve:
    """Precision and recall at IoU 0.5, all classes together, along falling confidence.

    Attributes:
        confidence: (K,) distinct confidences, falling.
        precision: (K,)
        recall: (K,)
    """

    confidence: FloatArray
    precision: FloatArray
    recall: FloatArray


@dataclasses.dataclass(frozen=True)
class DetectionScores:
    """Detection scores over a data set; ratios in [0, 1], NaN where undefined (no true box).

    Attributes:
        images: Labelled images with a true box or a predicted one.
        both_empty: Labelled images with neither.
        not_labelled: Images without truth, or without a prediction.
        objects: True boxes (ignored regions apart).
        boxes: Predicted boxes, ignored ones left out.
        ap50: AP at IoU 0.5, mean over classes.
        ap75: AP at IoU 0.75.
        ap: AP50:95.
        ap_small: AP50:95 of boxes up to 32 x 32 pixels.
        ap_medium: AP50:95 of boxes between.
        ap_large: AP50:95 of boxes from 96 x 96 pixels.
        ap50_by_class: Class name -> AP50.
        best: Where F1 is best.
        at: At the stated confidence; NaN too where boxes above it may have been cut off.
        recall_all: Recall at IoU 0.5 of all boxes, whatever their confidence.
    """

    images: int
    both_empty: int
    not_labelled: int
    objects: int
    boxes: int
    ap50: float
    ap75: float
    ap: float
    ap_small: float
    ap_medium: float
    ap_large: float
    ap50_by_class: dict[str, float]
    best: OperatingPoint
    at: OperatingPoint
    recall_all: float


def check_image(
    boxes: NDArray[Any] | None,
    scores: NDArray[Any] | None,
    class_id: NDArray[Any] | None,
    truth: NDArray[Any] | None,
    truth_class: NDArray[Any] | None,
    classes: int,
) -> bool:
    """Return whether an image counts: whether there are predicted boxes and true ones, be they none.

    Raises:
        ShapeError: If boxes are not (N, 4), have not as many scores and class ids, or a class id is not one of 0 ..
            ``classes`` - 1.
    """
    if boxes is None or truth is None:
        return False
    if scores is None or class_id is None or truth_class is None:
        raise ShapeError("predicted boxes need scores and class ids, true ones class ids")
    for name, rows, ids in (("predicted", boxes, class_id), ("true", truth, truth_class)):
        if len(rows) != len(ids) or (len(rows) and np.shape(rows) != (len(rows), 4)):
            raise ShapeError(f"{name} boxes must be (N, 4) with N class ids, got {np.shape(rows)} and {len(ids)}")
        if len(ids) and not (np.min(ids) >= 0 and np.max(ids) < classes):
            raise ShapeError(f"class ids of {name} boxes must be in 0 .. {classes - 1}, got {np.unique(ids)}")
    if len(scores) != len(boxes):
        raise ShapeError(f"{len(boxes)} predicted boxes have {len(scores)} scores")
    return True


class DetectionMetric:
    """Detection scores, an image at a time; about 30 bytes a box and 50 an image are kept.

    Args:
        class_names: Names that class ids index.
        confidence: The stated confidence of `DetectionScores.at` and of the confusion matrix.
        max_boxes: At most so many boxes an image and class count (COCO itself uses 100).
        lowest: Boxes below this confidence may have been cut off; figures at one below it are undefined.
    """

    def __init__(
        self,
        class_names: Sequence[str] = ("vehicle",),
        confidence: float = 0.25,
        max_boxes: int = 300,
        lowest: float = 0.0,
    ) -> None:
        self.class_names = tuple(class_names)
        self.confidence = confidence
        self.max_boxes = max_boxes
        self.lowest = lowest
        self._thresholds = np.array(IOU_THRESHOLDS, np.float64)
        self._ranges = np.array(list(AREAS.values()), np.float64)
        areas, classes = len(AREAS), len(self.class_names)
        self._scores = Rows(1, np.float32)
        self._image = Rows(1, np.int32)
        self._class = Rows(1, np.int16)
        self._matched = Rows(areas, np.uint16)  # one bit an IoU threshold
        self._ignored = Rows(areas, np.uint16)
        self._objects = Rows(areas * classes, np.int32)
        self._labelled = Rows(1, np.bool_)
        self._ranked: dict[tuple[int, int], RankedBoxes] = {}
        self._best: OperatingPoint | None = None
        self._confusion: NDArray[np.int64] = np.zeros((classes + 1, classes + 1), np.int64)

    def __len__(self) -> int:
        return len(self._labelled)

    @property
    def confusion(self) -> NDArray[np.int64]:
        """(classes + 1, classes + 1) counts at the stated confidence and IoU 0.5: row truth, column prediction.

        The last row is background that was taken for an object, the last column objects that were missed.
        """
        confusion: NDArray[np.int64] = self._confusion.copy()
        return confusion

    def update(
        self,
        boxes: NDArray[Any] | None,
        scores: NDArray[Any] | None,
        class_id: NDArray[Any] | None,
        truth: NDArray[Any] | None,
        truth_class: NDArray[Any] | None,
        ignored: NDArray[Any] | None = None,
        neutral: NDArray[np.bool_] | None = None,
    ) -> tuple[int, int, int] | None:
        """Add an image.

        Args:
            boxes: (D, 4) predicted left, top, right, bottom in pixels; None if the model gave none.
            scores: (D,) confidences in [0, 1].
            class_id: (D,) class ids.
            truth: (G, 4) true boxes; None = not labelled.
            truth_class: (G,) class ids.
            ignored: (M, 4) ignored regions, of any class.
            neutral: (D,) predicted boxes that are not wrong where they meet no true box; those in ``ignored`` need not
                be among them.

        Returns:
            Right boxes, wrong boxes and missed objects of the image at the stated confidence; None where the image
            does not count.

        Raises:
            ShapeError: See `check_image`; nothing is added then.
        """
        labelled = check_image(boxes, scores, class_id, truth, truth_class, len(self.class_names))
        self._ranked.clear()
        self._best = None
        index = len(self._labelled)
        self._labelled.append(labelled)
        objects = np.zeros((len(self.class_names), len(AREAS)), np.int32)
        if boxes is None or scores is None or class_id is None or truth is None or truth_class is None:
            self._objects.append(objects.ravel())
            return None
        boxes = np.asarray(boxes, np.float64).reshape(-1, 4)
        regions = np.zeros((0, 4)) if ignored is None else np.asarray(ignored, np.float64).reshape(-1, 4)
        pardoned = np.zeros(len(boxes), np.bool_) if neutral is None else np.asarray(neutral, np.bool_)
        order = np.argsort(-np.asarray(scores, np.float32), kind="stable")
        for number in range(len(self.class_names)):
            picked = order[np.asarray(class_id)[order] == number][: self.max_boxes]
            true = np.asarray(truth, np.float64).reshape(-1, 4)[np.asarray(truth_class) == number]
            objects[number] = self._in_range(box_area(true)).sum(axis=1)
            if not len(picked):
                continue
            matched, passed = self._match(boxes[picked], true, regions, pardoned[picked])
            self._scores.append(np.asarray(scores, np.float32)[picked, None])
            self._image.append(np.full((len(picked), 1), index))
            self._class.append(np.full((len(picked), 1), number))
            self._matched.append(matched)
            self._ignored.append(passed)
        self._objects.append(objects.ravel())
        kept = order[np.asarray(scores)[order] > self.confidence]
        return self._confuse(
            boxes[kept],
            np.asarray(class_id)[kept],
            truth,
            truth_class,
            regions,
            pardoned[kept],
        )

    def _in_range(self, area: FloatArray) -> NDArray[np.bool_]:
        """Return (areas, N): whether each area lies in each range."""
        return (area >= self._ranges[:, :1]) & (area <= self._ranges[:, 1:])

    def _match(
        self, boxes: FloatArray, truth: FloatArray, regions: FloatArray, pardoned: NDArray[np.bool_]
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Match sorted boxes of one class: (D, areas) bits an IoU threshold of right boxes and of ignored ones."""
        limits = np.minimum(self._thresholds, 1 - 1e-10)
        bits = (1 << np.arange(len(limits))).astype(np.uint16)
        matched = np.zeros((len(boxes), len(AREAS)), np.uint16)
        outside = ~self._in_range(box_area(boxes))  # (areas, D)
        overlap = box_overlap(boxes, truth)
        cover = box_cover(boxes, regions).max(axis=1, initial=0)
        in_region = (cover[:, None] >= limits) | pardoned[:, None]
        # Boxes near no true box: wrong, unless in an ignored region or outside the area range.
        passed = np.where(outside.T, bits.sum(), (in_region * bits).sum(axis=1)[:, None]).astype(np.uint16)
        if not len(truth):
            return matched, passed
        # The others, in falling order of confidence, for all area ranges and thresholds at once.
        true_ignored = ~self._in_range(box_area(truth))  # (areas, G)
        free = np.ones((len(AREAS), len(limits), len(truth)), np.bool_)
        for row in np.flatnonzero(overlap.max(axis=1) >= limits[0]):
            reach = free & (overlap[row] >= limits[:, None])  # (areas, T, G)
            best, target = _last_best(np.where(reach & ~true_ignored[:, None, :], overlap[row], 0.0))
            spare_best, spare_target = _last_best(np.where(reach & true_ignored[:, None, :], overlap[row], 0.0))
            hit = best > 0
            in_spare = ~hit & (spare_best > cover[row] * in_region[row])
            area, level = np.nonzero(hit)
            free[area, level, target[hit]] = False
            area, level = np.nonzero(in_spare)
            free[area, level, spare_target[in_spare]] = False
            neutral = ~hit & (in_spare | in_region[row] | outside[:, row, None])
            matched[row] = (hit * bits).sum(axis=1)
            passed[row] = (neutral * bits).sum(axis=1)
        return matched, passed

    def _confuse(
        self,
        boxes: FloatArray,
        class_id: NDArray[Any],
        truth: NDArray[Any],
        truth_class: NDArray[Any],
        regions: FloatArray,
        pardoned: NDArray[np.bool_],
    ) -> tuple[int, int, int]:
        """Match sorted boxes to true ones of any class at IoU 0.5, into the confusion matrix."""
        background = len(self.class_names)
        classes = np.asarray(truth_class, np.int64)
        target = match_boxes(boxes, class_id, truth, classes)
        met = target >= 0
        counted = met | ~(pardoned | in_regions(boxes, regions))
        true_class = np.full(len(boxes), background, np.int64)
        true_class[met] = classes[target[met]]
        np.add.at(self._confusion, (true_class[counted], np.asarray(class_id, np.int64)[counted]), 1)
        alone = np.delete(classes, target[met])
        self._confusion[:background, background] += np.bincount(alone, minlength=background)
        right = int((true_class == class_id).sum())
        return right, int(counted.sum()) - right, len(classes) - right

    # Scores -------------------------------------------------------------------------------------------------------

    def average_precision(self, weights: NDArray[Any] | None = None, area: str = "all") -> FloatArray:
        """Return AP by class and IoU threshold.

        Args:
            weights: (R, N) how often each image counts; None for once each (R = 1).
            area: A key of `AREAS`.

        Returns:
            (R, classes, thresholds) in [0, 1], NaN for a class without true boxes.
        """
        column = list(AREAS).index(area)
        totals = weighted_sum(self._objects.array[:, column :: len(AREAS)], weights)  # (R, classes)
        out = np.full((*totals.shape, len(IOU_THRESHOLDS)), np.nan)
        for number, objects in enumerate(totals.T):
            ranked = self._ranking(number, column)
            for sums in ranked.sums(weights, len(self)):
                for level in range(len(IOU_THRESHOLDS)):
                    bit = np.uint16(1 << level)
                    hit, counted = (ranked.right & bit) != 0, (ranked.ignored & bit) == 0
                    out[sums.rows, number, level] = _ap(sums, hit, counted, objects[sums.rows])
        return out

    def _ranking(self, number: int, column: int) -> RankedBoxes:
        """Return the boxes of a class, ranked: once for all weightings."""
        ranked = self._ranked.get((number, column))
        if ranked is None:
            mine = np.flatnonzero(self._class.array[:, 0] == number)
            ranked = self._ranked[number, column] = RankedBoxes(
                self._scores.array[mine, 0],
                self._image.array[mine, 0],
                self._matched.array[mine, column],
                self._ignored.array[mine, column],
                len(self),
                _ALL_BITS,
            )
        return ranked

    def _verdicts(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return whether each box is right at IoU 0.5, and whether it is wrong; one that counts neither way is not."""
        hit = (self._matched.array[:, 0] & np.uint16(1)) != 0
        return hit, ~hit & ((self._ignored.array[:, 0] & np.uint16(1)) == 0)

    def curve(self) -> DetectionCurve:
        """Return precision and recall at IoU 0.5 along falling confidence, all classes together."""
        objects = int(self._objects.array[:, :: len(AREAS)].sum())
        return precision_recall_curve(self._scores.array[:, 0], *self._verdicts(), objects)

    def histogram(self, bins: int = 20) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return how many right and wrong boxes (IoU 0.5) fall into equal bins of confidence from 0 to 1."""
        return confidence_histogram(self._scores.array[:, 0], *self._verdicts(), bins)

    def _best_point(self) -> OperatingPoint:
        """Return where F1 is best over all images, each counted once; found once for all weightings."""
        if self._best is None:
            objects = self._objects.array[:, :: len(AREAS)].any()
            self._best = _point_of_best_f1(self.curve()) if objects else OperatingPoint(*[float("nan")] * 4)
        return self._best

    def _point_figures(
        self, weights: NDArray[Any] | None, confidence: float, suffix: str = ""
    ) -> dict[str, FloatArray]:
        """Precision, recall and F1 above a confidence at IoU 0.5, NaN where boxes above it may have been cut off."""
        figures = self._figures_above(weights, confidence)
        undefined = is_cut_off(self.lowest, confidence)
        return {
            f"{name}{suffix}": np.full_like(value, np.nan) if undefined else value for name, value in figures.items()
        }

    def _figures_above(self, weights: NDArray[Any] | None, confidence: float) -> dict[str, FloatArray]:
        """Precision, recall and F1 of the boxes above a confidence at IoU 0.5, from sums an image."""
        above = self._scores.array[:, 0] > confidence
        image = self._image.array[:, 0]
        boxes = [np.bincount(image[which & above], minlength=len(self)) for which in self._verdicts()]
        table = np.stack([*boxes, self._objects.array[:, :: len(AREAS)].sum(axis=1)], axis=1)
        right, bad, objects = weighted_sum(table, weights).T
        return {
            "precision": ratio(right, right + bad),
            "recall": ratio(right, objects),
            "f1": ratio(2 * right, right + bad + objects),
        }

    def _best_figures(self, weights: NDArray[Any] | None) -> dict[str, FloatArray]:
        """Precision, recall and F1 at the confidence that is best over all images, whatever the weighting."""
        below = np.nextafter(np.float32(self._best_point().confidence), np.float32(-1))
        return {f"{name}_best": value for name, value in self._figures_above(weights, float(below)).items()}

    def _size_figures(self, weights: NDArray[Any] | None) -> dict[str, FloatArray]:
        """AP50:95 of small, medium and large boxes."""
        by_size = {name: self.average_precision(weights, name) for name in AREAS if name != "all"}
        return {f"ap_{name}": mean_known(ap.reshape(len(ap), -1)) for name, ap in by_size.items()}

    def figures(self, weights: NDArray[Any] | None = None) -> dict[str, FloatArray]:
        """Return scores by name under R weightings of the images at once.

        Args:
            weights: (R, N) how often each image counts; None for once each.

        Returns:
            Name -> (R,).
        """
        ap = self.average_precision(weights)
        return {
            "ap50": mean_known(ap[:, :, 0]),
            "ap": mean_known(ap.reshape(len(ap), -1)),
            **self._size_figures(weights),
            **self._point_figures(weights, self.confidence),
            **self._best_figures(weights),
            **self._point_figures(weights, COMMON_CONFIDENCE, "_025"),
        }

    def compute(self) -> DetectionScores:
        """Return the scores over all images."""
        ap = self.average_precision()[0]
        sizes = {name: float(value[0]) for name, value in self._size_figures(None).items()}
        curve = self.curve()
        objects = self._objects.array[:, :: len(AREAS)].sum(axis=1)
        boxes = np.bincount(self._image.array[:, 0], minlength=len(self))
        labelled = self._labelled.array[:, 0]
        empty = labelled & (objects == 0) & (boxes == 0)
        point = {name: float(value[0]) for name, value in self._point_figures(None, self.confidence).items()}
        return DetectionScores(
            images=int((labelled & ~empty).sum()),
            both_empty=int(empty.sum()),
            not_labelled=int((~labelled).sum()),
            objects=int(objects.sum()),
            boxes=int(np.logical_or(*self._verdicts()).sum()),
            ap50=float(mean_known(ap[None, :, 0])[0]),
            ap75=float(mean_known(ap[None, :, 5])[0]),
            ap=float(mean_known(ap.reshape(1, -1))[0]),
            **sizes,
            ap50_by_class={name: float(ap[number, 0]) for number, name in enumerate(self.class_names)},
            best=self._best_point(),
            at=OperatingPoint(self.confidence, **point),
            recall_all=float(curve.recall[-1]) if len(curve.recall) else (0.0 if objects.sum() else float("nan")),
        )

    def _tables(self) -> dict[str, Rows]:
        return {
            "scores": self._scores,
            "image": self._image,
            "class_id": self._class,
            "matched": self._matched,
            "ignored": self._ignored,
            "objects": self._objects,
            "labelled": self._labelled,
        }

    def state(self) -> dict[str, Any]:
        """Return what was kept, as ``json.dumps`` takes it."""
        return {
            "class_names": list(self.class_names),
            "confidence": self.confidence,
            "max_boxes": self.max_boxes,
            "lowest": self.lowest,
            **pack_tables(self._tables()),
            "confusion": self._confusion.tolist(),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> DetectionMetric:
        """Read what `state` returned."""
        metric = cls(state["class_names"], state["confidence"], state["max_boxes"], state.get("lowest", 0.0))
        unpack_tables(metric._tables(), state)
        metric._confusion = np.asarray(state["confusion"], np.int64)
        return metric


def precision_recall_curve(
    scores: NDArray[np.float32], right: NDArray[np.bool_], wrong: NDArray[np.bool_], objects: int
) -> DetectionCurve:
    """Return precision and recall along falling confidence.

    Args:
        scores: (D,) confidences, in any order.
        right: (D,) whether each box is right.
        wrong: (D,) whether each is wrong; what is neither does not count.
        objects: True boxes.
    """
    order = np.argsort(-scores, kind="stable")
    order = order[(right | wrong)[order]]
    along = scores[order].astype(np.float64)
    found = np.cumsum(right[order])
    last = np.flatnonzero(np.append(along[1:] != along[:-1], True)) if len(along) else np.zeros(0, np.int64)
    return DetectionCurve(
        confidence=along[last],
        precision=ratio(found[last], last + 1),
        recall=ratio(found[last], float(objects)),
    )


def confidence_histogram(
    scores: NDArray[np.float32], right: NDArray[np.bool_], wrong: NDArray[np.bool_], bins: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return how many right and wrong boxes, as `precision_recall_curve` takes them, fall into bins from 0 to 1."""
    edges = np.linspace(0, 1, bins + 1)
    return np.histogram(scores[right], edges)[0], np.histogram(scores[wrong], edges)[0]


def is_cut_off(lowest: float, confidence: float) -> bool:
    """Return whether boxes above a confidence may have been cut off, for the lowest of all ends above it."""
    return lowest > confidence + _CUT_SLACK


def match_boxes(
    boxes: NDArray[Any], class_id: NDArray[Any], truth: NDArray[Any], truth_class: NDArray[Any]
) -> NDArray[np.intp]:
    """Return the true box of each box at IoU 0.5, -1 for none, for what is counted and drawn of one image.

    Each box, best first, takes the free true box of its own class that it overlaps most; then those left over take what
    is still free, of any class. So what is right, wrong and missed agrees with precision and recall.

    Args:
        boxes: (D, 4) predicted left, top, right, bottom, best first.
        class_id: (D,) class ids.
        truth: (G, 4) true boxes.
        truth_class: (G,) class ids.
    """
    overlap = box_overlap(np.asarray(boxes, np.float64), np.asarray(truth, np.float64).reshape(-1, 4))
    target = np.full(len(boxes), -1, np.intp)
    same = np.asarray(class_id)[:, None] == np.asarray(truth_class)
    free: NDArray[np.bool_] = np.ones(len(truth_class), np.bool_)
    for allowed in (same, ~same):
        reach = np.where(allowed, overlap, -1.0)
        for row in np.flatnonzero((target < 0) & (reach.max(axis=1, initial=-1.0) >= 0.5)):
            best = np.where(free, reach[row], -1.0)
            if best.max() >= 0.5:
                target[row] = best.argmax()
                free[target[row]] = False
    return target


def in_regions(boxes: NDArray[Any], regions: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which (D, 4) boxes lie by half or more in one of (M, 4) ignored regions."""
    cover = box_cover(np.asarray(boxes, np.float64), np.asarray(regions, np.float64).reshape(-1, 4))
    return np.asarray(np.max(cover, axis=1, initial=0) >= 0.5)


def _last_best(overlap: FloatArray) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return the largest overlap along the last axis and where it is: of equal ones the last, as in COCO."""
    return overlap.max(axis=-1), overlap.shape[-1] - 1 - overlap[..., ::-1].argmax(axis=-1)


def _ap(sums: RankedSums, hit: NDArray[np.bool_], counted: NDArray[np.bool_], objects: FloatArray) -> FloatArray:
    """Return the (B,) 101-point AP, NaN without objects.

    Args:
        sums: Of the ranked boxes, under B weightings.
        hit: (K,) whether each is right.
        counted: (K,) whether each counts at all.
        objects: (B,) weight of the true boxes.
    """
    # Precision is highest right after a hit, so only those positions matter.
    right = np.cumsum(sums.weight[:, hit], axis=1)
    wrong = (sums.before + np.cumsum(sums.weight * (counted & ~hit), axis=1))[:, hit]
    precision = right / (right + wrong + _EPS)
    envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    envelope = np.concatenate([envelope, np.zeros((len(envelope), 1))], axis=1)
    points = np.full((len(objects), len(_RECALLS)), np.nan)
    for row in np.flatnonzero(objects > 0):
        points[row] = envelope[row, (right[row] / objects[row]).searchsorted(_RECALLS, side="left")]
    return np.asarray(points.mean(axis=1))


def _point_of_best_f1(curve: DetectionCurve) -> OperatingPoint:
    if not len(curve.confidence):  # nothing is found, at any confidence
        return OperatingPoint(float("nan"), float("nan"), 0.0, 0.0)
    f1 = np.nan_to_num(ratio(2 * curve.precision * curve.recall, curve.precision + curve.recall))
    best = int(f1.argmax())
    return OperatingPoint(
        float(curve.confidence[best]), float(curve.precision[best]), float(curve.recall[best]), float(f1[best])
    )
