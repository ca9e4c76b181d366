"""Perceptions with all there can be: two pictures, and a short video with tracks, a gap and a model of two tasks."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from trilitenet.processing.geometry import Camera
from trilitenet.road.structures import EgoLane, Estimate, Event, GroundCurve, LaneLine, LeadVehicle, Road
from trilitenet.structures import Boxes, Perception

SIZE = (120, 200)
CLASSES = ("vehicle", "rider & bike")


def make_boxes(rows: list[tuple[float, float, float, float, float, int, int]], *, tracked: bool) -> Boxes:
    table = np.array(rows, np.float64).reshape(-1, 7)
    return Boxes(
        xyxy=table[:, :4].astype(np.float32),
        confidence=table[:, 4].astype(np.float32),
        class_id=table[:, 5].astype(np.int64),
        track_id=table[:, 6].astype(np.int64) if tracked else None,
    )


def make_masks(shift: int) -> tuple[np.ndarray, np.ndarray]:
    drivable, lane = np.zeros(SIZE, np.uint8), np.zeros(SIZE, np.uint8)
    cv2.fillPoly(drivable, [np.array([[20 + shift, 119], [90, 60], [110, 60], [180, 119]])], 1)
    cv2.line(lane, (40 + shift, 119), (95, 60), 1, 3)
    cv2.line(lane, (160, 119), (105, 60), 1, 3)
    return drivable.astype(np.bool_), lane.astype(np.bool_)


@pytest.fixture
def pictures() -> list[Perception]:
    drivable, lane = make_masks(0)
    found = make_boxes([(10.25, 20, 60, 50.5, 0.9, 0, -1), (100, 30, 130, 70, 0.5, 1, -1)], tracked=False)
    nothing = np.zeros(SIZE, np.bool_)
    return [
        Perception(SIZE, CLASSES, found, drivable, lane, source="day/road.jpg"),
        Perception(SIZE, CLASSES, Boxes.empty(), nothing, nothing, source="night/road.jpg"),
    ]


@pytest.fixture
def video() -> list[Perception]:
    frames = []
    for index in range(4):
        drivable, lane = make_masks(index)
        rows = [(10.0 + index, 20, 60 + index, 50, 0.9, 0, 7)] if index != 2 else []
        rows.append((100, 30, 130, 70, 0.4, 1, -1))
        boxes = make_boxes([(*row,) for row in rows], tracked=True)
        frames.append(
            Perception(
                SIZE,
                CLASSES,
                boxes,
                drivable,
                None if index == 3 else lane,
                source="drive.mp4",
                frame=index,
                timestamp=index / 25,
            )
        )
    return frames


@pytest.fixture
def road() -> Road:
    """A road with everything known of it."""
    points = np.array([[40, 119], [60, 95.5], [95, 60]], np.float32)
    curve = GroundCurve(np.array([1.8, 0.01, 0.001, 0.0]), 5.0, 40.0)
    near = Estimate(0.25, 0.03)
    return Road(
        lines=(LaneLine(3, -1, points, np.zeros(6), (119.0, -59.0), 0.7, 0.9, curve),),
        drivable=(points,),
        ego_lane=EgoLane(Estimate(3.5, 0.1), near, Estimate(-0.01, 0.002), None),
        lead=LeadVehicle(0, 7, Estimate(22.5, 1.1), Estimate(2.0, 0.5), None),
        camera=Camera((120, 200), 150.0, 150.0, 99.5, 59.5, 1.4),
        calibrated="file",
        events=(Event("lane_departure_left", "begin", 0.04, 1, 0.1),),
    )
