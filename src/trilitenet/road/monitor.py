"""Frame after frame of a video, or one picture, into what they tell of the road: this layer's parts in their order."""

from __future__ import annotations

import dataclasses
import math
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import ShapeError
from trilitenet.processing.geometry import Camera
from trilitenet.processing.polygons import mask_to_polygons
from trilitenet.road.camera import CameraErrors, SelfCalibration
from trilitenet.road.ego import LaneFilter, LaneFit, LeadFilter, find_distances, find_lead, fit_ego_lane, ground_curve
from trilitenet.road.events import EventDetector, EventThresholds
from trilitenet.road.lanes import assign_positions, find_lines, vanishing_point
from trilitenet.road.structures import Estimate, LaneLine, Road
from trilitenet.road.tracking import LineTracker
from trilitenet.structures import Boxes, Perception

__all__ = ["RoadMonitor"]

_WIDTH_MEMORY: Final = 0.8
"""Seconds over which the lane's width is averaged."""
_VEHICLES: Final = frozenset({"vehicle", "car", "van", "truck", "lorry", "bus"})
"""Classes whose boxes are as wide as a lane's vehicles."""
_WIDENING: Final = 0.05
"""Metres that a lane's width wanders in a second while it is not seen."""


class RoadMonitor:
    """Follows the road through a video; use a new one for each video and each picture.

    Args:
        camera: The camera, for any resolution of its view; estimated from the lanes if left out.
        thresholds: When events begin and end; the vehicle's width is the camera's, where that has one.
        field_of_view: Assumed horizontal field of view in degrees, without a camera.
        lane_width: Assumed width of a lane in metres, without a camera.
        still: This is a single picture.

    Raises:
        ConfigError: If the field of view is not between 1 and 179 degrees, or the lane's width not above 0.
    """

    def __init__(
        self,
        camera: Camera | None = None,
        *,
        thresholds: EventThresholds | None = None,
        field_of_view: float = 60.0,
        lane_width: float = 3.5,
        still: bool = False,
    ) -> None:
        if camera is None:
            SelfCalibration((1, 1), field_of_view=field_of_view, lane_width=lane_width)  # tells what is out of range
        self._given = camera
        self._assumed = (field_of_view, lane_width)
        self._still = still
        thresholds = thresholds or EventThresholds()
        if camera is not None and camera.vehicle_width is not None:
            thresholds = dataclasses.replace(thresholds, vehicle_width=camera.vehicle_width)
        self._events = EventDetector(thresholds)
        self._lane = LaneFilter()
        self._lead = LeadFilter()
        self._size: tuple[int, int] | None = None
        self._camera: Camera | None = None
        self._calibration: SelfCalibration | None = None
        self._lines: LineTracker | None = None
        self._width: Estimate | None = None
        self._width_seen = 0.0
        self._clock = 0.0

    def __call__(self, perception: Perception) -> Road:
        """Take in the next frame.

        Args:
            perception: What the network sees. A frame of a video should have its timestamp; without one, frames are
                taken to be 1/30 s apart.

        Raises:
            ShapeError: If the frame has another shape than the camera.
        """
        self._prepare(perception.size)
        timestamp = self._clock if perception.timestamp is None else perception.timestamp
        self._clock = timestamp + 1 / 30
        lines = [] if perception.lane is None else find_lines(perception.lane)
        drivable = () if perception.drivable is None else _outlines(perception.drivable)
        if self._lines is not None:
            lines = self._lines.update(lines)
        by_column = assign_positions(lines, [_column_right(line, perception.size) for line in lines])
        if self._calibration is not None and self._still:
            self._calibration.update(by_column, timestamp, _vehicles(perception))
        camera, errors, calibrated = self._trusted(lines)
        if camera is None:
            if self._calibration is not None and not self._still:
                self._calibration.update(by_column, timestamp, _vehicles(perception))
            return self._with_events(Road(tuple(by_column), drivable), perception, timestamp)
        lines = [dataclasses.replace(line, ground=ground_curve(line, camera)) for line in lines]
        lines = assign_positions(lines, [_metres_right(line) for line in lines])
        if self._calibration is not None and not self._still:
            self._calibration.update(lines, timestamp, _vehicles(perception))
        distances = () if perception.boxes is None else find_distances(perception.boxes, camera, errors)
        road = Road(tuple(lines), drivable, camera=camera, calibrated=calibrated, distances=distances)
        usual = CameraErrors() if self._calibration is None else self._calibration.errors
        known = self._known_width(timestamp)
        fit = fit_ego_lane(*road.ego_lines, camera, errors, usual=usual, known_width=known)
        if fit is not None:
            if self._calibration is not None and fit.lane.curvature is not None:
                self._calibration.see_bend(fit.lane.curvature.value)
            road = self._with_lane(road, fit, perception, timestamp, usual, shaken=errors != usual)
        return self._with_events(road, perception, timestamp)

    def _prepare(self, size: tuple[int, int]) -> None:
        if size == self._size:
            return
        if self._given is not None:
            wide, given = size[1] / size[0], self._given.size[1] / self._given.size[0]
            if abs(wide / given - 1) > 0.01:
                raise ShapeError(
                    f"the camera file is for {self._given.size[1]}x{self._given.size[0]} pixels, the picture has "
                    f"{size[1]}x{size[0]}, which is another shape; calibrate for it or leave the camera out"
                )
            self._camera = self._given if size == self._given.size else self._given.resized(size)
        else:
            field_of_view, lane_width = self._assumed
            self._calibration = SelfCalibration(
                size, field_of_view=field_of_view, lane_width=lane_width, still=self._still
            )
        self._size = size
        self._lines = None if self._still else LineTracker(size)

    def _trusted(self, lines: list[LaneLine]) -> tuple[Camera | None, CameraErrors, Literal["file", "lanes"] | None]:
        """Return the camera, how well it is known for this frame, and where it is from."""
        if self._camera is not None:
            camera, errors = self._camera, CameraErrors()
        else:
            calibration = self._calibration
            assert calibration is not None
            if calibration.camera is None:
                return None, CameraErrors(), None
            camera, errors = calibration.camera, calibration.errors
        # Where this frame's lanes surely vanish elsewhere, the car pitches: what rests on the horizon is less sure.
        seen = vanishing_point(lines, camera.size, camera)
        if seen is not None:
            away = abs(seen.v - camera.vanishing_point()[1])
            if away > 3 * seen.error:
                errors = dataclasses.replace(errors, pitch=max(errors.pitch, away / camera.fy))
        return camera, errors, "file" if self._camera is not None else "lanes"

    def _known_width(self, timestamp: float) -> Estimate | None:
        """Return the lane's width as it was last seen, the less sure the longer ago that is."""
        if self._width is None:
            return None
        age = abs(timestamp - self._width_seen)
        return Estimate(self._width.value, math.hypot(self._width.error, _WIDENING * math.sqrt(age)))

    def _see_width(self, width: Estimate, timestamp: float) -> None:
        step = timestamp - self._width_seen
        if self._width is None or step > LaneFilter.GAP:
            mean = width.value
        else:
            mean = self._width.value + (width.value - self._width.value) * -math.expm1(-max(step, 0.0) / _WIDTH_MEMORY)
        self._width = Estimate(mean, max(0.1, width.error, abs(mean - width.value)))
        self._width_seen = timestamp

    def _with_lane(
        self, road: Road, fit: LaneFit, perception: Perception, timestamp: float, usual: CameraErrors, *, shaken: bool
    ) -> Road:
        """Add the lane and the lead; ``usual`` is how well the camera is known where it is not shaken as in a frame."""
        camera = road.camera
        assert camera is not None
        if fit.lane.width is not None:
            self._see_width(fit.lane.width, timestamp)
        lead = None
        if perception.boxes is not None:
            lead = find_lead(perception.boxes, road.distances, fit, camera)
            if lead is not None and not self._still:
                calm = find_distances(perception.boxes, camera, usual)[lead.box] if shaken else None
                added = 0.0 if calm is None else math.sqrt(max(lead.distance.error**2 - calm.error**2, 0.0))
                scale = math.hypot(usual.height, usual.focal)
                lead = self._lead.update(lead, perception.boxes, timestamp, camera, added, scale)
        lane = fit.lane if self._still else self._lane.update(fit, timestamp)
        if lane.width is None and lane.offset is not None:
            lane = dataclasses.replace(lane, width=self._known_width(timestamp))
        if lane.offset is not None:
            middle = Estimate(lane.offset.value - camera.left, lane.offset.error)
            lane = dataclasses.replace(lane, offset=middle)
        return dataclasses.replace(road, ego_lane=lane, lead=lead)

    def _with_events(self, road: Road, perception: Perception, timestamp: float) -> Road:
        if self._still:
            return road
        events = self._events.update(road, timestamp, perception.frame)
        return dataclasses.replace(road, events=events, warnings=self._events.warnings)


def _vehicles(perception: Perception) -> Boxes | None:
    """Return the boxes of vehicles: a model of one's own may find other things, too."""
    boxes = perception.boxes
    if boxes is None:
        return None
    classes = [number for number, name in enumerate(perception.class_names) if name.lower() in _VEHICLES]
    keep = np.isin(boxes.class_id, classes)
    return Boxes(boxes.xyxy[keep], boxes.confidence[keep], boxes.class_id[keep])


def _outlines(mask: NDArray[np.bool_]) -> tuple[NDArray[np.float32], ...]:
    """Return outlines of the drivable area, precise to 1/320 of the width, without specks."""
    width = mask.shape[1]
    return tuple(mask_to_polygons(mask, tolerance=width / 320, min_area=0.0005 * mask.size))


def _column_right(line: LaneLine, size: tuple[int, int]) -> float | None:
    """Return how many pixels right of the middle the line meets the lower edge; None if it ends too far from it."""
    height, width = size
    if line.origin[0] < 0.62 * height or line.confidence < 0.3:
        return None
    return float(line.column(height - 1.0)) - (width - 1) / 2


def _metres_right(line: LaneLine) -> float | None:
    """Return how many metres right of the vehicle the line passes it; None if it is only seen far away."""
    if line.ground is None or line.ground.start > 25 or line.confidence < 0.3:
        return None
    value = line.ground.tangent(min(max(line.ground.start, 3.0), line.ground.end), 0.0)
    return -value if math.isfinite(value) and abs(value) < 40 else None
