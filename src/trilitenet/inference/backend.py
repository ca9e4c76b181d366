"""The one thing a runtime must do: turn letterboxed images into raw outputs."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from typing import Any, Final, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ArtefactInfo, ModelCard
from trilitenet.errors import BackendError, ShapeError
from trilitenet.processing.cores import usable_cores
from trilitenet.structures import RawOutputs

__all__ = [
    "MOST_PARALLEL",
    "Backend",
    "ParallelSessions",
    "artefact_info",
    "check_batch",
    "check_process",
    "held",
    "out_of_memory",
    "replaced",
    "streams_of",
]

T = TypeVar("T")

MOST_PARALLEL: Final = 4
"""At most so many images are computed at once where a backend trades latency for images a second."""


def check_batch(batch: NDArray[np.uint8], stride: int = 1) -> None:
    """Check what `Backend.run` takes.

    Args:
        batch: The images.
        stride: H and W must be multiples of so many pixels.

    Raises:
        ShapeError: If it is not (B, H, W, 3) uint8, or empty, or of other sides.
    """
    if batch.ndim != 4 or batch.shape[3] != 3 or batch.dtype != np.uint8 or 0 in batch.shape:
        raise ShapeError(f"a batch must be (B, H, W, 3) uint8 with B >= 1, got {batch.shape} {batch.dtype}")
    height, width = batch.shape[1:3]
    if height % stride or width % stride:
        raise ShapeError(f"the sides of images must be multiples of {stride} pixels, got {width}x{height}")


def out_of_memory(name: str, batch: NDArray[np.uint8]) -> BackendError:
    """Return the error of a backend of that name whose memory did not do for a (B, H, W, 3) batch."""
    count, height, width = batch.shape[:3]
    what, less = ("an image", "") if count == 1 else (f"{count} images", "a smaller batch or ")
    return BackendError(f"{name} is out of memory for {what} of {width}x{height}; use {less}a smaller size")


def check_process(opened_in: int) -> None:
    """Check that a runtime runs in the process that opened it: a fork lacks its threads, and would wait for ever.

    Args:
        opened_in: Number of the process that opened it.

    Raises:
        BackendError: If this is another process.
    """
    if os.getpid() != opened_in:
        raise BackendError(
            "the model was opened before this process was forked; load it in this process, or start processes with "
            "multiprocessing.get_context('spawn')"
        )


def held(what: T | None, model: object) -> T:
    """Return what a backend computes with, which `Backend.close` lets go.

    Args:
        what: What it holds; None after that.
        model: What was loaded, for the message.

    Raises:
        BackendError: If it was closed.
    """
    if what is None:
        raise BackendError(f"{model}: the model was closed; load it again")
    return what


_REPLACING: Final = threading.Lock()


@contextlib.contextmanager
def replaced(owner: Any, name: str, make: Callable[[], Any]) -> Iterator[None]:
    """Inside, an attribute has another value. Several may be inside at once: the first makes it, the last restores.

    Args:
        owner: Whose attribute it is; one attribute of it at a time.
        name: The attribute.
        make: Returns the other value.
    """
    with _REPLACING:
        uses, before = getattr(owner, "_replaced", (0, None))
        if not uses:
            before = getattr(owner, name)
            setattr(owner, name, make())
        owner._replaced = uses + 1, before
    try:
        yield
    finally:
        with _REPLACING:
            uses, before = owner._replaced
            if uses == 1:
                setattr(owner, name, before)
                before = None
            owner._replaced = uses - 1, before


class ParallelSessions:
    """Trades latency for images a second, on a runtime whose sessions several threads may use at once."""

    _session: Any
    _threads: int | None
    _device: str

    def _open(self, threads: int | None) -> Any:
        """Return a session of so many threads; the runtime's own choice if left out."""
        raise NotImplementedError

    @contextlib.contextmanager
    def in_parallel(self) -> Iterator[int]:
        """Inside, images share no cores; yields from how many threads `run` is best called."""
        cores = self._threads or usable_cores()
        count = min(MOST_PARALLEL, cores) if self._device == "cpu" else 1
        if count == 1:
            yield 1
            return
        with replaced(self, "_session", lambda: self._open(cores // count)):
            yield count


@runtime_checkable
class Backend(Protocol):
    """A network on a runtime: PyTorch, ONNX Runtime, OpenVINO, NCNN, ExecuTorch, TensorRT, or a fake in tests.

    Attributes:
        card: What the network is: classes, normalisation, thresholds.
        name: The runtime and the device, for reports: ``"torch cpu"``.
        canvas: (height, width) in pixels if the input size is fixed; None if any multiples of 32 will do.

    Some have more, which is looked for and may be lacking: ``info`` (see `artefact_info`), ``streams`` (see
    `streams_of`) and ``in_parallel`` (see `ParallelSessions`).
    """

    @property
    def card(self) -> ModelCard: ...  # noqa: D102

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def canvas(self) -> tuple[int, int] | None: ...  # noqa: D102

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        """Run the network; normalisation and decoding included.

        Args:
            batch: (B, H, W, 3) uint8 RGB, letterboxed; any B from 1.

        Raises:
            ShapeError: If the runtime cannot take that size.
            BackendError: If the runtime fails, or the backend was closed.
        """
        ...

    def close(self) -> None:
        """Free what the runtime holds. Calling it twice is harmless."""
        ...


def artefact_info(backend: Backend) -> ArtefactInfo | None:
    """Return how an artefact takes pixels and returns results; None of a backend that runs none."""
    info: ArtefactInfo | None = getattr(backend, "info", None)
    return info


def streams_of(backend: Backend) -> int | None:
    """Return how many images a backend computes at once; None of one that has no streams."""
    streams: int | None = getattr(backend, "streams", None)
    return streams
