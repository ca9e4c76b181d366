"""Anchors fitted to a data set by k-means on box width and height, in that order."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import STRIDES, Anchors
from trilitenet.data.reading import SampleSource
from trilitenet.errors import DataError, import_extra
from trilitenet.processing.boxes import best_side_ratio
from trilitenet.processing.letterbox import Letterbox

__all__ = ["AnchorFit", "best_possible_recall", "box_sizes", "fit_anchors"]

PER_LEVEL = 3
"""Anchors a level."""
_MOST_READ = 5000
"""At most so many images are read, drawn at random."""
_RATIO = 4.0
"""An anchor takes boxes whose sides differ from its own by less, see `trilitenet.losses.detection.match`."""
_LEAST = 2.0
"""Boxes with a side under so many pixels are left out."""


@dataclasses.dataclass(frozen=True)
class AnchorFit:
    """Anchors and how well they suit the boxes they were fitted to.

    Attributes:
        anchors: (width, height) in input pixels, three a level, small to large; the old ones if those were no worse.
        changed: Whether they are new.
        boxes: Number of boxes.
        recall_before: Share of boxes that some old anchor takes, in [0, 1].
        recall_after: The same of ``anchors``.
        fit_before: Mean over boxes of the best anchor's worst side ratio, in (0, 1]: 1 = the very size.
        fit_after: The same of ``anchors``.
    """

    anchors: Anchors
    changed: bool
    boxes: int
    recall_before: float
    recall_after: float
    fit_before: float
    fit_after: float

    def summary(self) -> str:
        """Return one line."""
        what = "new anchors" if self.changed else "anchors kept"
        return (
            f"{what} ({self.boxes} boxes): best possible recall {self.recall_before:.4f} -> {self.recall_after:.4f}, "
            f"fit {self.fit_before:.3f} -> {self.fit_after:.3f}"
        )


def box_sizes(
    dataset: SampleSource,
    canvas: tuple[int, int],
    *,
    seed: int = 0,
    swapped: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.float64]:
    """Return (N, 2) width and height of the labelled boxes in pixels of the letterboxed input.

    Args:
        dataset: Where samples come from.
        canvas: (height, width) of the input.
        seed: Of the draw of images.
        swapped: As the published code has it: the width, as a share of the image's, times the height of the resized
            image, and the height times its width.
        progress: Called with how many images are read, and of how many.
    """
    order = np.random.default_rng(seed).permutation(len(dataset))[:_MOST_READ]
    sizes = [np.zeros((0, 2))]
    for done, index in enumerate(order, start=1):
        sample = dataset[int(index)]
        if sample.boxes is not None and len(sample.boxes):
            resized = Letterbox.fit(sample.size, canvas=canvas).resized
            width, height = resized if swapped else resized[::-1]
            scale = np.array([width / sample.size[1], height / sample.size[0]])
            sizes.append((sample.boxes[:, 2:] - sample.boxes[:, :2]) * scale)
        if progress is not None:
            progress(done, len(order))
    return np.concatenate(sizes)


def best_possible_recall(sizes: NDArray[np.float64], anchors: NDArray[np.float64]) -> float:
    """Return the share of boxes that at least one anchor takes.

    Args:
        sizes: (N, 2) width and height.
        anchors: (A, 2) width and height in the same unit.
    """
    return float((best_side_ratio(sizes, anchors) > 1 / _RATIO).mean())


def fit_anchors(sizes: NDArray[np.float64], before: Anchors, *, enough: float = math.inf, seed: int = 0) -> AnchorFit:
    """Fit nine anchors by k-means, and keep the old ones where they suit no worse, or well enough.

    Args:
        sizes: (N, 2) width and height of boxes in input pixels.
        before: Anchors to compare with.
        enough: Keep the old ones when their best possible recall reaches this.
        seed: Of k-means.

    Raises:
        DataError: If there are too few boxes, or boxes of too few sizes.
        MissingExtraError: Without SciPy.
    """
    cluster: Any = import_extra("scipy.cluster.vq", "train")
    count = len(STRIDES) * PER_LEVEL
    sizes = sizes[(sizes >= _LEAST).all(axis=1)]
    different = len(np.unique(sizes, axis=0))
    if different < count:
        raise DataError(
            f"{len(sizes)} boxes of {different} sizes are too few to fit {count} anchors; train with --no-auto-anchor"
        )
    old = np.array(before, np.float64).reshape(-1, 2)
    # Ratios matter, not differences: clusters are sought in the logarithm of the sizes.
    centres, _ = cluster.kmeans(np.log(sizes), count, iter=20, seed=np.random.default_rng(seed))
    if len(centres) < count:  # k-means may lose clusters; quantiles of the area fill the gap
        extra = sizes[np.argsort(sizes.prod(axis=1))][np.linspace(0, len(sizes) - 1, count - len(centres)).astype(int)]
        centres = np.concatenate([centres, np.log(extra)])
    new = np.exp(centres)
    new = np.round(new[np.argsort(new.prod(axis=1))], 1)
    scores = [(best_possible_recall(sizes, a), float(best_side_ratio(sizes, a).mean())) for a in (old, new)]
    changed = scores[0][0] < enough and scores[1][1] > scores[0][1] and scores[1][0] >= scores[0][0] - 1e-3
    chosen = new if changed else old
    anchors = tuple(
        tuple((float(width), float(height)) for width, height in level)
        for level in chosen.reshape(len(STRIDES), PER_LEVEL, 2)
    )
    after = scores[1] if changed else scores[0]
    return AnchorFit(anchors, changed, len(sizes), scores[0][0], after[0], scores[0][1], after[1])
