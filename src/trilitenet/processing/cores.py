"""The processor: what it is, how many cores there are to work with, and processes that use them."""

from __future__ import annotations

import concurrent.futures
import contextlib
import multiprocessing
import os
import pickle
import platform
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, TypeVar

import cv2

from trilitenet.errors import BackendError

__all__ = ["ProcessPool", "held_back", "processor", "usable_cores"]

T = TypeVar("T")


def usable_cores() -> int:
    """Return on how many processor cores this process may run: `taskset` or a container's set of them may limit it."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor() -> tuple[str, frozenset[str]]:
    """Return what the processor is called, and the names of its instructions as far as Linux tells."""
    try:
        listing = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        listing = ""
    found = dict(re.findall(r"^(model name|flags)\s*: *(.*)$", listing, re.M))
    name = found.get("model name") or platform.processor() or platform.machine()
    return name, frozenset(found.get("flags", "").split())


class ProcessPool(concurrent.futures.ProcessPoolExecutor):
    """Processes that Ctrl-C in the terminal, which reaches all of them, ends without a word.

    What a process is at is interrupted, so that it cleans up; what waits is forgotten. Processes whose own was killed
    end, too. OpenCV takes one thread in each. They do not run the caller's script again, which need not be guarded by
    ``if __name__ == "__main__"`` then, unless what they are given is of the script itself.

    Args:
        workers: How many.
        initializer: Called first in each.
        initargs: What it is called with.
    """

    def __init__(
        self, workers: int, initializer: Callable[..., object] | None = None, initargs: tuple[Any, ...] = ()
    ) -> None:
        self._handed = (initializer, initargs)
        heeds = signal.getsignal(signal.SIGINT) is not signal.SIG_IGN  # which a shell's background job does not
        super().__init__(
            workers,
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_begin,
            initargs=(heeds, initializer, initargs),
        )

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> concurrent.futures.Future[T]:
        """Add a task."""
        own = _is_of_script((self._handed, fn, args, kwargs))
        # A process that starts with this task holds SIGINT back, too, until it can do without a word.
        with held_back(signal.SIGINT), contextlib.nullcontext() if own else _script_unseen():
            return super().submit(_interruptible, fn, *args, **kwargs)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.shutdown(wait=True, cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            raise BackendError(
                "a process that shared the work was ended, mostly for want of memory; give fewer --workers, such as 1"
            ) from error


_hiding = threading.Lock()


def _is_of_script(handed: object) -> bool:
    """Return whether anything that is handed to a process is of the script that runs."""
    try:
        return b"__main__" in pickle.dumps(handed)
    except Exception:
        return False


@contextlib.contextmanager
def _script_unseen() -> Iterator[None]:
    """Hide from processes that start in the block which script to run first: see `multiprocessing.spawn`."""
    main = vars(sys.modules["__main__"])
    with _hiding:
        hidden: dict[str, Any] = {name: main.pop(name) for name in ("__file__", "__spec__") if name in main}
        main["__spec__"] = None
        try:
            yield
        finally:
            main.update(hidden)


@contextlib.contextmanager
def held_back(number: signal.Signals) -> Iterator[None]:
    """Let a signal wait for the end of the block, where the system can; processes started in it begin so."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {number})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_busy = _stopped = False


def _begin(heeds: bool, initializer: Callable[..., object] | None, initargs: tuple[Any, ...]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()  # while it takes no signal from the main thread
    signal.signal(signal.SIGINT, _stop if heeds else signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    cv2.setNumThreads(1)  # the processes are the parallelism
    if initializer is not None:
        initializer(*initargs)


def _end_with_parent() -> None:
    """End this process when the one that started it has gone, which cannot ask for it when it is killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _stop(number: int, frame: FrameType | None) -> None:
    """Interrupt the task at hand, and refuse those that are handed over already."""
    global _stopped
    _stopped = True
    if _busy:
        raise KeyboardInterrupt


def _interruptible(function: Callable[..., T], /, *args: Any, **kwargs: Any) -> T:
    global _busy
    if _stopped:
        raise KeyboardInterrupt
    _busy = True
    try:
        return function(*args, **kwargs)
    finally:
        _busy = False
