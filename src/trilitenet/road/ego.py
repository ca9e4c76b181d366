"""Lines and boxes -> metres: the ego lane's width, offset, heading and curvature, and the vehicle ahead.

Every figure comes with an error from the fit and from how well the camera is known; a figure whose error is too large
to be of use is None.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilitenet.processing.boxes import box_iou
from trilitenet.processing.geometry import Camera, Floats
from trilitenet.road.camera import CameraErrors
from trilitenet.road.structures import LATE, EgoLane, Estimate, GroundCurve, LaneLine, LeadVehicle
from trilitenet.structures import Boxes

__all__ = [
    "REACH",
    "REAR_OVERHANG",
    "LaneFilter",
    "LaneFit",
    "LeadFilter",
    "find_distances",
    "find_lead",
    "fit_ego_lane",
    "ground_curve",
]

REACH: Final = 70.0
"""Metres ahead that lines are used to."""
PIXEL_ERROR: Final = 0.8
"""Standard deviation of a line's place in a 640-pixel picture, in pixels."""
BOX_ERROR: Final = 1.0
"""Standard deviation of a box's lower edge in a 640-pixel picture, in pixels, however small the box."""
BOX_ERROR_SHARE: Final = 0.09
"""And, added to it, as a share of the box's shorter side: what the shipped weights miss on real frames at any size."""
REAR_OVERHANG: Final = 0.8
"""Metres from a car's rear to where its rear tyres touch the road, which is the lowest that is seen of it."""
OVERHANG_ERROR: Final = 0.25
"""Standard deviation of that, in metres: cars differ."""
IN_LANE: Final = 0.7
"""A vehicle is in the ego lane when its middle is within so much of half the lane's width."""
MAX_OUTSIDE: Final = 0.2
"""The vehicle's middle is at most so many metres outside of the lines of its own lane, as they are measured."""
UNSEEN: Final = 1e4
"""Variance of a figure that a frame does not tell."""
MAX_OFFSET_ERROR: Final = 0.4
MAX_HEADING_ERROR: Final = 0.04
MAX_CURVATURE_ERROR: Final = 0.006
MAX_DISTANCE_ERROR: Final = 0.30
"""Of the distance from the lens, as a share."""


class LaneFit(NamedTuple):
    """The ego lane in metres.

    Attributes:
        lane: What there is to say of it.
        centre: Its middle; None where only one line was seen and the width is not known.
        half_width: Metres.
        seen: (3,) offset, heading and curvature as fitted, however sure; None where the vehicle would be outside of
            the lane.
        spread: (3, 3) covariance of their errors that differ from frame to frame; what was not seen has a huge one.
        lasting: (3,) standard deviations of their errors that last (the camera's).
    """

    lane: EgoLane
    centre: GroundCurve | None
    half_width: float
    seen: Floats | None
    spread: Floats
    lasting: Floats


class _Points(NamedTuple):
    x: Floats
    y: Floats
    error: Floats


def _ground_points(line: LaneLine, camera: Camera) -> _Points:
    """Return points of the curve on the road, with one standard deviation of y."""
    v0, span = line.origin
    rows = np.linspace(v0, v0 + span, 32)
    columns = np.asarray(line.column(rows), np.float64)
    ground = camera.to_ground(np.stack([columns, rows], axis=1))
    keep = (ground[:, 0] > 1.0) & (ground[:, 0] < REACH)
    x, y = ground[keep, 0], ground[keep, 1]
    pixel = math.hypot(PIXEL_ERROR * camera.size[1] / 640, line.residual)
    error = pixel * x / camera.fx * np.sqrt(1 + (y / camera.height) ** 2)
    return _Points(x, y, np.maximum(error, 0.01))


def _degree(x: Floats) -> int:
    reach = float(np.ptp(x)) if len(x) else 0.0
    return 1 if reach < 8 else 2 if reach < 22 else 3


def ground_curve(line: LaneLine, camera: Camera) -> GroundCurve | None:
    """Return the line in metres; None if too little of it lies on the road within reach."""
    points = _ground_points(line, camera)
    if len(points.x) < 4 or np.ptp(points.x) < 2.0:
        return None
    degree = _degree(points.x)
    basis = np.vander(points.x, degree + 1, increasing=True)
    solution, *_ = np.linalg.lstsq(basis / points.error[:, None], points.y / points.error, rcond=None)
    polynomial = np.zeros(4)
    polynomial[: degree + 1] = solution
    return GroundCurve(polynomial, float(points.x.min()), float(points.x.max()))


def fit_ego_lane(
    left: LaneLine | None,
    right: LaneLine | None,
    camera: Camera,
    errors: CameraErrors,
    *,
    usual: CameraErrors | None = None,
    known_width: Estimate | None = None,
) -> LaneFit | None:
    """Fit the two lines of the ego lane as one curve with two distances from it.

    Args:
        left: The line left of the vehicle.
        right: The line right of it.
        camera: The camera.
        errors: How well it is known in this frame.
        usual: How well it is known in general, if that is better: what is beyond differs from frame to frame.
        known_width: Width of the lane from earlier frames, for when one line is out of sight.

    Returns:
        None if there is no line that can be used.
    """
    sides = [_ground_points(line, camera) for line in (left, right) if line is not None]
    names = [name for name, line in (("left", left), ("right", right)) if line is not None]
    usable = [(name, p) for name, p in zip(names, sides, strict=True) if len(p.x) >= 4 and np.ptp(p.x) >= 2.0]
    if not usable:
        return None
    count = len(usable)
    x = np.concatenate([p.x for _, p in usable])
    y = np.concatenate([p.y for _, p in usable])
    sigma = np.concatenate([p.error for _, p in usable])
    degree = _degree(x)
    # Unknowns: where each line passes the vehicle, and the shared slope, bend and its change.
    basis = np.zeros((len(x), count + degree))
    start = 0
    for side, (_, p) in enumerate(usable):
        basis[start : start + len(p.x), side] = 1.0
        start += len(p.x)
    for power in range(1, degree + 1):
        basis[:, count + power - 1] = x**power
    weight = 1 / sigma
    for _ in range(3):
        scaled = basis * weight[:, None]
        normal = scaled.T @ scaled + 1e-12 * np.eye(count + degree)
        solution = np.linalg.solve(normal, scaled.T @ (y * weight))
        missed = (y - basis @ solution) / sigma
        weight = 1 / (sigma * np.sqrt(np.maximum(1.0, np.abs(missed) / 2.0)))
    # Points of one line share most of their error: count every eighth of them.
    covariance = np.linalg.inv(normal) * 8.0 * max(1.0, float(np.mean(missed**2)))
    slope = float(solution[count])
    bend = float(2 * solution[count + 1]) if degree >= 2 else 0.0
    change = float(6 * solution[count + 2]) if degree >= 3 else 0.0
    cos = 1 / math.sqrt(1 + slope * slope)
    variance = np.diag(covariance)

    side_error = math.sqrt(float(np.mean(variance[:count])))
    width: Estimate | None = None
    middle: float | None = None
    middle_error = 0.0
    half = 0.0
    if count == 2:
        apart = float(solution[0] - solution[1]) * cos
        half = apart / 2
        width = Estimate(apart, math.hypot(math.sqrt(2) * side_error, apart * errors.height))
        middle, middle_error = float(solution[0] + solution[1]) / 2, side_error / math.sqrt(2)
        if not 1.8 < apart < 6.5:
            return None
    elif known_width is not None:
        half = known_width.value / 2
        shift = half / cos if usable[0][0] == "right" else -half / cos
        middle, middle_error = float(solution[0]) + shift, math.hypot(side_error, known_width.error)
    seen = np.array([-(middle or 0.0) * cos, -math.atan(slope), bend * cos**3])
    shares = [_camera_shares(seen, one, camera, float(x.min()), half) for one in (errors, usual or errors)]
    of_camera, lasting = shares[0], np.minimum(*shares)
    offset = curvature = None
    inside = middle is None or abs(float(seen[0])) < half + MAX_OUTSIDE
    if middle is not None and inside:  # else these are not the lines of the lane that the vehicle is in
        offset = _kept(float(seen[0]), math.hypot(middle_error, float(of_camera[0])), MAX_OFFSET_ERROR)
    heading = _kept(
        float(seen[1]), math.hypot(math.sqrt(float(variance[count])), float(of_camera[1])), MAX_HEADING_ERROR
    )
    if degree >= 2:
        error = math.hypot(2 * math.sqrt(float(variance[count + 1])), float(of_camera[2]))
        curvature = _kept(float(seen[2]), error, MAX_CURVATURE_ERROR)
    turned = np.zeros((3, count + degree))  # from the unknowns to offset, heading and curvature
    turned[0, :count] = -1 / count
    turned[1, count] = -1.0
    if degree >= 2:
        turned[2, count + 1] = 4.0  # twice the coefficient, and the error doubled as above
    spread = turned @ covariance @ turned.T + np.diag(of_camera**2 - lasting**2)
    if middle is None:
        spread[0, 0] += UNSEEN
    elif count == 1:
        spread[0, 0] += middle_error**2 - side_error**2
    if degree < 2:
        spread[2, 2] += UNSEEN
    centre = None
    if middle is not None:
        polynomial = np.array([middle, slope, bend / 2, change / 6])
        centre = GroundCurve(polynomial, float(x.min()), float(x.max()))
    return LaneFit(EgoLane(width, offset, heading, curvature), centre, half, seen if inside else None, spread, lasting)


def _camera_shares(seen: Floats, errors: CameraErrors, camera: Camera, near: float, half: float) -> Floats:
    """Return the standard deviations of offset, heading and curvature that the camera's errors make.

    Args:
        seen: Offset, heading and curvature.
        errors: Of the camera.
        camera: The camera.
        near: Metres ahead at which the lines begin to be seen.
        half: Half the lane's width in metres; 0 where it is not known.
    """
    offset, _, curvature = seen.tolist()
    lever = camera.height * (1 + (half / camera.height) ** 2)  # by which a roll moves lines so far to either side
    return np.array(
        [
            math.hypot(offset * errors.height, (errors.yaw + errors.pitch) * near, errors.roll * lever),
            math.hypot(errors.yaw, errors.pitch * offset / camera.height),
            abs(curvature) * (errors.focal + errors.height),
        ]
    )


def _kept(value: float, error: float, limit: float) -> Estimate | None:
    return Estimate(value, error) if math.isfinite(value) and error <= limit else None


def _pushed(step: float) -> Floats:
    """Return the covariance of a value and its rate after so many seconds in which white noise of 1 pushes the rate."""
    return np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])


_SEEN: Final = [0, 2, 4]
"""Where offset, heading and curvature stand in the state of a `LaneFilter`."""


class LaneFilter:
    """Follows offset, heading and curvature over time.

    It is a Kalman filter of the three together, with the rates of offset and heading: the fit knows how their errors in
    one frame hang together, so that what earlier frames told of the bend makes the offset surer. A frame that
    contradicts the others counts less, and what it is off by goes into the errors told; two such frames that agree are
    believed.
    """

    SWERVE: Final = 0.3
    """How much the rate of the offset wanders in a second, in m/s."""
    TURN: Final = 0.025
    """How much the rate of the heading wanders in a second, in rad/s."""
    BEND: Final = 0.002
    """How far the curvature wanders in a second, in 1/m."""
    ALIKE: Final = 0.4
    """Seconds within which the errors of frames are the same, not new ones."""
    GATE: Final = 16.0
    """Squared Mahalanobis distance beyond which a frame contradicts the others."""
    MAX_RATE: Final = 1.0
    """Standard deviation of the rate of the offset before any is known, in m/s."""
    GAP: Final = 2.0
    """Seconds without a lane after which it is forgotten; video with fewer frames is not followed."""

    def __init__(self) -> None:
        self._state: Floats | None = None
        self._covariance = np.zeros((5, 5))
        self._wild: tuple[Floats, Floats] | None = None
        self._last = 0.0

    def update(self, fit: LaneFit, timestamp: float) -> EgoLane:
        """Return the lane with what its history tells.

        Args:
            fit: The lane of this frame.
            timestamp: Seconds.
        """
        if fit.seen is None or not np.isfinite(fit.seen).all():
            return fit.lane
        step = timestamp - self._last
        off = np.zeros(3)
        if self._state is None or not -LATE <= step <= self.GAP + 1e-6:
            self._start(fit)
            self._last = timestamp
        elif step > 0:  # else it is the same moment again, or a late frame
            self._advance(step)
            off = self._take_in(fit, step)
            self._last = timestamp
        assert self._state is not None
        values = self._state[_SEEN]
        errors = np.sqrt(np.diag(self._covariance)[_SEEN] + fit.lasting**2 + off**2)
        limits = (MAX_OFFSET_ERROR, MAX_HEADING_ERROR, MAX_CURVATURE_ERROR)
        offset, heading, curvature = map(_kept, values.tolist(), errors.tolist(), limits)
        if offset is not None and fit.half_width > 0 and abs(offset.value) > fit.half_width + MAX_OUTSIDE:
            offset = None
        return EgoLane(fit.lane.width, offset, heading, curvature)

    def _start(self, fit: LaneFit) -> None:
        """Begin anew with what one frame tells."""
        assert fit.seen is not None
        self._state = np.array([fit.seen[0], 0.0, fit.seen[1], 0.0, fit.seen[2]])
        self._covariance = np.zeros((5, 5))
        self._covariance[np.ix_(_SEEN, _SEEN)] = fit.spread
        self._covariance[1, 1], self._covariance[3, 3] = self.MAX_RATE**2, 0.05**2
        self._wild = None

    def _advance(self, step: float) -> None:
        assert self._state is not None
        move = np.eye(5)
        move[0, 1] = move[2, 3] = step
        noise = np.zeros((5, 5))
        pushed = _pushed(step)
        noise[:2, :2] = pushed * self.SWERVE**2
        noise[2:4, 2:4] = pushed * self.TURN**2
        noise[4, 4] = self.BEND**2 * step
        self._state = move @ self._state
        self._covariance = move @ self._covariance @ move.T + noise

    def _take_in(self, fit: LaneFit, step: float) -> Floats:
        """Correct the state by a frame; return by how much a frame that contradicts it is still off."""
        assert self._state is not None
        assert fit.seen is not None
        spread = fit.spread * max(1.0, self.ALIKE / step)
        total = self._covariance[np.ix_(_SEEN, _SEEN)] + spread
        apart = fit.seen - self._state[_SEEN]
        distance = _squared(apart, total)
        for across in (-2 * fit.half_width, 2 * fit.half_width):
            # Into the next lane, if that is what fits: one stray line must not do it.
            if distance > self.GATE and abs(self._state[0] + across) < fit.half_width + MAX_OUTSIDE:
                rest = apart - np.array([across, 0.0, 0.0])
                other = _squared(rest, total)
                if other <= self.GATE:
                    self._state[0] += across
                    apart, distance = rest, other
        wild, self._wild = self._wild, None
        if distance > self.GATE:
            moved = np.diag(np.square([self.MAX_RATE * step, 0.05 * step, 0.0]))
            if wild is not None and _squared(fit.seen - wild[0], fit.spread + wild[1] + moved) <= self.GATE:
                self._start(fit)
                return np.zeros(3)
            self._wild = fit.seen, fit.spread
        total = total * max(1.0, distance / self.GATE)
        gain = np.linalg.solve(total, self._covariance[_SEEN]).T
        self._state = self._state + gain @ apart
        covariance = self._covariance - gain @ self._covariance[_SEEN]
        self._covariance = (covariance + covariance.T) / 2
        return apart if distance > self.GATE else np.zeros(3)


def _squared(apart: Floats, covariance: Floats) -> float:
    """Return the squared Mahalanobis distance."""
    return float(apart @ np.linalg.solve(covariance, apart))


def _lane_at(centre: GroundCurve, x: float) -> float:
    """Return y of the lane's middle; beyond what was seen it goes on straight."""
    return centre.tangent(min(max(x, 0.0), centre.end), x)


def find_lead(boxes: Boxes, distances: Sequence[Estimate | None], fit: LaneFit, camera: Camera) -> LeadVehicle | None:
    """Return the nearest vehicle in the ego lane.

    Args:
        boxes: Vehicles, in pixels of the camera's picture, (0, 0) being the first pixel's corner.
        distances: What `find_distances` tells of them.
        fit: The ego lane.
        camera: The camera.

    Returns:
        None without one, or if its distance cannot be told well enough.
    """
    if fit.centre is None or not len(boxes):
        return None
    height, width = camera.size
    left, _, right, bottom = boxes.xyxy.T.astype(np.float64) - 0.5
    ground, left_end, right_end = (
        camera.to_ground(np.stack([column, bottom], axis=1)) for column in ((left + right) / 2, left, right)
    )
    best, nearest = None, math.inf
    for index, (x, y) in enumerate(ground.tolist()):
        if not x < nearest or bottom[index] >= height - 1.5:
            continue
        middle = _lane_at(fit.centre, x)
        if left[index] < 1 or right[index] > width - 2:
            # Its middle is out of the picture: it counts if it surely stands across the lane's middle.
            if not right_end[index, 1] + 0.3 < middle < left_end[index, 1] - 0.3:
                continue
        elif abs(y - middle) > IN_LANE * fit.half_width:
            continue
        best, nearest = index, x
    if best is None or (distance := distances[best]) is None:  # what is behind it is not the lead
        return None
    return LeadVehicle(best, -1 if boxes.track_id is None else int(boxes.track_id[best]), distance)


def find_distances(boxes: Boxes, camera: Camera, errors: CameraErrors) -> tuple[Estimate | None, ...]:
    """Return metres from the own bumper to the nearest end of each vehicle.

    The bumper is ``camera.front`` before the lens. None is for a vehicle that is cut off below or too far to tell.
    """
    height, width = camera.size
    left, _, right, bottom = boxes.xyxy.T.astype(np.float64) - 0.5
    ground = camera.to_ground(np.stack([(left + right) / 2, bottom], axis=1))
    found: list[Estimate | None] = []
    for x, row, box in zip(ground[:, 0].tolist(), bottom.tolist(), boxes.xyxy, strict=True):
        estimate = None
        seen = x - REAR_OVERHANG
        if math.isfinite(x) and seen > camera.front + 0.5 and row < height - 1.5:
            error = _distance_error(x, camera, errors, _box_error(box, width))
            if error <= MAX_DISTANCE_ERROR * seen:
                estimate = Estimate(seen - camera.front, error)
        found.append(estimate)
    return tuple(found)


def _box_error(box: NDArray[np.float32], width: int) -> float:
    """Return one standard deviation of a box's lower edge, in pixels of a picture of this width."""
    side = float(min(box[2] - box[0], box[3] - box[1]))
    return math.hypot(BOX_ERROR * width / 640, BOX_ERROR_SHARE * side)


def _distance_error(x: float, camera: Camera, errors: CameraErrors, pixel: float) -> float:
    per_radian = (x * x + camera.height**2) / camera.height
    return math.sqrt(
        (per_radian * math.hypot(pixel / camera.fy, errors.pitch)) ** 2
        + (x * math.hypot(errors.height, errors.focal)) ** 2
        + OVERHANG_ERROR**2
    )


class LeadFilter:
    """Follows the distance to one vehicle over time, for the closing speed and the time to collision.

    It is a Kalman filter of distance and speed.
    """

    ACCELERATION: Final = 2.0
    """How much the closing speed wanders in a second, in m/s: an acceleration taken to last about so long."""
    BOX_NOISE: Final = 0.5
    """The part of `BOX_ERROR` that differs from frame to frame, in pixels."""
    ANY_SPEED: Final = 30.0
    """Standard deviation of the closing speed before any is known, in m/s."""
    GAP: Final = 0.6
    """Seconds without the vehicle after which it is forgotten."""
    NEEDED: Final = 0.5
    """Seconds of watching before a speed is told."""
    MAX_SPEED_ERROR: Final = 2.0
    """Of the speed as it is followed, in m/s: what the camera errs by grows with the speed and must not hide it."""
    MAX_SPEED_SHARE: Final = 0.2
    """Or so large a share of the speed, if that is more."""
    MAX_TIME: Final = 30.0

    def __init__(self) -> None:
        self._state: Floats | None = None
        self._covariance = np.zeros((2, 2))
        self._identity = -1
        self._box: NDArray[np.float32] | None = None
        self._last = self._since = 0.0

    def update(
        self,
        lead: LeadVehicle | None,
        boxes: Boxes,
        timestamp: float,
        camera: Camera,
        shaken: float = 0.0,
        scale: float = 0.0,
    ) -> LeadVehicle | None:
        """Return the lead with what its history tells.

        Args:
            lead: The lead of this frame.
            boxes: The boxes that it indexes.
            timestamp: Seconds.
            camera: The camera.
            shaken: Metres, of the error of the distance: what this frame adds to it, as the pitch of a bump does.
            scale: Share of the distance from the lens, of its error: what is in the speed alike, and so not in the time
                to collision but for what the bumper is nearer.
        """
        if lead is None:
            return None
        box = boxes.xyxy[lead.box]
        pixel = self.BOX_NOISE * camera.size[1] / 640
        seen = lead.distance.value + camera.front
        noise = math.hypot(pixel * (seen**2 + camera.height**2) / (camera.fy * camera.height), shaken)
        step = timestamp - self._last
        same = self._state is not None and -LATE <= step <= self.GAP + 1e-6 and self._is_same(lead, box)
        late = self._state is not None and -LATE <= step <= 0  # or the same moment again
        if late and not same:
            return lead
        if same and not late:
            self._advance(step, lead.distance.value, noise)
        elif not same:
            self._state = np.array([lead.distance.value, 0.0])
            self._covariance = np.diag([noise**2, self.ANY_SPEED**2])
            self._since = timestamp
        if not late:
            self._last, self._identity, self._box = timestamp, lead.track_id, box
        assert self._state is not None
        distance, rate = self._state.tolist()
        spread = math.sqrt(max(self._covariance[0, 0], 0.0))
        systematic = math.sqrt(max(lead.distance.error**2 - noise**2, 0.0))
        found = Estimate(distance, math.hypot(spread, systematic))
        rate_spread = math.sqrt(max(self._covariance[1, 1], 0.0))
        limit = max(self.MAX_SPEED_ERROR, self.MAX_SPEED_SHARE * abs(rate))
        if self._last - self._since < self.NEEDED or rate_spread > limit:
            return dataclasses.replace(lead, distance=found)
        seen = distance + camera.front
        closing = Estimate(-rate, math.hypot(rate_spread, rate * systematic / max(seen, 1.0)))
        left = None
        if -rate > max(0.5, 2 * rate_spread) and distance / -rate < self.MAX_TIME:
            time = max(distance, 0.0) / -rate
            uneven = math.sqrt(max(systematic**2 - (scale * seen) ** 2, 0.0))
            left = Estimate(time, math.hypot(spread, time * rate_spread, uneven, scale * camera.front) / -rate)
        return dataclasses.replace(lead, distance=found, closing_speed=closing, time_to_collision=left)

    def _is_same(self, lead: LeadVehicle, box: NDArray[np.float32]) -> bool:
        if lead.track_id >= 0 and self._identity >= 0:
            return lead.track_id == self._identity
        if self._box is None:
            return False
        return bool(box_iou(box[None], self._box[None])[0, 0] > 0.3)

    def _advance(self, step: float, distance: float, noise: float) -> None:
        assert self._state is not None
        move = np.array([[1.0, step], [0.0, 1.0]])
        state = move @ self._state
        covariance = move @ self._covariance @ move.T + _pushed(step) * self.ACCELERATION**2
        total = covariance[0, 0] + noise**2
        gain = covariance[:, 0] / total
        self._state = state + gain * (distance - state[0])
        self._covariance = covariance - np.outer(gain, covariance[0])
