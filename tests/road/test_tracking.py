from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest

from trilitenet.errors import ConfigError, MissingExtraError
from trilitenet.road.structures import LaneLine
from trilitenet.road.tracking import LineTracker, MaskSmoother, Steady, VehicleTracker, flicker
from trilitenet.structures import Boxes, Perception


def boxes(*left: float, confidence: float = 0.9) -> Boxes:
    xyxy = np.array([[x, 100, x + 60, 150] for x in left], np.float32).reshape(-1, 4)
    return Boxes(xyxy, np.full(len(left), confidence, np.float32), np.zeros(len(left), np.int64))


def test_vehicles_keep_their_numbers_while_they_move() -> None:
    pytest.importorskip("edgefirst.tracker")
    tracker = VehicleTracker()
    seen = []
    for frame in range(12):
        # The order of the boxes says nothing of who is who.
        found = (10.0 + 4 * frame, 400.0 - 5 * frame)
        order = found if frame % 2 else found[::-1]
        tracked = tracker.update(boxes(*order), frame / 25)
        assert tracked.track_id is not None
        pair = tracked.track_id.tolist()
        seen.append(pair if frame % 2 else pair[::-1])
    assert len({tuple(pair) for pair in seen[3:]}) == 1
    assert len(set(seen[-1])) == 2
    assert min(seen[-1]) >= 1


def test_a_vehicle_that_fades_keeps_its_number_and_a_lost_one_does_not_return() -> None:
    pytest.importorskip("edgefirst.tracker")
    tracker = VehicleTracker(memory=0.5)
    for frame in range(8):
        tracked = tracker.update(boxes(100.0), frame / 25)
    assert tracked.track_id is not None
    number = int(tracked.track_id[0])
    faint = tracker.update(boxes(101.0, confidence=0.2), 8 / 25)
    assert faint.track_id is not None
    assert int(faint.track_id[0]) == number
    for frame in range(60):
        assert len(tracker.update(Boxes.empty(), (9 + frame) / 25)) == 0
    again = tracker.update(boxes(101.0), 80 / 25)
    again = tracker.update(boxes(101.0), 81 / 25)
    assert again.track_id is not None
    assert int(again.track_id[0]) != number


@pytest.mark.parametrize("then", [3600.0, 2.3, 0.0])
def test_no_track_outlives_a_leap_in_time(then: float) -> None:
    pytest.importorskip("edgefirst.tracker")
    tracker = VehicleTracker(memory=1.0)
    for frame in range(5):
        before = tracker.update(boxes(100.0), 1 + frame / 30)
    assert before.track_id is not None
    numbers = set[int]()
    for frame in range(5):
        after = tracker.update(boxes(100.0), then + frame / 30)
        assert after.track_id is not None
        numbers |= set(after.track_id.tolist())
    assert numbers - {-1}
    assert int(before.track_id[0]) not in numbers


def test_a_late_frame_has_no_identity_and_ends_none() -> None:
    pytest.importorskip("edgefirst.tracker")
    tracker = VehicleTracker(memory=1.0)
    seen = []
    for frame in (0, 1, 2, 4, 3, 5, 6):
        after = tracker.update(boxes(100.0), 1 + frame / 30)
        assert after.track_id is not None
        seen.append(int(after.track_id[0]))
    assert seen[4] == -1
    assert seen[3] == seen[5] == seen[6] > 0


def test_a_vehicle_keeps_its_number_in_a_crowd_that_comes_and_goes() -> None:
    pytest.importorskip("edgefirst.tracker")
    tracker = VehicleTracker(memory=1.0)
    crowd = [100.0 * place for place in range(1, 514)]
    seen = [tracker.update(boxes(0.0, *crowd), frame / 30).track_id for frame in range(3)][-1]
    assert seen is not None
    assert len(set(seen.tolist()) - {-1}) == 514
    assert tracker.update(boxes(*crowd), 3 / 30).track_id is not None  # hidden for a frame
    again = tracker.update(boxes(0.0, *crowd), 4 / 30).track_id
    assert again is not None
    assert again.tolist() == seen.tolist()


def test_times_out_of_range_are_refused() -> None:
    pytest.importorskip("edgefirst.tracker")
    for memory in (-1.0, float("inf"), float("nan")):
        with pytest.raises(ConfigError, match="memory must be at least 0"):
            VehicleTracker(memory=memory)
    for timestamp in (-0.1, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="time stamp must be at least 0"):
            VehicleTracker().update(boxes(100.0), timestamp)


def test_says_which_extra_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "edgefirst.tracker", None)
    with pytest.raises(MissingExtraError, match=r"trilitenet\[track\]"):
        Steady(track=True)
    Steady(track=False, smoothing=0.5)


def _line(bottom: float) -> LaneLine:
    points = np.array([[bottom, 350], [bottom, 200]], np.float32)
    return LaneLine(0, 0, points, np.array([bottom, 0, 0, 0, 0, 0.0]), (350.0, -150.0), 0.1, 0.9)


def test_lines_are_followed_by_place() -> None:
    tracker = LineTracker((360, 640), memory=3)
    first = [line.id for line in tracker.update([_line(100), _line(500)])]
    moved = tracker.update([_line(490), _line(110)])
    assert [line.id for line in moved] == first[::-1]
    tracker.update([_line(120)])
    back = tracker.update([_line(125), _line(485)])
    assert [line.id for line in back] == first
    for _ in range(5):
        tracker.update([])
    assert not {line.id for line in tracker.update([_line(125)])} & set(first)


def test_smoothing_calms_a_flickering_mask_and_keeps_a_still_one(rng: np.random.Generator) -> None:
    solid = np.zeros((60, 80), bool)
    solid[30:, 20:60] = True
    noisy = [solid ^ (rng.random(solid.shape) < 0.05) for _ in range(30)]
    smoother = MaskSmoother(0.7)
    calm = [smoother.update(mask) for mask in noisy]
    assert flicker(calm) < 0.2 * flicker(noisy)
    assert (calm[-1] == solid).mean() > 0.99
    assert flicker([solid, solid]) == 0.0
    steady = MaskSmoother(0.0)
    np.testing.assert_array_equal(steady.update(noisy[0]), noisy[0])
    np.testing.assert_array_equal(steady.update(noisy[1]), noisy[1])


def test_smoothing_follows_a_lasting_change_and_a_new_size() -> None:
    smoother = MaskSmoother(0.6)
    smoother.update(np.zeros((10, 10), bool))
    on = np.ones((10, 10), bool)
    answers = [bool(smoother.update(on).all()) for _ in range(4)]
    assert answers == [False, False, False, True]
    assert smoother.update(np.ones((5, 5), bool)).shape == (5, 5)
    with pytest.raises(ConfigError, match="below 1"):
        MaskSmoother(1.0)


@pytest.mark.parametrize("strength", [0.01, 0.1, 0.3, 0.5])
def test_a_flash_of_one_frame_is_off_at_any_strength(strength: float) -> None:
    smoother = MaskSmoother(strength)
    on, off = np.ones((2, 2), np.bool_), np.zeros((2, 2), np.bool_)
    assert not any(smoother.update(mask).any() for mask in (off, on, off, off))


def test_more_smoothing_leaves_less_flicker(rng: np.random.Generator) -> None:
    noisy = [rng.random((60, 80)) < 0.8 for _ in range(40)]
    left = []
    for strength in (0.0, 0.1, 0.3, 0.5, 0.7, 0.9):
        smoother = MaskSmoother(strength)
        left.append(flicker([smoother.update(mask) for mask in noisy]))
    assert all(more < 0.9 * less for less, more in itertools.pairwise(left)), left


@pytest.mark.parametrize(("strength", "frames"), [(0.0, 0), (0.1, 1), (0.4, 1), (0.5, 2), (0.7, 4), (0.9, 13)])
def test_a_moving_edge_lags_by_as_many_frames_as_is_said(strength: float, frames: int) -> None:
    grows, shrinks = MaskSmoother(strength), MaskSmoother(strength)
    columns = np.arange(100)[None]
    for frame in range(40):
        grown, shrunk = grows.update(columns < 10 + frame), shrinks.update(columns < 90 - frame)
    assert (int(grown.sum()), int(shrunk.sum())) == (49 - frames, 51 + frames)


def test_masks_may_lie_column_by_column(rng: np.random.Generator) -> None:
    rows, columns = MaskSmoother(0.7), MaskSmoother(0.7)
    for mask in rng.random((4, 6, 5)) > 0.5:
        np.testing.assert_array_equal(columns.update(np.asfortranarray(mask)), rows.update(mask))


def test_steady_leaves_absent_tasks_absent() -> None:
    perception = Steady(smoothing=0.5)(Perception((4, 6)))
    assert perception.boxes is None
    assert perception.drivable is None


def test_flicker_is_a_share_of_the_mask_before() -> None:
    full, half = np.ones((4, 4), np.bool_), np.eye(4, dtype=np.bool_)
    assert flicker([full, half]) == 12 / 16
    assert flicker([half, full, full]) == 12 / 20


def test_two_lines_never_share_an_identity() -> None:
    tracker = LineTracker((360, 640))
    (first,) = tracker.update([_line(100)])
    both = tracker.update([_line(110), _line(96)])  # the second is the nearer
    assert both[1].id == first.id
    assert both[0].id != first.id


def test_frames_without_time_stamps_are_a_thirtieth_of_a_second_apart() -> None:
    pytest.importorskip("edgefirst.tracker")
    steady = Steady(track=True)
    seen = [*[boxes(100.0)] * 8, *[Boxes.empty()] * 60, *[boxes(100.0)] * 8]  # gone for two seconds
    numbers = []
    for found in seen:
        tracked = steady(Perception((360, 640), boxes=found)).boxes
        assert tracked is not None
        assert tracked.track_id is not None
        numbers.append(tracked.track_id.tolist())
    assert numbers[7] != [-1]
    assert numbers[-1] != [-1]
    assert numbers[7] != numbers[-1]
