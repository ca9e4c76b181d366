"""Lane departure and forward collision as events that begin and end, with hysteresis.

Advisory only: they rest on one camera and a light network, and no safety function may rest on them.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

from trilitenet.errors import ConfigError
from trilitenet.road.structures import Event, EventKind, Road

__all__ = ["EventDetector", "EventThresholds"]


@dataclasses.dataclass(frozen=True)
class EventThresholds:
    """When events begin and end.

    Attributes:
        vehicle_width: Metres of the own vehicle.
        departure_begin: Metres between the vehicle's side and the line, at less than which a departure begins.
        departure_end: At more than which it ends.
        drift: Radians that the vehicle must point towards the line for a departure to begin.
        collision_begin: Seconds to collision at less than which a warning begins.
        collision_end: At more than which it ends.
        confirm: Seconds that a beginning must hold before it is told.
        hold: Seconds that an end must hold before it is told.
    """

    vehicle_width: float = 1.8
    departure_begin: float = 0.10
    departure_end: float = 0.30
    drift: float = 0.004
    collision_begin: float = 2.7
    collision_end: float = 3.5
    confirm: float = 0.12
    hold: float = 0.5

    def __post_init__(self) -> None:
        if self.departure_end < self.departure_begin or self.collision_end < self.collision_begin:
            raise ConfigError("an event's end threshold must not be below the one of its beginning")


@dataclasses.dataclass
class _State:
    """One kind of event: whether it is on, and since when the opposite is seen."""

    on: bool = False
    since: float | None = None

    def step(self, wants: bool | None, timestamp: float, confirm: float, hold: float) -> Literal["begin", "end"] | None:
        """Take in one frame.

        Args:
            wants: True or False for what this frame says, None if it says nothing.
            timestamp: Seconds.
            confirm: Seconds before a beginning is told.
            hold: Seconds before an end is told.
        """
        if wants is None or wants == self.on:
            self.since = None
            return None
        if self.since is None:
            self.since = timestamp
        if timestamp - self.since < (hold if self.on else confirm):
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
        readings = {**self._departures(road), "forward_collision": self._collision(road)}
        for kind, state in self._states.items():
            wants, value = readings[kind]
            phase = state.step(wants, timestamp, self.thresholds.confirm, self.thresholds.hold)
            if phase is not None:
                track = self._track if kind == "forward_collision" else -1
                events.append(Event(kind, phase, timestamp, frame, value, track))
        return tuple(events)

    @property
    def warnings(self) -> tuple[EventKind, ...]:
        """Kinds of events that are on."""
        return tuple(kind for kind, state in self._states.items() if state.on)

    def _departures(self, road: Road) -> dict[EventKind, tuple[bool | None, float]]:
        limits, lane = self.thresholds, road.ego_lane
        if lane is None or lane.offset is None or lane.width is None:
            return {"lane_departure_left": (None, 0.0), "lane_departure_right": (None, 0.0)}
        found: dict[EventKind, tuple[bool | None, float]] = {}
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

    def _collision(self, road: Road) -> tuple[bool | None, float]:
        limits, lead = self.thresholds, road.lead
        time = None if lead is None else lead.time_to_collision
        if self._states["forward_collision"].on:
            return (time is not None and time.value < limits.collision_end), 0.0 if time is None else time.value
        if lead is None or time is None:
            return False, 0.0
        self._track = lead.track_id
        return time.value < limits.collision_begin, time.value
