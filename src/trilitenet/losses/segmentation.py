"""Focal and Tversky losses of the two masks (Section III-C, L_da and L_ll).

A target holds 0 for background, 1 for foreground and 255 for pixels that count for nothing: not labelled, or hidden by
the vehicle itself.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from trilitenet.errors import ShapeError

__all__ = ["IGNORED", "SegmentationLoss", "SegmentationTerms", "focal_loss", "tversky_loss"]

IGNORED = 255
"""Value of a mask's pixels that count for nothing."""


class SegmentationTerms(NamedTuple):
    """The two terms of L_da or L_ll as 0-dim tensors; their sum is the loss."""

    focal: Tensor
    tversky: Tensor


def _check(logits: Tensor, target: Tensor) -> None:
    if logits.ndim != 4 or logits.shape[1] != 2 or target.shape != logits[:, 0].shape:
        raise ShapeError(
            f"logits must be (B, 2, H, W) and the target (B, H, W), got {tuple(logits.shape)} and {tuple(target.shape)}"
        )


def _one_hot(target: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return (B, 2, H, W) one-hot targets (background, foreground) and (B, 1, H, W) weights 0 or 1."""
    weight = (target != IGNORED).to(dtype)[:, None]
    foreground = (target == 1).to(dtype)[:, None]
    return torch.cat([weight - foreground, foreground], dim=1), weight


def _full(logits: Tensor) -> Tensor:
    return logits if logits.dtype is torch.float64 else logits.float()


def focal_loss(logits: Tensor, target: Tensor, alpha: float = 0.25, gamma: float = 2.0) -> Tensor:
    """Return the focal loss (Lin et al., 2017): binary, with logits, for each of the two channels, summed.

    FL = -alpha_t (1 - p_t)^gamma log p_t, averaged over the pixels that count; alpha_t is ``alpha`` where the channel is
    the truth and 1 - ``alpha`` elsewhere.

    Args:
        logits: (B, 2, H, W): background, foreground.
        target: (B, H, W) uint8 of 0, 1 and 255.
        alpha: Weight of the truth, in [0, 1].
        gamma: How much easy pixels count less.

    Raises:
        ShapeError: If the shapes do not fit.
    """
    _check(logits, target)
    with torch.autocast(device_type=logits.device.type, enabled=False):
        logits = _full(logits)
        truth, weight = _one_hot(target, logits.dtype)
        signed = logits * (2 * truth - 1)  # the logit of what is true
        log_p = torch.nn.functional.logsigmoid(signed)
        balance = alpha * truth + (1 - alpha) * (1 - truth)
        loss = -balance * (1 - log_p.exp()).pow(gamma) * log_p
        return (loss * weight).sum() / weight.sum().clamp(min=1)


def tversky_loss(
    logits: Tensor, target: Tensor, alpha: float = 0.7, beta: float = 0.3, gamma: float = 4 / 3, eps: float = 1e-7
) -> Tensor:
    """Return the focal Tversky loss (Salehi et al., 2017): the whole batch is one region.

    With the soft-max over the channels, T = TP / (TP + alpha FP + beta FN) for each class; the mean over both classes of
    1 - T (0 for a class without a pixel) is raised to ``gamma``.

    Args:
        logits: (B, 2, H, W): background, foreground.
        target: (B, H, W) uint8 of 0, 1 and 255.
        alpha: Weight of false positives.
        beta: Weight of false negatives.
        gamma: Exponent of the mean, at least 1.
        eps: Least denominator.

    Raises:
        ShapeError: If the shapes do not fit.
    """
    _check(logits, target)
    with torch.autocast(device_type=logits.device.type, enabled=False):
        logits = _full(logits)
        truth, weight = _one_hot(target, logits.dtype)
        probability = logits.softmax(dim=1) * weight
        hit = (probability * truth).sum(dim=(0, 2, 3))
        wrong = probability.sum(dim=(0, 2, 3)) - hit
        present = truth.sum(dim=(0, 2, 3))
        score = hit / (hit + alpha * wrong + beta * (present - hit)).clamp(min=eps)
        loss = ((1 - score) * (present > 0)).mean()
        return loss.clamp(min=0).pow(gamma)


class SegmentationLoss(nn.Module):
    """L = focal + Tversky of one mask.

    Args:
        alpha: Tversky's weight of false positives (0.7 for the drivable area, 0.9 for lanes).
        beta: Tversky's weight of false negatives (0.3, 0.1).
        focal_alpha: See `focal_loss`.
        focal_gamma: See `focal_loss`.
        tversky_gamma: See `tversky_loss`.
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
        """Compute both terms of (B, 2, H, W) logits against a (B, H, W) target of 0, 1 and 255."""
        return SegmentationTerms(
            focal_loss(logits, target, self.focal_alpha, self.focal_gamma),
            tversky_loss(logits, target, self.alpha, self.beta, self.tversky_gamma),
        )
