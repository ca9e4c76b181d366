"""Lane departure and forward collision as events that begin and end, with hysteresis.

Advisory only: they rest on one camera and a light network, and no safety function may rest on them.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, TypeAlias

from trilitenet.errors import ConfigError
from trilitenet.road.structures import LATE, Event, EventKind, Road

__all__ = ["EventDetector", "EventThresholds"]

_Reading: TypeAlias = tuple[bool | None, float | None]
"""Whether a frame wants an event to be on, and the figure that says so; None for what it does not tell."""


@dataclasses.dataclass(frozen=True)
class EventThresholds:
    """When events begin and end.

    Attributes:
        vehicle_width: Metres of the own vehicle, where the camera's file does not tell it.
        departure_begin: Metres between the vehicle's side and the line, at less than which a departure begins.
        departure_end: At more than which it ends.
        drift: Radians that the vehicle must point towards the line for a departure to begin.
        collision_begin: Seconds to collision at less than which a warning begins.
        collision_end: At more than which it ends.
        confirm: Seconds that a beginning must hold before it is told.
        hold: Seconds that an end must hold before it is told.
        unknown: Seconds without a reading (no lane, or no vehicle whose speed is known) after which an event ends.
    """

    vehicle_width: float = 1.8
    departure_begin: float = 0.10
    departure_end: float = 0.30
    drift: float = 0.004
    collision_begin: float = 2.7
    collision_end: float = 3.5
    confirm: float = 0.12
    hold: float = 0.5
    unknown: float = 2.0

    def __post_init__(self) -> None:
        if self.departure_end < self.departure_begin or self.collision_end < self.collision_begin:
            raise ConfigError("an event's end threshold must not be below the one of its beginning")


@dataclasses.dataclass
class _State:
    """One kind of event: whether it is on, since when the opposite is seen, and the last reading."""

    on: bool = False
    since: float | None = None
    read: float = -math.inf
    value: float = 0.0

    def step(
        self, wants: bool | None, value: float | None, timestamp: float, limits: EventThresholds
    ) -> Literal["begin", "end"] | None:
        """Take in one frame; one that is late adds nothing.

        Args:
            wants: True or False for what this frame says, None if it says nothing.
            value: What the frame reads; None if it has no figure, so that the last one stays.
            timestamp: Seconds.
            limits: How long a beginning and an end must hold, and how long there may be nothing.
        """
        if -LATE <= timestamp - self.read < 0:
            return None
        if value is not None:
            self.value = value
        if wants is None:
            self.since = None
            if not self.on or abs(timestamp - self.read) <= limits.unknown:
                return None
            self.on = False
            return "end"
        self.read = timestamp
        if wants == self.on:
            self.since = None
            return None
        if self.since is None or timestamp < self.since:  # the latter of a clock that was set back
            self.since = timestamp
        if timestamp - self.since < (limits.hold if self.on else limits.confirm):
            return None
        self.on, self.since = wants, None
        return "begin" if wants else "end"


class EventDetector:
    """Turns the road of frame after frame into events.

    Args:
        thresholds: When events begin and end.
    """

    def __init__(self, thresholds: EventThresholds | None = None) -> None:
        self.thresholds = thresholds or EventThresholds()
        self._states: dict[EventKind, _State] = {
            "lane_departure_left": _State(),
            "lane_departure_right": _State(),
            "forward_collision": _State(),
        }
        self._track = -1

    def update(self, road: Road, timestamp: float, frame: int | None = None) -> tuple[Event, ...]:
        """Return what begins or ends with this frame.

        Args:
            road: The road of the frame.
            timestamp: Seconds.
            frame: Index of the frame.
        """
        events: list[Event] = []
        readings: dict[EventKind, _Reading] = {**self._departures(road), "forward_collision": self._collision(road)}
        for kind, state in self._states.items():
            wants, value = readings[kind]
            phase = state.step(wants, value, timestamp, self.thresholds)
            if phase is not None:
                track = self._track if kind == "forward_collision" else -1
                events.append(Event(kind, phase, timestamp, frame, state.value, track))
        return tuple(events)

    @property
    def warnings(self) -> tuple[EventKind, ...]:
        """Kinds of events that are on."""
        return tuple(kind for kind, state in self._states.items() if state.on)

    def _departures(self, road: Road) -> dict[EventKind, _Reading]:
        limits, lane = self.thresholds, road.ego_lane
        if lane is None or lane.offset is None or lane.width is None:
            return {"lane_departure_left": (None, None), "lane_departure_right": (None, None)}
        found: dict[EventKind, _Reading] = {}
        sides: tuple[tuple[EventKind, float], ...] = (("lane_departure_left", 1.0), ("lane_departure_right", -1.0))
        for kind, side in sides:
            room = lane.width.value / 2 - side * lane.offset.value - limits.vehicle_width / 2
            towards = lane.heading is not None and side * lane.heading.value > limits.drift
            wants: bool | None
            if self._states[kind].on:
                wants = not (room > limits.departure_end or (not towards and room > limits.departure_begin))
                if lane.offset.value * side < 0:
                    wants = False  # the vehicle is in the next lane now
            else:
                wants = room < limits.departure_begin and towards
            found[kind] = (wants, room)
        return found

    def _collision(self, road: Road) -> _Reading:
        limits, lead = self.thresholds, road.lead
        if lead is None:
            return None, None  # too near to be measured, hidden, or gone
        time, on = lead.time_to_collision, self._states["forward_collision"].on
        if time is None:
            return (None if lead.closing_speed is None else False), None
        if not on:
            self._track = lead.track_id
        return time.value < (limits.collision_end if on else limits.collision_begin), time.value
