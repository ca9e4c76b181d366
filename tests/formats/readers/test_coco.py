from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.formats.readers.conftest import SIZE
from trilitenet.data.converting import ConversionOptions, convert
from trilitenet.data.reading import DrivingDataset
from trilitenet.errors import DataError
from trilitenet.formats.readers.coco import read_coco
from trilitenet.formats.readers.mapping import LabelMapping
from trilitenet.formats.writers.base import open_writer
from trilitenet.structures import Perception

CLASSES: dict[str, tuple[str, ...]] = {"car": ("car",), "truck": ("truck",)}


def test_what_the_writer_writes_comes_back(perceptions: list[Perception], tmp_path: Path) -> None:
    with open_writer("coco", tmp_path / "data") as writer:
        for perception in perceptions:
            writer.write(perception)
    source = read_coco(tmp_path / "data", LabelMapping(classes=CLASSES))
    convert(source, tmp_path / "out", ConversionOptions(classes=CLASSES))
    dataset = DrivingDataset(tmp_path / "out", "train")
    assert dataset.names == ["one", "two"]
    for sample, perception in zip(dataset, perceptions, strict=True):
        assert perception.boxes is not None
        assert sample.boxes is not None
        np.testing.assert_allclose(sample.boxes, perception.boxes.xyxy, atol=0.011)
        np.testing.assert_array_equal(sample.class_id, perception.boxes.class_id)
        np.testing.assert_array_equal(sample.drivable, perception.drivable)
        np.testing.assert_array_equal(sample.lane, perception.lane)


def coco(**more: Any) -> dict[str, Any]:
    return {
        "images": [{"id": 7, "file_name": "one.png", "height": SIZE[0], "width": SIZE[1]}],
        "categories": [{"id": 1, "name": "car"}, {"id": 2, "name": "road"}, {"id": 3, "name": "mud"}],
        "annotations": [
            {"image_id": 7, "category_id": 1, "bbox": [1, 2, 3, 4], "iscrowd": 1},
            {"image_id": 7, "category_id": 1, "bbox": [10, 2, 30, 4], "iscrowd": 0},
            {"image_id": 7, "category_id": 2, "bbox": [0, 0, 1, 1], "segmentation": [[10, 20, 30, 20, 30, 40, 10, 40]]},
            {"image_id": 7, "category_id": 3, "bbox": [0, 0, 1, 1], "segmentation": [[40, 20, 50, 20, 50, 40, 40, 40]]},
            {"image_id": 7, "category_id": 2, "bbox": [0, 0, 1, 1], "segmentation": []},
        ],
        **more,
    }


@pytest.mark.parametrize("place", ["annotations/instances_val2017.json", "valid/_annotations.coco.json"])
def test_polygons_crowds_and_layouts(tmp_path: Path, place: str) -> None:
    path = tmp_path / place
    path.parent.mkdir()
    path.write_text(json.dumps(coco()))
    folder = path.parent if path.parent.name == "valid" else tmp_path / "val2017"
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "one.png"), np.zeros((*SIZE, 3), np.uint8))
    source = read_coco(tmp_path, LabelMapping(drivable=("road",), ignore=("mud",)))
    report = convert(source, tmp_path / "out", ConversionOptions(classes={"vehicle": ("car",)}))
    sample = DrivingDataset(tmp_path / "out", "val")[0]
    assert sample.boxes is not None
    assert sample.boxes.tolist() == [[10, 2, 40, 6]]
    assert sample.ignored.tolist() == [[1, 2, 4, 6]]
    assert sample.drivable is not None
    assert sample.drivable.sum() == 400
    assert sample.drivable[20:40, 10:30].all()
    assert sample.valid is not None
    assert (~sample.valid).sum() == 200
    assert not sample.valid[20:40, 40:50].any()
    assert sample.lane is None  # no category of lanes, so they are not labelled
    assert report.dropped["val"] == {"road: without a segmentation": 1}


def test_uncompressed_runs(tmp_path: Path) -> None:
    mask = np.zeros(SIZE, np.bool_)
    mask[3:9, 5:7] = True
    flat = mask.T.reshape(-1)
    edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    counts = np.diff(np.concatenate([[0], edges, [flat.size]])).tolist()
    segmentation = {"size": list(SIZE), "counts": counts}
    annotations = [{"image_id": 7, "category_id": 2, "bbox": [0, 0, 1, 1], "segmentation": segmentation}]
    (tmp_path / "labels.json").write_text(json.dumps(coco(annotations=annotations)))
    cv2.imwrite(str(tmp_path / "one.png"), np.zeros((*SIZE, 3), np.uint8))
    convert(read_coco(tmp_path / "labels.json", LabelMapping(drivable=("road",))), tmp_path / "out")
    np.testing.assert_array_equal(DrivingDataset(tmp_path / "out", "train")[0].drivable, mask)


def test_errors(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no COCO annotations"):
        read_coco(tmp_path)
    path = tmp_path / "a.json"
    path.write_text("{")
    with pytest.raises(DataError, match="not JSON"):
        read_coco(path)
    path.write_text(json.dumps(coco()))
    with pytest.raises(DataError, match="none of the images"):
        read_coco(path)
    path.write_text(json.dumps(coco(annotations=[{"hello": 1}])))
    with pytest.raises(DataError, match="not as COCO has it"):
        read_coco(path)
