"""A batch: samples of one size as tensors, with 'not labelled' spelled out."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from trilitenet.data.sample import Sample
from trilitenet.errors import ShapeError
from trilitenet.processing.boxes import xyxy_to_cxcywh

__all__ = ["NOT_LABELLED", "Batch", "collate"]

NOT_LABELLED: Final = 255
"""Value of a mask pixel that is not labelled or is ignored."""

_EGO_STRIPS: Final = 20
"""The own car's area is ignored for boxes as this many upright strips."""


@dataclasses.dataclass(frozen=True, eq=False)
class Batch:
    """B samples of H x W pixels.

    Attributes:
        images: (B, 3, H, W) uint8 RGB, not normalised.
        boxes: (T, 6) float32: image index, class id, centre x, centre y, width, height in pixels.
        ignored: (S, 5) float32: image index, centre x, centre y, width, height in pixels: neither object nor
            background.
        detection_labelled: (B,) bool: whether the image's objects are labelled.
        drivable: (B, H, W) uint8: 0 background, 1 drivable, 255 not labelled or ignored.
        lane: (B, H, W) uint8: 0 background, 1 lane marking, 255 not labelled or ignored.
        names: The images' names.
    """

    images: torch.Tensor
    boxes: torch.Tensor
    ignored: torch.Tensor
    detection_labelled: torch.Tensor
    drivable: torch.Tensor
    lane: torch.Tensor
    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)

    def to(self, device: torch.device | str, *, non_blocking: bool = False) -> Batch:
        """Return the batch on another device."""
        return dataclasses.replace(
            self, **{name: getattr(self, name).to(device, non_blocking=non_blocking) for name in _TENSORS}
        )

    def pin_memory(self) -> Batch:
        """Return the batch in page-locked memory (called by PyTorch's data loader)."""
        return dataclasses.replace(self, **{name: getattr(self, name).pin_memory() for name in _TENSORS})


_TENSORS: Final = ("images", "boxes", "ignored", "detection_labelled", "drivable", "lane")


def collate(samples: Sequence[Sample]) -> Batch:
    """Put samples of one size into a batch.

    Raises:
        ShapeError: If there is none, or their sizes differ.
    """
    if not samples:
        raise ShapeError("a batch needs at least one sample")
    height, width = samples[0].size
    for sample in samples:
        if sample.size != (height, width):
            raise ShapeError(f"{sample.name}: {sample.size} in a batch of {(height, width)}; transform to one canvas")
    images = np.empty((len(samples), 3, height, width), np.uint8)
    drivable = np.full((len(samples), height, width), NOT_LABELLED, np.uint8)
    lane = np.full((len(samples), height, width), NOT_LABELLED, np.uint8)
    boxes: list[NDArray[np.float32]] = [np.zeros((0, 6), np.float32)]
    ignored: list[NDArray[np.float32]] = [np.zeros((0, 5), np.float32)]
    for index, sample in enumerate(samples):
        cv2.split(sample.image, list(images[index]))
        for target, mask, counted in (
            (drivable, sample.drivable, sample.counted("drivable")),
            (lane, sample.lane, sample.counted("lane")),
        ):
            if mask is not None:
                target[index] = mask
                if counted is not None:
                    target[index][~counted] = NOT_LABELLED
        if sample.boxes is not None and sample.class_id is not None and len(sample.boxes):
            rows = np.empty((len(sample.boxes), 6), np.float32)
            rows[:, 0], rows[:, 1], rows[:, 2:] = index, sample.class_id, xyxy_to_cxcywh(sample.boxes)
            boxes.append(rows)
        outside = sample.ignored
        if sample.valid is not None:
            outside = np.concatenate([outside, _strips(sample.valid)])
        if len(outside):
            rows = np.empty((len(outside), 5), np.float32)
            rows[:, 0], rows[:, 1:] = index, xyxy_to_cxcywh(outside)
            ignored.append(rows)
    return Batch(
        images=torch.from_numpy(images),
        boxes=torch.from_numpy(np.concatenate(boxes)),
        ignored=torch.from_numpy(np.concatenate(ignored)),
        detection_labelled=torch.tensor([sample.boxes is not None for sample in samples]),
        drivable=torch.from_numpy(drivable),
        lane=torch.from_numpy(lane),
        names=tuple(sample.name for sample in samples),
    )


def _strips(valid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return (K, 4) xyxy px: the invalid area as upright strips, each as high as a part of the area in it."""
    strips: list[tuple[float, float, float, float]] = []
    edges = np.linspace(0, valid.shape[1], _EGO_STRIPS + 1).round().astype(int)
    for left, right in itertools.pairwise(edges):
        rows = np.flatnonzero(~valid[:, left:right].all(axis=1))
        for part in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
            if len(part):
                strips.append((left, part[0], right, part[-1] + 1))
    return np.array(strips, np.float32).reshape(-1, 4)
