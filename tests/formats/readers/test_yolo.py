from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.formats.readers.conftest import SIZE
from trilitenet.data.converting import ConversionOptions, convert
from trilitenet.data.reading import DrivingDataset
from trilitenet.errors import DataError
from trilitenet.formats.readers.mapping import LabelMapping
from trilitenet.formats.readers.yolo import read_yolo
from trilitenet.formats.writers.base import open_writer
from trilitenet.structures import Perception

CLASSES: dict[str, tuple[str, ...]] = {"car": ("car",), "truck": ("truck",)}


def test_what_the_writer_writes_comes_back(perceptions: list[Perception], tmp_path: Path) -> None:
    with open_writer("yolo", tmp_path / "data") as writer:
        for perception in perceptions:
            writer.write(perception)
    source = read_yolo(tmp_path / "data", LabelMapping(classes=CLASSES))
    assert source.splits == ("train",)
    convert(source, tmp_path / "out", ConversionOptions(classes=CLASSES))
    dataset = DrivingDataset(tmp_path / "out", "train")
    for sample, perception in zip(dataset, perceptions, strict=True):
        assert perception.boxes is not None
        assert sample.boxes is not None
        np.testing.assert_allclose(sample.boxes, perception.boxes.xyxy, atol=1e-3)
        np.testing.assert_array_equal(sample.class_id, perception.boxes.class_id)
        assert sample.drivable is None  # the format has no place for it
        assert sample.lane is None


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for split in ("train", "val"):
        (tmp_path / f"images/{split}").mkdir(parents=True)
        (tmp_path / f"labels/{split}").mkdir(parents=True)
        cv2.imwrite(str(tmp_path / f"images/{split}/a.jpg"), np.zeros((*SIZE, 3), np.uint8))
    (tmp_path / "data.yaml").write_text(
        "path: .\ntrain: images/train\nval: [images/val]\nnames: {0: car, 1: road, 2: line}\n"
    )
    return tmp_path


def test_polygons_confidences_and_missing_files(root: Path, tmp_path: Path) -> None:
    (root / "labels/train/a.txt").write_text(
        "0 0.5 0.5 0.5 0.5 0.77\n1 0.25 0.5 0.5 0.5 0.5 1.0 0.25 1.0\n2 0.1 0 0.2 0 0.2 1 0.1 1\n"
        "0 0.1 0.1 0.3 0.1 0.3 0.4\n"
    )
    mapping = LabelMapping(classes={"car": ("car",)}, drivable=("road",), lane=("line",))
    source = read_yolo(root, mapping)
    convert(source, tmp_path / "out", ConversionOptions(classes={"car": ("car",)}))
    sample = DrivingDataset(tmp_path / "out", "train")[0]
    assert sample.boxes is not None
    np.testing.assert_allclose(sample.boxes, [[20.0, 12.0, 60.0, 36.0], [8, 4.8, 24, 19.2]], atol=1e-4)
    assert sample.drivable is not None
    assert sample.drivable[24:, 20:40].all()
    assert sample.drivable.sum() == 24 * 20
    assert sample.lane is not None
    assert sample.lane.sum() == 48 * 8
    # The val image has no label file: not labelled, unless the mapping says that this means empty.
    assert DrivingDataset(tmp_path / "out", "val")[0].boxes is None
    empty = read_yolo(root, LabelMapping(classes={"car": ("car",)}, missing="empty")).record("val", "a")
    assert empty.objects == ()


@pytest.mark.parametrize("line", ["0 0.5 0.5 half 0.5", "0 0.5 0.5", "0 0.1 0.2 0.3 0.4 0.5 0.6 0.7"])
def test_a_bad_line_is_named(root: Path, line: str) -> None:
    (root / "labels/train/a.txt").write_text(f"0 0.5 0.5 0.5 0.5\n{line}\n")
    with pytest.raises(DataError, match=r"a\.txt, line 2"):
        read_yolo(root).record("train", "a")


def test_errors(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no data\.yaml"):
        read_yolo(tmp_path)
    (tmp_path / "data.yaml").write_text("names: [car]\ntrain: images/train\n")
    with pytest.raises(DataError, match="no images"):
        read_yolo(tmp_path)
