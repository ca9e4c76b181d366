"""Evaluate any predictor on any labelled images: PyTorch, ONNX and INT8 are scored by the same lines.

    report = evaluate(predictor, dataset)                    # protocol="fair"
    report.fair.drivable.miou, report.fair.lane.f1, report.fair.detection.ap50
    sys.stdout.write(report.summary())

Reading goes ahead in one thread, scoring follows in another, and the network runs in one or several between them. Of an
image stay counts and some 30 bytes a box.
"""

from __future__ import annotations

import collections
import dataclasses
import datetime
import itertools
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, nullcontext
from typing import Any, Final, Literal, Protocol, TypeVar, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ModelCard, Thresholds
from trilitenet.engine.predictions import SavedPredictions
from trilitenet.engine.provenance import describe_hardware, describe_versions, peak_memory
from trilitenet.engine.report import SAVED, Provenance, Report
from trilitenet.engine.scorecard import CONDITIONS, GROUP, PAPER_THRESHOLDS, Scorecard
from trilitenet.engine.scoring import CanvasPrediction, LabelledImage, add_boxes
from trilitenet.errors import ConfigError, DataError
from trilitenet.metrics.detection import DetectionMetric
from trilitenet.processing.letterbox import Letterbox
from trilitenet.processing.postprocess import select_boxes, threshold_mask
from trilitenet.structures import Perception, RawOutputs

__all__ = [
    "LOWEST_CONFIDENCE",
    "BestThresholds",
    "EvaluatedPredictor",
    "LabelledImages",
    "best_thresholds",
    "evaluate",
    "score_predictions",
]

LOWEST_CONFIDENCE: Final = 0.001
"""Boxes down to this confidence are scored (the published one); average precision needs the doubtful ones too."""

_S = TypeVar("_S")
_T = TypeVar("_T")
_Read = tuple[LabelledImage, NDArray[np.uint8], Letterbox]
_Look = Callable[[LabelledImage, RawOutputs, int, Letterbox], None]
ImageChange = Callable[[NDArray[np.uint8], str], NDArray[np.uint8]]
"""Given an (H, W, 3) uint8 RGB image and its name, returns the image to show to the network, of the same size."""


class RunsBatches(Protocol):
    """What evaluation needs of a backend."""

    @property
    def card(self) -> ModelCard:
        """What the network is."""

    @property
    def name(self) -> str:
        """The runtime and the device."""

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        """Run the network on (B, H, W, 3) uint8 RGB, letterboxed."""


@runtime_checkable
class RunsInParallel(Protocol):
    """A backend that can trade latency for images a second."""

    def in_parallel(self) -> AbstractContextManager[int]:
        """Inside, yield from how many threads at once ``run`` is best called."""


class EvaluatedPredictor(Protocol):
    """What evaluation needs of a predictor; `trilitenet.inference.predictor.Predictor` is one."""

    thresholds: Thresholds

    @property
    def backend(self) -> RunsBatches:
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
    protocol: str = "fair",
    batch_size: int = 1,
    limit: int | None = None,
    resamples: int = 1000,
    seed: int = 0,
    worst: int = 24,
    by: Sequence[str] = CONDITIONS,
    group: str = GROUP,
    paper_batch: int = 16,
    change: ImageChange | None = None,
    on_prediction: Callable[[LabelledImage, Perception], None] | None = None,
    progress: Callable[[int, int], None] | None = None,
    about: Mapping[str, Any] | None = None,
) -> Report:
    """Score a predictor on labelled images.

    Args:
        predictor: Its thresholds decide masks, and state the confidence of precision, recall and F1.
        dataset: In the order that batches of the 'paper' protocol are made of: by name.
        protocol: ``"fair"``, ``"paper"`` or ``"both"``.
        batch_size: At most so many images of one size go through the network at once; figures do not hang on it.
        limit: Only the first so many images.
        resamples: Bootstrap draws for the 95% intervals; 0 for none.
        seed: Of the draws.
        worst: How many of the worst images to keep pictures of, a task; 0 for none.
        by: Attributes to make tables by.
        group: Attribute whose images are drawn together for the intervals; ``"image"`` for each by itself.
        paper_batch: Images a batch of the published averages.
        change: Alters each image before the network sees it (corruptions); labels stay.
        on_prediction: Called with every image and its prediction in pixels of the image, in order.
        progress: Called with how many images are scored, and of how many.
        about: Fields of `Provenance` that only the caller knows: ``model``, ``model_sha256``, ``data``, ``split``,
            ``data_sha256``, ``settings``.

    Raises:
        ConfigError: If there is no such protocol, or the classes of model and data differ.
        DataError: If there are no images.
    """
    card = predictor.backend.card
    check_classes(card, dataset)
    scorecard = Scorecard(
        card.class_names,
        card.tasks,
        protocol=protocol,
        confidence=predictor.thresholds.confidence,
        paper_batch=paper_batch,
        worst=worst,
        by=by,
        group=group,
    )
    started = time.time()
    canvases: dict[tuple[int, int], None] = {}
    native = "fair" in scorecard.protocols or on_prediction is not None

    def score(sample: LabelledImage, raw: RawOutputs, index: int, letterbox: Letterbox) -> None:
        canvases[letterbox.canvas] = None
        perception, canvas = _predictions(
            raw, index, letterbox, predictor.thresholds, card, native=native, published="paper" in scorecard.protocols
        )
        scorecard.add(sample, perception, canvas)
        if on_prediction is not None and perception is not None:
            on_prediction(sample, perception)

    _look_at_each(predictor, dataset, batch_size, limit, score, progress, change)
    details = {
        "model": card.variant,
        "runtime": predictor.backend.name,
        "thresholds": dataclasses.asdict(predictor.thresholds),
        **(about or {}),
    }
    published = dataclasses.asdict(PAPER_THRESHOLDS)
    return _report(scorecard, started, canvases, details, resamples, seed, LOWEST_CONFIDENCE, published)


def score_predictions(
    predictions: SavedPredictions,
    dataset: LabelledImages,
    *,
    protocol: str = "fair",
    confidence: float = 0.25,
    limit: int | None = None,
    resamples: int = 1000,
    seed: int = 0,
    worst: int = 24,
    by: Sequence[str] = CONDITIONS,
    group: str = GROUP,
    paper_batch: int = 16,
    progress: Callable[[int, int], None] | None = None,
    about: Mapping[str, Any] | None = None,
) -> Report:
    """Score saved predictions of any model, by the lines that score a predictor.

    Under the 'paper' protocol masks are brought to the size they would have inside the 640-pixel canvas by area
    interpolation, and count where the greater half of a pixel is foreground.

    Args:
        predictions: As `trilitenet.engine.predictions` describes.
        dataset: Labelled images of the same names, in the order that batches of the 'paper' protocol are made of.
        protocol: ``"fair"``, ``"paper"`` or ``"both"``.
        confidence: The stated confidence of precision, recall and F1.
        limit: Only the first so many images.
        resamples: Bootstrap draws for the 95% intervals; 0 for none.
        seed: Of the draws.
        worst: How many of the worst images to keep pictures of, a task; 0 for none.
        by: Attributes to make tables by.
        group: Attribute whose images are drawn together for the intervals; ``"image"`` for each by itself.
        paper_batch: Images a batch of the published averages.
        progress: Called with how many images are scored, and of how many.
        about: Fields of `Provenance` that only the caller knows.

    Raises:
        ConfigError: If there is no such protocol.
        DataError: If there are no images, or a prediction is broken.
    """
    scorecard = Scorecard(
        dataset.class_names,
        predictions.tasks,
        protocol=protocol,
        confidence=confidence,
        lowest=predictions.lowest,
        paper_batch=paper_batch,
        worst=worst,
        by=by,
        group=group,
    )
    started = time.time()
    count = _count(dataset, limit)
    canvases: dict[tuple[int, int], None] = {}
    scored = _ahead(lambda index: _with_saved(dataset[index], predictions), range(count), 4, "reader")
    for done, (sample, perception) in enumerate(scored, start=1):
        letterbox = Letterbox.fit(perception.size)
        canvases[letterbox.canvas] = None
        scorecard.add(
            sample,
            perception,
            _saved_on_canvas(perception, letterbox) if "paper" in scorecard.protocols else None,
        )
        if progress is not None:
            progress(done, count)
    details = {
        "model": str(predictions.folder),
        "runtime": SAVED,
        "thresholds": {"confidence": confidence},
        **(about or {}),
    }
    published = {"confidence": PAPER_THRESHOLDS.confidence, "max_boxes": PAPER_THRESHOLDS.max_boxes}
    return _report(scorecard, started, canvases, details, resamples, seed, predictions.lowest, published)


def _with_saved(sample: LabelledImage, predictions: SavedPredictions) -> tuple[LabelledImage, Perception]:
    height, width = sample.image.shape[:2]
    return sample, predictions.get(sample.name, (height, width))


def _saved_on_canvas(perception: Perception, letterbox: Letterbox) -> CanvasPrediction:
    def shrink(mask: NDArray[np.bool_] | None) -> NDArray[np.bool_] | None:
        return None if mask is None else letterbox.mask(mask, threshold=127)[letterbox.inside].astype(np.bool_)

    boxes = perception.boxes
    if boxes is not None:
        kept = np.flatnonzero(boxes.confidence > PAPER_THRESHOLDS.confidence)[: PAPER_THRESHOLDS.max_boxes]
        boxes = boxes.select(kept)
    return CanvasPrediction(boxes, shrink(perception.drivable), shrink(perception.lane), letterbox)


def check_classes(card: ModelCard, dataset: LabelledImages) -> None:
    """Refuse labels whose class ids mean something else than the model's.

    Raises:
        ConfigError: If there are several classes and their names differ.
    """
    names = tuple(dataset.class_names)
    if "detection" in card.tasks and names != card.class_names and max(len(names), card.classes) > 1:
        raise ConfigError(
            f"the model has classes {', '.join(card.class_names)}, the labels {', '.join(names)}; "
            "read the data set with the model's classes"
        )


def _count(dataset: LabelledImages, limit: int | None) -> int:
    return len(dataset) if limit is None else min(limit, len(dataset))


def _report(
    scorecard: Scorecard,
    started: float,
    canvases: Iterable[tuple[int, int]],
    about: Mapping[str, Any],
    resamples: int,
    seed: int,
    lowest: float,
    published: Mapping[str, float],
) -> Report:
    """Return the report of what was scored, with what is known of the run: versions, hardware, time and memory.

    Args:
        scorecard: Of all images.
        started: `time.time` at the start.
        canvases: (height, width) of the network's inputs.
        about: Fields of `Provenance`.
        resamples: Bootstrap draws for the intervals.
        seed: Of the draws.
        lowest: Confidence that boxes go down to.
        published: Thresholds that the 'paper' protocol decides with.
    """
    settings: dict[str, Any] = {
        "protocols": list(scorecard.protocols),
        "lowest_confidence": round(lowest, 6),
        "resamples": resamples,
        "seed": seed,
    }
    if scorecard.paper is not None:
        settings |= {"paper_batch": scorecard.paper.batch_size, "paper_thresholds": dict(published)}
    fields: dict[str, Any] = {
        "model_sha256": None,
        "data": "",
        "split": "",
        "data_sha256": {},
        "settings": settings,
        "canvas": tuple(f"{width}x{height}" for height, width in canvases),
        **about,
    }
    return scorecard.report(
        lambda images: Provenance(
            **fields,
            images=images,
            versions=describe_versions(),
            hardware=describe_hardware(fields["runtime"]),
            started=datetime.datetime.fromtimestamp(started, datetime.timezone.utc).isoformat(timespec="seconds"),
            seconds=round(time.time() - started, 3),
            peak_memory_mib=round(peak_memory(), 1),
        ),
        resamples=resamples,
        seed=seed,
    )


def _predictions(
    raw: RawOutputs,
    index: int,
    letterbox: Letterbox,
    thresholds: Thresholds,
    card: ModelCard,
    *,
    native: bool,
    published: bool,
) -> tuple[Perception | None, CanvasPrediction | None]:
    """Return what an image of a batch is scored by: at its own size, and as published."""
    low = dataclasses.replace(thresholds, confidence=min(LOWEST_CONFIDENCE, thresholds.confidence))
    boxes = paper_boxes = None
    if raw.detection is not None:
        boxes = select_boxes(raw.detection[index], letterbox, low) if native else None
        if published:
            same = boxes is not None and (low.confidence, low.iou, low.max_boxes) == (
                PAPER_THRESHOLDS.confidence,
                PAPER_THRESHOLDS.iou,
                PAPER_THRESHOLDS.max_boxes,
            )
            paper_boxes = boxes if same else select_boxes(raw.detection[index], letterbox, PAPER_THRESHOLDS)
    perception = canvas = None
    if native:
        perception = Perception(
            size=letterbox.source,
            class_names=card.class_names,
            boxes=boxes,
            drivable=None if raw.drivable is None else threshold_mask(raw.drivable[index], letterbox, low.drivable),
            lane=None if raw.lane is None else threshold_mask(raw.lane[index], letterbox, low.lane),
        )
    if published:
        fitted = Letterbox.fit(letterbox.source)
        canvas = CanvasPrediction(
            boxes=paper_boxes,
            drivable=_argmax(raw.drivable, index, letterbox, fitted),
            lane=_argmax(raw.lane, index, letterbox, fitted),
            letterbox=fitted,
        )
    return perception, canvas


def _argmax(
    masks: NDArray[np.uint8] | None, index: int, letterbox: Letterbox, published: Letterbox
) -> NDArray[np.bool_] | None:
    """Decide by the likelier of the two classes, padding cropped, at the size the image has in the published canvas."""
    if masks is None:
        return None
    inside = letterbox.crop(masks[index])
    if inside.shape != published.resized:
        inside = cv2.resize(inside, published.resized[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(inside > 127)


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
    predictor: EvaluatedPredictor,
    dataset: LabelledImages,
    *,
    batch_size: int = 1,
    limit: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> BestThresholds:
    """Find the threshold a task that does best on a validation split, in one pass.

    The confidence is the one of best F1 at IoU 0.5 (half way to the next box below), the others those of best
    foreground IoU over the split, at the images' own size, exact to 1/255.

    Args:
        predictor: Its own thresholds stay where there is nothing to tell from.
        dataset: Labelled images; not those that are reported on as held out.
        batch_size: At most so many images go through the network at once.
        limit: Only the first so many images.
        progress: Called with how many images are looked at, and of how many.

    Raises:
        ConfigError: If the classes of model and data differ.
        DataError: If there are no images.
    """
    card = predictor.backend.card
    check_classes(card, dataset)
    low = dataclasses.replace(predictor.thresholds, confidence=LOWEST_CONFIDENCE)
    detection = DetectionMetric(card.class_names)
    counts: dict[Literal["drivable", "lane"], NDArray[np.int64]] = {
        "drivable": np.zeros((2, 256), np.int64),
        "lane": np.zeros((2, 256), np.int64),
    }

    def look(sample: LabelledImage, raw: RawOutputs, index: int, letterbox: Letterbox) -> None:
        if raw.detection is not None:
            add_boxes(detection, sample, select_boxes(raw.detection[index], letterbox, low))
        for task in counts:
            masks, truth = getattr(raw, task), getattr(sample, task)
            if masks is not None and truth is not None:
                probability = letterbox.mask_to_source(masks[index])
                counts[task] += _probability_counts(probability, truth, sample.counted(task))

    _look_at_each(predictor, dataset, batch_size, limit, look, progress)
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
    joint = probability.astype(np.uint16) + ((truth > 0).astype(np.uint16) << np.uint16(8))
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
    return round((best - 0.5) / 255, 4) if iou[best - 1] else default, float(iou[best - 1])


def _best_confidence(detection: DetectionMetric, default: float) -> tuple[float, float]:
    curve, best = detection.curve(), detection.compute().best
    if not best.f1 > 0:  # undefined, or no box is right at any confidence
        return default, best.f1
    at = int(np.flatnonzero(curve.confidence == best.confidence)[0])
    below = curve.confidence[at + 1] if at + 1 < len(curve.confidence) else 0.0
    return round(float((best.confidence + below) / 2), 6), best.f1


def _look_at_each(
    predictor: EvaluatedPredictor,
    dataset: LabelledImages,
    batch_size: int,
    limit: int | None,
    look: _Look,
    progress: Callable[[int, int], None] | None,
    change: ImageChange | None = None,
) -> None:
    """Call ``look``, in order, with each sample, the outputs of its batch, its place in that, and its letterbox.

    Reading and letterboxing go ahead in a thread of their own, looking follows in another. Where the backend can,
    several threads compute a batch each on cores of their own: scoring beside a network that has all cores would make
    each of its layers wait.
    """
    count = _count(dataset, limit)
    if count < 1 or batch_size < 1:
        raise DataError(f"no images to evaluate on (images {count}, batch size {batch_size})")
    backend = predictor.backend
    done = itertools.count(1)

    def prepare(index: int) -> _Read:
        sample = dataset[index]
        image = sample.image if change is None else change(sample.image, sample.name)
        return sample, *predictor.preprocess(image)

    def run(batch: list[_Read]) -> tuple[list[_Read], RawOutputs]:
        canvases = [canvas for _, canvas, _ in batch]
        return batch, backend.run(canvases[0][None] if len(canvases) == 1 else np.stack(canvases))

    def look_at(sample: LabelledImage, raw: RawOutputs, index: int, letterbox: Letterbox) -> None:
        look(sample, raw, index, letterbox)
        if progress is not None:
            progress(next(done), count)

    with (
        backend.in_parallel() if isinstance(backend, RunsInParallel) else nullcontext(1) as runners,
        closing(_ahead(prepare, range(count), batch_size * (runners + 1) + 1, "reader")) as read,
        closing(_ahead(run, _batches(read, batch_size), runners, "network", runners)) as outputs,
        _InOrder() as looking,
    ):
        for batch, raw in outputs:
            for index, (sample, _, letterbox) in enumerate(batch):
                looking.submit(look_at, sample, raw, index, letterbox)


def _batches(read: Iterable[_Read], batch_size: int) -> Iterator[list[_Read]]:
    """Gather images that follow each other and have a canvas of one size."""
    batch: list[_Read] = []
    for one in read:
        if batch and (len(batch) == batch_size or one[1].shape != batch[0][1].shape):
            yield batch
            batch = []
        batch.append(one)
    if batch:
        yield batch


def _ahead(
    prepare: Callable[[_S], _T], order: Iterable[_S], depth: int, name: str, threads: int = 1
) -> Generator[_T, None, None]:
    """Yield what threads prepare of each, in order, up to ``depth`` ahead."""
    with ThreadPoolExecutor(threads, thread_name_prefix=name) as pool:
        waiting: collections.deque[Future[_T]] = collections.deque()
        try:
            for one in order:
                waiting.append(pool.submit(prepare, one))
                if len(waiting) > depth:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


class _InOrder:
    """Calls, one after the other in a thread of their own; a few may wait, and the first error is raised."""

    _WAITING: Final = 8

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="scorer")
        self._futures: collections.deque[Future[None]] = collections.deque()

    def __enter__(self) -> _InOrder:
        return self

    def submit(self, function: Callable[..., None], *arguments: Any) -> None:
        self._futures.append(self._pool.submit(function, *arguments))
        while len(self._futures) > self._WAITING:
            self._futures.popleft().result()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if error is None:
            while self._futures:
                self._futures.popleft().result()
        self._pool.shutdown(wait=True, cancel_futures=True)
