"""The one thing a runtime must do: turn letterboxed images into raw outputs."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ModelCard
from trilitenet.processing.cores import usable_cores
from trilitenet.structures import RawOutputs

__all__ = ["MOST_PARALLEL", "Backend", "ParallelSessions"]

MOST_PARALLEL: Final = 4
"""At most so many images are computed at once where a backend trades latency for images a second."""


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
        before, self._session = self._session, self._open(cores // count)
        try:
            yield count
        finally:
            self._session = before


@runtime_checkable
class Backend(Protocol):
    """A network on a runtime: PyTorch, ONNX Runtime, OpenVINO, NCNN, TensorRT, or a fake in tests.

    Attributes:
        card: What the network is: classes, normalisation, thresholds.
        name: The runtime and the device, for reports: ``"torch cpu"``.
        canvas: (height, width) in pixels if the input size is fixed; None if any multiples of 32 will do.
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
            BackendError: If the runtime fails.
        """
        ...

    def close(self) -> None:
        """Free what the runtime holds. Calling it twice is harmless."""
        ...
