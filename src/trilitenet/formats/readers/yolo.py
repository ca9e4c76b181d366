"""YOLO's label files: a text file an image, a line an object, and a ``data.yaml`` with names and folders.

Format: https://docs.ultralytics.com/datasets/detect/ (``class cx cy w h``, all in [0, 1]; a sixth number is a
confidence) and https://docs.ultralytics.com/datasets/segment/ (``class x1 y1 x2 y2 x3 y3 ...``).
Of key points (``kpt_shape`` in ``data.yaml``) the boxes are read.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from trilitenet.config import Task, read_yaml
from trilitenet.data.reading import check_root, is_image_file
from trilitenet.data.records import AreaLabel, ImageRecord, LaneLabel, ObjectLabel, image_size, name_apart, same_name
from trilitenet.errors import ConfigError, DataError, brief, few
from trilitenet.formats.readers.mapping import LabelMapping, Labels, hull, visible

__all__ = ["YoloSource", "read_yolo"]

_BEYOND: Final = 2.0
"""A coordinate that is larger is none in [0, 1] that lies a little outside of the image."""


class YoloSource:
    """A YOLO data set as a `RecordSource`; made by `read_yolo`.

    Attributes:
        found: One line for each split, for the user.
    """

    def __init__(
        self,
        root: Path,
        images: dict[str, dict[str, Path]],
        names: dict[int, str],
        mapping: LabelMapping,
        found: tuple[str, ...],
        *,
        key_points: bool,
    ) -> None:
        self.origin = mapping.origin("yolo", root)
        self._images = images
        self._names = names
        self._mapping = mapping
        self._key_points = key_points
        self._tasks: set[Task] = mapping.labelled(set(names.values()))
        self.found = found

    @property
    def splits(self) -> tuple[str, ...]:
        """The splits there are."""
        return tuple(self._images)

    def names(self, split: str) -> list[str]:
        """Return the names of a split's images, sorted."""
        return sorted(self._images[split])

    def record(self, split: str, name: str) -> ImageRecord:
        """Read one image's labels.

        Raises:
            DataError: If the label file is broken.
        """
        image = self._images[split][name]
        path = _label_path(image)
        if not path.is_file() and self._mapping.missing != "empty":
            return ImageRecord(name, image)
        text = _read_text(path) if path.is_file() else ""
        return self._parse(text, path, image).record(name, image, self._tasks)

    def _parse(self, text: str, path: Path, image: Path) -> Labels:
        labels = Labels()
        lines = [(number, line.split()) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
        size = image_size(image) if lines else (0, 0)
        scale = np.array([size[1], size[0]], np.float64)
        for number, words in lines:
            try:
                category = self._names.get(int(float(words[0])), words[0])
                values = np.array([float(word) for word in words[1:]])
            except (ValueError, OverflowError) as error:
                raise DataError(f"{path}, line {number}: not numbers ({error})") from error
            if self._key_points:  # which follow the box
                values = values[:4]
            coordinates = values[:4] if len(values) in (4, 5) else values
            wrong = coordinates[~(np.abs(coordinates) <= _BEYOND)]  # what is no number, too
            if len(wrong):
                raise DataError(
                    f"{path}, line {number}: {wrong[0]:g} is no coordinate in [0, 1]; "
                    "divide pixels by the image's size, and leave the numbers of tracks out"
                )
            if len(values) in (4, 5):
                centre, extent = values[:2] * scale, values[2:4] * scale
                x1, y1, x2, y2 = (float(v) for v in (*(centre - extent / 2), *(centre + extent / 2)))
                labels.objects.append(ObjectLabel(category, (x1, y1, x2, y2)))
                continue
            if len(values) < 6 or len(values) % 2:
                raise DataError(f"{path}, line {number}: neither a box (4 numbers) nor a polygon (6 or more, even)")
            points = values.reshape(-1, 2) * scale
            kind = self._mapping.area_kind(category)
            if category in self._mapping.lane:
                labels.lanes.append(LaneLabel(category, points, closed=True))
            else:
                labels.add(AreaLabel(kind or "direct", points), ObjectLabel(category, hull(points)), kind)
        return labels


def read_yolo(root: str | Path, mapping: LabelMapping | None = None) -> YoloSource:
    """Read a data set with YOLO labels.

    Args:
        root: The folder with ``data.yaml`` (or any one ``.yaml`` with ``names``), or that file.
        mapping: What the class names mean.

    Raises:
        DataError: If there is no such file, or no images where it says; or if the class names mean nothing.
    """
    mapping = mapping or LabelMapping()
    path = _find_yaml(Path(root))
    try:
        content = read_yaml(path)
    except ConfigError as error:
        raise DataError(str(error)) from error
    try:
        names: Any = content["names"]
        table = dict(enumerate(names)) if isinstance(names, list) else {int(key): value for key, value in names.items()}
        base = path.parent / str(content.get("path") or ".")
        if not base.is_dir():
            base = path.parent
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise DataError(f"{path}: not a YOLO data file ({brief(error)})") from error
    listed: dict[str, list[Path]] = defaultdict(list)
    missing: dict[str, list[Path]] = defaultdict(list)
    looked: dict[Path, None] = {}
    for key, split in (("train", "train"), ("val", "val"), ("valid", "val"), ("test", "test")):
        places = content.get(key)
        if not places:
            continue
        for place in places if isinstance(places, list) else [places]:
            candidates = _candidates(base, path.parent, str(place))
            looked |= dict.fromkeys(root / part for root, part in candidates)
            for image in _images_at(candidates):
                (listed if image.is_file() else missing)[split].append(image)
    if content.get("train") == content.get("val"):
        listed.pop("val", None)
    images: dict[str, dict[str, Path]] = defaultdict(dict)
    for split, paths in listed.items():
        for image, name in name_apart(paths).items():
            if images[split].setdefault(name, image) != image:
                raise same_name(name, split, images[split][name], image)
    if not images:
        words = f"looked in {', '.join(map(str, looked))}" if looked else "it names no folder as train, val or test"
        if missing:
            words += f"; listed and not there: {few([str(image) for paths in missing.values() for image in paths])}"
        raise DataError(f"{path}: no images; {words}")
    table = {key: str(value) for key, value in table.items()}
    mapping.check_categories(set(table.values()), path)
    found = [f"{split}: {len(items)} images" for split, items in images.items()]
    found += [
        f"{split}: {len(paths)} listed images are not there, such as {paths[0]}" for split, paths in missing.items()
    ]
    labels = {_label_path(image): image for items in images.values() for image in items.values()}
    folders = {path.parent for path, image in labels.items() if path.parent != image.parent}
    stray = {
        path for folder in folders for path in visible(folder.glob("*.txt")) if path.name != "classes.txt"
    } - labels.keys()
    if stray:
        found.append(f"{len(stray)} label files are of no image in a split, such as {min(stray)}")
    return YoloSource(path, dict(images), table, mapping, tuple(found), key_points=bool(content.get("kpt_shape")))


def _find_yaml(root: Path) -> Path:
    if root.is_file():
        return root
    for path in [root / "data.yaml", *visible(root.glob("*.y*ml"))]:
        if path.is_file() and "names" in _read_text(path):
            return path
    check_root(root)
    raise DataError(f"{root}: no data.yaml with 'names'")


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")  # editors put a mark before the first line
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not text in UTF-8 ({brief(error)}); save it as such") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error


def _candidates(base: Path, beside: Path, place: str) -> list[tuple[Path, str]]:
    """Return (folder, place in it) where images may be; Roboflow writes ``../train/images`` of what lies beside."""
    return [(root, part) for part in dict.fromkeys((place, place.removeprefix("../"))) for root in (base, beside)]


def _images_at(candidates: list[tuple[Path, str]]) -> list[Path]:
    """Return the images in the first folder that is there, or those that a list names, whether they are or not."""
    for root, part in candidates:
        folder = root / part
        if folder.is_dir():
            return sorted(path for path in folder.rglob("*") if is_image_file(path.name))
        if folder.suffix == ".txt" and folder.is_file():
            return [root / line.strip() for line in _read_text(folder).splitlines() if line.strip()]
    return []


def _label_path(image: Path) -> Path:
    """Return the label file: ``labels`` instead of the last ``images`` in the path, else beside the image."""
    parts = list(image.parts)
    for index in range(len(parts) - 2, -1, -1):
        if parts[index] == "images":
            parts[index] = "labels"
            break
    return Path(*parts).with_suffix(".txt")
