"""Focal and Tversky losses of the two masks (Section III-C, L_da and L_ll).

A target holds 0 for background, 1 for foreground and 255 for pixels that count for nothing: not labelled, or hidden by
the vehicle itself.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from trilitenet.errors import ShapeError

__all__ = ["IGNORED", "SegmentationLoss", "SegmentationTerms"]

IGNORED: Final = 255
"""Value of a mask's pixels that count for nothing."""

EPS: Final = 1e-7
"""Least denominator of the Tversky index."""


class SegmentationTerms(NamedTuple):
    """The two terms of L_da or L_ll as 0-dim tensors; their sum is the loss."""

    focal: Tensor
    tversky: Tensor


class SegmentationLoss(nn.Module):
    """L = focal + Tversky of one mask.

    The focal loss (Lin et al., 2017) is binary, with logits, for each of the two channels, summed: FL = -alpha_t
    (1 - p_t)^gamma log p_t, averaged over the pixels that count; alpha_t is ``focal_alpha`` where the channel is the
    truth and 1 - ``focal_alpha`` elsewhere.

    The focal Tversky loss (Salehi et al., 2017) takes the whole batch as one region. With the soft-max over the
    channels, T = TP / (TP + alpha FP + beta FN) for each class; the mean over both classes of 1 - T (0 for a class
    without a pixel) is raised to ``tversky_gamma``.

    Args:
        alpha: Tversky's weight of false positives (0.7 for the drivable area, 0.9 for lanes).
        beta: Tversky's weight of false negatives (0.3, 0.1).
        focal_alpha: Weight of the truth, in [0, 1].
        focal_gamma: How much easy pixels count less.
        tversky_gamma: Exponent of the mean, at least 1.
    """

    def __init__(
        self,
        alpha: float,
        beta: float,
        *,
        focal_alpha: float = 0.25,
        focal_gamma: float = 2.0,
        tversky_gamma: float = 4 / 3,
    ) -> None:
        super().__init__()
        self.alpha = alpha
        self.beta = beta
        self.focal_alpha = focal_alpha
        self.focal_gamma = focal_gamma
        self.tversky_gamma = tversky_gamma

    def forward(self, logits: Tensor, target: Tensor) -> SegmentationTerms:
        """Compute both terms of (B, 2, H, W) logits against a (B, H, W) target of 0, 1 and 255, in 32-bit floats.

        Raises:
            ShapeError: If the shapes do not fit.
        """
        if logits.ndim != 4 or logits.shape[1] != 2 or target.shape != logits[:, 0].shape:
            raise ShapeError(
                "logits must be (B, 2, H, W) and the target (B, H, W), "
                f"got {tuple(logits.shape)} and {tuple(target.shape)}"
            )
        with torch.autocast(device_type=logits.device.type, enabled=False):
            sum_up: Any = _Sums.apply
            sums: Tensor = sum_up(logits, target, self.focal_alpha, self.focal_gamma)
            focal_sum, hit, wrong, foreground, background = sums.unbind()
            focal = focal_sum / (foreground + background).clamp(min=1)
            # Two channels that sum to 1: what is wrong in one class is missed in the other.
            of_foreground = self._index(hit, wrong, foreground - hit)
            of_background = self._index(background - wrong, foreground - hit, wrong)
            losses = (1 - of_foreground) * (foreground > 0) + (1 - of_background) * (background > 0)
            return SegmentationTerms(focal, (losses / 2).clamp(min=0).pow(self.tversky_gamma))

    def _index(self, hit: Tensor, wrong: Tensor, missed: Tensor) -> Tensor:
        return hit / (hit + self.alpha * wrong + self.beta * missed).clamp(min=EPS)


class _Sums(torch.autograd.Function):
    """The five sums over pixels that both losses are made of, with their gradient in closed form.

    (5,): the focal loss, the soft foreground on foreground pixels, the soft foreground on background pixels, and the
    number of foreground and background pixels. On a CPU the images are taken one at a time, in place, so that they stay
    in the cache.
    """

    @staticmethod
    def forward(ctx: Any, logits: Tensor, target: Tensor, alpha: float, gamma: float) -> Tensor:
        dtype = torch.promote_types(logits.dtype, torch.float32)
        sums = torch.zeros(5, dtype=dtype, device=logits.device)
        # Gradients by the logits: of the focal sum, and of the soft foreground by the difference of the logits.
        of_focal = torch.empty_like(logits)
        of_soft = torch.empty_like(target, dtype=logits.dtype)
        for part in _parts(target):
            labels = target[part]
            foreground = (labels == 1).to(dtype)
            weight = (labels != IGNORED).to(dtype)
            sign = 2 * foreground - 1
            background, first = (logits[part, channel].to(dtype, copy=True) for channel in (0, 1))
            soft = (first - background).sigmoid_()
            soft_sum = (soft * weight).sum()
            sums[1] += (on_foreground := (soft * foreground).sum())
            sums[2] += soft_sum - on_foreground
            sums[3] += (pixels := foreground.sum())
            sums[4] += weight.sum() - pixels
            of_soft[part] = soft.addcmul_(soft, soft, value=-1)
            # The background's truth is the opposite of the foreground's: so are its sign and its balance.
            for channel, x in enumerate((background.mul_(sign).neg_(), first.mul_(sign))):
                on, off = (alpha, 1 - alpha) if channel else (1 - alpha, alpha)
                log_p = F.logsigmoid(x)
                p = torch.exp(log_p, out=x)
                miss = 1 - p
                factor = miss.pow(gamma).mul_((foreground * (on - off)).add_(off).mul_(weight))
                sums[0] -= torch.dot(factor.reshape(-1), log_p.reshape(-1))
                slope = p.mul_(log_p).mul_(gamma).sub_(miss).mul_(factor).mul_(sign)
                of_focal[part, channel] = slope if channel else slope.neg_()
        ctx.save_for_backward(of_focal, of_soft, target)
        return sums

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
        of_focal, of_soft, target = ctx.saved_tensors
        focal, hit, wrong = grad[:3].to(of_focal.dtype).unbind()
        result = torch.empty_like(of_focal)
        for part in _parts(target):
            labels = target[part]
            weight = (labels != IGNORED).to(result.dtype).mul_(wrong)
            soft = (labels == 1).to(result.dtype).mul_(hit - wrong).add_(weight).mul_(of_soft[part])
            for channel in (0, 1):
                slope = of_focal[part, channel] * focal
                result[part, channel] = slope.add_(soft, alpha=1 if channel else -1)
        return result, None, None, None


def _parts(target: Tensor) -> list[slice]:
    """Cut (B, H, W) into what is worked on at once: an image on a CPU, everything elsewhere."""
    if target.device.type != "cpu":
        return [slice(None)]
    return [slice(image, image + 1) for image in range(len(target))]
