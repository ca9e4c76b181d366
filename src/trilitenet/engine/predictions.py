"""Predictions on disk, of any model: the form that `trilitenet score` reads and `trilitenet evaluate --save` writes.

    DIR/detections.json      COCO results: image_id = name of the image without ending, bbox = [left, top, width,
                             height] in pixels of the image as stored, score in [0, 1], category_id = 1, 2, ... in the
                             order of the classes (with one class: anything)
    DIR/classes.json         names of the classes in that order, ["car", "bus"]: may be left out; where it is there,
                             predictions of several classes are read with these alone
    DIR/drivable/NAME.png    above 0 = drivable, same size as the image
    DIR/lane/NAME.png        above 0 = lane marking, same size as the image

A part that is not there is a task that the model lacks. An image without an entry in ``detections.json`` has no boxes;
an image without a mask, where others have one, is an error.
"""

from __future__ import annotations

import array
import contextlib
import json
import logging
import re
import shlex
import shutil
from collections.abc import Iterator, Sequence, Set
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.config import TASKS, Task
from trilitenet.data.reading import decode_grey
from trilitenet.errors import DataError, OutputError, brief, part_of, write_file, writing
from trilitenet.structures import Boxes, Perception

__all__ = ["DETECTIONS_FILE", "PredictionWriter", "SavedPredictions", "saved_tasks"]

_LOGGER: Final = logging.getLogger(__name__)

DETECTIONS_FILE: Final = "detections.json"
_CLASSES_FILE: Final = "classes.json"


class PredictionWriter:
    """Write predictions as they come; a context manager.

    Args:
        folder: Made if need be; it must hold no predictions yet.
        tasks: The tasks to write.
        overwrite: Replace predictions that are there.

    Raises:
        OutputError: If the folder holds predictions, or cannot be written.
    """

    def __init__(self, folder: Path, tasks: Sequence[Task], *, overwrite: bool = False) -> None:
        self.folder = folder
        self._tasks = tuple(tasks)
        self._class_names: tuple[str, ...] = ()
        self._file: IO[str] | None = None
        self._first = True
        held = [name for name in (DETECTIONS_FILE, "drivable", "lane") if (folder / name).exists()]
        if held and not overwrite:
            raise OutputError(f"{folder}: holds {held[0]} already; give another folder or --overwrite")
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            # Another model's predictions would be taken for this one's.
            for name in (DETECTIONS_FILE, _CLASSES_FILE):
                (folder / name).unlink(missing_ok=True)
            for name in ("drivable", "lane"):
                if (folder / name).is_dir():
                    shutil.rmtree(folder / name)
            for task in self._tasks:
                if task != "detection":
                    (folder / task).mkdir(exist_ok=True)
            if "detection" in self._tasks:
                self._file = part_of(folder / DETECTIONS_FILE).open("w", encoding="utf-8")
                self._file.write("[")

    def __enter__(self) -> PredictionWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        elif self._file is not None:  # without its other images it would say that they are empty
            with contextlib.suppress(OSError):
                self._file.close()
            part_of(self.folder / DETECTIONS_FILE).unlink(missing_ok=True)
            self._file = None

    def write(self, name: str, prediction: Perception) -> None:
        """Add the prediction for an image.

        Raises:
            OutputError: If a file cannot be written.
        """
        if self._file is not None and prediction.boxes is not None:
            boxes = prediction.boxes
            self._class_names = prediction.class_names
            for box, score, number in zip(boxes.xyxy, boxes.confidence, boxes.class_id, strict=True):
                left, top, right, bottom = (float(value) for value in box)
                entry = {
                    "image_id": name,
                    "category_id": int(number) + 1,
                    "bbox": [round(value, 3) for value in (left, top, right - left, bottom - top)],
                    "score": float(f"{score:.7g}"),
                }
                with writing(self.folder / DETECTIONS_FILE):
                    self._file.write(("\n" if self._first else ",\n") + json.dumps(entry))
                self._first = False
        for task in self._tasks:
            mask: NDArray[np.bool_] | None = getattr(prediction, task, None) if task != "detection" else None
            if mask is not None:
                path = self.folder / task / f"{name}.png"
                encoded = cv2.imencode(".png", mask.astype(np.uint8) * 255)[1]
                with writing(path):
                    path.write_bytes(bytes(np.asarray(encoded, np.uint8)))

    def close(self) -> None:
        """Name the classes and finish ``detections.json``, which has its name from then on.

        Calling it twice is harmless.

        Raises:
            OutputError: If it cannot be written.
        """
        if self._file is not None:
            path = self.folder / DETECTIONS_FILE
            if self._class_names:
                write_file(self.folder / _CLASSES_FILE, json.dumps(self._class_names))
            with writing(path):
                with self._file as file:
                    self._file = None
                    file.write("\n]\n")
                part_of(path).replace(path)


def saved_tasks(folder: Path) -> tuple[Task, ...]:
    """Return the tasks that a folder holds predictions of.

    Raises:
        DataError: If there are none.
    """
    present = {
        "detection": (folder / DETECTIONS_FILE).is_file(),
        "drivable": (folder / "drivable").is_dir(),
        "lane": (folder / "lane").is_dir(),
    }
    if not any(present.values()):
        raise DataError(f"{folder}: no predictions; expected {DETECTIONS_FILE}, drivable/NAME.png or lane/NAME.png")
    return tuple(task for task in TASKS if present[task])


class SavedPredictions:
    """Predictions read from disk.

    Args:
        folder: In the form above.
        class_names: Detection classes, category 1 first.

    Raises:
        DataError: If there is nothing in the folder, a file has another form, or the boxes are of other classes.
    """

    def __init__(self, folder: Path, class_names: Sequence[str]) -> None:
        self.folder = folder
        self.class_names = tuple(class_names)
        self.tasks = saved_tasks(folder)
        self._boxes: dict[str, Boxes] = {}
        if "detection" in self.tasks:
            self._check_classes(folder / _CLASSES_FILE)
            self._boxes = self._read_detections(folder / DETECTIONS_FILE)

    @property
    def names(self) -> Set[str]:
        """Images that have boxes."""
        return self._boxes.keys()

    @property
    def lowest(self) -> float:
        """The least confidence of all boxes, 0 without any: those below it may have been cut off."""
        return min((float(boxes.confidence[-1]) for boxes in self._boxes.values()), default=0.0)

    def get(self, name: str, size: tuple[int, int], tasks: Sequence[Task] = TASKS) -> Perception:
        """Return the prediction for an image.

        Args:
            name: Of the image, without ending.
            size: (height, width) of the image.
            tasks: What of it is read; nothing is said of others.

        Raises:
            DataError: If a mask is missing, broken, of another size or of more than 8 bits a pixel.
        """
        present = set(tasks) & set(self.tasks)
        boxes = self._boxes.get(name, Boxes.empty()) if "detection" in present else None
        return Perception(
            size=size,
            class_names=self.class_names,
            boxes=boxes,
            drivable=self._mask("drivable", name, size) if "drivable" in present else None,
            lane=self._mask("lane", name, size) if "lane" in present else None,
        )

    def _mask(self, task: Task, name: str, size: tuple[int, int]) -> NDArray[np.bool_]:
        path = self.folder / task / f"{name}.png"
        if not path.is_file():
            raise DataError(f"{path}: missing; every image needs a mask (an empty one where nothing is predicted)")
        grey = decode_grey(np.fromfile(path, np.uint8), str(path))
        if grey is None:
            raise DataError(f"{path}: not an image that can be decoded")
        if grey.shape != size:
            raise DataError(f"{path}: {grey.shape[1]}x{grey.shape[0]}, the image is {size[1]}x{size[0]}")
        mask: NDArray[np.bool_] = grey > 0
        return mask

    def _check_classes(self, path: Path) -> None:
        """Refuse classes that the numbers do not stand for; with one, all boxes count as of it.

        Raises:
            DataError: If they are others or in another order, or the file has another form.
        """
        if len(self.class_names) == 1 or not path.is_file():
            return
        try:
            names = tuple(map(str, json.loads(path.read_bytes())))
        except (TypeError, ValueError, RecursionError) as error:
            raise DataError(f"{path}: not a JSON list of names: {brief(error)}") from error
        if names != self.class_names:
            raise DataError(
                f"{path}: the boxes are of the classes {', '.join(names)}, not {', '.join(self.class_names)}; give "
                f"--classes {shlex.join(names)}"
            )

    def _read_detections(self, path: Path) -> dict[str, Boxes]:
        numbers = array.array("d")  # an entry: image, left, top, right, bottom, score, class
        index: dict[str, int] = {}
        categories: set[int] = set()
        try:
            for entry in _entries(path.read_text(encoding="utf-8-sig")):  # editors put a mark before it
                left, top, width, height = (float(value) for value in entry["bbox"])
                category = int(entry["category_id"])
                categories.add(category)
                number = self._class(category, path)
                if not all(abs(value) < 1e9 for value in (left, top, width, height)):
                    raise DataError(f"{path}: a bbox must be four numbers of pixels, got {entry['bbox']}")
                if width < 0 or height < 0:
                    raise DataError(f"{path}: a bbox is left, top, width, height, got {entry['bbox']}")
                score = float(entry["score"])
                if not 0 <= score <= 1:
                    raise DataError(f"{path}: a score must be between 0 and 1, got {score}")
                image = index.setdefault(str(entry["image_id"]), len(index))
                numbers.extend((image, left, top, left + width, top + height, score, number))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            if isinstance(error, DataError):
                raise
            form = "a list of image_id, category_id, bbox, score"
            raise DataError(f"{path}: not COCO results ({form}): {brief(error)}") from error
        if len(self.class_names) == 1 < len(categories):
            _LOGGER.warning(
                "%s: boxes of %d categories count as %s alike; if they are classes, name them with --classes",
                path, len(categories), self.class_names[0],
            )  # fmt: skip
        table = np.frombuffer(numbers, np.float64).reshape(-1, 7) if numbers else np.zeros((0, 7))
        table = table[np.lexsort((-table[:, 5], table[:, 0]))]
        parts = np.split(table, np.flatnonzero(np.diff(table[:, 0])) + 1) if len(table) else []
        return {
            name: Boxes(part[:, 1:5].astype(np.float32), part[:, 5].astype(np.float32), part[:, 6].astype(np.int64))
            for name, part in zip(index, parts, strict=True)
        }

    def _class(self, category: int, path: Path) -> int:
        if len(self.class_names) == 1:
            return 0
        if not 1 <= category <= len(self.class_names):
            raise DataError(
                f"{path}: category_id {category} is not 1 to {len(self.class_names)} ({', '.join(self.class_names)})"
            )
        return category - 1


def _entries(text: str) -> Iterator[dict[str, Any]]:
    """Yield the members of a JSON list one at a time, so that millions of boxes never are as many dictionaries.

    Raises:
        ValueError: If it is not a JSON list, or is nested too deeply.
    """
    decoder = json.JSONDecoder()
    space = re.compile(r"\s*")

    def skip(at: int) -> int:
        return space.match(text, at).end()  # type: ignore[union-attr]

    at = skip(0)
    if text[at : at + 1] != "[":
        raise ValueError("no list")
    at = skip(at + 1)
    more = text[at : at + 1] != "]"
    while more:
        try:
            entry, at = decoder.raw_decode(text, at)
        except RecursionError as error:
            raise ValueError("nested too deeply") from error
        yield entry
        at = skip(at)
        more = text[at : at + 1] == ","
        if more:
            at = skip(at + 1)
    if text[at : at + 1] != "]" or skip(at + 1) < len(text):
        raise ValueError(f"not one JSON list, at character {at}")
