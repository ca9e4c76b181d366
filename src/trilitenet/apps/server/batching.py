"""Dynamic batching: a bounded number of accepted images, one thread that runs the network on those that wait.

The thread takes the oldest waiting canvas and others of the same shape, up to the largest batch, and runs them at once.
While it runs, the next ones gather, so batches grow with the load and nobody waits for company when there is none.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trilitenet.apps.server.problems import BusyError
from trilitenet.structures import RawOutputs

__all__ = ["Admission", "Batcher", "split"]

_LOGGER: Final = logging.getLogger(__name__)


class Admission:
    """Counts the images that are accepted and not yet answered, and refuses those that would wait too long.

    There are so many places. Where the machine is slow, or busy with something else, fewer are given away: an image
    that would be thrown away at its deadline costs as much as one that is answered, and would only delay others.

    Args:
        places: The most images at a time.
        patience: The most seconds that those ahead of an image may be expected to take.
        clock: Seconds that only grow; replaced in tests.
    """

    def __init__(self, places: int, patience: float = math.inf, *, clock: Callable[[], float] = time.monotonic) -> None:
        self.places = places
        self.patience = patience
        self.taken = 0
        self.seconds_each = 0.1
        self._clock = clock
        self._since = clock()
        self._lock = threading.Lock()

    def check(self, count: int = 1) -> None:
        """Refuse ``count`` images that there is no room for, without taking places.

        Raises:
            BusyError: If there is none; its Retry-After is the time that those ahead are expected to take.
        """
        expected = self.taken * self.seconds_each
        wait = max(1, math.ceil(expected))
        if self.taken + count > self.places:
            raise BusyError("queue_full", f"all {self.places} places are taken; try again in {wait} s", wait)
        if self.taken > 1 and expected > self.patience:  # the second always enters, so that the estimate can recover
            raise BusyError("queue_slow", f"the images ahead would take {wait} s; try again then", wait)

    def enter(self, count: int = 1) -> None:
        """Take ``count`` places.

        Raises:
            BusyError: As `check`.
        """
        with self._lock:
            self.check(count)
            if self.taken == 0:
                self._since = self._clock()
            self.taken += count

    def leave(self, count: int = 1) -> None:
        """Give ``count`` places back."""
        with self._lock:
            self.taken -= count

    def skip(self) -> None:
        """Learn nothing from the time until now: it went to an image that was refused, or whose client has gone."""
        with self._lock:
            self._since = self._clock()

    def observe(self, count: int) -> None:
        """Learn from ``count`` images that came through now how long one takes, as a moving average.

        The time runs from the last ones that came through or were skipped, or from when the places were all free: so
        it holds all that an image costs, and what else the machine does meanwhile.
        """
        with self._lock:
            if self.taken == 0:  # the first run, before any request
                return
            now = self._clock()
            for _ in range(count):
                self.seconds_each += 0.1 * ((now - self._since) / count - self.seconds_each)
            self._since = now


@dataclasses.dataclass
class _Item:
    canvas: NDArray[np.uint8]
    deadline: float
    entered: float
    future: Future[tuple[RawOutputs, float, float, int]]


class Batcher:
    """Runs canvases through the network in batches, in a thread of its own.

    Args:
        run: Takes (B, H, W, 3) uint8 RGB and returns the raw outputs of the batch.
        max_batch: The most canvases at once.
        delay: Seconds that a batch that is not full waits for more.
        observe: Told the size of each batch that is through.
    """

    def __init__(
        self,
        run: Callable[[NDArray[np.uint8]], RawOutputs],
        *,
        max_batch: int,
        delay: float = 0.0,
        observe: Callable[[int], None] = lambda size: None,
    ) -> None:
        self._run = run
        self._max_batch = max_batch
        self._delay = delay
        self._observe = observe
        self._waiting: deque[_Item] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._began: float | None = None
        self._thread = threading.Thread(target=self._loop, name="trilitenet-batcher", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread runs."""
        return self._thread.is_alive()

    @property
    def busy(self) -> float:
        """Seconds since the batch that runs was begun; 0 if none runs."""
        began = self._began
        return 0.0 if began is None else time.monotonic() - began

    @property
    def length(self) -> int:
        """Canvases that wait."""
        return len(self._waiting)

    def submit(self, canvas: NDArray[np.uint8], deadline: float) -> Future[tuple[RawOutputs, float, float, int]]:
        """Put a canvas into the queue.

        Args:
            canvas: (H, W, 3) uint8 RGB, letterboxed.
            deadline: On `time.monotonic`; one that is not started by then fails with `BusyError`.

        Returns:
            Its raw outputs (a batch of one), the seconds it waited, the seconds its whole batch took, and the images
            in that batch. Cancelling the future takes it out of the queue if it has not been started.

        Raises:
            BusyError: If the service is closing.
        """
        item = _Item(canvas, deadline, time.monotonic(), Future())
        with self._changed:
            if self._closing:
                raise BusyError("closing", "the service is closing")
            self._waiting.append(item)
            self._changed.notify()
        return item.future

    def close(self, timeout: float | None = None) -> None:
        """Finish what waits, then end the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread.ident is not None:
            self._thread.join(timeout)

    def _loop(self) -> None:
        while True:
            batch = self._next_batch()
            if batch is None:
                return
            if batch:
                self._began = time.monotonic()
                self._run_batch(batch, self._began)
                self._began = None

    def _next_batch(self) -> list[_Item] | None:
        """Wait for work; None when there is none left and the batcher is closing."""
        with self._changed:
            while not self._waiting and not self._closing:
                self._changed.wait()
            if not self._waiting:
                return None
            until = time.monotonic() + self._delay
            while len(self._waiting) < self._max_batch and not self._closing:
                left = until - time.monotonic()
                if left <= 0 or not self._changed.wait(left):
                    break
            return self._take()

    def _take(self) -> list[_Item]:
        """Take the oldest item and those of its shape; drop the cancelled and the late."""
        batch: list[_Item] = []
        others: deque[_Item] = deque()
        now = time.monotonic()
        while self._waiting and len(batch) < self._max_batch:
            item = self._waiting.popleft()
            if batch and item.canvas.shape != batch[0].canvas.shape:
                others.append(item)
            elif not item.future.set_running_or_notify_cancel():
                continue
            elif now > item.deadline:
                item.future.set_exception(BusyError("deadline", "the image waited too long; try again soon"))
            else:
                batch.append(item)
        self._waiting.extendleft(reversed(others))
        return batch

    def _run_batch(self, batch: list[_Item], start: float) -> None:
        try:
            raw = self._run(np.stack([item.canvas for item in batch]))
            pieces = split(raw, len(batch))
        except Exception as error:  # the service must outlive a backend that fails on one batch
            _LOGGER.exception("the backend failed on a batch of %d", len(batch))
            for item in batch:
                item.future.set_exception(error)
            return
        seconds = time.monotonic() - start
        self._observe(len(batch))
        for item, piece in zip(batch, pieces, strict=True):
            item.future.set_result((piece, start - item.entered, seconds, len(batch)))


def split(raw: RawOutputs, count: int) -> list[RawOutputs]:
    """Split the raw outputs of a batch into batches of one (views, no copies)."""

    def piece(array: NDArray[Any] | None, index: int) -> Any:
        return None if array is None else array[index : index + 1]

    return [RawOutputs(piece(raw.detection, i), piece(raw.drivable, i), piece(raw.lane, i)) for i in range(count)]
