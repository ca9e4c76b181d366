"""Batch normalisation, PReLU and pooling for training on a CPU, as fast as channels-last convolutions.

PyTorch's kernels of the first two walk a channels-last tensor of few channels one pixel at a time, which made them half
of a training step. Here an image's rows of W x C values are the unit, with the channels' parameters repeated W times,
so that every step is a plain vectorised operation, on as many rows at a time as stay in the cache. Values and gradients
are the same up to rounding, and in 32-bit floats nearer to exact ones: PyTorch 2.13's channels-last normalisation loses
digits in its sums over many pixels.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

__all__ = ["AveragePool", "PReLU", "batch_norm_prelu"]

_jit: Any = torch.jit

NARROW = 4
"""Up to so many channels, `batch_norm_prelu` normalises bf16 by rows too; 32-bit floats always, for exactness."""

BLOCK = 2**18
"""Values worked on at once: a few such blocks fit a core's second-level cache or its share of the third."""


class AveragePool(nn.AvgPool2d):
    """Mean over windows, zeros of the padding counted: (B, C, H, W) -> (B, C, H', W').

    Training on a CPU takes a depthwise convolution, six times as fast on channels-last images of three channels.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Apply the pooling."""
        if self.training and _by_rows(x):
            size = int(self.kernel_size)  # type: ignore[arg-type]
            mean = torch.full((x.shape[1], 1, size, size), 1 / size**2, dtype=x.dtype)
            return F.conv2d(x, mean, None, self.stride, self.padding, 1, x.shape[1])
        return super().forward(x)


class PReLU(nn.PReLU):
    """PReLU with one slope a channel: x where x > 0, else slope x. (B, C, ...) -> (B, C, ...)."""

    def forward(self, x: Tensor) -> Tensor:
        """Apply the activation."""
        if self.num_parameters == x.shape[1] and _by_rows(x):
            apply: Any = _RowPReLU.apply
            out: Tensor = apply(x, self.weight)
            return out
        return super().forward(x)


def batch_norm_prelu(bn: nn.Module, act: nn.Module, x: Tensor) -> Tensor:
    """Return ``act(bn(x))``: (B, C, H, W) -> (B, C, H, W), whatever the two are."""
    worthwhile = x.dtype.itemsize >= 4 or x.shape[1] <= NARROW
    if (
        type(bn) is nn.BatchNorm2d
        and isinstance(act, nn.PReLU)
        and act.num_parameters == x.shape[1]
        and bn.training
        and bn.affine
        and bn.num_batches_tracked is not None
        and bn.momentum is not None
        and worthwhile
        and _by_rows(x)
        and not (_has_hooks(bn) or _has_hooks(act))
    ):
        bn.num_batches_tracked.add_(1)
        apply: Any = _RowBatchNormPReLU.apply
        out: Tensor = apply(x, bn.weight, bn.bias, act.weight, bn.running_mean, bn.running_var, bn.momentum, bn.eps)
        return out
    activated: Tensor = act(bn(x))
    return activated


def _has_hooks(module: nn.Module) -> bool:
    return bool(
        module._forward_hooks or module._forward_pre_hooks or module._backward_hooks or module._backward_pre_hooks
    )


def _by_rows(x: Tensor) -> bool:
    """Return whether the row-wise way applies: training on a CPU, channels-last, under no transform of torch.func."""
    return (
        x.device.type == "cpu"
        and x.ndim == 4
        and torch.is_grad_enabled()
        and not _jit.is_tracing()
        and not torch.compiler.is_compiling()
        and not torch._C._are_functorch_transforms_active()
        and x.is_contiguous(memory_format=torch.channels_last)
    )


def _rows(x: Tensor) -> Tensor:
    """Return (B, C, H, W) as (B H, W C), without a copy if it is channels-last."""
    batch, channels, height, width = x.shape
    return x.permute(0, 2, 3, 1).reshape(batch * height, width * channels)


def _image(rows: Tensor, shape: torch.Size) -> Tensor:
    """Invert `_rows`."""
    batch, channels, height, width = shape
    return rows.view(batch, height, width, channels).permute(0, 3, 1, 2)


def _blocks(rows: Tensor) -> list[slice]:
    """Cut (R, W C) into runs of rows of about `BLOCK` values."""
    count = max(1, BLOCK // rows.shape[1])
    return [slice(first, first + count) for first in range(0, rows.shape[0], count)]


def _full(x: Tensor) -> torch.dtype:
    """Return the type to sum in: 32-bit floats at least."""
    return torch.promote_types(x.dtype, torch.float32)


def _per_channel(sums: Tensor, channels: int) -> Tensor:
    """Add up (W C,) to (C,)."""
    return sums.view(-1, channels).sum(0)


def _room(rows: Tensor, count: int) -> list[Tensor]:
    """Return ``count`` tensors for a block each, which stay in the cache as no new ones do."""
    size = max((len(rows[block]) for block in _blocks(rows)), default=0)
    return list(torch.empty(count, size, rows.shape[1], dtype=_full(rows)))


def _moments(rows: Tensor, channels: int, spare: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean and the variance (C,) of (R, W C): those of the blocks, joined (Chan et al., 1979)."""
    mean, squares = torch.zeros(2, channels, dtype=spare.dtype)
    before = 0
    for block in _blocks(rows):
        part = rows[block]
        count = part.numel() // channels
        own = _per_channel(part.sum(0, dtype=spare.dtype), channels) / count
        apart = torch.sub(part, own.repeat(part.shape[1] // channels), out=spare[: len(part)])
        step = own - mean
        mean = mean + step * (count / (before + count))
        squares = squares + _per_channel(apart.square_().sum(0), channels)
        squares = squares + step.square() * (before * count / (before + count))
        before += count
    return mean, squares / before


def _slope_gradients(grad: Tensor, z: Tensor, slope: Tensor, out: Tensor, spare: Tensor) -> Tensor:
    """Write the gradient of PReLU's input (R, W C) to ``out``; return that of its slope, summed over rows, (W C,)."""
    torch.ops.aten.threshold_backward.grad_input(grad, z, 0, grad_input=out)  # the gradient where z > 0, else 0
    negative = torch.sub(grad, out, out=spare[: len(grad)])
    torch.addcmul(out, negative, slope, out=out)
    return negative.mul_(z).sum(0)


class _RowPReLU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, slope: Tensor) -> Tensor:
        ctx.save_for_backward(x, slope)
        tiled = slope.to(x.dtype).repeat(x.shape[3])
        return _image(torch._prelu_kernel(_rows(x), tiled), x.shape)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        x, slope = ctx.saved_tensors
        tiled = slope.to(x.dtype).repeat(x.shape[3])
        rows, of_out = _rows(x), _rows(grad)
        of_x = torch.empty_like(rows)
        of_slope = torch.zeros(rows.shape[1], dtype=_full(x))
        (spare,) = _room(rows, 1)
        for block in _blocks(rows):
            of_slope += _slope_gradients(of_out[block], rows[block], tiled, of_x[block], spare)
        return _image(of_x, x.shape), _per_channel(of_slope, x.shape[1]).to(slope.dtype)


class _RowBatchNormPReLU(torch.autograd.Function):
    """Keeps its input alone for the gradient: what it normalised is cheaper to compute again than to read back."""

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        weight: Tensor,
        bias: Tensor,
        slope: Tensor,
        running_mean: Tensor,
        running_var: Tensor,
        momentum: float,
        eps: float,
    ) -> Tensor:
        channels, width = x.shape[1], x.shape[3]
        count = x.numel() // channels
        rows = _rows(x)
        (spare,) = _room(rows, 1)
        mean, variance = _moments(rows, channels, spare)
        running_mean.lerp_(mean.to(running_mean.dtype), momentum)
        running_var.lerp_((variance * (count / max(count - 1, 1))).to(running_var.dtype), momentum)
        inverse = (variance + eps).rsqrt()
        means, scales, shifts = mean.repeat(width), (weight * inverse).repeat(width), bias.repeat(width)
        slopes = slope.to(mean.dtype).repeat(width)
        out = torch.empty_like(rows)
        for block in _blocks(rows):
            part = rows[block]
            z = torch.sub(part, means, out=spare[: len(part)])
            out[block] = torch._prelu_kernel(torch.addcmul(shifts, z, scales, out=z), slopes)
        ctx.save_for_backward(x, weight, bias, slope, mean, inverse)
        return _image(out, x.shape)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, weight, bias, slope, mean, inverse = ctx.saved_tensors
        channels, width = x.shape[1], x.shape[3]
        count = x.numel() // channels
        rows, of_out = _rows(x), _rows(grad)
        blocks = _blocks(rows)
        scale = weight * inverse
        means, scales, shifts = mean.repeat(width), scale.repeat(width), bias.repeat(width)
        slopes = slope.to(mean.dtype).repeat(width)
        of_z = torch.empty_like(of_out, dtype=mean.dtype)
        sums = torch.zeros(3, rows.shape[1], dtype=mean.dtype)
        *room, spare = _room(rows, 3)
        for block in blocks:
            part = of_z[block]
            centred, z = (each[: len(part)] for each in room)
            torch.addcmul(shifts, torch.sub(rows[block], means, out=centred), scales, out=z)
            sums[0] += _slope_gradients(of_out[block].to(part.dtype), z, slopes, part, spare)
            sums[1] += part.sum(0)
            sums[2] += centred.mul_(part).sum(0)
        of_slope, of_bias, of_weight = (_per_channel(each, channels) for each in sums)
        of_weight = of_weight * inverse
        # d/dx = weight / std (g - mean of g - normalised x * mean of (g * normalised x))
        by_input = (scale * inverse * of_weight / -count).repeat(width)
        constant = (scale * of_bias / -count).repeat(width)
        for block in blocks:
            part = of_z[block]
            others = torch.sub(rows[block], means, out=spare[: len(part)])
            torch.addcmul(torch.addcmul(constant, others, by_input, out=others), part, scales, out=part)
        return (
            _image(of_z.to(x.dtype), x.shape),
            of_weight.to(weight.dtype),
            of_bias.to(weight.dtype),
            of_slope.to(slope.dtype),
            None,
            None,
            None,
            None,
        )
