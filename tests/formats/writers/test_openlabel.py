from __future__ import annotations

import base64
import dataclasses
import json
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import jsonschema
import numpy as np
import pytest

from trilitenet.formats.writers.openlabel import OpenLabelWriter, _intervals
from trilitenet.road.structures import Road
from trilitenet.structures import Perception


def write(output: Path, perceptions: list[Perception]) -> list[dict[str, Any]]:
    with OpenLabelWriter(output) as writer:
        for perception in perceptions:
            writer.write(perception)
    return [json.loads(path.read_text(encoding="utf-8")) for path in writer.files]


def official_schema() -> jsonschema.Draft7Validator:
    package = pytest.importorskip("uai_openlabel")
    file = resources.files(package).joinpath("official_schema").joinpath("openlabel_json_schema.json")
    return jsonschema.Draft7Validator(json.loads(file.read_text(encoding="utf-8")))


def test_the_standards_own_schema_accepts_it(
    tmp_path: Path, pictures: list[Perception], video: list[Perception]
) -> None:
    package = pytest.importorskip("uai_openlabel")
    validator = official_schema()
    documents = write(tmp_path, [*pictures, *video])
    assert len(documents) == 3
    for document in documents:
        validator.validate(document)
        package.OpenLabel.from_dict(document)
    broken = json.loads(json.dumps(documents[0]).replace('"mime_type"', '"mime"'))
    assert not validator.is_valid(broken), "the schema can refuse"


def test_boxes_and_masks_come_back(tmp_path: Path, pictures: list[Perception]) -> None:
    content = write(tmp_path, pictures[:1])[0]["openlabel"]
    objects = content["frames"]["0"]["objects"]
    box = objects["2"]["object_data"]["bbox"][0]
    assert box["val"] == pytest.approx([35.125, 35.25, 49.75, 30.5], abs=0.01)
    assert box["attributes"]["num"] == [{"name": "confidence", "val": 0.9}]
    image = objects["0"]["object_data"]["image"][0]
    mask = cv2.imdecode(np.frombuffer(base64.b64decode(image["val"]), np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(mask == 255, pictures[0].drivable)
    assert base64.b64decode(image["val"])[24] == 1  # bit a pixel
    assert content["streams"]["camera"]["uri"] == "day/road.jpg"


def test_objects_say_when_they_were_seen(tmp_path: Path, video: list[Perception]) -> None:
    content = write(tmp_path, video)[0]["openlabel"]
    vehicles = [thing for thing in content["objects"].values() if thing["type"] == "vehicle"]
    assert [vehicle["frame_intervals"] for vehicle in vehicles] == [
        [{"frame_start": 0, "frame_end": 1}, {"frame_start": 3, "frame_end": 3}]
    ]
    assert len([thing for thing in content["objects"].values() if thing["type"] == "rider & bike"]) == 4
    assert content["objects"]["1"]["frame_intervals"] == [{"frame_start": 0, "frame_end": 2}]
    assert content["frame_intervals"] == [{"frame_start": 0, "frame_end": 3}]
    assert content["frames"]["3"]["frame_properties"]["timestamp"] == 0.12


def test_pictures_without_a_name_have_a_file_each(tmp_path: Path, pictures: list[Perception]) -> None:
    documents = write(tmp_path, [dataclasses.replace(picture, source=None) for picture in pictures])
    assert [list(document["openlabel"]["frames"]) for document in documents] == [["0"], ["0"]]


def test_time_is_told_to_the_microsecond(tmp_path: Path, video: list[Perception]) -> None:
    frames = [dataclasses.replace(frame, timestamp=index / 30) for index, frame in enumerate(video)]
    content = write(tmp_path, frames)[0]["openlabel"]["frames"]
    assert [content[str(index)]["frame_properties"]["timestamp"] for index in range(3)] == [0, 0.033333, 0.066667]


def test_intervals_by_hand() -> None:
    ends = [(one["frame_start"], one["frame_end"]) for one in _intervals([0, 0, 1, 3, 3, 4])]
    assert ends == [(0, 1), (3, 4)]


def test_a_track_that_changes_its_class_is_two(tmp_path: Path, video: list[Perception]) -> None:
    boxes = video[1].boxes
    assert boxes is not None
    changed = dataclasses.replace(video[1], boxes=dataclasses.replace(boxes, class_id=1 - boxes.class_id))
    objects = write(tmp_path, [video[0], changed])[0]["openlabel"]["objects"].values()
    tracked = [
        (one["type"], [interval["frame_start"] for interval in one["frame_intervals"]])
        for one in objects
        if one["type"] in video[0].class_names
    ]
    one, other = video[0].class_names
    assert sorted(tracked) == sorted([(one, [0]), (other, [0]), (one, [1]), (other, [1])])


def test_a_line_and_a_track_of_one_number_are_two_objects(tmp_path: Path, video: list[Perception], road: Road) -> None:
    boxes = video[0].boxes
    assert boxes is not None
    (line,) = road.to_dict()["lines"]
    tracked = dataclasses.replace(boxes, track_id=np.array([line["id"], -1]))
    with OpenLabelWriter(tmp_path) as writer:
        writer.write(dataclasses.replace(video[0], boxes=tracked), road.to_dict())
    objects = json.loads(writer.files[0].read_text(encoding="utf-8"))["openlabel"]["objects"]
    kinds = [thing["type"] for thing in objects.values()]
    assert sorted(kinds) == ["drivable area", "lane line", "lane marking", "rider & bike", "vehicle"]


def test_the_road_is_objects_and_a_context(tmp_path: Path, video: list[Perception], road: Road) -> None:
    with OpenLabelWriter(tmp_path) as writer:
        for frame in video[:2]:
            writer.write(frame, road.to_dict())
    document = json.loads(writer.files[0].read_text(encoding="utf-8"))
    official_schema().validate(document)
    content = document["openlabel"]
    (uid,) = [uid for uid, thing in content["objects"].items() if thing["type"] == "lane line"]
    curve = content["frames"]["1"]["objects"][uid]["object_data"]["poly2d"][0]["val"]
    assert curve == [40.5, 119.5, 60.5, 96.0, 95.5, 60.5]
    figures = {
        figure["name"]: figure["val"] for figure in content["frames"]["0"]["contexts"]["0"]["context_data"]["num"]
    }
    assert figures == {
        "lane_width": 3.5,
        "lane_offset": 0.25,
        "lane_heading": -0.01,
        "lead_distance": 22.5,
        "lead_closing_speed": 2.0,
    }
    assert content["contexts"]["0"]["frame_intervals"] == [{"frame_start": 0, "frame_end": 1}]
