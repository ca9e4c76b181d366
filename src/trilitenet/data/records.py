"""What a reader of a foreign format hands over for one image: shapes and names, before any mask is drawn."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import DataError, ShapeError
from trilitenet.processing.images import BROKEN, open_image, upright_size
from trilitenet.processing.serialise import decode_mask

__all__ = [
    "AreaLabel",
    "BrokenRecord",
    "CocoRuns",
    "ImageRecord",
    "LaneLabel",
    "ListedRecords",
    "MaskFile",
    "ObjectLabel",
    "RecordSource",
    "RowRuns",
    "RunLabel",
    "image_size",
    "name_apart",
    "named_apart",
    "same_name",
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
        bottom, right = self.top + self.height, self.left + self.width
        if min(self.left, self.top, self.width, self.height) < 0 or right > size[1] or bottom > size[0]:
            raise DataError(f"a mask that reaches out of an image of {size[1]}x{size[0]}")
        mask = np.zeros(size, np.bool_)
        mask[self.top : bottom, self.left : right] = _spread(self.runs, self.height, self.width)
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
            DataError: If the runs are for another size, do not fill it, or are no run lengths.
        """
        if self.size != size:
            raise DataError(f"a run-length mask of {self.size[1]}x{self.size[0]}, image of {size[1]}x{size[0]}")
        if isinstance(self.counts, str):
            try:
                return decode_mask({"size": size, "counts": self.counts})
            except ShapeError as error:
                raise DataError(str(error)) from error
        mask: NDArray[np.bool_] = _spread(self.counts, size[1], size[0]).T
        return mask


RunLabel = RowRuns | CocoRuns


def _spread(runs: Sequence[int], lines: int, length: int) -> NDArray[np.bool_]:
    """Return run lengths, in turn outside and inside, as (lines, length) bool.

    Raises:
        DataError: If they do not fill it.
    """
    if min(runs, default=0) < 0 or sum(runs) != lines * length:
        raise DataError(f"a run-length mask whose runs are negative or do not fill its {lines * length} pixels")
    inside: NDArray[np.bool_] = np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(lines, length)
    return inside


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
        values: Pixel value -> ``"direct"``, ``"alternative"``, ``"foreground"``, ``"ignore"``, ``"background"``; other
            values are background, too, and told where that is named. Keys are grey levels or indices (int), or
            ``(red, green, blue)``. Empty: every value above 0 is foreground.
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
        size: (height, width) that the labels were made for; None = the format does not say.
    """

    name: str
    image: Path
    objects: tuple[ObjectLabel, ...] | None = None
    drivable: tuple[AreaLabel | RunLabel, ...] | MaskFile | None = None
    lane: tuple[LaneLabel | RunLabel, ...] | MaskFile | None = None
    attributes: dict[str, str] = dataclasses.field(default_factory=dict)
    dropped: dict[str, int] = dataclasses.field(default_factory=dict)
    size: tuple[int, int] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class BrokenRecord(ImageRecord):
    """An image whose labels are broken; a conversion leaves it out.

    Attributes:
        reason: What is wrong with them.
    """

    reason: str = ""


def image_size(path: Path) -> tuple[int, int]:
    """Return an image's (height, width), turned as its EXIF data say, without decoding the pixels.

    Raises:
        DataError: If it is not an image.
    """
    try:
        with open_image(path) as image:
            return upright_size(image)
    except BROKEN as error:
        raise DataError(f"{path}: not an image that can be read ({error})") from error


def name_apart(images: Iterable[Path]) -> dict[Path, str]:
    """Return each image's name: its stem, after as many of its folders as tell it from the others (``day1-0001``).

    Images that differ in their ending alone have one name. Case tells none apart, as on Windows and macOS.
    """
    depths = dict.fromkeys(images, 0)
    places = {path: str(path.with_suffix("")).casefold() for path in depths}
    alike = Counter(places.values())
    while True:
        names = {path: "-".join((*path.parts[-1 - depth : -1], path.stem)) for path, depth in depths.items()}
        counts = Counter(map(str.casefold, names.values()))
        longer = [
            path
            for path, name in names.items()
            if counts[name.casefold()] > 1
            and alike[places[path]] == 1
            and depths[path] < len(path.relative_to(path.anchor).parent.parts)
        ]
        if not longer:
            return names
        for path in longer:
            depths[path] += 1


def named_apart(records: Iterable[ImageRecord]) -> list[ImageRecord]:
    """Return the records of a split with the names that `name_apart` gives their images."""
    records = list(records)
    names = name_apart(record.image for record in records)
    return [dataclasses.replace(record, name=names[record.image]) for record in records]


def same_name(name: str, split: str, one: Path, two: Path) -> DataError:
    """Return the error that two images of a split would get the same files."""
    if one == two:
        return DataError(f"{one}: is listed twice in split {split!r}; list it once, or convert one label file alone")
    return DataError(f"two images are called {name!r} in split {split!r}: {one} and {two}; rename one and its labels")


class ListedRecords:
    """A foreign data set whose records are all known; one of its files may list a whole split.

    Args:
        records: Split -> records.
        found: One line for each thing that was found, for the user.
        origin: See `RecordSource`.

    Raises:
        DataError: If two images of a split have one name.
    """

    def __init__(
        self,
        records: Mapping[str, Iterable[ImageRecord]],
        found: tuple[str, ...] = (),
        origin: Mapping[str, str] | None = None,
    ) -> None:
        self.found = found
        self.origin = dict(origin or {})
        self._records: dict[str, dict[str, ImageRecord]] = {}
        for split, items in records.items():
            own = self._records.setdefault(split, {})
            for item in items:
                if item.name in own:
                    raise same_name(item.name, split, own[item.name].image, item.image)
                own[item.name] = item

    @property
    def splits(self) -> tuple[str, ...]:
        """The splits there are."""
        return tuple(self._records)

    def names(self, split: str) -> list[str]:
        """Return the names of a split's images, sorted."""
        return sorted(self._records[split])

    def record(self, split: str, name: str) -> ImageRecord:
        """Return one image's labels.

        Raises:
            DataError: If they are broken.
        """
        record = self._records[split][name]
        if isinstance(record, BrokenRecord):
            raise DataError(record.reason)
        return record


class RecordSource(Protocol):
    """A foreign data set: names first, each record when it is wanted, from any process (so it must be picklable)."""

    @property
    def found(self) -> tuple[str, ...]:
        """One line for each thing that was found, for the user."""

    @property
    def origin(self) -> Mapping[str, str]:
        """What tells this source from another: its kind, its path, what its names mean. A conversion keeps to one."""

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
