"""The segmentation decoders (Section III-A-3): two heads of one design, with weights of their own."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trilitenet.models.blocks import ConvBNPReLU, TransposedConvBNPReLU

__all__ = ["SegmentationHead", "UpStage"]


class UpStage(nn.Module):
    """Transposed convolution x2, concatenation with the down-sampled image, two 3x3 convolutions."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.up = TransposedConvBNPReLU(in_channels, out_channels)
        self.conv1 = ConvBNPReLU(out_channels + 3, out_channels)
        self.conv2 = ConvBNPReLU(out_channels, out_channels)

    def forward(self, x: Tensor, image: Tensor) -> Tensor:
        """Map (B, C, H, W) and the image at 2H x 2W to (B, out, 2H, 2W)."""
        out: Tensor = self.conv2(self.conv1(torch.cat((self.up(x), image), 1)))
        return out


class SegmentationHead(nn.Module):
    """F_pcaa (B, c2, H/8, W/8) -> U1 (1/4) -> U2 (1/2) -> logits (B, 2, H, W): background, foreground."""

    def __init__(self, c0: int, c1: int, c2: int) -> None:
        super().__init__()
        self.up1 = UpStage(c2, c1)
        self.up2 = UpStage(c1, c0)
        self.out = TransposedConvBNPReLU(c0, 2)

    def forward(self, x: Tensor, i1: Tensor, i2: Tensor) -> Tensor:
        """Return logits (B, 2, H, W).

        Args:
            x: F_pcaa, (B, c2, H/8, W/8).
            i1: The image pooled once, (B, 3, H/2, W/2).
            i2: The image pooled twice, (B, 3, H/4, W/4).
        """
        out: Tensor = self.out(self.up2(self.up1(x, i2), i1))
        return out
