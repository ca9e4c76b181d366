"""The report card as one self-contained HTML page: no script, no file beside it, light or dark as the reader likes."""

from __future__ import annotations

import base64
from typing import Final

from trilitenet.config import TASKS, Task
from trilitenet.engine.figures import CONDITION_FIGURES, HEADLINES, meaning
from trilitenet.engine.overlays import FALSE, IGNORED, MISSED, RIGHT
from trilitenet.engine.page import bar_cell, escape, histogram_plot, line_plot, page, percent, section, table
from trilitenet.engine.report import FEW_IMAGES, Condition, DetectionPlots, Report, WorstFrame
from trilitenet.metrics.published import PublishedSegmentationScores
from trilitenet.metrics.segmentation import SegmentationScores

__all__ = ["report_page"]

_COLOURS = (("right", RIGHT), ("false", FALSE), ("missed", MISSED), ("ignored region", IGNORED))
_KEY = '<p class="note key">{}</p>'.format(
    "".join(f'<span><i style="background:rgb{colour}"></i>{words}</span>' for words, colour in _COLOURS)
)
_PROTOCOLS = {
    "fair": "Native size, one confusion matrix over the data set, COCO matching; ignored regions count neither way.",
    "paper": "As the published evaluation: canvas size, averages over batches, recall at confidence 0.001. "
    "Comparable with published rows only.",
}
_MASKS: Final[dict[Task, str]] = {"drivable": "Drivable area", "lane": "Lane marking, as labelled"}
_WITHOUT_FAIR = " The confusion of boxes and the worst images need the fair protocol."


def report_page(report: Report) -> str:
    """Return the page."""
    provenance = report.provenance
    parts = [
        f"<h1>{escape(provenance.model)}</h1>",
        f'<p class="lead">{escape(provenance.runtime)} on {provenance.images} images of {escape(provenance.data)} '
        f"{escape(provenance.split)}, {escape(provenance.started)}</p>",
        _tiles(report),
    ]
    parts += [_figures(report, protocol) for protocol in report.protocols]
    if report.plots is not None:
        parts.append(_detection(report, report.plots))
    parts.append(_pixels(report))
    parts += [_conditions(report, protocol) for protocol in report.protocols]
    parts += [_variations(report)]
    parts += [_worst(report, task) for task in TASKS]
    parts.append(_provenance(report))
    return page(f"{provenance.model}: report card", "\n".join(part for part in parts if part))


def _tiles(report: Report) -> str:
    groups = []
    for protocol in report.protocols:
        tiles = []
        for key in HEADLINES:
            figure = report.figures.get(key)
            if figure is None or not key.startswith(f"{protocol}/"):
                continue
            tiles.append(
                f'<div class="tile"><span>{key.split("/")[1]}</span><b>{percent(figure.value)}</b>'
                f"<span>{escape(meaning(key).title)}</span><span>{figure.spread}</span></div>"
            )
        groups.append(f'<h3>{protocol} protocol</h3><div class="tiles">{"".join(tiles)}</div>')
    return "".join(groups)


def _figures(report: Report, protocol: str) -> str:
    rows = []
    last = ""
    for key, figure in report.figures.items():
        owner, task, _ = key.split("/")
        if owner != protocol:
            continue
        if task != last:
            rows.append(f'<tr><th colspan="2" class="group">{task}</th></tr>')
            last = task
        words = meaning(key)
        rows.append(
            f'<tr><td>{escape(words.title)}<span class="note">{escape(words.formula)}</span></td>'
            f"{bar_cell(figure.value, figure.spread)}</tr>"
        )
    head = '<th>figure</th><th class="n">per cent, 95% interval</th>'
    body = f'<div class="card">{table(head, "".join(rows))}</div>'
    note = _PROTOCOLS[protocol] + (_WITHOUT_FAIR if report.fair is None else "")
    return section(f"Figures, {protocol} protocol", body, note)


def _detection(report: Report, plots: DetectionPlots) -> str:
    marks = []
    scores = None if report.fair is None else report.fair.detection
    if scores is not None:
        best, at = scores.best, scores.at
        marks = [
            (best.recall, best.precision, f"best F1 {percent(best.f1)} at {best.confidence:.2f}"),
            (at.recall, at.precision, f"at {at.confidence:.2f}"),
        ]
    cards = [
        (
            "card",
            "Precision and recall, IoU 0.5",
            line_plot(plots.recall, plots.precision, "recall", "precision", marks),
        ),
        (
            "card",
            "Confidence of right and wrong boxes",
            histogram_plot(plots.right, plots.wrong, "confidence")
            + '<p class="note key"><span><i style="background:var(--right)"></i>right</span>'
            '<span><i style="background:var(--false)"></i>wrong</span><span>logarithmic scale</span></p>',
        ),
    ]
    if plots.confusion:
        # A table of more than a few classes takes the whole width.
        kind = "card wide" if len(plots.class_names) > 4 else "card"
        cards.append((kind, "Confusion at the stated confidence", _confusion(plots)))
    body = "".join(f'<div class="{kind}"><h3>{title}</h3>{content}</div>' for kind, title, content in cards)
    note = "Right and wrong by the published matching." if report.fair is None else ""
    return section("Detection", f'<div class="grid">{body}</div>', note)


def _confusion(plots: DetectionPlots) -> str:
    *names, _ = (escape(name) for name in plots.class_names)
    rows = [[f"<td>{count}</td>" for count in counts] for counts in plots.confusion]
    rows[-1][-1] = "<td></td>"
    return table(
        "".join(f"<th>{name}</th>" for name in ("truth \\ prediction", *names, "missed")),
        "".join(
            f"<tr><th>{name}</th>{''.join(row)}</tr>" for name, row in zip((*names, "nothing there"), rows, strict=True)
        ),
        framed=True,
    )


def _pixels(report: Report) -> str:
    scores = report.task_scores()
    cards = [
        f'<div class="card"><h3>{title}</h3>{_pixel_table(scores[task])}</div>'
        for task, title in _MASKS.items()
        if task in scores
    ]
    note = "Over the data set, at canvas size." if report.fair is None else ""
    return section("Pixels", f'<div class="grid">{"".join(cards)}</div>', note) if cards else ""


def _pixel_table(scores: SegmentationScores | PublishedSegmentationScores) -> str:
    total = scores.true_positive + scores.false_positive + scores.false_negative + scores.true_negative

    def cell(count: int) -> str:
        share = percent(count / total, 2) if total else "-"
        return f'<td>{share} %<br><span class="note">{count:,}</span></td>'.replace(",", " ")

    head = "<th>truth \\ prediction</th><th>foreground</th><th>background</th>"
    body = (
        f"<tr><th>foreground</th>{cell(scores.true_positive)}{cell(scores.false_negative)}</tr>"
        f"<tr><th>background</th>{cell(scores.false_positive)}{cell(scores.true_negative)}</tr>"
    )
    left_out = f"{scores.not_labelled} not labelled"
    if isinstance(scores, SegmentationScores):
        left_out = f"{scores.both_empty} empty in truth and prediction and {left_out}"
    return f'{table(head, body, framed=True)}<p class="note">{scores.images} images count; {left_out} are left out.</p>'


def _conditions(report: Report, protocol: str) -> str:
    if not report.conditions:
        return ""
    keys = [key for key in CONDITION_FIGURES[protocol] if key in report.conditions[0].figures]
    head = "".join(f'<th class="n">{key.split("/")[1]}<br>{escape(meaning(key).title)}</th>' for key in keys)
    groups: dict[str, list[Condition]] = {}
    for row in report.conditions:
        groups.setdefault(row.attribute, []).append(row)
    cards = []
    for attribute, members in groups.items():
        rows = "".join(
            f'<tr{" class=few" if row.few else ""}><td>{escape(row.value)}</td><td class="n">{row.images}</td>'
            + "".join(bar_cell(row.figures.get(key), few=row.few_for(key)) for key in keys)
            + "</tr>"
            for row in members
        )
        full = table(f'<th>{escape(attribute)}</th><th class="n">images</th>{head}', rows)
        cards.append(f'<div class="card">{full}</div>')
    return section(
        f"By condition, {protocol} protocol",
        f'<div class="stack">{"".join(cards)}</div>',
        f"Per cent. Grey: under {FEW_IMAGES} labelled images, too few to say much.",
    )


def _variations(report: Report) -> str:
    """Robustness and input sizes, where they were measured."""
    if not report.variations:
        return ""
    parts = []
    for kind in dict.fromkeys(variation.kind for variation in report.variations):
        members = [variation for variation in report.variations if variation.kind == kind and not variation.detail]
        keys = [key for key in HEADLINES if key in members[0].figures]
        head = "".join(f'<th class="n">{key.split("/")[1]}<br>{escape(meaning(key).title)}</th>' for key in keys)
        rows = "".join(
            f"<tr><td>{escape(member.name)}</td>" + "".join(bar_cell(member.figures.get(key)) for key in keys) + "</tr>"
            for member in members
        )
        parts.append(section(kind, f'<div class="card">{table(f"<th></th>{head}", rows)}</div>', members[0].note))
    return "".join(parts)


def _worst(report: Report, task: str) -> str:
    frames = [frame for frame in report.worst if frame.task == task]
    if not frames:
        return ""
    body = f'{_KEY}<div class="frames">{"".join(_frame(frame) for frame in frames)}</div>'
    return section(f"Worst images: {task}", body)


def _frame(frame: WorstFrame) -> str:
    picture = ""
    if frame.picture:
        data = base64.b64encode(frame.picture).decode()
        picture = f'<img loading="lazy" alt="{escape(frame.name)}" src="data:image/jpeg;base64,{data}">'
    return f"<figure>{picture}<figcaption><b>{escape(frame.name)}</b><br>{escape(frame.note)}</figcaption></figure>"


def _provenance(report: Report) -> str:
    known = report.provenance
    settings = {name: value for name, value in known.settings.items() if name != "paper_thresholds"}
    rows = [
        ("model", known.model),
        ("model SHA-256", known.model_sha256 or "-"),
        ("runtime", known.runtime),
        ("data", f"{known.data}, split {known.split}, {known.images} images"),
        *((f"SHA-256 of {name}", value) for name, value in known.data_sha256.items()),
        *((f"{protocol} with", words) for protocol, words in report.thresholds().items()),
        ("settings", ", ".join(f"{name} {value}" for name, value in settings.items())),
        *((("intervals", f"drawn from {report.drawn}"),) if known.settings.get("resamples") else ()),
        ("canvas", ", ".join(known.canvas)),
        ("versions", ", ".join(f"{name} {value}" for name, value in known.versions.items())),
        ("hardware", known.hardware),
        ("started", known.started),
        ("took", f"{known.seconds:.1f} s, peak memory {known.peak_memory_mib:.0f} MiB"),
    ]
    body = "".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in rows)
    return section("Where this comes from", f'<div class="card"><dl>{body}</dl></div>')
