"""Samples with their labels drawn on them, and sheets of many."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.data.reading import UNDEFINED, DrivingDataset, decode_grey
from trilitenet.data.sample import Sample
from trilitenet.processing.drawing import DRIVABLE_COLOUR, draw, line_thickness
from trilitenet.processing.letterbox import Letterbox
from trilitenet.structures import Boxes, Perception

__all__ = ["alternative_area", "as_perception", "caption", "contact_sheet", "draw_sample", "pick", "thumbnail"]

_IGNORED_COLOUR: Final = (150, 150, 150)
_INVALID_COLOUR: Final = (213, 94, 0)
_TEXT_ROWS: Final = 18
_LONGEST: Final = 30
"""Characters of a name that a sheet has room for."""
_ALTERNATIVE: Final = {127: "alternative"}
"""Values of drivable masks of a data set that does not name them, where they are not plainly drivable."""
_FAINT: Final = 0.15
"""Opacity of alternative areas, where direct ones have 0.42."""


def as_perception(sample: Sample, class_names: Sequence[str]) -> Perception:
    """Return a sample's labels as what a network would have seen with confidence 1."""
    boxes = None
    if sample.boxes is not None and sample.class_id is not None:
        boxes = Boxes(sample.boxes, np.ones(len(sample.boxes), np.float32), sample.class_id)
    return Perception(
        size=sample.size,
        class_names=tuple(class_names),
        boxes=boxes,
        drivable=None if sample.drivable is None else sample.drivable.astype(np.bool_),
        lane=None if sample.lane is None else sample.lane.astype(np.bool_),
        image=sample.image,
    )


def alternative_area(dataset: DrivingDataset, index: int) -> NDArray[np.bool_] | None:
    """Return where an image's drivable mask says that the area is an alternative one, which a sample does not tell.

    Args:
        dataset: The split.
        index: Of an image that can be read.

    Returns:
        (H, W) bool; None where there is no such area.
    """
    names = dataset.description.drivable.values or _ALTERNATIVE
    values = [value for value, name in names.items() if name == "alternative"]
    path = dataset.label_path("drivable", dataset.names[index])
    if not (values and path.is_file()):
        return None
    grey = decode_grey(np.fromfile(path, np.uint8), str(path))
    area = np.isin(grey, values) if grey is not None else np.zeros(0, np.bool_)
    return area if area.any() else None


def draw_sample(
    sample: Sample, class_names: Sequence[str], alternative: NDArray[np.bool_] | None = None
) -> NDArray[np.uint8]:
    """Return the image with its labels: areas and markings blended, objects boxed, ignored regions in grey.

    Pixels that are ignored by every task (the own car) are hatched, those that one mask ignores the other way. What is
    not labelled is not drawn.

    Args:
        sample: Of any size.
        class_names: Names that ``sample.class_id`` indexes.
        alternative: (H, W) bool where drivable areas are alternative ones, which are tinted less; None for nowhere.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    image = sample.image
    if alternative is not None and sample.drivable is not None:
        faint = alternative & (sample.drivable > 0)
        image = image.copy()
        image[faint] = np.rint((1 - _FAINT) * image[faint] + _FAINT * np.array(DRIVABLE_COLOUR)).astype(np.uint8)
        sample = dataclasses.replace(sample, drivable=np.where(faint, np.uint8(0), sample.drivable))
    canvas = draw(as_perception(sample, class_names), image, hide=("labels",))
    for valid, way in ((sample.valid, 1), (sample.drivable_valid, -1), (sample.lane_valid, -1)):
        if valid is not None:
            rows, columns = np.indices(sample.size)
            canvas[~valid & ((rows + way * columns) % 8 < 2)] = _INVALID_COLOUR
    for x1, y1, x2, y2 in np.rint(sample.ignored).astype(int).tolist():
        cv2.rectangle(canvas, (x1, y1), (x2 - 1, y2 - 1), _IGNORED_COLOUR, line_thickness(canvas))
    return canvas


def caption(sample: Sample) -> str:
    """Return a sample's name, condition and missing tasks."""
    return ", ".join(filter(None, [sample.name, *_remarks(sample)]))


def thumbnail(
    sample: Sample,
    class_names: Sequence[str],
    size: tuple[int, int] = (180, 320),
    *,
    split: str = "",
    alternative: NDArray[np.bool_] | None = None,
) -> NDArray[np.uint8]:
    """Return a drawn sample made to fit ``size`` (height, width), with its name, condition and missing tasks below.

    Args:
        sample: Of any size.
        class_names: Names that ``sample.class_id`` indexes.
        size: (height, width) in pixels.
        split: To name it too.
        alternative: See `draw_sample`.

    Returns:
        (height + 18, width, 3) uint8 RGB.
    """
    small = Letterbox.fit(sample.size, canvas=size).image(draw_sample(sample, class_names, alternative))
    label = np.full((_TEXT_ROWS, size[1], 3), 255, np.uint8)
    name = sample.name
    if len(name) > _LONGEST:  # what tells it from others is as a rule at its end
        name = f"{name[: _LONGEST // 2 - 2]}..{name[-_LONGEST // 2 :]}"
    text = "  ".join(filter(None, [f"{split}/{name}" if split else name, *_remarks(sample)]))
    text = text.encode(errors="backslashreplace").decode()  # OpenCV crashes on what is not UTF-8 in a file's name
    cv2.putText(label, text, (3, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([small, label])


def contact_sheet(thumbnails: Sequence[NDArray[np.uint8]], *, columns: int = 4) -> NDArray[np.uint8]:
    """Return one picture of many.

    Args:
        thumbnails: In reading order, of one size; at least one.
        columns: Pictures a row.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    tiles = list(thumbnails)
    columns = min(columns, len(tiles))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[first : first + columns], axis=1) for first in range(0, len(tiles), columns)]
    return np.concatenate(rows)


def pick(dataset: DrivingDataset, where: Mapping[str, str], count: int, *, seed: int = 0, start: int = 0) -> list[int]:
    """Return the indices of images with certain attributes, in a random order, reading no more than needed.

    Args:
        dataset: The split.
        where: Attribute -> wanted value; that of an image without it is `UNDEFINED`.
        count: At most so many.
        seed: Of the order.
        start: Leave out the first so many that fit.
    """
    found: list[int] = []
    for index in np.random.default_rng(seed).permutation(len(dataset)).tolist():
        if where:
            attributes = dataset.attributes(index)
            if any((attributes.get(key) or UNDEFINED) != value for key, value in where.items()):
                continue
        found.append(index)
        if len(found) >= start + count:
            break
    return found[start:]


def _remarks(sample: Sample) -> list[str]:
    """Return a sample's condition and what is not labelled, each empty where there is nothing to say."""
    tasks = (("boxes", sample.boxes), ("area", sample.drivable), ("lane", sample.lane))
    missing = [name for name, label in tasks if label is None]
    condition = sample.attributes.get("condition") or sample.attributes.get("timeofday", "")
    return [condition, f"no {', '.join(missing)}" if missing else ""]
