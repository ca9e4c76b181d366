from __future__ import annotations

import numpy as np

from trilitenet.processing.boxes import box_area, box_iou, clip_boxes, cxcywh_to_xyxy, lie_on_mask, xyxy_to_cxcywh


def test_forms_are_inverse() -> None:
    boxes = np.array([[10, 20, 4, 8], [0.5, 0.5, 1, 1]], np.float32)
    np.testing.assert_array_equal(cxcywh_to_xyxy(boxes), [[8, 16, 12, 24], [0, 0, 1, 1]])
    np.testing.assert_array_equal(xyxy_to_cxcywh(cxcywh_to_xyxy(boxes)), boxes)


def test_iou_of_known_pairs() -> None:
    first = np.array([[0, 0, 10, 10], [5, 5, 5, 5]], np.float32)
    second = np.array([[0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30], [5, 5, 5, 5]], np.float32)
    np.testing.assert_allclose(box_iou(first, second), np.array([[1, 1 / 3, 0, 0], [0, 0, 0, 0]]), rtol=1e-6)
    assert box_iou(first[:0], second).shape == (0, 4)


def test_area_of_an_inside_out_box_is_zero() -> None:
    np.testing.assert_array_equal(box_area(np.array([[0, 0, 2, 3], [2, 2, 1, 5]], np.float32)), [6, 0])


def test_clip() -> None:
    np.testing.assert_array_equal(clip_boxes(np.array([[-1.0, -1, 700, 500]]), (480, 640)), [[0, 0, 640, 480]])


def test_more_than_half_of_a_box_lies_on_a_mask_by_hand() -> None:
    mask = np.zeros((40, 40), np.bool_)
    mask[30:] = True
    rows = [(0, 24, 10, 36), (0, 24, 10, 37), (10, 32, 20, 36), (0, 25.4, 10, 35.6), (-5, 35, 10, 90), (3, 3, 3, 3)]
    # On it: 6 of 12 rows; 7 of 13; all; 6 of the 11 from 25 to 36; all that is in the picture; nothing of nothing.
    assert lie_on_mask(np.array(rows, np.float64), mask).tolist() == [False, True, True, True, True, False]
    assert lie_on_mask(np.zeros((0, 4), np.float32), mask).shape == (0,)
