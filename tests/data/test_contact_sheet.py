from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.data.published import write_published
from trilitenet.data.contact_sheet import alternative_area, caption, draw_sample, thumbnail
from trilitenet.data.description import MaskMeaning, read_description, write_description
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.sample import Sample


def test_ignored_regions_show_on_a_small_picture() -> None:
    sample = Sample("a", np.zeros((720, 1280, 3), np.uint8), ignored=np.array([[320, 160, 960, 480]], np.float32))
    small = thumbnail(sample, ("vehicle",), size=(180, 320))
    assert small[60, 78:83].max() > 100  # the left edge, in grey
    assert small[60, 100:220].max() == 0


def test_a_caption_names_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    monkeypatch.setattr(cv2, "putText", lambda _, text, *__: written.append(text))
    mask = np.zeros((36, 64), np.uint8)
    sample = Sample("0123456789abcdefghijklmnopqrstuvwxyz", np.zeros((36, 64, 3), np.uint8), lane=mask)
    sample = dataclasses.replace(sample, attributes={"timeofday": "night"})
    assert caption(sample) == f"{sample.name}, night, no boxes, area"
    thumbnail(sample, ("vehicle",))
    thumbnail(dataclasses.replace(sample, name=sample.name[:30]), ("vehicle",), split="val")
    assert written[0] == "0123456789abc..lmnopqrstuvwxyz  night  no boxes, area"
    assert written[1] == f"val/{sample.name[:30]}  night  no boxes, area"


@pytest.mark.parametrize("name", ["na\udcefve", "\udcff"])
def test_a_name_that_is_no_text_is_written_in_escapes(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    monkeypatch.setattr(cv2, "putText", lambda _, text, *__: written.append(text))  # itself it would crash
    mask = np.zeros((36, 64), np.uint8)
    boxes, class_id = np.zeros((0, 4), np.float32), np.zeros(0, np.int64)
    thumbnail(Sample(name, np.zeros((36, 64, 3), np.uint8), boxes, class_id, drivable=mask, lane=mask), ("vehicle",))
    assert written == [name.encode("utf-8", "backslashreplace").decode()]
    assert written[0].isascii()


def test_alternative_areas_are_tinted_less_than_direct_ones(tmp_path: Path) -> None:
    write_published(tmp_path, "train", 2)
    mask = np.zeros((72, 128), np.uint8)
    mask[40:, 20:60], mask[40:, 70:110] = 127, 255
    cv2.imwrite(str(tmp_path / "da_seg_annotations/train/train_0000.png"), mask)
    dataset = DrivingDataset(tmp_path, "train")
    area = alternative_area(dataset, 0)
    np.testing.assert_array_equal(area, mask == 127)
    assert alternative_area(dataset, 1) is None
    grey = np.full((72, 128, 3), 100, np.uint8)
    sample = Sample("a", grey, drivable=(mask > 1).astype(np.uint8))
    picture = draw_sample(sample, ("vehicle",), area)
    assert (grey == 100).all()
    changes = np.abs(picture.astype(int) - 100).sum(axis=2)
    assert 0 < changes[55, 40] < changes[55, 90] / 2
    assert changes[55, 5] == 0
    description = read_description(tmp_path)
    for values, there in (({255: "alternative"}, 255), ({255: "drivable"}, None)):
        write_description(tmp_path, dataclasses.replace(description, drivable=MaskMeaning(values=values)))
        area = alternative_area(DrivingDataset(tmp_path, "train"), 0)
        assert (area is None) if there is None else np.array_equal(np.asarray(area), mask == there)
