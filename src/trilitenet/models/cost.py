"""Parameters and multiply-adds, the columns of the paper's cost table (Sections IV-A-3 and IV-B-1).

The paper's figures ("FLOPs") count element-wise layers besides, so they are somewhat higher (docs/network.md).
"""

from __future__ import annotations

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

__all__ = ["count_multiply_adds", "count_parameters"]


def count_parameters(network: nn.Module) -> int:
    """Return the number of learned parameters."""
    return sum(parameter.numel() for parameter in network.parameters())


def count_multiply_adds(network: nn.Module, size: tuple[int, int] = (384, 640)) -> int:
    """Return the multiply-adds of all convolutions and matrix products for one image.

    Args:
        network: Any network that takes (B, 3, H, W).
        size: (height, width) of the input in pixels.
    """
    parameter = next(network.parameters())
    image = torch.zeros(1, 3, *size, device=parameter.device, dtype=parameter.dtype)
    training = [(module, module.training) for module in network.modules()]
    network.eval()
    try:
        with torch.no_grad(), FlopCounterMode(display=False) as counter:
            network(image)
    finally:
        for module, mode in training:  # one by one: parts may be frozen
            module.training = mode
    return int(counter.get_total_flops()) // 2
