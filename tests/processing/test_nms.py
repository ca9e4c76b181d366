from __future__ import annotations

import numpy as np
import pytest

from trilitenet.processing.boxes import box_iou
from trilitenet.processing.nms import nms

BOXES = np.array([[0, 0, 10, 10], [1, 0, 11, 10], [20, 20, 30, 30], [0, 0, 10, 10]], np.float32)
SCORES = np.array([0.8, 0.9, 0.7, 0.6], np.float32)


def test_overlapping_boxes_of_one_class_go() -> None:
    assert nms(BOXES, SCORES, np.zeros(4, np.int64), 0.5, 100).tolist() == [1, 2]


def test_classes_do_not_suppress_each_other() -> None:
    assert nms(BOXES, SCORES, np.array([0, 1, 0, 0]), 0.5, 100).tolist() == [1, 0, 2]


def test_an_overlap_of_exactly_the_threshold_stays() -> None:
    boxes = np.array([[0, 0, 10, 10], [0, 0, 10, 5]], np.float32)
    scores, classes = np.array([0.9, 0.8], np.float32), np.zeros(2, np.int64)
    assert nms(boxes, scores, classes, 0.5, 100).tolist() == [0, 1]
    assert nms(boxes, scores, classes, 0.49, 100).tolist() == [0]


def test_number_of_boxes_is_bounded_and_none_is_none() -> None:
    assert nms(BOXES, SCORES, np.zeros(4, np.int64), 0.5, 1).tolist() == [1]
    assert nms(BOXES[:0], SCORES[:0], np.zeros(0, np.int64), 0.5, 10).tolist() == []


@pytest.mark.parametrize(("count", "class_count"), [(300, 3), (300, 1), (2000, 2)])
def test_agrees_with_the_definition_on_random_boxes(count: int, class_count: int) -> None:
    rng = np.random.default_rng(3)
    low = rng.uniform(0, 200 * count / 300, (count, 2))
    boxes = np.concatenate([low, low + rng.uniform(5, 60, (count, 2))], axis=1).astype(np.float32)
    scores, classes = rng.random(count).astype(np.float32), rng.integers(0, class_count, count)
    kept = nms(boxes, scores, classes, 0.45, count)
    assert (np.diff(scores[kept]) <= 0).all()
    assert nms(boxes, scores, classes, 0.45, 50).tolist() == kept[:50].tolist()
    overlap = box_iou(boxes, boxes)
    for i in range(count):
        better = [k for k in kept if scores[k] > scores[i] and classes[k] == classes[i]]
        assert (i in kept) == (not better or overlap[i, better].max() <= 0.45)


def test_boxes_outside_the_image_meet_their_own_class_alone() -> None:
    scores = np.array([0.9, 0.8], np.float32)
    left = np.array([[0, 0, 10, 10], [-11, -11, -1, -1]], np.float32)
    assert nms(left, scores, np.array([0, 1]), 0.5, 300).tolist() == [0, 1]
    large = np.array([[0, 0, 640, 384], [-600, -400, 600, 400]], np.float32)
    assert nms(large, scores, np.array([0, 1]), 0.05, 300).tolist() == [0, 1]


def test_empty_boxes_overlap_nothing() -> None:
    boxes = np.array([[0, 0, 0, 0], [0, 0, 9, 9], [50, 50, 50, 50], [0, 0, 9, 8]], np.float32)
    scores = np.array([0.9, 0.8, 0.7, 0.6], np.float32)
    assert nms(boxes, scores, np.zeros(4, np.int64), 0.5, 300).tolist() == [0, 1, 2]
