"""Every metric of a protocol fed by one call an image, whoever made the predictions."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import TASKS, Task
from trilitenet.errors import ShapeError
from trilitenet.metrics.detection import DetectionMetric, DetectionScores
from trilitenet.metrics.lane import LaneMetric, LaneScores
from trilitenet.metrics.published import (
    PublishedDetection,
    PublishedDetectionScores,
    PublishedSegmentation,
    PublishedSegmentationScores,
)
from trilitenet.metrics.segmentation import SegmentationMetric, SegmentationScores
from trilitenet.processing.boxes import lie_on_mask
from trilitenet.processing.letterbox import Letterbox
from trilitenet.structures import Boxes, Perception

__all__ = [
    "CanvasPrediction",
    "FairMetrics",
    "FairScores",
    "ImageOutcome",
    "LabelledImage",
    "PaperMetrics",
    "PaperScores",
    "add_boxes",
]


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
    def counted(self, task: Literal["drivable", "lane"]) -> NDArray[np.bool_] | None: ...  # noqa: D102
    @property
    def attributes(self) -> dict[str, str]: ...  # noqa: D102


def add_boxes(metric: DetectionMetric, sample: LabelledImage, boxes: Boxes | None) -> tuple[int, int, int] | None:
    """Add an image to a detection metric: boxes that lie by more than half on the own car are not wrong.

    Args:
        metric: To add to.
        sample: The labels.
        boxes: Predicted, in pixels of the sample's image; None if the model gave none.

    Returns:
        See `DetectionMetric.update`.
    """
    labels = sample.boxes, sample.class_id, sample.ignored
    if boxes is None:
        return metric.update(None, None, None, *labels)
    neutral = None if sample.valid is None or not len(boxes) else lie_on_mask(boxes.xyxy, ~sample.valid)
    return metric.update(boxes.xyxy, boxes.confidence, boxes.class_id, *labels, neutral)


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


class _ByTask:
    """Metrics of up to three tasks; None for one that is not scored."""

    detection: Any
    drivable: Any
    lane: Any

    def figures(self, weights: NDArray[Any] | None = None) -> dict[str, NDArray[np.float64]]:
        """Return scores by name, ``task/figure``, under R weightings of the images at once (see the metrics)."""
        return {
            f"{task}/{name}": value
            for task, metric in self._by_task().items()
            for name, value in metric.figures(weights).items()
        }

    def _by_task(self) -> dict[Task, Any]:
        return {task: metric for task in TASKS if (metric := getattr(self, task)) is not None}

    def _scores(self) -> dict[Task, Any]:
        metrics = self._by_task()
        return {task: metrics[task].compute() if task in metrics else None for task in TASKS}


class FairMetrics(_ByTask):
    """The 'fair' protocol: native resolution, one confusion matrix over the data set, COCO matching.

    Args:
        class_names: Detection classes.
        tasks: Tasks to score.
        confidence: The stated confidence for precision, recall and F1 of detection.
        lowest: Boxes below this confidence may have been cut off.
    """

    def __init__(
        self, class_names: Sequence[str], tasks: Sequence[Task], *, confidence: float = 0.25, lowest: float = 0.0
    ) -> None:
        self.detection = DetectionMetric(class_names, confidence, lowest=lowest) if "detection" in tasks else None
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
            counts = add_boxes(self.detection, sample, prediction.boxes)
            if counts is not None:
                right, wrong, missed = counts
                if sum(counts):
                    detection = 2 * right / (2 * right + wrong + missed)
        if self.drivable is not None:
            pixels = self.drivable.update(prediction.drivable, sample.drivable, sample.counted("drivable"))
            if pixels is not None and any(pixels[:3]):
                drivable = pixels[0] / sum(pixels[:3])
        if self.lane is not None:
            lane = self.lane.update(prediction.lane, sample.lane, sample.counted("lane"))
        return ImageOutcome(detection, drivable, lane, right, wrong, missed)

    def compute(self) -> FairScores:
        """Return the scores over all images."""
        return FairScores(**self._scores())

    def state(self) -> dict[str, Any]:
        """Return what was kept of each image, as ``json.dumps`` takes it."""
        return {task: metric.state() for task, metric in self._by_task().items()}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> FairMetrics:
        """Read what `state` returned."""
        metrics = cls((), ())
        if "detection" in state:
            metrics.detection = DetectionMetric.from_state(state["detection"])
        if "drivable" in state:
            metrics.drivable = SegmentationMetric.from_state(state["drivable"])
        if "lane" in state:
            metrics.lane = LaneMetric.from_state(state["lane"])
        return metrics


@dataclasses.dataclass(frozen=True)
class PaperScores:
    """Scores under the 'paper' protocol; None for a task that was not scored.

    Attributes:
        batch_size: Images a batch of the averages; batches follow the order of the images.
        detection: Recall and average precision as published.
        drivable: Figures as published, and over the data set.
        lane: Likewise.
    """

    batch_size: int
    detection: PublishedDetectionScores | None
    drivable: PublishedSegmentationScores | None
    lane: PublishedSegmentationScores | None


@dataclasses.dataclass(frozen=True, eq=False)
class CanvasPrediction:
    """What the 'paper' protocol compares: masks at the size that the image has inside the canvas.

    Attributes:
        boxes: In pixels of the source image, down to the published confidence; None without the task.
        drivable: (h, w) bool, padding cropped; None without the task.
        lane: Likewise.
        letterbox: How the image was fitted into the canvas.
    """

    boxes: Boxes | None
    drivable: NDArray[np.bool_] | None
    lane: NDArray[np.bool_] | None
    letterbox: Letterbox


class PaperMetrics(_ByTask):
    """The 'paper' protocol: the published evaluation, with its averages over batches.

    Args:
        classes: Number of detection classes.
        tasks: Tasks to score.
        batch_size: Images a batch of the averages.
    """

    def __init__(self, classes: int, tasks: Sequence[Task], *, batch_size: int = 16) -> None:
        self.batch_size = batch_size
        self.detection = PublishedDetection(classes) if "detection" in tasks else None
        self.drivable = PublishedSegmentation(batch_size) if "drivable" in tasks else None
        self.lane = PublishedSegmentation(batch_size) if "lane" in tasks else None

    def update(self, sample: LabelledImage, prediction: CanvasPrediction) -> None:
        """Add an image; images come in the order that batches are made of."""
        letterbox = prediction.letterbox
        if self.detection is not None:
            truth, truth_class = sample.boxes, sample.class_id
            if truth is not None and truth_class is not None and self.detection.classes == 1:
                # The published reader knows no ignored regions: they are objects to it.
                truth = np.concatenate([truth, sample.ignored])
                truth_class = np.zeros(len(truth), np.int64)
            boxes = prediction.boxes
            self.detection.update(
                None if boxes is None else boxes.xyxy,
                None if boxes is None else boxes.confidence,
                None if boxes is None else boxes.class_id,
                truth,
                truth_class,
            )
        for metric, mask, true in (
            (self.drivable, prediction.drivable, sample.drivable),
            (self.lane, prediction.lane, sample.lane),
        ):
            if metric is not None:
                metric.update(mask, None if true is None else letterbox.mask(true * np.uint8(255))[letterbox.inside])

    def compute(self) -> PaperScores:
        """Return the scores over all images."""
        return PaperScores(self.batch_size, **self._scores())

    def state(self) -> dict[str, Any]:
        """Return what was kept of each image, as ``json.dumps`` takes it."""
        return {"batch_size": self.batch_size} | {task: metric.state() for task, metric in self._by_task().items()}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> PaperMetrics:
        """Read what `state` returned."""
        metrics = cls(1, (), batch_size=state["batch_size"])
        if "detection" in state:
            metrics.detection = PublishedDetection.from_state(state["detection"])
        if "drivable" in state:
            metrics.drivable = PublishedSegmentation.from_state(state["drivable"])
        if "lane" in state:
            metrics.lane = PublishedSegmentation.from_state(state["lane"])
        return metrics
