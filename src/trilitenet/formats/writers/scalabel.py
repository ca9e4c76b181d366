"""Scalabel's JSON, the format of BDD100K's labels since 2020.

Format: https://doc.scalabel.com/format.html.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trilitenet.formats.writers.base import JsonStream, Writer, dumps, objects, polylines, rounded
from trilitenet.processing.serialise import encode_mask
from trilitenet.structures import Perception

__all__ = ["ScalabelWriter"]


class ScalabelWriter(Writer):
    """Writes ``scalabel.json``: boxes, drivable area and lane markings as masks, lines of lanes as polylines."""

    FILES = ("scalabel.json",)

    def __init__(self, output: Path, *, overwrite: bool = False) -> None:
        super().__init__(output, overwrite=overwrite)
        self._stream: JsonStream | None = JsonStream(self.create("scalabel.json"), '{"frames": [')
        self._class_names: tuple[str, ...] = ()
        self._labels = 0

    def _write(self, perception: Perception, road: Mapping[str, Any] | None = None) -> None:
        """Write one frame."""
        assert self._stream is not None
        self._class_names = perception.class_names
        height, width = perception.size
        frame: dict[str, Any] = {
            "name": self.image_name(perception),
            "url": perception.source,
            "size": {"width": width, "height": height},
            "labels": [*self._boxes(perception), *self._masks(perception), *self._lines(road)],
        }
        if perception.frame is not None:
            frame |= {"videoName": self.stem(perception.source), "frameIndex": perception.frame}
        if perception.timestamp is not None:
            frame["timestamp"] = round(perception.timestamp * 1000)  # milliseconds
        self._stream.add(frame)

    def _close(self) -> None:
        """Write the categories, and finish the file."""
        if self._stream is None:
            return
        categories = [
            *({"name": name, "isThing": True} for name in self._class_names),
            {"name": "drivable", "isThing": False},
            {"name": "lane", "isThing": False},
            {"name": "lane line", "isThing": True},
        ]
        self._stream.close(f'],\n"groups": null,\n"config": {dumps({"categories": categories})}}}')
        self.finish(self._stream.path)
        self._stream = None

    def _boxes(self, perception: Perception) -> list[dict[str, Any]]:
        return [
            {
                "id": f"track-{found.track_id}" if found.track_id >= 0 else self._identity(),
                "category": found.name,
                "score": round(found.confidence, 4),
                "manualShape": False,
                "manualAttributes": False,
                "box2d": dict(zip(("x1", "y1", "x2", "y2"), rounded(found.corners), strict=True)),
            }
            for found in objects(perception)
        ]

    def _masks(self, perception: Perception) -> list[dict[str, Any]]:
        return [
            {
                "id": self._identity(),
                "category": category,
                "manualShape": False,
                "manualAttributes": False,
                "rle": encode_mask(mask),
            }
            for category, mask in (("drivable", perception.drivable), ("lane", perception.lane))
            if mask is not None and mask.any()
        ]

    def _lines(self, road: Mapping[str, Any] | None) -> list[dict[str, Any]]:
        return [
            {
                "id": f"line-{identity}",
                "category": "lane line",
                "manualShape": False,
                "manualAttributes": False,
                "poly2d": [{"vertices": points, "types": "L" * len(points), "closed": False}],
            }
            for identity, points in polylines(road)
        ]

    def _identity(self) -> str:
        self._labels += 1
        return str(self._labels)
