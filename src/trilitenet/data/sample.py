"""One labelled image, as read or as transformed: the noun of the data layer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import ShapeError

__all__ = ["BOXES", "MASKS", "VALID", "Sample"]

BOXES: Final = ("boxes", "ignored")
"""The fields of a sample that hold boxes."""
MASKS: Final = ("drivable", "lane")
"""The fields of a sample that hold masks."""
VALID: Final = ("valid", "drivable_valid", "lane_valid")
"""The fields of a sample that say where masks count."""


def _no_boxes() -> NDArray[np.float32]:
    return np.zeros((0, 4), np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class Sample:
    """One image with whatever labels it has. A task without a label is None, never an empty mask or list.

    Attributes:
        name: The image's name without folder and ending; unique in its split.
        image: (H, W, 3) uint8 RGB.
        boxes: (N, 4) float32: left, top, right, bottom in pixels of ``image``; None = not labelled.
        class_id: (N,) int64: index into the data set's class names; None exactly when ``boxes`` is.
        ignored: (M, 4) float32 as ``boxes``: regions that are neither object nor background.
        drivable: (H, W) uint8, 1 = drivable, 0 = not; None = not labelled.
        lane: (H, W) uint8, 1 = lane marking, 0 = not; None = not labelled.
        valid: (H, W) bool, False where every task is ignored (the own car's bonnet); None = valid everywhere.
        drivable_valid: (H, W) bool, False where the drivable mask alone says nothing; None = it speaks everywhere.
        lane_valid: (H, W) bool, likewise for the lane mask.
        attributes: Weather, scene, time of day, source and the like.

    Raises:
        ShapeError: If the arrays do not fit each other.
    """

    name: str
    image: NDArray[np.uint8]
    boxes: NDArray[np.float32] | None = None
    class_id: NDArray[np.int64] | None = None
    ignored: NDArray[np.float32] = dataclasses.field(default_factory=_no_boxes)
    drivable: NDArray[np.uint8] | None = None
    lane: NDArray[np.uint8] | None = None
    valid: NDArray[np.bool_] | None = None
    drivable_valid: NDArray[np.bool_] | None = None
    lane_valid: NDArray[np.bool_] | None = None
    attributes: dict[str, str] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.image.ndim != 3 or self.image.shape[2] != 3 or self.image.dtype != np.uint8:
            raise ShapeError(f"{self.name}: image must be (H, W, 3) uint8, got {self.image.shape} {self.image.dtype}")
        if (self.boxes is None) != (self.class_id is None):
            raise ShapeError(f"{self.name}: boxes and class_id go together")
        if self.boxes is not None and self.class_id is not None:
            count = len(self.boxes)
            if self.boxes.shape != (count, 4) or self.class_id.shape != (count,):
                raise ShapeError(
                    f"{self.name}: boxes must be (N, 4) with N class ids, "
                    f"got {self.boxes.shape} and {self.class_id.shape}"
                )
        if self.ignored.ndim != 2 or self.ignored.shape[1] != 4:
            raise ShapeError(f"{self.name}: ignored must be (M, 4), got {self.ignored.shape}")
        for field in (*MASKS, *VALID):
            dtype = np.bool_ if field in VALID else np.uint8
            mask = getattr(self, field)
            if mask is not None and (mask.shape != self.size or mask.dtype != dtype):
                raise ShapeError(
                    f"{self.name}: {field} must be {self.size} {np.dtype(dtype)}, got {mask.shape} {mask.dtype}"
                )

    def counted(self, task: Literal["drivable", "lane"]) -> NDArray[np.bool_] | None:
        """Return (H, W) bool, True where a task's mask counts; None = everywhere."""
        own = self.drivable_valid if task == "drivable" else self.lane_valid
        if self.valid is None or own is None:
            return own if self.valid is None else self.valid
        return self.valid & own

    def changed(self, fields: Iterable[str], change: Callable[[NDArray[Any]], Any]) -> dict[str, Any]:
        """Return some fields by name, those that are there changed."""
        return {name: None if (value := getattr(self, name)) is None else change(value) for name in fields}

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the image in pixels."""
        return self.image.shape[0], self.image.shape[1]
