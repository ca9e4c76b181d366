"""From what a backend returns to what a user gets: thresholds, non-maximum suppression, and back to source pixels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import Thresholds
from trilitenet.errors import ShapeError
from trilitenet.processing.boxes import cxcywh_to_xyxy
from trilitenet.processing.letterbox import Letterbox
from trilitenet.processing.nms import nms
from trilitenet.structures import Boxes, Perception, RawOutputs

__all__ = ["judge", "mask_limit", "select_boxes", "threshold_mask", "to_perceptions"]


def to_perceptions(
    raw: RawOutputs,
    letterboxes: Sequence[Letterbox],
    thresholds: Thresholds,
    class_names: tuple[str, ...],
    images: Sequence[NDArray[np.uint8]] | None = None,
    sources: Sequence[str | None] | None = None,
) -> list[Perception]:
    """Turn the raw outputs of a batch into one `Perception` an image, in pixels of the source images.

    Args:
        raw: Outputs for B images, with masks as probability x 255. Those of an exported artefact are not (0 and 1, by
            default): `trilitenet.inference.exported.gather_outputs` makes them so.
        letterboxes: How each of the B images was fitted into the canvas.
        thresholds: What counts as an object, as drivable and as lane.
        class_names: Names of the detection classes.
        images: The B source images, (height, width, 3) uint8 RGB, to keep for drawing.
        sources: Where each image came from.

    Raises:
        ShapeError: If a raw output is for another number of images.
    """
    for name in ("detection", "drivable", "lane"):
        output = getattr(raw, name)
        if output is not None and len(output) != len(letterboxes):
            raise ShapeError(f"{name} is for {len(output)} images, there are {len(letterboxes)}")
    return [
        Perception(
            size=letterbox.source,
            class_names=class_names,
            boxes=None if raw.detection is None else select_boxes(raw.detection[i], letterbox, thresholds),
            drivable=None if raw.drivable is None else threshold_mask(raw.drivable[i], letterbox, thresholds.drivable),
            lane=None if raw.lane is None else threshold_mask(raw.lane[i], letterbox, thresholds.lane),
            image=None if images is None else images[i],
            source=None if sources is None else sources[i],
        )
        for i, letterbox in enumerate(letterboxes)
    ]


def judge(rows: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return the (N,) most probable classes of (N, 5 + classes) rows, and objectness x their probability."""
    class_id = rows[:, 5:].argmax(axis=1)
    return class_id, rows[:, 4] * np.take_along_axis(rows[:, 5:], class_id[:, None], axis=1)[:, 0]


def select_boxes(detection: NDArray[np.float32], letterbox: Letterbox, thresholds: Thresholds) -> Boxes:
    """Pick the boxes of one image.

    A box has the class of its highest probability, and the confidence objectness x that probability.

    Args:
        detection: (N, 5 + classes): centre x, centre y, width, height in canvas pixels, objectness, class
            probabilities.
        letterbox: How the image was fitted into the canvas.
        thresholds: Confidence, overlap and number of boxes.

    Returns:
        Boxes in pixels of the source image, clipped to it, best first; those wholly in the padding are gone.
    """
    candidates = detection[detection[:, 4] > thresholds.confidence]
    class_id, scores = judge(candidates)
    keep = scores > thresholds.confidence
    candidates, class_id, scores = candidates[keep], class_id[keep], scores[keep]
    xyxy = cxcywh_to_xyxy(candidates[:, :4])
    source = letterbox.boxes_to_source(xyxy)
    visible = ((source[:, 2] > source[:, 0]) & (source[:, 3] > source[:, 1])).nonzero()[0]
    kept = visible[nms(xyxy[visible], scores[visible], class_id[visible], thresholds.iou, thresholds.max_boxes)]
    return Boxes(
        xyxy=source[kept],
        confidence=np.minimum(scores[kept], 1.0).astype(np.float32),
        class_id=class_id[kept].astype(np.int64),
    )


def mask_limit(threshold: float) -> int:
    """Return the highest probability x 255, rounded to a whole number, that is not above a threshold in [0, 1].

    A whole number is above 255 t exactly when it is above the integer part of that.
    """
    return int(threshold * 255)


def threshold_mask(mask: NDArray[np.uint8], letterbox: Letterbox, threshold: float) -> NDArray[np.bool_]:
    """Decide each pixel of the source image.

    Args:
        mask: (canvas height, canvas width) uint8, probability x 255; where it was decided before, 0 or 255, not 1.
        letterbox: How the image was fitted into the canvas.
        threshold: True where the probability is above this, in [0, 1].

    Returns:
        (height, width) bool of the source size.
    """
    decided: NDArray[np.bool_] = letterbox.mask_to_source(mask) > np.uint8(mask_limit(threshold))
    return decided
