from __future__ import annotations

import csv
import errno
from pathlib import Path

import numpy as np
import pytest

from trilitenet.formats.writers.tables import BOX_COLUMNS, FRAME_COLUMNS, CsvWriter, ParquetWriter
from trilitenet.processing.serialise import decode_mask
from trilitenet.road.structures import Road
from trilitenet.structures import Boxes, Perception


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as handle:
        return list(csv.DictReader(handle))


def test_csv(tmp_path: Path, video: list[Perception]) -> None:
    with CsvWriter(tmp_path) as writer:
        for frame in video:
            writer.write(frame)
    assert video[0].drivable is not None
    frames, boxes = read(tmp_path / "frames.csv"), read(tmp_path / "boxes.csv")
    assert list(frames[0]) == list(FRAME_COLUMNS)
    assert list(boxes[0]) == list(BOX_COLUMNS)
    assert [row["objects"] for row in frames] == ["2", "2", "1", "2"]
    assert float(frames[0]["drivable_share"]) == pytest.approx(np.mean(video[0].drivable), abs=1e-6)
    assert frames[3]["lane_share"] == "", "a task that the model lacks is empty, not 0"
    assert frames[0]["lines"] == "", "nor is what nobody looked for"
    assert [row["track_id"] for row in boxes[:2]] == ["7", ""]
    assert boxes[0]["right"] == "60.0"


def test_a_frame_whose_boxes_cannot_be_written_is_in_neither_table(
    tmp_path: Path, video: list[Perception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(text: str) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with CsvWriter(tmp_path) as writer:
        writer.write(video[0])
        monkeypatch.setattr(writer._boxes, "add", full)
        with pytest.raises(OSError, match="No space left"):
            writer.write(video[1])
    assert [row["frame"] for row in read(tmp_path / "frames.csv")] == ["0"]


def test_parquet(tmp_path: Path, video: list[Perception]) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    with ParquetWriter(tmp_path) as writer:
        for frame in video * 100:
            writer.write(frame)
    table = parquet.read_table(tmp_path / "perceptions.parquet")
    assert table.num_rows == 400
    assert parquet.ParquetFile(tmp_path / "perceptions.parquet").num_row_groups == 2
    row = table.slice(1, 1).to_pylist()[0]
    assert row["frame"] == 1
    assert row["boxes"][0]["track_id"] == 7
    assert row["boxes"][1]["track_id"] is None
    mask = decode_mask({"size": [row["height"], row["width"]], "counts": row["drivable"]})
    np.testing.assert_array_equal(mask, video[1].drivable)
    assert table.slice(3, 1).to_pylist()[0]["lane"] is None
    assert table.column("frame").to_pylist() == [0, 1, 2, 3] * 100
    metadata = parquet.read_metadata(tmp_path / "perceptions.parquet")
    assert metadata.row_group(0).column(0).compression == "ZSTD"


def test_a_task_that_the_model_lacks_is_null_in_parquet(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    with ParquetWriter(tmp_path) as writer:
        writer.write(Perception((4, 6), source="a.jpg"))
        writer.write(Perception((4, 6), boxes=Boxes.empty(), source="b.jpg"))
    rows = parquet.read_table(tmp_path / "perceptions.parquet").to_pylist()
    assert [row["boxes"] for row in rows] == [None, []]
    assert (rows[0]["objects"], rows[0]["lines"], rows[0]["road"]) == (None, None, None)


def test_the_road_has_columns(tmp_path: Path, video: list[Perception], road: Road) -> None:
    with CsvWriter(tmp_path) as writer:
        writer.write(video[0], road.to_dict())
    (row,) = read(tmp_path / "frames.csv")
    assert (row["lane_offset"], row["lane_curvature"], row["lead_distance"]) == ("0.25", "", "22.5")
    assert (row["lines"], row["events"]) == ("1", "lane_departure_left:begin")
