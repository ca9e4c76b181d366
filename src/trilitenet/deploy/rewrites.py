"""Exact rewrites of the network's layers: algebra on weights, one named function each.

Nothing here approximates: every function returns weights of a layer that computes what the layers it replaces compute,
in exact arithmetic. All are evaluated in float64, so that the deploy graph differs from the network by float32
rounding alone. `Kernel` holds what a convolution needs; `Blocks` says how many neighbouring pixels share a cell of a
space-to-depth map.

Space-to-depth maps: a map of C channels with blocks (r, c) is held as (B, r * c * C, H / r, W / c); channel
(i * c + j) * C + k of cell (y, x) is channel k of pixel (r * y + i, c * x + j). Channels-last memory of such a map is a
mere regrouping of rows, and narrow convolutions become wide enough for a processor's vectors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from trilitenet.models.attention import PCAA

__all__ = [
    "AttentionWeights",
    "Blocks",
    "Kernel",
    "batch_norm_affine",
    "compose_pointwise",
    "concatenated_cells",
    "conv_kernel",
    "depthwise_as_dense",
    "fold_attention",
    "fold_batch_norm",
    "fold_normalisation",
    "hierarchical_sum_matrix",
    "join_outputs",
    "mask_difference",
    "merge_pool_into_stem",
    "nest_blocks",
    "pad_inputs",
    "pool_kernel",
    "prelu_as_maximum",
    "prelu_slopes",
    "reverse_inputs",
    "space_to_depth_kernel",
    "split_inputs",
    "take_outputs",
    "transposed_as_pointwise",
    "transposed_in_columns",
    "trim_taps",
    "upsample_kernel",
]

Blocks = tuple[int, int]
"""Rows and columns of pixels that share a cell of a space-to-depth map; (1, 1) is an ordinary map."""


class Kernel(NamedTuple):
    """A convolution's weights, float64.

    Attributes:
        weight: (out, in / groups, kernel height, kernel width).
        bias: (out,).
        padding: Zeros added at the top, left, bottom, right.
        stride: Rows and columns.
        dilation: Rows and columns.
        groups: 1, or the number of channels for a depthwise convolution.
    """

    weight: Tensor
    bias: Tensor
    padding: tuple[int, int, int, int] = (0, 0, 0, 0)
    stride: tuple[int, int] = (1, 1)
    dilation: tuple[int, int] = (1, 1)
    groups: int = 1


def conv_kernel(conv: nn.Conv2d) -> Kernel:
    """Return the weights of a convolution layer with square kernel, stride, padding and dilation."""
    weight = conv.weight.detach().double()
    bias = torch.zeros(len(weight), dtype=torch.float64) if conv.bias is None else conv.bias.detach().double()
    pad = conv.padding[0]
    assert isinstance(pad, int)
    stride, dilation = ((pair[0], pair[1]) for pair in (conv.stride, conv.dilation))
    return Kernel(weight, bias, (pad,) * 4, stride, dilation, conv.groups)


def fold_batch_norm(kernel: Kernel, norm: nn.BatchNorm2d) -> Kernel:
    """Fold a batch normalisation into the convolution before it.

    With s = gamma / sqrt(var + eps): BN(Wx + b) = (sW) x + (s (b - mean) + beta).
    """
    scale, shift = batch_norm_affine(norm)
    return kernel._replace(
        weight=kernel.weight * scale.view(-1, 1, 1, 1),
        bias=kernel.bias * scale + shift,
    )


def batch_norm_affine(norm: nn.BatchNorm2d) -> tuple[Tensor, Tensor]:
    """Return scale and shift of a batch normalisation in evaluation mode: BN(x) = scale x + shift."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = norm.weight.detach().double() / (norm.running_var.double() + norm.eps).sqrt()
    return scale, norm.bias.detach().double() - norm.running_mean.double() * scale


def prelu_slopes(act: nn.PReLU, channels: int) -> Tensor:
    """Return the slopes of a PReLU, one a channel, float64."""
    return act.weight.detach().double().expand(channels)


def fold_normalisation(mean: tuple[float, ...], std: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """Return scale and shift, (3,) each, of (x / 255 - mean) / std = scale x + shift.

    The shift cannot go into the first convolution, whose padding is zero *after* normalisation.
    """
    scale = 1 / (255 * torch.tensor(std, dtype=torch.float64))
    return scale, -torch.tensor(mean, dtype=torch.float64) / torch.tensor(std, dtype=torch.float64)


def depthwise_as_dense(kernel: Kernel) -> Kernel:
    """Write a depthwise convolution as a dense one, with zeros off the diagonal."""
    channels = len(kernel.weight)
    weight = kernel.weight.new_zeros(channels, channels, *kernel.weight.shape[2:])
    index = torch.arange(channels)
    weight[index, index] = kernel.weight[:, 0]
    return kernel._replace(weight=weight, groups=1)


def compose_pointwise(first: Kernel, second: Kernel) -> Kernel:
    """Merge a convolution and a 1x1 convolution after it, with nothing between.

    V (W * x + b) + d = (V W) * x + (V b + d). Serves a 1x1 depthwise and its pointwise, the last 1x1 of the spatial
    pyramid and LitePAN's lateral, a smoothing pointwise and the detection convolution.
    """
    if first.groups > 1:
        first = depthwise_as_dense(first)
    matrix = second.weight[:, :, 0, 0]
    return first._replace(
        weight=torch.einsum("om,mihw->oihw", matrix, first.weight),
        bias=matrix @ first.bias + second.bias,
    )


def hierarchical_sum_matrix(first: int, branch: int) -> Tensor:
    """Return the hierarchical feature fusion of the ESP blocks as a matrix on concat(d1, d2, d4, d8, d16).

    concat(d1, d2, d2 + d4, d2 + d4 + d8, d2 + d4 + d8 + d16) = T concat(d1, d2, d4, d8, d16), where T is block lower
    triangular: the identity for d1, and identities on and below the diagonal of the other four.

    Returns:
        (first + 4 branch, first + 4 branch) float64.
    """
    lower = torch.kron(torch.ones(4, 4, dtype=torch.float64).tril(), torch.eye(branch, dtype=torch.float64))
    matrix: Tensor = torch.block_diag(torch.eye(first, dtype=torch.float64), lower)
    return matrix


def join_outputs(*kernels: Kernel) -> Kernel:
    """Merge convolutions of one input and one geometry into one whose outputs are theirs, concatenated."""
    return kernels[0]._replace(
        weight=torch.cat([kernel.weight for kernel in kernels]),
        bias=torch.cat([kernel.bias for kernel in kernels]),
    )


def split_inputs(kernel: Kernel, *channels: int) -> list[Kernel]:
    """Split a convolution of a concatenation: conv(concat(x, y)) = conv_x(x) + conv_y(y).

    Returns:
        One kernel a part; the first keeps the bias.
    """
    parts = kernel.weight.split(channels, 1)
    zero = torch.zeros_like(kernel.bias)
    return [kernel._replace(weight=part, bias=kernel.bias if index == 0 else zero) for index, part in enumerate(parts)]


def pad_inputs(kernel: Kernel, before: int) -> Kernel:
    """Let a convolution ignore ``before`` further channels in front of its own: zero weights."""
    out, _, height, width = kernel.weight.shape
    zeros = kernel.weight.new_zeros(out, before, height, width)
    return kernel._replace(weight=torch.cat((zeros, kernel.weight), 1))


def reverse_inputs(kernel: Kernel) -> Kernel:
    """Let a convolution of RGB take BGR: its input channels in reverse order."""
    return kernel._replace(weight=kernel.weight.flip(1))


def prelu_as_maximum(slopes: Tensor) -> bool:
    """Tell whether PReLU_a(x) = max(x, a x) on every channel, which holds just where a <= 1.

    Some runtimes have fast multiplications and maxima, and a slow PReLU.
    """
    return bool((slopes <= 1).all())


def pool_kernel(channels: int) -> Kernel:
    """Write the 3x3 stride-2 average pool (padding counted) as a dense convolution: 1/9 on the diagonal."""
    weight = torch.eye(channels, dtype=torch.float64).view(channels, channels, 1, 1).repeat(1, 1, 3, 3) / 9
    return Kernel(weight, torch.zeros(channels, dtype=torch.float64), (1, 1, 1, 1), (2, 2))


def merge_pool_into_stem(stem: Kernel, slopes: Tensor) -> tuple[Kernel, Tensor]:
    """Compute level1 and I1, the pooled image, by one convolution.

    Both are 3x3, stride 2, padding 1 on the image, so concat(level1(x), pool(x)) is one convolution with c0 + 3
    outputs; PReLU with slope 1 is the identity on the pooled channels.

    Returns:
        The kernel and its PReLU slopes.
    """
    return join_outputs(stem, pool_kernel(3)), torch.cat((slopes, torch.ones(3, dtype=slopes.dtype)))


def transposed_as_pointwise(weight: Tensor, norm: nn.BatchNorm2d) -> Kernel:
    """Write a 2x2 stride-2 transposed convolution and its batch normalisation as a 1x1 convolution.

    Strides equal the kernel, so outputs do not overlap: pixel (2y + i, 2x + j) is W[:, :, i, j]^T x(y, x). All four
    make a space-to-depth map with blocks (2, 2), on which an activation acts as on the pixels; depth-to-space, where
    the consumer wants pixels, comes after it.

    Args:
        weight: (in, out, 2, 2).
        norm: The normalisation of its outputs.

    Returns:
        A kernel with 4 x out outputs, in the order of space-to-depth maps.
    """
    scale, shift = batch_norm_affine(norm)
    rows = weight.detach().double().permute(2, 3, 1, 0) * scale.view(1, 1, -1, 1)  # (i, j, out, in)
    return Kernel(rows.reshape(-1, len(weight), 1, 1), shift.repeat(4))


def transposed_in_columns(weight: Tensor, columns: int) -> Tensor:
    """Write a 2x2 stride-2 transposed convolution as a 2x1 one of stride (2, 1), from cells to cells twice as wide.

    Pixel c of a cell becomes pixels 2c and 2c + 1 of two cells, one a row.

    Args:
        weight: (in, out, 2, 2).
        columns: Pixels a cell of the input.

    Returns:
        (columns x in, 2 columns x out, 2, 1).
    """
    inputs, out = weight.shape[:2]
    cells = weight.new_zeros(columns, inputs, columns, 2, out, 2)
    for c in range(columns):
        cells[c, :, c] = weight.permute(0, 3, 1, 2)
    return cells.reshape(columns * inputs, columns * 2 * out, 2, 1)


def nest_blocks(kernel: Kernel, outer: Blocks) -> Kernel:
    """Reorder the outputs of a doubling convolution on a space-to-depth map into those of one finer map.

    Where a cell holds rows x columns pixels and each becomes 2 x 2, outputs come as (r, c, i, j, channel), for pixel
    (2r + i, 2c + j) of the cell. A map with blocks twice as large wants (r, i, c, j, channel).

    Args:
        kernel: Its outputs are rows x columns x 2 x 2 x channels.
        outer: Rows and columns of pixels a cell, before doubling.
    """
    return take_outputs(kernel, torch.arange(len(kernel.weight)).view(*outer, 2, 2, -1).permute(0, 2, 1, 3, 4))


def space_to_depth_kernel(kernel: Kernel, source: Blocks, target: Blocks) -> Kernel:
    """Rewrite a convolution for space-to-depth maps.

    Along one axis, output pixel T Y + r (cell Y, block size T, 0 <= r < T) reads input pixels S_c (T Y + r) + D t - p
    for taps t, with stride S_c, dilation D and padding p. For input cells of B pixels, with B dividing S_c T, that is
    pixel (S_c r + D t - p) mod B of cell (S_c T / B) Y + floor((S_c r + D t - p) / B): again a convolution, of stride
    S_c T / B, whose taps are the distinct floors, and whose dilation is what their distances have in common. Zero
    padding stays zero padding. A depthwise convolution stays one where every output pixel reads its own place in the
    cells, as with a dilation that B divides; else it becomes a dense one.

    Args:
        kernel: Dense or depthwise.
        source: Blocks of the input map.
        target: Blocks of the output map.

    Returns:
        A kernel with source x in inputs and target x out outputs.
    """
    if source == (1, 1) == target:
        return kernel
    steps, lows, highs, gaps = [], [], [], []
    own_place = source == target
    for axis in range(2):
        step, remainder = divmod(kernel.stride[axis] * target[axis], source[axis])
        assert remainder == 0
        reads = _reads(kernel, axis, source[axis], target[axis])
        own_place &= all(place == r for r, taps in enumerate(reads) for _, place in taps)
        cells = [cell for taps in reads for cell, _ in taps]
        steps.append(step)
        lows.append(min(cells))
        highs.append(max(cells))
        gaps.append(math.gcd(*(cell - min(cells) for cell in cells)) or 1)
    # The last cell of an axis of n output cells reads up to cell step (n - 1) + high of step n: high - step + 1 beyond.
    beyond = [max(high - step + 1, 0) for high, step in zip(highs, steps, strict=True)]
    geometry = Kernel(
        kernel.weight,
        kernel.bias.repeat(math.prod(target)),
        (-lows[0], -lows[1], beyond[0], beyond[1]),
        (steps[0], steps[1]),
        (gaps[0], gaps[1]),
    )
    if kernel.groups > 1 and own_place:
        weight = kernel.weight.repeat(math.prod(target), 1, 1, 1)
        return geometry._replace(weight=weight, groups=len(weight))
    dense = (depthwise_as_dense(kernel) if kernel.groups > 1 else kernel).weight
    out, inputs, *_ = dense.shape
    taps = [(high - low) // gap + 1 for low, high, gap in zip(lows, highs, gaps, strict=True)]
    weight = dense.new_zeros(*target, out, *source, inputs, *taps)
    for r, rows in enumerate(_reads(kernel, 0, source[0], target[0])):
        for c, columns in enumerate(_reads(kernel, 1, source[1], target[1])):
            for t, (cell_y, y) in enumerate(rows):
                for u, (cell_x, x) in enumerate(columns):
                    tap_y, tap_x = (cell_y - lows[0]) // gaps[0], (cell_x - lows[1]) // gaps[1]
                    weight[r, c, :, y, x, :, tap_y, tap_x] = dense[:, :, t, u]
    return geometry._replace(weight=weight.reshape(math.prod(target) * out, math.prod(source) * inputs, *taps))


def _reads(kernel: Kernel, axis: int, source: int, target: int) -> list[list[tuple[int, int]]]:
    """Return, for each output pixel of a cell and each tap, the input cell (from the output's) and the place in it."""
    return [
        [
            divmod(kernel.stride[axis] * r + kernel.dilation[axis] * t - kernel.padding[axis], source)
            for t in range(kernel.weight.shape[2 + axis])
        ]
        for r in range(target)
    ]


def concatenated_cells(kernel: Kernel, channels: Sequence[int], blocks: Blocks) -> Kernel:
    """Rewrite a convolution of a concatenation for the concatenation of its parts' space-to-depth maps.

    Channels of concatenated cells come by part, then by pixel; those of the cells of a concatenation by pixel first.

    Args:
        kernel: Dense; its inputs are the parts' channels in turn.
        channels: Channels of each part.
        blocks: Blocks of every part and of the output.
    """
    parts = [space_to_depth_kernel(part, blocks, blocks) for part in split_inputs(kernel, *channels)]
    return parts[0]._replace(weight=torch.cat([part.weight for part in parts], 1))


def take_outputs(kernel: Kernel, index: Tensor) -> Kernel:
    """Keep the outputs of a dense convolution that ``index`` names, in its order."""
    index = index.reshape(-1)
    return kernel._replace(weight=kernel.weight[index], bias=kernel.bias[index])


def trim_taps(kernel: Kernel) -> Kernel:
    """Leave out the first and last rows and columns of taps that are all zero, and the padding that only they read.

    Some outputs of a convolution on cells read no further than their own cell: taken alone, they need fewer taps.
    """
    weight, padding = kernel.weight, list(kernel.padding)
    for axis in range(2):
        gap = kernel.dilation[axis]
        taps = weight.shape[2 + axis]
        used = weight.movedim(2 + axis, 0).flatten(1).any(1).nonzero().flatten().tolist() or [0]
        first = min(used[0], padding[axis] // gap)
        last = min(taps - 1 - used[-1], padding[axis + 2] // gap)
        weight = weight.narrow(2 + axis, first, taps - first - last)
        padding[axis] -= first * gap
        padding[axis + 2] -= last * gap
    top, left, bottom, right = padding
    return kernel._replace(weight=weight, padding=(top, left, bottom, right))


def mask_difference(blocks: int, threshold: float) -> Kernel:
    """Return the 1x1 convolution that turns pairs of logits into one decision value a pixel.

    Soft-max over (background, foreground) exceeds t just where foreground - background > log(t / (1 - t)). So the
    weights are +1 and -1, the bias is -log(t / (1 - t)), and the decision is ``> 0``.

    Args:
        blocks: Pixels a cell; the input has 2 channels a pixel.
        threshold: t in [0, 1]; at the ends, where the logarithm has none, as 1e-6 away from them.
    """
    threshold = min(max(threshold, 1e-6), 1 - 1e-6)
    pair = torch.tensor([[-1.0, 1.0]], dtype=torch.float64)
    weight = torch.block_diag(*[pair] * blocks).view(blocks, 2 * blocks, 1, 1)
    return Kernel(weight, torch.full((blocks,), -math.log(threshold / (1 - threshold)), dtype=torch.float64))


def upsample_kernel() -> Kernel:
    """Return bilinear x2 upsampling (half-pixel centres) of one channel as a convolution to a space-to-depth map.

    Along an axis, output pixel 2y is x[y - 1] / 4 + 3 x[y] / 4 and pixel 2y + 1 is 3 x[y] / 4 + x[y + 1] / 4. At a
    border the missing pixel counts as zero instead of repeating its neighbour, which scales the result by 3/4: its
    sign, which is all that a mask keeps, is that of bilinear interpolation.
    """
    row = torch.tensor([[0.25, 0.75, 0.0], [0.0, 0.75, 0.25]], dtype=torch.float64)
    weight = torch.einsum("rt,cu->rctu", row, row).reshape(4, 1, 3, 3)
    return Kernel(weight, torch.zeros(4, dtype=torch.float64), (1, 1, 1, 1))


class AttentionWeights(NamedTuple):
    """PCAA with its linear layers folded, for pixels P of a bin, (R, C) with R pixels; float64.

    Attributes:
        maps: (K, C): class maps, transposed: maps P^T is (K, R). The bias is dropped, see `fold_attention`.
        maps_bias: (K,): only the confidence sees it.
        nodes: (bins, bins): the graph convolution over bins with its residual.
        nodes_slopes: (bins,): its PReLU.
        key: (C, C): local centres to keys, graph linear, key and query in one.
        key_bias: (C,): the query's bias, as one number a class.
        fuse: (bins,): the sum over bins that makes the global centres.
        fuse_bias: Its bias.
        fuse_slope: Slope of its PReLU.
        channels: (C, C): the graph convolution's linear layer, transposed for products from the right.
        value: (C, C): global centres to outputs, value, output convolution and batch normalisation in one.
        value_bias: (C,): likewise.
        out_slopes: (C,): the output's PReLU.
    """

    maps: Tensor
    maps_bias: Tensor
    nodes: Tensor
    nodes_slopes: Tensor
    key: Tensor
    key_bias: Tensor
    fuse: Tensor
    fuse_bias: float
    fuse_slope: float
    channels: Tensor
    value: Tensor
    value_bias: Tensor
    out_slopes: Tensor


def fold_attention(pcaa: PCAA) -> AttentionWeights:
    """Fold the linear layers of PCAA.

    With N the node matrix, G the graph's linear layer, a = PReLU((N + I) L) its activation of the local centres L:

    - Soft-max over pixels does not see a bias a class, so the class maps need it only for the confidence, the sigmoid
      of their mean, and the mean of maps is the maps of the mean pixel.
    - Affinity: (P Wq^T + bq)(a G^T Wk^T + bk)^T = P (Wq^T Wk G) a^T + 1 (bq Wk G) a^T + (terms equal for all classes,
      which soft-max does not see). So keys are a (G^T Wk^T Wq) and a number a class, a (G^T Wk^T bq).
    - Global centres: PReLU(f . (a G^T) + b) = PReLU((f . a) G^T + b): sum over bins first.
    - Values and output: rows of the soft-max A sum to 1, so BN(Wo (A (T Wv^T + bv))) = A (T V^T) + v, with V = s Wo Wv
      and v = s Wo bv + shift.
    """

    def linear(layer: nn.Linear) -> Tensor:
        return layer.weight.detach().double()

    def bias(layer: nn.Linear | nn.Conv2d) -> Tensor:
        assert layer.bias is not None
        return layer.bias.detach().double()

    bins = len(pcaa.graph.nodes.weight)
    nodes = pcaa.graph.nodes.weight.detach().double()[:, :, 0, 0]
    graph = linear(pcaa.graph.channels)
    key = graph.T @ linear(pcaa.key).T
    conv, norm, act = pcaa.out
    assert isinstance(conv, nn.Conv2d)
    assert isinstance(norm, nn.BatchNorm2d)
    assert isinstance(act, nn.PReLU)
    out = fold_batch_norm(conv_kernel(conv), norm)
    matrix = out.weight[:, :, 0, 0]
    return AttentionWeights(
        maps=pcaa.class_maps.weight.detach().double()[:, :, 0, 0],
        maps_bias=bias(pcaa.class_maps),
        nodes=nodes + torch.eye(bins, dtype=torch.float64),
        nodes_slopes=prelu_slopes(pcaa.graph.act, bins),
        key=key @ linear(pcaa.query),
        key_bias=key @ bias(pcaa.query),
        fuse=pcaa.fuse.weight.detach().double().view(bins),
        fuse_bias=float(bias(pcaa.fuse)),
        fuse_slope=float(pcaa.fuse_act.weight.detach()),
        channels=graph.T,
        value=(matrix @ linear(pcaa.value)).T,
        value_bias=matrix @ bias(pcaa.value) + out.bias,
        out_slopes=prelu_slopes(act, len(matrix)),
    )
