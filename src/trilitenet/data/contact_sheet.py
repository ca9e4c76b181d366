"""Samples with their labels drawn on them, and sheets of many."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.data.reading import DrivingDataset
from trilitenet.data.sample import Sample
from trilitenet.processing.drawing import draw, line_thickness
from trilitenet.processing.letterbox import Letterbox
from trilitenet.structures import Boxes, Perception

__all__ = ["as_perception", "contact_sheet", "draw_sample", "pick", "thumbnail"]

_IGNORED_COLOUR: Final = (150, 150, 150)
_INVALID_COLOUR: Final = (213, 94, 0)
_TEXT_ROWS: Final = 18


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


def draw_sample(sample: Sample, class_names: Sequence[str]) -> NDArray[np.uint8]:
    """Return the image with its labels: areas and markings blended, objects boxed, ignored regions in grey.

    Pixels that are ignored by every task (the own car) are hatched, those that one mask ignores the other way. What is
    not labelled is not drawn.

    Args:
        sample: Of any size.
        class_names: Names that ``sample.class_id`` indexes.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    canvas = draw(as_perception(sample, class_names), sample.image, hide=("labels",))
    for valid, way in ((sample.valid, 1), (sample.drivable_valid, -1), (sample.lane_valid, -1)):
        if valid is not None:
            rows, columns = np.indices(sample.size)
            canvas[~valid & ((rows + way * columns) % 8 < 2)] = _INVALID_COLOUR
    for x1, y1, x2, y2 in np.rint(sample.ignored).astype(int).tolist():
        cv2.rectangle(canvas, (x1, y1), (x2 - 1, y2 - 1), _IGNORED_COLOUR, line_thickness(canvas))
    return canvas


def thumbnail(sample: Sample, class_names: Sequence[str], size: tuple[int, int] = (180, 320)) -> NDArray[np.uint8]:
    """Return a drawn sample made to fit ``size`` (height, width), with its name and missing tasks below.

    Returns:
        (height + 18, width, 3) uint8 RGB.
    """
    small = Letterbox.fit(sample.size, canvas=size).image(draw_sample(sample, class_names))
    label = np.full((_TEXT_ROWS, size[1], 3), 255, np.uint8)
    cv2.putText(label, _caption(sample), (3, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA)
    return np.concatenate([small, label])


def contact_sheet(
    samples: Sequence[Sample], class_names: Sequence[str], *, columns: int = 4, size: tuple[int, int] = (180, 320)
) -> NDArray[np.uint8]:
    """Return one picture of many samples.

    Args:
        samples: In reading order; at least one.
        class_names: Names that class ids index.
        columns: Pictures a row.
        size: (height, width) of each.

    Returns:
        (H, W, 3) uint8 RGB.
    """
    tiles = [thumbnail(sample, class_names, size) for sample in samples]
    columns = min(columns, len(tiles))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    rows = [np.concatenate(tiles[first : first + columns], axis=1) for first in range(0, len(tiles), columns)]
    return np.concatenate(rows)


def pick(dataset: DrivingDataset, where: Mapping[str, str], count: int, *, seed: int = 0, start: int = 0) -> list[int]:
    """Return the indices of images with certain attributes, in a random order, reading no more than needed.

    Args:
        dataset: The split.
        where: Attribute -> wanted value.
        count: At most so many.
        seed: Of the order.
        start: Leave out the first so many that fit.
    """
    found: list[int] = []
    for index in np.random.default_rng(seed).permutation(len(dataset)).tolist():
        if where and not where.items() <= dataset.attributes(index).items():
            continue
        found.append(index)
        if len(found) >= start + count:
            break
    return found[start:]


def _caption(sample: Sample) -> str:
    tasks = (("boxes", sample.boxes), ("area", sample.drivable), ("lane", sample.lane))
    missing = [name for name, label in tasks if label is None]
    condition = sample.attributes.get("condition") or sample.attributes.get("timeofday", "")
    name = sample.name if len(sample.name) <= 30 else f"{sample.name[:28]}.."
    return "  ".join(filter(None, [name, condition, f"no {', '.join(missing)}" if missing else ""]))
