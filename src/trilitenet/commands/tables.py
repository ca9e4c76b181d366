"""Tables as Markdown, for commands that print the paper's."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

__all__ = ["PAPER_COLUMNS", "markdown_row"]

PAPER_COLUMNS: Final = {
    "paper/detection/recall": "Recall (%)",
    "paper/detection/map50": "mAP@0.5 (%)",
    "paper/drivable/miou": "Drivable mIoU (%)",
    "paper/lane/acc": "Lane Acc (%)",
    "paper/lane/iou": "Lane IoU (%)",
}
"""Figures that the paper's tables show -> their headings."""


def markdown_row(cells: Iterable[str]) -> str:
    """Return a row of a Markdown table."""
    return "| " + " | ".join(cells) + " |"
