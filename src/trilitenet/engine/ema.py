"""Exponential moving average of a network (Section IV-A): the network that is validated and shipped."""

from __future__ import annotations

import copy
import math
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

__all__ = ["MovingAverage"]

_N = TypeVar("_N", bound=nn.Module)


class MovingAverage:
    """Averages every floating-point tensor of a network, statistics of batch normalisation included.

    The decay of update n is ``decay`` x (1 - exp(-n / ramp)), so that early weights are soon forgotten.

    Args:
        network: What to average; the average starts as a copy of it.
        decay: In [0, 1); 0 makes the average a plain copy.
        ramp: In updates; 0 for no ramp.
    """

    def __init__(self, network: _N, decay: float = 0.9999, ramp: float = 2000.0) -> None:
        self.network: nn.Module = copy.deepcopy(network).eval().requires_grad_(False)
        self.decay = decay
        self.ramp = ramp
        self.updates = 0

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        """Take in the network's current weights."""
        self.updates += 1
        decay = self.decay * (1 - math.exp(-self.updates / self.ramp)) if self.ramp else self.decay
        # Looked up anew: a change of memory format, as validation makes, gives the average's parameters new tensors.
        own, own_copied = _tensors(self.network)
        averaged, copied = _tensors(network)
        torch._foreach_lerp_(own, averaged, 1 - decay)
        if copied:
            torch._foreach_copy_(own_copied, copied)

    def state_dict(self) -> dict[str, Any]:
        """Return the state as plain values and tensors."""
        return {"updates": self.updates, "network": self.network.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` returned."""
        self.updates = int(state["updates"])
        self.network.load_state_dict(state["network"])


def _tensors(network: nn.Module) -> tuple[list[Tensor], list[Tensor]]:
    """Return the floating-point tensors, to average, and the others (counters), to copy."""
    averaged: list[Tensor] = []
    copied: list[Tensor] = []
    for tensor in (*network.parameters(), *network.buffers()):
        (averaged if tensor.is_floating_point() else copied).append(tensor.detach())
    return averaged, copied
