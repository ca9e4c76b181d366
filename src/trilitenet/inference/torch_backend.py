"""The network on PyTorch: CPU, CUDA or Apple's MPS."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trilitenet.config import MAX_STRIDE, ModelCard
from trilitenet.errors import BackendError
from trilitenet.inference.backend import MOST_PARALLEL, check_batch, held, out_of_memory, replaced
from trilitenet.models.trilitenet import TriLiteNet, normalise_images
from trilitenet.processing.memory import lacks_memory
from trilitenet.structures import RawOutputs

__all__ = ["TorchBackend", "check_threads", "pick_device"]

_parallel_in: int | None = None
"""Number of the process in which PyTorch first had several threads to work with."""


def check_threads() -> None:
    """Check that PyTorch's threads are of this process: a fork lacks them, and would wait for them for ever.

    Raises:
        BackendError: If this process was forked from one where PyTorch had several threads, and is to use several too.
    """
    global _parallel_in
    if torch.get_num_threads() == 1:
        return
    if _parallel_in is None:
        _parallel_in = os.getpid()
    if os.getpid() != _parallel_in:
        raise BackendError(
            "PyTorch worked on several threads before this process was forked; load the model with threads=1, or start "
            "processes with multiprocessing.get_context('spawn')"
        )


def pick_device(device: str = "auto") -> torch.device:
    """Return the device called ``device``; ``"auto"`` is CUDA, else MPS, else the CPU.

    Raises:
        BackendError: If there is no such device here.
    """
    if device == "auto":
        if torch.cuda.is_available():
            return torch.device("cuda")
        return torch.device("mps" if torch.backends.mps.is_available() else "cpu")
    try:
        chosen = torch.device(device)
    except RuntimeError as error:
        raise BackendError(f"unknown device {device!r}; use auto, cpu, cuda, cuda:1 (another GPU) or mps") from error
    try:
        torch.empty(0, device=chosen)
    except (RuntimeError, AssertionError, ImportError) as error:
        reason = str(error).partition("\n")[0].partition(". ")[0].rstrip(".")
        raise BackendError(f"device {device!r} cannot be used ({reason}); try 'cpu'") from error
    return chosen


class TorchBackend:
    """A network on PyTorch.

    Args:
        network: The network; it is moved to the device and put in evaluation mode.
        device: As `pick_device` takes it.
        canvas: Fix the input to this (height, width), as artefacts do; None takes any size in multiples of 32.
        graph: What to run in the network's place: a module or function of (B, H, W, 3) uint8 RGB pixels that returns
            detections (B, N, 5 + classes) float32 and two masks (B, H, W) uint8 of 0 .. 255, None for a task it lacks.

    Raises:
        BackendError: If the device cannot be used, or the process lacks PyTorch's threads (see `check_threads`).
    """

    def __init__(
        self,
        network: TriLiteNet,
        device: str = "auto",
        canvas: tuple[int, int] | None = None,
        *,
        graph: Callable[[Tensor], Sequence[Tensor | None]] | None = None,
    ) -> None:
        check_threads()
        self._graph = graph
        self._canvas = canvas
        self.device = pick_device(device)
        self._name = f"torch {self.device}{'' if graph is None else ' graph'}"
        self._card = network.card
        self._network: TriLiteNet | None = network.to(self.device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]

    @property
    def network(self) -> TriLiteNet:
        """The network on its device; a `BackendError` once the backend was closed."""
        return held(self._network, self._card.variant)

    @property
    def card(self) -> ModelCard:
        """What the network is."""
        return self._card

    @property
    def name(self) -> str:
        """The runtime and the device."""
        return self._name

    @property
    def canvas(self) -> tuple[int, int] | None:
        """(height, width) of the input if it is fixed."""
        return self._canvas

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        """Run the network on (B, H, W, 3) uint8 RGB; see `Backend.run`."""
        check_batch(batch, MAX_STRIDE)
        check_threads()
        batch = np.ascontiguousarray(batch)  # PyTorch takes no reversed axes
        try:
            with torch.inference_mode():
                network, graph = self.network, self._graph
                pixels = torch.from_numpy(batch).to(self.device, non_blocking=True)
                if graph is not None:
                    return RawOutputs(*(None if one is None else one.cpu().numpy() for one in graph(pixels)))
                images = pixels.permute(0, 3, 1, 2)  # seen so it is channels-last in memory: nothing is copied
                outputs = network(normalise_images(images, self.card.mean, self.card.std))
                return RawOutputs(
                    detection=(None if outputs.detection is None else network.decode(outputs).float().cpu().numpy()),
                    drivable=None if outputs.drivable is None else _foreground(outputs.drivable),
                    lane=None if outputs.lane is None else _foreground(outputs.lane),
                )
        except (RuntimeError, MemoryError) as error:
            if not lacks_memory(error):
                raise
            raise out_of_memory(self.name, batch) from error

    @contextlib.contextmanager
    def in_parallel(self) -> Iterator[int]:
        """Inside, images share no cores; yields from how many threads, new ones, `run` is best called."""
        cores = torch.get_num_threads()
        count = min(MOST_PARALLEL, cores) if self.device.type == "cpu" else 1
        if count == 1:
            yield 1
            return
        with replaced(_NEW_THREADS, "number", lambda: cores // count):
            yield count

    def close(self) -> None:
        """Let the network go."""
        self._network = self._graph = None


class _NewThreads:
    """Threads that begin, to which PyTorch gives the number last set by any; one that has worked keeps its own.

    Read and set in a thread of its own: set in one that works, it would be that one's number too, and of those that
    share it (see `replaced`) the first to come need not be the last to go.
    """

    @property
    def number(self) -> int:
        """PyTorch's threads for each of them."""
        with ThreadPoolExecutor(1) as new:
            return new.submit(torch.get_num_threads).result()

    @number.setter
    def number(self, number: int) -> None:
        with ThreadPoolExecutor(1) as new:
            new.submit(torch.set_num_threads, number).result()


_NEW_THREADS: Final = _NewThreads()


def _foreground(logits: Tensor) -> NDArray[np.uint8]:
    """Return (B, H, W) uint8, soft-max probability of the second of two channels x 255."""
    probability = (logits[:, 1] - logits[:, 0]).float().sigmoid_()
    mask: NDArray[np.uint8] = probability.mul_(255).round_().to(torch.uint8).cpu().numpy()
    return mask
