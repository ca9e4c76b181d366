"""Figures in metres against exact truth: the geometry alone, fed with true masks and boxes."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from importlib import resources

import cv2
import jsonschema
import numpy as np
import pytest

from trilitenet.data.synthetic import Scene
from trilitenet.errors import ShapeError
from trilitenet.processing.geometry import Camera
from trilitenet.road.camera import CameraErrors
from trilitenet.road.ego import REAR_OVERHANG
from trilitenet.road.monitor import RoadMonitor
from trilitenet.road.structures import EgoLane, Road
from trilitenet.road.tracking import Steady
from trilitenet.structures import Boxes, Perception

Perceive = Callable[[Scene], Perception]


@pytest.fixture(scope="module")
def roads(drive: tuple[Scene, ...], perceived: Perceive) -> list[Road]:
    monitor = RoadMonitor(drive[0].truth.camera)
    return [monitor(perceived(scene)) for scene in drive]


def test_offset_heading_and_curvature(drive: tuple[Scene, ...], roads: list[Road]) -> None:
    offsets, headings, bends = [], [], []
    for scene, road in zip(drive, roads, strict=True):
        lane, truth = road.ego_lane, scene.truth
        assert lane is not None
        assert lane.offset is not None
        assert lane.heading is not None
        half = truth.lane_width / 2
        apart = abs(lane.offset.value - truth.offset)
        # On the line between two lanes, which of them is the own one is a matter of centimetres.
        if half - abs(truth.offset) < 0.1:
            apart = min(apart, abs(apart - truth.lane_width))
        offsets.append(apart)
        headings.append(abs(lane.heading.value - truth.heading))
        if lane.curvature is not None:
            bends.append(abs(lane.curvature.value - truth.curvature))
        assert apart < 5 * lane.offset.error
    assert max(offsets) < 0.10
    assert max(headings) < 0.01
    assert len(bends) > 40
    assert max(bends) < 0.003


def test_lane_width(drive: tuple[Scene, ...], roads: list[Road]) -> None:
    widths = [road.ego_lane.width.value for road in roads if road.ego_lane and road.ego_lane.width]
    assert len(widths) > 50
    np.testing.assert_allclose(widths, drive[0].truth.lane_width, atol=0.1)


def test_distance_to_the_lead(drive: tuple[Scene, ...], roads: list[Road]) -> None:
    shares = []
    for scene, road in zip(drive, roads, strict=True):
        lead = scene.truth.lead
        if lead is not None and lead.distance <= 40:
            assert road.lead is not None
            shares.append(abs(road.lead.distance.value / lead.distance - 1))
            assert abs(road.lead.distance.value - lead.distance) < 3 * road.lead.distance.error
    assert len(shares) > 25
    assert max(shares) < 0.05


def test_closing_speed_and_time_to_collision(drive: tuple[Scene, ...], roads: list[Road]) -> None:
    errors = []
    for scene, road in zip(drive, roads, strict=True):
        lead = scene.truth.lead
        if lead is None or lead.distance > 30 or road.lead is None or road.lead.closing_speed is None:
            continue
        errors.append(abs(road.lead.closing_speed.value - (scene.truth.speed - lead.speed)))
        if road.lead.time_to_collision is not None:
            assert road.lead.closing_speed.value > 0.5
    assert len(errors) > 15
    assert np.median(errors) < 0.7


def test_the_change_of_lanes_is_one_departure_to_the_left(roads: list[Road]) -> None:
    events = [event for road in roads for event in road.events]
    assert [(event.kind, event.phase) for event in events] == [
        ("lane_departure_left", "begin"),
        ("lane_departure_left", "end"),
    ]
    assert 6.0 < events[0].timestamp < 11.0


def test_a_warning_ends_when_the_camera_is_no_longer_trusted(
    drive: tuple[Scene, ...], perceived: Perceive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monitor = RoadMonitor(drive[0].truth.camera)
    scenes = iter(drive)
    while not (road := monitor(perceived(next(scenes)))).warnings:
        pass
    assert road.warnings == ("lane_departure_left",)
    monkeypatch.setattr(monitor, "_trusted", lambda _: (None, CameraErrors(), None))
    after = [monitor(perceived(next(scenes))) for _ in range(12)]  # 3 s
    assert after[0].warnings == ("lane_departure_left",)
    assert [event.phase for found in after for event in found.events] == ["end"]
    assert after[-1].warnings == ()


def test_lines_keep_their_identity(roads: list[Road]) -> None:
    left = [road.ego_lines[0].id for road in roads[:20] if road.ego_lines[0]]
    assert len(left) == 20
    assert len(set(left)) == 1


def test_drivable_outlines_cover_the_mask(drive: tuple[Scene, ...], roads: list[Road]) -> None:
    mask = drive[0].sample.drivable
    assert mask is not None
    drawn = np.zeros_like(mask)
    for outline in roads[0].drivable:
        cv2.fillPoly(drawn, [np.rint(outline).astype(np.int32)], 1)
    assert (drawn & mask).sum() / (drawn | mask).sum() > 0.95


def test_without_a_camera_it_calibrates_itself(drive: tuple[Scene, ...], perceived: Perceive) -> None:
    monitor = RoadMonitor(lane_width=drive[0].truth.lane_width)
    found = [monitor(perceived(scene)) for scene in drive]
    assert found[0].camera is None
    assert found[0].ego_lane is None
    assert found[0].lines  # curves need no camera
    offsets = [
        abs(road.ego_lane.offset.value - scene.truth.offset)
        for scene, road in zip(drive, found, strict=True)
        if road.ego_lane and road.ego_lane.offset and abs(scene.truth.offset) < 1.5
    ]
    assert len(offsets) > 35
    assert max(offsets) < 0.12
    assert found[-1].calibrated == "lanes"


def test_a_wrong_horizon_is_told_by_the_error(drive: tuple[Scene, ...], perceived: Perceive) -> None:
    import dataclasses

    true = drive[0].truth.camera
    wrong = RoadMonitor(dataclasses.replace(true, pitch=true.pitch + 0.02), still=True)
    right = RoadMonitor(true, still=True)
    for scene in drive[8:24:4]:
        bad, good = wrong(perceived(scene)).lead, right(perceived(scene)).lead
        assert good is not None
        if bad is not None:
            assert bad.distance.error > 1.5 * good.distance.error
            assert abs(bad.distance.value - good.distance.value) < 2 * bad.distance.error


def test_nothing_in_sight_gives_nothing() -> None:
    camera = Camera.from_field_of_view((360, 640), 60.0, 1.4)
    road = RoadMonitor(camera)(Perception((360, 640), lane=np.zeros((360, 640), bool)))
    assert road.lines == ()
    assert road.ego_lane is None
    assert road.lead is None
    assert RoadMonitor()(Perception((360, 640))).to_dict()["camera"] is None


def test_a_camera_of_another_shape_is_refused() -> None:
    camera = Camera.from_field_of_view((480, 640), 60.0, 1.4)
    monitor = RoadMonitor(camera)
    for _ in range(2):
        with pytest.raises(ShapeError, match="another shape"):
            monitor(Perception((360, 640)))


def test_a_camera_of_another_resolution_is_scaled(drive: tuple[Scene, ...], perceived: Perceive) -> None:
    camera = drive[0].truth.camera.resized((720, 1280))
    lane = RoadMonitor(camera, still=True)(perceived(drive[0])).ego_lane
    assert lane is not None
    assert lane.offset is not None
    assert lane.offset.value == pytest.approx(drive[0].truth.offset, abs=0.1)


def test_the_json_follows_the_schema(drive: tuple[Scene, ...], perceived: Perceive, roads: list[Road]) -> None:
    text = resources.files("trilitenet.formats").joinpath("schema/perception-1.0.json").read_text()
    schema = json.loads(text)
    schema = {"$schema": schema["$schema"], "$defs": schema["$defs"], "$ref": "#/$defs/road"}
    for road in (roads[0], roads[30], roads[59], RoadMonitor()(perceived(drive[0]))):
        jsonschema.validate(json.loads(json.dumps(road.to_dict())), schema)
    assert roads[30].to_dict()["lead"] is not None


def test_with_tracks_the_lead_keeps_its_number(drive: tuple[Scene, ...], perceived: Perceive) -> None:
    pytest.importorskip("edgefirst.tracker")
    steady, monitor = Steady(track=True), RoadMonitor(drive[0].truth.camera)
    tracks = []
    for scene in drive[:24]:
        road = monitor(steady(perceived(scene)))
        if road.lead is not None and scene.truth.lead is not None:
            tracks.append((road.lead.track_id, scene.truth.lead.number))
    assert len(set(tracks[4:])) == 1


def marked(camera: Camera, *sides: float, curvature: float = 0.0) -> Perception:
    """Draw lines so many metres to the left, straight or bending to it."""
    ahead = np.linspace(4.5, 60.0, 200)
    mask = np.zeros(camera.size, np.uint8)
    for side in sides:
        pixels = camera.to_pixels(np.stack([ahead, side + curvature * ahead**2 / 2], axis=1))
        cv2.polylines(mask, [np.round(pixels).astype(np.int32)], False, 1, 3)
    return Perception(camera.size, lane=mask > 0)


def test_with_one_line_in_sight_the_lane_has_the_width_from_before() -> None:
    camera = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03)
    monitor = RoadMonitor(camera)
    for _ in range(5):
        monitor(marked(camera, 1.8, -1.8))
    lane = monitor(marked(camera, 1.8)).ego_lane
    assert lane is not None
    assert lane.width is not None
    assert lane.width.value == pytest.approx(3.6, abs=0.15)
    for frame in range(60):  # the vehicle moves 0.3 m towards the line that is seen
        lane = monitor(marked(camera, 1.8 - min(frame, 30) * 0.01)).ego_lane
    assert lane is not None
    assert lane.offset is not None
    assert lane.offset.value == pytest.approx(0.3, abs=0.1)


@pytest.mark.parametrize("still", [True, False])
def test_a_road_that_vehicles_are_too_narrow_for_is_no_lane(still: bool) -> None:
    camera = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03)
    road = marked(camera, 4.7, 3.2, -3.2)
    (start, foot), (end, _) = camera.to_pixels([[12.0, 0.9], [12.0, -0.9]])
    box = np.array([[start, foot - 40, end, foot]], np.float32)
    vehicle = Boxes(box, np.full(1, 0.9, np.float32), np.zeros(1, np.int64))
    for boxes, name in ((None, "vehicle"), (vehicle, "person"), (vehicle, "vehicle"), (vehicle, "Car")):
        road = dataclasses.replace(road, class_names=(name,))
        monitor = RoadMonitor(still=still)
        for frame in range(1 if still else 30):  # the video has its camera before the vehicles come
            seen = boxes if still or frame >= 15 else None
            found = monitor(dataclasses.replace(road, boxes=seen, timestamp=frame / 10))
            assert still or frame != 20 or found.camera is not None
        assert (found.camera is None) == (boxes is not None and name != "person")


@pytest.mark.parametrize("still", [True, False])
@pytest.mark.parametrize("left", [0.0, 0.3, -0.3])
def test_offsets_are_those_of_the_middle_of_the_vehicle(left: float, still: bool) -> None:
    camera = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03)
    monitor = RoadMonitor(dataclasses.replace(camera, left=left), still=still)
    for _ in range(5):
        lane = monitor(marked(camera, 1.6, -2.0)).ego_lane  # the lens is 0.2 m left of the lane's centre
    assert lane is not None
    assert lane.offset is not None
    assert lane.offset.value == pytest.approx(0.2 - left, abs=0.03)


@pytest.mark.parametrize(
    ("told", "departs"),
    [
        ({}, False),  # 1.75 - 0.25 - 0.9 = 0.6 m of room on the left
        ({"vehicle_width": 2.5}, False),  # 0.25 m
        ({"vehicle_width": 2.5, "left": -0.2}, True),  # 0.05 m, for the middle is 0.45 m left of the lane's
        ({"left": -0.6}, True),  # 0.0 m
    ],
)
def test_departures_are_those_of_the_sides_of_the_vehicle(told: dict[str, float], departs: bool) -> None:
    camera = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03, yaw=0.02)  # 0.02 rad to the left
    driven = RoadMonitor(dataclasses.replace(camera, yaw=0.0, **told))  # type: ignore[arg-type]
    for _ in range(20):
        road = driven(marked(camera, 1.5, -2.0))
    assert road.warnings == (("lane_departure_left",) if departs else ())


@pytest.mark.parametrize("radius", [300, -500])
def test_a_bend_that_is_calibrated_as_yaw_is_in_the_errors(radius: int) -> None:
    camera = Camera.from_field_of_view((720, 1280), 60.0, 1.4, pitch=0.03)
    monitor = RoadMonitor()
    for _ in range(60):
        lane = monitor(marked(camera, 1.75, -1.75, curvature=1 / radius)).ego_lane
    assert lane is not None
    assert lane.heading is not None
    assert 0.008 < abs(lane.heading.value) < 2 * lane.heading.error  # the vehicle drives along the lane
    straight = RoadMonitor()
    for _ in range(60):
        lane = straight(marked(camera, 1.75, -1.75)).ego_lane
    assert lane is not None
    assert lane.heading is not None
    assert abs(lane.heading.value) < 2 * lane.heading.error < 0.03


@pytest.mark.parametrize("rate", [1, 5, 25])
def test_the_width_of_a_lane_is_learnt_and_forgotten_by_time(rate: int) -> None:
    camera = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03)
    monitor = RoadMonitor(camera)
    now = 0.0

    def see(seconds: float, *sides: float) -> EgoLane | None:
        nonlocal now
        road = None
        for _ in range(max(1, round(seconds * rate))):
            road = monitor(dataclasses.replace(marked(camera, *sides), timestamp=now))
            now += 1 / rate
        assert road is not None
        return road.ego_lane

    see(4, 1.9, -1.9)
    see(3, 1.4, -1.4)  # the road narrows
    lane = see(1 / rate, -1.4)
    assert lane is not None
    assert lane.width is not None
    assert lane.width.value == pytest.approx(2.8, abs=0.15)
    sure = lane.width.error
    lane = see(10, -1.4)
    assert lane is not None
    assert lane.width is not None
    assert lane.width.error > sure + 0.03
    now += 600  # another road
    lane = see(1 / rate, -1.4)
    assert lane is None or (lane.width, lane.offset) == (None, None)


@pytest.mark.parametrize("given", [True, False])
@pytest.mark.parametrize("speed", [8, 20, 30])
def test_a_standing_vehicle_is_warned_of_however_fast_it_comes(given: bool, speed: int) -> None:
    camera = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03)
    monitor = RoadMonitor(camera if given else None)
    empty = marked(camera, 1.75, -1.75)
    begun = None
    for frame in range(-15, 70):
        left = 5.0 - max(frame, 0) / 25  # seconds
        feet = np.array([[speed * left + REAR_OVERHANG, 0.9], [speed * left + REAR_OVERHANG, -0.9]])
        (start, foot), (end, _) = camera.to_pixels(feet) + 0.5
        box = np.array([[start, foot - 0.83 * (end - start), end, foot]], np.float32)
        boxes = Boxes(box, np.full(1, 0.9, np.float32), np.zeros(1, np.int64), np.zeros(1, np.int64))
        road = monitor(dataclasses.replace(empty, boxes=boxes if frame >= 0 else None, timestamp=(frame + 15) / 25))
        if road.warnings and begun is None:
            begun = left
            assert road.warnings == ("forward_collision",)
            assert road.lead is not None
            assert road.lead.time_to_collision is not None
            assert abs(road.lead.time_to_collision.value - left) < 2 * road.lead.time_to_collision.error
    assert begun == pytest.approx(2.55, abs=0.07 if given else 0.15)
