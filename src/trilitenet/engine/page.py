"""Pieces of a self-contained HTML page: escaping, tables with bars, and plots as inline SVG."""

from __future__ import annotations

import html
import math
import string
from collections.abc import Sequence
from importlib import resources

__all__ = ["bar_cell", "escape", "histogram_plot", "interval_plot", "line_plot", "page", "percent", "section", "table"]

_WIDTH, _HEIGHT = 360, 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 50, 10, 10, 36


def escape(text: object) -> str:
    """Return text safe inside HTML."""
    return html.escape(str(text))


def percent(value: float | None, digits: int = 1) -> str:
    """Return a ratio as per cent, a dash where it is undefined."""
    return "-" if value is None or math.isnan(value) else f"{100 * value:.{digits}f}"


def page(title: str, body: str) -> str:
    """Return a whole page.

    Args:
        title: Plain text.
        body: HTML.
    """
    template = resources.files("trilitenet.engine").joinpath("templates/page.html").read_text(encoding="utf-8")
    return string.Template(template).substitute(title=escape(title), body=body)


def section(title: str, body: str, note: str = "") -> str:
    """Return a titled part of the page; ``note`` is plain text."""
    below = f'<p class="note">{escape(note)}</p>' if note else ""
    return f"<section><h2>{escape(title)}</h2>{below}{body}</section>"


def bar_cell(value: float | None, note: str = "", *, few: bool = False) -> str:
    """Return a table cell with a ratio as per cent and as a bar, and a few small words; grey if from few images."""
    if value is None or math.isnan(value):
        return '<td class="n">-</td>'
    width = max(0.0, min(1.0, value)) * 100
    bar = f'<span class="track"><span class="bar" style="width:{width:.1f}%"></span></span>'
    words = f'<span class="note">{escape(note)}</span>' if note else ""
    return f'<td class="n{" few" if few else ""}">{percent(value)}{bar}{words}</td>'


def table(head: str, body: str, *, framed: bool = False) -> str:
    """Return a table that scrolls sideways where the screen is narrow.

    Args:
        head: Header cells, as HTML.
        body: Rows, as HTML.
        framed: Draw lines around every cell.
    """
    kind = ' class="cells"' if framed else ""
    return f'<div class="scroll"><table{kind}><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def _axes(
    x_label: str, y_label: str, x_ticks: Sequence[tuple[float, str]], y_ticks: Sequence[tuple[float, str]]
) -> str:
    """Return grid, ticks and labels; ticks are (position in [0, 1], text)."""
    parts = []
    for at, text in y_ticks:
        y = _y(at)
        parts.append(f'<line class="gridline" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 5}" y="{y + 4:.1f}" text-anchor="end">{escape(text)}</text>')
    for at, text in x_ticks:
        parts.append(f'<text x="{_x(at):.1f}" y="{_HEIGHT - _BOTTOM + 15}" text-anchor="middle">{escape(text)}</text>')
    base = _HEIGHT - _BOTTOM
    parts.append(f'<path class="axis" d="M{_LEFT} {_TOP}V{base}H{_WIDTH - _RIGHT}"/>')
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{_HEIGHT - 5}" text-anchor="middle">{escape(x_label)}</text>')
    high = (_TOP + base) / 2
    parts.append(
        f'<text x="9" y="{high}" text-anchor="middle" transform="rotate(-90 9 {high})">{escape(y_label)}</text>'
    )
    return "".join(parts)


def _x(value: float) -> float:
    return _LEFT + value * (_WIDTH - _LEFT - _RIGHT)


def _y(value: float) -> float:
    return _HEIGHT - _BOTTOM - value * (_HEIGHT - _TOP - _BOTTOM)


def _svg(content: str, label: str, height: float = _HEIGHT) -> str:
    return f'<svg viewBox="0 0 {_WIDTH} {height:g}" role="img" aria-label="{escape(label)}">{content}</svg>'


_TENTHS = tuple((step / 5, f"{step / 5:g}") for step in range(6))


def line_plot(
    x: Sequence[float], y: Sequence[float], x_label: str, y_label: str, marks: Sequence[tuple[float, float, str]] = ()
) -> str:
    """Return a curve over [0, 1] x [0, 1].

    Args:
        x: Along the curve.
        y: Likewise.
        x_label: Plain text.
        y_label: Plain text.
        marks: At most two points, with a few words each that stand below.
    """
    points = [(a, b) for a, b in zip(x, y, strict=True) if not (math.isnan(a) or math.isnan(b))]
    path = " ".join(f"{_x(a):.1f},{_y(b):.1f}" for a, b in points)
    content = _axes(x_label, y_label, _TENTHS, _TENTHS) + f'<polyline class="curve" points="{path}"/>'
    key = []
    for (a, b, words), name in zip(marks, ("dot", "ring"), strict=False):
        if math.isnan(a) or math.isnan(b):
            continue
        content += f'<circle class="{name}" cx="{_x(a):.1f}" cy="{_y(b):.1f}" r="5"/>'
        key.append(f'<span><i class="{name}"></i>{escape(words)}</span>')
    words = f'<p class="note key">{"".join(key)}</p>' if key else ""
    return _svg(content, f"{y_label} against {x_label}") + words


def histogram_plot(right: Sequence[int], wrong: Sequence[int], x_label: str) -> str:
    """Return right and wrong counts side by side over equal bins of [0, 1], on a logarithmic scale."""
    most = max((*right, *wrong, 1))
    decades = max(1, math.ceil(math.log10(most + 1)))
    ticks = [(power / decades, f"{10**power:,}".replace(",", " ")) for power in range(decades + 1)]
    content = _axes(x_label, "boxes", _TENTHS, ticks)
    for index, counts in enumerate(zip(right, wrong, strict=True)):
        for shift, (count, name) in enumerate(zip(counts, ("hit", "bad"), strict=True)):
            if count:
                # one box stands a little above the axis
                height = max(0.02, math.log10(count) / decades)
                left = _x((index + 0.06 + 0.44 * shift) / len(right))
                width = _x(0.44 / len(right)) - _x(0)
                top = _y(height)
                content += (
                    f'<rect class="{name}" x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" '
                    f'height="{_y(0) - top:.1f}"><title>{count}</title></rect>'
                )
    return _svg(content, f"right and wrong boxes by {x_label}")


def interval_plot(rows: Sequence[tuple[str, float, float, float, bool]], label: str) -> str:
    """Return a dot and whiskers a row around zero.

    Args:
        rows: Words, value, low, high, and whether the difference is real.
        label: What is plotted.
    """
    known = [value for _, *values, _ in rows for value in values if not math.isnan(value)]
    reach = max([abs(value) for value in known] + [1e-6]) * 1.15
    step, top, words = 22, 8, 130

    def across(value: float) -> float:
        return words + (value / reach + 1) / 2 * (_WIDTH - words - 10)

    height = top + step * len(rows) + 26
    base = top + step * len(rows) + 4
    parts = [f'<line class="zero" x1="{across(0):.1f}" x2="{across(0):.1f}" y1="{top}" y2="{base}"/>']
    for index, (name, value, low, high, real) in enumerate(rows):
        y = top + step * (index + 0.5)
        parts.append(f'<text x="0" y="{y + 4:.1f}">{escape(name)}</text>')
        if math.isnan(value):
            continue
        if not (math.isnan(low) or math.isnan(high)):
            parts.append(
                f'<line class="whisker" x1="{across(low):.1f}" x2="{across(high):.1f}" y1="{y:.1f}" y2="{y:.1f}"/>'
            )
        parts.append(f'<circle class="{"real" if real else "unsure"}" cx="{across(value):.1f}" cy="{y:.1f}" r="5"/>')
    for value in (-reach / 1.15, 0.0, reach / 1.15):
        parts.append(
            f'<text x="{across(value):.1f}" y="{base + 15:.1f}" text-anchor="middle">{100 * value:+.1f}</text>'
        )
    return _svg("".join(parts), label, height)
