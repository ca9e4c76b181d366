"""Batch normalisation and PReLU for training on a CPU, as fast as channels-last convolutions.

PyTorch's kernels of the two walk a channels-last tensor of few channels one pixel at a time, which made them half of a
training step. Here an image's rows of W x C values are the unit, with the channels' parameters repeated W times, so
that every step is a plain vectorised operation. Values and gradients are the same up to rounding, and in 32-bit floats
nearer to exact ones: PyTorch 2.13's channels-last normalisation loses digits in its sums over many pixels.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["PReLU", "batch_norm_prelu"]

_jit: Any = torch.jit

NARROW = 4
"""Up to so many channels, `batch_norm_prelu` normalises bf16 by rows too; 32-bit floats always, for exactness."""


class PReLU(nn.PReLU):
    """PReLU with one slope a channel: x where x > 0, else slope x. (B, C, ...) -> (B, C, ...)."""

    def forward(self, x: Tensor) -> Tensor:
        """Apply the activation."""
        if _by_rows(x):
            apply: Any = _RowPReLU.apply
            out: Tensor = apply(x, self.weight)
            return out
        return super().forward(x)


def batch_norm_prelu(bn: nn.BatchNorm2d, act: nn.PReLU, x: Tensor) -> Tensor:
    """Return ``act(bn(x))``: (B, C, H, W) -> (B, C, H, W)."""
    by_rows = x.dtype.itemsize >= 4 or x.shape[1] <= NARROW
    if bn.training and by_rows and _by_rows(x) and bn.num_batches_tracked is not None:
        bn.num_batches_tracked.add_(1)
        assert bn.momentum is not None
        apply: Any = _RowBatchNormPReLU.apply
        out: Tensor = apply(x, bn.weight, bn.bias, act.weight, bn.running_mean, bn.running_var, bn.momentum, bn.eps)
        return out
    activated: Tensor = act(bn(x))
    return activated


def _by_rows(x: Tensor) -> bool:
    """Return whether the row-wise way applies: training on a CPU, channels-last."""
    return (
        x.device.type == "cpu"
        and x.ndim == 4
        and torch.is_grad_enabled()
        and not _jit.is_tracing()
        and not torch.compiler.is_compiling()
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


def _per_channel(rows: Tensor, channels: int) -> Tensor:
    """Sum (R, W C) to (C,), in 32-bit floats at least."""
    dtype = torch.float64 if rows.dtype is torch.float64 else torch.float32
    return rows.sum(0, dtype=dtype).view(-1, channels).sum(0)


def _slope_gradients(grad: Tensor, z: Tensor, slope: Tensor, channels: int) -> tuple[Tensor, Tensor]:
    """Return the gradients of PReLU's input (R, W C) and slope (C,)."""
    positive = torch.ops.aten.threshold_backward(grad, z, 0)  # the gradient where z > 0, else 0
    negative = grad - positive
    return torch.addcmul(positive, negative, slope), _per_channel(negative * z, channels)


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
        of_x, of_slope = _slope_gradients(_rows(grad), _rows(x), tiled, x.shape[1])
        return _image(of_x, x.shape), of_slope.to(slope.dtype)


class _RowBatchNormPReLU(torch.autograd.Function):
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
        full = torch.promote_types(x.dtype, torch.float32)
        rows = _rows(x).to(full)
        mean = _per_channel(rows, channels) / count
        centred = rows - mean.repeat(width)
        variance = _per_channel(centred.square(), channels) / count
        running_mean.lerp_(mean.to(running_mean.dtype), momentum)
        running_var.lerp_((variance * (count / max(count - 1, 1))).to(running_var.dtype), momentum)
        inverse = (variance + eps).rsqrt()
        z = centred.mul_((weight * inverse).repeat(width)).add_(bias.repeat(width)).to(x.dtype)
        ctx.save_for_backward(x, z, weight, slope, mean, inverse)
        return _image(torch._prelu_kernel(z, slope.to(x.dtype).repeat(width)), x.shape)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        x, z, weight, slope, mean, inverse = ctx.saved_tensors
        channels, width = x.shape[1], x.shape[3]
        count = x.numel() // channels
        of_z, of_slope = _slope_gradients(_rows(grad), z, slope.to(z.dtype).repeat(width), channels)
        of_z = of_z.to(mean.dtype)
        centred = _rows(x).to(mean.dtype) - mean.repeat(width)
        of_bias = _per_channel(of_z, channels)
        of_weight = _per_channel(of_z * centred, channels) * inverse
        # d/dx = weight / std (g - mean of g - normalised x * mean of (g * normalised x))
        scale = weight * inverse
        centred.mul_((scale * inverse * of_weight / -count).repeat(width))
        centred.addcmul_(of_z, scale.repeat(width)).sub_((scale * of_bias / count).repeat(width))
        of_x = _image(centred.to(x.dtype), x.shape)
        return (
            of_x,
            of_weight.to(weight.dtype),
            of_bias.to(weight.dtype),
            of_slope.to(slope.dtype),
            None,
            None,
            None,
            None,
        )
