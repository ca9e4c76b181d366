"""The loss of all tasks: L = L_det + 0.3 L_da + 0.3 L_ll (Section III-C)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol, TypeAlias, get_args

import torch
from torch import Tensor, nn

from trilitenet.errors import ConfigError, did_you_mean
from trilitenet.losses.detection import DetectionLoss
from trilitenet.losses.segmentation import IGNORED, SegmentationLoss

__all__ = ["LossTerms", "MultiTaskLoss", "Outputs", "Targets"]

Balancing: TypeAlias = Literal["fixed", "uncertainty"]


class Outputs(Protocol):
    """What the loss reads of a network's outputs; None for a task the network lacks."""

    @property
    def detection(self) -> Sequence[Tensor] | None:
        """Three (B, A, rows, columns, 5 + classes) tensors of logits."""

    @property
    def drivable(self) -> Tensor | None:
        """(B, 2, H, W) logits."""

    @property
    def lane(self) -> Tensor | None:
        """(B, 2, H, W) logits."""


class Targets(Protocol):
    """What the loss reads of a batch; boxes in input pixels."""

    @property
    def boxes(self) -> Tensor:
        """(T, 6): image index, class, centre x, centre y, width, height."""

    @property
    def ignored(self) -> Tensor:
        """(S, 5): image index, centre x, centre y, width, height."""

    @property
    def detection_labelled(self) -> Tensor:
        """(B,) bool: whether the image has detection labels."""

    @property
    def drivable(self) -> Tensor:
        """(B, H, W) uint8: 0 background, 1 drivable, 255 counts for nothing."""

    @property
    def lane(self) -> Tensor:
        """(B, H, W) uint8: 0 background, 1 lane marking, 255 counts for nothing."""


class LossTerms(NamedTuple):
    """The loss and its parts as they enter it (gains and task weights applied), 0-dim tensors; 0 for an absent task.

    The parts sum to ``total`` under fixed weights; under uncertainty weighting the total also holds the logarithms.
    """

    total: Tensor
    box: Tensor
    objectness: Tensor
    classification: Tensor
    drivable_focal: Tensor
    drivable_tversky: Tensor
    lane_focal: Tensor
    lane_tversky: Tensor


class MultiTaskLoss(nn.Module):
    """Weighted sum of the detection loss and the two segmentation losses.

    Args:
        detection: Loss of the boxes; None if the network has no such task.
        drivable: Loss of the drivable mask; left out, the paper's.
        lane: Loss of the lane mask; left out, the paper's.
        weights: Of detection, drivable area and lane.
        balancing: ``"fixed"`` keeps the weights; ``"uncertainty"`` learns a log-variance s a task (Kendall et al.,
            2018): the sum of weight x exp(-s) x loss + s. Only that has parameters, which the optimiser must be given.

    Raises:
        ConfigError: If the balancing is unknown.
    """

    def __init__(
        self,
        detection: DetectionLoss | None,
        drivable: SegmentationLoss | None = None,
        lane: SegmentationLoss | None = None,
        *,
        weights: tuple[float, float, float] = (1.0, 0.3, 0.3),
        balancing: Balancing = "fixed",
    ) -> None:
        super().__init__()
        self.detection = detection
        self.drivable = drivable or SegmentationLoss(0.7, 0.3)
        self.lane = lane or SegmentationLoss(0.9, 0.1)
        self.weights = weights
        if balancing not in get_args(Balancing):
            raise ConfigError(f"unknown balancing {balancing!r}{did_you_mean(balancing, get_args(Balancing))}")
        self.log_variance = nn.Parameter(torch.zeros(3)) if balancing == "uncertainty" else None

    def forward(self, outputs: Outputs, batch: Targets) -> LossTerms:
        """Compute the loss of one batch, in 32-bit floats whatever the autocast."""
        zero = torch.zeros((), device=batch.detection_labelled.device)
        terms = [zero] * 7
        if outputs.detection is not None and self.detection is not None:
            terms[0:3] = self.detection(outputs.detection, batch.boxes, batch.ignored, batch.detection_labelled)
        if outputs.drivable is not None:
            terms[3:5] = self.drivable(outputs.drivable, batch.drivable)
        if outputs.lane is not None:
            terms[5:7] = self.lane(outputs.lane, batch.lane)
        weights: list[float | Tensor] = list(self.weights)
        extra = zero
        if self.log_variance is not None:
            weights = [weight * torch.exp(-s) for weight, s in zip(self.weights, self.log_variance, strict=True)]
            extra = (self.log_variance * self._learning(outputs, batch)).sum()
        task = (0, 0, 0, 1, 1, 2, 2)
        parts = [term * weights[index] for term, index in zip(terms, task, strict=True)]
        total = torch.stack(parts).sum() + extra
        return LossTerms(total, *parts)

    def _learning(self, outputs: Outputs, batch: Targets) -> Tensor:
        """Return (3,) bool: the tasks of a weight above 0 that the batch has a label of; the others learn nothing."""
        missing = torch.zeros((), dtype=torch.bool, device=batch.detection_labelled.device)
        has_boxes = outputs.detection is not None and self.detection is not None
        return torch.stack(
            [
                batch.detection_labelled.any() if has_boxes and self.weights[0] else missing,
                (batch.drivable != IGNORED).any() if outputs.drivable is not None and self.weights[1] else missing,
                (batch.lane != IGNORED).any() if outputs.lane is not None and self.weights[2] else missing,
            ]
        )
