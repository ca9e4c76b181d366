"""Progress of long work, shown on the terminal; nothing where standard error is none."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Iterator

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

__all__ = ["ProgressBar", "show_bars", "show_progress"]


class ProgressBar:
    """A bar: called with how much is done, and of how much."""

    def __init__(self, progress: Progress, task: TaskID) -> None:
        self._progress, self._task = progress, task

    def __call__(self, done: int, total: int) -> None:
        """Show how much is done."""
        self._progress.update(self._task, completed=done, total=total)

    def name(self, what: str) -> None:
        """Say what is worked on from now on."""
        self._progress.update(self._task, description=what)


@contextlib.contextmanager
def show_progress(what: str) -> Iterator[ProgressBar]:
    """Yield a bar that is gone at the end.

    Args:
        what: What is counted.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with show_bars(*columns, transient=True) as progress:
        yield ProgressBar(progress, progress.add_task(what, total=None))


@contextlib.contextmanager
def show_bars(
    *columns: ProgressColumn, quiet: bool = False, transient: bool = False, expand: bool = False
) -> Iterator[Progress]:
    """Yield what shows bars, a line each; messages of the log go above them.

    Args:
        columns: What a line is made of.
        quiet: Show nothing, on a terminal either; ``disable`` of what is yielded says whether it is so.
        transient: Nothing of them stays at the end.
        expand: A column with a ratio takes what the others leave of the terminal's width.
    """
    console = Console(stderr=True)
    progress = Progress(
        *columns, console=console, transient=transient, expand=expand, disable=quiet or not console.is_terminal
    )
    direct = sys.stderr
    handlers = [
        handler
        for handler in logging.getLogger().handlers
        if isinstance(handler, logging.StreamHandler) and handler.stream is direct
    ]
    with progress:
        for handler in handlers:
            handler.setStream(sys.stderr)  # while bars are shown it writes above them
        try:
            yield progress
        finally:
            for handler in handlers:
                handler.setStream(direct)
