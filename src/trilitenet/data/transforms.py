"""Transforms of a sample: one draw of random numbers for the image, its boxes and its masks.

The published recipe (letterbox, one affine map, HSV gains, left-right flip) is `TrainTransform` with its defaults;
mosaic, mix-up, weather and other light are there and off.
Every geometric step is one 2x3 matrix from source pixels to canvas pixels, applied to all of them alike; pixel centres
are at integer coordinates in the matrix and boxes are measured from the corner of the first pixel, so a box's edges
are moved by half a pixel before and after.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.config import check_size
from trilitenet.data import photometric
from trilitenet.data.bonnet import bonnet
from trilitenet.data.sample import BOXES, MASKS, VALID, Sample
from trilitenet.errors import ConfigError
from trilitenet.processing.boxes import clip_boxes
from trilitenet.processing.letterbox import PAD_VALUE, Letterbox

__all__ = [
    "Affine",
    "Augmentation",
    "EvalTransform",
    "TrainTransform",
    "Transform",
    "draw_affine",
    "hsv",
    "kept_boxes",
    "mixup",
    "mosaic",
    "shift_hsv",
    "shrink",
    "warp",
]


_PHOTOMETRIC: Final = {
    "night": photometric.night,
    "fog": photometric.fog,
    "rain": photometric.rain,
    "light": photometric.light,
    "blur": photometric.blur,
    "noise": photometric.noise,
}
"""Steps that move nothing, in the order they are applied: what happens outside before what the camera does."""

_JOINS_TRIED: Final = 8
"""So many samples are drawn to find one with labels for the same tasks."""


class Transform(Protocol):
    """A map from a sample to one at canvas size; all its randomness comes from ``rng``."""

    def __call__(
        self, sample: Sample, rng: np.random.Generator, draw: Callable[[np.random.Generator], Sample] | None = None
    ) -> Sample:
        """Return the transformed sample; ``draw`` gives another, untransformed one, for steps that join several."""


@dataclasses.dataclass(frozen=True)
class Augmentation:
    """Strengths of the random steps. The defaults are the published recipe.

    Attributes:
        rotation: Degrees, drawn in +-.
        scale: Factor drawn in 1 +-.
        translation: Fraction of the canvas, drawn in +- about its middle.
        hue: Gain drawn in 1 +-.
        saturation: Gain drawn in 1 +-.
        value: Gain drawn in 1 +-.
        flip: Probability of a left-right flip.
        mask_above: A warped mask pixel (0 to 255) above this is foreground. The published 1 thickens masks by up to a
            pixel; 127 keeps their area.
        light: Probability of another exposure (brightness, contrast, gamma).
        blur: Probability of a Gaussian or motion blur.
        noise: Probability of sensor noise and JPEG blocks.
        rain: Probability of rain.
        fog: Probability of fog.
        night: Probability of darkness.
        bonnet: Probability of the own car's bonnet or dashboard in view.
        mosaic: Probability that four samples share the canvas.
        mixup: Probability that a second sample shines through.
    """

    rotation: float = 10.0
    scale: float = 0.25
    translation: float = 0.1
    hue: float = 0.015
    saturation: float = 0.7
    value: float = 0.4
    flip: float = 0.5
    mask_above: int = 1
    light: float = 0.0
    blur: float = 0.0
    noise: float = 0.0
    rain: float = 0.0
    fog: float = 0.0
    night: float = 0.0
    bonnet: float = 0.0
    mosaic: float = 0.0
    mixup: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.scale < 1:
            raise ConfigError(f"scale must be in [0, 1), got {self.scale}")
        if not 0 <= self.mask_above < 255:
            raise ConfigError(f"mask_above must be in [0, 255), got {self.mask_above}")
        for name in ("rotation", "translation", "hue", "saturation", "value"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"{name} must not be negative or infinite, got {getattr(self, name)}")
        for name in ("flip", *_PHOTOMETRIC, "bonnet", "mosaic", "mixup"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} is a probability, in [0, 1], got {getattr(self, name)}")


@dataclasses.dataclass(frozen=True)
class Affine:
    """One draw of the geometric step.

    Attributes:
        angle: Degrees, counter-clockwise as seen.
        scale: Factor about the canvas centre.
        shift: (x, y) in fractions of the canvas.
        flip: Mirror left and right, last.
    """

    angle: float = 0.0
    scale: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    flip: bool = False

    def matrix(self, box: Letterbox) -> NDArray[np.float64]:
        """Return the 2x3 map from pixels of the resized image (before padding) to canvas pixels."""
        height, width = box.canvas
        centre = ((width - 1) / 2, (height - 1) / 2)
        about = np.eye(3)
        about[:2] = cv2.getRotationMatrix2D(centre, self.angle, self.scale)
        about[0, 2] += self.shift[0] * width
        about[1, 2] += self.shift[1] * height
        pad = np.array([[1.0, 0.0, box.left], [0.0, 1.0, box.top], [0.0, 0.0, 1.0]])
        whole = about @ pad
        if self.flip:
            whole = np.array([[-1.0, 0.0, width - 1], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ whole
        return np.ascontiguousarray(whole[:2])


def draw_affine(rng: np.random.Generator, strength: Augmentation) -> Affine:
    """Draw the geometric step (always the same count of random numbers)."""
    angle, scale, x, y, mirrored = rng.random(5)
    return Affine(
        angle=(2 * angle - 1) * strength.rotation,
        scale=1 + (2 * scale - 1) * strength.scale,
        shift=((2 * x - 1) * strength.translation, (2 * y - 1) * strength.translation),
        flip=bool(mirrored < strength.flip),
    )


def shrink(sample: Sample, canvas: tuple[int, int], mask_above: int = 1) -> Sample:
    """Resize a sample to fit a canvas, without padding: what the training transform does first.

    Args:
        sample: Of any size.
        canvas: (height, width) in pixels.
        mask_above: An area-resized mask pixel (0 to 255) above this is foreground.
    """
    box = Letterbox.fit(sample.size, canvas=canvas)
    height, width = box.resized
    if (height, width) == sample.size:
        return sample
    bare = dataclasses.replace(box, canvas=box.resized, top=0, left=0)
    factor = np.array([width / sample.size[1], height / sample.size[0]] * 2)

    return dataclasses.replace(
        sample,
        image=bare.image(sample.image),
        **sample.changed(BOXES, lambda boxes: (boxes * factor).astype(np.float32)),
        **sample.changed(MASKS, lambda mask: bare.mask(mask.view(np.bool_), mask_above)),
        **sample.changed(VALID, lambda valid: bare.mask(~valid) == 0),
    )


def warp(sample: Sample, affine: Affine, canvas: tuple[int, int], mask_above: int = 1) -> Sample:
    """Letterbox a sample and apply an affine map, in one interpolation after the resize.

    Args:
        sample: Of any size.
        affine: The map on the letterboxed canvas.
        canvas: (height, width) of the result in pixels.
        mask_above: A warped mask pixel (0 to 255) above this is foreground.

    Returns:
        The sample at canvas size; boxes of which too little is left are gone (`kept_boxes`).
    """
    box = Letterbox.fit(sample.size, canvas=canvas)
    matrix = affine.matrix(box)
    masks = {
        **sample.changed(MASKS, lambda mask: _resize_mask(mask, box, mask_above)),
        # What comes from outside the image is not the own car: its mask is warped, and padded with 0.
        **sample.changed(VALID, lambda valid: _resize_mask((~valid).view(np.uint8), box, 1)),
    }
    there = {name: mask for name, mask in masks.items() if mask is not None}
    image, moved = _warp_together(_resize(sample.image, box), there, matrix, canvas)
    whole: dict[str, Any] = {
        name: grey <= 1 if name in VALID else cv2.threshold(grey, mask_above, 1, cv2.THRESH_BINARY)[1]
        for name, grey in moved.items()
    }
    boxes, class_id = sample.boxes, sample.class_id
    if boxes is not None and class_id is not None:
        boxes, keep = _move_boxes(boxes, box, matrix, affine.scale, strict=True)
        class_id = class_id[keep]
    ignored, _ = _move_boxes(sample.ignored, box, matrix, affine.scale, strict=False)
    return dataclasses.replace(
        sample,
        image=image,
        boxes=boxes,
        class_id=class_id,
        ignored=ignored,
        **whole,
    )


def hsv(
    image: NDArray[np.uint8], rng: np.random.Generator, strength: Augmentation, out: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Multiply hue, saturation and value of an RGB image by random gains (always three random numbers).

    ``out`` is where the result goes, as in `shift_hsv`.
    """
    gains = 1 + (2 * rng.random(3) - 1) * (strength.hue, strength.saturation, strength.value)
    if not (strength.hue or strength.saturation or strength.value):
        return image
    return shift_hsv(image, (float(gains[0]), float(gains[1]), float(gains[2])), out)


def shift_hsv(
    image: NDArray[np.uint8], gains: tuple[float, float, float], out: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """Multiply hue, saturation and value of an image by gains.

    Args:
        image: (H, W, 3) uint8 **RGB** (the published code runs this step with red and blue swapped).
        gains: Of hue (wraps round), saturation and value (both clipped).
        out: Where to write, of the image's shape; may be ``image`` itself. Made if left out.

    Returns:
        (H, W, 3) uint8 RGB, ``out`` if it was given.
    """
    levels = np.arange(256, dtype=np.float64)
    table = np.empty((1, 256, 3), np.uint8)
    table[0, :, 0] = (levels * gains[0]) % 180
    table[0, :, 1] = np.clip(levels * gains[1], 0, 255)
    table[0, :, 2] = np.clip(levels * gains[2], 0, 255)
    converted = cv2.cvtColor(image, cv2.COLOR_RGB2HSV, dst=out)
    cv2.LUT(converted, table, dst=converted)
    return cv2.cvtColor(converted, cv2.COLOR_HSV2RGB, dst=converted)  # type: ignore[no-any-return]


def kept_boxes(moved: NDArray[np.float32], clipped: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which boxes to keep after clipping, by the published rule.

    A box goes when what is left of it is under 2 px wide or high, under 10% of its area, or thinner than 20:1.

    Args:
        moved: (N, 4) xyxy px: the boxes at their new size, not clipped.
        clipped: (N, 4) xyxy px: the same clipped to the canvas.

    Returns:
        (N,) bool.
    """
    before = np.maximum(moved[:, 2:] - moved[:, :2], 0)
    after = np.maximum(clipped[:, 2:] - clipped[:, :2], 0)
    ratio = np.maximum(after[:, 0], after[:, 1]) / np.maximum(np.minimum(after[:, 0], after[:, 1]), 1e-9)
    enough = after.prod(axis=1) > 0.1 * before.prod(axis=1)
    kept: NDArray[np.bool_] = (after > 2).all(axis=1) & enough & (ratio < 20)
    return kept


@dataclasses.dataclass(frozen=True)
class EvalTransform:
    """Letterbox alone.

    Attributes:
        canvas: (height, width) of the result in pixels, multiples of 32.
    """

    canvas: tuple[int, int] = (384, 640)

    def __post_init__(self) -> None:
        check_size(self.canvas, "canvas")

    def __call__(
        self,
        sample: Sample,
        rng: np.random.Generator | None = None,
        draw: Callable[[np.random.Generator], Sample] | None = None,
    ) -> Sample:
        """Return the sample at canvas size; all boxes are kept."""
        box = Letterbox.fit(sample.size, canvas=self.canvas)
        return dataclasses.replace(
            sample,
            image=box.image(sample.image),
            **sample.changed(BOXES, box.boxes),
            **sample.changed(MASKS, lambda mask: box.mask(mask.view(np.bool_))),
            # What is outside the image is not the own car, so the padding stays valid.
            **sample.changed(VALID, lambda valid: box.mask(~valid) == 0),
        )


@dataclasses.dataclass(frozen=True)
class TrainTransform:
    """The published augmentation: letterbox, one affine map, HSV gains, flip; and more if asked for.

    Attributes:
        canvas: (height, width) of the result in pixels, multiples of 32.
        strength: How strong each random step is.
    """

    canvas: tuple[int, int] = (384, 640)
    strength: Augmentation = Augmentation()

    def __post_init__(self) -> None:
        check_size(self.canvas, "canvas")

    def __call__(
        self, sample: Sample, rng: np.random.Generator, draw: Callable[[np.random.Generator], Sample] | None = None
    ) -> Sample:
        """Return an augmented sample at canvas size."""
        strength = self.strength
        if draw is not None and strength.mosaic and rng.random() < strength.mosaic:
            moved = self._mosaic(sample, rng, draw)
        else:
            moved = self._warp(sample, rng)
        if draw is not None and strength.mixup and rng.random() < strength.mixup:
            other = _alike(sample, rng, draw)
            if other is not None:
                moved = mixup(moved, self._warp(other, rng), rng)
        image = hsv(moved.image, rng, strength, out=moved.image)  # which nobody else has
        for name, step in _PHOTOMETRIC.items():
            probability = getattr(strength, name)
            if probability and rng.random() < probability:
                image = step(image, rng)
        return dataclasses.replace(moved, image=image)

    def _warp(self, sample: Sample, rng: np.random.Generator) -> Sample:
        if self.strength.bonnet and rng.random() < self.strength.bonnet:
            # At the canvas's size, so that a prepared sample draws the same.
            sample = bonnet(shrink(sample, self.canvas, self.strength.mask_above), rng)
        return warp(sample, draw_affine(rng, self.strength), self.canvas, self.strength.mask_above)

    def _mosaic(
        self, sample: Sample, rng: np.random.Generator, draw: Callable[[np.random.Generator], Sample]
    ) -> Sample:
        others = [_alike(sample, rng, draw) for _ in range(3)]
        tiles = [sample, *(other for other in others if other is not None)]
        moved = [self._warp(tile, rng) for tile in tiles]
        return mosaic(moved, rng) if len(moved) == 4 else moved[0]


def mosaic(tiles: Sequence[Sample], rng: np.random.Generator) -> Sample:
    """Put a part of each of four samples into one canvas, about a random point near its middle.

    Args:
        tiles: Four samples of one size, labelled for the same tasks.
        rng: Draws the point, and which part of each sample is shown.

    Returns:
        A sample of that size with the first one's name and attributes.
    """
    height, width = tiles[0].size
    split_y, split_x = int(rng.uniform(0.35, 0.65) * height), int(rng.uniform(0.35, 0.65) * width)
    places = [
        (slice(0, split_y), slice(0, split_x)),
        (slice(0, split_y), slice(split_x, width)),
        (slice(split_y, height), slice(0, split_x)),
        (slice(split_y, height), slice(split_x, width)),
    ]
    parts = []
    for tile, (rows, columns) in zip(tiles, places, strict=True):
        top = int(rng.integers(height - (rows.stop - rows.start) + 1))
        left = int(rng.integers(width - (columns.stop - columns.start) + 1))
        parts.append(_crop(tile, top, left, rows.stop - rows.start, columns.stop - columns.start))
    first = parts[0]

    def join(arrays: list[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([np.concatenate(arrays[:2], axis=1), np.concatenate(arrays[2:], axis=1)], axis=0)

    def shifted(boxes: list[NDArray[np.float32]]) -> NDArray[np.float32]:
        corners = [(columns.start, rows.start) * 2 for rows, columns in places]
        moved = [part + np.array(corner, np.float32) for part, corner in zip(boxes, corners, strict=True)]
        return np.concatenate(moved)

    def joined(name: str) -> Any:
        arrays = [getattr(part, name) for part in parts]
        if all(array is None for array in arrays):
            return None
        if name in VALID:
            arrays = [np.ones(p.size, np.bool_) if a is None else a for a, p in zip(arrays, parts, strict=True)]
        return join(arrays)

    return dataclasses.replace(
        tiles[0],
        image=join([part.image for part in parts]),
        boxes=None if first.boxes is None else shifted([part.boxes for part in parts if part.boxes is not None]),
        class_id=None
        if first.class_id is None
        else np.concatenate([part.class_id for part in parts if part.class_id is not None]),
        ignored=shifted([part.ignored for part in parts]),
        **{name: joined(name) for name in (*MASKS, *VALID)},
    )


def mixup(one: Sample, two: Sample, rng: np.random.Generator) -> Sample:
    """Let a second sample shine through the first.

    Boxes of both count. Masks are those of the first, which is always the stronger: a blend has no half labels.

    Args:
        one: Weighs 0.5 or more.
        two: Of the same size, labelled for the same tasks.
        rng: Draws the weight: Beta(8, 8), mirrored to 0.5 or more.
    """
    weight = float(rng.beta(8.0, 8.0))
    weight = max(weight, 1 - weight)
    boxes, class_id = one.boxes, one.class_id
    if boxes is not None and class_id is not None and two.boxes is not None and two.class_id is not None:
        boxes = np.concatenate([boxes, two.boxes])
        class_id = np.concatenate([class_id, two.class_id])
    return dataclasses.replace(
        one,
        image=cv2.addWeighted(one.image, weight, two.image, 1 - weight, 0),
        boxes=boxes,
        class_id=class_id,
        ignored=np.concatenate([one.ignored, two.ignored]),
    )


def _alike(sample: Sample, rng: np.random.Generator, draw: Callable[[np.random.Generator], Sample]) -> Sample | None:
    """Draw a sample that is labelled for the same tasks, if one turns up."""
    for _ in range(_JOINS_TRIED):
        other = draw(rng)
        if all((getattr(other, name) is None) == (getattr(sample, name) is None) for name in _LABELS):
            return other
    return None


_LABELS: Final = ("boxes", "drivable", "lane")


def _crop(sample: Sample, top: int, left: int, height: int, width: int) -> Sample:
    """Cut a part out of a sample; boxes of which too little is left are gone."""
    area = np.s_[top : top + height, left : left + width]

    def cut(boxes: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        moved = boxes - np.array([left, top, left, top], np.float32)
        return moved, clip_boxes(moved, (height, width))

    boxes, class_id = sample.boxes, sample.class_id
    if boxes is not None and class_id is not None:
        moved, boxes = cut(boxes)
        keep = kept_boxes(moved, boxes)
        boxes, class_id = boxes[keep], class_id[keep]
    _, ignored = cut(sample.ignored)
    ignored = ignored[(ignored[:, 2] > ignored[:, 0]) & (ignored[:, 3] > ignored[:, 1])]
    return dataclasses.replace(
        sample,
        image=sample.image[area],
        boxes=boxes,
        class_id=class_id,
        ignored=ignored,
        **sample.changed((*MASKS, *VALID), lambda mask: mask[area]),
    )


def _resize(array: NDArray[np.uint8], box: Letterbox) -> NDArray[np.uint8]:
    """Resize an image or mask to the letterbox's size, without padding."""
    height, width = box.resized
    if array.shape[:2] == (height, width):
        return array
    shrinking = height * width < array.shape[0] * array.shape[1]
    return cv2.resize(  # type: ignore[no-any-return]
        array, (width, height), interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR
    )


def _resize_mask(mask: NDArray[np.uint8], box: Letterbox, above: int) -> NDArray[np.uint8]:
    """Return a {0, 1} mask as {0, 255} at the letterbox's size, without padding."""
    grey = _resize(mask * np.uint8(255), box)
    return grey if grey.shape == mask.shape else cv2.threshold(grey, above, 255, cv2.THRESH_BINARY)[1]


def _warp_together(
    image: NDArray[np.uint8],
    masks: dict[str, NDArray[np.uint8]],
    matrix: NDArray[np.float64],
    canvas: tuple[int, int],
) -> tuple[NDArray[np.uint8], dict[str, NDArray[np.uint8]]]:
    """Warp an image, padded with grey, and its masks, padded with 0.

    One mask travels as the image's fourth channel: OpenCV warps four channels in less than half the time of three.
    """
    names = list(masks)
    stack = cv2.cvtColor(image, cv2.COLOR_RGB2RGBA)
    if names:
        cv2.insertChannel(masks[names[0]], stack, 3)
    whole = cv2.warpAffine(
        stack,
        matrix,
        (canvas[1], canvas[0]),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(PAD_VALUE, PAD_VALUE, PAD_VALUE, 0),
    )
    moved = {
        name: cv2.warpAffine(masks[name], matrix, (canvas[1], canvas[0]), flags=cv2.INTER_LINEAR) for name in names[1:]
    }
    if names:
        moved[names[0]] = cv2.extractChannel(whole, 3)
    return cv2.cvtColor(whole, cv2.COLOR_RGBA2RGB), moved


def _move_boxes(
    boxes: NDArray[np.float32], box: Letterbox, matrix: NDArray[np.float64], scale: float, *, strict: bool
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Move boxes of the source image by ``matrix``: the hull of the four corners, clipped to the canvas.

    Args:
        boxes: (N, 4) xyxy px of the source image.
        box: How the source image was resized.
        matrix: From resized pixels to canvas pixels.
        scale: The scale in ``matrix``.
        strict: Drop by `kept_boxes`; else drop what is wholly outside.

    Returns:
        (K, 4) float32 xyxy canvas px, and (N,) bool: which were kept.
    """
    if not len(boxes):
        return boxes, np.zeros(0, np.bool_)
    factor = np.array([box.resized[1] / box.source[1], box.resized[0] / box.source[0]] * 2)
    resized = boxes * factor
    # Edges lie half a pixel outside the centres of the outermost pixels.
    corners = np.stack([resized[:, [0, 1]], resized[:, [2, 1]], resized[:, [2, 3]], resized[:, [0, 3]]], axis=1) - 0.5
    moved = corners @ matrix[:, :2].T + matrix[:, 2] + 0.5
    hull = np.concatenate([moved.min(axis=1), moved.max(axis=1)], axis=1).astype(np.float32)
    clipped = clip_boxes(hull, box.canvas)
    if strict:
        # The published rule compares with the scaled box, not with the hull of the rotated one.
        keep = kept_boxes((resized * scale).astype(np.float32), clipped)
    else:
        keep = (clipped[:, 2] > clipped[:, 0]) & (clipped[:, 3] > clipped[:, 1])
    return clipped[keep], keep
