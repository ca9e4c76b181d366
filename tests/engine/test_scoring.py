from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from trilitenet.data.sample import Sample
from trilitenet.engine.scoring import CanvasPrediction, FairMetrics, PaperMetrics
from trilitenet.errors import ShapeError
from trilitenet.processing.letterbox import Letterbox
from trilitenet.structures import Boxes, Perception


def mask(text: str) -> np.ndarray:
    """``"110 000"`` is two rows of three."""
    return np.array([[int(value) for value in row] for row in text.split()], np.uint8)


def boxes(*rows: tuple[float, ...]) -> Boxes:
    """Rows of left, top, right, bottom, score."""
    table = np.array(rows, np.float32).reshape(-1, 5)
    return Boxes(table[:, :4], table[:, 4], np.zeros(len(table), np.int64))


def truth(*rows: tuple[float, ...]) -> np.ndarray:
    return np.array(rows, np.float32).reshape(-1, 4)


def sample(name: str, drivable: str | None, lane: str, objects: np.ndarray | None, ignored: np.ndarray) -> Sample:
    return Sample(
        name=name,
        image=np.zeros((*mask(lane).shape, 3), np.uint8),
        boxes=objects,
        class_id=None if objects is None else np.zeros(len(objects), np.int64),
        ignored=ignored,
        drivable=None if drivable is None else mask(drivable),
        lane=mask(lane),
    )


# Six images of different sizes: c is empty, b, c and d have no lanes, e has neither drivable area nor boxes labelled.
SIX: list[tuple[Sample, str, str, Boxes]] = [
    (
        sample("a", "1110 0000", "0001 0010", truth((0, 0, 10, 10), (20, 0, 30, 10)), truth((50, 0, 60, 10))),
        "1100 1000",
        "0001 0001",
        boxes((0, 0, 10, 10, 0.9), (0, 0, 10, 9, 0.8), (50, 0, 60, 10, 0.7)),
    ),
    (sample("b", "11", "00", truth(), truth()), "10", "01", boxes((3, 3, 9, 9, 0.6))),
    (sample("c", "00 00", "00 00", truth(), truth()), "00 00", "00 00", boxes()),
    (sample("d", "1000", "0000", truth((0, 0, 4, 10)), truth()), "1100", "0000", boxes((0, 0, 4, 5, 0.5))),
    (sample("e", None, "100", None, truth()), "111", "100", boxes((0, 0, 5, 5, 0.95))),
    (sample("f", "110", "001", truth((0, 0, 10, 10)), truth()), "111", "000", boxes((0, 0, 10, 8, 0.4))),
]


def paper_on_six() -> PaperMetrics:
    metrics = PaperMetrics(1, ("detection", "drivable", "lane"), batch_size=2)
    for one, drivable, lane, predicted in SIX:
        # Canvas pixels are image pixels here, so that no mask is resized.
        size = mask(lane).shape
        letterbox = Letterbox.fit((size[0], size[1]), long_side=max(size))
        metrics.update(one, CanvasPrediction(predicted, mask(drivable) > 0, mask(lane) > 0, letterbox))
    return metrics


def test_the_paper_protocol_by_hand_drivable() -> None:
    # Pixels, TP FP FN TN:  a 2 1 1 4,  b 1 0 1 0,  c 0 0 0 4,  d 1 1 0 2,  e not labelled,  f 2 1 0 0
    # Batches of two:       ab 3 1 2 4 (2 images),  cd 1 1 0 6 (2 images),  ef 2 1 0 0 (1 image counts)
    scores = paper_on_six().compute().drivable
    assert scores is not None
    assert (scores.images, scores.not_labelled) == (5, 1)
    #   IoU 3/6, 1/2, 2/3; IoU of background 4/7, 6/7, 0/1
    assert scores.iou == pytest.approx((2 * 3 / 6 + 2 * 1 / 2 + 2 / 3) / 5)
    assert scores.miou == pytest.approx((2 * (3 / 6 + 4 / 7) / 2 + 2 * (1 / 2 + 6 / 7) / 2 + (2 / 3 + 0) / 2) / 5)
    #   sensitivity 3/5, 1/1, 2/2; specificity 4/5, 6/7, 0/1
    assert scores.recall == pytest.approx((2 * 3 / 5 + 2 * 1 + 1) / 5)
    assert scores.acc == pytest.approx((2 * (3 / 5 + 4 / 5) / 2 + 2 * (1 + 6 / 7) / 2 + (1 + 0) / 2) / 5)
    #   the data set: 6 3 2 10
    assert scores.dataset_iou == pytest.approx(6 / 11)
    assert scores.dataset_miou == pytest.approx((6 / 11 + 10 / 15) / 2)
    assert scores.dataset_acc == pytest.approx((6 / 8 + 10 / 13) / 2)
    assert scores.dataset_recall == pytest.approx(6 / 8)


def test_the_paper_protocol_by_hand_lane() -> None:
    # Pixels, TP FP FN TN:  a 1 1 1 5,  b 0 1 0 1,  c 0 0 0 4,  d 0 0 0 4,  e 1 0 0 2,  f 0 0 1 2
    # Batches of two:       ab 1 2 1 6,  cd 0 0 0 8 (IoU and sensitivity 0/0 count as 0),  ef 1 0 1 4
    scores = paper_on_six().compute().lane
    assert scores is not None
    assert scores.iou == pytest.approx((1 / 4 + 0 + 1 / 2) / 3)
    assert scores.miou == pytest.approx(((1 / 4 + 6 / 9) / 2 + (0 + 1) / 2 + (1 / 2 + 4 / 5) / 2) / 3)
    assert scores.recall == pytest.approx((1 / 2 + 0 + 1 / 2) / 3)
    assert scores.acc == pytest.approx(((1 / 2 + 6 / 8) / 2 + (0 + 1) / 2 + (1 / 2 + 1) / 2) / 3)
    #   the data set: 2 2 2 18
    assert scores.dataset_iou == pytest.approx(2 / 6)
    assert scores.dataset_miou == pytest.approx((2 / 6 + 18 / 22) / 2)
    assert scores.dataset_acc == pytest.approx((2 / 4 + 18 / 20) / 2)
    assert scores.dataset_recall == pytest.approx(2 / 4)


def test_the_paper_protocol_by_hand_detection() -> None:
    # Objects: a 3 (the ignored region is an object here), d 1, f 1 = 5; e is not labelled.
    #   0.9 right (IoU 1)          0.8 wrong: its best object is taken      0.7 right: the ignored region
    #   0.6 wrong                  0.5 wrong: IoU 0.5 is not above 0.5      0.4 right to IoU 0.75 (0.8 is not above 0.8)
    scores = paper_on_six().compute().detection
    assert scores is not None
    assert (scores.images, scores.not_labelled, scores.objects, scores.boxes) == (5, 1, 5, 6)
    assert scores.recall == pytest.approx(3 / 5)
    assert scores.precision == pytest.approx(3 / 6)
    # Recall 1/5 1/5 2/5 2/5 2/5 3/5, precision 1 1/2 2/3 1/2 2/5 1/2. The envelope at recall 0, 0.01, ... is 1 at 20
    # points (0 to 0.19), 2/3 at 20 (0.20 to 0.39), 1/2 at 21 (0.40 to 0.60), 0 at 40. Trapezoid: the two ends by half.
    ap_with = 0.01 * (20 * 1 + 20 * 2 / 3 + 21 / 2 - 1 / 2)
    assert scores.map50 == pytest.approx(ap_with)
    # At IoU 0.80 to 0.95 the last box is wrong: recall ends at 2/5 with precision 2/6, at one point (0.40).
    ap_without = 0.01 * (20 * 1 + 20 * 2 / 3 + 2 / 6 - 1 / 2)
    assert scores.map == pytest.approx((6 * ap_with + 4 * ap_without) / 10)


def fair_on_six() -> FairMetrics:
    metrics = FairMetrics(("vehicle",), ("detection", "drivable", "lane"), confidence=0.55)
    for one, drivable, lane, predicted in SIX:
        height, width = mask(lane).shape
        metrics.update(
            one, Perception((height, width), boxes=predicted, drivable=mask(drivable) > 0, lane=mask(lane) > 0)
        )
    return metrics


def test_the_fair_protocol_by_hand() -> None:
    scores = fair_on_six().compute()
    assert scores.drivable is not None
    assert scores.lane is not None
    assert scores.detection is not None
    # Drivable, c left out (empty on both sides), e not labelled: 6 3 2 6 pixels.
    drivable = scores.drivable
    assert (drivable.images, drivable.both_empty, drivable.not_labelled) == (4, 1, 1)
    assert drivable.iou == pytest.approx(6 / 11)
    assert drivable.miou == pytest.approx((6 / 11 + 6 / 11) / 2)
    assert drivable.image_iou == pytest.approx((2 / 4 + 1 / 2 + 1 / 2 + 2 / 3) / 4)
    # Lane, c and d left out: 2 2 2 10 pixels.
    lane = scores.lane.as_labelled
    assert (lane.images, lane.both_empty, lane.not_labelled) == (4, 2, 0)
    assert lane.iou == pytest.approx(2 / 6)
    assert lane.balanced_accuracy == pytest.approx((2 / 4 + 10 / 12) / 2)
    # Within 2 px: of 4 predicted pixels those of a and e, of 4 true ones likewise.
    assert scores.lane.precision == pytest.approx(3 / 4)
    assert scores.lane.recall == pytest.approx(3 / 4)
    # Detection: 4 objects; 0.9 right, 0.8 wrong, 0.7 ignored, 0.6 wrong, 0.5 right (IoU 0.5 reaches 0.5), 0.4 right.
    # Precision after each hit 1, 2/4, 3/5; the envelope is 1 up to recall 1/4 (26 points), 3/5 up to 3/4 (50 points).
    detection = scores.detection
    assert (detection.images, detection.both_empty, detection.not_labelled, detection.objects) == (4, 1, 1, 4)
    assert detection.ap50 == pytest.approx((26 * 1 + 50 * 3 / 5) / 101)
    # Above 0.55: one right of three that count (0.9, 0.8, 0.6).
    assert detection.at.precision == pytest.approx(1 / 3)
    assert detection.at.recall == pytest.approx(1 / 4)
    assert detection.at.f1 == pytest.approx(2 / (3 + 4))


def test_the_outcome_of_an_image() -> None:
    metrics = FairMetrics(("vehicle",), ("detection", "drivable", "lane"), confidence=0.25)
    one, drivable, lane, predicted = SIX[0]
    outcome = metrics.update(one, Perception((2, 4), boxes=predicted, drivable=mask(drivable) > 0, lane=mask(lane) > 0))
    assert (outcome.right, outcome.wrong, outcome.missed) == (1, 1, 1)
    assert outcome.detection == pytest.approx(2 / 4)
    assert outcome.drivable == pytest.approx(2 / 4)
    assert outcome.lane == 1.0


@pytest.mark.parametrize("build", [paper_on_six, fair_on_six])
def test_states_survive_json(build: Any) -> None:
    metrics = build()
    again = type(metrics).from_state(json.loads(json.dumps(metrics.state())))
    assert str(again.compute()) == str(metrics.compute())
    weights = np.array([[1, 2, 0, 1, 1, 1]])
    for name, value in metrics.figures(weights).items():
        np.testing.assert_array_equal(value, again.figures(weights)[name])


def test_a_prediction_of_another_size_is_refused() -> None:
    with pytest.raises(ShapeError, match="a: prediction for"):
        fair_on_six().update(SIX[0][0], Perception((3, 3)))


def test_tasks_that_are_not_asked_for_are_not_scored() -> None:
    metrics = FairMetrics(("vehicle",), ("lane",))
    one, _, lane, _ = SIX[0]
    metrics.update(one, Perception((2, 4), lane=mask(lane) > 0))
    scores = metrics.compute()
    assert scores.detection is None
    assert scores.drivable is None
    assert all(name.startswith("lane/") for name in metrics.figures())


def test_a_mask_that_ignores_pixels_leaves_the_other_alone() -> None:
    image = np.zeros((2, 3, 3), np.uint8)
    ignored = mask("110 000") == 0
    labelled = Sample("a", image, drivable=mask("001 000"), lane=mask("100 000"), drivable_valid=ignored)
    metrics = FairMetrics(("vehicle",), ("drivable", "lane"))
    metrics.update(
        labelled, Perception((2, 3), ("vehicle",), None, mask("111 000").astype(bool), mask("000 000").astype(bool))
    )
    scores = metrics.compute()
    assert scores.drivable is not None
    assert scores.lane is not None
    assert scores.drivable.iou == 1
    assert scores.lane.as_labelled.iou == 0


def test_boxes_on_the_own_car_are_not_wrong() -> None:
    valid = np.ones((40, 40), np.bool_)
    valid[30:] = False
    labelled = Sample("a", np.zeros((40, 40, 3), np.uint8), truth((0, 0, 10, 10)), np.zeros(1, np.int64), valid=valid)
    found = boxes((0, 0, 10, 10, 0.6), (5, 26, 35, 40, 0.9), (5, 12, 35, 40, 0.8))
    metrics = FairMetrics(("vehicle",), ("detection",))
    outcome = metrics.update(labelled, Perception((40, 40), ("vehicle",), found, None, None))
    assert (outcome.right, outcome.wrong, outcome.missed) == (1, 1, 0)  # 10 of 14 and 10 of 28 rows on the bonnet
