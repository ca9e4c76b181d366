from __future__ import annotations

import cv2
import numpy as np

from trilitenet.processing.polygons import mask_to_polygons


def test_a_rectangle_is_its_four_corners() -> None:
    mask = np.zeros((40, 60), np.bool_)
    mask[10:20, 5:50] = True
    (polygon,) = mask_to_polygons(mask)
    assert {tuple(point) for point in polygon.tolist()} == {(5, 10), (49, 10), (49, 19), (5, 19)}


def test_there_and_back_keeps_a_smooth_region() -> None:
    mask = np.zeros((360, 640), np.uint8)
    cv2.fillPoly(mask, [np.array([[0, 359], [250, 150], [330, 140], [420, 170], [639, 300], [639, 359]])], 1)
    (polygon,) = mask_to_polygons(mask.astype(np.bool_), tolerance=1.0)
    back = cv2.fillPoly(np.zeros_like(mask), [np.rint(polygon).astype(np.int32)], 1)
    assert len(polygon) < 20
    assert (mask & back).sum() / (mask | back).sum() > 0.99


def test_specks_go_and_the_largest_comes_first() -> None:
    mask = np.zeros((40, 60), np.bool_)
    mask[0:2, 0:2] = True
    mask[5:10, 5:10] = True
    mask[15:35, 15:55] = True
    polygons = mask_to_polygons(mask)
    assert [len(polygon) for polygon in polygons] == [4, 4]
    assert polygons[0].min() == 15


def test_nothing_gives_nothing() -> None:
    assert mask_to_polygons(np.zeros((8, 8), np.bool_)) == []


def test_thin_regions_stay() -> None:
    for top, bottom, left, right in ((30, 32, 20, 180), (30, 31, 20, 180), (9, 60, 7, 8)):
        mask = np.zeros((60, 200), np.uint8)
        mask[top:bottom, left:right] = 1
        (polygon,) = mask_to_polygons(mask)
        assert len(polygon) >= 3
        np.testing.assert_array_equal(cv2.fillPoly(np.zeros_like(mask), [polygon.astype(np.int32)], 1), mask)
    slanted = np.zeros((200, 200), np.uint8)
    cv2.line(slanted, (20, 20), (180, 100), 1)
    (polygon,) = mask_to_polygons(slanted)
    assert len(polygon) >= 3
