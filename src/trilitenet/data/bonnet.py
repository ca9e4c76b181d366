"""The own car's bonnet or dashboard in view: a surface drawn over the lower part of an image, which is no road.

Few training frames show one, so a network without this takes it for the road that usually is there.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.data.sample import Sample

__all__ = ["bonnet"]

_LEAST_SEEN: Final = 0.4
"""A box of which less than this share of the height is left above the edge becomes an ignored region."""


def bonnet(sample: Sample, rng: np.random.Generator) -> Sample:
    """Cover the lower edge of an image with a bonnet or dashboard.

    Its masks are 0 there. Boxes end at its edge; of one that is hidden for the most part what is left is ignored.

    Args:
        sample: Of any size; it is not changed.
        rng: Draws shape, colour, shading, reflections and texture.

    Returns:
        A sample of the same size.
    """
    edge = _edge(sample.size, rng)
    alpha = np.clip(np.arange(sample.size[0], dtype=np.float32)[:, None] - edge[None] + 0.5, 0, 1)
    first = int(edge.min())  # rows above stay as they are
    image = sample.image.copy()
    soft = cv2.GaussianBlur(alpha[first:], (0, 0), rng.uniform(0.5, 2.0))[..., None]
    surface = _surface(sample.image, edge, rng)[first:]
    image[first:] = np.round(image[first:] * (1 - soft) + surface * soft)
    hidden = alpha > 0.5
    masks = sample.changed(("drivable", "lane"), lambda mask: np.where(hidden, np.uint8(0), mask))
    return dataclasses.replace(sample, image=image, **masks, **_boxes(sample, edge))


def _edge(size: tuple[int, int], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the row at which the surface begins in each column: an arch, tilted, with up to two bumps."""
    height, width = size
    across = np.linspace(0, 1, width)
    top, sag, tilt, middle = rng.uniform([0.66, -0.05, -0.03, 0.3], [0.95, 0.12, 0.03, 0.7])
    rows = top + sag * (2 * (across - middle)) ** 2 + tilt * (across - 0.5)
    for _ in range(int(rng.integers(3))):
        place, reach, rise = rng.uniform([0.0, 0.03, 0.01], [1.0, 0.15, 0.08])
        rows -= rise * np.exp(-(((across - place) / reach) ** 2))
    return np.asarray(np.clip(rows, 0.6, 0.99) * height, np.float32)


def _surface(image: NDArray[np.uint8], edge: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return (H, W, 3) float32: plain colour, mostly dark, in uneven light, at times a mirror of what is above it."""
    height, width = image.shape[:2]
    colour = 255 * rng.beta(1.0, 2.2) * (1 + rng.uniform(-1, 1, 3) * (0.6 if rng.random() < 0.2 else 0.08))
    down, across = rng.uniform(-0.5, 0.5, 2)
    light = 1 + down * np.linspace(-1, 1, height)[:, None] + across * np.linspace(-1, 1, width)[None]
    surface = (light[..., None] * colour).astype(np.float32)
    coarse = rng.normal(0, rng.uniform(0, 15), (6, 10)).astype(np.float32)
    surface += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)[..., None]
    if rng.random() < 0.5:
        small = cv2.resize(image, (max(width // 16, 1), max(height // 16, 1)), interpolation=cv2.INTER_AREA)
        blurred = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
        mirrored = np.clip(np.round(2 * edge[None] - np.arange(height)[:, None]), 0, height - 1).astype(np.int64)
        share = rng.uniform(0.1, 0.6)
        surface += share * (blurred[mirrored, np.arange(width)[None]] - surface)
    surface += rng.normal(0, rng.uniform(0.5, 4.0), (height, width, 1)).astype(np.float32)
    return np.asarray(np.clip(surface, 0, 255), np.float32)


def _boxes(sample: Sample, edge: NDArray[np.float32]) -> dict[str, Any]:
    """Return the boxes, their classes and the ignored regions as they are seen above the edge."""
    if sample.boxes is None or sample.class_id is None or not len(sample.boxes):
        return {}
    boxes = sample.boxes.copy()
    columns = np.clip(boxes[:, [0, 2]].mean(axis=1), 0, len(edge) - 1).astype(np.int64)
    boxes[:, 3] = np.minimum(boxes[:, 3], edge[columns])
    left = (boxes[:, 3] - boxes[:, 1]) / np.maximum(sample.boxes[:, 3] - sample.boxes[:, 1], 1e-6)
    seen, partly = left >= _LEAST_SEEN, (left > 0) & (left < _LEAST_SEEN)
    return {
        "boxes": boxes[seen],
        "class_id": sample.class_id[seen],
        "ignored": np.concatenate([sample.ignored, boxes[partly]]),
    }
