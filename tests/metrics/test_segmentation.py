from __future__ import annotations

import json

import numpy as np
import pytest

from trilitenet.errors import ShapeError
from trilitenet.metrics.segmentation import SegmentationMetric, as_binary, confusion


def test_every_ratio_by_hand() -> None:
    # One confusion matrix over two images of different sizes.
    #   2 x 2: prediction 1 1 / 0 0, truth 1 0 / 1 0 -> TP 1, FP 1, FN 1, TN 1
    #   1 x 4: prediction 1 1 1 0,   truth 1 1 1 0   -> TP 3, FP 0, FN 0, TN 1
    # Together TP 4, FP 1, FN 1, TN 2.
    metric = SegmentationMetric()
    assert metric.update(np.array([[1, 1], [0, 0]], np.uint8), np.array([[1, 0], [1, 0]], np.uint8)) == (1, 1, 1, 1)
    metric.update(np.array([[1, 1, 1, 0]], np.bool_), np.array([[9, 9, 9, 0]], np.uint8))
    scores = metric.compute()
    assert scores.iou == pytest.approx(4 / 6)
    assert scores.miou == pytest.approx((4 / 6 + 2 / 4) / 2)
    assert scores.precision == pytest.approx(4 / 5)
    assert scores.recall == pytest.approx(4 / 5)
    assert scores.f1 == pytest.approx(8 / 10)
    assert scores.balanced_accuracy == pytest.approx((4 / 5 + 2 / 3) / 2)
    assert scores.image_iou == pytest.approx((1 / 3 + 1) / 2)
    assert (scores.true_positive, scores.false_positive, scores.false_negative, scores.true_negative) == (4, 1, 1, 2)


def test_images_empty_on_both_sides_or_unlabelled_are_left_out_and_counted() -> None:
    metric = SegmentationMetric()
    empty = np.zeros((4, 4), np.uint8)
    metric.update(np.eye(4, dtype=np.uint8), np.eye(4, dtype=np.uint8))
    before = metric.compute()
    assert metric.update(empty, empty) == (0, 0, 0, 16)
    assert metric.update(np.ones((4, 4), np.uint8), None) is None
    after = metric.compute()
    assert (after.miou, after.iou) == (before.miou, before.iou) == (1.0, 1.0)
    assert (after.images, after.both_empty, after.not_labelled) == (1, 1, 1)


def test_no_evidence_is_nan() -> None:
    scores = SegmentationMetric().compute()
    assert np.isnan([scores.iou, scores.miou, scores.f1, scores.image_iou]).all()


def test_invalid_pixels_do_not_count() -> None:
    prediction = np.array([[1, 1, 0, 0]], np.uint8)
    truth = np.array([[1, 0, 1, 0]], np.uint8)
    metric = SegmentationMetric()
    assert metric.update(prediction, truth, np.array([[True, False, True, True]])) == (1, 0, 1, 1)


def test_weights_are_repetitions(rng: np.random.Generator) -> None:
    masks = [(rng.random((6, 7)) < 0.5, rng.random((6, 7)) < 0.4) for _ in range(5)]
    metric, repeated = SegmentationMetric(), SegmentationMetric()
    weights = np.array([0, 2, 1, 3, 0])
    for (prediction, truth), count in zip(masks, weights, strict=True):
        metric.update(prediction, truth)
        for _ in range(count):
            repeated.update(prediction, truth)
    for name, value in metric.figures(weights[None]).items():
        assert value[0] == pytest.approx(repeated.figures()[name][0])


def test_the_state_survives_json(rng: np.random.Generator) -> None:
    metric = SegmentationMetric()
    for _ in range(100):
        metric.update(rng.random((3, 3)) < 0.5, rng.random((3, 3)) < 0.5)
    metric.update(None, None)
    again = SegmentationMetric.from_state(json.loads(json.dumps(metric.state())))
    assert again.compute() == metric.compute()


def test_masks_of_different_sizes_are_refused() -> None:
    with pytest.raises(ShapeError, match="against"):
        confusion(np.zeros((2, 2), np.uint8), np.zeros((2, 3), np.uint8))


def test_as_binary_takes_bool_and_any_grey_level() -> None:
    assert as_binary(np.array([[0, 1, 255]], np.uint8)).tolist() == [[0, 1, 1]]
    assert as_binary(np.array([[False, True]])).tolist() == [[0, 1]]
    assert as_binary(np.array([[True, True]]), np.array([[True, False]])).tolist() == [[1, 0]]


def test_other_types_are_refused_not_cast() -> None:
    truth = np.ones((4, 4), np.bool_)
    for mask in (np.full((4, 4), 0.9), np.full((4, 4), 256)):
        with pytest.raises(ShapeError, match="bool or uint8"):
            SegmentationMetric().update(mask, truth)
    for valid in (np.full((4, 4), 255, np.uint8), np.ones((2, 2), np.bool_)):
        with pytest.raises(ShapeError, match="valid must be"):
            SegmentationMetric().update(truth, truth, valid)  # type: ignore[arg-type]


def test_masks_of_a_batch_are_refused() -> None:
    masks = np.ones((1, 4, 4), np.bool_)
    with pytest.raises(ShapeError, match=r"must be \(H, W\)"):
        SegmentationMetric().update(masks, masks)
