"""Scores of lane markings, which are thin: IoU at stated label widths, and scores with a tolerance in pixels.

The IoU of thin structures mostly measures their width: a perfect prediction drawn 8 pixels wide has an IoU of about
2/8 to 3/8 with the same line drawn 2 pixels wide. So beside the IoU against the truth as labelled there are

- IoU at width w: the truth is thinned to its centre line and drawn again w pixels wide; the prediction is as it is;
- tolerant precision and recall at t pixels: the share of predicted pixels within t pixels of a true one, and of true
  pixels within t pixels of a predicted one (Euclidean distance between pixel centres); F1 their harmonic mean;
- boundary F at t pixels: the same over boundary pixels alone (Csurka et al., BMVC 2013). A boundary pixel belongs to
  the mask and has one of its four neighbours outside; the image's edge is no boundary.

Widths and tolerances are pixels of the image as stored. Everything is summed over the data set before dividing.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import ConfigError, ShapeError
from trilitenet.metrics.arithmetic import FloatArray, ratio, weighted_sum
from trilitenet.metrics.rows import Rows
from trilitenet.metrics.segmentation import (
    SegmentationMetric,
    SegmentationScores,
    as_binary,
    check_valid,
    confusion,
)

__all__ = ["LaneMetric", "LaneScores", "boundary", "draw_at_width", "thin"]


def boundary(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the boundary pixels of a mask.

    Args:
        mask: (H, W) uint8 of 0 and 1.

    Returns:
        (H, W) uint8 of 0 and 1: pixels of the mask with one of their four neighbours outside it.
    """
    cross = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
    return np.asarray(cv2.subtract(mask, cv2.erode(mask, cross)), np.uint8)


@functools.cache
def _disc(diameter: float) -> NDArray[np.uint8]:
    """Return a disc: the pixels whose centre lies within half the diameter of the middle."""
    side = int(diameter)
    offset = np.arange(side) - (side - 1) / 2
    return (offset[:, None] ** 2 + offset[None, :] ** 2 <= (diameter / 2) ** 2).astype(np.uint8)


@functools.cache
def _ball(radius: float) -> NDArray[np.uint8]:
    """Return the pixels within ``radius`` of the middle one."""
    offset = np.arange(-int(radius), int(radius) + 1)
    return (offset[:, None] ** 2 + offset[None, :] ** 2 <= radius**2).astype(np.uint8)


def _near(mask: NDArray[np.uint8], radius: float) -> NDArray[np.uint8]:
    """Return the pixels within ``radius`` of the mask."""
    return np.asarray(cv2.dilate(mask, _ball(radius), borderType=cv2.BORDER_CONSTANT, borderValue=0), np.uint8)


def draw_at_width(centre: NDArray[np.uint8], width: int) -> NDArray[np.uint8]:
    """Draw centre lines ``width`` pixels wide.

    Args:
        centre: (H, W) uint8 of 0 and 1, one pixel wide, as from `thin`.
        width: Pixels across the line.

    Returns:
        (H, W) uint8 of 0 and 1.
    """
    # Of an even number of pixels `thin` keeps the upper or the right one of the middle two.
    anchor = ((width - 1) // 2, width // 2)
    drawn = cv2.dilate(centre, _disc(float(width)), anchor=anchor, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(drawn, np.uint8)


def thin(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Thin a mask to centre lines one pixel wide (Guo and Hall, CACM 1989).

    Unlike the better known thinning of Zhang and Suen it keeps slanted lines that are two pixels wide.

    Args:
        mask: (H, W) uint8 of 0 and 1.

    Returns:
        (H, W) uint8 of 0 and 1, a subset of the mask with the same connected parts.
    """
    height, width = mask.shape
    padded = np.zeros((height + 2, width + 2), np.uint8)
    padded[1:-1, 1:-1] = mask
    flat = padded.ravel()
    stride = width + 2
    # Neighbours P2 .. P9 clockwise from above, bit 0 .. 7.
    offsets = (-stride, -stride + 1, 1, stride + 1, stride, stride - 1, -1, -stride - 1)
    code = np.asarray(cv2.filter2D(padded, cv2.CV_8U, _NEIGHBOUR_BITS, borderType=cv2.BORDER_CONSTANT)).ravel()
    pixels = np.flatnonzero(flat.view(np.bool_))
    idle = 0  # passes in a row that took nothing away
    for table in itertools.cycle(_thinning_tables()):
        goes = table[code[pixels]]
        gone = pixels[goes]
        idle = 0 if len(gone) else idle + 1
        if idle == 2:
            break
        pixels = pixels[~goes]
        flat[gone] = 0
        for bit, offset in enumerate(offsets):
            code[gone - offset] &= np.uint8(255 - (1 << bit))
    return np.array(padded[1:-1, 1:-1], np.uint8)


_NEIGHBOUR_BITS: Final = np.array([[128, 1, 2], [64, 0, 4], [32, 16, 8]], np.float32)
"""What each neighbour of a pixel adds to its code: P2, above, is bit 0, and so on clockwise."""


@functools.cache
def _thinning_tables() -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return, for each of the two passes, whether a pixel goes, by the 8-bit code of its neighbours."""
    code = np.arange(256)
    p = [((code >> bit) & 1).astype(np.bool_) for bit in range(8)]  # P2 .. P9
    parts = sum((~p[i] & (p[i + 1] | p[(i + 2) % 8])).astype(np.int64) for i in (0, 2, 4, 6))
    pairs = sum((p[i - 1] | p[i]).astype(np.int64) for i in (0, 2, 4, 6))
    others = sum((p[i] | p[i + 1]).astype(np.int64) for i in (0, 2, 4, 6))
    neighbours = np.minimum(pairs, others)
    thinnable = (parts == 1) & (neighbours >= 2) & (neighbours <= 3)
    first = thinnable & ~((p[4] | p[5] | ~p[7]) & p[6])
    second = thinnable & ~((p[0] | p[1] | ~p[3]) & p[2])
    return first, second


@dataclasses.dataclass(frozen=True)
class LaneScores:
    """Scores of lane markings over a data set; ratios in [0, 1], NaN where undefined.

    Attributes:
        as_labelled: Pixel-wise scores against the truth as it is labelled.
        iou_at_width: Label width in pixels -> IoU against the truth drawn so wide.
        tolerance: Pixels of the three scores below.
        precision: Share of predicted pixels within the tolerance of a true one.
        recall: Share of true pixels within the tolerance of a predicted one.
        f1: Harmonic mean of the two.
        boundary_f: Tolerance in pixels -> boundary F.
    """

    as_labelled: SegmentationScores
    iou_at_width: dict[int, float]
    tolerance: float
    precision: float
    recall: float
    f1: float
    boundary_f: dict[float, float]


class LaneMetric:
    """Scores of lane markings, an image at a time; some twenty integers an image are kept.

    Args:
        widths: Label widths in pixels for the IoU at width.
        tolerances: Pixels, for the boundary F.
        tolerance: Pixels, for tolerant precision and recall.

    Raises:
        ConfigError: If a width is below 1 or a tolerance negative.
    """

    def __init__(
        self, widths: Sequence[int] = (2, 8), tolerances: Sequence[float] = (1, 2, 5), tolerance: float = 2
    ) -> None:
        if any(width < 1 for width in widths) or any(value < 0 for value in (*tolerances, tolerance)):
            raise ConfigError(f"widths must be at least 1 and tolerances at least 0, got {widths}, {tolerances}")
        self.widths = tuple(widths)
        self.tolerances = tuple(tolerances)
        self.tolerance = tolerance
        self._pixels = SegmentationMetric()
        self._widths = Rows(4 * len(self.widths))
        # predicted, near a true one, true, near a predicted one: first tolerant pixels, then boundaries a tolerance
        self._near = Rows(4 * (1 + len(self.tolerances)))

    def __len__(self) -> int:
        return len(self._pixels)

    def update(
        self, prediction: NDArray[Any] | None, truth: NDArray[Any] | None, valid: NDArray[np.bool_] | None = None
    ) -> float | None:
        """Add an image.

        Args:
            prediction: (H, W) bool, or uint8 with foreground above 0; None if the model gave none.
            truth: Likewise; None = not labelled.
            valid: (H, W) bool: pixels that count.

        Returns:
            The image's tolerant F1; None where the image does not count.

        Raises:
            ShapeError: If the masks are of different sizes.
        """
        counts = None
        if prediction is not None and truth is not None:
            margin = max((1, *self.widths)) // 2 + 1
            whole = as_binary(prediction), as_binary(truth)
            # Lines are thinned, drawn and compared whole; what is ignored is left out of the counts alone.
            check_valid(truth, valid)
            seen = None if valid is None or valid.all() else as_binary(valid)
            pixels = whole[0].size if seen is None else cv2.countNonZero(seen)
            inside = _content(*whole, margin)
            predicted, true = (np.ascontiguousarray(mask[inside]) for mask in whole)
            if seen is not None:
                seen = np.ascontiguousarray(seen[inside])
            counts = confusion(_cut(predicted, seen), _cut(true, seen), pixels)
        self._pixels.add(counts)
        if counts is None or not any(counts[:3]):
            self._widths.append(np.zeros(4 * len(self.widths), np.int64))
            self._near.append(np.zeros(4 * (1 + len(self.tolerances)), np.int64))
            return None
        centre = thin(true) if self.widths else true
        self._widths.append(
            [
                count
                for width in self.widths
                for count in confusion(_cut(predicted, seen), _cut(draw_at_width(centre, width), seen))
            ]
        )
        near = _near_counts(predicted, true, self.tolerance, seen)
        edges = boundary(predicted), boundary(true)
        rows = list(near)
        for tolerance in self.tolerances:
            rows.extend(_near_counts(*edges, tolerance, seen))
        self._near.append(rows)
        return float(_tolerant(np.array([near], np.float64))[2][0])

    def figures(self, weights: NDArray[Any] | None = None) -> dict[str, FloatArray]:
        """Return scores by name under R weightings of the images at once.

        Args:
            weights: (R, N) how often each image counts; None for once each.

        Returns:
            Name -> (R,).
        """
        figures = self._pixels.figures(weights)
        del figures["miou"]
        widths = weighted_sum(self._widths.array, weights)
        for index, width in enumerate(self.widths):
            tp, fp, fn, _ = widths[:, 4 * index : 4 * index + 4].T
            figures[f"iou_width_{width}"] = ratio(tp, tp + fp + fn)
        near = weighted_sum(self._near.array, weights)
        precision, recall, f1 = _tolerant(near[:, :4])
        figures |= {
            f"precision_{self.tolerance:g}px": precision,
            f"recall_{self.tolerance:g}px": recall,
            f"f1_{self.tolerance:g}px": f1,
        }
        for index, tolerance in enumerate(self.tolerances):
            figures[f"boundary_f_{tolerance:g}px"] = _tolerant(near[:, 4 * index + 4 : 4 * index + 8])[2]
        return figures

    def compute(self) -> LaneScores:
        """Return the scores over all images."""
        figures = {name: float(value[0]) for name, value in self.figures().items()}
        return LaneScores(
            as_labelled=self._pixels.compute(),
            iou_at_width={width: figures[f"iou_width_{width}"] for width in self.widths},
            tolerance=self.tolerance,
            precision=figures[f"precision_{self.tolerance:g}px"],
            recall=figures[f"recall_{self.tolerance:g}px"],
            f1=figures[f"f1_{self.tolerance:g}px"],
            boundary_f={value: figures[f"boundary_f_{value:g}px"] for value in self.tolerances},
        )

    def state(self) -> dict[str, Any]:
        """Return the counts an image, as ``json.dumps`` takes them."""
        return {
            "widths": list(self.widths),
            "tolerances": list(self.tolerances),
            "tolerance": self.tolerance,
            "pixels": self._pixels.state(),
            "width_counts": self._widths.pack(),
            "near_counts": self._near.pack(),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> LaneMetric:
        """Read what `state` returned."""
        metric = cls(state["widths"], state["tolerances"], state["tolerance"])
        metric._pixels = SegmentationMetric.from_state(state["pixels"])
        if metric.widths:
            metric._widths.unpack(state["width_counts"])
        else:
            metric._widths.append(np.zeros((len(metric._pixels), 0)))
        metric._near.unpack(state["near_counts"])
        return metric


def _content(prediction: NDArray[np.uint8], truth: NDArray[np.uint8], margin: int) -> tuple[slice, slice]:
    """Return the rectangle that holds every foreground pixel of either mask, with ``margin`` pixels to spare."""
    if prediction.shape != truth.shape:
        raise ShapeError(f"prediction of {prediction.shape} against truth of {truth.shape}")
    left, top, width, height = cv2.boundingRect(cv2.bitwise_or(prediction, truth))
    rows = slice(max(top - margin, 0), top + height + margin)
    return rows, slice(max(left - margin, 0), left + width + margin)


def _cut(mask: NDArray[np.uint8], seen: NDArray[np.uint8] | None) -> NDArray[np.uint8]:
    """Return the mask where it is seen, all of it without ``seen``."""
    return mask if seen is None else np.asarray(cv2.bitwise_and(mask, seen), np.uint8)


def _near_counts(
    prediction: NDArray[np.uint8], truth: NDArray[np.uint8], radius: float, seen: NDArray[np.uint8] | None
) -> tuple[int, int, int, int]:
    """Return predicted pixels, those near a true one, true pixels, those near a predicted one; of the seen ones."""
    predicted, true = _cut(prediction, seen), _cut(truth, seen)
    return (
        cv2.countNonZero(predicted),
        cv2.countNonZero(cv2.bitwise_and(predicted, _near(truth, radius))),
        cv2.countNonZero(true),
        cv2.countNonZero(cv2.bitwise_and(true, _near(prediction, radius))),
    )


def _tolerant(near: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return precision, recall and F1 of (R, 4) sums of `_near_counts`."""
    predicted, predicted_near, true, true_near = near.T
    precision, recall = ratio(predicted_near, predicted), ratio(true_near, true)
    # 0 where nothing is predicted or nothing is there: then one side has all its pixels unmatched.
    harmonic = ratio(2 * np.nan_to_num(precision) * np.nan_to_num(recall), np.nan_to_num(precision + recall))
    f1 = np.where(predicted + true > 0, np.nan_to_num(harmonic), np.nan)
    return precision, recall, f1
