"""Networks with statistics and slopes that exercise every term of the rewrites."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from trilitenet.models.trilitenet import TriLiteNet, build_network


def lively_network(variant: str = "tiny", seed: int = 0, **options: Any) -> TriLiteNet:
    """Build a network whose normalisations and activations are far from their initial values."""
    torch.manual_seed(seed)
    network = build_network(variant, **options)
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.BatchNorm2d):
                assert module.running_mean is not None
                assert module.running_var is not None
                module.running_mean.normal_(0, 0.1)
                module.running_var.uniform_(0.6, 1.4)
                module.weight.uniform_(0.6, 1.2)
                module.bias.normal_(0, 0.1)
            elif isinstance(module, nn.PReLU):
                module.weight.uniform_(0.05, 0.5)
        if network.detection is not None:
            for conv in network.detection.convs:
                assert isinstance(conv, nn.Conv2d)
                conv.weight.mul_(3)
    return network.eval()
