from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from trilitenet.deploy.parity import TOLERANCES, Parity, Tolerance, compare
from trilitenet.structures import RawOutputs

STRICT = Tolerance(pixels=0.999, overlap=0.98, boxes=0.99, confidence=0.02)
CANVAS = np.zeros((32, 64, 3), np.uint8)


def outputs() -> RawOutputs:
    lane = np.zeros((1, 32, 64), np.uint8)
    lane[:, 10:20] = 200
    row = [20, 15, 16, 10, 0.9, 0.9]
    return RawOutputs(np.array([[row, [50, 15, 8, 8, 0.1, 0.5]]], np.float32), None, lane)


def parity_of(changed: RawOutputs) -> list[str]:
    return compare(lambda _: outputs(), lambda _: changed, [CANVAS], STRICT).failures


def test_equal_outputs_pass() -> None:
    assert parity_of(outputs()) == []


def test_a_moved_box_fails_from_either_side() -> None:
    moved = outputs()
    assert moved.detection is not None
    moved.detection[0, 0, 0] += 8
    assert "boxes agree" in parity_of(moved)[0]
    ghost = outputs()
    assert ghost.detection is not None
    ghost.detection[0, 1, 4:] = 0.9
    assert "boxes agree" in parity_of(ghost)[0]


def test_another_confidence_fails_though_the_box_is_the_same() -> None:
    surer = outputs()
    assert surer.detection is not None
    surer.detection[0, 0, 4] = 0.95
    assert "boxes agree" in parity_of(surer)[0]


@pytest.mark.parametrize("confidence", [0.9, 0.999])
def test_boxes_below_the_threshold_are_compared_if_none_is_above(confidence: float) -> None:
    def failures(changed: RawOutputs) -> list[str]:
        return compare(lambda _: outputs(), lambda _: changed, [CANVAS], STRICT, confidence=confidence).failures

    assert failures(outputs()) == []
    moved = outputs()
    assert moved.detection is not None
    moved.detection[0, 0, 0] += 8
    assert "boxes agree" in failures(moved)[0]


def test_nothing_to_compare_fails_or_is_told() -> None:
    nothing = np.zeros((1, 2, 6), np.float32)
    boxes, both = RawOutputs(nothing, None, None), RawOutputs(nothing, None, outputs().lane)
    (failure,) = compare(lambda _: boxes, lambda _: boxes, [CANVAS], STRICT).failures
    assert failure == "there was no box to compare; give --frames with vehicles, or leave --nms out"
    parity = compare(lambda _: both, lambda _: both, [CANVAS], STRICT)
    assert parity.failures == []
    assert "no box to compare" in parity.summary()


def test_other_pixels_fail() -> None:
    other = outputs()
    assert other.lane is not None
    other.lane[:, :2] = 255
    assert "mask pixels agree" in parity_of(other)[0]


def test_another_class_fails_though_the_box_is_the_same() -> None:
    rows = np.array([[[20, 15, 16, 10, 0.9, 0.9, 0.1]]], np.float32)
    swapped = rows[..., [0, 1, 2, 3, 4, 6, 5]]

    def failures(changed: np.ndarray) -> list[str]:
        one, other = RawOutputs(rows, None, None), RawOutputs(changed, None, None)
        return compare(lambda _: one, lambda _: other, [CANVAS], STRICT).failures

    assert failures(rows) == []
    assert "boxes agree" in failures(swapped)[0]


def test_the_worse_of_the_two_masks_decides() -> None:
    same = np.zeros((1, 32, 64), np.uint8)
    other = same.copy()
    other[:, :2] = 255
    one, changed = RawOutputs(None, same, same), RawOutputs(None, same, other)
    found = compare(lambda _: one, lambda _: changed, [CANVAS], STRICT)
    assert found.pixels == 30 / 32
    assert "mask pixels agree" in found.failures[0]


def test_a_box_at_the_very_threshold_is_looked_for_on_both_sides_of_it() -> None:
    above, below = (
        RawOutputs(np.array([[[20, 15, 16, 10, score, 1.0]]], np.float32), None, None) for score in (0.31, 0.24)
    )
    loose = Tolerance(pixels=0.999, overlap=0.98, boxes=0.99, confidence=0.1)
    found = compare(lambda _: above, lambda _: below, [CANVAS], loose, confidence=0.25)
    assert found.boxes == 1.0


def test_masks_are_compared_at_their_thresholds() -> None:
    one, other = (RawOutputs(None, None, np.full((1, 32, 64), level, np.uint8)) for level in (240, 200))
    for threshold, pixels in ((0.5, 1.0), (0.9, 0.0)):
        found = compare(lambda _: one, lambda _: other, [CANVAS], STRICT, masks=(0.5, threshold))
        assert found.pixels == pixels


def test_a_speck_must_be_at_its_place_to_half_a_pixel() -> None:
    specks = [
        RawOutputs(np.array([[[left, 15, 1, 1, 0.9, 0.9]]], np.float32), None, None) for left in (20.0, 20.25, 22.0)
    ]
    shares = [compare(lambda _: specks[0], lambda _, one=one: one, [CANVAS], STRICT).boxes for one in specks]  # type: ignore[misc]
    assert shares == [1.0, 1.0, 0.0]


def of_boxes(*rows: tuple[float, ...]) -> RawOutputs:
    """Boxes as (centre x, centre y, width, height, objectness), surely of the one class."""
    return RawOutputs(np.array([[[*row, 1.0] for row in rows]], np.float32), None, None)


def compared(one: RawOutputs, other: RawOutputs, confidence: float = 0.25) -> Parity:
    return compare(lambda _: one, lambda _: other, [CANVAS], STRICT, confidence=confidence)


def test_a_box_must_overlap_by_nine_tenths() -> None:
    box = of_boxes((30, 15, 16, 10, 0.9))
    assert compared(box, of_boxes((30.8, 15, 16, 10, 0.9))).boxes == 1.0  # IoU 15.2 / 16.8 = 0.905
    assert compared(box, of_boxes((31, 15, 16, 10, 0.9))).boxes == 0.0  # IoU 15 / 17 = 0.882


def test_every_side_of_a_speck_counts() -> None:
    wider = of_boxes((20.4, 15, 1.8, 1, 0.9))  # of its sides only the right one is elsewhere, by 0.8 pixels
    assert compared(of_boxes((20, 15, 1, 1, 0.9)), wider).boxes == 0.0


def test_how_far_sides_are_apart_is_of_the_pairs() -> None:
    one = of_boxes((20, 15, 0.2, 0.2, 0.9), (50, 15, 0.2, 0.2, 0.9))
    found = compared(one, of_boxes((20, 15, 0.2, 0.2, 0.9), (50.25, 15, 0.2, 0.2, 0.9)))
    assert found.boxes == 1.0
    assert found.box_error == pytest.approx(0.0625)  # of four sides left and right are 0.25 apart, of every other pair


def test_boxes_without_a_pair_are_told() -> None:
    found = compared(of_boxes((20, 15, 16, 10, 0.9)), of_boxes((40, 15, 16, 10, 0.9)))
    assert found.summary() == "parity: 1 frames, boxes in both 0.0000 (sides 0.00 px apart)"


def test_the_less_confident_boxes_are_looked_for_too() -> None:
    boxes = [(10 * i, 15, 8, 10, 0.9 - i / 100) for i in range(1, 6)]
    found = compared(of_boxes(*boxes), of_boxes(*boxes[:4], (55, 15, 8, 10, 0.85)))
    assert found.boxes == 8 / 10


def test_boxes_barely_above_the_threshold_are_compared() -> None:
    barely = of_boxes((20, 15, 16, 10, 0.27))
    assert compared(barely, barely, confidence=0.25).boxes == 1.0


def test_boxes_at_half_of_the_best_are_left_to_rounding() -> None:
    best = (20, 15, 16, 10, 0.2)
    found = compared(of_boxes(best, (50, 15, 8, 8, 0.101)), of_boxes(best, (50, 15, 8, 8, 0.099)), confidence=0.25)
    assert found.boxes == 1.0


def test_boxes_that_are_no_numbers_fail() -> None:
    broken = of_boxes((float("nan"),) * 5)
    assert compared(of_boxes((20, 15, 16, 10, 0.9)), broken).boxes == 0.0


def test_what_is_just_within_the_tolerance_passes() -> None:
    just = Parity(1, 0.999, 0.98, 0.99, 0.0, STRICT, detection=True)
    assert just.failures == []
    assert len(Parity(1, 0.9989, 0.9799, 0.9899, 0.0, STRICT, detection=True).failures) == 3


def of_lane(lane: NDArray[np.bool_]) -> RawOutputs:
    return RawOutputs(None, None, (255 * lane[None]).astype(np.uint8))


@pytest.mark.parametrize("precision", TOLERANCES)
@pytest.mark.parametrize(
    "change",
    [
        pytest.param(np.zeros_like, id="empty"),
        pytest.param(lambda lane: lane[:, ::-1], id="mirrored"),
        pytest.param(lambda lane: np.roll(lane, 8, 1), id="shifted"),
    ],
)
def test_a_wrong_lane_mask_is_refused_at_every_precision(
    precision: str, change: Callable[[NDArray[np.bool_]], NDArray[np.bool_]]
) -> None:
    lane = np.zeros((384, 640), bool)
    lane[100:, 200:208] = True  # of 1% of the pixels: the others agree
    right, wrong = of_lane(lane), of_lane(change(lane))
    parity = compare(lambda _: right, lambda _: wrong, [CANVAS], TOLERANCES[precision])
    assert any("masks overlap with an IoU of 0.0000" in failure for failure in parity.failures)
    parity = compare(lambda _: right, lambda _: right, [CANVAS], TOLERANCES[precision])
    assert (parity.overlap, parity.failures) == (1.0, [])
    assert parity.summary() == "parity: 1 frames, mask pixels equal 1.000000, IoU of masks 1.0000"


def test_masks_overlap_over_all_frames_together() -> None:
    lane = np.zeros((32, 64), bool)
    lane[:, :10] = True
    few = np.arange(64) < 2
    expected, got = (iter(map(of_lane, masks)) for masks in ((lane, few[None]), (np.roll(lane, 1, 1), ~few[None])))
    parity = compare(lambda _: next(expected), lambda _: next(got), [CANVAS] * 2, STRICT)
    assert parity.overlap == (32 * 9) / (32 * 11 + 64)


def test_masks_of_next_to_no_foreground_are_not_compared_by_overlap() -> None:
    lane = np.zeros((384, 640), bool)
    empty = of_lane(np.zeros_like(lane))
    for size, overlap in ((299, None), (300, 0.0)):
        lane[0, :size] = True
        found = compare(lambda _: of_lane(lane), lambda _: empty, [CANVAS], STRICT)
        assert found.overlap == overlap
