from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from trilitenet.data.converting import ConversionOptions, convert
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.records import RecordSource
from trilitenet.structures import Boxes, Perception

CLASSES: dict[str, tuple[str, ...]] = {"car": ("car",), "truck": ("truck",)}
SIZE = (48, 80)


def check_round_trip(source: RecordSource, wanted: list[Perception], out: Path, within: float = 0.011) -> None:
    """Check that what a writer wrote is read and converted as it was; ``within`` is of boxes, in pixels."""
    convert(source, out, ConversionOptions(classes=CLASSES))
    dataset = DrivingDataset(out, "train")
    assert dataset.names == ["one", "two"]
    for sample, perception in zip(dataset, wanted, strict=True):
        assert perception.boxes is not None
        assert sample.boxes is not None
        np.testing.assert_allclose(sample.boxes, perception.boxes.xyxy, atol=within)
        np.testing.assert_array_equal(sample.class_id, perception.boxes.class_id)
        for mask, own in ((sample.drivable, perception.drivable), (sample.lane, perception.lane)):
            assert (mask is None) == (own is None)
            np.testing.assert_array_equal(mask, own)


@pytest.fixture
def perceptions(tmp_path: Path) -> list[Perception]:
    """Two labelled frames and their images in ``tmp_path/data/images``; the second has no object."""
    folder = tmp_path / "data/images"
    folder.mkdir(parents=True)
    result = []
    for index, name in enumerate(("one", "two")):
        cv2.imwrite(str(folder / f"{name}.png"), np.full((*SIZE, 3), 40 * (index + 1), np.uint8))
        drivable, lane = np.zeros(SIZE, np.bool_), np.zeros(SIZE, np.bool_)
        drivable[30:48, 10 : 60 + index] = True
        lane[28:48, 20] = True
        lane[40, 3] = True
        boxes = Boxes(
            np.array([[10.25, 5.5, 30.75, 20.25], [0, 0, 8, 9]], np.float32),
            np.array([0.9, 0.4], np.float32),
            np.array([0, 1]),
        )
        result.append(
            Perception(
                SIZE,
                ("car", "truck"),
                boxes if index == 0 else Boxes.empty(),
                drivable,
                lane,
                source=str(folder / f"{name}.png"),
            )
        )
    return result
