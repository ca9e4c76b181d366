"""Where frames come from: pictures, folders, video files, streams, cameras, numbered pictures, standard input.

What a user names becomes a list of `Stills` and frame readers. A reader gives `Frame` after `Frame` with its index and
time stamp, applies `Clip`, and never holds more than a few frames.
"""

from __future__ import annotations

import abc
import contextlib
import dataclasses
import functools
import glob
import heapq
import itertools
import logging
import math
import os
import re
import sys
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import ConfigError, FreeNames, InputError, import_extra
from trilitenet.processing.images import read_image

__all__ = [
    "VIDEO_SUFFIXES",
    "CameraReader",
    "Clip",
    "Failure",
    "Frame",
    "FrameReader",
    "SequenceReader",
    "Stills",
    "StreamReader",
    "VideoReader",
    "find_sources",
    "silent_opencv",
]

VIDEO_SUFFIXES: Final = frozenset(
    {
        ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".ts", ".m2ts", ".mts", ".wmv", ".flv",
        ".3gp", ".3g2", ".ogv", ".gif", ".h264", ".264", ".hevc", ".h265", ".mjpeg", ".y4m", ".qt", ".asf", ".vob",
        ".m2v", ".mxf", ".dav",
    }
)  # fmt: skip
"""File name endings, in lower case, that are taken for videos."""

_LOGGER: Final = logging.getLogger(__name__)
_NUMBERED: Final = re.compile(r"%0?(\d*)d")
_PATIENCE: Final = 10.0
"""Seconds without data after which a connection counts as broken."""
_SLACK: Final = 1e-6
"""Seconds that a time stamp may be off by: a frame at 2/3 s is not before a start of 0.666667."""
_WITH_LENGTH: Final = ("mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm", "avi", "flv", "asf")
"""FFmpeg's names of the containers that state their length, which of others is found from what is there."""
_PLAYLISTS: Final = ("hls", "hls,applehttp", "dash")
"""FFmpeg's names of lists of pieces of a video."""
_INDEX_FIRST: Final = "its index comes first: ffmpeg -i IN -c copy -movflags +faststart OUT"
_KEY_FRAMES: Final = 10.0
"""Seconds in which a video is expected to have a key frame."""
_NO_TIMESTAMPS: Final = 0x80
"""FFmpeg's flag of formats without time stamps, such as raw H.264, to whose frames it gives 25 a second."""
_UNKNOWN: Final = 1 << 30
"""Frames that FFmpeg states in an AVI whose beginning it could not write again, as in a pipe."""
_Decoded: TypeAlias = tuple[float, Callable[[], NDArray[np.uint8]]]
"""Seconds from the start, and what makes the RGB image of it (not called for frames that are left out)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Frame:
    """One picture on its way to the network.

    Attributes:
        image: (height, width, 3) uint8 RGB, upright.
        source: The path, URL or name it came from.
        index: Position in the video, from 0, frames that were skipped or left out included; None for a still picture.
        timestamp: Seconds from the start of the video; None for a still picture.
    """

    image: NDArray[np.uint8]
    source: str
    index: int | None = None
    timestamp: float | None = None


@dataclasses.dataclass(frozen=True)
class Failure:
    """A source that could not be used.

    Attributes:
        source: Its name.
        reason: One line that begins with the name.
    """

    source: str
    reason: str


@dataclasses.dataclass(frozen=True)
class Clip:
    """Which frames of a video are wanted.

    Attributes:
        every: Every so many frames, from the first.
        start: Seconds from the start of the video.
        end: Seconds from the start of the video, exclusive; None for all.
        max_frames: At most so many; None for all.

    Raises:
        ConfigError: If a value is out of range.
    """

    every: int = 1
    start: float = 0.0
    end: float | None = None
    max_frames: int | None = None

    def __post_init__(self) -> None:
        if self.every < 1 or (self.max_frames is not None and self.max_frames < 1):
            raise ConfigError(f"every and max_frames must be at least 1, got {self.every} and {self.max_frames}")
        end = self.start + 1 if self.end is None else self.end
        if not (0 <= self.start < end and math.isfinite(end)):
            raise ConfigError(f"start must be at least 0 and end after it, got {self.start} and {self.end}")

    def expected(self, frames: int | None, rate: float | None) -> int | None:
        """Return about how many frames remain of a video of so many, at so many a second; None if unknown."""
        if frames is not None and rate:
            last = frames if self.end is None else min(frames, _first_from(self.end, rate))
            wanted = -(-max(0, last - _first_from(self.start, rate)) // self.every)
            return wanted if self.max_frames is None else min(wanted, self.max_frames)
        return self.max_frames


def _first_from(seconds: float, rate: float) -> int:
    """Return the index of the first frame that is not before this time, at a constant rate."""
    return max(0, math.ceil((seconds - _SLACK) * rate))


class FrameReader(abc.ABC):
    """Frames of one video, stream or camera, one after the other.

    Args:
        name: What it is called in results.
        clip: Which frames are wanted.

    Attributes:
        live: Whether frames come at their own pace, so that one not taken in time is lost.
        rate: Frames a second as the source states it, before ``clip.every``; None if unknown.
        expected: About how many frames it will give; None if unknown.
        broken: Frames so far that could not be decoded and were left out.
        pixel_aspect: Width of an upright pixel by its height; None for squares, and before the first frame.
    """

    live = False
    _cure = ""

    def __init__(self, name: str, clip: Clip | None = None) -> None:
        self.name = name
        self.clip = clip or Clip()
        self.rate: float | None = None
        self.expected: int | None = None
        self.broken = 0
        self.pixel_aspect: Fraction | None = None
        self._skipped = 0  # frames before the first that `_decode` gives
        self._closed = threading.Event()

    def look(self) -> None:  # noqa: B027 - most know it from the beginning
        """Find out ``rate`` and ``expected``, where that was put off.

        Raises:
            InputError: If the source cannot be read.
        """

    def close(self) -> None:
        """Stop waiting for a stream to come back; from any thread."""
        self._closed.set()

    def __iter__(self) -> Iterator[Frame]:
        given = seen = 0
        broken = self.broken
        with contextlib.closing(self._decode()) as decoded:
            for count, (timestamp, make) in enumerate(decoded):
                if timestamp < self.clip.start - _SLACK:
                    continue
                if self.clip.end is not None and timestamp >= self.clip.end - _SLACK:
                    break
                seen += 1
                if (seen - 1) % self.clip.every:
                    continue
                index = self._skipped + count + self.broken - broken
                try:
                    image = make()
                except InputError as error:
                    self.broken, broken = self.broken + 1, broken + 1  # it has been counted
                    _LOGGER.warning("%s", error)
                    continue
                yield Frame(image, self.name, index, timestamp)
                given += 1
                if given == self.clip.max_frames:
                    break
        if not given:
            part = "" if self.clip.start == 0 and self.clip.end is None else " between --start and --end"
            raise InputError(f"{self.name}: has no frames that can be decoded{part}{self._cure}")

    @abc.abstractmethod
    def _decode(self) -> Any:
        """Yield `_Decoded` in order, as a generator."""


class VideoReader(FrameReader):
    """A video file, or standard input, by PyAV.

    Rotation and mirroring noted in the file are applied, time stamps are the file's own (so that a variable frame rate
    is kept), and a frame that cannot be decoded is left out and counted. Frames that ``clip.start`` passes over
    without reading them are not counted but estimated from the time and the mean rate.

    Args:
        path: The file, its URL, or ``"-"`` for standard input.
        clip: Which frames are wanted.
        timeout: Seconds without data after which a URL is given up; None to wait for ever.
        unopened: Leave it alone until `look` or the first frame, as of many files of which few may be wanted.

    Raises:
        InputError: If it is missing, empty, or no video.
        MissingExtraError: If PyAV is not installed.
    """

    def __init__(
        self, path: str | Path, clip: Clip | None = None, *, timeout: float | None = None, unopened: bool = False
    ) -> None:
        super().__init__("stdin" if str(path) == "-" else _without_secrets(str(path)), clip)
        self._path = str(path)
        self._timeout = timeout
        self._unopened = unopened
        if self._path == "-":
            self._cure = f"; an MP4 can be piped if {_INDEX_FIRST}"
        elif unopened:
            _av()
        else:
            self.look()

    def look(self) -> None:
        """Find out ``rate`` and ``expected`` from the file's head; of standard input neither is known.

        Raises:
            InputError: If it is missing, empty, or no video.
        """
        self._unopened = False
        if self._path == "-":
            return
        with self._open() as container:
            self._look_at(container)

    def _look_at(self, container: Any) -> None:
        stream = container.streams.video[0]
        self.rate = _rate_of(container)
        frames = stream.frames or None
        if frames is None and container.duration and self.rate:
            frames = round(container.duration / 1e6 * self.rate)
        self.expected = self.clip.expected(frames, self.rate)

    def _open(self) -> Any:
        return _open_container(self._path, self.name, timeout=self._timeout)

    def _decode(self) -> Any:
        if self._unopened:
            self.look()
        frames = None
        if self.clip.start and self._path != "-":
            with self._open() as container:
                frames = self._sought(container)
                if frames is not None:
                    yield from frames
        if frames is None:
            with self._open() as container:
                yield from _frames_of(container, self)
        if self.broken:
            what = "frame was" if self.broken == 1 else "frames were"
            _LOGGER.warning("%s: %d broken %s left out", self.name, self.broken, what)

    def _sought(self, container: Any) -> Iterator[_Decoded] | None:
        """Return the frames from the last key frame before the start on; None where seeking does not lead there.

        That is so in H.264 and JPEGs without a container, which have no time stamps to go by, in recordings one after
        the other, whose time stamps begin anew, and in AVI whose frames are counted from the first that is stored.
        """
        stream, broken = container.streams.video[0], self.broken
        if stream.start_time is None or _is_reordered(container):
            return None
        length = container.duration if container.format.name not in _WITH_LENGTH else None
        if length is not None and self.clip.start > length / 1e6:
            return None  # the length is that of the last recording, by whose time stamps it would be sought
        for back in (0.0, _KEY_FRAMES):  # MPEG-TS is entered at any frame, and decoded from the next key frame on
            seconds = max(0.0, self.clip.start - back)
            with contextlib.suppress(_av().FFmpegError):  # what cannot seek is read from its beginning
                container.seek(stream.start_time + int(seconds / stream.time_base), stream=stream)
            frames = _frames_of(container, self)
            head = next(frames, None)
            if head is not None and head[0] <= self.clip.start + _SLACK:
                # The broken frames before it are counted besides.
                self._skipped = round(head[0] * (self.rate or 0)) - (self.broken - broken)
                return itertools.chain([head], frames)
            self.broken = broken
        return None


class StreamReader(FrameReader):
    """A live stream by URL (RTSP, HTTP, RTMP, UDP ...), picked up again when it breaks or ends.

    After a break it waits ``backoff`` seconds, then twice as long each time, up to ``longest``; a frame that arrives
    starts the count anew. Time stamps go on over a break by the clock, or after the last frame if that is later. Those
    of a stream that has none (JPEGs of a network camera, H.264 as such) are the clock's. A playlist that has an end by
    then is over; any other stream that does not come back is lost: after the frames that came, iterating raises
    `InputError`.

    Args:
        url: The address.
        clip: Which frames are wanted.
        retries: Give up after so many attempts in a row that brought no frame.
        backoff: Seconds before the first new attempt.
        longest: Seconds between attempts at most.

    Attributes:
        reconnections: How often it was picked up again.
    """

    live = True

    def __init__(
        self,
        url: str,
        clip: Clip | None = None,
        *,
        retries: int = 8,
        backoff: float = 0.5,
        longest: float = 30.0,
    ) -> None:
        super().__init__(_without_secrets(url), clip)
        self._url = url
        self.expected = self.clip.expected(None, None)
        self.retries, self.backoff, self.longest = retries, backoff, longest
        self.reconnections = 0

    def _decode(self) -> Any:
        began: float | None = None
        following = 0.0
        attempt, connected = 0, False
        reason = "no frames came"
        while attempt <= self.retries:
            if attempt:
                wait = min(self.longest, self.backoff * 2 ** (attempt - 1))
                _LOGGER.warning("%s: %s; trying again in %.1f s", self.name, reason, wait)
                if self._closed.wait(wait):
                    return
            attempt += 1
            try:
                with _open_container(self._url, self.name, timeout=_PATIENCE, live=True) as container:
                    if connected and container.format.name in _PLAYLISTS and _has_end(container):
                        return  # the sender wrote the end, and it would begin anew
                    offset: float | None = None
                    timeless = bool(container.format.flags & _NO_TIMESTAMPS)
                    step = 0.0 if timeless else _step(container, self)
                    for timestamp, make in _frames_of(container, self):
                        if began is None:
                            began = time.monotonic()
                        if offset is None:
                            self.reconnections += connected
                            connected, attempt = True, 1
                        if offset is None or timeless:
                            offset = max(time.monotonic() - began, following) - timestamp
                        following = timestamp + offset + step
                        yield timestamp + offset, make
                reason = "the stream ended"
            except InputError as error:
                if not connected and attempt == 1:
                    raise
                reason = str(error).removeprefix(f"{self.name}: ")
        raise InputError(f"{self.name}: given up after {self.retries} attempts ({reason})")


class _UrlReader(VideoReader, StreamReader):
    """A file behind an HTTP or FTP URL, which has an end, or a live stream; `look` or the first frame finds out which.

    Args:
        url: The address, which is left alone until then.
        clip: Which frames are wanted.

    Raises:
        MissingExtraError: If PyAV is not installed.
    """

    def __init__(self, url: str, clip: Clip | None = None) -> None:
        super().__init__(url, clip, timeout=_PATIENCE, unopened=True)
        self._url = url  # whole: `VideoReader` passes the name on
        self._live = True

    @property
    def live(self) -> bool:  # type: ignore[override]
        """See `FrameReader`; it is found out when asked for."""
        if self._unopened:
            self.look()
        return self._live

    def look(self) -> None:
        """Find out which it is, and of a file ``rate`` and ``expected``.

        Raises:
            InputError: If it cannot be read.
        """
        with self._open() as container:
            self._live = not _has_end(container)
            if not self._live:
                self._look_at(container)
        self._unopened = False

    def _decode(self) -> Any:
        return StreamReader._decode(self) if self.live else VideoReader._decode(self)


class CameraReader(FrameReader):
    """A camera of this machine, by its number.

    Args:
        number: 0 for the first.
        clip: Which frames are wanted.

    Raises:
        InputError: If it is not there.
    """

    live = True

    def __init__(self, number: int, clip: Clip | None = None) -> None:
        super().__init__(f"camera-{number}", clip)
        self._number = number
        self.expected = self.clip.expected(None, None)

    def _decode(self) -> Any:
        with silent_opencv():
            camera = cv2.VideoCapture(self._number)
        try:
            if not camera.isOpened():
                raise InputError(f"{self.name}: there is no such camera, or another program holds it")
            self.rate = camera.get(cv2.CAP_PROP_FPS) or None
            began: float | None = None
            while True:
                taken, bgr = camera.read()
                if not taken:
                    more = "" if began is None else " more"
                    raise InputError(f"{self.name}: gives no{more} frames; is it still connected?")
                began = time.monotonic() if began is None else began
                yield time.monotonic() - began, functools.partial(cv2.cvtColor, bgr, cv2.COLOR_BGR2RGB)
        finally:
            camera.release()


class SequenceReader(FrameReader):
    """Numbered pictures as one video: ``frames/%06d.jpg``. Gaps in the numbers are skipped.

    In results it is called what stands before the number: ``frames``.

    Args:
        pattern: A path with one ``%d``, as C's printf takes it.
        clip: Which frames are wanted.
        rate: Frames a second.

    Raises:
        InputError: If no file matches.
    """

    def __init__(self, pattern: str, clip: Clip | None = None, *, rate: float = 30.0) -> None:
        place = _NUMBERED.search(pattern)
        if place is None:
            raise ConfigError(f"{pattern}: a pattern of numbered pictures has one %d, such as frames/%06d.jpg")
        before, after = pattern[: place.start()], pattern[place.end() :]
        digits = int(place.group(1) or 1)
        _check_rate(rate)
        super().__init__(before.rstrip("/\\_-. ") or "sequence", clip)
        self.rate = rate
        exact = re.compile(rf"{re.escape(before)}(\d{{{digits},}}){re.escape(after)}\Z")
        numbered = {
            int(match.group(1)): Path(path)
            for path in glob.glob(f"{glob.escape(before)}*{glob.escape(after)}")  # noqa: PTH207 - a pattern
            if (match := exact.match(path))
        }
        if not numbered:
            raise InputError(f"{pattern}: no file matches")
        self._paths = [numbered[number] for number in sorted(numbered)]
        self.expected = self.clip.expected(len(self._paths), rate)

    def _decode(self) -> Any:
        assert self.rate is not None
        for number, path in enumerate(self._paths):
            yield number / self.rate, functools.partial(read_image, path)


@dataclasses.dataclass(frozen=True)
class Stills:
    """Single pictures, read one by one; one that cannot be read becomes a `Failure` in its place.

    Attributes:
        paths: The files.
    """

    paths: tuple[Path, ...]

    def __iter__(self) -> Iterator[Frame | Failure]:
        for path in self.paths:
            try:
                yield Frame(read_image(path), str(path))
            except InputError as error:
                yield Failure(str(path), str(error))


def find_sources(
    names: Sequence[str | Path], clip: Clip | None = None, *, rate: float = 30.0, unopened: bool = False
) -> tuple[list[Stills | FrameReader], list[Failure]]:
    """Turn what a user names into sources.

    Args:
        names: Pictures, videos, folders (all the files directly in them, but hidden ones), glob patterns, numbered
            pictures (``%06d``), URLs, a camera's number, ``-`` or ``stdin`` for standard input.
        clip: Which frames of videos are wanted.
        rate: Frames a second of numbered pictures.
        unopened: Open neither video files nor URLs: what is wrong with them is told by `FrameReader.look`.

    Returns:
        The sources in order, each once, neighbouring pictures together, no two readers of one name; and what cannot be
        used.

    Raises:
        ConfigError: If the rate is out of range.
    """
    _check_rate(rate)
    sources: list[Stills | FrameReader] = []
    failures: list[Failure] = []
    stills: list[Path] = []

    def add(make: Callable[[], FrameReader], name: str) -> None:
        if stills:
            sources.append(Stills(tuple(stills)))
            stills.clear()
        try:
            sources.append(make())
        except InputError as error:
            failures.append(Failure(_without_secrets(name), str(error)))

    taken: set[Path] = set()
    place = _placing()
    for name in dict.fromkeys(_local(os.fspath(name)) for name in names):
        if re.match(r"[a-z][a-z0-9+.-]+://", name, re.IGNORECASE):
            add(functools.partial(_read_url, name, clip, unopened=unopened), name)
        elif name == "-" or (name == "stdin" and not Path(name).exists()):
            add(functools.partial(VideoReader, "-", clip), "stdin")
        elif name.isdecimal() and not Path(name).exists():
            add(functools.partial(CameraReader, int(name), clip), name)
        elif _NUMBERED.search(name) and not Path(name).exists():
            add(functools.partial(SequenceReader, name, clip, rate=rate), name)
        else:
            try:
                paths = _expand(name, place)
            except InputError as error:
                failures.append(Failure(name, str(error)))
                continue
            except OSError as error:  # a name too long, a folder that may not be listed
                failures.append(Failure(name, f"{name}: cannot be read ({error.strerror})"))
                continue
            for path in paths:
                if (shown := _printable(str(path))) != str(path):
                    failures.append(Failure(shown, f"{shown}: its name is not UTF-8; rename it"))
                    continue
                where = place(path)
                if where in taken:
                    continue
                taken.add(where)
                if path.suffix.lower() in VIDEO_SUFFIXES:
                    add(functools.partial(VideoReader, path, clip, unopened=unopened), str(path))
                else:
                    stills.append(path)
    if stills:
        sources.append(Stills(tuple(stills)))
    _tell_apart(source for source in sources if isinstance(source, FrameReader))
    return sources, failures


def _check_rate(rate: float) -> None:
    if not 0 < rate <= 1000:
        raise ConfigError(f"the frame rate must be above 0 and at most 1000, got {rate}")


def _tell_apart(readers: Iterable[FrameReader]) -> None:
    """Number readers of one name, such as ``a/%d.jpg`` and ``a/%d.png``, or two queries of a URL: ``a``, ``a-2`` ..."""
    free = FreeNames()
    for reader in readers:
        reader.name = free.give(reader.name)


def _printable(name: str) -> str:
    """Return a file name with what is not UTF-8 in it as escapes."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def _local(name: str) -> str:
    """Return the path that a ``file://`` URL of this machine stands for; anything else as it is."""
    parts = urllib.parse.urlsplit(name) if name[:7].lower() == "file://" else None
    return urllib.request.url2pathname(parts.path) if parts and parts.netloc in {"", "localhost"} else name


def _read_url(url: str, clip: Clip | None, *, unopened: bool) -> FrameReader:
    """Return a reader of a file behind an HTTP or FTP URL, or of a live stream; ``unopened``, of what may be either."""
    if not re.match("https?:|ftp:", url, re.IGNORECASE):
        return StreamReader(url, clip)
    if unopened:
        return _UrlReader(url, clip)
    with _open_container(url, _without_secrets(url), timeout=_PATIENCE) as container:
        ends = _has_end(container)
    return VideoReader(url, clip, timeout=_PATIENCE) if ends else StreamReader(url, clip)


def _has_end(container: Any) -> bool:
    """Return whether what is behind a URL is a file, which has a length in seconds or in bytes."""
    # That in bytes of a playlist, which may grow, is its own.
    return bool(container.duration or (container.size > 0 and container.format.name not in _PLAYLISTS))


def _without_secrets(url: str) -> str:
    """Return a URL without user, password and query, which have no place in results; anything else as it is."""
    parts = urllib.parse.urlsplit(url)
    if "://" not in url or not parts.netloc:
        return url
    return urllib.parse.urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, "", ""))


def _expand(name: str, place: Callable[[Path], Path]) -> list[Path]:
    """Return the files that a path or a pattern stands for, in natural order (2 before 10).

    ``place`` is what `_placing` returns.
    """
    path = Path(name)
    if path.is_dir():
        files = [child for child in path.iterdir() if _is_file(child) and not child.name.startswith(".")]
        if not files:
            if any(child.is_dir() for child in path.iterdir()):
                raise InputError(f"{name}: has no files itself; for those in its folders: {str(path / '**' / '*')!r}")
            raise InputError(f"{name}: is an empty folder")
    elif path.exists():
        return [path]
    elif glob.has_magic(name):
        places: dict[Path, Path] = {}
        # The shortest way to each: a link to a folder above it leads to all in that again and again.
        for match in sorted(map(Path, glob.glob(name, recursive=True)), key=lambda path: len(path.parts)):  # noqa: PTH207
            places.setdefault(place(match), match)
        files = [match for match in places.values() if _is_file(match)]
        if not files:
            raise InputError(f"{name}: no file matches")
    else:
        raise InputError(f"{name}: no such file or folder")
    return sorted(files, key=lambda file: [int(t) if t.isdecimal() else t for t in re.split(r"(\d+)", str(file))])


def _placing() -> Callable[[Path], Path]:
    """Return what tells where a path is, by whatever ways, and looks each folder up once.

    A link of another name is a place, and gives a result, of its own.
    """
    resolve = functools.cache(Path.resolve)
    return lambda path: resolve(path.parent) / path.name


def _is_file(path: Path) -> bool:
    """Return whether a path is a file, or a link to what is not there: told as one that cannot be read."""
    return path.is_file() or (path.is_symlink() and not path.is_dir())


@contextlib.contextmanager
def silent_opencv() -> Iterator[None]:
    """Keep OpenCV from printing: what it has to say is raised."""
    # OpenCV 4 has it by the first name, OpenCV 5 by the second.
    set_level: Callable[[int], int] = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    before = set_level(0)
    try:
        yield
    finally:
        set_level(before)


def _av() -> Any:
    return import_extra("av", "video")


def _open_container(path: str, name: str, *, timeout: float | None = None, live: bool = False) -> Any:
    """Open what has a video stream; of a ``live`` one each frame is decoded as soon as it is there.

    Raises:
        InputError: If that fails; one line, with the name.
    """
    av = _av()
    if path == "-" and sys.stdin is None:
        raise InputError(f"{name}: is closed")
    options = {"rtsp_transport": "tcp"} if path.lower().startswith("rtsp") else {}
    if path != "-" and timeout is None and Path(path).is_file() and not Path(path).stat().st_size:
        raise InputError(f"{name}: is empty")
    try:
        container = av.open(sys.stdin.buffer if path == "-" else path, options=options, timeout=timeout)
    except (av.FFmpegError, OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{name}: is not a video that can be read ({reason})") from error
    if not container.streams.video:
        container.close()
        raise InputError(f"{name}: has no video stream")
    # Several frames at once are faster, but each thread holds one back.
    container.streams.video[0].thread_type = "SLICE" if live else "AUTO"
    return container


def _rate_of(container: Any) -> float | None:
    """Return how many frames a second the first video stream has; None if unknown."""
    stream = container.streams.video[0]
    rate = stream.average_rate or stream.guessed_rate
    if container.format.flags & _NO_TIMESTAMPS:  # to which FFmpeg gives 25 a second, whatever the video says
        rate = stream.guessed_rate or rate
    return float(rate) if rate else None


def _frames_of(container: Any, reader: FrameReader) -> Iterator[_Decoded]:
    """Yield the frames of the first video stream, those that cannot be decoded left out and counted.

    A file that ends well before its length is told in the log.

    Raises:
        InputError: If the connection to a stream, or to a file behind a URL, is lost.
    """
    av = _av()
    stream = container.streams.video[0]
    step = _step(container, reader)
    first = float(stream.start_time * stream.time_base) if stream.start_time is not None else None
    last = -step
    end = 0.0
    places: list[int] = []
    reordered = _is_reordered(container)
    # Without a length of its own, the video is measured by that of the container, which may be that of its sound.
    packets = container.demux(stream) if reader.live or stream.duration else container.demux()
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            break
        except av.FFmpegError as error:  # the file ends in the middle, or the connection is lost
            if reader.live:
                raise InputError(f"{reader.name}: the stream broke ({error.strerror})") from error
            if "://" in reader.name and not isinstance(error, av.error.InvalidDataError):
                reason = f"the connection was lost after {end:.1f} s ({error.strerror})"
                if not end and "mp4" in container.format.name:
                    reason = f"cannot be read in one go ({error.strerror}); an MP4 can if {_INDEX_FIRST}"
                raise InputError(f"{reader.name}: {reason}") from error
            reader.broken += 1
            break
        ticks = packet.dts if packet.pts is None else packet.pts
        if ticks is not None:
            end = max(end, float(ticks * packet.time_base) + (float((packet.duration or 0) * packet.time_base) or step))
        if packet.stream.index != stream.index:
            continue
        try:
            frames = packet.decode()
        except av.FFmpegError:
            reader.broken += 1
            continue
        if reordered and packet.dts is not None:
            heapq.heappush(places, packet.dts)
        for frame in frames:
            if places:
                frame.pts = heapq.heappop(places)
            if frame.is_corrupt:
                reader.broken += 1
                continue
            seconds = frame.time
            if seconds is None:
                timestamp = last + step
            else:
                first = seconds if first is None else first
                if seconds - first < last - step:  # recordings one after the other, or a recorder that began anew
                    _LOGGER.warning("%s: time stamps jump back after %.3f s; time goes on", reader.name, last)
                    first = seconds - last - step
                timestamp = seconds - first
            last = timestamp
            aspect = stream.sample_aspect_ratio or Fraction(1)
            reader.pixel_aspect = None if aspect == 1 else 1 / aspect if _orientation(frame)[2] else aspect
            yield timestamp, functools.partial(_upright, frame)
    if not reader.live and container.format.name in _WITH_LENGTH:
        length = float(stream.duration * stream.time_base) if stream.duration else (container.duration or 0) / 1e6
        if container.format.name == "avi":  # from whose duration FFmpeg takes off what is not there
            length = stream.frames * step if stream.frames < _UNKNOWN else 0.0
        if length - end > max(0.02 * length, min(1, 5 * step)):
            _LOGGER.warning("%s: ends after %.1f s of %.1f s; the file may be cut off", reader.name, end, length)


def _step(container: Any, reader: FrameReader) -> float:
    """Return about how many seconds lie between two frames."""
    return 1 / (reader.rate or _rate_of(container) or 30.0)


def _is_reordered(container: Any) -> bool:
    """Return whether frames are counted as they are stored, in AVI, which is not how they are shown."""
    return bool(container.format.name == "avi" and container.streams.video[0].codec_context.has_b_frames)


def _upright(frame: Any) -> NDArray[np.uint8]:
    """Return the RGB image as it is to be shown: turned by multiples of 90 degrees, and mirrored."""
    image: NDArray[np.uint8] = frame.to_ndarray(format="rgb24")
    right, down, swapped = _orientation(frame)
    if swapped:
        image = image.swapaxes(0, 1)
    return np.ascontiguousarray(image[::down, ::right])


def _orientation(frame: Any) -> tuple[int, int, bool]:
    """Return the directions to read the columns and rows in, 1 or -1, once those have swapped places or not."""
    matrix = frame.side_data.get("DISPLAYMATRIX")
    if matrix is None:
        return 1, 1, False
    # x' = a x + c y, y' = b x + d y; FFmpeg's av_display_rotation_get knows the angle alone, not the mirror.
    a, b, _, c, d, *_ = np.frombuffer(matrix, np.int32).tolist()
    swapped = abs(b) > abs(a)
    x, y = (c, b) if swapped else (a, d)
    return -1 if x < 0 else 1, -1 if y < 0 else 1, swapped
