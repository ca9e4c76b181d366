from __future__ import annotations

import math
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from trilitenet.config import DEFAULT_ANCHORS
from trilitenet.errors import ConfigError
from trilitenet.losses.distillation import DistillationLoss, distil_boxes, distil_mask

ANCHORS = torch.tensor(DEFAULT_ANCHORS)


class Outputs(NamedTuple):
    detection: tuple[Tensor, ...] | None
    drivable: Tensor | None
    lane: Tensor | None


def outputs(seed: int, classes: int = 1) -> Outputs:
    generator = torch.Generator().manual_seed(seed)
    detection = tuple(torch.randn(2, 3, 64 // s, 96 // s, 5 + classes, generator=generator) for s in (8, 16, 32))
    masks = [torch.randn(2, 2, 64, 96, generator=generator) for _ in range(2)]
    return Outputs(detection, *masks)


def learn(student: Tensor, loss: object, steps: int = 300) -> Tensor:
    student = student.clone().requires_grad_()
    optimiser = torch.optim.Adam([student], 0.1)
    for _ in range(steps):
        optimiser.zero_grad()
        loss(student).backward()  # type: ignore[operator]
        optimiser.step()
    return student.detach()


def test_the_best_mask_is_the_teachers() -> None:
    teacher, student = outputs(0).lane, outputs(1).lane
    assert teacher is not None
    assert student is not None
    learned = learn(student, lambda x: distil_mask(x, teacher))
    torch.testing.assert_close(learned.softmax(1), teacher.softmax(1), atol=0.01, rtol=0)


def test_the_best_boxes_are_the_teachers_whatever_the_anchors() -> None:
    teacher, student = outputs(0).detection, outputs(1).detection
    assert teacher is not None
    assert student is not None
    sizes = ANCHORS[2] / 32
    learned = learn(student[2], lambda x: distil_boxes(x, teacher[2], sizes * 1.5, sizes), 1500)
    torch.testing.assert_close(learned[..., 4:].sigmoid(), teacher[2][..., 4:].sigmoid(), atol=0.05, rtol=0)
    ours = (2 * learned[..., 2:4].sigmoid()).square() * 1.5
    theirs = (2 * teacher[2][..., 2:4].sigmoid()).square()
    assert float((ours / theirs).log().abs().median()) < 0.1


def test_no_gradient_reaches_the_teacher_and_absent_tasks_are_zero() -> None:
    student, teacher = outputs(0), outputs(1)
    for tensor in (*(student.detection or ()), student.drivable, *(teacher.detection or ()), teacher.drivable):
        assert tensor is not None
        tensor.requires_grad_()
    terms = DistillationLoss(ANCHORS, ANCHORS, (1.0, 2.0, 3.0))(student, teacher._replace(lane=None))
    assert float(terms.lane) == 0.0
    torch.stack(tuple(terms)).sum().backward()
    assert student.drivable is not None
    assert teacher.drivable is not None
    assert student.drivable.grad is not None
    assert teacher.drivable.grad is None


def test_weights_multiply_the_terms() -> None:
    once = DistillationLoss(ANCHORS, ANCHORS)(outputs(0), outputs(1))
    more = DistillationLoss(ANCHORS, ANCHORS, (2.0, 3.0, 4.0))(outputs(0), outputs(1))
    torch.testing.assert_close([2 * once[0], 3 * once[1], 4 * once[2]], list(more))


def test_other_classes_are_refused_unless_boxes_are_left_out() -> None:
    with pytest.raises(ConfigError, match="other classes"):
        DistillationLoss(ANCHORS, ANCHORS)(outputs(0), outputs(1, classes=3))
    assert float(DistillationLoss(ANCHORS, ANCHORS, (0.0, 1.0, 1.0))(outputs(0), outputs(1, classes=3)).detection) == 0


def test_boxes_count_where_the_teacher_sees_an_object() -> None:
    teacher = torch.zeros(1, 1, 1, 2, 6)
    teacher[..., 4] = torch.tensor([20.0, -20.0])  # sure of the first cell, nothing in the second
    anchors = torch.ones(1, 2)
    there, elsewhere = teacher.clone(), teacher.clone()
    there[..., 0, :4] = 3.0
    elsewhere[..., 1, :4] = 3.0
    same, off, wrong = (float(distil_boxes(one, teacher, anchors, anchors)) for one in (teacher, elsewhere, there))
    assert off == pytest.approx(same, abs=1e-6)
    assert wrong > same + 0.01


def test_a_box_of_twice_the_sides_costs_its_missing_overlap() -> None:
    teacher = torch.zeros(1, 1, 1, 1, 6)
    teacher[..., 4] = 20.0
    student = teacher.clone()
    student[..., 2:4] = math.log(math.sqrt(0.5) / (1 - math.sqrt(0.5)))  # (2 sigmoid)^2 = 2
    anchors = torch.ones(1, 2)
    same, twice = (float(distil_boxes(one, teacher, anchors, anchors)) for one in (teacher, student))
    assert twice - same == pytest.approx(0.05 * (1 - 1 / 4), abs=1e-5)
