"""YOLO's label files: a text file an image, a line a box: class, centre x, centre y, width, height, all in [0, 1].

Format: https://docs.ultralytics.com/datasets/detect/. Only boxes have a place in it.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from trilitenet.errors import writing
from trilitenet.formats.writers.base import Writer
from trilitenet.processing.boxes import xyxy_to_cxcywh
from trilitenet.structures import Perception

__all__ = ["YoloWriter"]


class YoloWriter(Writer):
    """Writes ``labels/NAME.txt`` for each image, and one ``data.yaml`` with the class names.

    Args:
        output: The folder; the images belong into ``images`` beside ``labels``.
        overwrite: Replace files that exist.
        confidence: Add the confidence as a sixth column, as YOLO's own predictions can have; tools that read labels
            take five.
    """

    FILES = ("data.yaml",)
    GATHERS = False
    PICTURE_FILES = ("labels/{}.txt",)
    VIDEO_FILES = ("labels/{}-*.txt",)

    def __init__(self, output: Path, *, overwrite: bool = False, confidence: bool = False) -> None:
        super().__init__(output, overwrite=overwrite)
        self.confidence = confidence
        self._class_names: tuple[str, ...] | None = None
        self._remains: dict[str, set[Path]] = defaultdict(set)
        self._replaced: set[str] = set()
        if overwrite:
            for path in (output / "labels").glob("*.txt"):
                if video := _video_of(path):
                    self._remains[video].add(path)
        self._data = self.create("data.yaml")

    def _write(self, perception: Perception, road: Mapping[str, Any] | None = None) -> None:
        """Write the label file of one image: an empty one without boxes, none where they were not looked for."""
        if perception.boxes is None:
            return
        number = "" if perception.frame is None else f"-{perception.frame:07d}"
        path = self.create(f"labels/{self.stem(perception.source)}{number}.txt")
        lines = []
        height, width = perception.size
        boxes = xyxy_to_cxcywh(perception.boxes.xyxy) / np.array([width, height, width, height], np.float32)
        for box, class_id, score in zip(boxes, perception.boxes.class_id, perception.boxes.confidence, strict=True):
            values = " ".join(f"{value:.6f}" for value in box)
            lines.append(f"{class_id} {values}" + (f" {score:.4f}" if self.confidence else "") + "\n")
        self.write_whole(path, "".join(lines))
        if (video := _video_of(path)) and path in self._remains[video]:
            self._remains[video].remove(path)
            self._replaced.add(video)
        self._class_names = perception.class_names

    def remove_remains(self, source: str) -> None:
        """Remove the labels that an earlier run left of other frames of a video.

        There was such a run only if this one has replaced some; other files may be called alike.
        """
        stem = self.stem(source)
        for path in self._remains.pop(stem, ()) if stem in self._replaced else ():
            with writing(path):
                path.unlink(missing_ok=True)

    def _close(self) -> None:
        """Write ``data.yaml``."""
        if self._class_names is None:
            return
        data = {"train": "images", "val": "images", "names": list(self._class_names)}  # from its own folder on
        self._class_names = None
        self.write_whole(self._data, yaml.safe_dump(data, sort_keys=False))


def _video_of(labels: Path) -> str | None:
    """Return the stem of the video of which a label file, by its name, has a frame."""
    frame = re.fullmatch(r"(.+)-\d{7}", labels.stem)
    return None if frame is None else frame[1]
