"""Marks of results that are not whole, by which a later `predict` sees what is to be done anew."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from trilitenet.commands.predict_plan import Plan, mark_of, read_mark
from trilitenet.errors import writing
from trilitenet.inference.sources import FrameReader

__all__ = ["Marks"]


class Marks:
    """The marks of a run: files that are there while others hold but some of what they should.

    Attributes:
        whole: Whether all sources were done; the run says so at its end.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._videos = {source.name: source for source in plan.sources if isinstance(source, FrameReader)}
        self._unfinished: dict[str, bool] = {}
        self._gathered = False
        self.whole = False

    @property
    def partial(self) -> tuple[Path, ...]:
        """Files of all sources together that hold some of them alone."""
        return tuple(self._plan.gathered) if self._gathered and not self.whole else ()

    def mark_gathered(self) -> None:
        """Leave the marks of the files of all sources, which hold but some of them until the run's end."""
        if self._gathered:
            return
        self._gathered = True
        for file in self._plan.gathered:
            with writing(file):
                mark_of(file).touch()

    def remove_gathered(self) -> None:
        """Remove the marks of files that hold all sources, and of those that were not written."""
        for file in self._plan.gathered if self._gathered else ():
            if self.whole or not file.exists():
                with writing(file):
                    mark_of(file).unlink(missing_ok=True)

    def begin(self, name: str) -> None:
        """Note that a video has a result."""
        self._unfinished[name] = True

    def finish(self, name: str) -> None:
        """Note that a video was done to its end."""
        self._unfinished[name] = False

    def mark_unfinished(self, name: str) -> None:
        """Leave the mark of a video that was not done to its end, which names its results."""
        if self._unfinished.get(name):
            mark = self._plan.mark(name)
            _write_mark(mark, self._files(name) | (read_mark(mark) or frozenset()))

    def remove_unfinished(self) -> None:
        """Remove the marks of videos that were done to their end, and of those that have no results.

        Those of files that an earlier run left, and this one did not replace, stay.
        """
        for name, unfinished in self._unfinished.items():
            mark = self._plan.mark(name)
            rest = read_mark(mark) or frozenset()
            if not unfinished:
                rest -= self._files(name)
            with writing(mark):
                if any(map(Path.exists, rest)):
                    _write_mark(mark, rest)
                else:
                    mark.unlink(missing_ok=True)

    def _files(self, name: str) -> frozenset[Path]:
        return frozenset(self._plan.files(self._videos[name], name))


def _write_mark(mark: Path, files: frozenset[Path]) -> None:
    mark.touch()
    with contextlib.suppress(OSError):  # no room for the names: it is of any file then
        mark.write_text(
            json.dumps(sorted(file.relative_to(mark.parent).as_posix() for file in files)), encoding="utf-8"
        )
