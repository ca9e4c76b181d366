"""Tables as Markdown, for commands that print the paper's."""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["markdown_row"]


def markdown_row(cells: Iterable[str]) -> str:
    """Return a row of a Markdown table."""
    return "| " + " | ".join(cells) + " |"
