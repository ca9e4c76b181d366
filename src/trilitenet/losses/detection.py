"""Detection loss: anchor matching, complete IoU, objectness and class terms (Section III-C, Equation for L_det).

The paper names the terms and their weights; matching, the objectness target and the weights a level are those of the
published code. Everything is vectorised over targets, with shapes that depend on the number of targets alone, so that
nothing waits for what the device computes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from trilitenet.config import STRIDES
from trilitenet.errors import ConfigError, ShapeError

__all__ = ["DetectionLoss", "DetectionTerms", "Matches", "complete_iou", "ignored_cells", "match"]

NEIGHBOURS = 3
"""Cells a target may be matched to on a level: its own, and the nearest beside it horizontally and vertically."""


class DetectionTerms(NamedTuple):
    """The three terms of L_det, gains applied, as 0-dim tensors; their sum is L_det."""

    box: Tensor
    objectness: Tensor
    classification: Tensor


class Matches(NamedTuple):
    """Candidate (target, anchor, cell) triples of one level; M = targets x anchors x 3, hopeless ones included.

    Attributes:
        valid: (M,) bool: whether the triple is a match.
        image: (M,) int64 index of the image in the batch.
        anchor: (M,) int64 index of the anchor.
        row: (M,) int64 row of the cell, clamped into the grid.
        column: (M,) int64 column of the cell, clamped into the grid.
        box: (M, 4) target as offset of its centre from the cell's corner and width, height, in cells.
        class_id: (M,) int64 class of the target.
    """

    valid: Tensor
    image: Tensor
    anchor: Tensor
    row: Tensor
    column: Tensor
    box: Tensor
    class_id: Tensor


def match(boxes: Tensor, anchors: Tensor, grid: tuple[int, int], ratio_limit: float = 4.0) -> Matches:
    """Match targets to anchors and cells of one level.

    An anchor takes a target when the larger of the width and height ratios between the two, either way round, is
    under ``ratio_limit``. Each such target goes to the cell of its centre and to the nearest neighbour on either
    axis (left or right, above or below, by the half of the cell the centre lies in), where that is inside the grid.

    Args:
        boxes: (T, 6): image index, class, centre x, centre y, width, height, the last four in cells of this level.
        anchors: (A, 2) width, height in cells.
        grid: Rows and columns of the level.
        ratio_limit: Limit of the side ratio, above 1.
    """
    targets, count = boxes.shape[0], anchors.shape[0]
    centre, size = boxes[:, 2:4], boxes[:, 4:6]
    ratio = size[:, None] / anchors[None]
    fits = torch.maximum(ratio, 1.0 / ratio).amax(dim=2) < ratio_limit  # (T, A)

    cell = _inside(centre.floor().long(), grid)
    fraction = centre - cell
    step = (fraction > 0.5).long() - (fraction < 0.5).long()  # towards the nearer side; 0 on the middle line
    zero = torch.zeros_like(step[:, 0])
    offset = torch.stack(
        [
            torch.stack([zero, zero], 1),
            torch.stack([step[:, 0], zero], 1),
            torch.stack([zero, step[:, 1]], 1),
        ],
        dim=1,
    )  # (T, 3, 2)
    there = cell[:, None] + offset
    place = _inside(there, grid)
    exists = (there == place).all(dim=2)
    exists[:, 1:] &= step != 0

    shape = (targets, count, NEIGHBOURS)
    own = torch.cat([centre[:, None] - place, size[:, None].expand(-1, NEIGHBOURS, -1)], dim=2)  # (T, 3, 4)
    return Matches(
        valid=(fits[:, :, None] & exists[:, None]).reshape(-1),
        image=boxes[:, 0].long()[:, None, None].expand(shape).reshape(-1),
        anchor=torch.arange(count, device=boxes.device)[None, :, None].expand(shape).reshape(-1),
        row=place[:, None, :, 1].expand(shape).reshape(-1),
        column=place[:, None, :, 0].expand(shape).reshape(-1),
        box=own[:, None].expand(*shape, 4).reshape(-1, 4),
        class_id=boxes[:, 1].long()[:, None, None].expand(shape).reshape(-1),
    )


def _inside(cells: Tensor, grid: tuple[int, int]) -> Tensor:
    """Clamp (..., 2) columns and rows of cells to a grid of so many rows and columns."""
    rows, columns = grid
    return torch.stack([cells[..., 0].clamp(0, columns - 1), cells[..., 1].clamp(0, rows - 1)], dim=-1)


def complete_iou(first: Tensor, second: Tensor) -> Tensor:
    """Return the complete IoU of pairs of boxes (Zheng et al., 2020): IoU - centre distance - aspect ratio term.

    Args:
        first: (N, 4) centre x, centre y, width, height in any one unit.
        second: (N, 4) likewise.

    Returns:
        (N,) values in (-2, 1]; the weight of the aspect ratio term carries no gradient.
    """
    eps = 1e-7  # of denominators
    centre1, size1 = first[:, :2], first[:, 2:]
    centre2, size2 = second[:, :2], second[:, 2:]
    low1, high1 = centre1 - size1 / 2, centre1 + size1 / 2
    low2, high2 = centre2 - size2 / 2, centre2 + size2 / 2
    inter = (torch.minimum(high1, high2) - torch.maximum(low1, low2)).clamp(min=0).prod(dim=1)
    union = size1.prod(dim=1) + size2.prod(dim=1) - inter + eps
    iou = inter / union
    diagonal = (torch.maximum(high1, high2) - torch.minimum(low1, low2)).square().sum(dim=1) + eps
    distance = (centre2 - centre1).square().sum(dim=1) / diagonal
    angle1 = torch.atan(size1[:, 0] / (size1[:, 1] + eps))
    angle2 = torch.atan(size2[:, 0] / (size2[:, 1] + eps))
    aspect = (4 / math.pi**2) * (angle2 - angle1).square()
    with torch.no_grad():
        weight = aspect / ((1 - iou).clamp(min=0) + aspect + eps)  # rounding may take IoU above 1
    return iou - distance - weight * aspect


def ignored_cells(ignored: Tensor, images: int, grid: tuple[int, int], stride: int) -> Tensor:
    """Return which cells of a level say nothing about objectness because of ignored boxes.

    A cell is ignored when its centre lies in an ignored box taken as at least two cells wide and high: so much that
    every cell the box would be matched to, were it an object, is among them. The rule holds for all anchors of the
    cell, depends on no prediction, and gives way to a match.

    Args:
        ignored: (S, 5): image index, centre x, centre y, width, height in input pixels.
        images: Number of images in the batch.
        grid: Rows and columns of the level.
        stride: Input pixels a cell.

    Returns:
        (images, rows, columns) bool.
    """
    rows, columns = grid
    half = (ignored[:, 3:5] / (2 * stride)).clamp(min=1.0)
    centre = ignored[:, 1:3] / stride
    x = torch.arange(columns, device=ignored.device) + 0.5
    y = torch.arange(rows, device=ignored.device) + 0.5
    in_x = (x[None] - centre[:, :1]).abs() <= half[:, :1]  # (S, columns)
    in_y = (y[None] - centre[:, 1:]).abs() <= half[:, 1:]  # (S, rows)
    inside = (in_y[:, :, None] & in_x[:, None, :]).float()
    hits = torch.zeros(images, rows, columns, device=ignored.device)
    return hits.index_add_(0, ignored[:, 0].long(), inside) > 0


_BALANCE: Final = (4.0, 1.0, 0.4)
"""Weight of the objectness of 1/8, 1/16 and 1/32."""
_SINGLE_CLASS_SHARE: Final = 1 / 80
"""Of the class term's gain where there is one class (YOLOv5 scales the gain by classes / 80)."""


class DetectionLoss(nn.Module):
    """L_det = 0.05 box + 1.0 objectness + 0.5 class, summed over three levels.

    Each level gives: the mean of 1 - CIoU over its matches; the mean of the binary cross-entropy of objectness over
    all cells and anchors that count, with the detached CIoU (clamped at 0) as target where there is a match, times
    4.0, 1.0 or 0.4; the mean binary cross-entropy of the classes over the matches. Cells of images without detection
    labels, and those of `ignored_cells`, do not count. Where several targets are matched to one anchor of one cell,
    the objectness target is the largest of their CIoUs (the published code keeps whichever is written last).

    Args:
        anchors: (3, 3, 2) width, height in input pixels, a level a row.
        classes: Number of classes.
        gains: Of the box, objectness and class terms.
        ratio_limit: See `match`.
        single_class_loss: Train the class score also when there is one class (the published code does not, which
            leaves it as it was initialised). All its targets are 1, which says nothing of the image, so the term has
            1/80 of its weight then: at full weight it takes from the objectness (docs/training.md).
        label_smoothing: Class targets are 1 - s/2 and s/2, s in [0, 1).
    """

    anchors: Tensor

    def __init__(
        self,
        anchors: Tensor,
        classes: int,
        *,
        gains: tuple[float, float, float] = (0.05, 1.0, 0.5),
        ratio_limit: float = 4.0,
        single_class_loss: bool = True,
        label_smoothing: float = 0.0,
    ) -> None:
        super().__init__()
        if anchors.ndim != 3 or anchors.shape[0] != len(STRIDES) or anchors.shape[2] != 2:
            raise ShapeError(f"anchors must be ({len(STRIDES)}, A, 2), got {tuple(anchors.shape)}")
        if not 0.0 <= label_smoothing < 1.0:
            raise ConfigError(f"label_smoothing must be in [0, 1), got {label_smoothing}")
        if ratio_limit <= 1.0:
            raise ConfigError(f"ratio_limit must be above 1, got {ratio_limit}")
        self.register_buffer("anchors", anchors.detach().clone(), persistent=False)
        self.classes = classes
        self.gains = gains
        self.ratio_limit = ratio_limit
        self.single_class_loss = single_class_loss
        self.label_smoothing = label_smoothing

    def forward(self, outputs: Sequence[Tensor], boxes: Tensor, ignored: Tensor, labelled: Tensor) -> DetectionTerms:
        """Compute the terms.

        Args:
            outputs: One (B, A, rows, columns, 5 + classes) tensor of logits a level.
            boxes: (T, 6): image index, class, centre x, centre y, width, height in input pixels.
            ignored: (S, 5): image index, centre x, centre y, width, height in input pixels.
            labelled: (B,) bool: whether the image has detection labels.
        """
        with torch.autocast(device_type=boxes.device.type, enabled=False):
            levels = [
                self._level(
                    index, output if output.dtype is torch.float64 else output.float(), boxes, ignored, labelled
                )
                for index, output in enumerate(outputs)
            ]
        return DetectionTerms(
            *(
                gain * torch.stack(terms).sum()
                for gain, terms in zip(self.gains, zip(*levels, strict=True), strict=True)
            )
        )

    def _level(
        self, index: int, output: Tensor, boxes: Tensor, ignored: Tensor, labelled: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        images, anchors, rows, columns, _ = output.shape
        stride = STRIDES[index]
        sizes = self.anchors[index].to(output.dtype) / stride
        boxes = boxes.to(output.dtype)
        scaled = torch.cat([boxes[:, :2], boxes[:, 2:] / stride], dim=1)
        found = match(scaled, sizes, (rows, columns), self.ratio_limit)
        weight = found.valid.to(output.dtype)
        number = weight.sum().clamp(min=1)

        flat = ((found.image * anchors + found.anchor) * rows + found.row) * columns + found.column
        chosen = output.reshape(-1, output.shape[-1]).index_select(0, flat)  # (M, 5 + classes)
        centre = 2 * chosen[:, 0:2].sigmoid() - 0.5
        size = (2 * chosen[:, 2:4].sigmoid()).square() * sizes[found.anchor]
        overlap = complete_iou(torch.cat([centre, size], dim=1), found.box)
        box = ((1 - overlap) * weight).sum() / number

        with torch.no_grad():
            blank = torch.zeros(images * anchors * rows * columns, dtype=output.dtype, device=output.device)
            target = blank.scatter_reduce(0, flat, overlap.clamp(min=0) * weight, "amax")
            matched = blank.scatter_reduce(0, flat, weight, "amax") > 0
            shape = (images, anchors, rows, columns)
            target, matched = target.view(shape), matched.view(shape)
            skipped = ignored_cells(ignored, images, (rows, columns), stride)
            counts = ((matched | ~skipped[:, None]) & labelled[:, None, None, None]).to(output.dtype)
        entropy = F.binary_cross_entropy_with_logits(output[..., 4], target, reduction="none")
        objectness = _BALANCE[index] * (entropy * counts).sum() / counts.sum().clamp(min=1)

        if self.classes == 1 and not self.single_class_loss:
            return box, objectness, torch.zeros_like(box)
        smooth = self.label_smoothing
        truth = F.one_hot(found.class_id, self.classes).to(output.dtype) * (1 - smooth) + smooth / 2
        entropy = F.binary_cross_entropy_with_logits(chosen[:, 5:], truth, reduction="none")
        classification = (entropy.mean(dim=1) * weight).sum() / number
        return box, objectness, classification * (_SINGLE_CLASS_SHARE if self.classes == 1 else 1.0)
