from __future__ import annotations

import cv2
import numpy as np
import pytest

from trilitenet.processing.geometry import Camera
from trilitenet.road.camera import CameraErrors
from trilitenet.road.ego import BOX_ERROR_SHARE, find_distances, fit_ego_lane
from trilitenet.road.lanes import find_lines
from trilitenet.road.structures import LaneLine
from trilitenet.structures import Boxes

CAMERA = Camera.from_field_of_view((720, 1280), 60.0, 1.4, pitch=0.03)


def line_at(y: float) -> LaneLine:
    """Return the curve of a straight marking, y metres left of the camera."""
    ahead = np.linspace(4.5, 60, 200)
    mask = np.zeros(CAMERA.size, np.uint8)
    pixels = CAMERA.to_pixels(np.stack([ahead, np.full_like(ahead, y)], axis=1))
    cv2.polylines(mask, [np.round(pixels).astype(np.int32)], False, 1, 6)
    (line,) = find_lines(mask)
    return line


@pytest.mark.parametrize(("left", "right", "offset"), [(2.0, -1.5, -0.25), (1.0, -2.6, 0.8), (6.0, 2.4, None)])
def test_offset_is_told_of_the_lane_that_the_vehicle_is_in(left: float, right: float, offset: float | None) -> None:
    fit = fit_ego_lane(line_at(left), line_at(right), CAMERA, CameraErrors())
    assert fit is not None
    assert fit.lane.width is not None
    assert fit.lane.width.value == pytest.approx(left - right, abs=0.1)
    if offset is None:
        assert fit.lane.offset is None, "both lines are on one side"
    else:
        assert fit.lane.offset is not None
        assert fit.lane.offset.value == pytest.approx(offset, abs=0.05)


def test_the_lower_edge_of_a_large_box_is_less_sure() -> None:
    foot = float(CAMERA.to_pixels(np.array([[20.0, 0.0]]))[0, 1])
    sides = np.array([20.0, 100.0, 140.0])
    boxes = Boxes(
        np.stack([640 - sides / 2, foot - sides, 640 + sides / 2, np.full(3, foot)], axis=1).astype(np.float32),
        np.full(3, 0.9, np.float32),
        np.zeros(3, np.int64),
    )
    found = find_distances(boxes, CAMERA, CameraErrors())
    values = [one.value for one in found if one is not None]
    errors = [one.error for one in found if one is not None]
    assert len(values) == 3
    assert values == pytest.approx([values[0]] * 3)
    assert errors == sorted(errors)
    # 20 m away, a pixel is 20^2 / (1.4 f) metres.
    assert errors[2] == pytest.approx(BOX_ERROR_SHARE * sides[2] * 20**2 / 1.4 / CAMERA.fy, rel=0.15)
