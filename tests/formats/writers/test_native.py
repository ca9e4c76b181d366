from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from trilitenet.formats.writers.native import JsonLinesWriter, JsonWriter, read_schema, to_document
from trilitenet.road.structures import Road
from trilitenet.structures import SCHEMA_VERSION, Perception


@pytest.fixture(scope="module")
def validator() -> jsonschema.Draft202012Validator:
    schema = read_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_pictures_and_videos_follow_the_schema(
    tmp_path: Path, pictures: list[Perception], video: list[Perception], validator: jsonschema.Draft202012Validator
) -> None:
    with JsonWriter(tmp_path) as writer:
        for perception in [*pictures, *video]:
            writer.write(perception)
    assert [path.name for path in writer.files] == ["road.json", "road-2.json", "drive.json"]
    documents = [json.loads(path.read_text(encoding="utf-8")) for path in writer.files]
    for document in documents:
        validator.validate(document)
    assert [frame["frame"] for frame in documents[2]["frames"]] == [0, 1, 2, 3]
    assert documents[2]["source"] == "drive.mp4"
    back = Perception.from_dict(documents[0])
    np.testing.assert_array_equal(back.lane, pictures[0].lane)


def test_each_video_has_a_file(tmp_path: Path, video: list[Perception]) -> None:
    other = [dataclasses.replace(frame, source="other.mp4") for frame in video[:2]]
    with JsonWriter(tmp_path) as writer:
        for frame in [*video, *other]:
            writer.write(frame)
    documents = {path.name: json.loads(path.read_text(encoding="utf-8")) for path in writer.files}
    assert {name: len(document["frames"]) for name, document in documents.items()} == {"drive.json": 4, "other.json": 2}


@pytest.mark.parametrize(
    ("key", "value"),
    [("schema", "2.0"), ("boxes", [{"xyxy": [1, 2, 3]}]), ("drivable", []), ("frame", -1), ("class_names", [])],
)
def test_the_schema_refuses_what_is_wrong(
    pictures: list[Perception], validator: jsonschema.Draft202012Validator, key: str, value: object
) -> None:
    document = to_document(pictures[0])
    assert validator.is_valid(document)
    assert not validator.is_valid({**document, key: value})


def test_a_missing_task_is_null(pictures: list[Perception], validator: jsonschema.Draft202012Validator) -> None:
    document = to_document(Perception(size=(4, 6), source=None))
    validator.validate(document)
    assert document["boxes"] is document["drivable"] is document["lane"] is None


def test_json_lines_are_readable_while_they_grow(tmp_path: Path, video: list[Perception]) -> None:
    with JsonLinesWriter(tmp_path) as writer:
        writer.write(video[0])
        assert json.loads(writer.files[0].read_text(encoding="utf-8"))["frame"] == 0
        writer.write(video[1])
    lines = writer.files[0].read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["frame"] for line in lines] == [0, 1]


def test_the_schema_is_of_this_version() -> None:
    assert read_schema()["$id"].endswith(f":{SCHEMA_VERSION}")


def test_the_road_follows_the_schema(
    pictures: list[Perception], road: Road, validator: jsonschema.Draft202012Validator
) -> None:
    for known in (road, Road()):
        document = to_document(pictures[0], known.to_dict())
        validator.validate(json.loads(json.dumps(document)))
        assert document["road"]["lines"] == known.to_dict()["lines"]
    document["road"]["events"] = [{"kind": "lane_departure_up"}]
    assert not validator.is_valid(document)
    for key, value in (("polynomial", [0.0] * 4), ("origin", [119.0])):
        document = to_document(pictures[0], road.to_dict())
        document["road"]["lines"][0][key] = value
        assert not validator.is_valid(document)


def test_the_schema_describes_every_key(pictures: list[Perception], road: Road) -> None:
    """No key is written that the schema does not describe."""
    schema = read_schema()

    def check(value: object, description: dict[str, Any], path: str) -> None:
        if "$ref" in description:
            check(value, schema["$defs"][description["$ref"].rpartition("/")[2]], path)
        elif "oneOf" in description and value is not None:
            check(value, next(option for option in description["oneOf"] if option.get("type") != "null"), path)
        elif isinstance(value, dict):
            known = description.get("properties", {})
            assert set(value) <= set(known), path
            for key, item in value.items():
                check(item, known[key], f"{path}.{key}")
        elif isinstance(value, list):
            for item in value:
                check(item, description.get("items", {}), f"{path}[]")

    check(to_document(pictures[0], road.to_dict()), schema["$defs"]["perception"], "perception")
