from __future__ import annotations

import copy
import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pycocotools import mask as coco_mask

from trilitenet.errors import ShapeError
from trilitenet.processing.serialise import decode_mask, encode_mask
from trilitenet.structures import Boxes, Perception


def perception(*, track: bool = False) -> Perception:
    rng = np.random.default_rng(0)
    return Perception(
        size=(40, 60),
        class_names=("car", "bus"),
        boxes=Boxes(
            np.array([[1.25, 2, 30, 20.5], [5, 5, 9, 9]], np.float32),
            np.array([0.9, 0.5], np.float32),
            np.array([0, 1]),
            np.array([7, -1]) if track else None,
        ),
        drivable=rng.random((40, 60)) > 0.5,
        lane=np.zeros((40, 60), bool),
        source="a.mp4",
        frame=3,
        timestamp=0.1,
    )


@pytest.mark.parametrize("track", [False, True])
def test_json_there_and_back(track: bool) -> None:
    before = perception(track=track)
    text = json.dumps(before.to_dict())
    after = Perception.from_dict(json.loads(text))
    assert json.dumps(after.to_dict()) == text
    assert before.boxes is not None
    assert after.boxes is not None
    np.testing.assert_array_equal(after.boxes.xyxy, before.boxes.xyxy)
    np.testing.assert_array_equal(after.drivable, before.drivable)
    np.testing.assert_array_equal(after.lane, before.lane)
    assert (after.boxes.track_id is not None) == track


def test_masks_are_what_coco_tools_read() -> None:
    rng = np.random.default_rng(1)
    for density in (0.0, 0.02, 0.5, 1.0):
        mask = rng.random((37, 53)) < density
        mask[:, 20:30] = True
        encoded = encode_mask(mask)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pycocotools' own, about NumPy 2
            np.testing.assert_array_equal(coco_mask.decode(encoded), mask)
        np.testing.assert_array_equal(decode_mask(encoded), mask)


def test_what_coco_tools_wrote_is_read() -> None:
    mask = np.eye(5, 7, dtype=np.bool_)
    encoded = coco_mask.encode(np.asfortranarray(mask.astype(np.uint8)))
    np.testing.assert_array_equal(decode_mask(encoded), mask)


def test_boxes_take_lists_and_refuse_what_is_no_array() -> None:
    boxes = Boxes([[1, 2, 3, 4]], [0.5], [0])  # type: ignore[arg-type]
    assert [str(array.dtype) for array in (boxes.xyxy, boxes.confidence, boxes.class_id)] == ["float32"] * 2 + ["int64"]
    for broken in ([[1, 2, 3, 4], [1]], "x", 3.0):
        with pytest.raises(ShapeError, match="xyxy must be"):
            Boxes(broken, [0.5], [0])  # type: ignore[arg-type]
    for corners, confidence in (([1, 2, np.nan, 4], 0.5), ([1, 2, 3, np.inf], 0.5), ([1, 2, 3, 4], np.nan)):
        with pytest.raises(ShapeError, match="must be finite"):
            Boxes([corners], [confidence], [0])  # type: ignore[arg-type]


def test_numbers_of_numpy_and_paths_become_json() -> None:
    boxes = Boxes(np.ones((1, 4), np.float32), np.ones(1, np.float32), np.zeros(1, np.int64))
    size: Any = tuple(np.array([4, 6]))
    given: dict[str, Any] = {"source": Path("a.jpg"), "frame": np.int64(3), "timestamp": np.float32(0.5)}
    told = json.loads(json.dumps(Perception(size=size, boxes=boxes, **given).to_dict(), allow_nan=False))
    assert (told["source"], told["frame"], told["timestamp"], told["size"]["width"]) == ("a.jpg", 3, 0.5, 6)


def test_an_absent_task_is_null_and_an_empty_one_is_empty() -> None:
    absent = Perception(size=(4, 4)).to_dict()
    assert absent["boxes"] is absent["drivable"] is absent["lane"] is None
    empty = Perception.from_dict(Perception(size=(4, 4), boxes=Boxes.empty()).to_dict())
    assert empty.boxes is not None
    assert len(empty.boxes) == 0


@pytest.mark.parametrize(
    "change",
    [
        {"schema": "2.0"},
        {"schema": None},
        {"size": [4, 4]},
        {"boxes": [{"xyxy": [1, 2, 3]}]},
        {"drivable": {"size": [40, 60]}},
        {"drivable": {"size": [1, 1], "counts": "PPn0"}},
        {"lane": "x"},
        {"lane": {"size": [40, 60], "counts": ""}},
        {"lane": {"size": [40, 60], "counts": "P"}},
        {"lane": {"size": [40, 60], "counts": "ooooooooooooooo0"}},
        {"lane": {"size": [-40, -60], "counts": "PPn0"}},
        {"class_names": ["car"]},
        {"class_names": "vehicle"},
        {"size": {"height": float("inf"), "width": 4}},
        {"size": {"height": -5, "width": 7}, "boxes": None, "drivable": None, "lane": None},
        {"timestamp": "soon"},
        {"boxes": [{"xyxy": [1, 2, 3, 4], "confidence": 0.5, "class_id": -1}]},
        {"boxes": [{"xyxy": [1, 2, 3, 4], "confidence": 0.5, "class_id": 10**30}]},
        {"lane": {"size": [40, 60], "counts": [2400]}},
        {"schema": "0.9"},
        {"schema": "1.x"},
        {"size": {"height": 40.9, "width": 60}},
        {"boxes": {}},
        {"boxes": [{"xyxy": [1, 2, 3, 4], "confidence": 0.5, "class_id": 0.7}]},
        {"boxes": [{"xyxy": [1, 2, None, 4], "confidence": 0.5, "class_id": 0}]},
        {"boxes": [{"xyxy": [1, 2, 3, 4], "confidence": "0.5", "class_id": 0}]},
        {"boxes": [{"xyxy": [1, 2, 3, 4], "confidence": float("nan"), "class_id": 0}]},
        {"frame": "abc"},
        {"source": 3},
        {"timestamp": True},
        {"timestamp": float("inf")},
    ],
)
def test_what_is_not_that_form_is_refused(change: dict[str, Any]) -> None:
    mapping = copy.deepcopy(perception().to_dict()) | change
    with pytest.raises(ShapeError):
        Perception.from_dict(mapping)


def test_whole_numbers_with_a_point_are_taken_as_the_schema_does() -> None:
    form = Perception((4, 6), ("a",), Boxes.empty(), frame=3).to_dict()
    form |= {"frame": 3.0, "size": {"height": 4.0, "width": 6.0}}
    seen = Perception.from_dict(form)
    assert (seen.frame, seen.size) == (3, (4, 6))
    assert isinstance(seen.frame, int)


def test_a_box_without_an_identity_among_others_that_have_one_is_of_no_track() -> None:
    document = perception(track=True).to_dict()
    del document["boxes"][1]["track_id"]
    boxes = Perception.from_dict(document).boxes
    assert boxes is not None
    assert boxes.track_id is not None
    assert boxes.track_id.tolist() == [7, -1]
