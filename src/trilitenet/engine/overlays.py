"""Pictures of one task's errors on one image, small enough to keep the worst of a data set in memory."""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.config import Task
from trilitenet.engine.scoring import LabelledImage
from trilitenet.metrics.detection import in_regions, match_boxes
from trilitenet.metrics.segmentation import as_binary
from trilitenet.processing.boxes import lie_on_mask
from trilitenet.structures import Boxes, Perception

__all__ = ["FALSE", "IGNORED", "MISSED", "RIGHT", "error_overlay", "shrunken"]

RIGHT: Final = (0, 158, 115)
"""RGB of what prediction and truth share (colours of Okabe and Ito, told apart with colour-blind eyes)."""
FALSE: Final = (213, 94, 0)
"""RGB of what only the prediction has."""
MISSED: Final = (86, 180, 233)
"""RGB of what only the truth has."""
IGNORED: Final = (150, 150, 150)
"""RGB of ignored regions."""
_WIDTH: Final = 480


def shrunken(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an (H, W, 3) image shrunk by a whole number, so that it is at most 480 pixels across."""
    height, full = image.shape[:2]
    scale = 1 / -(-full // _WIDTH)
    return _shrink(image, (max(1, round(full * scale)), max(1, round(height * scale))))


def _shrink(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Shrink to (width, height), halving as often as that leaves enough: OpenCV halves ten times faster."""
    while image.shape[1] >= 2 * size[0] and image.shape[0] >= 2 * size[1]:
        half = (image.shape[1] // 2, image.shape[0] // 2)
        image = np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.uint8)


def error_overlay(
    small: NDArray[np.uint8],
    sample: LabelledImage,
    prediction: Perception,
    task: Task,
    *,
    confidence: float,
    quality: int = 80,
) -> bytes:
    """Draw right, false and missed in three colours.

    Args:
        small: The sample's image, as `shrunken` makes it; it stays as it is.
        sample: The labels.
        prediction: In pixels of the sample's image.
        task: The task to show.
        confidence: Boxes above this are drawn.
        quality: Of the JPEG, 1 to 100.

    Returns:
        The bytes of a JPEG file.
    """
    picture = small.copy()
    if task == "detection":
        _draw_boxes(picture, sample, prediction, confidence, small.shape[1] / sample.image.shape[1])
    else:
        predicted, true = getattr(prediction, task), getattr(sample, task)
        if predicted is not None and true is not None:
            counted = sample.counted(task)
            _draw_masks(picture, as_binary(predicted, counted), as_binary(true, counted), thick=task == "lane")
    encoded = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return bytes(np.asarray(encoded, np.uint8))


_BY_PREDICTED_AND_TRUE: Final = np.array([(0, 0, 0), FALSE, MISSED, RIGHT], np.uint8)


def _draw_masks(picture: NDArray[np.uint8], predicted: NDArray[np.uint8], true: NDArray[np.uint8], thick: bool) -> None:
    # Thin lines survive the shrinking when any share of a pixel counts.
    limit, opacity = (40, 0.85) if thick else (127, 0.5)
    first, second = (_shrink(mask * np.uint8(255), picture.shape[1::-1]) > limit for mask in (predicted, true))
    which = first.view(np.uint8) + 2 * second.view(np.uint8)
    coloured = cv2.addWeighted(picture, 1 - opacity, _BY_PREDICTED_AND_TRUE[which], opacity, 0)
    cv2.copyTo(coloured, which, picture)


def _draw_boxes(
    picture: NDArray[np.uint8], sample: LabelledImage, prediction: Perception, confidence: float, scale: float
) -> None:
    found, predicted = Boxes.empty(), prediction.boxes
    if predicted is not None:
        best = np.argsort(-predicted.confidence, kind="stable")
        found = predicted.select(best[predicted.confidence[best] > confidence])
    truth, classes = np.zeros((0, 4)), np.zeros(0, np.int64)
    if sample.boxes is not None and sample.class_id is not None:
        truth, classes = np.asarray(sample.boxes, np.float64), sample.class_id
    target = match_boxes(found.xyxy, found.class_id, truth, classes)
    right = target >= 0
    right[right] = classes[target[right]] == found.class_id[right]
    excused = in_regions(found.xyxy, sample.ignored)
    if sample.valid is not None and len(found):
        excused |= lie_on_mask(found.xyxy, ~sample.valid)
    for region in np.asarray(sample.ignored, np.float64):
        _rectangle(picture, region, scale, IGNORED)
    for box in np.delete(truth, target[right], axis=0):
        _rectangle(picture, box, scale, MISSED)
    for box in found.xyxy[~right & ((target >= 0) | ~excused)]:
        _rectangle(picture, box, scale, FALSE)
    for box in found.xyxy[right]:
        _rectangle(picture, box, scale, RIGHT)


def _rectangle(picture: NDArray[np.uint8], box: NDArray[Any], scale: float, colour: tuple[int, int, int]) -> None:
    left, top, right, bottom = (round(float(value) * scale) for value in box)
    cv2.rectangle(picture, (left, top), (right, bottom), colour, 2, cv2.LINE_AA)
