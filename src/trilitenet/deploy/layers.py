"""Layers of the deploy graph: what `rewrites` returns, as modules."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from trilitenet.deploy.rewrites import (
    Blocks,
    Kernel,
    batch_norm_affine,
    compose_pointwise,
    conv_kernel,
    fold_batch_norm,
    hierarchical_sum_matrix,
    prelu_as_maximum,
    prelu_slopes,
    space_to_depth_kernel,
)
from trilitenet.models.blocks import ConvBNPReLU, DepthwiseESP, DepthwiseSeparableConv, StrideESP

__all__ = [
    "Activation",
    "DepthwiseESPGraph",
    "FusedConv",
    "FusedTransposedConv",
    "Layout",
    "SeparableGraph",
    "StrideESPGraph",
    "constant",
    "depth_to_space",
    "fold_block",
]


@dataclasses.dataclass(frozen=True)
class Layout:
    """How the deploy graph is laid out in memory and operators. Every layout computes the same function.

    Attributes:
        channels_last: Regroup pixels, bins and masks in (B, H, W, C) order, and write transposed convolutions as 1x1
            convolutions; for runtimes whose convolutions are channels-last. Otherwise plain (B, C, H, W) operators of
            at most four dimensions, and transposed convolutions as such.
        front: Side of the pixel blocks that share a cell at 1/2 resolution in the encoder (1 or 2; see `rewrites`).
        quarter: The same in the segmentation heads at 1/4 (1 or 2).
        half: The same in the segmentation heads at 1/2, at most twice ``quarter``; above 1 it also writes their last
            transposed convolutions as 1x1.
        split: Write conv(concat(x, image)) as conv(x) + conv(image).
        maximum: Write PReLU as max(x, a x) where that is exact.
    """

    channels_last: bool = True
    front: int = 1
    quarter: int = 1
    half: int = 1
    split: bool = False
    maximum: bool = False

    def __post_init__(self) -> None:
        assert self.channels_last or self.front == self.quarter == 1
        assert self.front <= self.half <= 2 * self.quarter


def constant(value: Tensor) -> nn.Parameter:
    """Return a float32 parameter that is not trained."""
    return nn.Parameter(value.float().contiguous(), requires_grad=False)


class Activation(nn.Module):
    """PReLU with one slope a channel: (B, C, H, W) -> (B, C, H, W)."""

    def __init__(self, slopes: Tensor, *, maximum: bool = False) -> None:
        super().__init__()
        self.maximum = maximum and prelu_as_maximum(slopes)
        self.slopes = constant(slopes.view(1, -1, 1, 1) if self.maximum else slopes)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the activation."""
        return torch.maximum(x, x * self.slopes) if self.maximum else F.prelu(x, self.slopes)


class FusedConv(nn.Module):
    """Convolution with bias, an optional sum with another map, and an optional PReLU."""

    def __init__(self, kernel: Kernel, slopes: Tensor | None = None, *, maximum: bool = False) -> None:
        super().__init__()
        self.weight = constant(kernel.weight)
        self.bias = constant(kernel.bias)
        self.act = None if slopes is None else Activation(slopes, maximum=maximum)
        self.padding = kernel.padding
        self.stride = kernel.stride
        self.dilation = kernel.dilation
        self.groups = kernel.groups

    def forward(self, x: Tensor, add: Tensor | None = None) -> Tensor:
        """Return PReLU(conv(x) + add)."""
        top, left, bottom, right = self.padding
        if top == left == bottom == right:
            padding = top
        else:
            x = F.pad(x, (left, right, top, bottom))
            padding = 0
        x = F.conv2d(x, self.weight, self.bias, self.stride, padding, self.dilation, self.groups)
        if add is not None:
            x = x + add
        return x if self.act is None else self.act(x)


class FusedTransposedConv(nn.Module):
    """2x2 stride-2 transposed convolution with its batch normalisation folded, then PReLU."""

    def __init__(self, deconv: nn.ConvTranspose2d, norm: nn.BatchNorm2d, slopes: Tensor, *, maximum: bool) -> None:
        super().__init__()
        scale, shift = batch_norm_affine(norm)
        self.weight = constant(deconv.weight.detach().double() * scale.view(1, -1, 1, 1))
        self.bias = constant(shift)
        self.act = Activation(slopes, maximum=maximum)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to (B, out, 2H, 2W)."""
        out: Tensor = self.act(F.conv_transpose2d(x, self.weight, self.bias, 2))
        return out


def fold_block(block: ConvBNPReLU) -> tuple[Kernel, Tensor]:
    """Return the folded kernel and the PReLU slopes of a block."""
    kernel = fold_batch_norm(conv_kernel(block.conv), block.bn)
    return kernel, prelu_slopes(block.act, len(kernel.weight))


def depth_to_space(x: Tensor, block: int) -> Tensor:
    """Turn a space-to-depth map with blocks (block, block) into pixels: (B, C, H, W) -> (B, C / block^2, ...).

    The order of channels is that of ONNX's ``DepthToSpace`` in mode DCR, which is what an export gets.
    """
    batch, channels, height, width = x.shape
    shape = (batch, channels // block**2, height * block, width * block)
    if torch.onnx.is_in_onnx_export():
        attributes: dict[str, Any] = {"blocksize": block, "mode": "DCR"}
        return torch.onnx.ops.symbolic("DepthToSpace", (x,), attributes, dtype=x.dtype, shape=shape, version=13)
    return x.view(batch, block, block, shape[1], height, width).permute(0, 3, 4, 1, 5, 2).reshape(shape)


class StrideESPGraph(nn.Module):
    """Stride ESP: the reducing convolution, five dilated ones, and one 1x1 for sums, concat and normalisation."""

    def __init__(self, block: StrideESP, layout: Layout, source: Blocks) -> None:
        super().__init__()
        self.reduce = FusedConv(space_to_depth_kernel(conv_kernel(block.reduce), source, (1, 1)))
        kernels = [conv_kernel(conv) for conv in (block.d1, block.d2, block.d4, block.d8, block.d16)]
        self.branches = nn.ModuleList(FusedConv(kernel) for kernel in kernels)
        matrix = hierarchical_sum_matrix(len(kernels[0].weight), len(kernels[1].weight))
        merge = Kernel(matrix.view(*matrix.shape, 1, 1), torch.zeros(len(matrix), dtype=torch.float64))
        self.merge = FusedConv(
            fold_batch_norm(merge, block.bn), prelu_slopes(block.act, len(matrix)), maximum=layout.maximum
        )

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        x = self.reduce(x)
        out: Tensor = self.merge(torch.cat([branch(x) for branch in self.branches], 1))
        return out


class DepthwiseESPGraph(nn.Module):
    """Depth-wise ESP: one 1x1, five depthwise convolutions, one 1x1, the residual sum, scale and PReLU.

    BN(x + T D y) = s (x + T D y + shift / s): the shift over the scale is the bias of the merging 1x1; the scale stays
    behind the sum, where runtimes fuse it with the activation.
    """

    def __init__(self, block: DepthwiseESP, layout: Layout) -> None:
        super().__init__()
        reduce = compose_pointwise(conv_kernel(block.reduce.depthwise), conv_kernel(block.reduce.pointwise))
        self.reduce = FusedConv(reduce)
        pairs = (block.d1, block.d2, block.d4, block.d8, block.d16)
        self.branches = nn.ModuleList(FusedConv(conv_kernel(pair.depthwise)) for pair in pairs)
        pointwise = [conv_kernel(pair.pointwise).weight[:, :, 0, 0] for pair in pairs]
        matrix = hierarchical_sum_matrix(len(pointwise[0]), len(pointwise[1])) @ torch.block_diag(*pointwise)
        scale, shift = batch_norm_affine(block.bn_act.bn)
        self.merge = FusedConv(Kernel(matrix.view(*matrix.shape, 1, 1), shift / scale))
        self.scale = constant(scale.view(1, -1, 1, 1))
        self.act = Activation(prelu_slopes(block.bn_act.act, len(scale)), maximum=layout.maximum)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        y = self.reduce(x)
        y = self.merge(torch.cat([branch(y) for branch in self.branches], 1))
        out: Tensor = self.act((x + y) * self.scale)
        return out


class SeparableGraph(nn.Module):
    """Depthwise and pointwise convolution, and an optional sum."""

    def __init__(self, block: DepthwiseSeparableConv) -> None:
        super().__init__()
        self.depthwise = FusedConv(conv_kernel(block.depthwise))
        self.pointwise = FusedConv(conv_kernel(block.pointwise))

    def forward(self, x: Tensor, add: Tensor | None = None) -> Tensor:
        """Return pointwise(depthwise(x)) + add."""
        out: Tensor = self.pointwise(self.depthwise(x), add)
        return out
