from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from trilitenet.formats.writers.yolo import YoloWriter
from trilitenet.structures import Perception


def test_lines_by_hand(tmp_path: Path, pictures: list[Perception]) -> None:
    with YoloWriter(tmp_path, confidence=True) as writer:
        writer.write(pictures[0])
    lines = (tmp_path / "labels" / "road.txt").read_text().splitlines()
    # centre x (10.25 + 60) / 2 / 200, centre y (20 + 50.5) / 2 / 120, width 49.75 / 200, height 30.5 / 120
    assert lines[0] == "0 0.175625 0.293750 0.248750 0.254167 0.9000"
    assert lines[1].startswith("1 0.575000 ")


def test_the_folder_is_that_of_the_file_wherever_it_is_read_from(tmp_path: Path, pictures: list[Perception]) -> None:
    with YoloWriter(tmp_path) as writer:
        writer.write(pictures[0])
    told = yaml.safe_load((tmp_path / "data.yaml").read_text())
    assert told.keys() == {"train", "val", "names"}  # "path: ." would be the current folder to Ultralytics


def test_supervision_opens_it(tmp_path: Path, pictures: list[Perception]) -> None:
    supervision = pytest.importorskip("supervision")
    with YoloWriter(tmp_path) as writer:
        writer.write(pictures[0])
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "road.jpg"), np.zeros((*pictures[0].size, 3), np.uint8))
    dataset = supervision.DetectionDataset.from_yolo(
        str(tmp_path / "images"), str(tmp_path / "labels"), str(tmp_path / "data.yaml")
    )
    _, _, detections = dataset[0]
    assert dataset.classes == list(pictures[0].class_names)
    assert pictures[0].boxes is not None
    np.testing.assert_allclose(detections.xyxy, pictures[0].boxes.xyxy, atol=0.01)
    np.testing.assert_array_equal(detections.class_id, pictures[0].boxes.class_id)


def test_datumaro_opens_it(tmp_path: Path, pictures: list[Perception]) -> None:
    datumaro = pytest.importorskip("datumaro")
    with YoloWriter(tmp_path) as writer:
        writer.write(pictures[0])
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "road.jpg"), np.zeros((*pictures[0].size, 3), np.uint8))
    (item,) = datumaro.Dataset.import_from(str(tmp_path), "yolo")
    assert pictures[0].boxes is not None
    found = sorted((box.label, *box.points) for box in item.annotations)
    wanted = sorted(zip(pictures[0].boxes.class_id, *pictures[0].boxes.xyxy.T, strict=True))
    np.testing.assert_allclose(found, np.array(wanted), atol=0.01)


def test_two_pictures_of_one_name_do_not_clash(tmp_path: Path, pictures: list[Perception]) -> None:
    with YoloWriter(tmp_path) as writer:
        for picture in pictures:
            writer.write(picture)
    assert len(list((tmp_path / "labels").rglob("*.txt"))) == 2


def test_what_was_not_looked_for_leaves_no_labels(tmp_path: Path, pictures: list[Perception]) -> None:
    with YoloWriter(tmp_path) as writer:
        writer.write(dataclasses.replace(pictures[0], boxes=None))
    assert list(tmp_path.rglob("*.*")) == writer.files == []


def test_the_confidence_is_written_only_where_it_is_asked_for(tmp_path: Path, pictures: list[Perception]) -> None:
    for name, confidence, columns in (("labels-alone", False, 5), ("with-confidence", True, 6)):
        with YoloWriter(tmp_path / name, confidence=confidence) as writer:
            writer.write(pictures[0])
        lines = (tmp_path / name / "labels" / "road.txt").read_text().splitlines()
        assert {len(line.split()) for line in lines} == {columns}


def test_what_an_earlier_run_left_of_a_video_goes_once_it_is_done(tmp_path: Path, video: list[Perception]) -> None:
    labels = tmp_path / "labels"
    labels.mkdir()
    mine = {"drive.txt", "drive-000009.txt", "drive-x-0000009.txt", "other-0000009.txt", "drive-0000009.csv"}
    mine |= {"drive-20240101.txt", "new-0000009.txt"}
    left = {"drive-0000001.txt", "drive-0000003.txt", "drive-0000009.txt"}
    for name in mine | left:
        (labels / name).touch()
    with YoloWriter(tmp_path, overwrite=True) as writer:
        writer.write(dataclasses.replace(video[0], boxes=None))
        writer.remove_remains("drive.mp4")  # boxes were not looked for
        for frame in video[:2]:
            writer.write(frame)
        assert {path.name for path in labels.iterdir()} == {"drive-0000000.txt", "drive-0000001.txt"} | mine | left
        writer.write(video[3])
        writer.remove_remains("drive.mp4")
        writer.write(dataclasses.replace(video[0], source="new.mp4"))
        writer.remove_remains("new.mp4")  # nothing of it was replaced: of what run, if any, the other is nobody knows
    written = {f"drive-000000{index}.txt" for index in (0, 1, 3)} | {"new-0000000.txt"}
    assert {path.name for path in labels.iterdir()} == written | mine
