"""What the names and values in a foreign data set mean: read from a YAML file, or the defaults."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import Task, check_tasks, parse, parse_json, read_yaml
from trilitenet.data.description import VEHICLES, class_table
from trilitenet.data.reading import IMAGE_ENDINGS
from trilitenet.data.records import AreaLabel, ImageRecord, LaneLabel, ObjectLabel, RunLabel
from trilitenet.errors import ConfigError, DataError, brief

__all__ = [
    "SPLIT_NAMES",
    "LabelMapping",
    "Labels",
    "MaskRule",
    "find_image",
    "hull",
    "parse_colour",
    "read_json",
    "read_mapping",
    "visible",
]

SPLIT_NAMES: Final = {
    "train": "train",
    "training": "train",
    "val": "val",
    "valid": "val",
    "validation": "val",
    "test": "test",
}
"""What foreign formats call a split -> what it is called here."""
_MOST_NAMED: Final = 10
_KINDS: Final = ("direct", "alternative", "foreground", "ignore", "background")


@dataclasses.dataclass(frozen=True)
class MaskRule:
    """Where mask pictures are and what their values mean (``--from masks``).

    Attributes:
        path: From the data set's root, with ``{split}`` and ``{name}``.
        values: Value -> ``direct``, ``alternative``, ``foreground``, ``ignore`` or ``background``. A value is a grey
            level or index (``7``) or a colour (``"128, 64, 128"`` or ``"#804080"``); see `MaskFile` for others. Empty:
            everything above 0 is foreground.
    """

    path: str
    values: dict[str | int, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        self.meanings()

    def meanings(self) -> dict[int | tuple[int, int, int], str]:
        """Return the values parsed; none = everything above 0 is foreground, as for `MaskFile`.

        Raises:
            ConfigError: If one is neither a level nor a colour, levels and colours are mixed, or a kind is unknown.
        """
        parsed: dict[int | tuple[int, int, int], str] = {}
        for value, kind in self.values.items():
            if kind not in _KINDS:
                raise ConfigError(f"mask value {value!r} means {kind!r}; known: {', '.join(_KINDS)}")
            parsed[parse_colour(value)] = kind
        if len({isinstance(value, tuple) for value in parsed}) > 1:
            raise ConfigError("mask values are either all levels or all colours")
        return parsed


@dataclasses.dataclass(frozen=True)
class LabelMapping:
    """The meaning of a foreign data set's names.

    Attributes:
        classes: Class name -> categories that belong to it.
        ignore: Categories that are neither object nor background; for areas too.
        drivable: Categories of areas that are drivable.
        alternative: Categories of areas that are drivable after a lane change.
        lane: Categories of lane markings.
        lane_edges: Lines come two a marking, its edges; they are paired. False: a line is a marking's middle.
        tasks: What is labelled; found from the categories if left out.
        missing: An image without labels is ``unlabelled``, or ``empty``: looked at, and nothing there. For YOLO this is
            one without a label file, unlabelled if left out; for COCO and CVAT one that has no label of a task, which
            goes for each task on its own, empty if left out. Other formats do not take it.
        split: The split of images that the format does not put into one.
        splits: ``--from masks``: the splits to look for.
        images: ``--from masks``: folder of the images, with ``{split}``.
        drivable_mask: ``--from masks``: the drivable masks.
        lane_mask: ``--from masks``: the lane masks.
        name: Of the data set.
        licence: Of images and labels.
    """

    classes: dict[str, tuple[str, ...]] = dataclasses.field(default_factory=lambda: {"vehicle": VEHICLES})
    ignore: tuple[str, ...] = ()
    drivable: tuple[str, ...] = ("drivable", "drivable area", "direct")
    alternative: tuple[str, ...] = ("alternative",)
    lane: tuple[str, ...] = ("lane", "lane marking")
    lane_edges: bool = False
    tasks: tuple[Task, ...] = ()
    missing: Literal["unlabelled", "empty"] | None = None
    split: str = "train"
    splits: tuple[str, ...] = ("train", "val", "test")
    images: str = "images/{split}"
    drivable_mask: MaskRule = MaskRule("drivable/{split}/{name}.png")
    lane_mask: MaskRule = MaskRule("lane/{split}/{name}.png")
    name: str = ""
    licence: str = ""

    def __post_init__(self) -> None:
        if self.tasks:
            check_tasks(self.tasks)
        class_table(tuple(self.classes), self.classes)  # refuses a category of two classes
        for name, path, known in (
            ("images", self.images, ("split",)),
            ("drivable_mask", self.drivable_mask.path, ("split", "name")),
            ("lane_mask", self.lane_mask.path, ("split", "name")),
        ):
            try:
                path.format(**dict.fromkeys(known, ""))
            except (LookupError, ValueError) as error:
                places = " and ".join(f"{{{one}}}" for one in known)
                raise ConfigError(f"{name}: {path!r} may hold {places} alone in braces ({brief(error)})") from error

    def origin(self, kind: str, root: Path) -> dict[str, str]:
        """Return what a conversion of a data set of this kind and meaning remembers; see `RecordSource`."""
        meaning = dataclasses.replace(self, name="", licence="")  # these go to dataset.yaml alone
        return {"kind": kind, "path": str(root.resolve()), "mapping": repr(meaning)}

    def area_kind(self, category: str) -> str | None:
        """Return ``direct``, ``alternative`` or ``ignore`` if a category is an area, else None."""
        if category in self.drivable:
            return "direct"
        if category in self.alternative:
            return "alternative"
        return "ignore" if category in self.ignore else None

    def labelled(self, categories: set[str]) -> set[Task]:
        """Return the tasks that a data set with these categories labels."""
        if self.tasks:
            return set(self.tasks)
        tasks: set[Task] = set()
        if any(category in categories for members in self.classes.values() for category in members):
            tasks.add("detection")
        if categories & {*self.drivable, *self.alternative}:
            tasks.add("drivable")
        if categories & set(self.lane):
            tasks.add("lane")
        return tasks

    def labelled_in(self, labels: Labels, tasks: set[Task]) -> set[Task]:
        """Return for which of its file's tasks an image is labelled; what is ignored, or of no class, tells of none."""
        if self.missing != "unlabelled":
            return tasks
        known = {category for members in self.classes.values() for category in members}.difference(self.ignore)
        there: dict[Task, bool] = {
            "detection": any(item.category in known for item in labels.objects),
            "drivable": any(area.kind != "ignore" for area in labels.areas),
            "lane": bool(labels.lanes),
        }
        return {task for task in tasks if there[task]}

    def tell_empty(self, records: Mapping[str, Iterable[ImageRecord]]) -> list[str]:
        """Return a line for each split with images that have no label and are taken as empty, though nobody said so."""
        if self.missing is not None:
            return []
        counts = {split: sum(map(_is_empty, items)) for split, items in records.items()}
        return [
            f"{split}: {count} images without any label are taken as looked at, with nothing there; "
            "'missing: unlabelled' in the file of --classes leaves them unlabelled"
            for split, count in counts.items()
            if count
        ]

    def check_categories(self, categories: set[str], root: Path) -> None:
        """Refuse a data set whose categories all mean nothing, of which no label would be left.

        Raises:
            DataError: If there are some, and none is in a class, an area or a marking.
        """
        names = sorted(categories - {""})
        if names and not self.labelled(categories):
            some = ", ".join(map(repr, names[:_MOST_NAMED])) + (", ..." if len(names) > _MOST_NAMED else "")
            raise DataError(
                f"{root}: none of its categories ({some}) is one of a class, of areas or of lane markings; "
                "say what they mean with --classes FILE (docs/data.md)"
            )


@dataclasses.dataclass
class Labels:
    """Gathers the labels of one image while a reader goes through it."""

    objects: list[ObjectLabel] = dataclasses.field(default_factory=list)
    areas: list[AreaLabel | RunLabel] = dataclasses.field(default_factory=list)
    lanes: list[LaneLabel | RunLabel] = dataclasses.field(default_factory=list)
    attributes: dict[str, str] = dataclasses.field(default_factory=dict)
    dropped: Counter[str] = dataclasses.field(default_factory=Counter)

    def add(self, region: AreaLabel | RunLabel, label: ObjectLabel, kind: str | None) -> None:
        """Take a region that is no marking, as an object too unless it is an area alone.

        Args:
            region: As an area.
            label: As an object.
            kind: What `LabelMapping.area_kind` says of its category; what is to be ignored is both.
        """
        if kind is not None:
            self.areas.append(region)
        if kind in {None, "ignore"}:
            self.objects.append(dataclasses.replace(label, crowd=kind == "ignore"))

    def record(self, name: str, image: Path, tasks: Collection[Task], size: tuple[int, int] = (0, 0)) -> ImageRecord:
        """Return the labels of the tasks that are labelled; ``size`` is that of `ImageRecord`, with 0 for unknown."""
        return ImageRecord(
            name=name,
            image=image,
            objects=tuple(self.objects) if "detection" in tasks else None,
            drivable=tuple(self.areas) if "drivable" in tasks else None,
            lane=tuple(self.lanes) if "lane" in tasks else None,
            attributes=self.attributes,
            dropped=dict(self.dropped),
            size=size if all(size) else None,
        )


def _is_empty(record: ImageRecord) -> bool:
    """Return whether an image is labelled, and all of its labels are empty."""
    labels = [label for label in (record.objects, record.drivable, record.lane) if label is not None]
    return bool(labels) and not any(labels)


def read_mapping(path: str | Path | None) -> LabelMapping:
    """Read a mapping from YAML; None gives the defaults.

    Raises:
        ConfigError: If it is not YAML, or has an unknown key or a wrong value.
    """
    if path is None:
        return LabelMapping()
    return parse(LabelMapping, read_yaml(path), str(path))


def parse_colour(value: str | int) -> int | tuple[int, int, int]:
    """Return a grey level, or (red, green, blue), from ``7``, ``"7"``, ``"128, 64, 128"`` or ``"#804080"``.

    Raises:
        ConfigError: If it is none of these.
    """
    text = str(value).strip()
    if match := re.fullmatch(r"#([0-9a-fA-F]{2})([0-9a-fA-F]{2})([0-9a-fA-F]{2})", text):
        return (int(match[1], 16), int(match[2], 16), int(match[3], 16))
    parts = [part for part in re.split(r"[,\s]+", text.strip("()[]")) if part]
    try:
        numbers = [int(part) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) == 1 and 0 <= numbers[0] < 65536:
        return numbers[0]
    if len(numbers) == 3 and all(0 <= number < 256 for number in numbers):
        return (numbers[0], numbers[1], numbers[2])
    raise ConfigError(f"mask value {value!r} is neither a level (7) nor a colour ('128, 64, 128' or '#804080')")


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        DataError: If it is missing or broken.
    """
    try:
        return parse_json(path.read_bytes())
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise DataError(f"{path}: not JSON ({error})") from error


def hull(points: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return the left, top, right and bottom of (N, 2) points."""
    (left, top), (right, bottom) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return left, top, right, bottom


def visible(files: Iterable[Path]) -> list[Path]:
    """Return files sorted, without hidden ones: macOS puts a ``._labels.json``, which is none, beside each file."""
    return sorted(path for path in files if not path.name.startswith("."))


def find_image(name: str, folders: list[Path], taken: dict[Path, str]) -> Path | None:
    """Return the first of the folders' files with that name, or with its last part.

    A name without the ending of an image, as CVAT gives the frames of a video, is that of a file with any of them.

    Args:
        name: As it is listed.
        folders: Where to look, in this order.
        taken: Files that were found for other names, of any split -> the name; what is found is added.

    Raises:
        DataError: If the file was found for another name: one of the two has no picture.
    """
    place = _first_file(name, folders)
    if place is not None:
        first = taken.setdefault(place, name)
        if PurePosixPath(_posix(first)) != PurePosixPath(_posix(name)):
            raise DataError(f"{place}: is the only picture of both {first!r} and {name!r}; keep them in their folders")
    return place


def _posix(name: str) -> str:
    return name.replace("\\", "/")


def _first_file(name: str, folders: list[Path]) -> Path | None:
    posix = _posix(name)  # as written on Windows, whose archives may have made files of such names here
    endings = [""]
    if Path(name).suffix.lower() not in IMAGE_ENDINGS:
        endings += [*IMAGE_ENDINGS, *map(str.upper, IMAGE_ENDINGS)]
    for candidate in dict.fromkeys((name, posix, Path(posix).name)):
        for folder, ending in itertools.product(folders, endings):
            path = folder / f"{candidate}{ending}"
            with contextlib.suppress(OSError):  # a name that is too long is none of a file
                if path.is_file():
                    return path
    return None
