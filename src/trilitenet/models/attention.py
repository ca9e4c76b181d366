"""Partial Class Activation Attention (Section III-A-3).

Liu et al., Partial Class Activation Attention for Semantic Segmentation, CVPR 2022.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from trilitenet.models.blocks import batch_norm

__all__ = ["BINS", "PCAA", "merge_bins", "split_bins"]

BINS: Final = (2, 4)
"""Rows and columns of bins that the map is divided into."""


def split_bins(x: Tensor) -> Tensor:
    """Return (B, C, H, W) as (B, bins, pixels of a bin, C)."""
    batch, channels, height, width = x.shape
    rows, columns = BINS
    x = x.view(batch, channels, rows, height // rows, columns, width // columns)
    return x.permute(0, 2, 4, 3, 5, 1).reshape(batch, rows * columns, -1, channels)


def merge_bins(x: Tensor, height: int, width: int) -> Tensor:
    """Invert `split_bins`: (B, bins, pixels of a bin, C) -> (B, C, height, width)."""
    batch, _, _, channels = x.shape
    rows, columns = BINS
    x = x.view(batch, rows, columns, height // rows, width // columns, channels)
    return x.permute(0, 5, 1, 3, 2, 4).reshape(batch, channels, height, width)


class BinGraph(nn.Module):
    """Graph convolution over the bins: (B, bins, K, C) -> (B, bins, K, C)."""

    def __init__(self, bins: int, channels: int) -> None:
        super().__init__()
        self.nodes = nn.Conv2d(bins, bins, 1, bias=False)
        self.act = nn.PReLU(bins)
        self.channels = nn.Linear(channels, channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        out: Tensor = self.channels(self.act(self.nodes(x) + x))
        return out


class PCAA(nn.Module):
    """Attention between pixels and class centres, local to a bin and global: (B, C, H, W) -> (B, C, H, W).

    K class maps weigh the pixels of each bin into K local class centres; a graph convolution exchanges them between
    bins; a learned sum over bins gives global centres. A pixel's query meets its bin's local centres (keys) and
    collects the global ones (values). The affinities are not scaled by 1 / sqrt(d), as in the published network.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = channels // 2
        bins = BINS[0] * BINS[1]
        self.class_maps = nn.Conv2d(channels, channels, 1)
        self.graph = BinGraph(bins, channels)
        self.fuse = nn.Conv2d(bins, 1, 1)
        self.fuse_act = nn.PReLU(1)
        self.query = nn.Linear(channels, inner)
        self.key = nn.Linear(channels, inner)
        self.value = nn.Linear(channels, inner)
        self.out = nn.Sequential(nn.Conv2d(inner, channels, 1, bias=False), batch_norm(channels), nn.PReLU(channels))

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block; H must be a multiple of 2 and W of 4."""
        height, width = x.shape[-2:]
        pixels = split_bins(x)  # (B, bins, R, C)
        maps = split_bins(self.class_maps(x))  # (B, bins, R, K)
        confidence = maps.mean(2).sigmoid().unsqueeze(-1)  # (B, bins, K, 1)
        local = torch.matmul(F.softmax(maps, 2).transpose(2, 3), pixels) * confidence  # (B, bins, K, C)
        local = self.graph(local)
        # One set of global centres, repeated a bin as the published network does (the deploy graph computes it once).
        total = self.fuse_act(self.fuse(local)).repeat(1, local.shape[1], 1, 1)  # (B, bins, K, C)

        affinity = F.softmax(torch.matmul(self.query(pixels), self.key(local).transpose(2, 3)), -1)
        attended = torch.matmul(affinity, self.value(total))  # (B, bins, R, C / 2)
        out: Tensor = x + self.out(merge_bins(attended, height, width))
        return out
