"""Tables for statistics over many frames: CSV to open anywhere, Parquet for fleets."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from trilitenet.errors import import_extra, part_of
from trilitenet.formats.writers.base import GrowingFile, Writer, objects, rounded
from trilitenet.processing.serialise import encode_mask
from trilitenet.structures import SCHEMA_VERSION, Perception

__all__ = ["BOX_COLUMNS", "FRAME_COLUMNS", "CsvWriter", "ParquetWriter", "box_rows", "frame_row"]

ROW_GROUP: Final = 256
"""Frames a row group of Parquet; so many are held in memory."""

_WHERE: Final = {"source": str, "frame": int, "timestamp": float}
FRAME_COLUMNS: Final[dict[str, type]] = {
    **_WHERE,
    "width": int,
    "height": int,
    "objects": int,
    "drivable_share": float,
    "lane_share": float,
    "lines": int,
    "lane_width": float,
    "lane_offset": float,
    "lane_heading": float,
    "lane_curvature": float,
    "lead_distance": float,
    "lead_closing_speed": float,
    "lead_time_to_collision": float,
    "events": str,
}
"""Columns of a row a frame: metres, radians, 1/m, m/s and seconds, as the road's JSON form describes them."""
BOX_COLUMNS: Final[dict[str, type]] = {
    **_WHERE,
    "class_name": str,
    "track_id": int,
    "confidence": float,
    "left": float,
    "top": float,
    "right": float,
    "bottom": float,
}
"""Columns of a row an object; corners in pixels of the source image."""


def frame_row(perception: Perception, road: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the figures of one frame that have a single value; None where there is none.

    ``drivable_share`` and ``lane_share`` are the masks' shares of the image's pixels; of the road's estimates only the
    values are here, not their errors.
    """
    height, width = perception.size
    road = road or {}
    lane, lead = road.get("ego_lane") or {}, road.get("lead") or {}
    return {
        "source": perception.source,
        "frame": perception.frame,
        "timestamp": perception.timestamp,
        "width": width,
        "height": height,
        "objects": None if perception.boxes is None else len(perception.boxes),
        "drivable_share": None if perception.drivable is None else round(float(perception.drivable.mean()), 6),
        "lane_share": None if perception.lane is None else round(float(perception.lane.mean()), 6),
        "lines": len(road["lines"]) if "lines" in road else None,
        **{f"lane_{name}": _value(lane.get(name)) for name in ("width", "offset", "heading", "curvature")},
        **{f"lead_{name}": _value(lead.get(name)) for name in ("distance", "closing_speed", "time_to_collision")},
        "events": " ".join(f"{event['kind']}:{event['phase']}" for event in road.get("events", ())) or None,
    }


def _value(estimate: Mapping[str, float] | None) -> float | None:
    return None if estimate is None else estimate["value"]


def box_rows(perception: Perception) -> list[dict[str, Any]]:
    """Return a row an object, best first; ``track_id`` is None where the identity is unknown."""
    return [
        {
            "class_name": found.name,
            "track_id": found.track_id if found.track_id >= 0 else None,
            "confidence": round(found.confidence, 4),
            **dict(zip(("left", "top", "right", "bottom"), rounded(found.corners), strict=True)),
        }
        for found in objects(perception)
    ]


class CsvWriter(Writer):
    """Writes ``frames.csv``, a row a frame, and ``boxes.csv``, a row an object; both are readable while they grow."""

    FILES = ("frames.csv", "boxes.csv")

    def __init__(self, output: Path, *, overwrite: bool = False) -> None:
        super().__init__(output, overwrite=overwrite)
        self._frames, self._boxes = (
            GrowingFile(self.create(file), self.files, _lines(columns, [{name: name for name in columns}]))
            for file, columns in (("frames.csv", FRAME_COLUMNS), ("boxes.csv", BOX_COLUMNS))
        )

    def _write(self, perception: Perception, road: Mapping[str, Any] | None = None) -> None:
        """Write the rows of one frame."""
        where = {"source": perception.source, "frame": perception.frame, "timestamp": perception.timestamp}
        self._frames.add(_lines(FRAME_COLUMNS, [frame_row(perception, road)]))
        try:
            self._boxes.add(_lines(BOX_COLUMNS, [{**where, **row} for row in box_rows(perception)]))
        except OSError:
            self._frames.take_back()
            raise
        self._frames.keep()
        self._boxes.keep()

    def _close(self) -> None:
        """Close the files."""
        self._frames.close()
        self._boxes.close()


def _lines(columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> str:
    text = io.StringIO()
    csv.DictWriter(text, list(columns)).writerows(rows)
    return text.getvalue()


class ParquetWriter(Writer):
    """Writes ``perceptions.parquet``: a row a frame, with a list of boxes, the masks as run-length text and the road.

    Raises:
        MissingExtraError: If pyarrow is not installed.
    """

    EXTRA = ("pyarrow.parquet", "parquet")
    FILES = ("perceptions.parquet",)

    def __init__(self, output: Path, *, overwrite: bool = False) -> None:
        self._arrow = import_extra("pyarrow", "parquet")
        parquet = import_extra(*self.EXTRA)
        super().__init__(output, overwrite=overwrite)
        arrow = self._arrow
        number, integer, text = arrow.float64(), arrow.int64(), arrow.string()
        kinds = {str: text, int: integer, float: number}
        box = arrow.struct([(name, kinds[kind]) for name, kind in BOX_COLUMNS.items() if name not in _WHERE])
        self._schema = arrow.schema(
            [
                *((name, kinds[kind]) for name, kind in FRAME_COLUMNS.items()),
                ("boxes", arrow.list_(box)),
                ("drivable", text),
                ("lane", text),
                ("road", text),
            ],
            metadata={"trilitenet.schema": SCHEMA_VERSION},
        )
        self._path = self.create("perceptions.parquet")
        self._file = parquet.ParquetWriter(part_of(self._path), self._schema, compression="zstd")
        self._rows: list[dict[str, Any]] = []
        self._open = True

    def _write(self, perception: Perception, road: Mapping[str, Any] | None = None) -> None:
        """Write the row of one frame."""
        self._rows.append(
            {
                **frame_row(perception, road),
                "boxes": None if perception.boxes is None else box_rows(perception),
                "drivable": None if perception.drivable is None else encode_mask(perception.drivable)["counts"],
                "lane": None if perception.lane is None else encode_mask(perception.lane)["counts"],
                "road": None if road is None else json.dumps(dict(road), allow_nan=False),
            }
        )
        if len(self._rows) >= ROW_GROUP:
            self._flush()

    def _close(self) -> None:
        """Write what is left, and finish the file."""
        if not self._open:
            return
        self._open = False
        self._flush()
        self._file.close()
        self.finish(self._path)

    def _flush(self) -> None:
        if self._rows:
            self._file.write_table(self._arrow.Table.from_pylist(self._rows, schema=self._schema))
            self._rows = []
