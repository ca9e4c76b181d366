"""PyTorch on CUDA without launches: a graph from pixels to boxes and masks, captured once a shape and replayed."""

from __future__ import annotations

import collections
import threading
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from trilitenet.config import MAX_STRIDE, TASKS, ModelCard
from trilitenet.errors import BackendError
from trilitenet.inference.backend import check_batch, held, out_of_memory
from trilitenet.inference.torch_backend import pick_device
from trilitenet.structures import RawOutputs

__all__ = ["CudaGraphBackend"]

_WARM_UP: Final = 3
"""Runs before a capture, in which cuDNN chooses its kernels and the allocator grows."""
_SHAPES: Final = 16
"""So many batch shapes stay captured; the one longest unused makes room, and all do where memory runs out."""


class _Captured(NamedTuple):
    """A captured graph with its fixed input and outputs, each with a page-locked copy on the host."""

    graph: torch.cuda.CUDAGraph
    host: Tensor
    pixels: Tensor
    outputs: tuple[Tensor | None, ...]
    results: tuple[Tensor | None, ...]


class CudaGraphBackend:
    """A network that is launch-bound when run eagerly (its kernels take microseconds), replayed as one launch.

    A batch is filled up to 1, 2, 4 or a multiple of 8, so that few shapes are captured: each takes seconds, and memory.

    Args:
        graph: Module or function of (B, H, W, 3) uint8 RGB pixels on the device that returns detections (B, N, 5 +
            classes) float32 and two masks (B, H, W) uint8 of 0 .. 255, as `RawOutputs` names them; None for a task it
            lacks. It must do the same work on every call.
        card: What the network is.
        device: A CUDA device.

    Raises:
        BackendError: If the device is not CUDA or not there.
    """

    def __init__(
        self, graph: Callable[[Tensor], Sequence[Tensor | None]], card: ModelCard, device: str = "cuda"
    ) -> None:
        self.device = pick_device(device)
        if self.device.type != "cuda":
            raise BackendError(f"CUDA graphs need a CUDA device, not {self.device}; use backend 'torch'")
        self._graph: Callable[[Tensor], Sequence[Tensor | None]] | None = (
            graph.to(self.device).eval() if isinstance(graph, torch.nn.Module) else graph
        )
        self._card = card
        self._captured: collections.OrderedDict[tuple[int, ...], _Captured] = collections.OrderedDict()
        self._lock = threading.Lock()

    @property
    def card(self) -> ModelCard:
        """What the network is."""
        return self._card

    @property
    def name(self) -> str:
        """The runtime and the device."""
        return f"torch {self.device} graph"

    @property
    def canvas(self) -> tuple[int, int] | None:
        """None: any size in multiples of 32 will do; each is captured when it is first seen."""
        return None

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        """Run the network on (B, H, W, 3) uint8 RGB; see `Backend.run`."""
        check_batch(batch, MAX_STRIDE)
        with self._lock, torch.cuda.device(self.device), torch.inference_mode():
            try:
                captured = self._get(_filled(batch.shape))
            except torch.OutOfMemoryError as error:
                raise out_of_memory(self.name, batch) from error
            captured.host.numpy()[: len(batch)] = batch
            captured.pixels.copy_(captured.host, non_blocking=True)
            captured.graph.replay()
            for output, result in zip(captured.outputs, captured.results, strict=True):
                if output is not None and result is not None:
                    result.copy_(output, non_blocking=True)
            torch.cuda.current_stream().synchronize()
            found = {
                task: None if result is None else result.numpy()[: len(batch)].copy()
                for task, result in zip(TASKS, captured.results, strict=True)
            }
        return RawOutputs(**found)

    def close(self) -> None:
        """Free the network, the captured graphs and their memory."""
        with self._lock:
            self._graph = None
            self._captured.clear()

    def _get(self, shape: tuple[int, ...]) -> _Captured:
        """Return the captured graph of a batch shape, made now if it is not there."""
        network = held(self._graph, self._card.variant)
        if shape in self._captured:
            self._captured.move_to_end(shape)
            return self._captured[shape]
        while len(self._captured) >= _SHAPES:
            self._captured.popitem(last=False)
        made = None
        try:
            made = self._capture(network, shape)
        except torch.OutOfMemoryError:
            if not self._captured:
                raise
        if made is None:  # outside of the clause above, in which the error holds what did not fit
            self._captured.clear()
            torch.cuda.empty_cache()
            made = self._capture(network, shape)
        self._captured[shape] = made
        return made

    def _capture(self, network: Callable[[Tensor], Sequence[Tensor | None]], shape: tuple[int, ...]) -> _Captured:
        host = torch.zeros(shape, dtype=torch.uint8, pin_memory=True)
        pixels = host.to(self.device)
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(_WARM_UP):
                network(pixels)
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):  # other threads may use the GPU meanwhile
            outputs = tuple(network(pixels))
        results = tuple(
            None if output is None else torch.empty(output.shape, dtype=output.dtype, pin_memory=True)
            for output in outputs
        )
        return _Captured(graph, host, pixels, outputs, results)


def _filled(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of a batch that is filled up."""
    count = shape[0]
    return (1 << (count - 1).bit_length() if count <= 8 else -(-count // 8) * 8, *shape[1:])
