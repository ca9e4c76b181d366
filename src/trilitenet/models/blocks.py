"""Building blocks of the encoder and the decoders.

ESP blocks: Mehta et al., ESPNet, 2018 (https://arxiv.org/abs/1803.06815) and ESPNetv2, 2019
(https://arxiv.org/abs/1811.11431), as Section III-A-1 of the paper combines them. Every batch normalisation has
eps 1e-3 and momentum 0.03; every activation is a PReLU with one slope a channel.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from trilitenet.models.activation import PReLU, batch_norm_prelu

__all__ = [
    "BatchNormPReLU",
    "ConvBNPReLU",
    "DepthwiseConv",
    "DepthwiseESP",
    "DepthwiseSeparableConv",
    "StrideESP",
    "TransposedConvBNPReLU",
    "batch_norm",
]

DILATIONS = (2, 4, 8, 16)


def batch_norm(channels: int) -> nn.BatchNorm2d:
    """Return the batch normalisation used everywhere (eps 1e-3, momentum 0.03)."""
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.03)


class BatchNormPReLU(nn.Module):
    """Batch normalisation, then PReLU: (B, C, H, W) -> (B, C, H, W)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.bn = batch_norm(channels)
        self.act = PReLU(channels)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        out: Tensor = batch_norm_prelu(self.bn, self.act, x)
        return out


class ConvBNPReLU(nn.Module):
    """3x3 convolution without bias, batch normalisation, PReLU: (B, C, H, W) -> (B, out, H / stride, W / stride)."""

    def __init__(self, in_channels: int, out_channels: int, *, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(in_channels, out_channels, 3, stride, padding=1, bias=False)
        self.bn = batch_norm(out_channels)
        self.act = PReLU(out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        out: Tensor = batch_norm_prelu(self.bn, self.act, self.conv(x))
        return out


class TransposedConvBNPReLU(nn.Module):
    """2x2 stride-2 transposed convolution without bias, BN, PReLU: (B, C, H, W) -> (B, out, 2H, 2W)."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.deconv = nn.ConvTranspose2d(in_channels, out_channels, 2, 2, bias=False)
        self.bn = batch_norm(out_channels)
        self.act = PReLU(out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        out: Tensor = batch_norm_prelu(self.bn, self.act, self.deconv(x))
        return out


def _is_bf16_on_cpu(x: Tensor) -> bool:
    return x.device.type == "cpu" and torch.is_autocast_enabled("cpu")


class DilatedConv(nn.Conv2d):
    """k x k convolution without bias, size-keeping padding for stride 1, with a dilation.

    Under bf16 autocast on a CPU, a dilated one runs in fp32 where PyTorch (2.13.0) computes a wrong weight gradient for
    it from channels-last input in bf16: a depthwise one everywhere, a dense one on processors without matrix tiles
    (AMX), which may even crash.
    """

    def __init__(
        self, in_channels: int, out_channels: int, kernel: int, stride: int = 1, dilation: int = 1, groups: int = 1
    ) -> None:
        padding = (kernel // 2) * dilation
        super().__init__(in_channels, out_channels, kernel, stride, padding, dilation, groups, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the convolution."""
        if self.dilation[0] > 1 and _is_bf16_on_cpu(x) and (self.groups > 1 or not torch.cpu._is_amx_tile_supported()):
            with torch.autocast("cpu", enabled=False):
                return super().forward(x.float()).to(x.dtype)
        return super().forward(x)


class DepthwiseConv(DilatedConv):
    """A `DilatedConv` of one group a channel."""

    def __init__(self, channels: int, kernel: int, stride: int = 1, dilation: int = 1) -> None:
        super().__init__(channels, channels, kernel, stride, dilation, groups=channels)


class DepthwiseSeparableConv(nn.Module):
    """Depthwise k x k, then pointwise 1x1, both without bias, normalisation or activation."""

    def __init__(self, in_channels: int, out_channels: int, kernel: int, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        self.depthwise = DepthwiseConv(in_channels, kernel, stride, dilation)
        self.pointwise = nn.Conv2d(in_channels, out_channels, 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        out: Tensor = self.pointwise(self.depthwise(x))
        return out


def _split(out_channels: int) -> tuple[int, int]:
    """Return the channels of the dilated branches and of the dilation-1 branch."""
    branch = out_channels // 5
    return branch, out_channels - 4 * branch


def _fuse_hierarchically(d1: Tensor, d2: Tensor, d4: Tensor, d8: Tensor, d16: Tensor) -> Tensor:
    """Hierarchical feature fusion of ESPNet: concatenate d1, d2, d2+d4, d2+d4+d8 and d2+d4+d8+d16."""
    add1 = d2
    add2 = add1 + d4
    add3 = add2 + d8
    add4 = add3 + d16
    return torch.cat((d1, add1, add2, add3, add4), 1)


class StrideESP(nn.Module):
    """Stride ESP: reduce by a 3x3 stride-2 convolution, transform by five dense dilated ones, fuse, BN, PReLU.

    (B, C, H, W) -> (B, out, H / 2, W / 2).
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        branch, first = _split(out_channels)
        self.reduce = nn.Conv2d(in_channels, branch, 3, 2, padding=1, bias=False)
        self.d1 = nn.Conv2d(branch, first, 3, padding=1, bias=False)
        self.d2, self.d4, self.d8, self.d16 = (DilatedConv(branch, branch, 3, dilation=d) for d in DILATIONS)
        self.bn = batch_norm(out_channels)
        self.act = PReLU(out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        x = self.reduce(x)
        fused = _fuse_hierarchically(self.d1(x), self.d2(x), self.d4(x), self.d8(x), self.d16(x))
        out: Tensor = batch_norm_prelu(self.bn, self.act, fused)
        return out


class DepthwiseESP(nn.Module):
    """Depth-wise ESP: the ESP block with depthwise separable convolutions, a residual sum, then BN and PReLU.

    (B, C, H, W) -> (B, C, H, W).
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        branch, first = _split(channels)
        self.reduce = DepthwiseSeparableConv(channels, branch, 1)
        self.d1 = DepthwiseSeparableConv(branch, first, 3)
        self.d2, self.d4, self.d8, self.d16 = (DepthwiseSeparableConv(branch, branch, 3, dilation=d) for d in DILATIONS)
        self.bn_act = BatchNormPReLU(channels)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        y = self.reduce(x)
        fused = _fuse_hierarchically(self.d1(y), self.d2(y), self.d4(y), self.d8(y), self.d16(y))
        out: Tensor = self.bn_act(x + fused)
        return out
