"""The shared encoder (Section III-A-1): C1 .. C5, with the down-sampled images I1 and I2 mixed in."""

from __future__ import annotations

from contextlib import nullcontext
from typing import NamedTuple

import torch
from torch import Tensor, nn

from trilitenet.config import VariantConfig
from trilitenet.models.activation import AveragePool
from trilitenet.models.blocks import ConvBNPReLU, DepthwiseESP, StrideESP

__all__ = ["Encoder", "EncoderOutputs"]


class EncoderOutputs(NamedTuple):
    """Features at 1/8, 1/16 and 1/32 of the input, and the down-sampled images.

    Attributes:
        c3: (B, c4, H/8, W/8).
        c4: (B, c4, H/16, W/16); None without detection.
        c5: (B, c4, H/32, W/32); None without detection.
        i1: (B, 3, H/2, W/2), the image pooled once.
        i2: (B, 3, H/4, W/4), the image pooled twice.
    """

    c3: Tensor
    c4: Tensor | None
    c5: Tensor | None
    i1: Tensor
    i2: Tensor


class Encoder(nn.Module):
    """ESP encoder.

    Args:
        variant: Channels c0 .. c4 and the block counts P and Q.
        deep: Whether C4 and C5, which only detection uses, are computed.
    """

    def __init__(self, variant: VariantConfig, *, deep: bool = True) -> None:
        super().__init__()
        c0, c1, c2, c3, c4 = variant.channels
        self.level1 = ConvBNPReLU(3, c0, stride=2)
        self.pool = AveragePool(3, stride=2, padding=1)  # zeros of the padding count in the mean
        self.b1 = ConvBNPReLU(c0 + 3, c1)
        self.level2_down = StrideESP(c1, c2)
        self.level2 = nn.ModuleList(DepthwiseESP(c2) for _ in range(variant.p))
        self.b2 = ConvBNPReLU(2 * c2 + 3, 2 * c2 + 3)
        self.level3_down = StrideESP(2 * c2 + 3, c3)
        self.level3 = nn.ModuleList(DepthwiseESP(c3) for _ in range(variant.q))
        self.c4 = ConvBNPReLU(c4, c4, stride=2) if deep else None
        self.c5 = ConvBNPReLU(c4, c4, stride=2) if deep else None

    def forward(self, image: Tensor) -> EncoderOutputs:
        """Encode (B, 3, H, W) normalised RGB."""
        kind = image.device.type
        # While training, the stem is exact: what bf16 rounds off pixels and first maps, every gradient misses. It is
        # most of the difference between gradients in bf16 and in fp32, for a few per cent of time (docs/training.md).
        exact = self.training and torch.amp.is_autocast_available(kind) and torch.is_autocast_enabled(kind)
        with torch.autocast(kind, enabled=False) if exact else nullcontext():
            image = image.float() if exact else image
            i1 = self.pool(image)
            i2 = self.pool(i1)
            c1 = self.b1(torch.cat((self.level1(image), i1), 1))
            down2 = self.level2_down(c1)
        x = down2
        for block in self.level2:
            x = block(x)
        c2 = self.b2(torch.cat((x, down2, i2), 1))

        down3 = self.level3_down(c2)
        x = down3
        for block in self.level3:
            x = block(x)
        c3 = torch.cat((down3, x), 1)

        c4 = self.c4(c3) if self.c4 is not None else None
        c5 = self.c5(c4) if self.c5 is not None else None
        return EncoderOutputs(c3, c4, c5, i1, i2)
