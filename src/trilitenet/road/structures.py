"""What a frame tells of the road: frozen dataclasses of NumPy arrays and numbers, each with the form it has in JSON.

Pixels are those of the source image with OpenCV's convention: the centre of the first pixel is (0, 0). Metres are in
the vehicle's coordinates: x forward, y left, from the point on the road below the camera. Angles are radians, positive
to the left. Every measured quantity comes with one standard deviation of its error; what is not known is None.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from trilitenet.processing.geometry import Camera

__all__ = ["LATE", "EgoLane", "Estimate", "Event", "EventKind", "GroundCurve", "LaneLine", "LeadVehicle", "Road"]

LATE: Final = 0.5
"""Seconds by which a frame may come after a later one: what is followed goes on, and the frame adds nothing to it."""

EventKind = Literal["lane_departure_left", "lane_departure_right", "forward_collision"]


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A measured quantity.

    Attributes:
        value: In the unit that its field names.
        error: One standard deviation of its error, in the same unit.
    """

    value: float
    error: float

    def to_dict(self) -> dict[str, float]:
        """Return ``{"value": ..., "error": ...}``."""
        return {"value": round(self.value, 5), "error": round(self.error, 5)}


def _optional(estimate: Estimate | None) -> dict[str, float] | None:
    return None if estimate is None else estimate.to_dict()


@dataclasses.dataclass(frozen=True, eq=False)
class GroundCurve:
    """A line on the road: y(x) = c0 + c1 x + c2 x^2 + c3 x^3.

    Attributes:
        polynomial: (4,) float64 c0 .. c3, metres.
        start: x in metres where it was first seen.
        end: x in metres where it was last seen.
    """

    polynomial: NDArray[np.float64]
    start: float
    end: float

    def at(self, x: float | NDArray[np.float64]) -> Any:
        """Return y in metres at x in metres."""
        c0, c1, c2, c3 = self.polynomial
        return c0 + x * (c1 + x * (c2 + x * c3))

    def tangent(self, touch: float, x: float) -> float:
        """Return y in metres at x in metres of the straight line that touches the curve at x = ``touch``."""
        c1, c2, c3 = self.polynomial[1:].tolist()
        return float(self.at(touch) + (c1 + touch * (2 * c2 + touch * 3 * c3)) * (x - touch))

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "polynomial": [float(f"{c:.6g}") for c in self.polynomial],
            "range": [round(self.start, 2), round(self.end, 2)],
        }


@dataclasses.dataclass(frozen=True, eq=False)
class LaneLine:
    """One line of a lane: a marking, with its gaps bridged, or a kerb.

    Attributes:
        id: Identity over the frames of a video; an index for a still picture.
        position: -1 is the first line left of the vehicle, -2 the next; 1 the first to the right; 0 = unknown.
        points: (N, 2) float32 u, v on the curve in pixels, from near (bottom) to far.
        polynomial: (6,) float64: u = p0 + p1 t + ... + p5 t^5 with t = (v - v0) / span.
        origin: (v0, span): t is 0 at the nearest row and 1 at the farthest.
        residual: Root mean square distance of the mask's middle from the curve, across it, in pixels.
        confidence: In [0, 1]: how much of the curve the mask covers, how long it is and how well it fits.
        ground: The line in metres; None without a trusted camera.
    """

    id: int
    position: int
    points: NDArray[np.float32]
    polynomial: NDArray[np.float64]
    origin: tuple[float, float]
    residual: float
    confidence: float
    ground: GroundCurve | None = None

    def column(self, row: float | NDArray[np.float64]) -> Any:
        """Return u in pixels at rows; beyond the ends the curve goes on straight."""
        v0, span = self.origin
        t = (np.asarray(row, np.float64) - v0) / span
        inside = np.clip(t, 0.0, 1.0)
        p0, p1, p2, p3, p4, p5 = self.polynomial.tolist()
        value = p0 + inside * (p1 + inside * (p2 + inside * (p3 + inside * (p4 + inside * p5))))
        slope = p1 + inside * (2 * p2 + inside * (3 * p3 + inside * (4 * p4 + inside * 5 * p5)))
        return value + (t - inside) * slope

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "id": self.id,
            "position": self.position,
            "points": np.round(self.points.astype(np.float64), 1).tolist(),
            "polynomial": [float(f"{p:.6g}") for p in self.polynomial],
            "origin": [round(value, 2) for value in self.origin],
            "residual": round(self.residual, 3),
            "confidence": round(self.confidence, 3),
            "ground": None if self.ground is None else self.ground.to_dict(),
        }


@dataclasses.dataclass(frozen=True)
class EgoLane:
    """The lane that the vehicle is in.

    In a video all but the width rest on the frames so far, too (`trilitenet.road.ego.LaneFilter`).

    Attributes:
        width: Metres; None with only one line of the lane in sight.
        offset: Metres the vehicle's middle is left of the lane's centre; the lens is, unless the camera has ``left``.
        heading: Radians the vehicle points to the left of the lane.
        curvature: 1/m of the lane where the vehicle is, positive when it bends to the left.
    """

    width: Estimate | None
    offset: Estimate | None
    heading: Estimate | None
    curvature: Estimate | None

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {name: _optional(getattr(self, name)) for name in ("width", "offset", "heading", "curvature")}


@dataclasses.dataclass(frozen=True)
class LeadVehicle:
    """The nearest vehicle ahead in the ego lane.

    Attributes:
        box: Its index among the perception's boxes.
        track_id: Its identity over frames; -1 where unknown.
        distance: Metres from the own front bumper to its rear; from the lens, unless the camera has ``front``.
        closing_speed: m/s that the distance shrinks by; None until enough frames were seen.
        time_to_collision: Seconds at the closing speed; None unless it is surely closing.
    """

    box: int
    track_id: int
    distance: Estimate
    closing_speed: Estimate | None = None
    time_to_collision: Estimate | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "box": self.box,
            "track_id": self.track_id,
            "distance": self.distance.to_dict(),
            "closing_speed": _optional(self.closing_speed),
            "time_to_collision": _optional(self.time_to_collision),
        }


@dataclasses.dataclass(frozen=True)
class Event:
    """Something that began or ended. Advisory only: no safety function may rest on it.

    Attributes:
        kind: What it is.
        phase: ``"begin"`` or ``"end"``.
        timestamp: Seconds from the start of the video.
        frame: Index of the frame; None without one.
        value: What crossed the threshold: metres to the line, or seconds to collision; the last one known, where an
            event ends because nothing was seen any more.
        track_id: The vehicle it is about; -1 where there is none.
    """

    kind: EventKind
    phase: Literal["begin", "end"]
    timestamp: float
    frame: int | None
    value: float
    track_id: int = -1

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "kind": self.kind,
            "phase": self.phase,
            "timestamp": round(self.timestamp, 3),
            "frame": self.frame,
            "value": round(self.value, 3),
            "track_id": self.track_id,
        }


@dataclasses.dataclass(frozen=True, eq=False)
class Road:
    """All that one frame tells of the road.

    Attributes:
        lines: Lines of lanes, left to right.
        drivable: Outlines of the drivable area, largest first: (N, 2) float32 u, v in pixels each.
        ego_lane: The vehicle's lane in metres; None without a trusted camera or lines.
        lead: The vehicle ahead; None without one, or where its distance cannot be trusted.
        camera: The camera that metres rest on; None while there is none to trust.
        calibrated: ``"file"`` = the camera was given, ``"lanes"`` = estimated from the lanes' vanishing point.
        distances: Metres to each of the perception's boxes, from where the lead's is told, None for one whose distance
            cannot be told.
        events: What began or ended in this frame.
        warnings: Kinds of events that are on.
    """

    lines: tuple[LaneLine, ...] = ()
    drivable: tuple[NDArray[np.float32], ...] = ()
    ego_lane: EgoLane | None = None
    lead: LeadVehicle | None = None
    camera: Camera | None = None
    calibrated: Literal["file", "lanes"] | None = None
    distances: tuple[Estimate | None, ...] = ()
    events: tuple[Event, ...] = ()
    warnings: tuple[EventKind, ...] = ()

    @property
    def ego_lines(self) -> tuple[LaneLine | None, LaneLine | None]:
        """The lines left and right of the vehicle, None where there is none."""
        left = next((line for line in self.lines if line.position == -1), None)
        right = next((line for line in self.lines if line.position == 1), None)
        return left, right

    def to_dict(self) -> dict[str, Any]:
        """Return what ``json.dumps`` takes: the ``road`` part of the documented JSON form."""
        return {
            "lines": [line.to_dict() for line in self.lines],
            "drivable_polygons": [np.round(outline.astype(np.float64), 1).tolist() for outline in self.drivable],
            "ego_lane": None if self.ego_lane is None else self.ego_lane.to_dict(),
            "lead": None if self.lead is None else self.lead.to_dict(),
            "distances": [_optional(distance) for distance in self.distances],
            "camera": None if self.camera is None else {"calibrated": self.calibrated, **self.camera.to_dict()},
            "events": [event.to_dict() for event in self.events],
            "warnings": list(self.warnings),
        }
