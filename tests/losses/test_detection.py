from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from trilitenet.config import DEFAULT_ANCHORS
from trilitenet.errors import ConfigError, ShapeError
from trilitenet.losses.detection import DetectionLoss, complete_iou, ignored_cells, match

STRIDES = (8, 16, 32)
ANCHORS = torch.tensor(DEFAULT_ANCHORS, dtype=torch.float64)
SIZE = (96, 160)


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def cross_entropy(logit: float, target: float) -> float:
    p = sigmoid(logit)
    return -(target * math.log(p) + (1 - target) * math.log(1 - p))


def slow_ciou(a: list[float], b: list[float]) -> float:
    eps = 1e-7
    ax1, ay1, ax2, ay2 = a[0] - a[2] / 2, a[1] - a[3] / 2, a[0] + a[2] / 2, a[1] + a[3] / 2
    bx1, by1, bx2, by2 = b[0] - b[2] / 2, b[1] - b[3] / 2, b[0] + b[2] / 2, b[1] + b[3] / 2
    inter = max(0.0, min(ax2, bx2) - max(ax1, bx1)) * max(0.0, min(ay2, by2) - max(ay1, by1))
    iou = inter / (a[2] * a[3] + b[2] * b[3] - inter + eps)
    c2 = (max(ax2, bx2) - min(ax1, bx1)) ** 2 + (max(ay2, by2) - min(ay1, by1)) ** 2 + eps
    rho2 = (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2
    v = 4 / math.pi**2 * (math.atan(b[2] / (b[3] + eps)) - math.atan(a[2] / (a[3] + eps))) ** 2
    return iou - rho2 / c2 - v * v / (1 + eps - iou + v)


def slow_matches(box: list[float], anchors: list[list[float]], grid: tuple[int, int]) -> list[tuple[int, int, int]]:
    """(anchor, row, column) of a target (centre and size in cells): the published rule with loops."""
    rows, columns = grid
    cx, cy, w, h = box
    found = []
    for index, (aw, ah) in enumerate(anchors):
        if max(w / aw, aw / w, h / ah, ah / h) >= 4.0:
            continue
        row, column = min(int(cy), rows - 1), min(int(cx), columns - 1)
        cells = [(row, column)]
        if cx - column < 0.5 and column > 0:
            cells.append((row, column - 1))
        if cx - column > 0.5 and column < columns - 1:
            cells.append((row, column + 1))
        if cy - row < 0.5 and row > 0:
            cells.append((row - 1, column))
        if cy - row > 0.5 and row < rows - 1:
            cells.append((row + 1, column))
        found += [(index, r, c) for r, c in cells]
    return found


def slow_loss(
    outputs: list[Tensor],
    boxes: Tensor,
    ignored: Tensor,
    labelled: Tensor,
    classes: int,
    single_class_loss: bool = True,
    smooth: float = 0.0,
) -> tuple[float, float, float]:
    """L_det with plain loops over targets and cells in Python floats."""
    totals = [0.0, 0.0, 0.0]
    for level, output in enumerate(outputs):
        stride, balance = STRIDES[level], (4.0, 1.0, 0.4)[level]
        images, count, rows, columns, _ = output.shape
        values = output.tolist()
        anchors = (ANCHORS[level] / stride).tolist()
        targets: dict[tuple[int, int, int, int], float] = {}
        box_loss, class_loss, number = 0.0, 0.0, 0
        for target in boxes.tolist():
            image, label = int(target[0]), int(target[1])
            box = [value / stride for value in target[2:]]
            for anchor, row, column in slow_matches(box, anchors, (rows, columns)):
                p = values[image][anchor][row][column]
                predicted = [2 * sigmoid(p[i]) - 0.5 for i in range(2)]
                predicted += [(2 * sigmoid(p[2 + i])) ** 2 * anchors[anchor][i] for i in range(2)]
                iou = slow_ciou(predicted, [box[0] - column, box[1] - row, box[2], box[3]])
                box_loss += 1 - iou
                key = (image, anchor, row, column)
                targets[key] = max(targets.get(key, 0.0), iou, 0.0)
                for index in range(classes):
                    truth = (1 - smooth if index == label else 0.0) + smooth / 2
                    class_loss += cross_entropy(p[5 + index], truth) / classes
                number += 1
        objectness, cells = 0.0, 0
        for image in range(images):
            if not bool(labelled[image]):
                continue
            for row in range(rows):
                for column in range(columns):
                    hidden = any(
                        int(i) == image
                        and abs(column + 0.5 - cx / stride) <= max(w / stride / 2, 1.0)
                        and abs(row + 0.5 - cy / stride) <= max(h / stride / 2, 1.0)
                        for i, cx, cy, w, h in ignored.tolist()
                    )
                    for anchor in range(count):
                        key = (image, anchor, row, column)
                        if hidden and key not in targets:
                            continue
                        objectness += cross_entropy(values[image][anchor][row][column][4], targets.get(key, 0.0))
                        cells += 1
        totals[0] += box_loss / max(number, 1)
        totals[1] += balance * objectness / max(cells, 1)
        if classes > 1 or single_class_loss:
            totals[2] += class_loss / max(number, 1) / (80 if classes == 1 else 1)
    return 0.05 * totals[0], totals[1], 0.5 * totals[2]


def random_case(seed: int, classes: int, images: int = 3) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    height, width = SIZE
    outputs = [
        torch.randn(images, 3, height // s, width // s, 5 + classes, generator=generator, dtype=torch.float64)
        for s in STRIDES
    ]

    def draw(count: int) -> Tensor:
        image = torch.randint(0, images, (count, 1), generator=generator)  # the last may stay empty
        place = torch.rand(count, 2, generator=generator, dtype=torch.float64) * torch.tensor([width, height])
        size = torch.exp(torch.rand(count, 2, generator=generator, dtype=torch.float64) * 4 + 1)
        return torch.cat([image, place, size], dim=1)

    plain = draw(12)
    label = torch.randint(0, classes, (12, 1), generator=generator)
    boxes = torch.cat([plain[:, :1], label, plain[:, 1:]], dim=1)
    return outputs, boxes, draw(4), torch.ones(images, dtype=torch.bool)


@pytest.mark.parametrize("classes", [1, 2, 10])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_agrees_with_plain_loops(seed: int, classes: int) -> None:
    outputs, boxes, ignored, labelled = random_case(seed, classes)
    terms = DetectionLoss(ANCHORS, classes)(outputs, boxes, ignored, labelled)
    expected = slow_loss(outputs, boxes, ignored, labelled, classes)
    assert [float(term) for term in terms] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("case", ["no boxes", "no ignored", "nothing", "unlabelled image", "crowded"])
def test_agrees_in_odd_cases(case: str) -> None:
    outputs, boxes, ignored, labelled = random_case(5, 2)
    if case in {"no boxes", "nothing"}:
        boxes = boxes[:0]
    if case in {"no ignored", "nothing"}:
        ignored = ignored[:0]
    if case == "unlabelled image":
        boxes, ignored = boxes[boxes[:, 0] != 1], ignored[ignored[:, 0] != 1]
        labelled = torch.tensor([True, False, True])
    if case == "crowded":  # many targets on the same cells and anchors
        boxes = boxes.repeat(3, 1)
        boxes[:, 2:4] = boxes[:, 2:4] * 0.2 + 40
    terms = DetectionLoss(ANCHORS, 2)(outputs, boxes, ignored, labelled)
    expected = slow_loss(outputs, boxes, ignored, labelled, 2)
    assert [float(term) for term in terms] == pytest.approx(expected, rel=1e-6)


def test_published_way_skips_a_single_class() -> None:
    outputs, boxes, ignored, labelled = random_case(0, 1)
    terms = DetectionLoss(ANCHORS, 1, single_class_loss=False)(outputs, boxes, ignored, labelled)
    assert [float(term) for term in terms] == pytest.approx(
        slow_loss(outputs, boxes, ignored, labelled, 1, single_class_loss=False), rel=1e-6
    )
    assert float(terms.classification) == 0.0


def test_label_smoothing_agrees_with_plain_loops() -> None:
    outputs, boxes, ignored, labelled = random_case(1, 10)
    terms = DetectionLoss(ANCHORS, 10, label_smoothing=0.1)(outputs, boxes, ignored, labelled)
    expected = slow_loss(outputs, boxes, ignored, labelled, 10, smooth=0.1)
    assert [float(term) for term in terms] == pytest.approx(expected, rel=1e-6)


def test_matching_by_hand() -> None:
    # Centre (3.3, 5.8): own cell (5, 3), left neighbour (5, 2), lower neighbour (6, 3). Only the first anchor fits.
    found = match(torch.tensor([[0.0, 0.0, 3.3, 5.8, 2.0, 1.0]]), torch.tensor([[1.0, 1.0], [9.0, 1.0]]), (10, 10))
    cells = {
        (int(a), int(r), int(c))
        for v, a, r, c in zip(found.valid, found.anchor, found.row, found.column, strict=True)
        if v
    }
    assert cells == {(0, 5, 3), (0, 5, 2), (0, 6, 3)}
    offsets = found.box[found.valid][:, :2]
    torch.testing.assert_close(offsets, torch.tensor([[0.3, 0.8], [1.3, 0.8], [0.3, -0.2]]))


def test_matching_stays_inside_the_grid() -> None:
    corners = torch.tensor([[0, 0, 0.2, 0.2, 1, 1], [0, 0, 9.9, 9.9, 1, 1], [0, 0, 10.0, 10.0, 1, 1]])
    found = match(corners, torch.ones(1, 2), (10, 10))
    assert found.valid.tolist() == [True, False, False] * 3
    assert found.row[found.valid].tolist() == [0, 9, 9]


def test_matching_ratio_is_strict() -> None:
    boxes = torch.tensor([[0, 0, 5.5, 5.5, 4.0, 1.0], [0, 0, 5.5, 5.5, 3.99, 1.0]])
    assert match(boxes, torch.ones(1, 2), (10, 10)).valid.tolist() == [False] * 3 + [True, False, False]


def test_ignored_cells_hold_every_cell_that_would_match() -> None:
    generator = torch.Generator().manual_seed(0)
    for _ in range(50):
        centre = torch.rand(2, generator=generator) * torch.tensor([160.0, 96.0])
        size = torch.rand(2, generator=generator) * 40 + 2
        row = torch.cat([torch.zeros(1), centre, size])[None]
        for stride in STRIDES:
            grid = (96 // stride, 160 // stride)
            cells = ignored_cells(row, 1, grid, stride)[0]
            scaled = torch.cat([torch.zeros(1, 2), row[:, 1:] / stride], dim=1)
            found = match(scaled, scaled[:, 4:6], grid)
            assert bool(cells[found.row[found.valid], found.column[found.valid]].all())


def test_ignored_box_removes_the_penalty_for_a_confident_cell() -> None:
    outputs = [torch.full((1, 3, SIZE[0] // s, SIZE[1] // s, 6), -8.0) for s in STRIDES]
    outputs[0][0, :, 6, 10, 4] = 8.0
    none, box = torch.zeros(0, 5), torch.tensor([[0.0, 84.0, 52.0, 16.0, 12.0]])
    loss = DetectionLoss(ANCHORS.float(), 1)
    labelled = torch.ones(1, dtype=torch.bool)
    without = loss(outputs, torch.zeros(0, 6), none, labelled).objectness
    with_it = loss(outputs, torch.zeros(0, 6), box, labelled).objectness
    assert float(without) > 20 * float(with_it)
    object_there = loss(outputs, torch.tensor([[0.0, 0.0, 84.0, 52.0, 16.0, 12.0]]), box, labelled)
    assert float(object_there.objectness) > float(with_it)  # a match counts even inside an ignored box


def test_complete_iou_of_equal_boxes_is_one() -> None:
    box = torch.tensor([[3.0, 4.0, 2.0, 5.0]], dtype=torch.float64)
    assert float(complete_iou(box, box)) == pytest.approx(1.0, abs=1e-6)


def test_complete_iou_of_equal_boxes_of_any_size_is_finite() -> None:
    targets = torch.rand(1000, 4, generator=torch.Generator().manual_seed(0)) * 50 + 1
    boxes = targets.clone().requires_grad_()
    overlap = complete_iou(boxes, targets)
    overlap.sum().backward()
    torch.testing.assert_close(overlap, torch.ones(1000), atol=1e-5, rtol=0)
    assert boxes.grad is not None
    assert boxes.grad.isfinite().all()


def test_gradients_are_finite_and_right() -> None:
    outputs, boxes, ignored, labelled = random_case(3, 2, images=2)
    boxes, ignored = boxes[:4].clone(), ignored[:1].clone()
    leaves = [output[:, :, :3, :4].clone().requires_grad_() for output in outputs]
    boxes[:, 2:4] = boxes[:, 2:4] * 0.15
    loss = DetectionLoss(ANCHORS, 2)

    def box_and_class(*levels: Tensor) -> Tensor:
        terms = loss(levels, boxes, ignored, labelled)
        total: Tensor = terms.classification + terms.objectness.detach() * 0
        return total

    assert torch.autograd.gradcheck(box_and_class, leaves, fast_mode=True)
    sum(loss(leaves, boxes, ignored, labelled)).backward()
    assert all(leaf.grad is not None and bool(leaf.grad.isfinite().all()) for leaf in leaves)


def test_computes_in_32_bits_under_autocast() -> None:
    outputs, boxes, ignored, labelled = random_case(3, 1)
    halves = [output.bfloat16() for output in outputs]
    boxes, ignored = boxes.float(), ignored.float()
    loss = DetectionLoss(ANCHORS.float(), 1)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        terms = loss(halves, boxes, ignored, labelled)
    assert all(term.dtype is torch.float32 for term in terms)
    plain = loss([half.float() for half in halves], boxes, ignored, labelled)
    torch.testing.assert_close(terms, plain)


def test_refuses_wrong_settings() -> None:
    with pytest.raises(ShapeError, match="anchors must be"):
        DetectionLoss(ANCHORS[:2], 1)
    with pytest.raises(ConfigError, match="label_smoothing"):
        DetectionLoss(ANCHORS, 1, label_smoothing=1.0)
    with pytest.raises(ConfigError, match="ratio_limit"):
        DetectionLoss(ANCHORS, 1, ratio_limit=0.5)
