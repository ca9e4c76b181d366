"""The detection decoder (Section III-A-2): SPP, LitePAN, the anchor-based head and its decoding."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from trilitenet.config import STRIDES
from trilitenet.models.blocks import DepthwiseSeparableConv

__all__ = ["SPP", "DetectionHead", "LitePAN", "decode_level"]

_ANCHORS: Final = 3
"""Of a level."""


class SPP(nn.Module):
    """Spatial pyramid pooling: 1x1, max pools of 5, 9 and 13, concatenation, 1x1. (B, C, H, W) -> (B, C, H, W)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(channels, channels // 2, 1)
        self.expand = nn.Conv2d(channels * 2, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        x = self.reduce(x)
        pools = [F.max_pool2d(x, size, stride=1, padding=size // 2) for size in (5, 9, 13)]
        out: Tensor = self.expand(torch.cat((x, *pools), 1))
        return out


class LitePAN(nn.Module):
    """Path aggregation with depthwise separable convolutions and sums instead of concatenations.

    Args:
        in_channels: Channels of C3, C4 and C5.
        channels: Channels of P3, P4 and P5.
        paths: Without the two paths (ablation "without LitePAN") only the lateral 1x1 convolutions remain.
    """

    def __init__(self, in_channels: int, channels: int, *, paths: bool = True) -> None:
        super().__init__()
        self.laterals = nn.ModuleList(nn.Conv2d(in_channels, channels, 1) for _ in range(3))
        self.paths = paths
        if paths:
            self.top_down = nn.ModuleList(DepthwiseSeparableConv(channels, channels, 3) for _ in range(3))
            self.bottom_up = nn.ModuleList(DepthwiseSeparableConv(channels, channels, 3, 2) for _ in range(2))
            self.smooth = nn.ModuleList(DepthwiseSeparableConv(channels, channels, 3) for _ in range(3))

    def forward(self, c3: Tensor, c4: Tensor, c5: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return P3, P4 and P5."""
        p3, p4, p5 = (lateral(c) for lateral, c in zip(self.laterals, (c3, c4, c5), strict=True))
        if not self.paths:
            return p3, p4, p5
        p4 = p4 + F.interpolate(p5, size=p4.shape[-2:], mode="bilinear", align_corners=False)
        p3 = p3 + F.interpolate(p4, size=p3.shape[-2:], mode="bilinear", align_corners=False)
        p3, p4, p5 = (conv(p) for conv, p in zip(self.top_down, (p3, p4, p5), strict=True))
        p4 = p4 + self.bottom_up[0](p3)
        p5 = p5 + self.bottom_up[1](p4)
        p3, p4, p5 = (conv(p) for conv, p in zip(self.smooth, (p3, p4, p5), strict=True))
        return p3, p4, p5


class DetectionHead(nn.Module):
    """One 1x1 convolution a level: 3 anchors x (4 box + 1 objectness + classes) logits a cell."""

    def __init__(self, channels: int, classes: int) -> None:
        super().__init__()
        self.classes = classes
        self.convs = nn.ModuleList(nn.Conv2d(channels, _ANCHORS * (5 + classes), 1) for _ in STRIDES)
        self._initialise_biases()

    @torch.no_grad()
    def _initialise_biases(self) -> None:
        """Start at about 8 objects a 640-pixel image and at even classes, so that early steps are calm."""
        for conv, stride in zip(self.convs, STRIDES, strict=True):
            assert isinstance(conv, nn.Conv2d)
            assert conv.bias is not None
            bias = conv.bias.view(_ANCHORS, -1)
            bias[:, 4] += math.log(8 / (640 / stride) ** 2)
            bias[:, 5:] += math.log(0.6 / (self.classes - 0.99))

    def forward(self, levels: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return logits (B, 3, h, w, 5 + classes) of the three levels."""
        outputs = []
        for conv, x in zip(self.convs, levels, strict=True):
            y = conv(x)
            batch, _, height, width = y.shape
            outputs.append(y.view(batch, _ANCHORS, -1, height, width).permute(0, 1, 3, 4, 2))
        return outputs[0], outputs[1], outputs[2]


def decode_level(logits: Tensor, anchors: Tensor, stride: int) -> Tensor:
    """Decode one level.

    xy = (2 sigmoid(t) - 0.5 + cell) * stride; wh = (2 sigmoid(t))^2 * anchor; objectness and classes: sigmoid.

    Args:
        logits: (B, 3, h, w, 5 + classes).
        anchors: (3, 2) width and height in input pixels.
        stride: Input pixels a cell.

    Returns:
        (B, 3 * h * w, 5 + classes): centre x, centre y, width, height in input pixels, objectness, class
        probabilities; by anchor, row, column.
    """
    batch, per_level, height, width, values = logits.shape
    scores = logits.float().sigmoid()
    rows = torch.arange(height, device=logits.device, dtype=torch.float32)
    columns = torch.arange(width, device=logits.device, dtype=torch.float32)
    cells = torch.stack(torch.meshgrid(rows, columns, indexing="ij")[::-1], -1)  # (h, w, 2): x, y
    xy = (scores[..., :2] * 2 - 0.5 + cells) * stride
    wh = (scores[..., 2:4] * 2) ** 2 * anchors.view(1, per_level, 1, 1, 2)
    return torch.cat((xy, wh, scores[..., 4:]), -1).view(batch, -1, values)
