"""ASAM OpenLABEL 1.0: one JSON a picture or video, objects by identity and what is known of them by frame.

Standard: https://www.asam.net/standards/detail/openlabel/. Boxes are ``bbox`` (centre x, centre y, width, height in
pixels), the two masks are ``image`` (PNG in base64, 255 = inside) of the objects 0 and 1, lines of lanes are
``poly2d``, and the road's figures are numbers of the context 0.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.formats.writers.base import JsonStream, Writer, dumps, objects, polylines, rounded
from trilitenet.processing.boxes import xyxy_to_cxcywh
from trilitenet.structures import Perception

__all__ = ["OpenLabelWriter"]

_MASKS: Final = (("0", "drivable", "drivable area"), ("1", "lane", "lane marking"))
_METADATA: Final = {"schema_version": "1.0.0", "annotator": "trilitenet"}


class OpenLabelWriter(Writer):
    """Writes ``NAME.openlabel.json`` for each picture and each video.

    The list of objects is held until a video ends: about 400 bytes an object, of which each box without a track is one.
    """

    PICTURE_FILES = VIDEO_FILES = ("{}.openlabel.json",)

    def __init__(self, output: Path, *, overwrite: bool = False) -> None:
        super().__init__(output, overwrite=overwrite)
        self._document: _Document | None = None

    def _write(self, perception: Perception, road: Mapping[str, Any] | None = None) -> None:
        """Write one picture or frame."""
        document = self._document
        if document is None or perception.frame is None or document.source != perception.source:
            self._close()
            path = self.create(f"{self.stem(perception.source)}.openlabel.json")
            self._document = document = _Document(path, perception.source)
        document.add(perception, road)

    def _close(self) -> None:
        """Finish the file of the last picture or video."""
        if self._document is not None:
            self._document.close()
            self.finish(self._document.stream.path)
            self._document = None


class _Document:
    def __init__(self, path: Path, source: str | None) -> None:
        self.source = source
        metadata = {**_METADATA, **({"tagged_file": source} if source else {})}
        camera = {"type": "camera", "description": "front camera", **({"uri": source} if source else {})}
        head = f'{{"openlabel": {{"metadata": {dumps(metadata)},\n"streams": {dumps({"camera": camera})},\n"frames": {{'
        self.stream = JsonStream(path, head)
        self._objects: dict[str, dict[str, str]] = {}
        self._seen: dict[str, list[int]] = {}
        self._frames: list[int] = []
        self._uids: dict[tuple[str, int], str] = {}
        self._context: list[int] = []
        self._next = len(_MASKS)

    def add(self, perception: Perception, road: Mapping[str, Any] | None) -> None:
        frame = perception.frame or 0
        self._frames.append(frame)
        data: dict[str, Any] = {}
        for uid, task, label in _MASKS:
            mask = getattr(perception, task)
            if mask is not None:
                self._register(uid, frame, label, label)
                data[uid] = {"object_data": {"image": [_image("mask", mask)]}}
        for found in objects(perception):
            # An object has one type: a track that changes its class is one object a class.
            uid = self._uid((f"box {found.name}", found.track_id) if found.track_id >= 0 else None)
            self._register(uid, frame, f"{found.name} {uid}", found.name)
            confidence = {"name": "confidence", "val": round(found.confidence, 4)}
            value = list(rounded(xyxy_to_cxcywh(found.corners)))
            box = {"name": "box", "val": value, "attributes": {"num": [confidence]}}
            data[uid] = {"object_data": {"bbox": [box]}}
        for identity, points in polylines(road):
            uid = self._uid(("line", identity))
            self._register(uid, frame, f"lane line {identity}", "lane line")
            flat = [value for point in points for value in point]
            line = {"name": "curve", "val": flat, "mode": "MODE_POLY2D_ABSOLUTE", "closed": False}
            data[uid] = {"object_data": {"poly2d": [line]}}
        content: dict[str, Any] = {"objects": data}
        figures = _figures(road)
        if figures:
            content["contexts"] = {"0": {"context_data": {"num": figures}}}
            self._context.append(frame)
        if perception.timestamp is not None:
            content["frame_properties"] = {"timestamp": round(perception.timestamp, 6)}
        self.stream.add(content, key=str(frame))

    def close(self) -> None:
        named = {uid: {**item, "frame_intervals": _intervals(self._seen[uid])} for uid, item in self._objects.items()}
        tail: dict[str, Any] = {"objects": named}
        if self._context:
            context = {"name": "road", "type": "road", "frame_intervals": _intervals(self._context)}
            tail["contexts"] = {"0": context}
        tail["frame_intervals"] = _intervals(self._frames)
        self.stream.close("},\n" + ",\n".join(f"{dumps(key)}: {dumps(value)}" for key, value in tail.items()) + "}}")

    def _uid(self, key: tuple[str, int] | None) -> str:
        """Return the uid of what has an identity over the frames, or a new one."""
        if key is not None and key in self._uids:
            return self._uids[key]
        uid = str(self._next)
        self._next += 1
        if key is not None:
            self._uids[key] = uid
        return uid

    def _register(self, uid: str, frame: int, name: str, kind: str) -> None:
        self._objects.setdefault(uid, {"name": name, "type": kind})
        self._seen.setdefault(uid, []).append(frame)


def _image(name: str, mask: NDArray[np.bool_]) -> dict[str, str]:
    _, encoded = cv2.imencode(".png", mask.astype(np.uint8) * 255, [cv2.IMWRITE_PNG_BILEVEL, 1])
    value = base64.b64encode(encoded.tobytes()).decode("ascii")
    return {"name": name, "val": value, "mime_type": "image/png", "encoding": "base64"}


def _figures(road: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Return the road's estimates, each with its error as an attribute; those not known are left out."""
    parts = {} if road is None else {"lane": road["ego_lane"] or {}, "lead": road["lead"] or {}}
    return [
        {
            "name": f"{part}_{name}",
            "val": estimate["value"],
            "attributes": {"num": [{"name": "error", "val": estimate["error"]}]},
        }
        for part, estimates in parts.items()
        for name, estimate in estimates.items()
        if isinstance(estimate, Mapping)
    ]


def _intervals(frames: list[int]) -> list[dict[str, int]]:
    """Gather ascending frame numbers into closed intervals."""
    intervals: list[dict[str, int]] = []
    for frame in frames:
        if intervals and frame == intervals[-1]["frame_end"] + 1:
            intervals[-1]["frame_end"] = frame
        elif not intervals or frame != intervals[-1]["frame_end"]:
            intervals.append({"frame_start": frame, "frame_end": frame})
    return intervals
