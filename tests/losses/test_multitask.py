from __future__ import annotations

import dataclasses
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from trilitenet.config import DEFAULT_ANCHORS
from trilitenet.errors import ConfigError
from trilitenet.losses.detection import DetectionLoss
from trilitenet.losses.multitask import MultiTaskLoss
from trilitenet.losses.segmentation import SegmentationLoss

ANCHORS = torch.tensor(DEFAULT_ANCHORS)


class Outputs(NamedTuple):
    detection: tuple[Tensor, ...] | None
    drivable: Tensor | None
    lane: Tensor | None


@dataclasses.dataclass(frozen=True)
class Batch:
    boxes: Tensor
    ignored: Tensor
    detection_labelled: Tensor
    drivable: Tensor
    lane: Tensor


def case() -> tuple[Outputs, Batch]:
    generator = torch.Generator().manual_seed(0)
    detection = tuple(torch.randn(2, 3, 64 // s, 96 // s, 6, generator=generator) for s in (8, 16, 32))
    # Foreground is rare and mostly overestimated: false positives and false negatives weigh differently.
    lean = torch.tensor([0.0, 1.0]).view(2, 1, 1)
    masks = [torch.randn(2, 2, 64, 96, generator=generator) + lean for _ in range(2)]
    truths = [(torch.rand(2, 64, 96, generator=generator) < 0.1).to(torch.uint8) for _ in range(2)]
    batch = Batch(
        boxes=torch.tensor([[0, 0, 30.0, 20.0, 20.0, 15.0], [1, 0, 60.0, 30.0, 40.0, 35.0]]),
        ignored=torch.zeros(0, 5),
        detection_labelled=torch.ones(2, dtype=torch.bool),
        drivable=truths[0],
        lane=truths[1],
    )
    return Outputs(detection, *masks), batch


def test_is_the_papers_weighted_sum() -> None:
    outputs, batch = case()
    detection = DetectionLoss(ANCHORS, 1)
    assert outputs.detection is not None and outputs.drivable is not None and outputs.lane is not None  # noqa: PT018
    terms = MultiTaskLoss(detection)(outputs, batch)
    expected = (
        sum(detection(outputs.detection, batch.boxes, batch.ignored, batch.detection_labelled))
        + 0.3 * sum(SegmentationLoss(0.7, 0.3)(outputs.drivable, batch.drivable))
        + 0.3 * sum(SegmentationLoss(0.9, 0.1)(outputs.lane, batch.lane))
    )
    torch.testing.assert_close(terms.total, expected)
    torch.testing.assert_close(sum(terms[1:]), terms.total)


@pytest.mark.parametrize("task", ["detection", "drivable", "lane"])
def test_a_task_the_network_lacks_is_zero(task: str) -> None:
    outputs, batch = case()
    full = MultiTaskLoss(DetectionLoss(ANCHORS, 1))(outputs, batch)
    terms = MultiTaskLoss(DetectionLoss(ANCHORS, 1))(outputs._replace(**{task: None}), batch)
    gone = {
        "detection": ("box", "objectness", "classification"),
        "drivable": ("drivable_focal", "drivable_tversky"),
        "lane": ("lane_focal", "lane_tversky"),
    }[task]
    for name in terms._fields[1:]:
        value = getattr(terms, name)
        assert float(value) == 0.0 if name in gone else torch.equal(value, getattr(full, name))


def test_labels_that_are_absent_give_no_gradient() -> None:
    outputs, batch = case()
    batch = dataclasses.replace(
        batch,
        boxes=batch.boxes[:0],
        detection_labelled=torch.zeros(2, dtype=torch.bool),
        lane=torch.full_like(batch.lane, 255),
    )
    assert outputs.detection is not None and outputs.lane is not None  # noqa: PT018
    leaves = [*outputs.detection, outputs.lane]
    for leaf in leaves:
        leaf.requires_grad_()
    MultiTaskLoss(DetectionLoss(ANCHORS, 1))(outputs, batch).total.backward()
    assert all(leaf.grad is not None and float(leaf.grad.abs().sum()) == 0.0 for leaf in leaves)


def test_uncertainty_weighting_starts_as_the_fixed_sum_and_learns() -> None:
    outputs, batch = case()
    fixed = MultiTaskLoss(DetectionLoss(ANCHORS, 1))(outputs, batch)
    loss = MultiTaskLoss(DetectionLoss(ANCHORS, 1), balancing="uncertainty")
    terms = loss(outputs, batch)
    torch.testing.assert_close(terms.total, fixed.total)
    terms.total.backward()
    (parameter,) = loss.parameters()
    expected = 1 - torch.stack([sum(fixed[1:4]), sum(fixed[4:6]), sum(fixed[6:8])])
    torch.testing.assert_close(parameter.grad, expected)
    assert not list(MultiTaskLoss(DetectionLoss(ANCHORS, 1)).parameters())


def test_uncertainty_weighting_takes_an_image_without_any_loss() -> None:
    outputs, batch = case()
    loss = MultiTaskLoss(None, balancing="uncertainty")
    assert loss(outputs._replace(drivable=None, lane=None), batch).total.item() == 0.0


def test_uncertainty_weighting_learns_nothing_of_a_task_without_labels() -> None:
    outputs, batch = case()
    bare = dataclasses.replace(batch, lane=torch.full_like(batch.lane, 255))
    loss = MultiTaskLoss(DetectionLoss(ANCHORS, 1), balancing="uncertainty")
    loss(outputs, bare).total.backward()
    (parameter,) = loss.parameters()
    assert parameter.grad is not None
    assert parameter.grad[2] == 0
    assert (parameter.grad[:2] != 0).all()


def test_uncertainty_weighting_learns_nothing_of_boxes_that_nobody_labelled() -> None:
    outputs, batch = case()
    nobody = torch.zeros(2, dtype=torch.bool)
    bare = dataclasses.replace(batch, boxes=torch.zeros(0, 6), detection_labelled=nobody)
    loss = MultiTaskLoss(DetectionLoss(ANCHORS, 1), balancing="uncertainty")
    loss(outputs, bare).total.backward()
    (parameter,) = loss.parameters()
    assert parameter.grad is not None
    assert parameter.grad[0] == 0
    assert (parameter.grad[1:] != 0).all()


def test_uncertainty_weighting_learns_nothing_of_a_task_without_weight() -> None:
    outputs, batch = case()
    for task in range(3):
        weights = tuple(0.0 if index == task else 1.0 for index in range(3))
        loss = MultiTaskLoss(
            DetectionLoss(ANCHORS, 1), weights=(weights[0], weights[1], weights[2]), balancing="uncertainty"
        )
        loss(outputs, batch).total.backward()
        (parameter,) = loss.parameters()
        assert parameter.grad is not None
        assert (parameter.grad != 0).tolist() == [index != task for index in range(3)]


def test_a_balancing_that_is_none_is_refused() -> None:
    with pytest.raises(ConfigError, match="unknown balancing 'learned'; known: fixed, uncertainty"):
        MultiTaskLoss(None, balancing="learned")  # type: ignore[arg-type]
