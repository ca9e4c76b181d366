"""Fit an image of any size into the network's input and bring results back: the single home of both directions."""

from __future__ import annotations

import dataclasses
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.config import LONG_SIDE, MAX_STRIDE
from trilitenet.errors import ConfigError, ShapeError
from trilitenet.processing.boxes import clip_boxes

__all__ = ["PAD_VALUE", "Letterbox"]

PAD_VALUE: Final = 114
"""Grey level, of 255, of the padding around an image. Masks are padded with 0."""


@dataclasses.dataclass(frozen=True)
class Letterbox:
    """The geometry of one letterboxing: a source image resized, and padded on all sides to a canvas.

    Continuous pixel coordinates map as ``canvas = source * resized / source size + (left, top)``, each axis with its
    own exact ratio, so that `boxes_to_source` is the exact inverse of `boxes`. All sizes are (height, width) in pixels.

    Attributes:
        source: Size of the source image.
        canvas: Size of the network's input.
        resized: Size of the source image inside the canvas.
        top: Rows of padding above.
        left: Columns of padding to the left.
    """

    source: tuple[int, int]
    canvas: tuple[int, int]
    resized: tuple[int, int]
    top: int
    left: int

    @classmethod
    def fit(
        cls,
        source: tuple[int, int],
        *,
        long_side: int = LONG_SIDE,
        stride: int = MAX_STRIDE,
        canvas: tuple[int, int] | None = None,
    ) -> Letterbox:
        """Choose the geometry for a source image (Section IV-A: 1280x720 becomes 640x360 inside 640x384).

        Args:
            source: (height, width) of the image.
            long_side: The longer side of the image becomes this long, unless ``canvas`` is given.
            stride: Each side of the canvas is rounded up to a multiple of this, unless ``canvas`` is given.
            canvas: (height, width) of a fixed canvas; the image is made as large as fits.

        Raises:
            ConfigError: If a size is not positive.
        """
        height, width = source
        if min(height, width, long_side, stride, *(canvas or (1, 1))) < 1:
            raise ConfigError(
                f"sizes must be positive: source {source}, long_side {long_side}, stride {stride}, canvas {canvas}"
            )
        if canvas is None:
            scale = long_side / max(height, width)
            resized = (max(1, round(height * scale)), max(1, round(width * scale)))
            canvas = (-(-resized[0] // stride) * stride, -(-resized[1] // stride) * stride)
        else:
            scale = min(canvas[0] / height, canvas[1] / width)
            resized = (
                min(canvas[0], max(1, round(height * scale))),
                min(canvas[1], max(1, round(width * scale))),
            )
        return cls(
            source=(height, width),
            canvas=canvas,
            resized=resized,
            top=(canvas[0] - resized[0]) // 2,
            left=(canvas[1] - resized[1]) // 2,
        )

    @property
    def inside(self) -> tuple[slice, slice]:
        """Rows and columns of the canvas that the image takes."""
        return slice(self.top, self.top + self.resized[0]), slice(self.left, self.left + self.resized[1])

    @property
    def _scale(self) -> NDArray[np.float64]:
        """Canvas pixels a source pixel along (x, y, x, y)."""
        return np.tile(np.array(self.resized[::-1]) / np.array(self.source[::-1]), 2)

    @property
    def _offset(self) -> NDArray[np.float64]:
        return np.array([self.left, self.top, self.left, self.top], np.float64)

    def image(self, image: NDArray[np.uint8], out: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """Resize and pad an image: area interpolation when it shrinks, bilinear when it grows.

        Args:
            image: (height, width, 3) uint8, of the source size; the order of the channels is kept.
            out: (canvas height, canvas width, 3) uint8 to write into; made if left out.

        Returns:
            (canvas height, canvas width, 3) uint8, ``out`` if it was given.

        Raises:
            ShapeError: If the image or ``out`` is of another size or type.
        """
        if image.shape != (*self.source, 3) or image.dtype != np.uint8:
            raise ShapeError(f"image must be {(*self.source, 3)} uint8, got {image.shape} {image.dtype}")
        if out is None:
            out = np.empty((*self.canvas, 3), np.uint8)
        elif out.shape != (*self.canvas, 3) or out.dtype != np.uint8:
            raise ShapeError(f"out must be {(*self.canvas, 3)} uint8, got {out.shape} {out.dtype}")
        self._fill_border(out, PAD_VALUE)
        out[self.inside] = self._resize(image)
        return out

    def mask(self, mask: NDArray[Any], threshold: int = 1) -> NDArray[np.uint8]:
        """Resize and pad a label mask the published way: area interpolation, then foreground where above a threshold.

        Args:
            mask: (height, width) uint8 in 0 .. 255 (255 = foreground), or bool, of the source size.
            threshold: Values above this, of 255, count as foreground. The published 1 thickens thin lines.

        Returns:
            (canvas height, canvas width) uint8: 1 = foreground, 0 = background and padding.

        Raises:
            ShapeError: If the mask is of another size or type.
        """
        if mask.shape != self.source or mask.dtype not in (np.uint8, np.bool_):
            raise ShapeError(f"mask must be {self.source} uint8 or bool, got {mask.shape} {mask.dtype}")
        values = mask.astype(np.uint8) * np.uint8(255) if mask.dtype == np.bool_ else mask
        out = np.zeros(self.canvas, np.uint8)
        out[self.inside] = self._resize(values) > threshold
        return out

    def boxes(self, xyxy: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Bring boxes from source pixels to canvas pixels.

        Args:
            xyxy: (N, 4) left, top, right, bottom in source pixels.

        Returns:
            (N, 4) float32 in canvas pixels, not clipped.
        """
        return (np.asarray(xyxy, np.float64) * self._scale + self._offset).astype(np.float32)

    def boxes_to_source(self, xyxy: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Bring boxes from canvas pixels back to source pixels: the exact inverse of `boxes`.

        Args:
            xyxy: (N, 4) left, top, right, bottom in canvas pixels.

        Returns:
            (N, 4) float32 in source pixels, clipped to the image.
        """
        source = (np.asarray(xyxy, np.float64) - self._offset) / self._scale
        return clip_boxes(source.astype(np.float32), self.source)

    def mask_to_source(self, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Bring a probability mask from the canvas back to the source: padding cropped, bilinear interpolation.

        Args:
            mask: (canvas height, canvas width) uint8, probability x 255; or of a whole multiple of that size, where a
                backend enlarges masks itself.

        Returns:
            (height, width) uint8 of the source size, probability x 255.

        Raises:
            ShapeError: If the mask is of another size or type.
        """
        inside = self.crop(mask)
        if inside.shape == self.source:
            return np.array(inside)
        return np.asarray(cv2.resize(inside, self.source[::-1], interpolation=cv2.INTER_LINEAR), np.uint8)

    def crop(self, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the part of a mask that the image has inside the canvas, without padding.

        Args:
            mask: As `mask_to_source` takes it.

        Returns:
            A view of it: (height, width) uint8 of the resized size, or of the same multiple of that.

        Raises:
            ShapeError: If the mask is of another size or type.
        """
        scale = mask.shape[0] // self.canvas[0]
        if scale < 1 or mask.shape != (scale * self.canvas[0], scale * self.canvas[1]) or mask.dtype != np.uint8:
            raise ShapeError(f"mask must be {self.canvas} uint8, got {mask.shape} {mask.dtype}")
        rows, columns = (slice(scale * part.start, scale * part.stop) for part in self.inside)
        return mask[rows, columns]

    def _resize(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self.resized == self.source:
            return image
        shrinks = self.resized[0] < self.source[0] or self.resized[1] < self.source[1]
        interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(image, self.resized[::-1], interpolation=interpolation), np.uint8)

    def _fill_border(self, out: NDArray[np.uint8], value: int) -> None:
        rows, columns = self.inside
        out[: rows.start] = value
        out[rows.stop :] = value
        out[rows, : columns.start] = value
        out[rows, columns.stop :] = value
