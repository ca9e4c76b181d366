from __future__ import annotations

import cv2
import numpy as np

from trilitenet.processing.polygons import mask_to_polygons, polygons_to_mask


def test_a_rectangle_is_its_four_corners() -> None:
    mask = np.zeros((40, 60), np.bool_)
    mask[10:20, 5:50] = True
    (polygon,) = mask_to_polygons(mask)
    assert {tuple(point) for point in polygon.tolist()} == {(5, 10), (49, 10), (49, 19), (5, 19)}


def test_there_and_back_keeps_a_smooth_region() -> None:
    mask = np.zeros((360, 640), np.uint8)
    cv2.fillPoly(mask, [np.array([[0, 359], [250, 150], [330, 140], [420, 170], [639, 300], [639, 359]])], 1)
    inside = mask.astype(np.bool_)
    (polygon,) = mask_to_polygons(inside, tolerance=1.0)
    back = polygons_to_mask([polygon], inside.shape)
    assert len(polygon) < 20
    assert (inside & back).sum() / (inside | back).sum() > 0.99


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
    assert not polygons_to_mask([], (8, 8)).any()


def test_thin_regions_stay() -> None:
    for top, bottom, left, right in ((30, 32, 20, 180), (30, 31, 20, 180), (9, 60, 7, 8)):
        mask = np.zeros((60, 200), np.bool_)
        mask[top:bottom, left:right] = True
        (polygon,) = mask_to_polygons(mask)
        assert len(polygon) >= 3
        np.testing.assert_array_equal(polygons_to_mask([polygon], mask.shape), mask)
    slanted = np.zeros((200, 200), np.uint8)
    cv2.line(slanted, (20, 20), (180, 100), 1)
    (polygon,) = mask_to_polygons(slanted)
    assert len(polygon) >= 3
