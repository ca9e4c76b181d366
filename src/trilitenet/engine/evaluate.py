"""Evaluate any predictor on any labelled images: PyTorch, ONNX and INT8 are scored by the same lines."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ModelCard, Thresholds
from trilitenet.engine.scoring import FairMetrics, FairScores, LabelledImage
from trilitenet.errors import DataError
from trilitenet.metrics.detection import DetectionMetric
from trilitenet.processing.letterbox import Letterbox
from trilitenet.processing.postprocess import select_boxes, to_perceptions
from trilitenet.structures import RawOutputs

__all__ = [
    "LOWEST_CONFIDENCE",
    "BestThresholds",
    "EvaluatedPredictor",
    "LabelledImages",
    "best_thresholds",
    "evaluate",
]

LOWEST_CONFIDENCE: Final = 0.001
"""Boxes down to this confidence are scored (the published one); average precision needs the doubtful ones too."""


class _Backend(Protocol):
    @property
    def card(self) -> ModelCard: ...
    @property
    def name(self) -> str: ...
    def run(self, batch: NDArray[np.uint8]) -> RawOutputs: ...


class EvaluatedPredictor(Protocol):
    """What evaluation needs of a predictor; `trilitenet.inference.predictor.Predictor` is one."""

    thresholds: Thresholds

    @property
    def backend(self) -> _Backend:
        """The network on a runtime."""

    def preprocess(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Letterbox]:
        """Letterbox an (H, W, 3) uint8 RGB image."""


class LabelledImages(Protocol):
    """Labelled images by index; `trilitenet.data.reading.DrivingDataset` is such."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names that the labels' class ids index."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: int) -> LabelledImage: ...


def evaluate(
    predictor: EvaluatedPredictor,
    dataset: LabelledImages,
    *,
    batch_size: int = 1,
    limit: int | None = None,
) -> FairScores:
    """Score a predictor."""
    card = predictor.backend.card
    metrics = FairMetrics(card.class_names, card.tasks, confidence=predictor.thresholds.confidence)
    low = dataclasses.replace(predictor.thresholds, confidence=LOWEST_CONFIDENCE)
    for samples, letterboxes, raw in _outputs(predictor, dataset, batch_size, limit):
        for sample, prediction in zip(samples, to_perceptions(raw, letterboxes, low, card.class_names), strict=True):
            metrics.update(sample, prediction)
    return metrics.compute()


@dataclasses.dataclass(frozen=True)
class BestThresholds:
    """Thresholds that do best on a split, and how well they do there.

    Attributes:
        thresholds: With the confidence, the drivable and the lane threshold replaced.
        detection_f1: Best F1 at IoU 0.5, in [0, 1]; NaN without labels.
        drivable_iou: Best IoU over the split, in [0, 1]; NaN without labels.
        lane_iou: Likewise.
    """

    thresholds: Thresholds
    detection_f1: float
    drivable_iou: float
    lane_iou: float


def best_thresholds(
    predictor: EvaluatedPredictor, dataset: LabelledImages, *, batch_size: int = 1, limit: int | None = None
) -> BestThresholds:
    """Find the threshold a task that does best on a validation split, in one pass.

    The confidence is the one of best F1 at IoU 0.5 (half way to the next box below), the others those of best
    foreground IoU over the split, at the images' own size, exact to 1/255.

    Args:
        predictor: Its own thresholds stay where there is nothing to tell from.
        dataset: Labelled images; a split that is reported on as held out must not be used.
        batch_size: At most so many images go through the network at once.
        limit: Only the first so many images.
    """
    card = predictor.backend.card
    low = dataclasses.replace(predictor.thresholds, confidence=LOWEST_CONFIDENCE)
    detection = DetectionMetric(card.class_names)
    counts = {task: np.zeros((2, 256), np.int64) for task in ("drivable", "lane")}
    for samples, letterboxes, raw in _outputs(predictor, dataset, batch_size, limit):
        for index, (sample, letterbox) in enumerate(zip(samples, letterboxes, strict=True)):
            if raw.detection is not None:
                boxes = select_boxes(raw.detection[index], letterbox, low)
                detection.update(
                    boxes.xyxy, boxes.confidence, boxes.class_id, sample.boxes, sample.class_id, sample.ignored
                )
            for task, masks, truth in (("drivable", raw.drivable, sample.drivable), ("lane", raw.lane, sample.lane)):
                if masks is not None and truth is not None:
                    counts[task] += _probability_counts(letterbox.mask_to_source(masks[index]), truth, sample.valid)
    drivable, drivable_iou = _best_cut(counts["drivable"], predictor.thresholds.drivable)
    lane, lane_iou = _best_cut(counts["lane"], predictor.thresholds.lane)
    confidence, f1 = _best_confidence(detection, predictor.thresholds.confidence)
    return BestThresholds(
        dataclasses.replace(predictor.thresholds, confidence=confidence, drivable=drivable, lane=lane),
        f1,
        drivable_iou,
        lane_iou,
    )


def _probability_counts(
    probability: NDArray[np.uint8], truth: NDArray[np.uint8], valid: NDArray[np.bool_] | None
) -> NDArray[np.int64]:
    """Return (2, 256) pixels by truth and by probability x 255."""
    joint = probability.astype(np.uint16) + (truth.astype(np.uint16) << 8)
    picked = joint.ravel() if valid is None else joint[valid]
    return np.bincount(picked, minlength=512).reshape(2, 256)


def _best_cut(counts: NDArray[np.int64], default: float) -> tuple[float, float]:
    """Return the threshold in [0, 1] of best IoU, and that IoU."""
    above = counts[:, ::-1].cumsum(axis=1)[:, ::-1]  # pixels with at least that probability
    total = counts[1].sum()
    if not total:
        return default, float("nan")
    iou = above[1, 1:] / (total + above[0, 1:])
    best = int(iou.argmax()) + 1  # foreground from this value up
    return round((best - 0.5) / 255, 4), float(iou[best - 1])


def _best_confidence(detection: DetectionMetric, default: float) -> tuple[float, float]:
    curve = detection.curve()
    best = detection.compute().best
    if not len(curve.confidence) or np.isnan(best.f1):
        return default, float("nan")
    at = int(np.flatnonzero(curve.confidence == best.confidence)[0])
    below = curve.confidence[at + 1] if at + 1 < len(curve.confidence) else 0.0
    return round(float((best.confidence + below) / 2), 6), best.f1


_Outputs = tuple[list[LabelledImage], list[Letterbox], RawOutputs]


def _outputs(
    predictor: EvaluatedPredictor, dataset: LabelledImages, batch_size: int, limit: int | None
) -> Iterator[_Outputs]:
    """Yield samples with what the network makes of them; reading goes on in a second thread meanwhile."""
    count = len(dataset) if limit is None else min(limit, len(dataset))
    if not count:
        raise DataError("no images to evaluate on")
    samples: list[LabelledImage] = []
    canvases: list[NDArray[np.uint8]] = []
    letterboxes: list[Letterbox] = []
    for sample in _ahead(dataset, range(count), 2 * batch_size + 2):
        canvas, letterbox = predictor.preprocess(sample.image)
        if samples and (len(samples) == batch_size or canvas.shape != canvases[0].shape):
            yield samples, letterboxes, predictor.backend.run(_stack(canvases))
            samples, canvases, letterboxes = [], [], []
        samples.append(sample)
        canvases.append(canvas)
        letterboxes.append(letterbox)
    yield samples, letterboxes, predictor.backend.run(_stack(canvases))


def _stack(canvases: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    return canvases[0][None] if len(canvases) == 1 else np.stack(canvases)


def _ahead(dataset: LabelledImages, order: Iterable[int], depth: int) -> Iterator[LabelledImage]:
    """Yield samples in order, reading up to ``depth`` ahead."""
    with ThreadPoolExecutor(1, thread_name_prefix="reader") as pool:
        waiting: collections.deque[Future[LabelledImage]] = collections.deque()
        try:
            for index in order:
                waiting.append(pool.submit(dataset.__getitem__, index))
                if len(waiting) > depth:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
