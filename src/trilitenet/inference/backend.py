"""The one thing a runtime must do: turn letterboxed images into raw outputs."""

from __future__ import annotations

import os
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ModelCard
from trilitenet.structures import RawOutputs

__all__ = ["MOST_PARALLEL", "Backend", "usable_cores"]

MOST_PARALLEL: Final = 4
"""At most so many images are computed at once where a backend trades latency for images a second."""


def usable_cores() -> int:
    """Return on how many processor cores this process may run."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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
