"""What a reader of a foreign format hands over for one image: shapes and names, before any mask is drawn."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["AreaLabel", "ImageRecord", "LaneLabel", "MaskFile", "ObjectLabel", "RecordSource"]


@dataclasses.dataclass(frozen=True)
class ObjectLabel:
    """A labelled object.

    Attributes:
        category: As the file names it.
        box: Left, top, right, bottom in pixels.
        crowd: Uncertain, or a group: neither object nor background.
        attributes: Further ones (occluded, truncated, ...).
    """

    category: str
    box: tuple[float, float, float, float]
    crowd: bool = False
    attributes: dict[str, str | bool | float] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True, eq=False)
class AreaLabel:
    """A drivable area.

    Attributes:
        kind: ``"direct"`` or ``"alternative"``.
        points: (N, 2) float64: the polygon in pixels.
    """

    kind: str
    points: NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class LaneLabel:
    """A lane marking, or one edge of it.

    Attributes:
        category: ``"single white"``, ``"road curb"``, ``"crosswalk"``, ...
        points: (N, 2) float64: a polyline in pixels, or a polygon around the marking if ``closed``.
        closed: Whether it is a polygon.
        style: ``"solid"``, ``"dashed"`` or ``""``.
        direction: ``"parallel"``, ``"vertical"`` or ``""``.
        edge: Whether it may be one of two edges of a marking; False = its middle.
    """

    category: str
    points: NDArray[np.float64]
    closed: bool = False
    style: str = ""
    direction: str = ""
    edge: bool = False


@dataclasses.dataclass(frozen=True)
class MaskFile:
    """A mask that exists as a picture.

    Attributes:
        path: The picture.
        values: Pixel value -> ``"direct"``, ``"alternative"``, ``"foreground"``, ``"ignore"``; other values are
            background. Keys are grey levels or indices (int), or ``(red, green, blue)``.
    """

    path: Path
    values: dict[int | tuple[int, int, int], str]


@dataclasses.dataclass(frozen=True, eq=False)
class ImageRecord:
    """One image with its labels as read. A task that is not labelled is None, never an empty list.

    Attributes:
        name: Unique in its split; without folder and ending.
        image: The image's file.
        objects: Objects.
        drivable: Drivable areas, as polygons or as a picture.
        lane: Lane markings, as lines or as a picture.
        attributes: Weather, scene, time of day and the like.
        dropped: What the reader could not use: reason -> count.
    """

    name: str
    image: Path
    objects: tuple[ObjectLabel, ...] | None = None
    drivable: tuple[AreaLabel, ...] | MaskFile | None = None
    lane: tuple[LaneLabel, ...] | MaskFile | None = None
    attributes: dict[str, str] = dataclasses.field(default_factory=dict)
    dropped: dict[str, int] = dataclasses.field(default_factory=dict)


class RecordSource(Protocol):
    """A foreign data set: names first, each record when it is wanted, from any process (so it must be picklable)."""

    @property
    def splits(self) -> tuple[str, ...]:
        """The splits there are."""

    def names(self, split: str) -> list[str]:
        """Return the names of a split's images, sorted."""

    def record(self, split: str, name: str) -> ImageRecord:
        """Read one image's labels.

        Raises:
            DataError: If they are broken.
        """
