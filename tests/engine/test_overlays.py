from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from trilitenet.data.sample import Sample
from trilitenet.engine.overlays import FALSE, MISSED, RIGHT, error_overlay, shrunken
from trilitenet.structures import Boxes, Perception


def _decoded(data: bytes) -> NDArray[np.int16]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.int16)


def _perception(**parts: object) -> Perception:
    return Perception(size=(720, 1280), class_names=("vehicle",), **parts)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("size", "wanted"),
    [((720, 1280), (240, 427)), ((48, 96), (48, 96)), ((600, 500), (300, 250)), ((1, 2000), (1, 400))],
)
def test_images_are_shrunk_by_a_whole_number(size: tuple[int, int], wanted: tuple[int, int]) -> None:
    assert shrunken(np.full((*size, 3), 77, np.uint8)).shape == (*wanted, 3)
    assert (shrunken(np.full((*size, 3), 77, np.uint8)) == 77).all()


def test_masks_are_coloured_by_what_is_right_false_and_missed() -> None:
    black = np.zeros((720, 1280, 3), np.uint8)
    predicted, true = np.zeros((720, 1280), np.bool_), np.zeros((720, 1280), np.uint8)
    predicted[:, :800] = True
    true[:, 400:1000] = 1
    sample = Sample(name="a", image=black, drivable=true)
    small = shrunken(black)
    picture = _decoded(error_overlay(small, sample, _perception(drivable=predicted), "drivable", confidence=0.25))
    assert not small.any()  # the caller's picture stays
    for column, colour in ((60, FALSE), (200, RIGHT), (300, MISSED), (400, (0, 0, 0))):
        np.testing.assert_allclose(picture[120, column], np.array(colour) / 2, atol=8)


def test_pixels_that_do_not_count_are_neither_false_nor_missed() -> None:
    black = np.zeros((720, 1280, 3), np.uint8)
    whole, left = np.ones((720, 1280), np.bool_), np.ones((720, 1280), np.bool_)
    left[:, 640:] = False
    sample = Sample(name="a", image=black, drivable=whole.astype(np.uint8), lane=~whole * np.uint8(1), lane_valid=left)
    sample = dataclasses.replace(sample, drivable_valid=left)
    seen = _perception(drivable=~whole, lane=whole)
    for task, colour, opacity in (("drivable", MISSED, 0.5), ("lane", FALSE, 0.85)):
        picture = _decoded(error_overlay(shrunken(black), sample, seen, task, confidence=0.25))  # type: ignore[arg-type]
        np.testing.assert_allclose(picture[120, 100], np.array(colour) * opacity, atol=8)
        assert picture[120, 240:].max() < 8


@pytest.mark.parametrize("column", range(600, 606))
def test_a_line_two_pixels_wide_survives_the_shrinking(column: int) -> None:
    black = np.zeros((720, 1280, 3), np.uint8)
    true = np.zeros((720, 1280), np.uint8)
    true[:, column : column + 2] = 1
    sample = Sample(name="a", image=black, lane=true)
    nothing = np.zeros((720, 1280), np.bool_)
    picture = _decoded(error_overlay(shrunken(black), sample, _perception(lane=nothing), "lane", confidence=0.25))
    assert picture[120, 190:210, 2].max() > 150


def test_boxes_below_the_confidence_are_not_drawn() -> None:
    black = np.zeros((720, 1280, 3), np.uint8)
    box = np.array([[300, 300, 600, 600]], np.float32)
    sample = Sample(name="a", image=black, boxes=box, class_id=np.zeros(1, np.int64))
    for confidence, colour in ((0.5, RIGHT), (0.2, MISSED)):
        boxes = Boxes(box, np.array([confidence], np.float32), np.zeros(1, np.int64))
        picture = _decoded(
            error_overlay(shrunken(black), sample, _perception(boxes=boxes), "detection", confidence=0.25)
        )
        np.testing.assert_allclose(picture[150, 100], colour, atol=40)
        assert not picture[150, 120:180].any()


def test_a_box_of_another_class_is_false_and_one_on_the_own_car_is_not_drawn() -> None:
    black = np.zeros((720, 1280, 3), np.uint8)
    valid = np.ones((720, 1280), np.bool_)
    valid[600:] = False
    truth = np.array([[300, 300, 600, 500]], np.float32)
    sample = Sample(name="a", image=black, boxes=truth, class_id=np.zeros(1, np.int64), valid=valid)
    found = np.concatenate([truth, np.array([[700, 610, 1000, 710]], np.float32)])
    boxes = Boxes(found, np.array([0.9, 0.8], np.float32), np.array([1, 0]))
    small = shrunken(black)
    seen = Perception(size=(720, 1280), class_names=("car", "bus"), boxes=boxes)
    picture = _decoded(error_overlay(small, sample, seen, "detection", confidence=0.25))
    np.testing.assert_allclose(picture[133, 100], FALSE, atol=40)
    assert not picture[200:, 230:340].any()


def test_a_box_that_is_found_is_not_missed_beside() -> None:
    black = np.zeros((720, 1280, 3), np.uint8)
    truth = np.array([[300, 300, 600, 600]], np.float32)
    sample = Sample(name="a", image=black, boxes=truth, class_id=np.zeros(1, np.int64))
    boxes = Boxes(truth + np.array([60, 0, 60, 0], np.float32), np.array([0.9], np.float32), np.zeros(1, np.int64))
    picture = _decoded(error_overlay(shrunken(black), sample, _perception(boxes=boxes), "detection", confidence=0.25))
    np.testing.assert_allclose(picture[150, 120], RIGHT, atol=40)
    assert not picture[150, 96:105].any()


def test_another_class_is_false_where_it_is_labelled_though_the_region_is_ignored() -> None:
    black = np.zeros((720, 1280, 3), np.uint8)
    truth = np.array([[300, 300, 600, 600]], np.float32)
    region = np.array([[150, 150, 750, 690]], np.float32)
    boxes = Boxes(truth, np.array([0.9], np.float32), np.ones(1, np.int64))
    seen = Perception(size=(720, 1280), class_names=("car", "bus"), boxes=boxes)
    for labels, colour in ((truth, FALSE), (truth[:0], (0, 0, 0))):
        sample = Sample(name="a", image=black, boxes=labels, class_id=np.zeros(len(labels), np.int64), ignored=region)
        picture = _decoded(error_overlay(shrunken(black), sample, seen, "detection", confidence=0.25))
        np.testing.assert_allclose(picture[150, 100], colour, atol=40)


def test_a_lower_quality_takes_fewer_bytes() -> None:
    image = np.random.default_rng(0).integers(0, 256, (90, 160, 3), dtype=np.uint8)
    sample = Sample(name="a", image=image)
    sizes = [
        len(error_overlay(image, sample, _perception(), "lane", confidence=0.25, quality=quality))
        for quality in (20, 80)
    ]
    assert sizes[0] < sizes[1] / 2
