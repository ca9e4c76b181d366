"""The report card: what was measured, on what, with what, and how sure the figures are."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from trilitenet.config import TASKS, Task, parse, parse_json
from trilitenet.engine.figures import CONDITION_FIGURES, HEADLINES, meaning
from trilitenet.engine.page import percent
from trilitenet.engine.scoring import FairMetrics, FairScores, PaperMetrics, PaperScores
from trilitenet.errors import DataError, brief, write_file

__all__ = [
    "BY_IMAGE",
    "FEW_IMAGES",
    "REPORT_SCHEMA",
    "SAVED",
    "Condition",
    "DetectionPlots",
    "Figure",
    "Provenance",
    "Report",
    "Variation",
    "WorstFrame",
    "read_report",
    "render",
    "text_width",
    "titled_table",
    "without_nan",
]

REPORT_SCHEMA: Final = 1
"""Version of the JSON; a file with a higher one is refused. docs/evaluation.md describes it."""
SAVED: Final = "saved predictions"
BY_IMAGE: Final = "image"
"""In place of an attribute that makes groups: each image is drawn by itself."""
FEW_IMAGES: Final = 30
"""A table cell from fewer images says little and is greyed."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """A value and its 95% bootstrap interval.

    Attributes:
        value: In [0, 1]; NaN where undefined.
        low: Lower end; None without resampling, NaN where undefined.
        high: Upper end; likewise.
    """

    value: float
    low: float | None = None
    high: float | None = None

    @property
    def spread(self) -> str:
        """The interval in per cent, in words; empty without one, as where the value is undefined."""
        if self.low is None or math.isnan(self.low):
            return ""
        return f"{percent(self.low)} to {percent(self.high)}"


@dataclasses.dataclass(frozen=True)
class Condition:
    """Figures over the images of one condition.

    Attributes:
        attribute: For example ``"timeofday"``.
        value: For example ``"night"``.
        images: How many images have it.
        figures: Figure key -> value.
        labelled: Task -> how many of the images are labelled for it.
    """

    attribute: str
    value: str
    images: int
    figures: dict[str, float]
    labelled: dict[Task, int] = dataclasses.field(default_factory=dict)

    @property
    def few(self) -> bool:
        """Whether there are too few images to say much."""
        return self.images < FEW_IMAGES

    def few_for(self, key: str) -> bool:
        """Return whether too few of the images are labelled for a figure's task."""
        task = cast("Task", key.split("/")[1])
        return self.labelled.get(task, self.images) < FEW_IMAGES


@dataclasses.dataclass(frozen=True)
class Variation:
    """Figures under another circumstance: corrupted images, another input size.

    Attributes:
        kind: What is varied, as a heading.
        name: For example ``"fog 3"`` or ``"512"``.
        figures: Figure key -> value.
        note: How to read the table.
        detail: Left out of tables, which show the means; the JSON has it.
    """

    kind: str
    name: str
    figures: dict[str, float]
    note: str = ""
    detail: bool = False


@dataclasses.dataclass(frozen=True)
class WorstFrame:
    """One of the images that a task went worst on.

    Attributes:
        task: The task.
        name: The image.
        score: Detection: F1; drivable: IoU; lane: F1 with 2 px tolerance.
        note: Counts, in words.
        picture: JPEG with right, false and missed in colours; empty if it was not kept.
    """

    task: str
    name: str
    score: float
    note: str
    picture: bytes = dataclasses.field(default=b"", repr=False)


@dataclasses.dataclass(frozen=True)
class DetectionPlots:
    """What the plots of detection are drawn from, IoU 0.5.

    Attributes:
        recall: Along falling confidence, at most a few hundred points.
        precision: Likewise.
        confidence: Likewise.
        right: Right boxes by twentieths of confidence.
        wrong: Wrong boxes by twentieths of confidence.
        confusion: Row truth, column prediction, at the stated confidence; the last of each is background. Empty where
            'paper' was measured alone.
        class_names: Of rows and columns.
    """

    recall: tuple[float, ...]
    precision: tuple[float, ...]
    confidence: tuple[float, ...]
    right: tuple[int, ...]
    wrong: tuple[int, ...]
    confusion: tuple[tuple[int, ...], ...]
    class_names: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Provenance:
    """All that is needed to get the same figures again.

    Attributes:
        model: File, name or folder of predictions.
        model_sha256: Of the file; None where there is none.
        runtime: Runtime and device; `SAVED` of predictions that were read.
        data: Where the images are.
        split: Their split.
        images: How many.
        data_sha256: Of images, masks and boxes, apart.
        thresholds: Decision thresholds of the model, by which 'fair' goes.
        settings: Further settings of the protocols; ``paper_thresholds`` are those of 'paper', which are its own.
        canvas: Sizes of the network's input, "width x height".
        versions: Versions by package.
        hardware: Processor, cores, system, and the GPU if the runtime is on one.
        started: ISO 8601, UTC.
        seconds: From the first image to the last figure.
        peak_memory_mib: Most memory held by the process.
    """

    model: str
    model_sha256: str | None
    runtime: str
    data: str
    split: str
    images: int
    data_sha256: dict[str, str]
    thresholds: dict[str, float]
    settings: dict[str, Any]
    canvas: tuple[str, ...]
    versions: dict[str, str]
    hardware: str
    started: str
    seconds: float
    peak_memory_mib: float


@dataclasses.dataclass(frozen=True, eq=False)
class Report:
    """A report card.

    Attributes:
        provenance: Model, data, settings, machine.
        fair: Scores under the 'fair' protocol; None if it was not asked for.
        paper: Scores under the 'paper' protocol; None if it was not asked for.
        figures: ``protocol/task/name`` -> value and interval.
        conditions: Figures by weather, scene, time of day.
        plots: Of detection; None without it.
        worst: The images that went worst, a task after the other.
        names: The images, in order.
        groups: The number of each image's group, which is drawn as a whole for the intervals; empty where each image is
            drawn by itself.
        group: The attribute that makes the groups; ``"image"`` where each image is drawn by itself.
        state: Counts an image, from which every figure can be computed again.
        variations: Figures on corrupted images and at other input sizes, where measured.
    """

    provenance: Provenance
    fair: FairScores | None
    paper: PaperScores | None
    figures: dict[str, Figure]
    conditions: tuple[Condition, ...]
    plots: DetectionPlots | None
    worst: tuple[WorstFrame, ...]
    names: tuple[str, ...]
    state: dict[str, Any] = dataclasses.field(repr=False)
    variations: tuple[Variation, ...] = ()
    groups: tuple[int, ...] = ()
    group: str = BY_IMAGE

    @property
    def drawn(self) -> str:
        """What the intervals are drawn from, in words."""
        if not self.groups:
            return "1 image, which gives none" if len(self.names) == 1 else f"{len(self.names)} images"
        count = len(set(self.groups))
        if count == 1:
            return f"1 group of images (by {self.group}), which gives none"
        return f"{count} groups of images (by {self.group})"

    @property
    def protocols(self) -> tuple[str, ...]:
        """The protocols that were used."""
        return tuple(name for name, scores in (("fair", self.fair), ("paper", self.paper)) if scores is not None)

    def thresholds(self) -> dict[str, str]:
        """Return what each protocol decided with, in words; none for 'paper' in reports that do not tell."""
        known = {"fair": self.provenance.thresholds, "paper": self.provenance.settings.get("paper_thresholds", {})}
        return {
            protocol: ", ".join(f"{name} {value:g}" for name, value in known[protocol].items())
            for protocol in self.protocols
            if known[protocol]
        }

    def task_scores(self) -> dict[Task, Any]:
        """Return the scores a task, lanes as labelled: of 'fair', or of 'paper' where that was measured alone."""
        scores = self.paper if self.fair is None else self.fair
        found = {task: one for task in TASKS if (one := getattr(scores, task)) is not None}
        if self.fair is not None and self.fair.lane is not None:
            found["lane"] = self.fair.lane.as_labelled
        return found

    def values(self) -> dict[str, float]:
        """Return the figures without their intervals."""
        return {key: figure.value for key, figure in self.figures.items()}

    def metrics(self) -> dict[str, FairMetrics | PaperMetrics]:
        """Return the metrics by protocol, filled, to compute further figures from."""
        return _metrics(self.state)

    def to_dict(self) -> dict[str, Any]:
        """Return what ``json.dumps`` takes: the documented JSON form (without pictures; NaN is null)."""
        mapping = {
            "schema": REPORT_SCHEMA,
            "provenance": dataclasses.asdict(self.provenance),
            "figures": {key: dataclasses.asdict(figure) for key, figure in self.figures.items()},
            "meanings": {key: dataclasses.asdict(meaning(key)) for key in self.figures},
            "fair": None if self.fair is None else dataclasses.asdict(self.fair),
            "paper": None if self.paper is None else dataclasses.asdict(self.paper),
            "conditions": [dataclasses.asdict(row) | {"few": row.few} for row in self.conditions],
            "detection_plots": None if self.plots is None else dataclasses.asdict(self.plots),
            "worst": [
                {"task": frame.task, "name": frame.name, "score": frame.score, "note": frame.note}
                for frame in self.worst
            ],
            "variations": [dataclasses.asdict(variation) for variation in self.variations],
            "images": list(self.names),
            "groups": list(self.groups),
            "group": self.group,
            "state": self.state,
        }
        return dict(without_nan(mapping))

    def save_json(self, path: Path) -> None:
        """Write the JSON form.

        Raises:
            OutputError: If it cannot be written.
        """
        write_file(path, json.dumps(self.to_dict(), ensure_ascii=False, separators=(",", ":")) + "\n")

    def save_html(self, path: Path) -> None:
        """Write one self-contained HTML page.

        Raises:
            OutputError: If it cannot be written.
        """
        from trilitenet.engine.report_html import report_page

        write_file(path, report_page(self))

    def summary(self) -> str:
        """Return the report as text for a terminal: every figure with its interval and formula, then conditions."""
        tables: list[Table | Text] = [_provenance_text(self)]
        for protocol in self.protocols:
            tables.append(_figure_table(protocol, self.figures))
        if any(figure.low is not None for figure in self.figures.values()):
            alone = "; --group image draws each by itself" if len(set(self.groups)) == 1 else ""
            tables.append(Text(f"intervals: drawn from {self.drawn}{alone}"))
        tables.append(_exclusions(self))
        tables += [_condition_table(protocol, self.conditions) for protocol in self.protocols if self.conditions]
        tables += _variation_tables(self.variations)
        return render(tables)


def text_width() -> int:
    """Return how many characters a line of `render` may have."""
    return max(shutil.get_terminal_size((110, 40)).columns, 80)


def render(parts: list[Any]) -> str:
    """Render rich objects as text, coloured if standard output is a terminal; brackets in names are no markup.

    What is too long for a column of a table goes on in the next line: nothing is cut off.
    """
    buffer = io.StringIO()
    terminal, width = sys.stdout.isatty(), text_width()
    console = Console(file=buffer, force_terminal=terminal, width=width, highlight=False, markup=False, emoji=False)
    for part in parts:
        for column in part.columns if isinstance(part, Table) else ():
            column.overflow = "fold"
        console.print(part)
    return buffer.getvalue().rstrip()


def titled_table(title: str) -> Table:
    """Return a table without columns."""
    return Table(title=title, box=box.SIMPLE_HEAD, title_justify="left", title_style="bold")


def _figure_table(protocol: str, figures: Mapping[str, Figure]) -> Table:
    table = titled_table(f"{protocol} protocol (per cent)")
    table.add_column("task")
    table.add_column("figure", no_wrap=True)
    table.add_column("value", justify="right")
    table.add_column("95% interval", justify="right", no_wrap=True)
    table.add_column("formula", style="dim")
    last = ""
    for key, figure in figures.items():
        owner, task, _ = key.split("/")
        if owner != protocol:
            continue
        words = meaning(key)
        table.add_row(task if task != last else "", words.title, percent(figure.value), figure.spread, words.formula)
        last = task
    return table


def _condition_table(protocol: str, conditions: tuple[Condition, ...]) -> Table:
    keys = [key for key in CONDITION_FIGURES[protocol] if any(key in row.figures for row in conditions)]
    table = titled_table(f"by condition, {protocol} (per cent; in brackets: under {FEW_IMAGES} labelled images)")
    table.add_column("condition")
    table.add_column("value")
    table.add_column("images", justify="right")
    for key in keys:
        table.add_column(f"{key.split('/')[1]}\n{meaning(key).title}", justify="right")
    last = ""
    for row in conditions:
        cells = [percent(row.figures.get(key)) for key in keys]
        cells = [f"({cell})" if row.few_for(key) else cell for key, cell in zip(keys, cells, strict=True)]
        table.add_row(
            row.attribute if row.attribute != last else "",
            row.value,
            str(row.images),
            *cells,
            style="dim" if row.few else None,
        )
        last = row.attribute
    return table


def _variation_tables(variations: tuple[Variation, ...]) -> list[Table]:
    tables = []
    for kind in dict.fromkeys(variation.kind for variation in variations):
        members = [variation for variation in variations if variation.kind == kind and not variation.detail]
        keys = [key for key in HEADLINES if key in members[0].figures]
        table = titled_table(f"{kind} (per cent)")
        table.add_column("")
        for key in keys:
            table.add_column(f"{key.split('/')[1]}\n{meaning(key).title}", justify="right")
        for member in members:
            table.add_row(member.name, *(percent(member.figures.get(key)) for key in keys))
        tables.append(table)
    return tables


def _provenance_text(report: Report) -> Text:
    provenance = report.provenance
    lines = [
        f"model  {provenance.model} ({provenance.runtime}, canvas {', '.join(provenance.canvas)})",
        f"data   {provenance.data} {provenance.split}, {provenance.images} images",
        *(f"{protocol:5}  with {words}" for protocol, words in report.thresholds().items()),
        f"on     {provenance.hardware}; {provenance.seconds:.1f} s, peak memory {provenance.peak_memory_mib:.0f} MiB",
    ]
    return Text("\n".join(lines))


def _exclusions(report: Report) -> Text:
    """Say which images did not count, a task, and at which confidence the best F1 is."""
    parts = []
    for task, scores in report.task_scores().items():
        empty = "" if report.fair is None else f", {scores.both_empty} empty in both"
        parts.append(f"{task}: {scores.images} images count{empty}, {scores.not_labelled} not labelled")
    boxes = None if report.fair is None else report.fair.detection
    if boxes is not None and not math.isnan(boxes.best.confidence):
        parts[0] += f"; best F1 at confidence {boxes.best.confidence:.3g}"
    return Text("\n".join(parts))


def read_report(path: Path) -> Report:
    """Read what `Report.save_json` wrote (without pictures).

    Raises:
        DataError: If it is no report, or a newer one.
    """
    try:
        mapping = parse_json(path.read_bytes())
        schema = mapping["schema"]
        if schema > REPORT_SCHEMA:
            raise DataError(f"{path}: report schema {schema!r} is newer than {REPORT_SCHEMA}; upgrade trilitenet")
        state = mapping["state"]
        known = mapping["provenance"]
        known |= {"peak_memory_mib": _number(known["peak_memory_mib"])}
        names = tuple(mapping["images"])
        scores: dict[str, Any] = {}
        for name, metrics in _metrics(state).items():
            scores[name] = metrics.compute()
            metrics.figures(np.ones((1, len(names)), np.int32))  # as many images as the names
        plots = mapping["detection_plots"]
        report = Report(
            provenance=parse(Provenance, known, "provenance"),
            fair=scores.get("fair"),
            paper=scores.get("paper"),
            figures={
                key: Figure(_number(figure["value"]), figure["low"], figure["high"])
                for key, figure in mapping["figures"].items()
            },
            conditions=tuple(
                Condition(
                    row["attribute"],
                    row["value"],
                    row["images"],
                    {key: _number(value) for key, value in row["figures"].items()},
                    dict(row.get("labelled", {})),
                )
                for row in mapping["conditions"]
            ),
            plots=None if plots is None else _plots(plots),
            worst=tuple(
                WorstFrame(frame["task"], frame["name"], _number(frame["score"]), frame["note"])
                for frame in mapping["worst"]
            ),
            names=names,
            groups=_groups(mapping.get("groups", []), len(names)),
            group=str(mapping.get("group", BY_IMAGE)),
            state=state,
            variations=tuple(
                Variation(
                    row["kind"],
                    row["name"],
                    {key: _number(value) for key, value in row["figures"].items()},
                    row["note"],
                    row["detail"],
                )
                for row in mapping["variations"]
            ),
        )
        report.thresholds()  # are numbers
        return report
    except OSError as error:
        cure = "give the report.json, or its folder, that `trilitenet evaluate --output` has written"
        raise DataError(f"{path}: cannot be read ({error.strerror}); {cure}") from error
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: not a report that `trilitenet evaluate` wrote ({brief(error)})") from error


def _metrics(state: Mapping[str, Any]) -> dict[str, FairMetrics | PaperMetrics]:
    readers: dict[str, Any] = {"fair": FairMetrics.from_state, "paper": PaperMetrics.from_state}
    return {name: readers[name]({**part}) for name, part in state.items()}


def _groups(numbers: list[int], images: int) -> tuple[int, ...]:
    """Return the groups of a report's images.

    Raises:
        ValueError: If they are not as many numbers, 0 and up, as there are images.
    """
    if numbers and (len(numbers) != images or not all(isinstance(one, int) and 0 <= one < images for one in numbers)):
        raise ValueError("groups are not one number an image")
    return tuple(numbers)


def _plots(mapping: Mapping[str, Any]) -> DetectionPlots:
    return DetectionPlots(
        **{name: tuple(_number(value) for value in mapping[name]) for name in ("recall", "precision", "confidence")},
        right=tuple(mapping["right"]),
        wrong=tuple(mapping["wrong"]),
        confusion=tuple(tuple(row) for row in mapping["confusion"]),
        class_names=tuple(mapping["class_names"]),
    )


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def without_nan(value: Any) -> Any:
    """Replace NaN by None, since JSON has none, and keys by strings."""
    if isinstance(value, float):
        return None if math.isnan(value) else value
    if isinstance(value, Mapping):
        return {str(key): without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        if value and all(isinstance(item, int) for item in value):
            return list(value)
        return [without_nan(item) for item in value]
    return value
