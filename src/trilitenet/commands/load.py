"""Load a model as a predictor, on whatever runtime its file is for."""

from __future__ import annotations

import dataclasses
import os

from trilitenet.config import ModelCard, Thresholds
from trilitenet.errors import ConfigError, did_you_mean
from trilitenet.inference.backend import Backend
from trilitenet.inference.predictor import Predictor

__all__ = ["BACKENDS", "load"]

BACKENDS = ("auto", "torch")
"""What ``backend`` may be."""


def load(
    model: str | os.PathLike[str] = "tiny",
    *,
    device: str = "auto",
    backend: str = "auto",
    confidence: float | None = None,
    iou: float | None = None,
    drivable: float | None = None,
    lane: float | None = None,
    long_side: int | None = None,
    batch_size: int = 8,
) -> Predictor:
    """Load a model as a predictor.

    Args:
        model: Name of shipped weights, or a file of weights.
        device: auto (the best there is), cpu, cuda, cuda:1, mps.
        backend: auto (what the file is for) or torch.
        confidence: Keep boxes whose confidence is above this, in [0, 1]; the model's own if left out.
        iou: A box goes when it overlaps a better one by more, in [0, 1]; the model's own if left out.
        drivable: A pixel is drivable above this probability, in [0, 1]; the model's own if left out.
        lane: A pixel is lane marking above this probability, in [0, 1]; the model's own if left out.
        long_side: The longer side of an image is resized to so many pixels; by default as in training.
        batch_size: At most so many images go through the network at once.

    Returns:
        The predictor.

    Raises:
        WeightsError: If the file is missing, broken or foreign.
        BackendError: If the device or the runtime is not there.
        ConfigError: If an option is unknown or out of range.
    """
    if backend not in BACKENDS:
        raise ConfigError(f"unknown backend {backend!r}{did_you_mean(backend, BACKENDS)}")
    runtime = _open_torch(model, device)
    thresholds = _override(runtime.card, confidence=confidence, iou=iou, drivable=drivable, lane=lane)
    return Predictor(runtime, thresholds, long_side=long_side, batch_size=batch_size)


def _open_torch(model: str | os.PathLike[str], device: str) -> Backend:
    from trilitenet.inference.torch_backend import TorchBackend
    from trilitenet.models.weights import load_network

    return TorchBackend(load_network(model), device)


def _override(card: ModelCard, **given: float | None) -> Thresholds:
    return dataclasses.replace(card.thresholds, **{name: value for name, value in given.items() if value is not None})  # type: ignore[arg-type]
