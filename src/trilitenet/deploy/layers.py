"""Layers of the deploy graph: what `rewrites` returns, as modules."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from trilitenet.deploy.rewrites import (
    Kernel,
    batch_norm_affine,
    compose_pointwise,
    concatenated_cells,
    conv_kernel,
    fold_batch_norm,
    hierarchical_sum_matrix,
    prelu_as_maximum,
    prelu_slopes,
    space_to_depth_kernel,
    transposed_in_columns,
)
from trilitenet.models.blocks import ConvBNPReLU, DepthwiseESP, DepthwiseSeparableConv, StrideESP

__all__ = [
    "Activation",
    "Columns",
    "DepthwiseESPGraph",
    "FusedConv",
    "FusedTransposedConv",
    "Layout",
    "SeparableGraph",
    "StrideESPGraph",
    "columns_before",
    "columns_before_doubling",
    "concatenate",
    "constant",
    "depth_to_space",
    "fold_block",
    "recolumn",
]

MOST_SHIFT: Final = 1e3
"""A normalisation's shift over its scale, above which half precision loses what the shift is added to."""


@dataclasses.dataclass(frozen=True)
class Columns:
    """How many neighbouring columns share a cell, a stage of the deploy graph. See `recolumn`.

    Attributes:
        stem: Of the first convolution's output at 1/2.
        front: At 1/2 in the encoder.
        level2: In the ESP blocks at 1/4.
        quarter: In the segmentation heads at 1/4.
        half: In the segmentation heads at 1/2.
        out: Where the heads make logits, at 1/2. Above 1, each row of a mask comes from a convolution of its own.
    """

    stem: int = 1
    front: int = 1
    level2: int = 1
    quarter: int = 1
    half: int = 1
    out: int = 1


@dataclasses.dataclass(frozen=True)
class Layout:
    """How the deploy graph is laid out in memory and operators. Every layout computes the same function.

    Attributes:
        channels_last: Regroup pixels, bins and masks in (B, H, W, C) order, and write the last transposed convolutions
            as 1x1 convolutions; for runtimes whose convolutions are channels-last. Otherwise plain (B, C, H, W)
            operators of at most four dimensions, and transposed convolutions as such.
        pointwise: Write the other transposed convolutions as 1x1 convolutions too; only channels-last.
        columns: Cells of neighbouring columns; only channels-last, where they are views.
        half: Side of the pixel blocks that share a cell in the segmentation heads at 1/2 (1 or 2; see `rewrites`);
            only (B, C, H, W). 2 also writes their last transposed convolutions as 1x1.
        split: Write conv(concat(x, image)) as conv(x) + conv(image).
        shared_image: Let the heads find the image at 1/2 among the stem's outputs, instead of pooling it by a
            convolution of its own; only where the two have as many columns a cell.
        maximum: Write PReLU as max(x, a x) where that is exact.
    """

    channels_last: bool = True
    pointwise: bool = False
    columns: Columns = Columns()
    half: int = 1
    split: bool = False
    shared_image: bool = False
    maximum: bool = False

    def __post_init__(self) -> None:
        assert not self.pointwise or (self.channels_last and self.columns == Columns())
        assert self.half == 1 if self.channels_last else self.columns == Columns()
        assert self.split or max(self.columns.level2, self.columns.quarter, self.columns.half) == 1
        assert not self.shared_image or (self.split and self.columns.stem == self.columns.half > 1)


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


def columns_before(columns: int) -> int:
    """Return how many columns share a cell before a convolution of stride 2 whose output has ``columns``."""
    return 2 * columns if columns > 1 else 1


def columns_before_doubling(columns: int) -> int:
    """Return how many columns share a cell before a transposed convolution x2 whose output has ``columns``."""
    return max(columns // 2, 1)


def recolumn(x: Tensor, before: int, after: int) -> Tensor:
    """Let other numbers of neighbouring columns share a cell: (B, before x C, H, W / before) -> (B, after x C, ...).

    Channels-last it is a view: the same bytes, read as fewer and wider pixels, or as more and narrower ones.
    """
    return x if before == after else _rows(x, before, after).permute(0, 3, 1, 2)


def concatenate(maps: Sequence[Tensor], columns: int) -> Tensor:
    """Concatenate the channels of maps in cells of so many columns; the result has none.

    As rows of pixels, so that a runtime sees at once that its channels-last memory is the concatenation's.
    """
    if columns == 1:
        return torch.cat(tuple(maps), 1)
    return torch.cat([_rows(x, columns, 1) for x in maps], 3).permute(0, 3, 1, 2)


def _rows(x: Tensor, before: int, after: int) -> Tensor:
    """Return a map's rows, (B, H, width, channels), in cells of ``after`` columns instead of ``before``."""
    batch, channels, height, width = x.shape
    return x.permute(0, 2, 3, 1).reshape(batch, height, width * before // after, channels // before * after)


class FusedConv(nn.Module):
    """Convolution with bias, an optional sum with another map, and an optional PReLU.

    Args:
        kernel: The weights.
        slopes: Those of the PReLU, one an output channel.
        maximum: See `Layout`.
        columns: Columns that share a cell of the input and of the output.
    """

    def __init__(
        self, kernel: Kernel, slopes: Tensor | None = None, columns: tuple[int, int] = (1, 1), *, maximum: bool = False
    ) -> None:
        super().__init__()
        source, target = columns
        kernel = space_to_depth_kernel(kernel, (1, source), (1, target))
        slopes = None if slopes is None else slopes.repeat(target)
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
    """2x2 stride-2 transposed convolution with its batch normalisation folded, then PReLU.

    Args:
        deconv: The network's.
        norm: The normalisation after it.
        slopes: Those of the PReLU.
        columns: Columns that share a cell of the output; of the input see `columns_before_doubling`.
        maximum: See `Layout`.
    """

    def __init__(
        self,
        deconv: nn.ConvTranspose2d,
        norm: nn.BatchNorm2d,
        slopes: Tensor,
        columns: int = 1,
        *,
        maximum: bool = False,
    ) -> None:
        super().__init__()
        scale, shift = batch_norm_affine(norm)
        weight = deconv.weight.detach().double() * scale.view(1, -1, 1, 1)
        self.stride = (2, 2)
        if columns > 1:
            weight = transposed_in_columns(weight, columns_before_doubling(columns))
            self.stride = (2, 1)
        self.weight = constant(weight)
        copies = weight.shape[1] // len(shift)
        self.bias = constant(shift.repeat(copies))
        self.act = Activation(slopes.repeat(copies), maximum=maximum)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, C, H, W) to (B, out, 2H, 2W), or in cells of columns."""
        out: Tensor = self.act(F.conv_transpose2d(x, self.weight, self.bias, self.stride))
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
    """Stride ESP: the reducing convolution, five dilated ones, and one 1x1 for sums, concat and normalisation.

    Args:
        block: The network's.
        columns: Columns of the output that share a cell; of the input see `columns_before`.
        maximum: See `Layout`.
    """

    def __init__(self, block: StrideESP, columns: int, *, maximum: bool) -> None:
        super().__init__()
        self.reduce = FusedConv(conv_kernel(block.reduce), columns=(columns_before(columns), columns))
        kernels = [conv_kernel(conv) for conv in (block.d1, block.d2, block.d4, block.d8, block.d16)]
        self.branches = nn.ModuleList(FusedConv(kernel, columns=(columns, columns)) for kernel in kernels)
        channels = [len(kernel.weight) for kernel in kernels]
        matrix = hierarchical_sum_matrix(*channels[:2])
        merge = Kernel(matrix.view(*matrix.shape, 1, 1), torch.zeros(len(matrix), dtype=torch.float64))
        merge = concatenated_cells(fold_batch_norm(merge, block.bn), channels, (1, columns))
        slopes = prelu_slopes(block.act, len(matrix)).repeat(columns)
        self.merge = FusedConv(merge, slopes, maximum=maximum)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        x = self.reduce(x)
        out: Tensor = self.merge(torch.cat([branch(x) for branch in self.branches], 1))
        return out


class DepthwiseESPGraph(nn.Module):
    """Depth-wise ESP: one 1x1, five depthwise convolutions, one 1x1, the residual sum, scale and PReLU.

    BN(x + T D y) = s (x + T D y + shift / s): the shift over the scale is the bias of the merging 1x1; the scale stays
    behind the sum, where runtimes fuse it with the activation. In cells of columns the residual is one more input of
    the merging 1x1 instead, with s on the diagonal: OpenVINO regroups the result of a convolution without a sum for
    nothing, that of one with a sum by copying. So it is where a scale is so small that the shift cannot be over it.

    Args:
        block: The network's.
        columns: Columns that share a cell; those convolutions whose dilation they do not divide become dense.
        maximum: See `Layout`.
    """

    def __init__(self, block: DepthwiseESP, columns: int, *, maximum: bool) -> None:
        super().__init__()
        reduce = compose_pointwise(conv_kernel(block.reduce.depthwise), conv_kernel(block.reduce.pointwise))
        self.reduce = FusedConv(reduce, columns=(columns, columns))
        pairs = (block.d1, block.d2, block.d4, block.d8, block.d16)
        kernels = [conv_kernel(pair.depthwise) for pair in pairs]
        self.branches = nn.ModuleList(FusedConv(kernel, columns=(columns, columns)) for kernel in kernels)
        pointwise = [conv_kernel(pair.pointwise).weight[:, :, 0, 0] for pair in pairs]
        matrix = hierarchical_sum_matrix(len(pointwise[0]), len(pointwise[1])) @ torch.block_diag(*pointwise)
        scale, shift = batch_norm_affine(block.bn_act.bn)
        slopes = prelu_slopes(block.bn_act.act, len(scale))
        self.joined = columns > 1 or not bool((shift.abs() < MOST_SHIFT * scale.abs()).all())
        if self.joined:
            matrix = torch.cat((matrix * scale.unsqueeze(1), torch.diag(scale)), 1)
            merge = Kernel(matrix.view(*matrix.shape, 1, 1), shift)
            channels = [len(kernel.weight) for kernel in kernels] + [len(scale)]
            merge = concatenated_cells(merge, channels, (1, columns))
            self.merge = FusedConv(merge, slopes.repeat(columns), maximum=maximum)
        else:
            self.merge = FusedConv(Kernel(matrix.view(*matrix.shape, 1, 1), shift / scale))
            self.scale = constant(scale.view(1, -1, 1, 1))
            self.act = Activation(slopes, maximum=maximum)

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        y = self.reduce(x)
        parts = [branch(y) for branch in self.branches]
        if self.joined:
            joined: Tensor = self.merge(torch.cat((*parts, x), 1))
            return joined
        out: Tensor = self.act((x + self.merge(torch.cat(parts, 1))) * self.scale)
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
