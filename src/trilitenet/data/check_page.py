"""The report of `check_dataset` as one HTML page without outside parts: tables, plots as SVG, a contact sheet."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.config import DEFAULT_ANCHORS
from trilitenet.data.checking import KINDS, CheckReport
from trilitenet.data.description import folder_name

__all__ = ["check_page", "picture_page"]

_STYLE: Final = """
:root { color-scheme: light dark; --line: #8884; --bar: #0072b2; --two: #e69f00; --bad: #c0392b; --good: #1e8449; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 78rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
table { border-collapse: collapse; } th, td { padding: .25rem .8rem .25rem 0; text-align: left; vertical-align: top;
border-bottom: 1px solid var(--line); } td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
code { font-size: .85em; } .bad { color: var(--bad); font-weight: 600; } .good { color: var(--good); font-weight: 600; }
.plots { display: flex; flex-wrap: wrap; gap: 1.5rem; } figure { margin: 0; } figcaption { font-size: .85rem;
overflow-wrap: anywhere; }
img, svg { display: block; max-width: 100%; height: auto; } .scroll { overflow-x: auto; }
svg text { font: 11px system-ui, sans-serif; fill: currentColor; }
"""
_MOST_ROWS: Final = 65_000
"""JPEG has no room for many more rows; of a higher picture it takes several, one below the other."""
_SERIES: Final = ("var(--bar)", "var(--two)", "#009e73", "#cc79a7")


def check_page(report: CheckReport, sheet: NDArray[np.uint8] | None = None) -> str:
    """Return the page.

    Args:
        report: What was found.
        sheet: (H, W, 3) uint8 RGB contact sheet.
    """
    splits = list(report.images)
    state = '<span class="good">nothing wrong</span>'
    if report.findings:
        total = sum(finding.count for finding in report.findings)
        state = f'<span class="bad">{total} faults of {len({f.kind for f in report.findings})} kinds</span>'
    tasks = ("detection", "drivable", "lane")
    rows = [
        [split, report.images[split], *(report.labelled[split].get(task, 0) for task in tasks),
         _percent(report.drivable.get(split)), _percent(report.lane.get(split))]
        for split in splits
    ]  # fmt: skip
    body = [
        f"<h1>{_text(folder_name(report.root))}</h1><p>{state}. Taken for {_text(report.layout)}.</p>",
        "<h2>Faults</h2>",
        _table(
            ["kind", "what", "split", "count", "examples"],
            [[f.kind, KINDS[f.kind], f.split, f.count, _Code(f.examples)] for f in report.findings],
        )
        if report.findings
        else "<p>None.</p>",
        "<h2>Splits</h2>",
        _table(["split", "images", *(f"labelled: {task}" for task in tasks), "area drivable", "area lane"], rows),
        "<h2>Boxes</h2>",
        _table(["category", *splits], _by_row({split: report.objects[split] for split in splits})),
        '<div class="plots">',
        _figure(_box_plot(report.box_sizes), _box_caption(report)),
        _figure(_bars({"images": dict(list(report.sizes.items())[:16])}), "Image sizes"),
        "</div><h2>Conditions</h2><div class='plots'>",
        *(
            _figure(_bars({split: {v: c.get(split, 0) for v, c in values.items()} for split in splits}), _text(name))
            for name, values in report.conditions.items()
        ),
        "</div>",
    ]
    if sheet is not None:
        parts = [sheet[top : top + _MOST_ROWS] for top in range(0, len(sheet), _MOST_ROWS)]
        body += ["<h2>Some of it, with its labels</h2>", *(_image(part, "images with their labels") for part in parts)]
    return _page(f"Check of {folder_name(report.root)}", body)


def picture_page(title: str, groups: Mapping[str, Iterable[tuple[str, NDArray[np.uint8]]]]) -> str:
    """Return a page of pictures.

    Args:
        title: Of the page.
        groups: Heading -> captions and (H, W, 3) uint8 RGB pictures.
    """
    body = [f"<h1>{_text(title)}</h1>"]
    for heading, pictures in groups.items():
        body.append(f"<h2>{_text(heading)}</h2><div class='plots'>")
        body += [
            _figure(_image(picture, caption), _text(caption), width=picture.shape[1]) for caption, picture in pictures
        ]
        body.append("</div>")
    return _page(title, body)


class _Code(tuple[str, ...]):
    """Cell content shown as one line of code each."""


def _page(title: str, body: Iterable[str]) -> str:
    return (
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>"
        f"<title>{_text(title)}</title><style>{_STYLE}</style></head>\n<body>\n"
        + "\n".join(body)
        + "\n</body></html>\n"
    )


def _text(value: object) -> str:
    return html.escape(str(value))


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.1%}"


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    def cell(value: object, tag: str = "td") -> str:
        if isinstance(value, _Code):
            return f"<{tag}>" + "<br>".join(f"<code>{_text(line)}</code>" for line in value) + f"</{tag}>"
        number = isinstance(value, int) or (isinstance(value, str) and value.endswith("%"))
        return f"<{tag}{' class=n' if number else ''}>{_text(value)}</{tag}>"

    top = "<tr>" + "".join(cell(name, "th") for name in head) + "</tr>"
    body = "".join("<tr>" + "".join(cell(value) for value in row) + "</tr>" for row in rows)
    return f"<div class='scroll'><table>{top}{body}</table></div>"


def _by_row(columns: Mapping[str, Mapping[str, int]]) -> list[list[object]]:
    names = sorted({name for column in columns.values() for name in column})
    return [[name, *(column.get(name, 0) for column in columns.values())] for name in names]


def _figure(content: str, caption: str, width: int | None = None) -> str:
    """Return a drawing above its caption, both of at most so many pixels."""
    style = "" if width is None else f' style="max-width: {width}px"'
    return f"<figure{style}>{content}<figcaption>{caption}</figcaption></figure>"


def _image(picture: NDArray[np.uint8], text: str) -> str:
    """Return a picture; ``text`` stands for it where it is not seen."""
    data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
    return f'<img alt="{_text(text)}" src="data:image/jpeg;base64,{base64.b64encode(data).decode()}">'


def _bars(series: Mapping[str, Mapping[str, int]]) -> str:
    """Return horizontal bars, grouped by value, one colour a series, with a legend where there are several."""
    labels = list(dict.fromkeys(label for counts in series.values() for label in counts))
    top = max((count for counts in series.values() for count in counts.values()), default=0) or 1
    left, width, height = 150, 260, 14
    group = height * len(series) + 6
    parts, y = [], 4
    for label in labels:
        shown = label if len(label) <= 22 else f"{label[:20]}.."
        parts.append(f'<text x="{left - 6}" y="{y + group / 2}" text-anchor="end">{_text(shown or "none")}</text>')
        for number, counts in enumerate(series.values()):
            count = counts.get(label, 0)
            long = max(round(width * count / top), 1 if count else 0)
            parts.append(
                f'<rect x="{left}" y="{y + number * height}" width="{long}" height="{height - 2}" '
                f'fill="{_SERIES[number % len(_SERIES)]}"/>'
                f'<text x="{left + long + 4}" y="{y + number * height + 10}">{count}</text>'
            )
        y += group
    if len(series) > 1:
        for number, name in enumerate(series):
            x = left + 90 * number
            parts.append(
                f'<rect x="{x}" y="{y}" width="10" height="10" fill="{_SERIES[number % len(_SERIES)]}"/>'
                f'<text x="{x + 14}" y="{y + 9}">{_text(name)}</text>'
            )
        y += 16
    return _svg(left + width + 60, y + 4, parts)


def _box_plot(sizes: Sequence[tuple[float, float]]) -> str:
    """Return box sizes and anchors on logarithmic axes from 1 to 640 pixels."""
    side, margin = 320, 36

    def place(value: float) -> float:
        return side * math.log(min(max(value, 1.0), 640.0)) / math.log(640.0)

    parts = [f'<rect x="{margin}" y="4" width="{side}" height="{side}" fill="none" stroke="var(--line)"/>']
    for tick in (1, 4, 16, 64, 256):
        parts.append(f'<text x="{margin + place(tick)}" y="{side + 18}" text-anchor="middle">{tick}</text>')
        parts.append(f'<text x="{margin - 5}" y="{side + 8 - place(tick)}" text-anchor="end">{tick}</text>')
    for width, height in sizes:
        x, y = margin + place(width), side + 4 - place(height)
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.6" fill="var(--bar)" fill-opacity=".35"/>')
    for level in DEFAULT_ANCHORS:
        for width, height in level:
            x, y = margin + place(width), side + 4 - place(height)
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" fill="none" stroke="var(--two)" stroke-width="2"/>')
    return _svg(side + margin + 8, side + 26, parts)


def _svg(width: int, height: int, parts: Iterable[str]) -> str:
    """Return a drawing of so many pixels, which gets smaller where the page is narrower."""
    return f'<svg width="{width}" height="{height}" viewBox="0 0 {width} {height}">{"".join(parts)}</svg>'


def _box_caption(report: CheckReport) -> str:
    recall = "no boxes" if math.isnan(report.anchor_recall) else f"best possible recall {report.anchor_recall:.2%}"
    return f"Box width and height in pixels at a long side of 640; rings are anchors ({recall})"
