"""Results drawn on the image: masks with soft edges, boxes and labels, in colours that colour-blind people tell apart.

Colours are those of Okabe and Ito (2008), RGB. The drawing functions change the (height, width, 3) uint8 RGB canvas
they are given; `draw` makes the copy.
"""

from __future__ import annotations

import functools
from collections.abc import Collection
from pathlib import Path
from typing import Any, Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from trilitenet.errors import ConfigError, ShapeError, did_you_mean
from trilitenet.processing.images import read_image
from trilitenet.structures import Boxes, Perception

__all__ = [
    "BOX_COLOURS",
    "DRIVABLE_COLOUR",
    "LANE_COLOUR",
    "PARTS",
    "blend_masks",
    "check_parts",
    "draw",
    "draw_boxes",
    "draw_label",
    "label_font",
    "line_thickness",
]

Colour: TypeAlias = tuple[int, int, int]

DRIVABLE_COLOUR: Final[Colour] = (0, 158, 115)
LANE_COLOUR: Final[Colour] = (240, 228, 66)
BOX_COLOURS: Final[tuple[Colour, ...]] = (
    (86, 180, 233),
    (230, 159, 0),
    (204, 121, 167),
    (213, 94, 0),
    (0, 114, 178),
)
"""Colours of objects, by class, or by track where there are tracks."""

PARTS: Final = ("drivable", "lane", "boxes", "labels")
"""Parts of the picture that can be left out."""

_OPACITY: Final = {"drivable": 0.42, "lane": 0.85}
_STRIP: Final = 40_000
"""Masks are blended in strips of so many pixels, so that what is made on the way stays in the processor's cache, and
memory is not given back to the system and asked for again: that took half of the time."""


_LABELLED: Final = 192
"""Pixels of a picture's longer side from which objects have labels: on smaller ones they cover what they name."""


def check_parts(hide: Collection[str], known: Collection[str] = PARTS) -> frozenset[str]:
    """Return ``hide`` as a set.

    Raises:
        ConfigError: If a part is unknown; the message names the nearest.
    """
    for part in hide:
        if part not in known:
            raise ConfigError(f"unknown part {part!r} of the overlay{did_you_mean(part, known)}")
    return frozenset(hide)


def draw(
    perception: Perception,
    image: str | Path | bytes | Image.Image | NDArray[Any] | None = None,
    *,
    hide: Collection[str] = (),
    out: NDArray[np.uint8] | None = None,
) -> NDArray[np.uint8]:
    """Return a copy of the image with the three tasks drawn on it.

    Args:
        perception: What to draw.
        image: What to draw on, in any form that `read_image` takes; the perception's own if left out.
        hide: Parts to leave out, of `PARTS`.
        out: Where to draw; may be ``image`` itself. Made if left out.

    Returns:
        (height, width, 3) uint8 RGB, ``out`` if it was given.

    Raises:
        InputError: If an image cannot be read.
        ShapeError: If there is no image, or one of another size.
        ConfigError: If a part is unknown.
    """
    hidden = check_parts(hide)
    image = perception.image if image is None else image
    if image is None:
        raise ShapeError("this perception did not keep its image; pass one: perception.draw(image)")
    image = read_image(image)
    if image.shape != (*perception.size, 3):
        raise ShapeError(f"the image must be {(*perception.size, 3)}, got {image.shape}")
    canvas = np.empty_like(image) if out is None else out
    np.copyto(canvas, image)  # nothing to do where both are the same memory
    layers = {
        name: mask
        for name, mask in (("drivable", perception.drivable), ("lane", perception.lane))
        if mask is not None and name not in hidden
    }
    blend_masks(canvas, layers)
    if perception.boxes is not None and "boxes" not in hidden:
        draw_boxes(canvas, perception.boxes, perception.class_names, labels="labels" not in hidden)
    return canvas


def blend_masks(canvas: NDArray[np.uint8], masks: dict[str, NDArray[np.bool_]]) -> None:
    """Tint drivable area and lane markings, lane on top, with soft edges.

    Args:
        canvas: (height, width, 3) uint8 RGB, changed in place.
        masks: (height, width) bool under ``"drivable"`` and ``"lane"``.
    """
    height, width = canvas.shape[:2]
    soft = round(max(height, width) / 640)
    rows = max(8, _STRIP // width)
    used = {name: np.asarray(mask.any(axis=1)) for name, mask in masks.items()}
    for top in range(0, height, rows):
        bottom = min(height, top + rows)
        first, last = max(0, top - soft), min(height, bottom + soft)
        layers: dict[str, NDArray[Any]] = {}
        for name in ("drivable", "lane"):
            if name in masks and used[name][first:last].any():
                layers[name] = _soften(masks[name][first:last], _OPACITY[name], soft)[top - first : bottom - first]
        if layers:
            _tint(canvas[top:bottom], layers)


def _soften(mask: NDArray[np.bool_], opacity: float, soft: int) -> NDArray[Any]:
    """Return (height, width) uint8 weights of a mask, 255 = opaque, with edges ``soft`` pixels wide on both sides."""
    weights = cv2.convertScaleAbs(mask.view(np.uint8), alpha=255 * opacity)
    return np.asarray(cv2.GaussianBlur(weights, (2 * soft + 1, 2 * soft + 1), 0))


def _tint(part: NDArray[np.uint8], layers: dict[str, NDArray[Any]]) -> None:
    """Mix the colours of layers into rows of a canvas, in place, by their weights."""
    (name, covered), *above = layers.items()
    if above:  # lane markings lie on top
        lane = above[0][1]
        drivable = cv2.multiply(covered, cv2.bitwise_not(lane), scale=1 / 255)
        covered = cv2.add(drivable, lane)
        tint = [
            cv2.addWeighted(drivable, under / 255, lane, over / 255, 0)
            for under, over in zip(DRIVABLE_COLOUR, LANE_COLOUR, strict=True)
        ]
    else:
        colour = DRIVABLE_COLOUR if name == "drivable" else LANE_COLOUR
        tint = [cv2.convertScaleAbs(covered, alpha=value / 255) for value in colour]
    cv2.multiply(part, cv2.merge([cv2.bitwise_not(covered)] * 3), dst=part, scale=1 / 255)
    cv2.add(part, cv2.merge(tint), dst=part)


def draw_boxes(canvas: NDArray[np.uint8], boxes: Boxes, class_names: tuple[str, ...], *, labels: bool = True) -> None:
    """Draw boxes, the surest on top.

    A label is the class, if there is more than one, and the confidence, or the track's number where there is one.

    Args:
        canvas: (height, width, 3) uint8 RGB, changed in place.
        boxes: In pixels of the canvas.
        class_names: Names of the classes.
        labels: Write the labels too, unless the canvas is so small that they would cover the objects.
    """
    labels = labels and max(canvas.shape) >= _LABELLED
    thickness, beyond = line_thickness(canvas), max(canvas.shape)
    corners = np.clip(boxes.xyxy, -2 * thickness, beyond + 2 * thickness)  # OpenCV counts to 2**31
    for i in range(len(boxes) - 1, -1, -1):
        track = -1 if boxes.track_id is None else int(boxes.track_id[i])
        class_id = int(boxes.class_id[i])
        colour = BOX_COLOURS[(track if track >= 0 else class_id) % len(BOX_COLOURS)]
        left, top, right, bottom = (round(float(value)) for value in corners[i])
        cv2.rectangle(canvas, (left, top), (right, bottom), colour, thickness)
        if labels:
            words = [class_names[class_id]] if len(class_names) > 1 else []
            words.append(f"{boxes.confidence[i]:.2f}" if track < 0 else f"#{track}")
            draw_label(canvas, " ".join(words), (left, top), colour)


def line_thickness(canvas: NDArray[np.uint8]) -> int:
    """Return how thick the lines of boxes are, in pixels of a picture."""
    thickness: int = max(1, round(max(canvas.shape) / 400))
    return thickness


def draw_label(
    canvas: NDArray[np.uint8], text: str, corner: tuple[int, int], colour: Colour, *, size: int | None = None
) -> None:
    """Write text on a plate whose lower left corner is ``corner``, kept inside the canvas.

    Args:
        canvas: (height, width, 3) uint8 RGB, changed in place.
        text: One line.
        corner: (x, y) in pixels.
        colour: Of the plate; the text is black or white, whichever is easier to read.
        size: Height of the letters in pixels; by the canvas if left out.
    """
    height, width = canvas.shape[:2]
    make = _kept_plate if len(text) <= _SHORT else _plate
    plate = make(text, size or max(10, round(max(height, width) / 80)), colour)[:height, :width]
    left = min(max(corner[0], 0), width - plate.shape[1])
    top = corner[1] - plate.shape[0]
    if top < 0:
        top = corner[1]
    top = min(max(top, 0), height - plate.shape[0])
    canvas[top : top + plate.shape[0], left : left + plate.shape[1]] = plate


def _plate(text: str, size: int, colour: Colour) -> NDArray[np.uint8]:
    font = label_font(size)
    left, _, right, _ = font.getbbox(text, anchor="ls")
    above, below = font.getbbox("Ag", anchor="ls")[1::2]
    margin = max(2, size // 4)
    plate = Image.new("RGB", (int(right - left) + 2 * margin, int(below - above) + margin), colour)
    luminance = 0.299 * colour[0] + 0.587 * colour[1] + 0.114 * colour[2]
    ink = (0, 0, 0) if luminance > 110 else (255, 255, 255)
    ImageDraw.Draw(plate).text((margin - left, margin // 2 - above), text, fill=ink, font=font, anchor="ls")
    return np.asarray(plate, np.uint8)


_SHORT: Final = 32
"""Characters of a text that comes again and again, such as a box's; longer ones, of figures, are new in most frames."""
_kept_plate = functools.lru_cache(maxsize=512)(_plate)


@functools.lru_cache(maxsize=64)
def label_font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return the font of `draw_label`, with letters so many pixels high."""
    return ImageFont.load_default(size)
