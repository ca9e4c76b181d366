from __future__ import annotations

import contextlib
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO

from trilitenet.formats.writers.coco import CocoWriter
from trilitenet.structures import Perception


def write(output: Path, perceptions: list[Perception]) -> Path:
    with CocoWriter(output) as writer:
        for perception in perceptions:
            writer.write(perception)
    (path,) = writer.files
    return path


def test_pycocotools_opens_it(tmp_path: Path, pictures: list[Perception]) -> None:
    with contextlib.redirect_stdout(io.StringIO()):
        coco = COCO(str(write(tmp_path, pictures)))
    assert [image["file_name"] for image in coco.loadImgs([1, 2])] == ["road.jpg", "night/road.jpg"]
    assert [category["name"] for category in coco.loadCats([1, 2, 3, 4])] == [
        "vehicle",
        "rider & bike",
        "drivable",
        "lane",
    ]
    annotations = coco.loadAnns(coco.getAnnIds(imgIds=[1]))
    assert annotations[0]["bbox"] == [10.25, 20.0, 49.75, 30.5]
    assert annotations[0]["area"] == 1517.38  # 49.75 x 30.5
    assert annotations[2]["bbox"] == [20, 60, 161, 60]  # columns 20 to 180, rows 60 to 119
    assert annotations[0]["score"] == 0.9
    np.testing.assert_array_equal(coco.annToMask(annotations[2]).astype(bool), pictures[0].drivable)
    np.testing.assert_array_equal(coco.annToMask(annotations[3]).astype(bool), pictures[0].lane)
    assert pictures[0].drivable is not None
    assert annotations[2]["area"] == int(np.count_nonzero(pictures[0].drivable))
    assert coco.getAnnIds(imgIds=[2]) == []


def test_supervision_opens_it(tmp_path: Path, pictures: list[Perception]) -> None:
    supervision = pytest.importorskip("supervision")
    path = write(tmp_path, pictures[:1])
    cv2.imwrite(str(tmp_path / "road.jpg"), np.zeros((*pictures[0].size, 3), np.uint8))
    dataset = supervision.DetectionDataset.from_coco(str(tmp_path), str(path), force_masks=True)
    _, _, detections = dataset[0]
    assert dataset.classes == ["vehicle", "rider & bike", "drivable", "lane"]
    assert detections.class_id.tolist() == [0, 1, 2, 3]
    assert pictures[0].boxes is not None
    np.testing.assert_allclose(detections.xyxy[:2], pictures[0].boxes.xyxy, atol=0.01)
    np.testing.assert_array_equal(detections.mask[2], pictures[0].drivable)


def test_datumaro_opens_it(tmp_path: Path, pictures: list[Perception]) -> None:
    datumaro = pytest.importorskip("datumaro")
    path = write(tmp_path, pictures[:1])
    for folder in ("annotations", "images/train"):
        (tmp_path / folder).mkdir(parents=True)
    path.rename(tmp_path / "annotations" / "instances_train.json")
    cv2.imwrite(str(tmp_path / "images" / "train" / "road.jpg"), np.zeros((*pictures[0].size, 3), np.uint8))
    (item,) = datumaro.Dataset.import_from(str(tmp_path), "coco")
    assert pictures[0].boxes is not None
    boxes = [annotation for annotation in item.annotations if annotation.type.name == "bbox"]
    np.testing.assert_allclose(
        sorted(box.points for box in boxes if box.label < 2), sorted(pictures[0].boxes.xyxy.tolist()), atol=0.01
    )
    masks = {annotation.label: annotation.image for annotation in item.annotations if annotation.type.name == "mask"}
    np.testing.assert_array_equal(masks[2] > 0, pictures[0].drivable)
    np.testing.assert_array_equal(masks[3] > 0, pictures[0].lane)


def test_frames_of_a_video_are_named_and_tracked(tmp_path: Path, video: list[Perception]) -> None:
    document = json.loads(write(tmp_path, video).read_text(encoding="utf-8"))
    assert document["images"][3]["file_name"] == "drive-0000003.jpg"
    tracks = [annotation.get("track_id") for annotation in document["annotations"] if annotation["category_id"] <= 2]
    assert tracks == [7, None, 7, None, None, 7, None]
    assert len({annotation["id"] for annotation in document["annotations"]}) == len(document["annotations"])


def test_videos_are_listed_and_their_tracks_told_apart(
    tmp_path: Path, pictures: list[Perception], video: list[Perception]
) -> None:
    other = [dataclasses.replace(frame, source="night/drive.mp4") for frame in video]
    document = json.loads(write(tmp_path, [*video, pictures[0], *other]).read_text(encoding="utf-8"))
    assert document["videos"] == [{"id": 1, "name": "drive"}, {"id": 2, "name": "drive-2"}]
    places = [(image.get("video_id"), image.get("frame_id")) for image in document["images"]]
    assert places == [*((1, i) for i in range(4)), (None, None), *((2, i) for i in range(4))]
    of = {image["id"]: image.get("video_id") for image in document["images"]}
    tracks = {(of[each["image_id"]], each["track_id"]) for each in document["annotations"] if "track_id" in each}
    assert tracks == {(1, 7), (2, 8)}
    assert "videos" not in json.loads(write(tmp_path / "pictures", pictures).read_text(encoding="utf-8"))


@pytest.mark.parametrize("kept", ["boxes", "drivable", "lane"])
def test_what_was_not_looked_for_has_no_category(tmp_path: Path, pictures: list[Perception], kept: str) -> None:
    others: dict[str, Any] = {field: None for field in ("boxes", "drivable", "lane") if field != kept}
    document = json.loads(write(tmp_path, [dataclasses.replace(pictures[0], **others)]).read_text(encoding="utf-8"))
    names = [category["name"] for category in document["categories"]]
    assert names == (["vehicle", "rider & bike"] if kept == "boxes" else [kept])
    used = {annotation["category_id"] for annotation in document["annotations"]}
    assert used == {category["id"] for category in document["categories"]}


def test_no_image_is_still_a_file(tmp_path: Path) -> None:
    document = json.loads(write(tmp_path, []).read_text(encoding="utf-8"))
    assert document["images"] == document["annotations"] == []
