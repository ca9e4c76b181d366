from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest

from trilitenet.processing.geometry import Camera
from trilitenet.road.camera import CameraErrors
from trilitenet.road.ego import (
    BOX_ERROR_SHARE,
    MAX_DISTANCE_ERROR,
    REAR_OVERHANG,
    LaneFilter,
    LaneFit,
    LeadFilter,
    find_distances,
    find_lead,
    fit_ego_lane,
)
from trilitenet.road.lanes import find_lines
from trilitenet.road.structures import EgoLane, Estimate, LaneLine, LeadVehicle
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


def fit_of(offset: float, heading: float = 0.0, curvature: float = 0.0, sure: float = 1.0) -> LaneFit:
    """Return a lane 3.6 m wide as one frame may tell it."""
    lane = EgoLane(Estimate(3.6, 0.05), None, None, None)
    spread = np.diag([0.1**2, 0.02**2, 0.002**2]) / sure**2
    return LaneFit(lane, None, 1.8, np.array([offset, heading, curvature]), spread, np.array([0.01, 0.001, 0.0]))


def offset_of(lane: EgoLane) -> Estimate:
    assert lane.offset is not None
    return lane.offset


def test_frames_together_tell_the_lane_better_than_one() -> None:
    rng = np.random.default_rng(0)
    lanes, followed, alone = LaneFilter(), [], []
    for frame in range(100):
        true = 0.2 * np.sin(frame * 0.2)  # five frames a second, one swing in six seconds
        missed = rng.normal(0.0, 0.1)
        lane = lanes.update(fit_of(true + missed), frame * 0.2)
        alone.append(abs(missed))
        followed.append(abs(offset_of(lane).value - true))
        assert followed[-1] < 4 * offset_of(lane).error
    assert np.mean(followed[5:]) < 0.75 * np.mean(alone[5:])
    assert offset_of(lane).error < 0.1
    assert lane.width == Estimate(3.6, 0.05)


def test_more_frames_a_second_are_not_taken_for_more_evidence() -> None:
    errors = []
    for rate in (5, 50):
        lanes = LaneFilter()
        for frame in range(10 * rate):
            lane = lanes.update(fit_of(0.1), frame / rate)
        errors.append(offset_of(lane).error)
    assert errors[1] > 0.6 * errors[0]


def test_errors_that_hang_together_are_told_apart() -> None:
    """Once the bend is known, a frame whose offset and bend err together no longer misleads."""
    lanes = LaneFilter()
    for frame in range(20):
        lanes.update(fit_of(0.0, sure=5.0), frame * 0.2)
    wrong = fit_of(0.3, 0.0, 0.006)
    spread = wrong.spread.copy()
    spread[0, 2] = spread[2, 0] = 0.99 * np.sqrt(spread[0, 0] * spread[2, 2])
    together = offset_of(lanes.update(wrong._replace(spread=spread), 4.0))
    assert abs(together.value) < 0.02


def test_the_next_lane_is_a_step_not_a_slope() -> None:
    lanes, seen = LaneFilter(), []
    for frame in range(60):
        true = frame * 0.05  # a metre a second to the left
        within = (true + 1.8) % 3.6 - 1.8
        seen.append((offset_of(lanes.update(fit_of(within), frame * 0.05)).value, within))
    assert max(abs(value - true) for value, true in seen[20:]) < 0.1


def test_one_wild_frame_is_doubted_two_that_agree_are_believed() -> None:
    lanes = LaneFilter()
    for frame in range(20):
        lanes.update(fit_of(0.0), frame * 0.2)
    assert lanes.update(fit_of(1.2, sure=3.0), 4.0).offset is None, "its error is as large as the contradiction"
    assert offset_of(lanes.update(fit_of(0.0), 4.2)).value == pytest.approx(0.0, abs=0.25)
    assert lanes.update(fit_of(1.2, sure=3.0), 4.4).offset is None
    assert offset_of(lanes.update(fit_of(1.3, sure=3.0), 4.6)).value == pytest.approx(1.3, abs=0.05)


def test_one_stray_line_does_not_move_the_vehicle_into_the_next_lane() -> None:
    lanes = LaneFilter()
    for frame in range(50):
        lanes.update(fit_of(-1.0, sure=3.0), frame * 0.04)
    for frame, stray in ((50, fit_of(0.1, sure=3.0)._replace(half_width=1.0)), (51, fit_of(1.9, sure=3.0))):
        assert lanes.update(stray, frame * 0.04).offset is None
        for after in range(1, 5):
            lane = lanes.update(fit_of(-1.0, sure=3.0), (frame + 0.2 * after) * 0.04)
        assert offset_of(lane).value == pytest.approx(-1.0, abs=0.2)


def test_the_same_moment_again_changes_nothing() -> None:
    lanes = LaneFilter()
    for frame in range(20):
        lane = lanes.update(fit_of(0.5), frame * 0.2)
    assert lanes.update(fit_of(1.0), 19 * 0.2).offset == lane.offset


def test_a_late_frame_adds_nothing_to_the_lane() -> None:
    lanes = LaneFilter()
    for index in range(20):
        before = lanes.update(fit_of(0.1 + 0.004 * index, 0.1), index / 25)
    assert lanes.update(fit_of(0.8), 18.5 / 25) == before
    after = lanes.update(fit_of(0.18, 0.1), 20 / 25)
    assert offset_of(after).error < 1.01 * offset_of(before).error
    assert offset_of(lanes.update(fit_of(0.8), 0.0)).value == pytest.approx(0.8)  # not late: the clock was set back


def test_late_frames_leave_the_closing_speed_alone() -> None:
    camera, told = Camera.from_field_of_view((384, 640), 60.0, 1.4), []
    leads = LeadFilter()
    boxes = Boxes(np.array([[300, 180, 340, 220]], np.float32), np.ones(1, np.float32), np.zeros(1, np.int64))
    for index in range(60):
        moment = index / 25 - (0.05 if index % 10 == 9 else 0.0)
        lead = LeadVehicle(0, 7, Estimate(30.0 - 8 * moment, 1.0))
        found = leads.update(lead, boxes, moment, camera)
        assert found is not None
        told.append(None if found.closing_speed is None else found.closing_speed.value)
    assert all(speed is not None for speed in told[20:])
    assert told[-1] == pytest.approx(8.0, abs=0.5)
    other = LeadVehicle(0, 9, Estimate(5.0, 1.0))
    assert leads.update(other, boxes, 57.5 / 25, camera) is other  # late, and another vehicle: passed on as it is
    assert leads.update(lead, boxes, 60 / 25, camera).closing_speed is not None  # type: ignore[union-attr]


def test_the_same_moment_again_makes_no_closing_speed_surer() -> None:
    camera, found = Camera.from_field_of_view((384, 640), 60.0, 1.4), []
    boxes = Boxes(np.array([[300, 180, 340, 220]], np.float32), np.ones(1, np.float32), np.zeros(1, np.int64))
    for times in (1, 3):
        leads = LeadFilter()
        for index in range(25 * times):
            moment = index // times / 25
            told = leads.update(LeadVehicle(0, 7, Estimate(30.0 - 8 * moment, 1.0)), boxes, moment, camera)
        found.append(told)
    assert found[1] == found[0]


@pytest.mark.parametrize("rate", [5, 25, 60])
@pytest.mark.parametrize("braking", [2.0, 4.0])
def test_the_error_of_a_closing_speed_holds_while_the_lead_brakes(rate: int, braking: float) -> None:
    leads, boxes = LeadFilter(), standing((40.0, 0.0))
    for frame in range(4 * rate + 1):
        since = max(0.0, frame / rate - 2)
        distance = 40 - braking * since**2 / 2
        found = leads.update(LeadVehicle(0, 3, Estimate(distance, 0.5)), boxes, frame / rate, CAMERA)
    assert found is not None
    assert found.closing_speed is not None
    assert abs(found.closing_speed.value - 2 * braking) < 2 * found.closing_speed.error
    assert found.closing_speed.error < LeadFilter.MAX_SPEED_ERROR


@pytest.mark.parametrize("rate", [5, 25, 60])
@pytest.mark.parametrize("speed", [8, 20, 30])
def test_a_fast_approach_is_told_in_time(rate: int, speed: int) -> None:
    """A camera's error, which is a share of the speed, must not hide it."""
    leads, boxes = LeadFilter(), standing((30.0, 0.0))
    for frame in range(2 * rate + 1):
        true = 4.8 * speed - speed * frame / rate
        found = leads.update(LeadVehicle(0, 3, Estimate(1.1 * true, 0.2 * true)), boxes, frame / rate, CAMERA, 0, 0.15)
    assert found is not None
    assert found.closing_speed is not None
    assert abs(found.closing_speed.value - speed) < 2 * found.closing_speed.error
    assert found.time_to_collision is not None
    assert found.time_to_collision.value == pytest.approx(2.8, abs=0.15)


def test_the_error_of_a_time_to_collision_has_what_is_not_in_the_speed_alike() -> None:
    tilt = 0.004 / CAMERA.height  # radians, seen as a share of the distance that grows with it
    for scale, off in ((0.15, 0.0), (0.0, tilt)):
        leads, boxes = LeadFilter(), standing((30.0, 0.0))
        for frame in range(51):
            true = 144 - 30 * frame / 25
            distance = true * (1 + scale + off * true)
            lead = LeadVehicle(0, 3, Estimate(distance, true * (scale + off * true)))
            found = leads.update(lead, boxes, frame / 25, CAMERA, 0.0, scale)
        assert found is not None
        assert found.time_to_collision is not None
        left = found.time_to_collision
        assert abs(left.value - true / 30) < 2 * left.error
        assert (left.error > 0.4) == (off > 0)


def test_a_collision_is_of_the_bumper_not_of_the_lens() -> None:
    camera = dataclasses.replace(CAMERA, front=1.8)
    leads = LeadFilter()
    for frame in range(101):
        boxes = standing((20 - 3 * frame / 25 + REAR_OVERHANG, 0.0))  # 3 m/s nearer, in the end 8 m from the lens
        (distance,) = find_distances(boxes, camera, CameraErrors())
        assert distance is not None
        found = leads.update(LeadVehicle(0, 3, distance), boxes, frame / 25, camera, 0.0, 0.011)
    assert found is not None
    assert found.distance.value == pytest.approx(8 - 1.8, abs=0.05)
    assert found.closing_speed is not None
    assert found.closing_speed.value == pytest.approx(3.0, abs=0.05)
    assert found.time_to_collision is not None
    assert found.time_to_collision.value == pytest.approx(6.2 / 3, abs=0.05)  # 2.07 s; the windscreen has 2.67 s


def test_a_bumper_before_the_lens_changes_neither_reach_nor_errors() -> None:
    nearer = dataclasses.replace(CAMERA, front=5.0)
    boxes = standing((6.0, 0.0), (6.8, 0.0), *((float(ahead), 0.0) for ahead in np.linspace(60, 160, 400)))
    plain, told = (find_distances(boxes, camera, CameraErrors()) for camera in (CAMERA, nearer))
    assert plain[0] is not None
    assert told[0] is None, "less than half a metre before the bumper"
    assert told[1] is not None
    assert told[1].value == pytest.approx(6.8 - REAR_OVERHANG - 5.0, abs=0.05)
    for one, other in zip(plain[1:], told[1:], strict=True):
        assert (one is None) == (other is None)
        assert one is None or other is None or one.error == other.error
    found = []
    for camera in (CAMERA, nearer):
        leads = LeadFilter()
        for frame in range(51):
            seen = 40.0 - 10 * frame / 25
            lead = LeadVehicle(0, 3, Estimate(seen - camera.front, math.hypot(0.1, 0.2 * seen)))
            lead = leads.update(lead, boxes, frame / 25, camera, 0.0, 0.2) or lead
        found.append(lead)
    assert found[0].closing_speed is not None
    assert found[1].closing_speed is not None
    assert found[1].closing_speed.error == pytest.approx(found[0].closing_speed.error)
    assert found[1].distance.error == pytest.approx(found[0].distance.error)
    times = [lead.time_to_collision for lead in found if lead.time_to_collision is not None]
    assert times[1].value == pytest.approx(times[0].value - 0.5, abs=0.01)
    # All but the bumper's 5 m is wrong by the scale in distance and speed alike; what else the speed errs by is less.
    rate = math.sqrt(found[0].closing_speed.error ** 2 - (0.2 * 10) ** 2)
    shares = [(10 * left.error) ** 2 - (left.value * rate) ** 2 for left in times]
    assert shares[1] == pytest.approx(shares[0] + (0.2 * 5) ** 2, rel=0.05)


def test_a_speed_that_may_be_noise_is_not_told() -> None:
    rng, leads, boxes = np.random.default_rng(0), LeadFilter(), standing((30.0, 0.0))
    for frame in range(200):
        lead = LeadVehicle(0, 3, Estimate(100 + rng.normal(0, 5), 20))
        found = leads.update(lead, boxes, frame / 10, CAMERA)
        assert found is not None
        assert found.closing_speed is None


def test_a_bump_is_not_taken_for_speed() -> None:
    boxes = standing((30.0, 0.0))
    told: dict[bool, list[float]] = {True: [], False: []}
    for marked, speeds in told.items():
        leads = LeadFilter()
        for frame in range(80):
            off = 4.0 * math.sin((frame - 50) / 3) if 50 <= frame < 60 else 0.0  # of a pitch that the lanes show
            lead = LeadVehicle(0, 3, Estimate(30 + off, 0.5))
            found = leads.update(lead, boxes, frame / 25, CAMERA, abs(off) if marked else 0.0)
            if found is not None and found.closing_speed is not None:
                speeds.append(abs(found.closing_speed.value) / found.closing_speed.error)
    assert max(told[False]) > 3
    assert max(told[True]) < 1.2


def test_frames_exactly_a_gap_apart_tell_a_speed() -> None:
    leads, boxes = LeadFilter(), standing((30.0, 0.0))
    told = []
    for frame in range(36):
        found = leads.update(LeadVehicle(0, 3, Estimate(30.0, 0.1)), boxes, frame * 15 / 25, CAMERA)
        assert found is not None
        told.append(found.closing_speed is not None)
    assert all(told[3:])


def test_a_camera_that_may_be_tilted_makes_offsets_less_sure() -> None:
    plain, tilted = (fit_ego_lane(line_at(1.8), line_at(-1.8), CAMERA, CameraErrors(roll=roll)) for roll in (0.0, 0.02))
    assert plain is not None
    assert tilted is not None
    share = 0.02 * CAMERA.height * (1 + (1.8 / CAMERA.height) ** 2)
    assert offset_of(tilted.lane).error == pytest.approx(math.hypot(offset_of(plain.lane).error, share), rel=0.02)


def test_what_one_frame_alone_errs_by_is_not_kept() -> None:
    """A frame in which the car pitches is marked by its errors, and leaves no trace in later ones."""
    left, right = line_at(1.8), line_at(-1.8)
    bump = CameraErrors(pitch=0.05)
    fit = fit_ego_lane(left, right, CAMERA, bump, usual=CameraErrors())
    plain = fit_ego_lane(left, right, CAMERA, CameraErrors())
    assert fit is not None
    assert plain is not None
    np.testing.assert_allclose(fit.lasting, plain.lasting)
    assert fit.spread[0, 0] > plain.spread[0, 0] + 0.02
    lanes = LaneFilter()
    for frame in range(10):
        lanes.update(plain, frame * 0.04)
    wrong = fit._replace(seen=fit.seen + np.array([0.2, 0.0, 0.0]))
    for frame in range(10, 15):
        lanes.update(wrong, frame * 0.04)
    lane = lanes.update(plain, 15 * 0.04)
    assert abs(offset_of(lane).value) < 2 * offset_of(lane).error


def test_figures_that_are_none_are_not_taken_in() -> None:
    lanes = LaneFilter()
    lanes.update(fit_of(0.1), 0.0)
    lanes.update(fit_of(float("nan")), 0.2)
    assert offset_of(lanes.update(fit_of(0.1), 0.4)).value == pytest.approx(0.1)


def test_a_lane_out_of_sight_for_long_is_forgotten() -> None:
    lanes = LaneFilter()
    for frame in range(20):
        lanes.update(fit_of(0.0), frame * 0.2)
    assert offset_of(lanes.update(fit_of(0.5), 3.8 + LaneFilter.GAP + 0.1)).value == pytest.approx(0.5)


def test_a_frame_outside_of_its_lane_is_passed_on_as_it_is() -> None:
    lanes = LaneFilter()
    lanes.update(fit_of(0.0), 0.0)
    outside = fit_of(2.5)._replace(seen=None)
    assert lanes.update(outside, 0.2) is outside.lane


def test_a_vehicle_cut_off_below_is_no_lead_and_has_no_distance() -> None:
    fit = fit_ego_lane(line_at(1.8), line_at(-1.8), CAMERA, CameraErrors())
    assert fit is not None
    for bottom, told in ((700.0, True), (720.0, False)):
        near = Boxes(
            np.array([[540.0, bottom - 200, 740.0, bottom]], np.float32),
            np.full(1, 0.9, np.float32),
            np.zeros(1, np.int64),
        )
        distances = find_distances(near, CAMERA, CameraErrors())
        assert (distances[0] is not None) == told
        assert (find_lead(near, distances, fit, CAMERA) is not None) == told


def test_lines_too_far_apart_or_too_near_are_no_lane() -> None:
    for half, found in ((0.75, False), (1.5, True), (4.0, False)):
        fit = fit_ego_lane(line_at(half), line_at(-half), CAMERA, CameraErrors())
        assert (fit is not None) == found


def standing(*places: tuple[float, float]) -> Boxes:
    """Return boxes 1.8 m wide whose feet are so many metres ahead and to the left."""
    rows = []
    for ahead, left in places:
        (u, v), (side, _) = CAMERA.to_pixels(np.array([[ahead, left], [ahead, left + 0.9]])) + 0.5
        rows.append([side, v - 1.5 * (u - side), 2 * u - side, v])
    count = len(places)
    return Boxes(np.array(rows, np.float32), np.full(count, 0.9, np.float32), np.zeros(count, np.int64))


def test_the_lead_is_the_nearest_in_the_lane_and_its_distance_that_of_its_rear() -> None:
    fit = fit_ego_lane(line_at(1.8), line_at(-1.8), CAMERA, CameraErrors())
    assert fit is not None
    for places in ([(15.0, 0.0), (25.0, 0.0), (10.0, 3.6)], [(25.0, 0.0), (15.0, 0.0), (10.0, 3.6)]):
        boxes = standing(*places)
        distances = find_distances(boxes, CAMERA, CameraErrors())
        lead = find_lead(boxes, distances, fit, CAMERA)
        assert lead is not None
        assert places[lead.box] == (15.0, 0.0)
        found = [one.value for one in distances if one is not None]
        assert found == pytest.approx([ahead - REAR_OVERHANG for ahead, _ in places], abs=0.1)
        assert lead.distance.value == pytest.approx(15.0 - REAR_OVERHANG, abs=0.1)


def test_what_is_behind_a_vehicle_too_near_to_be_measured_is_no_lead() -> None:
    camera = dataclasses.replace(CAMERA, front=3.5)
    fit = fit_ego_lane(line_at(1.8), line_at(-1.8), camera, CameraErrors())
    assert fit is not None
    for near, lead in (((4.4, 0.0), None), ((4.4, 3.6), 1), ((5.4, 0.0), 0)):  # at the bumper, beside it, before it
        boxes = standing((near[0], near[1]), (12.0, 0.0))
        distances = find_distances(boxes, camera, CameraErrors())
        assert (distances[0] is None) == (near[0] == 4.4)
        assert distances[1] is not None
        found = find_lead(boxes, distances, fit, camera)
        assert (None if found is None else found.box) == lead


def test_what_is_behind_a_lorry_too_far_to_be_measured_is_no_lead() -> None:
    fit = fit_ego_lane(line_at(1.8), line_at(-1.8), CAMERA, CameraErrors())
    assert fit is not None
    boxes = standing((134.0, 0.0), (136.0, 0.0))
    boxes.xyxy[0] += np.array([-3, -35, 3, 0], np.float32)  # a large box's lower edge is less sure
    distances = find_distances(boxes, CAMERA, CameraErrors())
    assert distances[0] is None
    assert distances[1] is not None
    assert find_lead(boxes, distances, fit, CAMERA) is None


def test_a_lorry_beside_that_the_edge_of_the_picture_cuts_is_no_lead() -> None:
    fit = fit_ego_lane(line_at(1.8), line_at(-1.8), CAMERA, CameraErrors())
    assert fit is not None
    foot = float(CAMERA.to_pixels(np.array([[4.0, 0.0]]))[0, 1])
    for right, leads in ((620.0, False), (1000.0, True)):
        cut = Boxes(
            np.array([[0.0, 300.0, right, foot]], np.float32), np.full(1, 0.9, np.float32), np.zeros(1, np.int64)
        )
        assert (find_lead(cut, find_distances(cut, CAMERA, CameraErrors()), fit, CAMERA) is not None) == leads


def test_no_distance_is_told_whose_error_is_above_its_limit() -> None:
    boxes = standing(*((float(ahead), 0.0) for ahead in np.linspace(60, 160, 400)))
    told = [one for one in find_distances(boxes, CAMERA, CameraErrors()) if one is not None]
    assert 0 < len(told) < 400
    assert max(one.error / one.value for one in told) <= MAX_DISTANCE_ERROR


@pytest.mark.parametrize(("track", "pause"), [(4, 0.05), (3, LeadFilter.GAP + 0.1)])
def test_another_lead_or_one_that_was_gone_has_no_speed_yet(track: int, pause: float) -> None:
    leads, boxes = LeadFilter(), standing((30.0, 0.0))
    found = None
    for frame in range(20):
        found = leads.update(LeadVehicle(0, 3, Estimate(30 - 0.1 * frame, 0.5)), boxes, frame * 0.05, CAMERA)
    assert found is not None
    assert found.closing_speed is not None
    assert found.closing_speed.value == pytest.approx(2.0, abs=0.3)
    found = leads.update(LeadVehicle(0, track, Estimate(20.0, 0.5)), boxes, 0.95 + pause, CAMERA)
    assert found is not None
    assert found.distance.value == pytest.approx(20.0)
    assert found.closing_speed is None
