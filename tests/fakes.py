"""A backend that needs no network: it sees what the pixels say, so a test knows what must come out."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ModelCard
from trilitenet.errors import BackendError, part_of
from trilitenet.structures import RawOutputs


class ColourBackend:
    """Takes red pixels for a vehicle, green ones for drivable area and blue ones for lane markings.

    Attributes:
        batches: The shape of every batch it was given.
        closed: How often it was closed.
    """

    name = "fake"

    def __init__(self, canvas: tuple[int, int] | None = None, fail_after: int | None = None) -> None:
        self.card = ModelCard("tiny")
        self.canvas = canvas
        self.fail_after = fail_after
        self.batches: list[tuple[int, ...]] = []
        self.closed = 0

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        if self.fail_after is not None and len(self.batches) >= self.fail_after:
            raise BackendError("the fake backend fails as it was told to")
        self.batches.append(batch.shape)
        red, green, blue = (self._strong(batch, channel) for channel in range(3))
        return RawOutputs(
            np.stack([self._box(mask) for mask in red]), green.astype(np.uint8) * 255, blue.astype(np.uint8) * 255
        )

    def close(self) -> None:
        self.closed += 1

    @staticmethod
    def _strong(batch: NDArray[np.uint8], channel: int) -> NDArray[np.bool_]:
        others = [batch[..., other] for other in range(3) if other != channel]
        strong: NDArray[np.bool_] = (batch[..., channel] > 150) & (np.maximum(*others) < 100)
        return strong

    @staticmethod
    def _box(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
        rows, columns = mask.any(axis=1).nonzero()[0], mask.any(axis=0).nonzero()[0]
        if not len(rows):
            return np.zeros((1, 6), np.float32)
        top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
        return np.array([[(left + right) / 2, (top + bottom) / 2, right - left, bottom - top, 0.9, 1]], np.float32)


def coloured_scene(height: int = 360, width: int = 640) -> NDArray[np.uint8]:
    """Return an image whose lower half is green, with a blue line in it and a red square above."""
    image = np.full((height, width, 3), 60, np.uint8)
    image[height // 2 :] = (20, 200, 20)
    image[height // 2 :, width // 2 : width // 2 + max(4, width // 80)] = (20, 20, 220)
    image[height // 4 : height // 2, width // 4 : width // 2] = (220, 20, 20)
    return image


@contextlib.contextmanager
def written_by_another_process(path: Path) -> Iterator[None]:
    """Inside, another process has claimed a file and begun to write it; then it is killed."""
    program = (
        "import fcntl, sys; file = open(sys.argv[1], 'w'); fcntl.flock(file, fcntl.LOCK_EX); "
        "print('half', file=file, flush=True); print('claimed', flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-c", program, str(part_of(path))]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "claimed\n"
        try:
            yield
        finally:
            process.kill()
