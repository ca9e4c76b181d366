from __future__ import annotations

import numpy as np
import pytest

from trilitenet.config import Thresholds
from trilitenet.errors import ShapeError
from trilitenet.processing.letterbox import Letterbox
from trilitenet.processing.postprocess import threshold_mask, to_perceptions
from trilitenet.structures import RawOutputs

LETTERBOX = Letterbox.fit((720, 1280))


def raw(detection: list[list[float]] | None = None) -> RawOutputs:
    drivable = np.zeros((1, 384, 640), np.uint8)
    drivable[0, 212:, :] = 255
    lane = np.zeros((1, 384, 640), np.uint8)
    lane[0, :, 320:324] = 255
    rows = np.array(detection or [[320, 192, 40, 20, 0.9, 1.0]], np.float32)
    return RawOutputs(rows[None], drivable, lane)


def test_results_are_in_pixels_of_the_source() -> None:
    (perception,) = to_perceptions(raw(), [LETTERBOX], Thresholds(), ("vehicle",), sources=["a.jpg"])
    assert perception.boxes is not None
    np.testing.assert_allclose(perception.boxes.xyxy, [[600, 340, 680, 380]])
    np.testing.assert_allclose(perception.boxes.confidence, [0.9])
    assert perception.drivable is not None
    assert perception.drivable.shape == (720, 1280)
    assert not perception.drivable[:399].any()
    assert perception.drivable[401:].all()
    assert perception.lane is not None
    assert perception.lane.any(axis=0).nonzero()[0].tolist() == list(range(640, 648))
    assert perception.source == "a.jpg"


def test_confidence_is_objectness_times_class_and_strict() -> None:
    rows = [[100, 100, 20, 20, 0.5, 0.4, 0.6], [300, 100, 20, 20, 0.5, 0.5, 0.1], [500, 100, 20, 20, np.nan, 1, 0]]
    (perception,) = to_perceptions(raw(rows), [LETTERBOX], Thresholds(confidence=0.25), ("car", "bus"))
    assert perception.boxes is not None
    assert perception.boxes.class_id.tolist() == [1]
    np.testing.assert_allclose(perception.boxes.confidence, [0.3])


def test_a_box_wholly_in_the_padding_is_gone() -> None:
    (perception,) = to_perceptions(raw([[50, 4, 20, 6, 0.9, 1]]), [LETTERBOX], Thresholds(), ("vehicle",))
    assert perception.boxes is not None
    assert len(perception.boxes) == 0


def test_absent_tasks_stay_absent() -> None:
    (perception,) = to_perceptions(RawOutputs(None, None, None), [LETTERBOX], Thresholds(), ("vehicle",))
    assert perception.boxes is None
    assert perception.drivable is None
    assert perception.lane is None


def test_threshold_is_strictly_above() -> None:
    mask = np.full((1, 384, 640), 127, np.uint8)
    for threshold, expected in ((0.5, False), (0.49, True), (127 / 255, False)):
        outputs = RawOutputs(None, mask, None)
        (perception,) = to_perceptions(outputs, [LETTERBOX], Thresholds(drivable=threshold), ("vehicle",))
        assert perception.drivable is not None
        assert perception.drivable.all() == expected


def test_another_number_of_images_is_refused() -> None:
    with pytest.raises(ShapeError, match="for 1 images, there are 2"):
        to_perceptions(raw(), [LETTERBOX, LETTERBOX], Thresholds(), ("vehicle",))


def test_boxes_in_the_padding_take_no_place() -> None:
    letterbox = Letterbox.fit((64, 128), canvas=(128, 128))
    rows = np.array([[64, 4, 20, 6, 0.9, 0.9], [64, 64, 20, 20, 0.8, 0.9]], np.float32)
    raw = RawOutputs(rows[None], None, None)
    boxes = to_perceptions(raw, [letterbox], Thresholds(max_boxes=1), ("vehicle",))[0].boxes
    assert boxes is not None
    np.testing.assert_allclose(boxes.confidence, [0.72])


def test_a_probability_just_above_the_threshold_is_foreground() -> None:
    letterbox = Letterbox.fit((32, 64), canvas=(32, 64))
    mask = np.full((32, 64), 127, np.uint8)
    mask[:, 32:] = 128  # 128 / 255 is above one half, 127 / 255 is not
    found = threshold_mask(mask, letterbox, 0.5)
    assert found[:, 32:].all()
    assert not found[:, :32].any()
