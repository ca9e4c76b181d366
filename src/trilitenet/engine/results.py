"""The page at the end of a run: curves of losses, metrics and learning rate, labels beside predictions."""

from __future__ import annotations

import html
import io
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilitenet.engine.loggers import read_csv
from trilitenet.errors import import_extra, write_file

__all__ = ["write_results"]

_BALANCE: Final = "train/weight_"
"""What names of learned weights of the tasks begin with, which are no losses."""
_STYLE: Final = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem}"
    "img{max-width:100%}table{border-collapse:collapse}td,th{padding:.2rem .8rem;text-align:left}"
    "figure{margin:1rem 0}.pair{display:grid;grid-template-columns:1fr 1fr;gap:.5rem}"
)


def write_results(
    folder: Path,
    metrics: Path,
    *,
    title: str,
    facts: Mapping[str, str],
    pictures: Iterable[tuple[str, NDArray[np.uint8], NDArray[np.uint8]]] = (),
) -> Path:
    """Write the page.

    Args:
        folder: Where to; made if it is not there.
        metrics: What `CsvLogger` wrote.
        title: Of the page.
        facts: Lines of the table at its top.
        pictures: Name, labels drawn and prediction drawn ((H, W, 3) uint8 RGB) of images.

    Returns:
        The path of ``index.html``.

    Raises:
        MissingExtraError: Without Matplotlib.
        OutputError: If a file cannot be written.
    """
    curves: dict[str, tuple[list[int], list[float]]] = {}
    for step, name, value in read_csv(metrics):
        steps, values = curves.setdefault(name, ([], []))
        steps.append(step)
        values.append(value)
    groups = {
        "losses": [name for name in curves if name.startswith("train/") and not name.startswith(_BALANCE)],
        "balance": [name for name in curves if name.startswith(_BALANCE)],
        "metrics": [name for name in curves if name.startswith("val/")],
        "learning-rate": [name for name in curves if name == "lr"],
    }
    figures = []
    for group, names in groups.items():
        if names:
            plot = _plot({name: curves[name] for name in names}, log=group == "losses")
            write_file(folder / f"{group}.png", plot)
            figures.append(f'<figure><img src="{group}.png" alt="{group} by step"></figure>')
    pairs = []
    for number, (name, labels, prediction) in enumerate(pictures):
        for what, image in (("labels", labels), ("prediction", prediction)):
            picture = io.BytesIO()
            Image.fromarray(image).save(picture, "JPEG", quality=85)
            write_file(folder / f"{what}-{number}.jpg", picture.getvalue())
        pairs.append(
            f'<figure><figcaption>{html.escape(name)}: labels, prediction</figcaption><div class="pair">'
            f'<img src="labels-{number}.jpg" alt="labels"><img src="prediction-{number}.jpg" alt="prediction">'
            "</div></figure>"
        )
    rows = "".join(f"<tr><th>{html.escape(key)}</th><td>{html.escape(value)}</td></tr>" for key, value in facts.items())
    page = folder / "index.html"
    write_file(
        page,
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title>"
        f"<style>{_STYLE}</style><h1>{html.escape(title)}</h1><table>{rows}</table>{''.join(figures)}"
        f"{'<h2>Labels and predictions</h2>' if pairs else ''}{''.join(pairs)}</html>\n",
    )
    return page


def _plot(curves: Mapping[str, tuple[list[int], list[float]]], *, log: bool) -> bytes:
    """Return a PNG."""
    module: Any = import_extra("matplotlib.figure", "train")
    if log:  # of a term that is 0 throughout, as of a task without labels, there is nothing to see
        curves = {
            name: (steps, values)
            for name, (steps, values) in curves.items()
            if any(value != 0 and math.isfinite(value) for value in values)
        }
    figure = module.Figure(figsize=(10, 5), layout="constrained")
    axes = figure.add_subplot()
    for name, (steps, values) in curves.items():
        axes.plot(steps, values, label=name, marker="o" if len(steps) < 30 else None, markersize=3)
    finite = [value for _, values in curves.values() for value in values if math.isfinite(value)]
    if log and finite and min(finite) >= 0:  # with learned weights the total may be below
        axes.set_yscale("log")
        axes.set_ylim(bottom=max(axes.get_ylim()[0], max(finite) / 1e4))  # a term next to nothing flattens no other
    axes.set_xlabel("step")
    axes.grid(alpha=0.3)
    if curves:
        axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))  # beside the curves, over none of them
    picture = io.BytesIO()
    figure.savefig(picture, dpi=100)
    return picture.getvalue()
