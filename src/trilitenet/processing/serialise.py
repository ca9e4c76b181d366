"""`Perception` as JSON and back: the documented, versioned form. Masks are COCO compressed run-length encoding."""

from __future__ import annotations

import math
import re
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from trilitenet.errors import ShapeError
from trilitenet.structures import SCHEMA_VERSION, Boxes, Perception

__all__ = ["decode_mask", "encode_mask", "perception_from_dict", "perception_to_dict"]


def encode_mask(mask: NDArray[np.bool_]) -> dict[str, Any]:
    """Return ``{"size": [height, width], "counts": text}`` of a (height, width) bool mask."""
    columns = cv2.transpose(mask.view(np.uint8)).T if mask.size else np.asfortranarray(mask).view(np.uint8)
    encoded = coco_mask.encode(columns)  # wants column-major, which OpenCV does 14 times as fast as NumPy
    return {"size": [int(side) for side in encoded["size"]], "counts": encoded["counts"].decode("ascii")}


def decode_mask(encoded: dict[str, Any]) -> NDArray[np.bool_]:
    """Return the (height, width) bool mask that `encode_mask` wrote.

    Raises:
        ShapeError: If it is not of that form.
    """
    try:
        height, width = (int(side) for side in encoded["size"])
        counts = encoded["counts"]
        runs = _read_runs(counts.decode("ascii") if isinstance(counts, bytes) else counts)  # pycocotools gives bytes
        if min(height, width) < 0 or (runs < 0).any() or runs.sum() != height * width:
            raise ValueError(f"the runs do not fill {width}x{height} pixels")
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise ShapeError(f"a mask must be {{'size': [height, width], 'counts': run-length text}} ({error})") from error
    values = np.arange(len(runs)) % 2 == 1
    return np.ascontiguousarray(np.repeat(values, runs).reshape(width, height).T)


def _read_runs(counts: str) -> NDArray[np.int64]:
    """Return the lengths of the runs in COCO's text: 5 bits a character, later runs relative to the last but one.

    Read here rather than by pycocotools, whose decoder trusts the text and writes past the mask if the runs are long.
    """
    characters = np.frombuffer(counts.encode("ascii"), np.uint8).astype(np.int64) - 48
    ends = (characters & 32 == 0).nonzero()[0]
    if (characters < 0).any() or (characters > 63).any() or not len(ends) or ends[-1] != len(characters) - 1:
        raise ValueError("the text is damaged")
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts + 1
    if lengths.max() > 8:
        raise ValueError("a run is too long")
    shifts = 5 * (np.arange(len(characters)) - np.repeat(starts, lengths))
    runs = np.add.reduceat((characters & 31) << shifts, starts)
    runs -= (characters[ends] >> 4 & 1) << (5 * lengths)  # the sign bit
    runs[1::2] = np.cumsum(runs[1::2])
    runs[2::2] = np.cumsum(runs[2::2])
    return np.asarray(runs, np.int64)


def perception_to_dict(perception: Perception) -> dict[str, Any]:
    """Return what ``json.dumps`` takes. Coordinates are pixels of the source image, rounded to 1/100.

    A task the model lacks is null; a task that found nothing is an empty list or an empty mask.
    """
    height, width = perception.size
    return {
        "schema": SCHEMA_VERSION,
        "source": perception.source,
        "frame": perception.frame,
        "timestamp": None if perception.timestamp is None else round(perception.timestamp, 6),
        "size": {"height": height, "width": width},
        "class_names": list(perception.class_names),
        "boxes": None if perception.boxes is None else _boxes_to_list(perception.boxes, perception.class_names),
        "drivable": None if perception.drivable is None else encode_mask(perception.drivable),
        "lane": None if perception.lane is None else encode_mask(perception.lane),
    }


def perception_from_dict(mapping: dict[str, Any]) -> Perception:
    """Read what `perception_to_dict` returned.

    Raises:
        ShapeError: If it is not of that form, or of a newer major version.
    """
    try:
        version = str(mapping["schema"])
        if not re.fullmatch(r"[1-9]\d*\.\d+", version):
            raise ShapeError(f"schema must be a version such as {SCHEMA_VERSION}, got {version!r}")
        if int(version.partition(".")[0]) > int(SCHEMA_VERSION.partition(".")[0]):
            raise ShapeError(f"schema {version} is newer than {SCHEMA_VERSION}, which this version reads; upgrade")
        boxes, drivable, lane = (mapping.get(name) for name in ("boxes", "drivable", "lane"))
        size = (_whole(mapping["size"]["height"], "height"), _whole(mapping["size"]["width"], "width"))
        names, timestamp, source, frame = (
            mapping.get(name) for name in ("class_names", "timestamp", "source", "frame")
        )
        if min(size) < 1:
            raise ShapeError(f"size must be at least 1x1, got {size[1]}x{size[0]}")
        if boxes is not None and not isinstance(boxes, list):
            raise ShapeError(f"boxes must be a list or null, got {boxes!r}")
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ShapeError(f"class_names must be a list of texts, got {names!r}")
        if source is not None and not isinstance(source, str):
            raise ShapeError(f"source must be a text or null, got {source!r}")
        return Perception(
            size=size,
            class_names=tuple(names),
            boxes=None if boxes is None else _boxes_from_list(boxes),
            drivable=None if drivable is None else decode_mask(drivable),
            lane=None if lane is None else decode_mask(lane),
            source=source,
            frame=None if frame is None else _whole(frame, "frame"),
            timestamp=None if timestamp is None else _number(timestamp, "timestamp"),
        )
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        if isinstance(error, ShapeError):
            raise
        raise ShapeError(f"not the JSON form of a perception: {type(error).__name__}: {error}") from error


def _boxes_to_list(boxes: Boxes, class_names: tuple[str, ...]) -> list[dict[str, Any]]:
    rows = []
    for i in range(len(boxes)):
        row = {
            "xyxy": [round(float(value), 2) for value in boxes.xyxy[i]],
            "confidence": round(float(boxes.confidence[i]), 4),
            "class_id": int(boxes.class_id[i]),
            "class_name": class_names[int(boxes.class_id[i])],
        }
        if boxes.track_id is not None:
            row["track_id"] = int(boxes.track_id[i])
        rows.append(row)
    return rows


def _boxes_from_list(rows: list[dict[str, Any]]) -> Boxes:
    tracked = any("track_id" in row for row in rows)
    corners = [[_number(value, "xyxy") for value in row["xyxy"]] for row in rows]
    return Boxes(
        xyxy=np.array(corners, np.float32).reshape(-1, 4),
        confidence=np.array([_number(row["confidence"], "confidence") for row in rows], np.float32),
        class_id=np.array([_whole(row["class_id"], "class_id") for row in rows], np.int64),
        track_id=np.array([_whole(row.get("track_id", -1), "track_id") for row in rows], np.int64) if tracked else None,
    )


def _whole(value: Any, name: str) -> int:
    if isinstance(value, float) and value.is_integer():  # which JSON Schema calls an integer, too
        return int(value)
    if not isinstance(value, int) or isinstance(value, bool):
        raise ShapeError(f"{name} must be a whole number, got {value!r}")
    return value


def _number(value: Any, name: str) -> float:
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not math.isfinite(value):
        raise ShapeError(f"{name} must be a finite number, got {value!r}")
    return value
