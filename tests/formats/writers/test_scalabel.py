from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, Optional, Union

import numpy as np
import pytest
from pydantic import BaseModel, ConfigDict

from trilitenet.formats.writers.scalabel import ScalabelWriter
from trilitenet.processing.serialise import decode_mask
from trilitenet.road.structures import Road
from trilitenet.structures import Perception


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


# The part of https://doc.scalabel.com/format.html that is written here.
class Box2D(Strict):
    x1: float
    y1: float
    x2: float
    y2: float


class RLE(Strict):
    counts: str
    size: list[int]


class Label(Strict):
    id: str
    category: str
    score: Optional[float] = None  # noqa: UP045 - pydantic evaluates it on Python 3.10 as well
    manualShape: bool  # noqa: N815
    manualAttributes: bool  # noqa: N815
    attributes: Optional[dict[str, Union[bool, int, float, str]]] = None  # noqa: UP007, UP045
    box2d: Optional[Box2D] = None  # noqa: UP045
    rle: Optional[RLE] = None  # noqa: UP045


def write(output: Path, perceptions: list[Perception]) -> dict[str, Any]:
    with ScalabelWriter(output) as writer:
        for perception in perceptions:
            writer.write(perception)
    document: dict[str, Any] = json.loads(writer.files[0].read_text(encoding="utf-8"))
    return document


def test_labels_are_as_documented(tmp_path: Path, pictures: list[Perception]) -> None:
    document = write(tmp_path, pictures)
    assert set(document) == {"frames", "groups", "config"}
    labels = [Label.model_validate(label) for label in document["frames"][0]["labels"]]
    assert [label.category for label in labels] == ["vehicle", "rider & bike", "drivable", "lane"]
    assert labels[0].box2d == Box2D(x1=10.25, y1=20.0, x2=60.0, y2=50.5)
    np.testing.assert_array_equal(decode_mask(document["frames"][0]["labels"][2]["rle"]), pictures[0].drivable)
    assert document["frames"][1]["labels"] == []
    assert document["config"]["categories"] == [
        {"name": "vehicle", "isThing": True},
        {"name": "rider & bike", "isThing": True},
        {"name": "drivable", "isThing": False},
        {"name": "lane", "isThing": False},
        {"name": "lane line", "isThing": True},
    ]


def test_video(tmp_path: Path, video: list[Perception]) -> None:
    frames = write(tmp_path, video)["frames"]
    assert [frame["name"] for frame in frames] == [f"drive-000000{index}.jpg" for index in range(4)]
    assert [(frame["videoName"], frame["frameIndex"], frame["timestamp"]) for frame in frames][3] == ("drive", 3, 120)
    assert [frame["labels"][0]["id"] for frame in frames][::3] == ["track-7", "track-7"]
    identities = [label["id"] for frame in frames for label in frame["labels"] if "track" not in label["id"]]
    assert len(set(identities)) == len(identities)


def test_the_first_track_is_number_zero(tmp_path: Path, video: list[Perception]) -> None:
    boxes = video[0].boxes
    assert boxes is not None
    first = dataclasses.replace(video[0], boxes=dataclasses.replace(boxes, track_id=np.array([0, -1])))
    (frame,) = write(tmp_path, [first])["frames"]
    assert [label["id"] for label in frame["labels"][:2]] == ["track-0", "1"]


def test_scalabel_opens_it(tmp_path: Path, video: list[Perception]) -> None:
    loader = pytest.importorskip("scalabel.label.io")
    write(tmp_path, video)
    dataset = loader.load(str(tmp_path / "scalabel.json"))
    assert [category.name for category in dataset.config.categories] == [
        "vehicle",
        "rider & bike",
        "drivable",
        "lane",
        "lane line",
    ]
    assert dataset.frames[0].labels[0].box2d.x2 == 60.0


def test_lines_of_lanes_are_polylines(tmp_path: Path, pictures: list[Perception], road: Road) -> None:
    with ScalabelWriter(tmp_path) as writer:
        writer.write(pictures[1], road.to_dict())
    (label,) = json.loads(writer.files[0].read_text(encoding="utf-8"))["frames"][0]["labels"]
    assert label["poly2d"] == [
        {"vertices": [[40.5, 119.5], [60.5, 96.0], [95.5, 60.5]], "types": "LLL", "closed": False}
    ]
