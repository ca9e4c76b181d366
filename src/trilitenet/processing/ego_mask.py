"""The own car in the picture: what the network is shown in its place, and what it finds there, which is nothing."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilitenet.errors import InputError, ShapeError
from trilitenet.processing.boxes import lie_on_mask
from trilitenet.processing.images import read_image
from trilitenet.processing.letterbox import Letterbox
from trilitenet.structures import Perception

__all__ = ["EgoMask"]

_BLUR: Final = 1 / 60
"""Standard deviation of the blur of mirrored road, in widths of the picture."""
_SHRINK: Final = 4
"""The picture is so many times smaller while it is mirrored and blurred, which the blur hides."""
_SAME_SHAPE: Final = 0.01
"""Width by height of two pictures of one camera differs by no more than this share."""


class EgoMask:
    """Where the pictures of one camera show the own car: its bonnet, its dashboard, a pillar.

    Where the mask reaches the picture's lower edge, the network is shown the road above, mirrored and blurred, since a
    dark surface there costs it drivable area above, and so does a picture that ends there (docs/weights.md). What it
    finds on the mask is dropped: pixels of both masks, and boxes that lie on it by more than half.

    Args:
        mask: A path, the bytes of an image file, a Pillow image, or a (height, width) bool or
            (height, width, 3) uint8 array, of a picture's size, or of the same shape in another size. Bright, above
            half of its brightest value, is the own car.

    Raises:
        InputError: If a file is missing, broken or no image, or the mask marks nothing, or all of the picture.
        ShapeError: If an array is of the wrong shape or type.
    """

    def __init__(self, mask: str | Path | bytes | Image.Image | NDArray[Any]) -> None:
        if isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.ndim == 2:
            own = mask.astype(np.uint8)
        else:
            own = read_image(mask).max(axis=2)
        name = f"{mask}: the" if isinstance(mask, (str, Path)) else "the"
        if not own.any():
            raise InputError(f"{name} ego mask marks nothing; paint the own car white on black")
        # Not all above 0: JPEG leaves nearly black pixels all over a mask.
        self._own = np.asarray(own > own.max() // 2, np.uint8)
        if self._own.all():
            raise InputError(f"{name} ego mask marks all of the picture; paint the own car white on black")
        self._on_source = functools.lru_cache(maxsize=8)(self._fit)
        self._on_canvas = functools.lru_cache(maxsize=8)(self._find_mirrored)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the mask in pixels."""
        height, width = self._own.shape
        return height, width

    def of(self, size: tuple[int, int]) -> NDArray[np.bool_]:
        """Return the mask for a picture of (height, width) pixels: read-only bool, True = own car.

        Raises:
            ShapeError: If the picture is of another shape than the mask.
        """
        own: NDArray[np.bool_] = self._on_source(size)
        return own

    def hide(self, canvas: NDArray[np.uint8], letterbox: Letterbox) -> None:
        """Replace the own car in a letterboxed picture, in place.

        Args:
            canvas: (canvas height, canvas width, 3) uint8.
            letterbox: How the picture lies in it.

        Raises:
            ShapeError: If the picture is of another shape than the mask.
        """
        mirrored = self._on_canvas(letterbox)
        if mirrored is None:
            return
        picture = canvas[letterbox.inside]
        small = cv2.resize(picture, mirrored.size[::-1], interpolation=cv2.INTER_AREA)
        small[mirrored.to] = small[mirrored.of]
        small = cv2.GaussianBlur(small, (0, 0), mirrored.size[1] * _BLUR)
        road = cv2.resize(small, letterbox.resized[::-1], interpolation=cv2.INTER_LINEAR)
        cv2.copyTo(road[mirrored.top :], mirrored.own[mirrored.top :], picture[mirrored.top :])

    def drop(self, perception: Perception) -> Perception:
        """Return a perception without what lies on the own car.

        Raises:
            ShapeError: If it is of another shape than the mask.
        """
        own = self.of(perception.size)
        rest = ~own
        boxes = perception.boxes
        return dataclasses.replace(
            perception,
            boxes=None if boxes is None else boxes.select(~lie_on_mask(boxes.xyxy, own)),
            drivable=None if perception.drivable is None else perception.drivable & rest,
            lane=None if perception.lane is None else perception.lane & rest,
        )

    def _fit(self, size: tuple[int, int]) -> NDArray[np.bool_]:
        height, width = self.size
        if abs(width * size[0] - height * size[1]) > _SAME_SHAPE * height * size[1]:
            raise ShapeError(
                f"the ego mask is of {width}x{height} pixels, the picture of {size[1]}x{size[0]}, which is another "
                "shape; paint one for this camera"
            )
        own = np.asarray(cv2.resize(self._own, size[::-1], interpolation=cv2.INTER_NEAREST), np.bool_)
        own.setflags(write=False)
        return own

    def _find_mirrored(self, letterbox: Letterbox) -> _Mirrored | None:
        """Return which pixels of the picture on the canvas are replaced; None if the mask does not reach its edge."""
        own = letterbox.mask(self.of(letterbox.source), threshold=0)[letterbox.inside]
        first = _first_rows(own)
        height, width = letterbox.resized
        own = np.asarray(np.arange(height)[:, None] >= first, np.uint8)
        if not own.any():
            return None
        size = max(1, height // _SHRINK), max(1, width // _SHRINK)
        # A small pixel that has any of the own car is its, so that nothing of it is left.
        first = _first_rows(cv2.resize(own * np.uint8(255), size[::-1], interpolation=cv2.INTER_AREA))
        rows, columns = (np.arange(size[0])[:, None] >= first).nonzero()
        return _Mirrored(
            size,
            own,
            int(own.any(axis=1).argmax()),
            (rows, columns),
            (np.maximum(2 * first[columns] - 1 - rows, 0), columns),
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Mirrored:
    """What of a picture on the canvas is replaced by what.

    Attributes:
        size: (height, width) of the shrunken picture in which it is mirrored and blurred.
        own: (height, width) uint8 of the picture on the canvas: 1 is replaced.
        top: The first row with any.
        to: Rows and columns of the shrunken picture that are replaced.
        of: Those of what each is replaced by.
    """

    size: tuple[int, int]
    own: NDArray[np.uint8]
    top: int
    to: tuple[NDArray[np.intp], NDArray[np.intp]]
    of: tuple[NDArray[np.intp], NDArray[np.intp]]


def _first_rows(mask: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Return for each column of a (height, width) mask the highest row from which on all below is not 0."""
    return np.asarray(len(mask) - np.cumprod(mask[::-1] > 0, axis=0).sum(axis=0), np.intp)
