"""Multi-scale training: batches brought to another size on the device."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch.nn import functional as F  # noqa: N812

from trilitenet.config import MAX_STRIDE
from trilitenet.data.batches import Batch

__all__ = ["draw_size", "rescale"]

_SCALE_STREAM = 2
"""Random stream of the sizes; order and augmentation have others."""


def draw_size(size: tuple[int, int], factors: tuple[float, float], seed: int, step: int) -> tuple[int, int]:
    """Draw the (height, width) of a step: the input size times a random factor, in multiples of 32.

    Args:
        size: (height, width) in pixels.
        factors: Range of the factor.
        seed: Of the run.
        step: Of the run: with the seed, all that the draw depends on.
    """
    factor = np.random.default_rng([seed, _SCALE_STREAM, step]).uniform(*factors)
    height, width = (max(MAX_STRIDE, round(side * factor / MAX_STRIDE) * MAX_STRIDE) for side in size)
    return height, width


def rescale(batch: Batch, size: tuple[int, int]) -> Batch:
    """Resize the images (bilinear, antialiased), masks (nearest) and boxes of a batch to (height, width) pixels."""
    height, width = batch.images.shape[-2:]
    if (height, width) == size:
        return batch
    images = F.interpolate(batch.images.float(), size, mode="bilinear", align_corners=False, antialias=True)
    # Pixel by pixel at its centre, as the image is; "nearest" would move masks by up to a pixel.
    masks = [F.interpolate(mask[:, None], size, mode="nearest-exact")[:, 0] for mask in (batch.drivable, batch.lane)]
    scale = torch.tensor([size[1] / width, size[0] / height] * 2, device=batch.boxes.device)
    return dataclasses.replace(
        batch,
        images=images.round().to(torch.uint8),
        boxes=torch.cat([batch.boxes[:, :2], batch.boxes[:, 2:] * scale], dim=1),
        ignored=torch.cat([batch.ignored[:, :1], batch.ignored[:, 1:] * scale], dim=1),
        drivable=masks[0],
        lane=masks[1],
    )
