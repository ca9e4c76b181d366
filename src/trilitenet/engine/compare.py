"""Reports side by side: which differences are real."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from trilitenet.config import Task
from trilitenet.engine.figures import HEADLINES, meaning
from trilitenet.engine.page import escape, interval_plot, page, percent, section, table
from trilitenet.engine.published_rows import PAPER, PUBLISHED_ROWS, PublishedRow
from trilitenet.engine.report import SAVED, Report, render, text_width, titled_table, without_nan
from trilitenet.errors import ConfigError, write_file
from trilitenet.metrics.bootstrap import bootstrap, interval

__all__ = ["COMPARISON_SCHEMA", "Comparison", "Difference", "compare_reports"]

COMPARISON_SCHEMA: Final = 1
"""Version of the JSON of a comparison."""
_LABELS: Final[dict[Task, str]] = {"detection": "boxes", "drivable": "drivable", "lane": "lane"}
"""What the hash of a task's labels is called."""
_COSTS: Final = ("parameters, M", "multiply-adds, G")
"""Columns of what published models cost."""
_COSTS_WIDTH: Final = 110
"""Text of fewer characters a line leaves them out."""


@dataclasses.dataclass(frozen=True)
class Difference:
    """A figure of one model less that of the first, on the same images.

    Attributes:
        model: The name under which the other model stands.
        figure: Figure key.
        value: Difference of the figures, in [-1, 1].
        low: Lower end of its 95% interval from paired resampling.
        high: Upper end.
        real: The interval leaves out 0.
    """

    model: str
    figure: str
    value: float
    low: float
    high: float
    real: bool


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Reports side by side.

    Attributes:
        names: Of the models; the first is what others are compared with.
        data: Where each was measured.
        figures: Name -> figure key -> value.
        differences: Of every other model to the first; none for those measured on other images, nor of a figure that is
            undefined for either.
        unpaired: Name -> why its differences, or some of them, cannot be told.
        confidence: Name -> the confidence that precision, recall and F1 of boxes are stated at.
        published: Published rows beside them.
        resamples: Bootstrap draws.
        drawn: What they are drawn from, in words.
    """

    names: tuple[str, ...]
    data: dict[str, str]
    figures: dict[str, dict[str, float]]
    differences: tuple[Difference, ...]
    unpaired: dict[str, str]
    confidence: dict[str, float]
    published: tuple[PublishedRow, ...]
    resamples: int
    drawn: str

    def to_dict(self) -> dict[str, Any]:
        """Return what ``json.dumps`` takes (NaN is null)."""
        mapping = {
            "schema": COMPARISON_SCHEMA,
            "names": list(self.names),
            "data": self.data,
            "figures": self.figures,
            "differences": [dataclasses.asdict(one) for one in self.differences],
            "unpaired": self.unpaired,
            "confidence": self.confidence,
            "published": [dataclasses.asdict(row) for row in self.published],
            "resamples": self.resamples,
            "drawn": self.drawn,
        }
        return dict(without_nan(mapping))

    def save(self, folder: Path) -> None:
        """Write comparison.json and comparison.html into a folder.

        Raises:
            OutputError: If they cannot be written.
        """
        text = json.dumps(self.to_dict(), ensure_ascii=False, indent=1) + "\n"
        write_file(folder / "comparison.json", text)
        write_file(folder / "comparison.html", _comparison_page(self))

    def summary(self) -> str:
        """Return the comparison as text for a terminal."""
        parts: list[Table | Text] = [_figure_table(self)]
        if self.differences:
            parts.append(
                Text(
                    "* differs from the first: the 95% interval of the paired difference leaves out 0; drawn from "
                    f"{self.drawn}",
                    style="dim",
                )
            )
        parts += [Text(f"{name}: {reason}") for name, reason in self.unpaired.items()]
        if note := self.confidence_note():
            parts.append(Text(note))
        if self.published:
            parts += _published_table(self)
        return render(parts)

    def confidence_note(self) -> str:
        """Return at which confidence each model's precision, recall and F1 are, where it is not the same for all."""
        if len(set(self.confidence.values())) < 2:
            return ""
        told = ", ".join(f"{name} {value:.3g}" for name, value in self.confidence.items())
        return f"detection precision, recall and F1 are stated at other confidences: {told}"

    def published_note(self) -> str:
        """Return which models cannot be set against published rows yet, and what to do about it."""
        lacking = [name for name, row in self.figures.items() if not any(key.startswith("paper/") for key in row)]
        if not lacking:
            return ""
        return f"{', '.join(lacking)}: evaluate with --protocol paper (or both) to stand beside published rows"

    def difference(self, name: str, key: str) -> Difference | None:
        """Return the difference of a model in a figure, if it could be told."""
        return next((one for one in self.differences if one.model == name and one.figure == key), None)


def compare_reports(
    reports: Mapping[str, Report], *, published: bool = False, resamples: int = 1000, seed: int = 0
) -> Comparison:
    """Compare reports with the first of them.

    Images are resampled once for all models measured on the same images with the same labels, so that what is hard is
    hard for each of them; the difference of a figure is real when its 95% interval leaves out 0. Where the first report
    has its images in groups, such as the frames of a drive, whole groups are drawn for all.

    Args:
        reports: Name -> report, at least one.
        published: Put the published rows beside them.
        resamples: Bootstrap draws.
        seed: Of the draws.

    Raises:
        ConfigError: If there is no report.
    """
    if not reports:
        raise ConfigError("at least one report is needed")
    names = tuple(reports)
    first = reports[names[0]]
    groups = first.groups or None
    base = _spread(first, resamples, seed, groups)
    differences: list[Difference] = []
    unpaired: dict[str, str] = {}
    for name in names[1:]:
        other = reports[name]
        reasons = _why_unpaired(first, other)
        if reasons:
            unpaired[name] = "; ".join(
                f"{reason}; no paired differences" + (f" of {part.strip('/')} figures" if part else "")
                for part, reason in reasons.items()
            )
        if "" in reasons:
            continue
        spread = _spread(other, resamples, seed, groups)
        for key, figure in other.figures.items():
            if any(part in key for part in reasons):
                continue
            value = figure.value - first.figures[key].value if key in first.figures else math.nan
            if not math.isnan(value) and key in spread and key in base:
                low, high = interval(spread[key] - base[key])
                differences.append(Difference(name, key, value, low, high, bool(low > 0 or high < 0)))
    return Comparison(
        names=names,
        data={name: f"{report.provenance.data} {report.provenance.split}" for name, report in reports.items()},
        figures={name: report.values() for name, report in reports.items()},
        differences=tuple(differences),
        unpaired=unpaired,
        confidence={
            name: report.provenance.thresholds["confidence"]
            for name, report in reports.items()
            if "confidence" in report.provenance.thresholds and "fair/detection/f1" in report.figures
        },
        published=PUBLISHED_ROWS if published else (),
        resamples=resamples,
        drawn=first.drawn,
    )


def _spread(report: Report, resamples: int, seed: int, groups: Sequence[int] | None) -> dict[str, NDArray[np.float64]]:
    """Return figure key -> (resamples,) values; the same seed draws the same images for every report."""
    return {
        f"{protocol}/{name}": values
        for protocol, metrics in report.metrics().items()
        for name, values in bootstrap(metrics.figures, len(report.names), resamples, seed, groups).items()
    }


def _why_unpaired(first: Report, other: Report) -> dict[str, str]:
    """Say why figures of two reports cannot be compared image by image: part of their keys -> the reason."""
    if len(set(first.groups or first.names)) == 1:
        cure = "; evaluate with --group image to draw each by itself" if first.groups else ""
        return {"": f"drawn from {first.drawn}{cure}"}
    if first.names != other.names:
        return {"": f"measured on other images ({len(other.names)}, the first on {len(first.names)})"}
    hashes = [report.provenance.data_sha256 for report in (first, other)]

    def differ(part: str) -> bool:
        return part in hashes[0] and part in hashes[1] and hashes[0][part] != hashes[1][part]

    if differ("images"):
        return {"": "measured with other images under the same names"}
    found = {}
    for task, part in _LABELS.items():
        if _measures(first, task) and _measures(other, task) and differ(part):
            found[f"/{task}/"] = f"measured with other labels of {part}"
    classes = [report.state.get("fair", {}).get("detection", {}).get("class_names") for report in (first, other)]
    if None not in classes and classes[0] != classes[1]:
        told = [", ".join(map(str, names)) for names in classes]
        found["/detection/"] = f"tells {told[1]}, the first {told[0]}"
    batches = [report.provenance.settings.get("paper_batch") for report in (first, other)]
    saved = [report.provenance.runtime == SAVED for report in (first, other)]
    if None not in batches and batches[0] != batches[1]:
        found["paper/"] = f"averages over batches of {batches[1]}, the first of {batches[0]}"
    elif saved[0] != saved[1] and "paper" in first.state and "paper" in other.state:
        found["paper/"] = "one was scored from saved predictions, the other not"
    return found


def _measures(report: Report, task: Task) -> bool:
    return any(f"/{task}/" in key for key in report.figures)


def _keys(comparison: Comparison) -> list[str]:
    return list(dict.fromkeys(key for row in comparison.figures.values() for key in row))


def _figure_table(comparison: Comparison) -> Table:
    shown = titled_table("figures (per cent)")
    shown.add_column("figure")
    for name in comparison.names:
        shown.add_column(name, justify="right")
    for key in _keys(comparison):
        cells = []
        for name in comparison.names:
            value = percent(comparison.figures[name].get(key))
            difference = comparison.difference(name, key)
            if difference is not None:
                mark = "*" if difference.real else " "
                value += f" ({_interval(difference)}){mark}"
            cells.append(value)
        shown.add_row(_label(key), *cells)
    return shown


def _published_table(comparison: Comparison) -> list[Table | Text]:
    keys = list(comparison.published[0].figures)
    shown = titled_table("beside published rows (per cent)")
    shown.add_column("model")
    for key in keys:
        shown.add_column(_label(key).removeprefix("paper ").replace(" ", "\n", 1), justify="right")
    costs = len(_COSTS) if text_width() >= _COSTS_WIDTH else 0
    for title in _COSTS[:costs]:
        shown.add_column(title.replace(", ", "\n"), justify="right")
    for name in comparison.names:
        cells = [percent(comparison.figures[name].get(key)) for key in keys]
        shown.add_row(name, *cells, *("-" * costs), style="bold")
    sources = list(dict.fromkeys((row.source, row.protocol) for row in comparison.published))
    for row in comparison.published:
        number = sources.index((row.source, row.protocol)) + 1
        shown.add_row(f"{row.name} [{number}]", *row.printed, *row.printed_cost[:costs])
    notes = [
        f"measured here: {', '.join(f'{name} on {comparison.data[name]}' for name in comparison.names)}",
        f"published: {PAPER}",
        *(f"[{number}] {source}; {protocol}" for number, (source, protocol) in enumerate(sources, 1)),
        comparison.published_note(),
    ]
    return [shown, Text("\n".join(filter(None, notes)))]


def _label(key: str) -> str:
    protocol, task, _ = key.split("/")
    return f"{protocol} {task} {meaning(key).title}"


def _interval(difference: Difference) -> str:
    if difference.value == difference.low == difference.high == 0:
        return "no difference"
    return f"{_signed(difference.low)} to {_signed(difference.high)}"


def _signed(value: float) -> str:
    return "-" if math.isnan(value) else f"{100 * value:+.1f}"


def _comparison_page(comparison: Comparison) -> str:
    names = comparison.names
    parts = [
        f"<h1>{escape(' against '.join(names)) if len(names) > 1 else escape(names[0])}</h1>",
        f'<p class="lead">Differences to {escape(names[0])}, {comparison.resamples} draws from '
        f"{escape(comparison.drawn)}. Filled: the 95% interval leaves out 0.</p>",
    ]
    plots = []
    for name in names[1:]:
        rows = [
            (_label(key), one.value, one.low, one.high, one.real)
            for key in HEADLINES
            if (one := comparison.difference(name, key)) is not None
        ]
        body = (
            interval_plot(rows, f"differences of {name} to {names[0]}, points of a per cent")
            if rows
            else f'<p class="note">{escape(comparison.unpaired.get(name, "no difference to tell"))}</p>'
        )
        plots.append(f'<div class="card"><h3>{escape(name)} less {escape(names[0])}, points</h3>{body}</div>')
    notes = [
        comparison.confidence_note(),
        *(
            f"{name}: {reason}"
            for name, reason in comparison.unpaired.items()
            if any(one.model == name for one in comparison.differences)
        ),
    ]
    if plots:
        below = f'<p class="note">{"<br>".join(escape(note) for note in notes if note)}</p>' if any(notes) else ""
        body = f'<div class="stack"><div class="grid">{"".join(plots)}</div>{below}</div>'
        parts.append(section("Which differences are real", body))
    parts.append(section("Every figure", f'<div class="card">{_page_figures(comparison)}</div>', "Per cent."))
    if comparison.published:
        note = (
            f"Published rows are as printed in {PAPER}. "
            "Only figures of the paper protocol on the same images can be set against them."
        )
        if lacking := comparison.published_note():
            note += f" {lacking}."
        parts.append(section("Beside published rows", f'<div class="card">{_page_published(comparison)}</div>', note))
    return page("trilitenet: comparison", "\n".join(parts))


def _page_figures(comparison: Comparison) -> str:
    head = "<th>figure</th>" + "".join(f'<th class="n">{escape(name)}</th>' for name in comparison.names)
    rows = []
    for key in _keys(comparison):
        cells = ""
        for name in comparison.names:
            value = percent(comparison.figures[name].get(key))
            one = comparison.difference(name, key)
            note = ""
            if one is not None:
                value = f"<b>{value}</b>" if one.real else value
                told = _interval(one)
                if one.value or one.low or one.high:
                    told += ", real" if one.real else ", may be chance"
                note = f'<span class="note">{told}</span>'
            cells += f'<td class="n">{value}{note}</td>'
        rows.append(f"<tr><td>{escape(_label(key))}</td>{cells}</tr>")
    return table(head, "".join(rows))


def _page_published(comparison: Comparison) -> str:
    keys = list(comparison.published[0].figures)
    head = "<th>model</th>" + "".join(
        f'<th class="n">{escape(title)}</th>'
        for title in (*(_label(key).removeprefix("paper ") for key in keys), *_COSTS)
    )
    rows = [
        f"<tr><td><b>{escape(name)}</b><span class=note>measured here, on {escape(comparison.data[name])}</span></td>"
        + "".join(f'<td class="n">{percent(comparison.figures[name].get(key))}</td>' for key in keys)
        + '<td class="n">-</td>' * len(_COSTS)
        + "</tr>"
        for name in comparison.names
    ]
    rows += [
        f"<tr><td>{escape(row.name)}<span class=note>{escape(row.source)}; {escape(row.protocol)}</span></td>"
        + "".join(f'<td class="n">{text}</td>' for text in (*row.printed, *row.printed_cost))
        + "</tr>"
        for row in comparison.published
    ]
    return table(head, "".join(rows))
