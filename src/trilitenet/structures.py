"""The nouns everything speaks: boxes, what a backend returns, and what a user gets. NumPy only, validated when made."""

from __future__ import annotations

import dataclasses
import math
from numbers import Integral, Real
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import ShapeError

if TYPE_CHECKING:
    from PIL import Image

__all__ = ["SCHEMA_VERSION", "Boxes", "Perception", "RawOutputs"]

SCHEMA_VERSION: Final = "1.0"
"""Version of the JSON that `Perception.to_dict` returns: the major number rises when a reader would break."""


def _told(value: object) -> str:
    return f"{value.shape} {value.dtype}" if isinstance(value, np.ndarray) else f"no array but a {type(value).__name__}"


def _as_array(name: str, value: object, dtype: type[np.generic]) -> NDArray[Any]:
    """Return an array of a type.

    Raises:
        ShapeError: If it cannot be one, or whole numbers would become others by it.
    """
    try:
        with np.errstate(invalid="ignore"):  # told below
            array = np.asarray(value, dtype)
    except (OverflowError, TypeError, ValueError) as error:
        raise ShapeError(f"{name} must be an array of {dtype.__name__} ({error})") from error
    if array.dtype.kind == "i" and getattr(value, "dtype", None) != array.dtype:
        given = np.asarray(value)
        if given.dtype.kind in "fu" and not (given == array).all():
            raise ShapeError(f"{name} must be whole numbers of {dtype.__name__}")
    return array


_BOX_ARRAYS: Final[dict[str, type[np.generic]]] = {
    "xyxy": np.float32,
    "confidence": np.float32,
    "class_id": np.int64,
    "track_id": np.int64,
}


@dataclasses.dataclass(frozen=True, eq=False)
class Boxes:
    """Detected objects of one image.

    Attributes:
        xyxy: (N, 4) float32: left, top, right, bottom in pixels of the image, not normalised.
        confidence: (N,) float32 in [0, 1]: objectness x class probability.
        class_id: (N,) int64: index into the class names.
        track_id: (N,) int64, the object's identity over the frames of a video, -1 where unknown; None without tracking.

    Raises:
        ShapeError: If the arrays do not fit each other, or are no such arrays, or hold numbers that are not finite.
    """

    xyxy: NDArray[np.float32]
    confidence: NDArray[np.float32]
    class_id: NDArray[np.int64]
    track_id: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        for name, dtype in _BOX_ARRAYS.items():
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, _as_array(name, value, dtype))
            elif name != "track_id":
                raise ShapeError(f"{name} must be an array of {dtype.__name__}, got None")
        count = len(self.xyxy) if self.xyxy.ndim else 0
        if self.xyxy.shape != (count, 4):
            raise ShapeError(f"xyxy must be (N, 4), got {self.xyxy.shape}")
        for name in ("confidence", "class_id", "track_id"):
            array = getattr(self, name)
            if array is not None and array.shape != (count,):
                raise ShapeError(f"{name} must be ({count},) like xyxy, got {array.shape}")
        if not (np.isfinite(self.xyxy).all() and np.isfinite(self.confidence).all()):
            raise ShapeError("xyxy and confidence must be finite numbers")

    def __len__(self) -> int:
        return len(self.xyxy)

    @classmethod
    def empty(cls) -> Boxes:
        """Return no boxes."""
        return cls(np.zeros((0, 4), np.float32), np.zeros(0, np.float32), np.zeros(0, np.int64))

    def select(self, index: NDArray[Any]) -> Boxes:
        """Return the boxes at ``index`` (a mask or integer positions)."""
        return Boxes(
            self.xyxy[index],
            self.confidence[index],
            self.class_id[index],
            None if self.track_id is None else self.track_id[index],
        )


@dataclasses.dataclass(frozen=True, eq=False)
class RawOutputs:
    """What a backend returns for a batch of letterboxed images of H x W pixels.

    Attributes:
        detection: (B, N, 5 + classes) float32: centre x, centre y, width, height in input pixels, objectness and class
            probabilities in [0, 1]. N may be less than all cells if the backend dropped hopeless ones. None without
            the task.
        drivable: (B, H, W) uint8: probability of drivable x 255 (a backend that decides itself gives 0 or 255).
            None without the task.
        lane: (B, H, W) uint8, likewise for lane marking.
    """

    detection: NDArray[np.float32] | None
    drivable: NDArray[np.uint8] | None
    lane: NDArray[np.uint8] | None

    def __post_init__(self) -> None:
        rows = self.detection
        if rows is not None and not (isinstance(rows, np.ndarray) and rows.ndim == 3 and rows.shape[2] > 5):
            raise ShapeError(f"detection must be (B, N, 5 + classes), got {_told(rows)}")
        for name in ("drivable", "lane"):
            mask = getattr(self, name)
            if mask is not None and not (isinstance(mask, np.ndarray) and mask.ndim == 3 and mask.dtype == np.uint8):
                raise ShapeError(f"{name} must be (B, H, W) uint8, got {_told(mask)}")


@dataclasses.dataclass(frozen=True, eq=False)
class Perception:
    """What the network sees in one image. A task that the model lacks is None, never an empty result.

    Attributes:
        size: (height, width) of the source image in pixels.
        class_names: Names that ``boxes.class_id`` indexes.
        boxes: Detected objects in pixels of the source image, best first.
        drivable: (height, width) bool: where the vehicle may drive.
        lane: (height, width) bool: lane markings.
        image: (height, width, 3) uint8 RGB, the source image, for drawing; None if it was not kept.
        source: Where the image came from (a path, or a video's name); None if unknown.
        frame: Index of the frame in a video; None for a still image.
        timestamp: Seconds from the start of the video; None for a still image.

    Raises:
        ShapeError: If something is of another form, or does not fit the rest. Numbers of NumPy and paths are taken, and
            become Python's own and texts.
    """

    size: tuple[int, int]
    class_names: tuple[str, ...] = ("vehicle",)
    boxes: Boxes | None = None
    drivable: NDArray[np.bool_] | None = None
    lane: NDArray[np.bool_] | None = None
    image: NDArray[np.uint8] | None = None
    source: str | None = None
    frame: int | None = None
    timestamp: float | None = None

    def __post_init__(self) -> None:
        size, names = self.size, self.class_names
        whole = isinstance(size, (tuple, list)) and all(isinstance(side, (int, np.integer)) for side in size)
        if not (whole and len(size) == 2 and min(size) >= 0):
            raise ShapeError(f"size must be (height, width) in pixels, got {size!r}")
        if isinstance(names, str):
            raise ShapeError(f"class_names must be several names, got the text {names!r}; write ({names!r},)")
        self._set(size=(int(size[0]), int(size[1])), class_names=tuple(names))
        self._check_origin()
        for name in ("drivable", "lane"):
            mask = getattr(self, name)
            if mask is not None and not (
                isinstance(mask, np.ndarray) and mask.shape == tuple(self.size) and mask.dtype == np.bool_
            ):
                raise ShapeError(f"{name} must be {self.size} bool, got {_told(mask)}")
        image, boxes = self.image, self.boxes
        if image is not None and not (isinstance(image, np.ndarray) and image.shape == (*self.size, 3)):
            raise ShapeError(f"image must be {(*self.size, 3)}, got {_told(image)}")
        if boxes is not None and not isinstance(boxes, Boxes):
            raise ShapeError(f"boxes must be Boxes, got a {type(boxes).__name__}")
        if boxes is not None and len(boxes):
            for class_id in (int(boxes.class_id.min()), int(boxes.class_id.max())):
                if not 0 <= class_id < len(self.class_names):
                    raise ShapeError(f"class id {class_id} has no name among {self.class_names}")

    def _set(self, **values: Any) -> None:
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def _check_origin(self) -> None:
        """Bring what tells where the image is from into Python's own types, which every format can say."""
        source, frame, timestamp = self.source, self.frame, self.timestamp
        if isinstance(source, PurePath):
            self._set(source=str(source))
        elif source is not None and not isinstance(source, str):
            raise ShapeError(f"source must be a text or a path, got {source!r}")
        if frame is not None:
            if not isinstance(frame, Integral):
                raise ShapeError(f"frame must be a whole number, got {frame!r}")
            self._set(frame=int(frame))
        if timestamp is not None:
            if not isinstance(timestamp, Real) or not math.isfinite(timestamp):
                raise ShapeError(f"timestamp must be a finite number of seconds, got {timestamp!r}")
            self._set(timestamp=float(timestamp))

    def __repr__(self) -> str:
        height, width = self.size
        parts = [f"{width}x{height}"]
        if self.boxes is not None:
            parts.append("1 box" if len(self.boxes) == 1 else f"{len(self.boxes)} boxes")
        for name, mask in (("drivable", self.drivable), ("lane", self.lane)):
            if mask is not None:
                parts.append(f"{name} {np.count_nonzero(mask) / max(mask.size, 1):.0%}")
        return f"Perception({', '.join(parts)})"

    def to_dict(self) -> dict[str, Any]:
        """Return what ``json.dumps`` takes: the documented, versioned JSON form (masks as COCO run-length)."""
        from trilitenet.processing.serialise import perception_to_dict

        return perception_to_dict(self)

    @classmethod
    def from_dict(cls, mapping: dict[str, Any]) -> Perception:
        """Read what `to_dict` returned (without the image).

        Raises:
            ShapeError: If it is not that form, or of a newer major version.
        """
        from trilitenet.processing.serialise import perception_from_dict

        return perception_from_dict(mapping)

    def draw(self, image: str | Path | bytes | Image.Image | NDArray[Any] | None = None) -> NDArray[np.uint8]:
        """Return a copy of the image with the three tasks drawn on it.

        Args:
            image: What to draw on, in any form that a predictor takes; the source image if left out.

        Returns:
            (height, width, 3) uint8 RGB.

        Raises:
            InputError: If an image cannot be read.
            ShapeError: If there is no image, or one of another size.
        """
        from trilitenet.processing.drawing import draw

        return draw(self, image)
