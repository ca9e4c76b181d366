"""Video, end to end: a bounded pipeline of threads, and the encoder at its end.

    reader -> [decode] -> bounded queue -> [infer] -> bounded queue -> caller (draws, writes) -> [encode]

Names in brackets are threads. Each waits only for its neighbours, and no queue grows: memory stays flat whatever the
length of the video.
"""

from __future__ import annotations

import atexit
import contextlib
import dataclasses
import itertools
import queue
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Generic, TypeVar, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import Claim, ConfigError, InputError, OutputError, ShapeError, import_extra, part_of
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.sources import Failure, Frame, FrameReader, Stills
from trilitenet.processing.images import to_rgb
from trilitenet.structures import Perception

__all__ = ["PerceptionStream", "Prefetch", "VideoWriter"]

T = TypeVar("T")

_CLOCK: Final = 90_000
"""Ticks a second of the time stamps in written videos."""
_BATCHES_AHEAD: Final = 2
"""Batches that may wait between two stages of a stream."""
_FRAMES_AHEAD: Final = 8
"""Frames that may wait for the encoder."""
_LONGEST_SIDE: Final = 16384
"""Pixels of a side that x264 takes."""
_LONGEST_GAP: Final = 1000
"""Seconds between two frames of a written video: MP4 has no room for distances of several hours."""


class Prefetch(Generic[T]):
    """Iterates over something in a thread of its own, a bounded number of items ahead.

    Args:
        items: What to iterate over; a generator is closed in the thread that ran it.
        size: At most so many items wait.
        drop_oldest: When full, forget the oldest instead of waiting: for live sources.

    Attributes:
        dropped: Items forgotten so far.
    """

    def __init__(self, items: Iterable[T], size: int, *, drop_oldest: bool = False) -> None:
        self.dropped = 0
        self._size = size
        self._drop_oldest = drop_oldest
        self._waiting: deque[T] = deque()
        self._changed = threading.Condition()
        self._ended = False
        self._stopped = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(iter(items),), daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[T]:
        return self

    def __next__(self) -> T:
        with self._changed:
            while not (self._waiting or self._ended or self._stopped):
                self._changed.wait(0.5)  # a bounded wait, so that Ctrl-C gets through on every system
            if self._waiting and not self._stopped:
                item = self._waiting.popleft()
                self._changed.notify_all()
                return item
            error, self._error = self._error, None
        if error is not None and not self._stopped:
            raise error
        raise StopIteration

    def close(self) -> None:
        """Stop; what waits is forgotten. Returns when the thread has ended."""
        with self._changed:
            self._stopped = True
            self._waiting.clear()
            self._changed.notify_all()
        self._thread.join(timeout=30)

    def _run(self, items: Iterator[T]) -> None:
        # A thread that is in a runtime's code when Python ends would abort the process. Ctrl-C may have come before
        # anybody could close it.
        atexit.register(self.close)
        try:
            for item in items:
                with self._changed:
                    while len(self._waiting) >= self._size and not self._stopped:
                        if self._drop_oldest:
                            self._waiting.popleft()
                            self.dropped += 1
                        else:
                            self._changed.wait()
                    if self._stopped:
                        break
                    self._waiting.append(item)
                    self._changed.notify_all()
        except BaseException as error:  # handed over to whoever iterates
            self._error = error
        finally:
            close = getattr(items, "close", None)
            if close is not None:
                with contextlib.suppress(Exception):
                    close()
            with self._changed:
                self._ended = True
                self._changed.notify_all()
            atexit.unregister(self.close)


class PerceptionStream(Generic[T]):
    """What a predictor sees in a source, in order: reading and inference run ahead in two threads.

    It gives a `Perception` for each frame of a video; for each picture that, or a `Failure` if it cannot be used.
    Use it as a context manager, so that the threads end with the block. A live source never piles up: frames that come
    while the network is busy are left out. Of a video that cannot be read to its end, such as a stream or a camera that
    is lost, what came before is given first; then iterating raises `InputError`.

    Args:
        source: Pictures, or the frames of a video.
        predictor: The predictor; frames of a file go through it ``predictor.batch_size`` at a time.
    """

    @overload
    def __init__(self: PerceptionStream[Perception], source: FrameReader, predictor: Predictor) -> None: ...
    @overload
    def __init__(
        self: PerceptionStream[Perception | Failure], source: Stills | FrameReader, predictor: Predictor
    ) -> None: ...

    def __init__(self, source: Stills | FrameReader, predictor: Predictor) -> None:
        self._source = source
        live = isinstance(source, FrameReader) and source.live
        batch_size = 1 if live else predictor.batch_size
        items: Iterable[Frame | Failure] = source
        ahead = _BATCHES_AHEAD * batch_size
        self._frames = Prefetch(items, 1 if live else ahead, drop_oldest=live)
        self._perceptions: Prefetch[Any] = Prefetch(_perceive(self._frames, predictor, batch_size), ahead)

    @property
    def dropped(self) -> int:
        """Frames of a live source that were left out so far."""
        return self._frames.dropped

    def __iter__(self) -> Iterator[T]:
        return self._perceptions

    def close(self) -> None:
        """End both threads."""
        if isinstance(self._source, FrameReader):
            self._source.close()
        self._frames.close()
        self._perceptions.close()

    def __enter__(self) -> PerceptionStream[T]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _perceive(
    items: Iterable[Frame | Failure], predictor: Predictor, batch_size: int
) -> Iterator[Perception | Failure]:
    """Yield a perception for each frame, in order; failures pass through.

    Raises:
        InputError: If the predictor cannot take the frames of a video, or they cannot be read to their end; a picture
            that it cannot take is a failure.
    """
    source = iter(items)
    while True:
        batch: list[Frame | Failure] = []
        failure: InputError | None = None
        try:
            for item in itertools.islice(source, batch_size):
                batch.append(item)
        except InputError as error:  # what came before it is good
            failure = error
        yield from _perceive_batch(batch, predictor)
        if failure is not None:
            raise failure
        if len(batch) < batch_size:
            return


def _perceive_batch(batch: Sequence[Frame | Failure], predictor: Predictor) -> Iterator[Perception | Failure]:
    frames = [item for item in batch if isinstance(item, Frame)]
    try:
        perceptions = iter(predictor.perceive([frame.image for frame in frames], [frame.source for frame in frames]))
    except ShapeError as error:
        if len(batch) > 1:  # which one it is shows when each goes alone
            for item in batch:
                yield from _perceive_batch([item], predictor)
            return
        (frame,) = frames
        reason = f"{frame.source}: {error}"
        if frame.index is not None:
            raise InputError(reason) from error
        yield Failure(frame.source, reason)
        return
    for item in batch:
        if isinstance(item, Failure):
            yield item
        else:
            yield dataclasses.replace(next(perceptions), frame=item.index, timestamp=item.timestamp)


class VideoWriter:
    """Writes an H.264 video that every browser plays (yuv420p, index at the front), encoding in a thread of its own.

    The file gets its name when it is whole; until then it ends in ``.part``. It begins with the first frame, from whose
    time stamp the others keep their distances, of up to 1000 seconds, so a variable frame rate stays one. Odd sides are
    made even by repeating the last row or column.

    Args:
        path: The ``.mp4`` file.
        rate: Frames a second, for time stamps that are missing and for the encoder's rate control.
        quality: Constant rate factor, 0 (best) to 51.
        preset: x264's trade of speed for size.

    Attributes:
        frames: Frames given so far.
        pixel_aspect: Width of a pixel by its height, None for squares; to be set before the first frame.

    Raises:
        ConfigError: If the path does not end in ``.mp4``, or the rate is not above 0.
        MissingExtraError: If PyAV is not installed.
    """

    def __init__(
        self, path: str | Path, rate: float | None = None, *, quality: int = 23, preset: str = "superfast"
    ) -> None:
        self._av = import_extra("av", "video")
        self.path = path = Path(path)
        if path.suffix.lower() != ".mp4":
            raise ConfigError(f"{path}: a video is written as .mp4")
        if rate is not None and rate <= 0:
            raise ConfigError(f"{path}: frames a second must be above 0, got {rate:g}")
        self.frames = 0
        self.pixel_aspect: Fraction | None = None
        self._claimed = contextlib.ExitStack()
        self._rate = rate or 30.0
        self._options = {"crf": str(quality), "preset": preset}
        self._size: tuple[int, int] | None = None
        self._container: Any = None
        self._stream: Any = None
        self._first: float | None = None
        self._last = -1
        self._waiting: queue.Queue[tuple[NDArray[np.uint8], float] | None] = queue.Queue(_FRAMES_AHEAD)
        self._error: OutputError | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def write(self, image: NDArray[np.uint8], timestamp: float | None = None) -> None:
        """Add a frame. The array must not be changed afterwards.

        Args:
            image: (height, width, 3) uint8 RGB, or what else `to_rgb` takes; brought to the size of the first frame if
                it differs.
            timestamp: Seconds, from whenever; by the frame rate if left out.

        Raises:
            ShapeError: If it is no such image, or larger than H.264 takes, which takes nothing from the video.
            OutputError: If the file cannot be written, at this frame or a later one; or if the writer was closed.
        """
        if self._error is not None:
            raise self._error
        if self._closed:
            raise OutputError(f"{self.path}: the video was closed")
        image = to_rgb(image)
        height, width = image.shape[:2]
        if not self.frames and max(height, width) > _LONGEST_SIDE:  # others are brought to the size of the first
            raise ShapeError(f"H.264 takes at most {_LONGEST_SIDE} pixels a side, got {width} x {height}")
        self._waiting.put((image, self.frames / self._rate if timestamp is None else timestamp))
        self.frames += 1

    def close(self) -> None:
        """Encode what waits, finish the file and give it its name. Without a frame there is no file.

        Raises:
            OutputError: If the file cannot be written; then it is removed.
        """
        self._closed = True
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()
        if self._error is not None:
            raise self._error

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish the file: also when the block was left by an error or Ctrl-C, so that what there is can be played."""
        self.close()

    def _run(self) -> None:
        item: tuple[NDArray[np.uint8], float] | None = None
        try:
            while (item := self._waiting.get()) is not None:
                self._encode(*item)
            if self._container is not None:
                self._mux(None)
                self._container.close()
                part_of(self.path).replace(self.path)
                self._claimed.close()
        except Exception as error:  # whatever it is, the caller must hear of it and not wait
            reason = getattr(error, "strerror", None) or str(error)
            cannot = OutputError(f"{self.path}: the video cannot be written ({reason})")
            self._error = error if isinstance(error, OutputError) else cannot
            if self._container is not None:
                with contextlib.suppress(Exception):
                    self._container.close()
            self._claimed.close()
            while item is not None:  # so that nobody waits for a place in the queue for ever
                item = self._waiting.get()

    def _encode(self, image: NDArray[np.uint8], timestamp: float) -> None:
        if self._container is None:
            self._open(image.shape[0], image.shape[1])
        assert self._size is not None
        height, width = self._size
        if image.shape[:2] != (height, width):
            image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        if height % 2 or width % 2:
            image = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        # OpenCV's conversion (BT.601, 16 .. 235, as the stream says) is several times quicker than swscale's.
        planes = cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420)
        frame = self._av.VideoFrame.from_ndarray(planes, format="yuv420p")
        if self._first is None:
            self._first = timestamp
        gap = timestamp - self._first - self._last / _CLOCK
        self._first += max(0.0, gap - _LONGEST_GAP)
        self._last = max(self._last + 1, round((timestamp - self._first) * _CLOCK))
        frame.pts, frame.time_base = self._last, Fraction(1, _CLOCK)
        self._mux(frame)

    def _open(self, height: int, width: int) -> None:
        self._size = (height, width)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._claimed.callback(Claim(self.path).close)
        self._container = self._av.open(str(part_of(self.path)), "w", format="mp4", options={"movflags": "+faststart"})
        rate = max(Fraction(self._rate).limit_denominator(1001), Fraction(1, _LONGEST_GAP))
        self._stream = self._container.add_stream("libx264", rate=rate, options=self._options)
        self._stream.width, self._stream.height = width + width % 2, height + height % 2
        self._stream.pix_fmt = "yuv420p"
        context = self._stream.codec_context
        context.time_base = Fraction(1, _CLOCK)
        if self.pixel_aspect is not None:
            context.sample_aspect_ratio = self.pixel_aspect
        context.colorspace = context.color_primaries = context.color_trc = 6  # SMPTE 170M, which is BT.601

    def _mux(self, frame: Any) -> None:
        for packet in self._stream.encode(frame):
            self._container.mux(packet)
