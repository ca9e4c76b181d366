"""Collect predictions image by image, whoever made them, and turn them into a report."""

from __future__ import annotations

import collections
import heapq
import itertools
import logging
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import TASKS, Task, Thresholds
from trilitenet.engine.overlays import error_overlay, shrunken
from trilitenet.engine.report import BY_IMAGE, Condition, DetectionPlots, Figure, Provenance, Report, WorstFrame
from trilitenet.engine.scoring import CanvasPrediction, FairMetrics, ImageOutcome, LabelledImage, PaperMetrics
from trilitenet.errors import ConfigError, DataError, did_you_mean
from trilitenet.metrics.bootstrap import bootstrap, interval
from trilitenet.metrics.detection import DetectionMetric
from trilitenet.metrics.published import PublishedDetection
from trilitenet.structures import Perception

__all__ = ["CONDITIONS", "GROUP", "PAPER_THRESHOLDS", "PROTOCOLS", "Scorecard"]

_LOGGER: Final = logging.getLogger(__name__)

PROTOCOLS: Final = ("paper", "fair", "both")
CONDITIONS: Final = ("timeofday", "weather", "scene")
"""Attributes that tables are made by, in the paper's order."""
GROUP: Final = "sequence"
"""Attribute whose images are drawn together for the intervals: frames of one drive are much alike."""
PAPER_THRESHOLDS: Final = Thresholds(confidence=0.001, iou=0.6, max_boxes=300, drivable=0.5, lane=0.5)
"""What the published evaluation decides with."""
_CURVE_POINTS: Final = 400


class Scorecard:
    """Scores of predictions, an image at a time, in memory that does not grow with the size of the images.

    Args:
        class_names: Detection classes.
        tasks: Tasks to score.
        protocol: ``"fair"``, ``"paper"`` or ``"both"``.
        confidence: The stated confidence of precision, recall and F1, and of boxes in pictures.
        lowest: Boxes below this confidence may have been cut off.
        paper_batch: Images a batch of the published averages.
        worst: How many of the worst images to keep pictures of, a task; 0 for none.
        by: Attributes to make tables by.
        group: Images of one value of this attribute are drawn together for the intervals, those without it each by
            itself; ``"image"`` draws each by itself.

    Raises:
        ConfigError: If there is no such protocol.
    """

    def __init__(
        self,
        class_names: Sequence[str],
        tasks: Sequence[Task],
        *,
        protocol: str = "fair",
        confidence: float = 0.25,
        lowest: float = 0.0,
        paper_batch: int = 16,
        worst: int = 24,
        by: Sequence[str] = CONDITIONS,
        group: str = GROUP,
    ) -> None:
        if protocol not in PROTOCOLS:
            raise ConfigError(f"unknown protocol {protocol!r}; known: {', '.join(PROTOCOLS)}")
        self.protocols = ("fair", "paper") if protocol == "both" else (protocol,)
        self.tasks = tuple(task for task in TASKS if task in tasks)
        self.fair = None
        if "fair" in self.protocols:
            self.fair = FairMetrics(class_names, self.tasks, confidence=confidence, lowest=lowest)
        self.paper = None
        if "paper" in self.protocols:
            self.paper = PaperMetrics(len(class_names), self.tasks, batch_size=paper_batch)
        self._class_names = tuple(class_names)
        self._confidence = confidence
        self._keep = worst
        self._by = tuple(dict.fromkeys(by))
        self._names: list[str] = []
        self._values: dict[str, list[str]] = {attribute: [] for attribute in self._by}
        self._group = group
        self._groups: list[str] = []
        self._labelled: list[list[bool]] = []  # an image: whether it has labels, a task
        self._known: set[str] = set()
        self._worst: dict[Task, list[tuple[float, int, int, WorstFrame]]] = {task: [] for task in self.tasks}
        self._serial = itertools.count()

    def add(self, sample: LabelledImage, prediction: Perception | None, canvas: CanvasPrediction | None) -> None:
        """Add an image.

        Args:
            sample: The image and its labels.
            prediction: For the 'fair' protocol: in pixels of the image, boxes down to the lowest confidence.
            canvas: For the 'paper' protocol.
        """
        self._names.append(sample.name)
        self._known |= sample.attributes.keys()
        for attribute in self._by:
            self._values[attribute].append(sample.attributes.get(attribute, "") or "undefined")
        labels = {"detection": sample.boxes, "drivable": sample.drivable, "lane": sample.lane}
        self._labelled.append([labels[task] is not None for task in self.tasks])
        self._groups.append("" if self._group == BY_IMAGE else sample.attributes.get(self._group, ""))
        if self.fair is not None and prediction is not None:
            outcome = self.fair.update(sample, prediction)
            if self._keep:
                self._remember(sample, prediction, outcome)
        if self.paper is not None and canvas is not None:
            self.paper.update(sample, canvas)

    def _remember(self, sample: LabelledImage, prediction: Perception, outcome: ImageOutcome) -> None:
        """Keep a picture of the image if a task went worse on it than on those kept."""
        errors = outcome.wrong + outcome.missed
        notes = {
            "detection": f"F1 {outcome.detection or 0:.2f}: {outcome.right} right, {outcome.wrong} false, "
            f"{outcome.missed} missed",
            "drivable": f"IoU {outcome.drivable or 0:.2f}",
            "lane": f"F1 with 2 px tolerance {outcome.lane or 0:.2f}",
        }
        small: NDArray[np.uint8] | None = None
        for task in self.tasks:
            score: float | None = getattr(outcome, task)
            if score is None or np.isnan(score):
                continue
            heap = self._worst[task]
            badness = (1.0 - score, errors if task == "detection" else 0)
            if len(heap) >= self._keep and badness <= heap[0][:2]:
                continue
            if small is None:
                small = shrunken(sample.image)
            picture = error_overlay(small, sample, prediction, task, confidence=self._confidence)
            entry = (*badness, -next(self._serial), WorstFrame(task, sample.name, score, notes[task], picture))
            if len(heap) < self._keep:
                heapq.heappush(heap, entry)
            else:
                heapq.heapreplace(heap, entry)

    def report(self, provenance: Callable[[int], Provenance], *, resamples: int = 1000, seed: int = 0) -> Report:
        """Compute every figure.

        Args:
            provenance: Given the number of images, says where the figures come from; called last.
            resamples: Bootstrap draws for the intervals; 0 for no intervals.
            seed: Of the draws.

        Raises:
            DataError: If no image was added.
        """
        count = len(self._names)
        if not count:
            raise DataError("no images to score")
        metrics = {"fair": self.fair, "paper": self.paper}
        groups = self._numbered_groups()
        figures: dict[str, Figure] = {}
        rows = self._condition_rows()
        members = np.array([where for _, _, where in rows], np.int32).reshape(len(rows), count)
        tables: list[dict[str, float]] = [{} for _ in rows]
        for protocol, metric in metrics.items():
            if metric is None:
                continue
            plain = metric.figures()  # before the resampling, whose threads would each rank the boxes first
            spread = bootstrap(metric.figures, count, resamples, seed, groups or None)
            for name, value in plain.items():
                low, high = interval(spread[name]) if resamples else (None, None)
                figures[f"{protocol}/{name}"] = Figure(float(value[0]), low, high)
            if rows:
                for name, values in metric.figures(members).items():
                    for table, value in zip(tables, values, strict=True):
                        table[f"{protocol}/{name}"] = float(value)
        fair, paper = self.fair, self.paper
        scored = paper if fair is None else fair
        boxes = None if scored is None else scored.detection
        labelled = members @ np.array(self._labelled, np.int64).reshape(count, len(self.tasks))
        return Report(
            fair=None if fair is None else fair.compute(),
            paper=None if paper is None else paper.compute(),
            figures=figures,
            conditions=tuple(
                Condition(attribute, value, int(sum(where)), table, dict(zip(self.tasks, map(int, own), strict=True)))
                for (attribute, value, where), table, own in zip(rows, tables, labelled, strict=True)
            ),
            plots=None if boxes is None else _detection_plots(boxes, self._class_names),
            worst=tuple(
                entry[3]
                for task in self.tasks
                for entry in sorted(self._worst[task], key=lambda entry: entry[:3])[::-1]
            ),
            names=tuple(self._names),
            groups=groups,
            group=self._group if groups else BY_IMAGE,
            state={name: metric.state() for name, metric in metrics.items() if metric is not None},
            provenance=provenance(count),
        )

    def _numbered_groups(self) -> tuple[int, ...]:
        """Return the number of each image's group, in order of their first images; nothing where each is its own."""
        if not any(self._groups):
            if self._group not in {GROUP, BY_IMAGE}:
                hint = did_you_mean(self._group, self._known)
                _LOGGER.warning("no image has the attribute %r to draw by%s", self._group, hint)
            return ()
        numbers: dict[tuple[str, int], int] = {}
        keys = [(value, -1 if value else index) for index, value in enumerate(self._groups)]
        return tuple(numbers.setdefault(key, len(numbers)) for key in keys)

    def _condition_rows(self) -> list[tuple[str, str, list[int]]]:
        """Return attribute, value and membership of every image, for attributes that some image has."""
        rows: list[tuple[str, str, list[int]]] = []
        for attribute, values in self._values.items():
            counts = collections.Counter(values)
            if set(counts) == {"undefined"}:
                if attribute not in CONDITIONS:
                    hint = did_you_mean(attribute, self._known)
                    _LOGGER.warning("no image has the attribute %r to make a table by%s", attribute, hint)
                continue
            rows += [
                (attribute, value, [int(one == value) for one in values])
                for value, _ in sorted(counts.items(), key=lambda item: (-item[1], item[0]))
            ]
        return rows


def _detection_plots(metric: DetectionMetric | PublishedDetection, class_names: Sequence[str]) -> DetectionPlots:
    curve = metric.curve()
    count = len(curve.confidence)
    picked: NDArray[np.int64] = np.unique(np.linspace(0, max(count - 1, 0), min(count, _CURVE_POINTS)).astype(np.int64))
    right, wrong = metric.histogram(20)
    confusion = metric.confusion if isinstance(metric, DetectionMetric) else ()  # the published matching knows none
    return DetectionPlots(
        recall=tuple(float(value) for value in curve.recall[picked]),
        precision=tuple(float(value) for value in curve.precision[picked]),
        confidence=tuple(float(value) for value in curve.confidence[picked]),
        right=tuple(int(value) for value in right),
        wrong=tuple(int(value) for value in wrong),
        confusion=tuple(tuple(int(value) for value in row) for row in confusion),
        class_names=(*class_names, "background"),
    )
