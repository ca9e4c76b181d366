"""Every metric of a protocol fed by one call an image, whoever made the predictions."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import Task
from trilitenet.errors import ShapeError
from trilitenet.metrics.detection import DetectionMetric, DetectionScores
from trilitenet.metrics.lane import LaneMetric, LaneScores
from trilitenet.metrics.segmentation import SegmentationMetric, SegmentationScores
from trilitenet.structures import Perception

__all__ = ["FairMetrics", "FairScores", "ImageOutcome", "LabelledImage"]


class LabelledImage(Protocol):
    """What scoring needs of a sample; `trilitenet.data.sample.Sample` has it all and says what it means."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def image(self) -> NDArray[np.uint8]: ...  # noqa: D102
    @property
    def boxes(self) -> NDArray[np.float32] | None: ...  # noqa: D102
    @property
    def class_id(self) -> NDArray[np.int64] | None: ...  # noqa: D102
    @property
    def ignored(self) -> NDArray[np.float32]: ...  # noqa: D102
    @property
    def drivable(self) -> NDArray[np.uint8] | None: ...  # noqa: D102
    @property
    def lane(self) -> NDArray[np.uint8] | None: ...  # noqa: D102
    @property
    def valid(self) -> NDArray[np.bool_] | None: ...  # noqa: D102
    @property
    def attributes(self) -> dict[str, str]: ...  # noqa: D102


@dataclasses.dataclass(frozen=True)
class FairScores:
    """Scores under the 'fair' protocol; None for a task that was not scored.

    Attributes:
        detection: COCO matching at the images' own size.
        drivable: One confusion matrix over the data set, at the images' own size.
        lane: Likewise, with label widths and tolerances.
    """

    detection: DetectionScores | None
    drivable: SegmentationScores | None
    lane: LaneScores | None


@dataclasses.dataclass(frozen=True)
class ImageOutcome:
    """How one image went, each in [0, 1] and higher is better; None where the image does not count.

    Attributes:
        detection: F1 at the stated confidence and IoU 0.5.
        drivable: Foreground IoU.
        lane: Tolerant F1.
        right: Right boxes at the stated confidence.
        wrong: Wrong ones.
        missed: Objects not found.
    """

    detection: float | None
    drivable: float | None
    lane: float | None
    right: int = 0
    wrong: int = 0
    missed: int = 0


class FairMetrics:
    """The 'fair' protocol: native resolution, one confusion matrix over the data set, COCO matching.

    Args:
        class_names: Detection classes.
        tasks: Tasks to score.
        confidence: The stated confidence for precision, recall and F1 of detection.
        max_boxes: At most so many boxes an image and class.
    """

    name = "fair"

    def __init__(
        self, class_names: Sequence[str], tasks: Sequence[Task], *, confidence: float = 0.25, max_boxes: int = 300
    ) -> None:
        self.detection = DetectionMetric(class_names, confidence, max_boxes) if "detection" in tasks else None
        self.drivable = SegmentationMetric() if "drivable" in tasks else None
        self.lane = LaneMetric() if "lane" in tasks else None

    def update(self, sample: LabelledImage, prediction: Perception) -> ImageOutcome:
        """Add an image.

        Args:
            sample: The labels.
            prediction: In pixels of the sample's image, with boxes down to the lowest confidence.

        Raises:
            ShapeError: If the prediction is for an image of another size.
        """
        if prediction.size != sample.image.shape[:2]:
            raise ShapeError(
                f"{sample.name}: prediction for {prediction.size} (height, width), "
                f"the image has {sample.image.shape[:2]}"
            )
        detection = drivable = lane = None
        right = wrong = missed = 0
        if self.detection is not None:
            boxes = prediction.boxes
            counts = self.detection.update(
                None if boxes is None else boxes.xyxy,
                None if boxes is None else boxes.confidence,
                None if boxes is None else boxes.class_id,
                sample.boxes,
                sample.class_id,
                sample.ignored,
            )
            if counts is not None:
                right, wrong, missed = counts
                if sum(counts):
                    detection = 2 * right / (2 * right + wrong + missed)
        if self.drivable is not None:
            pixels = self.drivable.update(prediction.drivable, sample.drivable, sample.valid)
            if pixels is not None and any(pixels[:3]):
                drivable = pixels[0] / sum(pixels[:3])
        if self.lane is not None:
            lane = self.lane.update(prediction.lane, sample.lane, sample.valid)
        return ImageOutcome(detection, drivable, lane, right, wrong, missed)

    def compute(self) -> FairScores:
        """Return the scores over all images."""
        return FairScores(
            detection=None if self.detection is None else self.detection.compute(),
            drivable=None if self.drivable is None else self.drivable.compute(),
            lane=None if self.lane is None else self.lane.compute(),
        )

    def figures(self, weights: NDArray[Any] | None = None) -> dict[str, NDArray[np.float64]]:
        """Return scores by name, ``task/figure``, under R weightings of the images at once."""
        return {
            f"{task}/{name}": value
            for task, metric in (("detection", self.detection), ("drivable", self.drivable), ("lane", self.lane))
            if metric is not None
            for name, value in metric.figures(weights).items()
        }
