"""Distillation: a student learns what a teacher says of the same images (Hinton et al., 2015).

Teacher and student share the outputs' shapes whatever their variants: masks at full resolution, and three anchors a
cell of three levels. The teacher's anchors may differ, so boxes are compared in pixels of the cell.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from trilitenet.config import STRIDES
from trilitenet.errors import ConfigError
from trilitenet.losses.detection import complete_iou
from trilitenet.losses.multitask import Outputs

__all__ = ["DistillationLoss", "DistillationTerms", "distil_boxes", "distil_mask"]


class DistillationTerms(NamedTuple):
    """The terms, weights applied, as 0-dim tensors; 0 for a task that either network lacks."""

    detection: Tensor
    drivable: Tensor
    lane: Tensor


def distil_mask(student: Tensor, teacher: Tensor) -> Tensor:
    """Return the mean cross-entropy of the student's foreground probability against the teacher's.

    Args:
        student: (B, 2, H, W) logits.
        teacher: (B, 2, H, W) logits; no gradient goes there.
    """
    student, teacher = student.float(), teacher.detach().float()
    target = (teacher[:, 1] - teacher[:, 0]).sigmoid()
    return F.binary_cross_entropy_with_logits(student[:, 1] - student[:, 0], target)


def distil_boxes(student: Tensor, teacher: Tensor, student_anchors: Tensor, teacher_anchors: Tensor) -> Tensor:
    """Return the loss of one level: objectness everywhere, boxes and classes as far as the teacher sees an object.

    Args:
        student: (B, A, rows, columns, 5 + classes) logits.
        teacher: Likewise; no gradient goes there.
        student_anchors: (A, 2) width and height in cells.
        teacher_anchors: (A, 2) likewise.
    """
    student, teacher = student.float(), teacher.detach().float()
    confidence = teacher[..., 4].sigmoid()
    objectness = F.binary_cross_entropy_with_logits(student[..., 4], confidence)
    boxes = []
    for logits, anchors in ((student, student_anchors), (teacher, teacher_anchors)):
        centre = 2 * logits[..., :2].sigmoid()
        size = (2 * logits[..., 2:4].sigmoid()).square() * anchors.view(1, -1, 1, 1, 2)
        boxes.append(torch.cat([centre, size], dim=-1).flatten(0, 3))
    weight = confidence.flatten()
    total = weight.sum().clamp(min=1)
    box = ((1 - complete_iou(boxes[0], boxes[1])) * weight).sum() / total
    classes = F.binary_cross_entropy_with_logits(student[..., 5:], teacher[..., 5:].sigmoid(), reduction="none")
    return objectness + 0.05 * box + 0.5 * (classes.mean(dim=-1).flatten() * weight).sum() / total


class DistillationLoss(nn.Module):
    """Weighted sum over the tasks that student and teacher share.

    Args:
        student_anchors: (3, 3, 2) in input pixels; None without detection.
        teacher_anchors: (3, 3, 2) in input pixels; None without detection.
        weights: Of detection, drivable area and lane.
    """

    def __init__(
        self,
        student_anchors: Tensor | None,
        teacher_anchors: Tensor | None,
        weights: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> None:
        super().__init__()
        self.register_buffer("student_anchors", student_anchors, persistent=False)
        self.register_buffer("teacher_anchors", teacher_anchors, persistent=False)
        self.weights = weights

    def forward(self, student: Outputs, teacher: Outputs) -> DistillationTerms:
        """Compute the terms of one batch, in 32-bit floats whatever the autocast.

        Raises:
            ConfigError: If the class counts differ.
        """
        reference = next(t for t in (student.drivable, student.lane, *(student.detection or ())) if t is not None)
        zero = torch.zeros((), device=reference.device)
        with torch.autocast(device_type=reference.device.type, enabled=False):
            detection = zero
            if student.detection is not None and teacher.detection is not None and self.weights[0]:
                if student.detection[0].shape != teacher.detection[0].shape:
                    raise ConfigError(
                        "the teacher of boxes has other classes; set the first weight of distillation to 0"
                    )
                assert isinstance(self.student_anchors, Tensor)
                assert isinstance(self.teacher_anchors, Tensor)
                levels = zip(
                    student.detection,
                    teacher.detection,
                    self.student_anchors,
                    self.teacher_anchors,
                    STRIDES,
                    strict=True,
                )
                detection = torch.stack([distil_boxes(s, t, a / n, b / n) for s, t, a, b, n in levels]).mean()
            masks = [
                zero if s is None or t is None else distil_mask(s, t)
                for s, t in ((student.drivable, teacher.drivable), (student.lane, teacher.lane))
            ]
        return DistillationTerms(
            *(weight * term for weight, term in zip(self.weights, (detection, *masks), strict=True))
        )
