"""Boxes ranked by confidence, summed under many weightings of the images at once.

Average precision only asks how many wrong boxes come before each right one. Wrong boxes that no IoU threshold can make
right are most of all boxes; they are gathered once into the gaps between the others, an entry an image and gap, and a
weighting of the images then costs a sum over those entries instead of a pass over all boxes a threshold.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilitenet.metrics.arithmetic import FloatArray

__all__ = ["RankedBoxes", "RankedSums"]

_BLOCK: Final = 1_000_000
"""Numbers held at once while summing."""


class RankedSums(NamedTuple):
    """Sums under B weightings, over K boxes that some threshold makes right or ignored.

    Attributes:
        rows: Which of the weightings.
        weight: (B, K) of each of those boxes.
        before: (B, K) weight of always-wrong boxes ranked before it.
        wrong: (B,) weight of all always-wrong boxes.
    """

    rows: slice
    weight: FloatArray
    before: FloatArray
    wrong: FloatArray


class RankedBoxes:
    """Boxes of one class over a data set.

    Args:
        scores: (D,) confidences; of equal ones the earlier box ranks first.
        image: (D,) index of the image.
        right: (D,) bits, one an IoU threshold.
        ignored: (D,) bits, likewise: boxes that count neither way.
        images: Number of images.
        everything: The bits of all thresholds.
    """

    def __init__(
        self,
        scores: NDArray[np.float32],
        image: NDArray[np.int32],
        right: NDArray[np.uint16],
        ignored: NDArray[np.uint16],
        images: int,
        everything: int,
    ) -> None:
        order = np.argsort(-scores, kind="stable")
        image, right, ignored = image[order].astype(np.int64), right[order], ignored[order]
        never = (right == 0) & (ignored == everything)
        image, right, ignored = image[~never], right[~never], ignored[~never]
        special = (right != 0) | (ignored != 0)
        gap = np.cumsum(special)[~special]  # how many special boxes rank before each always-wrong one
        keys, self._count = np.unique(gap * images + image[~special], return_counts=True)
        self._gap, self._gap_image = np.divmod(keys, images)
        self._image = image[special]
        self.right: NDArray[np.uint16] = right[special]
        self.ignored: NDArray[np.uint16] = ignored[special]

    def sums(self, weights: NDArray[Any] | None, images: int) -> Iterator[RankedSums]:
        """Yield sums a block of weightings at a time.

        Args:
            weights: (R, N) how often each image counts; None for once each (R = 1).
            images: N.
        """
        table = np.ones((1, images)) if weights is None else np.asarray(weights)
        rows = max(1, _BLOCK // max(1, len(self._gap) + 4 * len(self._image)))
        starts = np.flatnonzero(np.diff(self._gap, prepend=-1))
        filled = self._gap[starts]
        count = self._count[:, None].astype(np.float32)
        for start in range(0, len(table), rows):
            block = slice(start, min(start + rows, len(table)))
            # Images along the first axis, so that whole rows are copied and added; counts are exact in float32.
            part = np.ascontiguousarray(table[block].T, np.float32)
            gaps = np.zeros((len(self._image) + 1, part.shape[1]))
            if len(starts):
                gaps[filled] = np.add.reduceat(part[self._gap_image] * count, starts, axis=0)
            before = np.cumsum(gaps, axis=0).T
            yield RankedSums(block, part[self._image].T.astype(np.float64), before[:, :-1], before[:, -1])
