"""AdamW with its parameter groups, and the learning rate of every step (Section IV-A)."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import torch
from torch import nn

from trilitenet.errors import ConfigError

__all__ = ["Schedule", "build_optimiser", "parameter_groups"]


def parameter_groups(modules: list[nn.Module], weight_decay: float, *, decay_all: bool = False) -> list[dict[str, Any]]:
    """Split learned parameters: weights of convolutions and matrices decay; biases, normalisation, slopes do not.

    Args:
        modules: Whose parameters that need a gradient are taken.
        weight_decay: Of those that decay.
        decay_all: Let all decay, as the published code does.
    """
    decayed: list[nn.Parameter] = []
    free: list[nn.Parameter] = []
    for module in modules:
        for parameter in module.parameters():
            if parameter.requires_grad:
                (decayed if decay_all or parameter.ndim > 1 else free).append(parameter)
    groups = ((decayed, weight_decay), (free, 0.0))
    return [{"params": params, "weight_decay": decay} for params, decay in groups if params]


def build_optimiser(
    modules: list[nn.Module], *, lr: float, betas: tuple[float, float], weight_decay: float, decay_all: bool = False
) -> torch.optim.AdamW:
    """Build AdamW over the learned parameters of the modules; the fused one where it exists.

    Raises:
        ConfigError: If every parameter is frozen.
    """
    groups = parameter_groups(modules, weight_decay, decay_all=decay_all)
    if not groups:
        raise ConfigError("nothing is left to train: every part is frozen")
    fused = groups[0]["params"][0].device.type in {"cpu", "cuda"}
    return torch.optim.AdamW(groups, lr=lr, betas=betas, fused=fused, foreach=None if fused else True)


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Learning rate of a step: a cosine from 1 to ``final`` of the initial rate, times a linear warm-up at its start.

    Attributes:
        steps: Optimiser steps of the run.
        warmup: Steps of the warm-up, at most ``steps``.
        lr: Initial rate.
        final: Fraction of ``lr`` at the end.
        stair: The cosine goes down once in so many steps.
    """

    steps: int
    warmup: int
    lr: float
    final: float
    stair: int = 1

    def rate(self, step: int) -> float:
        """Return the rate of a step, counted from 0."""
        progress = min(step // self.stair * self.stair / max(self.steps, 1), 1.0)
        cosine = self.final + (1 - self.final) * (1 + math.cos(math.pi * progress)) / 2
        warm = min((step + 1) / self.warmup, 1.0) if self.warmup else 1.0
        return self.lr * cosine * warm

    def apply(self, optimiser: torch.optim.Optimizer, step: int) -> float:
        """Set the rate of a step and return it."""
        rate = self.rate(step)
        for group in optimiser.param_groups:
            group["lr"] = rate
        return rate
