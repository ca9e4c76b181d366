"""What a reader of a foreign format hands over for one image: shapes and names, before any mask is drawn."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
import pycocotools.mask
from numpy.typing import NDArray

from trilitenet.errors import DataError

__all__ = [
    "AreaLabel",
    "CocoRuns",
    "ImageRecord",
    "LaneLabel",
    "ListedRecords",
    "MaskFile",
    "ObjectLabel",
    "RecordSource",
    "RowRuns",
    "RunLabel",
]


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
        kind: ``"direct"``, ``"alternative"`` or ``"ignore"``.
        points: (N, 2) float64: the polygon in pixels.
    """

    kind: str
    points: NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class RowRuns:
    """A region as CVAT stores it: runs along the rows of its bounding box, the first one background.

    Attributes:
        kind: As `AreaLabel`.
        left: Pixels.
        top: Pixels.
        width: Pixels.
        height: Pixels.
        runs: Lengths, in turn outside and inside.
    """

    kind: str
    left: int
    top: int
    width: int
    height: int
    runs: tuple[int, ...]

    def decode(self, size: tuple[int, int]) -> NDArray[np.bool_]:
        """Return the region as (height, width) bool.

        Raises:
            DataError: If the runs do not fill the box, or the box reaches out of the image.
        """
        inside = np.repeat(np.arange(len(self.runs)) % 2 == 1, self.runs)
        if len(inside) != self.width * self.height:
            raise DataError(f"a mask of {self.width}x{self.height} with runs for {len(inside)} pixels")
        if min(self.left, self.top) < 0 or self.left + self.width > size[1] or self.top + self.height > size[0]:
            raise DataError(f"a mask that reaches out of an image of {size[1]}x{size[0]}")
        mask = np.zeros(size, np.bool_)
        mask[self.top : self.top + self.height, self.left : self.left + self.width] = inside.reshape(
            self.height, self.width
        )
        return mask


@dataclasses.dataclass(frozen=True)
class CocoRuns:
    """A region as COCO stores it: runs down the columns of the whole image, compressed or not.

    Attributes:
        kind: As `AreaLabel`.
        size: (height, width) that the runs are for.
        counts: COCO's text, or the lengths, in turn outside and inside.
    """

    kind: str
    size: tuple[int, int]
    counts: str | tuple[int, ...]

    def decode(self, size: tuple[int, int]) -> NDArray[np.bool_]:
        """Return the region as (height, width) bool.

        Raises:
            DataError: If the runs are for another size.
        """
        if self.size != size:
            raise DataError(f"a run-length mask of {self.size[1]}x{self.size[0]}, image of {size[1]}x{size[0]}")
        if isinstance(self.counts, str):
            runs = pycocotools.mask.decode({"size": list(size), "counts": self.counts.encode()})
            return np.asarray(runs, np.bool_)
        inside = np.repeat(np.arange(len(self.counts)) % 2 == 1, self.counts)
        if len(inside) != size[0] * size[1]:
            raise DataError(f"a run-length mask with {len(inside)} pixels, image of {size[1]}x{size[0]}")
        mask: NDArray[np.bool_] = inside.reshape(size[1], size[0]).T
        return mask


RunLabel = RowRuns | CocoRuns


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
    drivable: tuple[AreaLabel | RunLabel, ...] | MaskFile | None = None
    lane: tuple[LaneLabel | RunLabel, ...] | MaskFile | None = None
    attributes: dict[str, str] = dataclasses.field(default_factory=dict)
    dropped: dict[str, int] = dataclasses.field(default_factory=dict)


class ListedRecords:
    """A foreign data set whose records are all known; one of its files may list a whole split.

    Args:
        records: Split -> records.
        found: One line for each thing that was found, for the user.

    Raises:
        DataError: If two images of a split have one name.
    """

    def __init__(self, records: Mapping[str, Iterable[ImageRecord]], found: tuple[str, ...] = ()) -> None:
        self.found = found
        self._records: dict[str, dict[str, ImageRecord]] = {}
        for split, items in records.items():
            own = self._records.setdefault(split, {})
            for item in items:
                if item.name in own:
                    raise DataError(f"two images are called {item.name!r} in split {split!r}: {own[item.name].image}")
                own[item.name] = item

    @property
    def splits(self) -> tuple[str, ...]:
        """The splits there are."""
        return tuple(self._records)

    def names(self, split: str) -> list[str]:
        """Return the names of a split's images, sorted."""
        return sorted(self._records[split])

    def record(self, split: str, name: str) -> ImageRecord:
        """Return one image's labels."""
        return self._records[split][name]


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
