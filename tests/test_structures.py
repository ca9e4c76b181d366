from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from trilitenet.errors import ShapeError
from trilitenet.structures import Boxes, Perception, RawOutputs


def boxes(*class_id: int) -> Boxes:
    count = len(class_id)
    corners = np.arange(4 * count, dtype=np.float32).reshape(-1, 4)
    return Boxes(corners, np.full(count, 0.5, np.float32), np.array(class_id), 10 + np.arange(count))


def test_selected_boxes_keep_all_that_is_known_of_them() -> None:
    for index in (np.array([False, True, True]), np.array([1, 2])):
        chosen = boxes(0, 1, 0).select(index)
        assert chosen.xyxy[:, 0].tolist() == [4, 8]
        assert chosen.class_id.tolist() == [1, 0]
        assert chosen.track_id is not None
        assert chosen.track_id.tolist() == [11, 12]


@pytest.mark.parametrize("class_id", [-1, 2])
def test_a_class_without_a_name_is_refused(class_id: int) -> None:
    with pytest.raises(ShapeError, match=f"class id {class_id} has no name"):
        Perception((10, 10), ("car", "bus"), boxes(0, class_id, 1))


def test_a_number_is_no_list_of_boxes() -> None:
    with pytest.raises(ShapeError, match=r"xyxy must be \(N, 4\), got \(\)"):
        Boxes(np.float32(1), np.zeros(0, np.float32), np.zeros(0, np.int64))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("detection", np.zeros((1, 2, 5), np.float32)),  # no class
        ("detection", np.zeros((2, 6), np.float32)),
        ("drivable", np.zeros((1, 4, 4), np.float32)),
        ("lane", np.zeros((4, 4), np.uint8)),
        ("lane", [[[0]]]),
        ("detection", [[[0.0] * 6]]),
    ],
)
def test_outputs_of_another_form_are_refused(field: str, value: np.ndarray) -> None:
    outputs = {"detection": None, "drivable": None, "lane": None, field: value}
    with pytest.raises(ShapeError, match=f"{field} must be"):
        RawOutputs(**outputs)
    RawOutputs(np.zeros((1, 0, 6), np.float32), None, None)


@pytest.mark.parametrize(
    ("field", "value", "got"),
    [
        ("drivable", [[True, False]], r"must be \(1, 2\) bool, got no array but a list"),
        ("lane", np.zeros((1, 2), np.uint8), r"must be \(1, 2\) bool, got \(1, 2\) uint8"),
        ("lane", np.zeros((2, 1), bool), r"must be \(1, 2\) bool, got \(2, 1\) bool"),
        ("image", [[[0, 0, 0]] * 2], r"must be \(1, 2, 3\), got no array but a list"),
        ("boxes", [[0, 0, 1, 1]], "must be Boxes, got a list"),
    ],
)
def test_a_perception_of_other_things_is_refused(field: str, value: Any, got: str) -> None:
    with pytest.raises(ShapeError, match=f"{field} {got}"):
        Perception((1, 2), **{field: value})
    Perception([1, 2], drivable=np.zeros((1, 2), bool))  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["class_id", "track_id"])
@pytest.mark.parametrize(
    "value", [np.array([0.7]), np.array([-0.5]), np.array([np.nan]), np.array([2**63 + 5], np.uint64)]
)
def test_numbers_that_would_become_others_are_refused(name: str, value: Any) -> None:
    arrays = {"class_id": [0], name: value}
    with pytest.raises(ShapeError, match=f"{name} must be whole numbers"):
        Boxes(np.zeros((1, 4)), np.ones(1), **arrays)  # type: ignore[arg-type]
    assert Boxes(np.zeros((1, 4)), np.ones(1), np.array([2.0])).class_id.tolist() == [2]  # type: ignore[arg-type]


def test_boxes_of_nothing_are_refused() -> None:
    with pytest.raises(ShapeError, match="xyxy must be an array of float32, got None"):
        Boxes(None, np.ones(1), np.zeros(1, np.int64))  # type: ignore[arg-type]


def test_a_perception_is_shown_on_one_line() -> None:
    drivable, lane = np.zeros((4, 25), bool), np.zeros((4, 25), bool)
    drivable[:2, :15], lane[0, :3] = True, True
    assert repr(Perception((4, 25), ("car", "bus"), boxes(0, 1), drivable, lane)) == (
        "Perception(25x4, 2 boxes, drivable 30%, lane 3%)"
    )
    assert repr(Perception((4, 25), boxes=boxes(0))) == "Perception(25x4, 1 box)"
    assert repr(Perception((0, 0), lane=np.zeros((0, 0), bool))) == "Perception(0x0, lane 0%)"


@pytest.mark.parametrize("size", ["ab", (1, 2, 3), None, (-1, 2), (1.0, 2.0)])
def test_a_size_is_two_whole_numbers(size: Any) -> None:
    with pytest.raises(ShapeError, match="size must be"):
        Perception(size)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("source", 3),
        ("frame", 1.5),
        ("frame", "1"),
        ("timestamp", "1"),
        ("timestamp", float("nan")),
        ("timestamp", np.float32("inf")),
    ],
)
def test_where_an_image_is_from_is_checked_when_it_is_told(field: str, value: Any) -> None:
    with pytest.raises(ShapeError, match=f"{field} must be a"):
        Perception((2, 2), **{field: value})


def test_a_text_is_no_list_of_names() -> None:
    with pytest.raises(ShapeError, match=r"write \('vehicle',\)"):
        Perception((2, 2), class_names="vehicle")  # type: ignore[arg-type]
