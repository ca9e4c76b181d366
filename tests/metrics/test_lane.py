from __future__ import annotations

import json
import math

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from trilitenet.errors import ConfigError, ShapeError
from trilitenet.metrics.lane import LaneMetric, LaneScores, boundary, draw_at_width, thin


def lines(seed: int, width: int, size: tuple[int, int] = (90, 120)) -> np.ndarray:
    rng = np.random.default_rng(seed)
    mask = np.zeros(size, np.uint8)
    for _ in range(3):
        ends = rng.integers(0, (size[1], size[0]), (2, 2))
        cv2.line(mask, ends[0].tolist(), ends[1].tolist(), 1, width)
    return mask


def brute_boundary(mask: np.ndarray) -> list[tuple[int, int]]:
    """Mask pixels with a 4-neighbour inside the image and outside the mask."""
    height, width = mask.shape
    found = []
    for y, x in np.argwhere(mask):
        for dy, dx in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            if 0 <= y + dy < height and 0 <= x + dx < width and not mask[y + dy, x + dx]:
                found.append((int(y), int(x)))
                break
    return found


def brute_near(points: np.ndarray, others: np.ndarray, tolerance: float) -> int:
    """How many points have another one within the tolerance, by every distance."""
    if not len(points) or not len(others):
        return 0
    distance = np.sqrt(((points[:, None, :].astype(float) - others[None, :, :]) ** 2).sum(axis=2))
    return int((distance.min(axis=1) <= tolerance).sum())


def brute_f(prediction: np.ndarray, truth: np.ndarray, tolerance: float) -> float:
    first, second = np.array(brute_boundary(prediction)), np.array(brute_boundary(truth))
    precision = brute_near(first, second, tolerance) / len(first)
    recall = brute_near(second, first, tolerance) / len(second)
    return 2 * precision * recall / (precision + recall)


@pytest.mark.parametrize("seed", range(5))
def test_boundary_f_is_that_of_every_distance(seed: int) -> None:
    prediction, truth = lines(seed, 5), lines(seed, 2)
    prediction = np.roll(prediction, (2, 1), axis=(0, 1))
    metric = LaneMetric()
    metric.update(prediction, truth)
    for tolerance, value in metric.compute().boundary_f.items():
        assert value == pytest.approx(brute_f(prediction, truth, tolerance), abs=1e-12)


def test_tolerant_precision_and_recall_are_those_of_every_distance() -> None:
    prediction, truth = np.roll(lines(3, 4), 3, axis=1), lines(3, 3)
    metric = LaneMetric()
    metric.update(prediction, truth)
    scores = metric.compute()
    predicted, true = np.argwhere(prediction), np.argwhere(truth)
    precision = brute_near(predicted, true, 2) / len(predicted)
    recall = brute_near(true, predicted, 2) / len(true)
    assert scores.precision == pytest.approx(precision)
    assert scores.recall == pytest.approx(recall)
    assert scores.f1 == pytest.approx(2 * precision * recall / (precision + recall))
    assert 0 < recall < 1


def test_scores_over_two_images_are_pooled() -> None:
    metric = LaneMetric(widths=(), tolerances=(1,))
    first, second = (lines(0, 3), lines(1, 3)), (lines(2, 3), lines(2, 2))
    for pair in (first, second):
        metric.update(*pair)
    sums = np.zeros(4)
    for prediction, truth in (first, second):
        a, b = np.array(brute_boundary(prediction)), np.array(brute_boundary(truth))
        sums += [len(a), brute_near(a, b, 1), len(b), brute_near(b, a, 1)]
    precision, recall = sums[1] / sums[0], sums[3] / sums[2]
    assert metric.compute().boundary_f[1] == pytest.approx(2 * precision * recall / (precision + recall))


@pytest.mark.parametrize("slope", [0.0, 0.3, 0.7, 2.6])
def test_a_perfect_line_8_px_wide_against_truth_2_px_wide_scores_what_geometry_says(slope: float) -> None:
    """Docs: 'Why a perfect lane model scores 0.25'."""
    middle = np.arange(400) - 200
    across = np.abs(middle[:, None] + 0.4 - slope * middle[None, :]) / math.hypot(1, slope)
    truth, prediction = across < 1, across < 4  # 2 and 8 pixels across, whatever the slope
    metric = LaneMetric()
    metric.update(prediction, truth)
    scores = metric.compute()
    # The areas are as 2 to 8: intersection 2, union 8.
    assert scores.as_labelled.iou == pytest.approx(2 / 8, abs=0.02)
    assert scores.as_labelled.recall == 1.0
    assert scores.as_labelled.precision == pytest.approx(2 / 8, abs=0.02)
    # Of the 8 pixels across, 2 are true and 2 on either side lie within 2 px of them.
    if slope == 0:
        assert scores.precision == 6 / 8
    assert 0.5 < scores.precision < 0.8
    assert scores.recall == 1.0
    # The edges are 3 px apart: beyond a tolerance of 2 px, within one of 5 px.
    assert scores.boundary_f == {1: 0.0, 2: 0.0, 5: 1.0}
    # Drawn as wide as the prediction, the truth is matched but for the pixel grid; drawn 2 px wide it is as labelled.
    assert scores.iou_at_width[8] > 0.8
    assert scores.iou_at_width[2] == pytest.approx(scores.as_labelled.iou, abs=0.05)


def test_published_area_resizing_lifts_that_score_to_about_two_fifths() -> None:
    """At 640x360 the truth grows to about 2 px of 5: the figure that published.md states."""
    from trilitenet.processing.letterbox import Letterbox

    rows = np.arange(720)[:, None]
    columns = np.arange(1280)[None, :]
    truth = np.zeros((720, 1280), np.uint8)
    prediction = np.zeros((720, 1280), np.uint8)
    for slope in (-1.4, -0.6, 0.5, 1.2):
        across = np.abs(columns - 640 - slope * (rows - 300)) / math.hypot(1, slope)
        truth |= ((across < 1) & (rows > 330)).astype(np.uint8)
        prediction |= ((across < 4) & (rows > 330)).astype(np.uint8)
    letterbox = Letterbox.fit((720, 1280))
    small = [letterbox.mask(mask * np.uint8(255)) for mask in (prediction, truth)]
    metric = LaneMetric()
    metric.update(small[0], small[1])
    assert 0.35 < metric.compute().as_labelled.iou < 0.45


@pytest.mark.parametrize("width", [1, 2, 3, 5, 8])
def test_thinning_and_drawing_gives_the_line_back(width: int) -> None:
    mask = np.zeros((60, 80), np.uint8)
    mask[20 : 20 + width, 10:70] = 1
    inside = (slice(None), slice(20, 60))  # the ends shrink by half the width
    centre = thin(mask)
    assert centre.sum(axis=0).max() == 1  # one pixel wide
    assert (centre <= mask).all()
    assert (draw_at_width(centre, width)[inside] == mask[inside]).all()
    upright = draw_at_width(thin(np.ascontiguousarray(mask.T)), width).T
    assert (upright[inside] == mask[inside]).all()


def test_thinning_keeps_every_part_in_one_piece() -> None:
    for seed in range(5):
        mask = lines(seed, 7)
        assert cv2.connectedComponents(thin(mask))[0] == cv2.connectedComponents(mask)[0]
    slanted = np.eye(40, dtype=np.uint8) | np.eye(40, k=1, dtype=np.uint8)
    assert cv2.connectedComponents(thin(slanted))[0] == 2
    assert thin(slanted).sum() >= 38
    empty = np.zeros((5, 5), np.uint8)
    assert not thin(empty).any()


def test_boundary_by_hand() -> None:
    mask = np.zeros((5, 6), np.uint8)
    mask[1:4, 0:4] = 1  # touches the left edge, which is no boundary
    assert boundary(mask).tolist() == [
        [0, 0, 0, 0, 0, 0],
        [1, 1, 1, 1, 0, 0],
        [0, 0, 0, 1, 0, 0],
        [1, 1, 1, 1, 0, 0],
        [0, 0, 0, 0, 0, 0],
    ]


def test_a_line_wholly_missed_or_invented_scores_zero() -> None:
    line, nothing = lines(0, 2), np.zeros((90, 120), np.uint8)
    for pair in ((line, nothing), (nothing, line)):
        metric = LaneMetric()
        assert metric.update(*pair) == 0.0
        scores = metric.compute()
        assert (scores.as_labelled.iou, scores.f1, scores.boundary_f[2], scores.iou_at_width[8]) == (0, 0, 0, 0)


def test_drawing_wider_reaches_beyond_the_content() -> None:
    # The union of both masks is one column wide; drawn at 8 px the truth is wider than that.
    mask = np.zeros((40, 40), np.uint8)
    mask[5:35, 20] = 1
    metric = LaneMetric(widths=(8,))
    metric.update(mask, mask)
    assert metric.compute().iou_at_width[8] == pytest.approx(1 / 8, abs=0.04)


def test_unlabelled_and_empty_images_are_left_out() -> None:
    metric = LaneMetric()
    nothing = np.zeros((9, 9), np.uint8)
    metric.update(nothing, nothing)
    metric.update(nothing, None)
    scores = metric.compute()
    assert (scores.as_labelled.both_empty, scores.as_labelled.not_labelled, scores.as_labelled.images) == (1, 1, 0)
    assert np.isnan([scores.f1, scores.boundary_f[1], scores.iou_at_width[2]]).all()


def test_the_state_survives_json() -> None:
    metric = LaneMetric()
    for seed in range(4):
        metric.update(lines(seed, 4), lines(seed + 1, 2))
    again = LaneMetric.from_state(json.loads(json.dumps(metric.state())))
    assert again.compute() == metric.compute()
    weights = np.array([[1, 0, 2, 1], [0, 0, 0, 1]])
    for name, value in metric.figures(weights).items():
        np.testing.assert_array_equal(value, again.figures(weights)[name])


def test_impossible_widths_are_refused() -> None:
    with pytest.raises(ConfigError, match="widths"):
        LaneMetric(widths=(0,))


def test_lines_are_compared_whole_where_a_part_is_ignored() -> None:
    def scores(prediction: slice, truth: slice, valid: NDArray[np.bool_] | None) -> LaneScores:
        masks = np.zeros((2, 100, 100), np.bool_)
        masks[0, :, prediction] = masks[1, :, truth] = True
        metric = LaneMetric()
        metric.update(masks[0], masks[1], valid)
        return metric.compute()

    valid = np.ones((100, 100), np.bool_)
    assert scores(slice(37, 45), slice(40, 42), valid).boundary_f[1] == 0
    everything = scores(slice(37, 45), slice(40, 42), None)
    assert everything.iou_at_width[8] == 1
    for ignored in (np.s_[50:], np.s_[np.arange(100) // 10 % 2 == 1], np.s_[:, 41:]):
        valid = np.ones((100, 100), np.bool_)
        valid[ignored] = False
        cut = scores(slice(37, 45), slice(40, 42), valid)
        assert (cut.iou_at_width[8], cut.boundary_f[1]) == (1, 0)
    valid = np.ones((100, 100), np.bool_)
    valid[:, 50:] = False
    assert scores(slice(48, 50), slice(50, 52), valid).precision == 1


def test_pixels_that_count_are_a_mask_of_the_size() -> None:
    mask = np.ones((4, 4), np.bool_)
    for valid in (np.ones((4, 5), np.bool_), np.full((4, 4), 255, np.uint8)):
        with pytest.raises(ShapeError, match="valid must be"):
            LaneMetric().update(mask, mask, valid)  # type: ignore[arg-type]
