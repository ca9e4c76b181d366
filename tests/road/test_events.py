from __future__ import annotations

import pytest

from trilitenet.errors import ConfigError
from trilitenet.road.events import EventDetector, EventThresholds
from trilitenet.road.structures import EgoLane, Estimate, Event, LeadVehicle, Road


def road(offset: float = 0.0, heading: float = 0.0, time: float | None = None) -> Road:
    lane = EgoLane(Estimate(3.6, 0.1), Estimate(offset, 0.05), Estimate(heading, 0.002), None)
    lead = None
    if time is not None:
        lead = LeadVehicle(0, 7, Estimate(20.0, 1.0), Estimate(20.0 / time, 0.5), Estimate(time, 0.3))
    return Road(ego_lane=lane, lead=lead)


def run(detector: EventDetector, roads: list[Road], start: float = 0.0) -> list[Event]:
    events: list[Event] = []
    for index, item in enumerate(roads):
        events += detector.update(item, start + index / 25, index)
    return events


def test_drifting_over_the_line_begins_and_ends_once() -> None:
    detector = EventDetector()
    out = [road(0.02 * i, 0.02) for i in range(60)]  # 1.2 m to the left: 0.3 m over the line
    back = [road(1.2 - 0.02 * i, -0.02) for i in range(60)]
    events = run(detector, out + back)
    assert [(e.kind, e.phase) for e in events] == [("lane_departure_left", "begin"), ("lane_departure_left", "end")]
    assert events[0].value < 0.1
    assert events[0].frame is not None
    assert 40 <= events[0].frame <= 50  # 0.8 m left the vehicle's side 0.1 m from the line, and 0.12 s to be sure
    assert detector.warnings == ()


def test_weaving_about_the_threshold_is_one_event() -> None:
    detector = EventDetector()
    weave = [road(0.85 + 0.06 * (i % 2), 0.02 if i % 2 else 0.01) for i in range(100)]
    assert len(run(detector, weave)) == 1


def test_no_departure_when_steering_away_or_for_a_blink() -> None:
    assert not run(EventDetector(), [road(1.0, -0.02)] * 50)
    blink = [road(0.0)] * 10 + [road(1.0, 0.02)] * 2 + [road(0.0)] * 10
    assert not run(EventDetector(), blink)


def test_departure_to_the_right() -> None:
    events = run(EventDetector(), [road(-1.0, -0.02)] * 20)
    assert [(e.kind, e.phase) for e in events] == [("lane_departure_right", "begin")]


def test_collision_warning_with_hysteresis() -> None:
    detector = EventDetector()
    times = [5.0, 4.0, 3.0, 2.5, 2.5, 2.5, 2.5, 2.5] + [3.2] * 30 + [3.6] * 30
    events = run(detector, [road(time=t) for t in times])
    assert [(e.kind, e.phase, e.track_id) for e in events] == [
        ("forward_collision", "begin", 7),
        ("forward_collision", "end", 7),
    ]
    assert events[0].timestamp == pytest.approx(6 / 25, abs=0.05)
    assert events[1].timestamp > 38 / 25 + 0.4


def test_says_nothing_of_what_it_does_not_know() -> None:
    detector = EventDetector()
    assert not run(detector, [Road()] * 50)
    run(detector, [road(1.0, 0.02)] * 20)
    assert detector.warnings == ("lane_departure_left",)
    assert not run(detector, [Road()] * 40, start=0.8)  # a lane out of sight for a moment ends no departure
    assert detector.warnings == ("lane_departure_left",)
    (event,) = run(detector, [Road()] * 50, start=2.4)
    assert (event.kind, event.phase) == ("lane_departure_left", "end")
    assert event.timestamp == pytest.approx(19 / 25 + 2.0, abs=0.05)
    assert event.value == pytest.approx(-0.1)
    assert not detector.warnings


def test_a_lead_too_near_to_be_seen_is_not_a_danger_that_is_over() -> None:
    detector = EventDetector()
    closing = [road(time=3.2 - i / 25) for i in range(73)]  # at 10 m/s from 32 m to 3.2 m
    (begin,) = run(detector, closing)
    assert begin.phase == "begin"
    assert not run(detector, [road()] * 45, start=73 / 25)
    assert detector.warnings == ("forward_collision",)
    (end,) = run(detector, [road()] * 25, start=118 / 25)
    assert (end.kind, end.phase, end.track_id) == ("forward_collision", "end", 7)
    assert end.value == pytest.approx(3.2 - 72 / 25)


def test_a_lead_that_no_longer_closes_ends_the_warning() -> None:
    detector = EventDetector()
    run(detector, [road(time=2.0)] * 10)
    away = LeadVehicle(0, 7, Estimate(20.0, 1.0), Estimate(-1.0, 0.5))
    (event,) = run(detector, [Road(lead=away)] * 20, start=0.4)
    assert (event.phase, event.value) == ("end", 2.0)
    assert event.timestamp == pytest.approx(0.9, abs=0.05)


def test_a_clock_set_back_does_not_stop_an_event_that_was_about_to_begin() -> None:
    detector = EventDetector()
    assert not run(detector, [road(1.2, 0.02)] * 2, start=102.0)
    (begin,) = run(detector, [road(1.2, 0.02)] * 10, start=2.0)
    assert begin.phase == "begin"


def test_a_late_frame_without_a_reading_does_not_end_an_event() -> None:
    detector = EventDetector()
    run(detector, [road(1.2, 0.02)] * 10)
    assert not detector.update(Road(), 0.3)
    assert detector.warnings == ("lane_departure_left",)


def test_a_late_frame_does_not_make_an_event_begin_or_end_early() -> None:
    detector = EventDetector()
    for timestamp in (10.0, 10.04, 9.7, 10.08):
        assert not detector.update(road(1.2, 0.02), timestamp)
    assert detector.update(road(1.2, 0.02), 10.13)
    for timestamp in (10.17, 9.8, 10.36):
        assert not detector.update(road(0.0, 0.0), timestamp)
    assert detector.update(road(0.0, 0.0), 10.68)


def test_an_event_as_json() -> None:
    event = Event("forward_collision", "begin", 1.23456, 30, 2.5, 7)
    assert event.to_dict() == {
        "kind": "forward_collision", "phase": "begin", "timestamp": 1.235, "frame": 30, "value": 2.5, "track_id": 7,
    }  # fmt: skip


def test_thresholds_must_leave_room_for_hysteresis() -> None:
    with pytest.raises(ConfigError, match="below"):
        EventThresholds(collision_begin=3.0, collision_end=2.0)


def test_a_departure_ends_in_the_next_lane_however_narrow() -> None:
    def narrow(offset: float) -> Road:
        return Road(ego_lane=EgoLane(Estimate(2.2, 0.1), Estimate(offset, 0.05), Estimate(0.02, 0.002), None))

    events = run(EventDetector(), [narrow(0.15)] * 10 + [narrow(-0.05)] * 30)
    assert [event.phase for event in events] == ["begin", "end"]


def test_a_beginning_must_hold_without_a_gap() -> None:
    detector = EventDetector()
    assert not run(detector, [road(time=2.0)] * 2 + [Road()] * 10 + [road(time=2.0)] * 2)
    assert len(run(detector, [road(time=2.0)] * 5, start=1.0)) == 1


def test_a_warning_ends_with_the_vehicle_that_it_began_with() -> None:
    other = Road(lead=LeadVehicle(0, 9, Estimate(20.0, 1.0), Estimate(4.0, 0.5), Estimate(5.0, 0.3)))
    events = run(EventDetector(), [road(time=2.0)] * 10 + [other] * 20)
    assert [(event.phase, event.track_id) for event in events] == [("begin", 7), ("end", 7)]
