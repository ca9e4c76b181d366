"""``dataset.yaml``: what a data set in the published layout says of itself. The file is optional."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import yaml

from trilitenet.config import TASKS, Task, parse, plain, read_yaml
from trilitenet.errors import ConfigError, DataError, write_file

__all__ = [
    "DESCRIPTION_FILE",
    "VEHICLES",
    "DatasetDescription",
    "MaskMeaning",
    "class_table",
    "folder_name",
    "is_folder_name",
    "read_description",
    "write_description",
]

DESCRIPTION_FILE: Final = "dataset.yaml"

VEHICLES: Final = ("car", "truck", "bus", "train", "vehicle")
"""Categories that count as ``vehicle`` unless a table says otherwise (the published choice: car, truck, bus, train)."""


@dataclasses.dataclass(frozen=True)
class MaskMeaning:
    """What the values of a stored mask mean.

    Attributes:
        above: Values above this are foreground (the published rule: above 1).
        values: Names of the values, for readers: ``{255: "direct", 127: "alternative"}``.
        ignore: Values that are neither foreground nor background.
    """

    above: int = 1
    values: dict[int, str] = dataclasses.field(default_factory=dict)
    ignore: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if wrong := [value for value in (self.above, *self.values, *self.ignore) if not 0 <= value <= 255]:
            raise ConfigError(f"the values of a mask are 0 .. 255, got {', '.join(map(str, wrong))}")


@dataclasses.dataclass(frozen=True)
class DatasetDescription:
    """The content of ``dataset.yaml``.

    Attributes:
        name: What the data set is called.
        classes: Class name to the categories in the annotation files that belong to it, in the order of class ids.
        ignore: Categories whose boxes are neither object nor background, also where a class has them.
        splits: The splits there are; empty = whatever folders exist.
        tasks: Tasks that are labelled at all; the labels of others are left out.
        attributes: Names of the attributes each image carries.
        drivable: What the values of the drivable masks mean.
        lane: What the values of the lane masks mean.
        ego_mask: A mask (path from the data set's root) of the own car, non-zero = own car; one for all images.
        ego_masks: The same by camera: a prefix of the image's name to a mask's path.
        licence: Licence of the images and labels.
        source: Where it came from, in words.
    """

    name: str = ""
    classes: dict[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    ignore: tuple[str, ...] = ()
    splits: tuple[str, ...] = ()
    tasks: tuple[Task, ...] = TASKS
    attributes: tuple[str, ...] = ()
    drivable: MaskMeaning = MaskMeaning()
    lane: MaskMeaning = MaskMeaning()
    ego_mask: str | None = None
    ego_masks: dict[str, str] = dataclasses.field(default_factory=dict)
    licence: str = ""
    source: str = ""

    @property
    def class_names(self) -> tuple[str, ...]:
        """Class names in the order of their ids; ``("vehicle",)`` if the file names none."""
        return tuple(self.classes) or ("vehicle",)


def folder_name(path: str | Path) -> str:
    """Return what a folder is called, also by a path such as ``.`` that does not say it."""
    path = Path(path)
    return path.resolve().name if path.name in {"", ".."} else path.name


def is_folder_name(split: str) -> bool:
    """Return whether a split is the name of one folder: its files stay inside the data set's."""
    return Path(split).name == split and split not in {"", ".", ".."} and "\0" not in split


def class_table(
    class_names: Sequence[str], classes: Mapping[str, Sequence[str]] | None = None, root: Path | None = None
) -> dict[str, int]:
    """Return category -> class id.

    A class holds the categories that ``classes`` lists for it, else the category of its own name; ``vehicle`` alone
    also holds car, truck, bus and train.

    Raises:
        DataError: If one category belongs to two classes; it names the description in ``root`` if that lists them.
    """
    table: dict[str, int] = {}
    for index, name in enumerate(class_names):
        default = VEHICLES if name == "vehicle" else (name,)
        for category in (classes or {}).get(name, default):
            if table.setdefault(category, index) != index:
                where = "" if root is None else f"{root / DESCRIPTION_FILE if classes else root}: "
                first = class_names[table[category]]
                raise DataError(f"{where}category {category!r} belongs to both {first!r} and {name!r}")
    return table


def read_description(root: Path) -> DatasetDescription:
    """Read ``root/dataset.yaml``; without the file, return the defaults.

    Raises:
        DataError: If it is not YAML, or has an unknown key or a wrong value.
    """
    path = root / DESCRIPTION_FILE
    if not path.is_file():
        return DatasetDescription(name=folder_name(root))
    try:
        return parse(DatasetDescription, read_yaml(path), str(path))
    except ConfigError as error:
        raise DataError(str(error)) from error


def write_description(root: Path, description: DatasetDescription) -> None:
    """Write ``root/dataset.yaml``, without the keys that hold their default."""
    default = dataclasses.asdict(DatasetDescription())
    content = {key: value for key, value in dataclasses.asdict(description).items() if value != default[key]}
    text = yaml.safe_dump(plain(content), sort_keys=False, allow_unicode=True, width=120)
    write_file(root / DESCRIPTION_FILE, text)
