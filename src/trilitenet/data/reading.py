"""Reading the published layout.

    ROOT/images/{split}/NAME.jpg
    ROOT/det_annotations/{split}/NAME.json        BDD100K's old per-image form
    ROOT/da_seg_annotations/{split}/NAME.png      drivable area, above 1 = drivable
    ROOT/ll_seg_annotations/{split}/NAME.png      lane marking, above 1 = marking
    ROOT/dataset.yaml                             optional: classes, mask values, ego mask, licence
    ROOT/index.csv                                optional: name, split and further columns, which become attributes

A missing annotation file means 'not labelled' for that image and task. Objects with ``attributes.crowd: true`` are
ignored regions.
"""

from __future__ import annotations

import csv
import functools
import hashlib
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.config import Task, parse_json
from trilitenet.data.description import DatasetDescription, MaskMeaning, class_table, read_description
from trilitenet.data.sample import Sample
from trilitenet.errors import DataError, brief, did_you_mean, few
from trilitenet.processing.addresses import as_address

__all__ = [
    "FOLDERS",
    "IMAGE_ENDINGS",
    "IMAGE_FOLDER",
    "LABEL_FILES",
    "PREPARED_FILE",
    "UNDEFINED",
    "DrivingDataset",
    "MixedDataset",
    "SampleSource",
    "check_root",
    "decode",
    "decode_grey",
    "decode_image",
    "decode_mask",
    "is_crowd",
    "is_image_file",
    "label_file",
    "parse_annotation",
    "parse_attributes",
    "read_index",
    "sampling_weights",
    "split_folders",
]

_LOGGER: Final = logging.getLogger(__name__)

IMAGE_FOLDER: Final = "images"
PREPARED_FILE: Final = "prepared.json"
"""Of a copy made for training, which is read by `trilitenet.data.prepared`."""
UNDEFINED: Final = "undefined"
"""What the check and the evaluation call the value of an attribute that an image does not have."""
LABEL_FILES: Final[dict[Task, tuple[str, str]]] = {
    "detection": ("det_annotations", ".json"),
    "drivable": ("da_seg_annotations", ".png"),
    "lane": ("ll_seg_annotations", ".png"),
}
"""Folder and file ending of a task's labels."""
FOLDERS: Final = (IMAGE_FOLDER, *(folder for folder, _ in LABEL_FILES.values()))
IMAGE_ENDINGS: Final = (".jpg", ".jpeg", ".png", ".bmp", ".webp")

_IGNORED: Final = 2

_READ_RGB: Final[int | None] = getattr(cv2, "IMREAD_COLOR_RGB", None)
"""Decode to RGB at once, which OpenCV can from 4.11 on."""


class SampleSource(Protocol):
    """Anything that samples can be taken from by index."""

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names that ``Sample.class_id`` indexes."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Sample: ...

    def attributes(self, index: int) -> dict[str, str]:
        """Return the attributes of a sample without decoding its image."""


def is_image_file(name: str) -> bool:
    """Return whether a file's name is one of an image; hidden ones, such as ``._0001.jpg`` of macOS, are none."""
    return not name.startswith(".") and name.lower().endswith(IMAGE_ENDINGS)


def check_root(root: Path) -> None:
    """Check that the folder of a data set is there.

    Raises:
        DataError: If it is not, or is a file or an address.
    """
    if not root.is_dir():
        if address := as_address(root):
            raise DataError(f"{address}: is an address; give a folder on this machine")
        raise DataError(f"{root}: {'is a file, not the folder of a data set' if root.exists() else 'no such folder'}")


def split_folders(root: Path, top: str = IMAGE_FOLDER) -> list[Path]:
    """Return the folders, one a split, of a data set's images (or of ``top``), sorted; hidden ones are passed over."""
    folder = root / top
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))


def label_file(task: Task, split: str, name: str) -> str:
    """Return where an image's labels of a task are, from the root of the data set."""
    folder, ending = LABEL_FILES[task]
    return f"{folder}/{split}/{name}{ending}"


def decode_image(data: bytes | NDArray[np.uint8], name: str) -> NDArray[np.uint8]:
    """Decode an encoded image (orientation tag applied) into (H, W, 3) uint8 RGB.

    Raises:
        DataError: If it is not an image, or a broken one.
    """
    buffer = np.frombuffer(data, np.uint8) if isinstance(data, bytes) else data
    image = decode(buffer, _READ_RGB or cv2.IMREAD_COLOR)
    if image is None:
        raise DataError(f"{name}: not an image that can be decoded; run `trilitenet data check` on the data set")
    return np.asarray(image if _READ_RGB else cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image), np.uint8)


def decode(buffer: NDArray[np.uint8], mode: int) -> NDArray[Any] | None:
    """Decode an encoded image by OpenCV, in one of its modes; None if it cannot be read.

    OpenCV itself returns None for most of what it cannot read, but refuses absurd sizes by an error.
    """
    try:
        return cv2.imdecode(buffer, mode) if len(buffer) else None
    except cv2.error:
        return None


def decode_grey(buffer: NDArray[np.uint8], name: str) -> NDArray[np.uint8] | None:
    """Decode an encoded image to (H, W) uint8 grey; None if it cannot be read.

    Raises:
        DataError: If it has more than 8 bits a pixel, which OpenCV would divide, so that 1 to 255 became 0.
    """
    grey = decode(buffer, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if grey is not None and grey.dtype != np.uint8:
        raise DataError(f"{name}: has {8 * grey.dtype.itemsize} bits a pixel; save it with 8")
    return grey


def decode_mask(
    data: bytes | NDArray[np.uint8], name: str, meaning: MaskMeaning
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Decode an encoded mask into (H, W) uint8 {0, 1} and, if it has ignored values, where it is valid.

    Raises:
        DataError: If it is not an image, a broken one, or one of more than 8 bits a pixel.
    """
    buffer = np.frombuffer(data, np.uint8) if isinstance(data, bytes) else data
    grey = decode_grey(buffer, name)
    if grey is None:
        raise DataError(f"{name}: not a mask that can be decoded; run `trilitenet data check` on the data set")
    if not meaning.ignore:
        return cv2.threshold(grey, meaning.above, 1, cv2.THRESH_BINARY)[1], None
    table = (np.arange(256) > meaning.above).astype(np.uint8)
    table[list(meaning.ignore)] = _IGNORED
    mask = cv2.LUT(grey, table)
    valid = mask != _IGNORED
    if valid.all():
        return mask, None
    mask[~valid] = 0
    return mask, valid


def parse_annotation(
    content: Any, table: Mapping[str, int], ignore: Sequence[str], size: tuple[int, int], name: str
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32], dict[str, str]]:
    """Take boxes and attributes from an annotation in BDD100K's old per-image form.

    Args:
        content: The parsed JSON.
        table: Category -> class id; other categories are left out.
        ignore: Categories that are ignored regions, whether or not the table has them.
        size: (height, width) of the image; boxes are clipped to it and dropped when nothing is left.
        name: For messages.

    Returns:
        (N, 4) boxes, (N,) class ids, (M, 4) ignored boxes, the image's attributes.

    Raises:
        DataError: If it has another form.
    """
    boxes: list[tuple[float, float, float, float]] = []
    class_id: list[int] = []
    ignored: list[tuple[float, float, float, float]] = []
    height, width = size
    try:
        for frame in content["frames"]:
            for item in frame.get("objects") or ():
                category = str(item["category"])
                box = item.get("box2d")
                if box is None:
                    continue
                crowd = category in ignore or (is_crowd(item) and category in table)
                if not crowd and category not in table:
                    continue
                x1, y1 = max(float(box["x1"]), 0.0), max(float(box["y1"]), 0.0)
                x2, y2 = min(float(box["x2"]), float(width)), min(float(box["y2"]), float(height))
                if not (x2 > x1 and y2 > y1):
                    continue
                if crowd:
                    ignored.append((x1, y1, x2, y2))
                else:
                    boxes.append((x1, y1, x2, y2))
                    class_id.append(table[category])
        attributes = parse_attributes(content)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(f"{name}: not an annotation in the per-image form ({brief(error)})") from error
    return (
        np.array(boxes, np.float32).reshape(-1, 4),
        np.array(class_id, np.int64),
        np.array(ignored, np.float32).reshape(-1, 4),
        attributes,
    )


def parse_attributes(content: Mapping[str, Any]) -> dict[str, str]:
    """Return the attributes of an annotation as text; one whose value is null is not stated."""
    return {str(key): str(value) for key, value in (content.get("attributes") or {}).items() if value is not None}


def is_crowd(item: Mapping[str, Any]) -> bool:
    """Return whether an object of an annotation is marked as a crowd; tools that know text alone write ``"false"``."""
    crowd = (item.get("attributes") or {}).get("crowd")
    if isinstance(crowd, str):
        return crowd.strip().lower() not in {"", "0", "0.0", "false", "no", "none"}
    return bool(crowd)


class DrivingDataset:
    """One split of a data set in the published layout.

    Args:
        root: The folder that holds ``images`` and the annotation folders.
        split: A folder name under each of them.
        class_names: Detection classes in the order of their ids; those of ``dataset.yaml``, else ``("vehicle",)``.
        classes: Class name -> categories in the files; that of ``dataset.yaml``, else see `class_table`.
        tasks: Read the labels of these alone; those of ``dataset.yaml``.
        names: Keep only these images, in this order.

    Raises:
        DataError: If the split has no images.
    """

    def __init__(
        self,
        root: str | Path,
        split: str,
        *,
        class_names: Sequence[str] | None = None,
        classes: Mapping[str, Sequence[str]] | None = None,
        tasks: Sequence[Task] | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        self.root = Path(root)
        self.split = split
        self.description: DatasetDescription = read_description(self.root)
        self._class_names = tuple(class_names or self.description.class_names)
        self._table = class_table(self._class_names, classes or self.description.classes, self.root)
        self._tasks = tuple(tasks if tasks is not None else self.description.tasks)
        self._files = _image_files(self.root, split)
        if names is None:
            self.names: list[str] = sorted(self._files)
        else:
            missing = [name for name in names if name not in self._files]
            if missing:
                raise DataError(f"{self.root}: no image {missing[0]!r} in split {split!r}")
            self.names = list(names)
        self._extra = _index_attributes(self.root, split)

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names that ``Sample.class_id`` indexes."""
        return self._class_names

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[Sample]:
        return (self[index] for index in range(len(self)))

    def image_path(self, index: int) -> Path:
        """Return the path of an image."""
        return self.root / IMAGE_FOLDER / self.split / self._files[self.names[index]]

    def attributes(self, index: int) -> dict[str, str]:
        """Return the attributes of an image without decoding it."""
        name = self.names[index]
        content = self._annotation(name)
        try:
            own = parse_attributes(content) if isinstance(content, dict) else {}
        except AttributeError as error:
            path = self.label_path("detection", name)
            raise DataError(f"{path}: not an annotation in the per-image form (attributes are no object)") from error
        return own | self._extra.get(name, {})

    def label_path(self, task: Task, name: str) -> Path:
        """Return where an image's labels of a task are, if it has any."""
        return self.root / label_file(task, self.split, name)

    def has_labels(self, task: Task) -> bool:
        """Return whether an image is labelled for a task; looks up to the first."""
        return task in self._tasks and any(self.label_path(task, name).is_file() for name in self.names)

    def meaning(self, task: Task) -> str:
        """Return, as text to compare, what the values in a task's labels mean."""
        about = self.description
        own: tuple[object, ...] = (about.drivable if task == "drivable" else about.lane,)
        if task == "detection":
            own = (self._table, about.ignore)
        return repr((task in self._tasks, *own, about.ego_mask, sorted(about.ego_masks.items())))

    def fingerprint(self, index: int) -> str:
        """Return a hash of a sample's files and of what their values mean; files that are missing are left out."""
        name, about = self.names[index], self.description
        meaning = (self._table, about.ignore, self._tasks, about.drivable, about.lane)
        digest = hashlib.sha256(repr(meaning).encode())
        files = [self.image_path(index), *(self.label_path(task, name) for task in LABEL_FILES)]
        files += filter(None, [self._ego_path(name)])
        for path in files:
            data = _bytes_of(path)
            digest.update(b"-" if data is None else hashlib.sha256(data.tobytes()).digest())
        return digest.hexdigest()[:16]

    def classes_without_boxes(self, progress: Callable[[int, int], None] | None = None) -> tuple[list[str], set[str]]:
        """Return the classes that no box is of, and the categories of the boxes; reads up to the first of each class.

        Without any box both are empty. ``progress`` is called with (annotations looked at, images).
        """
        without, found = dict(enumerate(self._class_names)), set[str]()
        for done, name in enumerate(self.names if "detection" in self._tasks else (), start=1):
            categories = self._categories(name)
            found |= categories
            for category in categories & self._table.keys():
                without.pop(self._table[category], None)
            if progress:
                progress(done if without else len(self), len(self))
            if not without:
                break
        return list(without.values()) if found else [], found

    def _categories(self, name: str) -> set[str]:
        """Return the categories of an image's boxes."""
        content = self._annotation(name)
        try:
            items = [item for frame in content["frames"] for item in frame.get("objects") or ()]
            return {str(item["category"]) for item in items if item.get("box2d") is not None}
        except (KeyError, TypeError, AttributeError):  # none, or a broken one, which is told when the sample is read
            return set()

    def classes_left_out(self) -> list[str]:
        """Return the classes of ``dataset.yaml`` whose boxes are all read as background."""
        return [name for name, own in self.description.classes.items() if self._table.keys().isdisjoint(own)]

    def warn_of_foreign(self, progress: Callable[[int, int], None] | None = None) -> None:
        """Warn of classes that no box is of, where boxes are of categories that mean nothing.

        ``progress`` is called with (annotations looked at, images).
        """
        without, found = self.classes_without_boxes(progress)
        foreign = sorted(found - self._table.keys() - set(self.description.ignore))
        if without and foreign:
            _LOGGER.warning(
                "no box of %s is of the class %s, and those of %s are of none; say under classes: in dataset.yaml "
                "which categories make up a class",
                self.root,
                ", ".join(without),
                few(foreign, most=10),
            )

    def __getitem__(self, index: int) -> Sample:
        """Read a sample.

        Raises:
            DataError: If a file is broken or cannot be read, or a mask has another size than its image.
        """
        name = self.names[index]
        path = self.image_path(index)
        data = _bytes_of(path)
        if data is None:
            raise DataError(f"{path}: the image is not there any more; run `trilitenet data check` on the data set")
        image = decode_image(data, str(path))
        size = image.shape[:2]
        boxes = class_id = None
        ignored = np.zeros((0, 4), np.float32)
        attributes: dict[str, str] = {}
        content = self._annotation(name)
        if content is not None:
            labelled = "detection" in self._tasks
            table, ignore = (self._table, self.description.ignore) if labelled else ({}, ())
            boxes, class_id, ignored, attributes = parse_annotation(
                content, table, ignore, size, str(self.label_path("detection", name))
            )
            if not labelled:
                boxes = class_id = None
        drivable, drivable_valid = self._mask("drivable", name, size)
        lane, lane_valid = self._mask("lane", name, size)
        return Sample(
            name=name,
            image=image,
            boxes=boxes,
            class_id=class_id,
            ignored=ignored,
            drivable=drivable,
            lane=lane,
            valid=self._ego(name, size),
            drivable_valid=drivable_valid,
            lane_valid=lane_valid,
            attributes=attributes | self._extra.get(name, {}),
        )

    def _annotation(self, name: str) -> Any:
        path = self.label_path("detection", name)
        data = _bytes_of(path)
        if data is None:
            return None
        try:
            return parse_json(data.tobytes())
        except ValueError as error:
            raise DataError(f"{path}: not JSON ({error})") from error

    def _mask(
        self, task: Task, name: str, size: tuple[int, int]
    ) -> tuple[NDArray[np.uint8] | None, NDArray[np.bool_] | None]:
        if task not in self._tasks:
            return None, None
        meaning = self.description.drivable if task == "drivable" else self.description.lane
        path = self.label_path(task, name)
        data = _bytes_of(path)
        if data is None:
            return None, None
        mask, valid = decode_mask(data, str(path), meaning)
        if mask.shape != size:
            raise DataError(f"{path}: mask of {mask.shape[1]}x{mask.shape[0]} for an image of {size[1]}x{size[0]}")
        return mask, valid

    def _ego_path(self, name: str) -> Path | None:
        masks = self.description.ego_masks
        path = next((masks[prefix] for prefix in sorted(masks, key=len, reverse=True) if name.startswith(prefix)), None)
        path = path or self.description.ego_mask
        return None if path is None else self.root / path

    def _ego(self, name: str, size: tuple[int, int]) -> NDArray[np.bool_] | None:
        path = self._ego_path(name)
        return None if path is None else _ego_mask(path, size)


class MixedDataset:
    """Several data sets as one.

    Args:
        parts: (data set, weight) pairs. A weight multiplies how often each of that data set's samples is drawn; all
            equal = every sample once an epoch.

    Raises:
        DataError: If there is none, a weight is not positive and finite, or the class names differ.
    """

    def __init__(self, parts: Sequence[tuple[SampleSource, float]]) -> None:
        if not parts:
            raise DataError("at least one data set is needed")
        names = parts[0][0].class_names
        for dataset, weight in parts:
            if not 0 < weight < math.inf:
                raise DataError(f"a data set's weight must be above 0 and finite, got {weight}")
            if dataset.class_names != names:
                raise DataError(
                    f"data sets with different classes, {names} and {dataset.class_names}; give both the same `classes`"
                )
        self.parts = list(parts)
        self._ends = np.cumsum([len(dataset) for dataset, _ in parts])

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names that ``Sample.class_id`` indexes."""
        return self.parts[0][0].class_names

    @property
    def weights(self) -> NDArray[np.float64]:
        """(N,) float64: the weight of each sample, by those within a part that is mixed itself."""
        return np.concatenate([weight * _weights_within(dataset) for dataset, weight in self.parts])

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, index: int) -> Sample:
        dataset, inner = self._find(index)
        return dataset[inner]

    def attributes(self, index: int) -> dict[str, str]:
        """Return the attributes of a sample without decoding its image."""
        dataset, inner = self._find(index)
        return dataset.attributes(inner)

    def _find(self, index: int) -> tuple[SampleSource, int]:
        if not 0 <= index < len(self):
            raise IndexError(index)
        part = int(np.searchsorted(self._ends, index, side="right"))
        return self.parts[part][0], index - (int(self._ends[part - 1]) if part else 0)


def _weights_within(dataset: SampleSource) -> NDArray[np.float64]:
    """Return (N,) float64: how often each of a data set's samples is drawn against the others."""
    return dataset.weights if isinstance(dataset, MixedDataset) else np.ones(len(dataset), np.float64)


def sampling_weights(
    dataset: SampleSource,
    table: Mapping[str, Mapping[str, float]],
    progress: Callable[[int, int], None] | None = None,
) -> NDArray[np.float64]:
    """Return how often each sample is to be drawn, from its attributes.

    Args:
        dataset: Any source of samples; the weights of a `MixedDataset` are multiplied in.
        table: Attribute -> value -> factor, for example ``{"timeofday": {"night": 2.0}, "source": {"dull": 0.5}}``.
            Values not listed count 1, and the factors of several attributes multiply. 0 leaves a sample out. That of
            a sample without the attribute is `UNDEFINED`, or empty.
        progress: Called with (samples whose attributes are read, samples in all).

    Returns:
        (N,) float64, relative weights.

    Raises:
        DataError: If a factor is negative or infinite, or all weights are 0.
    """
    weights = _weights_within(dataset)
    for attribute, factors in table.items():
        for value, factor in factors.items():
            if not 0 <= factor < math.inf:
                raise DataError(f"sampling weight of {attribute}={value} must be finite and not negative, got {factor}")
    if table:
        known: dict[str, set[str]] = {}
        missed: dict[str, set[str]] = {}  # attribute -> what the samples without it are called
        for index in range(len(dataset)):
            attributes = dataset.attributes(index)
            for attribute, value in attributes.items():
                known.setdefault(attribute, set()).add(value)
            for attribute, factors in table.items():
                value = attributes.get(attribute, "")
                if not value:
                    missed[attribute] = {"", UNDEFINED}
                    value = UNDEFINED if UNDEFINED in factors else ""
                weights[index] *= factors.get(value, 1.0)
            if progress:
                progress(index + 1, len(dataset))
        for attribute, factors in table.items():
            if attribute not in known:
                hint = did_you_mean(attribute, known)
                _LOGGER.warning("no image has the attribute %r to sample by%s", attribute, hint)
                continue
            for value in sorted(factors.keys() - known[attribute] - missed.get(attribute, {""})):
                hint = did_you_mean(value, known[attribute])
                _LOGGER.warning("no image has the %s %r to sample by%s", attribute, value, hint)
    if not weights.any():
        raise DataError("every sampling weight is 0")
    return weights


def _bytes_of(path: Path) -> NDArray[np.uint8] | None:
    """Return a file's content; None if there is no such file.

    Raises:
        DataError: If it is there and cannot be read.
    """
    try:
        return np.fromfile(path, np.uint8)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from error


def _image_files(root: Path, split: str) -> dict[str, str]:
    """Return image name -> file name of a split."""
    folder = root / IMAGE_FOLDER / split
    if not folder.is_dir():
        check_root(root)
        if (root / PREPARED_FILE).is_file():
            raise DataError(f"{root}: a prepared copy, for training alone; name the data set it was made from")
        splits = few([path.name for path in split_folders(root)])
        cure = f"its splits: {splits}" if splits else "expected the published layout, see docs/data.md"
        raise DataError(f"{root}: no folder {IMAGE_FOLDER}/{split}; {cure}")
    files: dict[str, str] = {}
    for file in sorted(path.name for path in folder.iterdir()):  # as text, which is many times as fast
        if not is_image_file(file):
            continue
        name = file.rpartition(".")[0]
        if name in files:
            raise DataError(f"{folder}: {files[name]} and {file} would have the same labels; remove or rename one")
        files[name] = file
    if not files:
        raise DataError(f"{folder}: no images ({', '.join(IMAGE_ENDINGS)})")
    return files


def _index_attributes(root: Path, split: str) -> dict[str, dict[str, str]]:
    """Return image name -> the further columns of ``index.csv``, if there is one."""
    return {
        row["name"]: {column: row[column] or "" for column in sorted(row) if column not in {"name", "split"}}
        for row in read_index(root)
        if row["split"] == split
    }


def read_index(root: Path) -> list[dict[str, Any]]:
    """Return the rows of ``index.csv``; none if there is no such file.

    Raises:
        DataError: If it has no columns ``name`` and ``split``, or is not UTF-8.
    """
    path = root / "index.csv"
    if not path.is_file():
        return []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets put a mark before the first column
            reader = csv.DictReader(file, restval="")
            columns = list(reader.fieldnames or ())
            rows = list(reader)
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: cannot be read as CSV in UTF-8 ({brief(error)})") from error
    if not {"name", "split"} <= set(columns):
        held = few(columns or ["none"], most=10)
        raise DataError(f"{path}: needs the columns 'name' and 'split', separated by commas; its columns: {held}")
    return [{column: row[column] for column in columns} for row in rows]


def _ego_mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Return where an image of ``size`` is valid, from a mask of the own car of any size."""
    try:
        return _read_ego_mask(path, path.stat().st_mtime_ns, size)
    except (OSError, ValueError) as error:  # the latter of a path that no system has
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path}: the ego mask that dataset.yaml names cannot be read") from error


@functools.lru_cache(maxsize=64)
def _read_ego_mask(path: Path, changed: int, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Read it; the time of its last change tells it from one that was there before."""
    del changed
    data = np.fromfile(path, np.uint8)
    own, _ = decode_mask(data, str(path), MaskMeaning(above=0))
    if own.shape != size:
        own = cv2.resize(own, (size[1], size[0]), interpolation=cv2.INTER_NEAREST)
    valid: NDArray[np.bool_] = own == 0
    valid.setflags(write=False)
    return valid
