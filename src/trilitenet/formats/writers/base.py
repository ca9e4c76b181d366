"""What every writer is: it takes perceptions one by one and leaves files of one format.

    with open_writer("coco", "results") as writer:
        for perception in perceptions:
            writer.write(perception)
    print(writer.files)

Memory stays flat over any number of frames, unless a format's own layout forbids it (said where it does). A file gets
its final name when it is whole: until then it ends in ``.part``. JSON lines and CSV, which are whole after each line,
have theirs from their first line on.
"""

from __future__ import annotations

import abc
import contextlib
import importlib
import io
import json
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path, PurePath
from types import FrameType, TracebackType
from typing import IO, TYPE_CHECKING, Any, ClassVar, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import Claim, ConfigError, FreeNames, OutputError, did_you_mean, import_extra, part_of, writing
from trilitenet.structures import Perception

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = [
    "WRITERS",
    "GrowingFile",
    "JsonStream",
    "Writer",
    "dumps",
    "file_stem",
    "find_writer",
    "objects",
    "open_writer",
    "polylines",
    "rounded",
    "uninterrupted",
]

WRITERS: Final[dict[str, str]] = {
    "json": "trilitenet.formats.writers.native:JsonWriter",
    "jsonl": "trilitenet.formats.writers.native:JsonLinesWriter",
    "scalabel": "trilitenet.formats.writers.scalabel:ScalabelWriter",
    "openlabel": "trilitenet.formats.writers.openlabel:OpenLabelWriter",
    "coco": "trilitenet.formats.writers.coco:CocoWriter",
    "yolo": "trilitenet.formats.writers.yolo:YoloWriter",
    "cvat": "trilitenet.formats.writers.cvat:CvatWriter",
    "parquet": "trilitenet.formats.writers.tables:ParquetWriter",
    "csv": "trilitenet.formats.writers.tables:CsvWriter",
}
"""The name a user gives to ``--format`` -> where its writer lives; imported when asked for."""


class Writer(abc.ABC):
    """Takes perceptions one by one, and writes files of one format into a folder.

    Frames of a video come in order, and one video is finished before the next source starts.

    Args:
        output: The folder; made if it does not exist.
        overwrite: Replace files that exist.

    Attributes:
        files: The files that are whole so far, those that grow by whole lines among them.
    """

    EXTRA: ClassVar[tuple[str, str] | None] = None
    """A package that it needs, and the extra that installs it."""
    FILES: ClassVar[tuple[str, ...]] = ()
    """Names of the files that it writes whatever it is given."""
    GATHERS: ClassVar[bool] = True
    """Whether those hold what is of each source, not just what they have in common."""
    PICTURE_FILES: ClassVar[tuple[str, ...]] = ()
    """Names of the files that it writes for a picture; ``{}`` is the source's `stem`."""
    VIDEO_FILES: ClassVar[tuple[str, ...]] = ()
    """Names of the files that it writes for a video; ``*`` stands for a number a frame."""

    def __init__(self, output: Path, *, overwrite: bool = False) -> None:
        self.output = output
        self.overwrite = overwrite
        self.files: list[Path] = []
        self._begun: dict[Path, Claim] = {}
        self._stems: dict[str, str] = {}
        self._free = FreeNames(files=True)
        self._names: Counter[str] = Counter()
        self._unnamed = 0
        self._empty = True
        self._broken = False
        self._closed = False

    def write(self, perception: Perception, road: Mapping[str, Any] | None = None) -> None:
        """Write one image or frame.

        Args:
            perception: What the network sees.
            road: What follows from it for the road, as its ``to_dict`` gives; a format that has no place for it
                leaves it out.

        Raises:
            OutputError: If a file exists and may not be replaced, or cannot be written, or an earlier one could not; if
                the source's name is not UTF-8, as files of text need it; or if the writer was closed.
        """
        if self._closed:
            raise OutputError(f"{self.output}: the writer was closed")
        if self._broken:
            raise OutputError(f"{self.output}: a result could not be written, and what followed it would have a gap")
        if perception.source is not None:
            _check_text(perception.source)  # before anything of it is kept, which the file could not hold at its end
        with uninterrupted():
            self._empty = False
            try:
                self._write(perception, road)
            except OSError as error:
                self._broken = not isinstance(error, OutputError)
                raise

    def remove_remains(self, source: str) -> None:  # noqa: B027 - a new file replaces the old one whole
        """Remove what an earlier run left of a video among its results, now that it is done to its end.

        Args:
            source: The video, as its perceptions name it.

        Raises:
            OutputError: If a file cannot be removed.
        """

    def close(self) -> None:
        """Finish every file, but none that a failed write may have left with a gap; a writer can be closed twice.

        If nothing was written, files that exist stay as they are.
        """
        self._closed = True
        with uninterrupted():
            try:
                self._close()
            finally:
                while self._begun:
                    self._begun.popitem()[1].close()

    @abc.abstractmethod
    def _write(self, perception: Perception, road: Mapping[str, Any] | None = None) -> None:
        """Write one image or frame; Ctrl-C and SIGTERM wait for the end of it."""

    @abc.abstractmethod
    def _close(self) -> None:
        """Finish every file that is not finished."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish what there is; where that fails, leave no half file."""
        try:
            self.close()
        except (OSError, ValueError):  # the latter from a file that an earlier failure has closed
            if not self._broken:  # told already
                raise

    def create(self, name: str) -> Path:
        """Return the path of a file to write, in a folder that exists.

        Raises:
            OutputError: If it exists and ``overwrite`` was not asked for, or it is being written already, or the folder
                cannot be made.
        """
        path = self.output / name
        if path.exists() and not self.overwrite:
            raise OutputError(f"{path} exists; choose another --output or add --overwrite")
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        self._begun[path] = Claim(path)
        return path

    def finish(self, path: Path) -> None:
        """Give a file that is whole its final name; after a failed write it goes, for it may have a gap.

        One without any result goes too where it would replace another.
        """
        if not (self._broken or (self._empty and path.exists())):
            part_of(path).replace(path)
            self.files.append(path)
        self._begun.pop(path).close()

    def write_whole(self, path: Path, text: str) -> None:
        """Write a small file at once, so that it is whole or not there."""
        try:
            part_of(path).write_text(text, encoding="utf-8")
            self.finish(path)
        except BaseException:
            self._begun.pop(path).close()
            raise

    def stem(self, source: str | None) -> str:
        """Return a file name without ending for a perception's source: the same for all frames of a video.

        Two sources of the same name are told apart by ``-2``, ``-3`` ...
        """
        if source is None:
            self._unnamed += 1
            return f"image-{self._unnamed:06d}"
        if source not in self._stems:
            self._stems[source] = self._free.give(file_stem(source))
            self._names[PurePath(source).name] += 1
        return self._stems[source]

    def image_name(self, perception: Perception) -> str:
        """Return the name of the picture as data sets list it.

        A still image keeps its file name (its whole path where another source that `stem` has named so far is called
        the same); a frame of a video gets ``NAME-0000012.jpg``, as the frames of BDD100K's videos are called.
        """
        stem = self.stem(perception.source)
        if perception.frame is not None:
            return f"{stem}-{perception.frame:07d}.jpg"
        if perception.source is None:
            return f"{stem}.jpg"
        name = PurePath(perception.source).name
        return name if self._names[name] == 1 else PurePath(perception.source).as_posix()


def open_writer(format: str, output: str | Path, *, overwrite: bool = False, **options: Any) -> Writer:
    """Return the writer of a format.

    Args:
        format: One of `WRITERS`.
        output: The folder to write into.
        overwrite: Replace files that exist.
        options: What the format's own writer takes besides.

    Raises:
        ConfigError: If the format is unknown.
        MissingExtraError: If the format needs a package that is not installed.
    """
    return find_writer(format)(Path(output), overwrite=overwrite, **options)


def _check_text(source: str) -> None:
    """Refuse a name that is not UTF-8, which Python holds, but no file of text can.

    Raises:
        OutputError: If it is one.
    """
    try:
        source.encode()
    except UnicodeEncodeError as error:
        shown = source.encode(errors="backslashreplace").decode()
        raise OutputError(f"{shown}: its name is not UTF-8; rename it") from error


def file_stem(source: str) -> str:
    """Return a source's name as that of a file without ending: of a URL without a path its whole address."""
    path = PurePath(source)
    if "://" in source and len(path.parts) == 2:
        return path.name.replace(":", "-")
    return path.stem or "image"


def find_writer(format: str) -> type[Writer]:
    """Return the class of a format's writer.

    Raises:
        ConfigError: If the format is unknown.
        MissingExtraError: If the format needs a package that is not installed.
    """
    if format not in WRITERS:
        raise ConfigError(f"unknown format {format!r}{did_you_mean(format, WRITERS)}")
    module, _, name = WRITERS[format].partition(":")
    writer: type[Writer] = getattr(importlib.import_module(module), name)
    if writer.EXTRA is not None:
        import_extra(*writer.EXTRA)
    return writer


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Let Ctrl-C and SIGTERM, which may come between any two steps of Python, wait for the end of the block."""
    before: dict[int, Callable[[int, FrameType | None], Any]] = {}
    held: list[tuple[int, FrameType | None]] = []
    if threading.current_thread() is threading.main_thread():
        for interruption in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(interruption)
            if callable(handler):  # no exception comes from others
                before[interruption] = handler
                signal.signal(interruption, lambda number, frame: held.append((number, frame)))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if held:
            before[held[0][0]](*held[0])


class GrowingFile:
    """A text file that is whole after each addition: one that cannot be written in full is taken back.

    With the first addition that is kept it has its name, and replaces what is there.

    Args:
        path: The file; its folder exists.
        files: Takes the path when the file has its name.
        head: Text before the first addition.
    """

    def __init__(self, path: Path, files: list[Path], head: str = "") -> None:
        self.path = path
        self._files = files
        self._head = head
        self._handle: io.FileIO | None = None
        self._before = self._end = 0

    def add(self, text: str) -> None:
        """Write what belongs to one image or frame.

        Raises:
            OSError: If it cannot be written; it names the file, which takes nothing more.
        """
        try:
            if self._handle is None:
                self._handle = io.FileIO(part_of(self.path), "w")
                text = self._head + text
            rest = text.encode()
            self._before, self._end = self._end, self._end + len(rest)
            while rest:
                rest = rest[self._handle.write(rest) :]
        except OSError as error:
            self.take_back()
            error.filename = str(self.path)
            raise

    def keep(self) -> None:
        """Let the last addition stay."""
        if self._handle is not None and self.path not in self._files:
            self._handle.close()  # Windows renames and removes no file that is open
            part_of(self.path).replace(self.path)
            self._handle = io.FileIO(self.path, "a")
            self._files.append(self.path)

    def take_back(self) -> None:
        """Forget the last addition, and with the first the file, and end it."""
        if self._handle is None:
            return
        if self._before:
            self._handle.truncate(self._before)
        self._handle.close()
        if not self._before:
            part_of(self.path).unlink(missing_ok=True)

    def close(self) -> None:
        """End the file. Without any addition one that is there stays as it is, else it is made of the head alone."""
        if self._handle is None and not self.path.exists():
            self.add("")
            self.keep()
        if self._handle is not None:
            self._handle.close()


class JsonStream:
    """A JSON document written piece by piece: one long list or object between a head and a tail.

    Args:
        path: The file; its final name comes with `close`.
        head: JSON text up to the first element, such as ``{"frames": [``.
    """

    def __init__(self, path: Path, head: str) -> None:
        self.path = path
        self._handle: IO[str] = part_of(path).open("w", encoding="utf-8")
        self._handle.write(head)
        self._first = True

    def add(self, value: Any, key: str | None = None) -> None:
        """Write the next element of the list, or the next member of the object."""
        text = dumps(value) if key is None else f"{json.dumps(key)}: {dumps(value)}"  # whole, or it raises first
        self._handle.write(("\n" if self._first else ",\n") + text)
        self._first = False

    def close(self, tail: str) -> None:
        """Write the JSON text after the last element, and close the file."""
        with contextlib.closing(self._handle) as handle:
            handle.write(f"\n{tail}\n")


def dumps(value: Any) -> str:
    """Return one line of JSON; not-a-number and infinity are refused, because JSON has neither."""
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


class Found(NamedTuple):
    """A box of a perception; ``track_id`` is -1 where its identity is not known."""

    corners: NDArray[np.float32]
    name: str
    class_id: int
    confidence: float
    track_id: int


def objects(perception: Perception) -> Iterator[Found]:
    """Yield the boxes of a perception, best first."""
    boxes = perception.boxes
    if boxes is None:
        return
    tracks = [-1] * len(boxes) if boxes.track_id is None else boxes.track_id.tolist()
    names = [perception.class_names[class_id] for class_id in boxes.class_id]
    yield from map(Found, boxes.xyxy, names, boxes.class_id.tolist(), boxes.confidence.tolist(), tracks)


def polylines(road: Mapping[str, Any] | None) -> Iterator[tuple[int, list[list[float]]]]:
    """Yield the id and the points of each line of a lane, near to far, in continuous pixels (not OpenCV's)."""
    for line in () if road is None else road["lines"]:
        yield line["id"], [[round(x + 0.5, 2), round(y + 0.5, 2)] for x, y in line["points"]]


def rounded(pixels: Any) -> Iterator[float]:
    """Yield plain floats, rounded to a hundredth."""
    return (round(float(value), 2) for value in pixels)
