"""Progress of long work, shown on the terminal; nothing where standard error is none."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

__all__ = ["ProgressBar", "show_progress"]


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
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        yield ProgressBar(progress, progress.add_task(what, total=None))
