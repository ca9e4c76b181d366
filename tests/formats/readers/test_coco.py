from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.formats.readers.conftest import CLASSES, SIZE, check_round_trip
from trilitenet.data.converting import ConversionOptions, convert
from trilitenet.data.reading import DrivingDataset
from trilitenet.errors import DataError, OutputError
from trilitenet.formats.readers.coco import read_coco
from trilitenet.formats.readers.mapping import LabelMapping
from trilitenet.formats.writers.base import open_writer
from trilitenet.structures import Perception


def test_what_the_writer_writes_comes_back(perceptions: list[Perception], tmp_path: Path) -> None:
    with open_writer("coco", tmp_path / "data") as writer:
        for perception in perceptions:
            writer.write(perception)
    source = read_coco(tmp_path / "data", LabelMapping(classes=CLASSES))
    check_round_trip(source, perceptions, tmp_path / "out")


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
    report = convert(source, tmp_path / "out", ConversionOptions(classes={"vehicle": ("car",)}, ignore=("mud",)))
    sample = DrivingDataset(tmp_path / "out", "val")[0]
    assert sample.boxes is not None
    assert sample.boxes.tolist() == [[10, 2, 40, 6]]
    assert sample.ignored.tolist() == [[1, 2, 4, 6], [0, 0, 1, 1]]
    assert sample.drivable is not None
    assert sample.drivable.sum() == 400
    assert sample.drivable[20:40, 10:30].all()
    assert sample.drivable_valid is not None
    assert (~sample.drivable_valid).sum() == 200
    assert not sample.drivable_valid[20:40, 40:50].any()
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
    path.write_text('{"images": [], "annotations": [1.5]}')
    with pytest.raises(DataError, match="no COCO annotations"):
        read_coco(tmp_path)
    path.write_text(json.dumps(coco()))
    with pytest.raises(DataError, match="none of the images"):
        read_coco(path)
    path.write_text(json.dumps(coco(images=[{"id": 7, "file_name": "x" * 5000}])))
    with pytest.raises(DataError, match="none of the images"):
        read_coco(path)
    path.write_text(json.dumps(coco(annotations=[{"hello": 1}])))
    cv2.imwrite(str(tmp_path / "one.png"), np.zeros((*SIZE, 3), np.uint8))
    with pytest.raises(DataError, match=r"not as COCO has it \('image_id' is missing\)"):
        read_coco(path)


def write(path: Path, content: dict[str, Any] | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if content is None:
        cv2.imwrite(str(path), np.zeros((*SIZE, 3), np.uint8))
    else:
        path.write_text(json.dumps(content))


def test_ignored_categories_keep_their_boxes_where_areas_are_not_labelled(tmp_path: Path) -> None:
    write(tmp_path / "one.png")
    write(tmp_path / "labels.json", coco())
    record = read_coco(tmp_path / "labels.json", LabelMapping(ignore=("mud",))).record("train", "one")
    assert record.drivable is None
    assert record.objects is not None
    assert [(item.category, item.crowd) for item in record.objects if item.category == "mud"] == [("mud", True)]


def test_coco_as_downloaded(tmp_path: Path) -> None:
    """Files of captions and of key points lie beside those of instances."""
    for split in ("train", "val"):
        write(tmp_path / f"{split}2017/one.png")
        write(tmp_path / f"annotations/instances_{split}2017.json", coco())
        write(tmp_path / f"annotations/person_keypoints_{split}2017.json", coco(annotations=[]))
        write(tmp_path / f"annotations/captions_{split}2017.json", coco(annotations=[{"image_id": 7, "caption": "a"}]))
    source = read_coco(tmp_path)
    assert source.splits == ("train", "val")
    assert len(source.record("val", "one").objects or ()) == 5
    assert source.found[-1].startswith("not used: captions_train2017.json, captions_val2017.json, person_keypoints_")
    for number in range(20):  # results of each picture, say
        (tmp_path / f"{number:02}.json").write_text("{}")
    assert read_coco(tmp_path).found[-1].endswith("08.json, 09.json and 14 more")


@pytest.mark.parametrize("place", ["val2017", "images/val", "images", "annotations/images", "."])
def test_a_single_file_finds_its_images(tmp_path: Path, place: str) -> None:
    write(tmp_path / place / "one.png")
    write(tmp_path / "annotations/instances_val2017.json", coco())
    assert read_coco(tmp_path / "annotations/instances_val2017.json").names("train") == ["one"]


@pytest.mark.parametrize(
    ("path", "split"),
    [("val/train.json", "train"), ("train/_annotations.coco.json", "train"), ("test/labels.json", "val")],
)
def test_the_file_names_its_split_before_its_folder(tmp_path: Path, path: str, split: str) -> None:
    write(tmp_path / path, coco())
    write((tmp_path / path).with_name("one.png"))
    assert read_coco((tmp_path / path).parent, LabelMapping(split="val")).splits == (split,)


def test_labels_made_at_another_size_are_left_out(tmp_path: Path) -> None:
    sizes = {"one": SIZE, "two": (SIZE[0] * 20, SIZE[1] * 20), "three": (0, 0)}
    images = [
        {"id": index, "file_name": f"{name}.png", "height": size[0], "width": size[1]}
        for index, (name, size) in enumerate(sizes.items())
    ]
    for name in sizes:
        write(tmp_path / f"{name}.png")
    write(tmp_path / "labels.json", coco(images=images, annotations=[]))
    report = convert(read_coco(tmp_path), tmp_path / "out")
    assert DrivingDataset(tmp_path / "out", "train").names == ["one", "three"]
    assert report.dropped["train"] == {"image: labels or image broken": 1}


def test_annotations_of_no_image_are_counted(tmp_path: Path) -> None:
    write(tmp_path / "one.png")
    annotations = [{**item, "image_id": image} for item, image in zip(coco()["annotations"], (7, 8, "7"), strict=False)]
    write(tmp_path / "labels.json", coco(annotations=annotations))
    source = read_coco(tmp_path)
    assert len(source.record("train", "one").objects or ()) == 1
    assert source.found[-1] == "train: 2 annotations of labels.json left out: their image_id is no image's id"


def test_annotations_that_are_all_of_no_image_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "one.png")
    write(tmp_path / "labels.json", coco(annotations=[{**item, "image_id": "7"} for item in coco()["annotations"]]))
    with pytest.raises(DataError, match=r"the id of an image \(image_id '7', but images 7, \.\.\.\); write both alike"):
        read_coco(tmp_path)
    write(tmp_path / "labels.json", coco(annotations=[{**item, "image_id": 8} for item in coco()["annotations"]]))
    with pytest.raises(DataError, match=r"\(image_id 8, but images 7, \.\.\.\); they are of other images"):
        read_coco(tmp_path)


def test_annotations_that_are_all_of_no_category_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "one.png")
    annotations = [{**item, "category_id": str(item["category_id"])} for item in coco()["annotations"]]
    write(tmp_path / "labels.json", coco(annotations=annotations))
    with pytest.raises(DataError, match=r"id of a category \(category_id '1', but categories 1, 2, 3\); write both"):
        read_coco(tmp_path)
    others = [{**item, "category_id": 0} for item in annotations]  # as of a list of names
    write(tmp_path / "other.json", coco(annotations=others))
    with pytest.raises(DataError, match=r"\(category_id 0, but categories 1, 2, 3\); number both alike"):
        read_coco(tmp_path / "other.json")
    (tmp_path / "other.json").unlink()
    write(tmp_path / "labels.json", coco(annotations=[*annotations, coco()["annotations"][0]]))
    assert len(read_coco(tmp_path).record("train", "one").objects or ()) == 6  # of which all but one are told


def test_a_split_without_images_is_left_out(tmp_path: Path) -> None:
    write(tmp_path / "train/one.png")
    for split in ("train", "val"):
        write(tmp_path / f"annotations/instances_{split}.json", coco())
    (tmp_path / "train/one.png").rename(tmp_path / "train/other.png")
    write(
        tmp_path / "annotations/instances_train.json", coco(images=[{**coco()["images"][0], "file_name": "other.png"}])
    )
    assert read_coco(tmp_path).splits == ("train",)


def test_a_conversion_keeps_to_its_source_and_mapping(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        write(tmp_path / folder / "one.png")
        write(tmp_path / folder / "labels.json", coco())
    convert(read_coco(tmp_path / "a"), tmp_path / "out")
    convert(read_coco(tmp_path / "a", LabelMapping(licence="CC0")), tmp_path / "out")
    for source in (read_coco(tmp_path / "b"), read_coco(tmp_path / "a", LabelMapping(drivable=("road",)))):
        with pytest.raises(OutputError, match="another source"):
            convert(source, tmp_path / "out")


def test_categories_that_all_mean_nothing_are_refused(tmp_path: Path) -> None:
    write(tmp_path / "one.png")
    write(tmp_path / "labels.json", coco(categories=[{"id": 1, "name": "Car"}, {"id": 2, "name": "Road"}]))
    with pytest.raises(DataError, match=r"none of its categories \('Car', 'Road'\) .* --classes FILE"):
        read_coco(tmp_path)
    assert read_coco(tmp_path, LabelMapping(lane=("Road",))).names("train") == ["one"]
    write(tmp_path / "two.png")
    more = coco(images=[{**coco()["images"][0], "file_name": "two.png"}])
    write(tmp_path / "more.json", more)
    assert read_coco(tmp_path).record("train", "one").objects is None  # one file of two says what is looked for


@pytest.mark.parametrize(
    ("annotation", "message"),
    [
        ({"bbox": None}, "bbox must be 4 numbers"),
        ({"bbox": []}, "bbox must be 4 numbers"),
        ({}, "bbox must be 4 numbers"),
        ({"bbox": [1, 2, 3, "x"]}, "bbox must be 4 numbers"),
        ({"bbox": [1, 2, 3, 4], "category_id": None}, "category_id must be the id of a category"),
        ({"category_id": 2, "segmentation": [[1, 2, 3]]}, "a polygon must be an even number of coordinates"),
        ({"category_id": 2, "segmentation": [1, 2, 3, 4, 5, 6]}, "a polygon must be an even number of coordinates"),
        ({"category_id": 2, "segmentation": {"size": [1], "counts": "0"}}, "run lengths need a size"),
        ({"category_id": 2, "segmentation": {"size": [48, float("inf")], "counts": "0"}}, "run lengths need a size"),
        ({"category_id": 2, "segmentation": {"size": [48, 80]}}, "run lengths need a size"),
        ({"category_id": 2, "segmentation": 1}, "segmentation must be a list of polygons, or run lengths"),
    ],
)
def test_an_image_with_a_broken_annotation_is_left_out_and_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, annotation: dict[str, Any], message: str
) -> None:
    for name in ("one", "two"):
        write(tmp_path / f"{name}.png")
    broken = {"id": 17, "image_id": 8, "category_id": 1, **annotation}
    images = [*coco()["images"], {**coco()["images"][0], "id": 8, "file_name": "two.png"}]
    write(tmp_path / "labels.json", coco(images=images, annotations=[*coco()["annotations"], broken]))
    report = convert(read_coco(tmp_path, LabelMapping(drivable=("road",))), tmp_path / "out")
    assert DrivingDataset(tmp_path / "out", "train").names == ["one"]
    assert report.dropped["train"]["image: labels or image broken"] == 1
    assert f"labels.json: image 'two.png', annotation 17: {message}" in caplog.text


def test_images_without_annotations_are_told_and_may_be_left_unlabelled(tmp_path: Path) -> None:
    names = ("one", "boxes", "none", "broken")
    images = [{**coco()["images"][0], "id": 7 + index, "file_name": f"{name}.png"} for index, name in enumerate(names)]
    for name in names:
        write(tmp_path / f"{name}.png")
    more = [{"image_id": 8, "category_id": 1, "bbox": [1, 2, 3, 4]}, {"image_id": 10, "category_id": 1}]
    write(tmp_path / "labels.json", coco(images=images, annotations=[*coco()["annotations"], *more]))
    source = read_coco(tmp_path, LabelMapping(drivable=("road",)))
    assert source.found[1].startswith("train: 1 images without any label are taken as looked at, with nothing there; ")
    assert (source.record("train", "none").objects, source.record("train", "none").drivable) == ((), ())
    assert len(read_coco(tmp_path, LabelMapping(drivable=("road",), missing="empty")).found) == 1
    source = read_coco(tmp_path, LabelMapping(drivable=("road",), missing="unlabelled"))
    assert len(source.found) == 1
    assert convert(source, tmp_path / "out").labelled == {"train": {"detection": 2, "drivable": 1}}
    assert DrivingDataset(tmp_path / "out", "train").names == ["boxes", "none", "one"]


def test_areas_of_too_few_points_are_counted(tmp_path: Path) -> None:
    write(tmp_path / "one.png")
    area = {"image_id": 7, "category_id": 2, "segmentation": [[], [1, 2], [1, 2, 3, 4], [1, 1, 9, 1, 9, 9]]}
    write(tmp_path / "labels.json", coco(annotations=[area]))
    report = convert(read_coco(tmp_path, LabelMapping(drivable=("road",))), tmp_path / "out")
    assert report.dropped["train"] == {"area with too few points": 3}


def test_images_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    images = []
    for number, folder in enumerate(("monday", "tuesday"), start=7):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "one.png")
        images.append({**coco()["images"][0], "id": number, "file_name": f"{folder}/one.png"})
    write(tmp_path / "labels.json", coco(images=images))
    source = read_coco(tmp_path, LabelMapping(classes=CLASSES))
    assert source.names("train") == ["monday-one", "tuesday-one"]
    assert [len(source.record("train", name).objects or ()) for name in source.names("train")] == [5, 0]


@pytest.mark.parametrize("split", ["train", "val"])
def test_a_picture_is_not_that_of_another_image_of_its_name(tmp_path: Path, split: str) -> None:
    (image,) = coco()["images"]
    for file, name in (("train_a", "monday/one.png"), (f"{split}_b", "tuesday/one.png")):
        write(tmp_path / f"annotations/instances_{file}.json", coco(images=[{**image, "file_name": name}]))
    write(tmp_path / "images/one.png")
    with pytest.raises(
        DataError, match=r"one\.png: is the only picture of both 'monday/one\.png' and 'tuesday/one\.png'"
    ):
        read_coco(tmp_path)


def test_several_files_may_list_one_image(tmp_path: Path) -> None:
    (image,) = coco()["images"]
    for split, name in (("train", "one.png"), ("val", "./one.png")):
        write(tmp_path / f"annotations/instances_{split}.json", coco(images=[{**image, "file_name": name}]))
    write(tmp_path / "images/one.png")
    assert read_coco(tmp_path).splits == ("train", "val")


def test_subsets_as_cvat_and_datumaro_export_them(tmp_path: Path) -> None:
    for subset in ("default", "Rear"):
        write(tmp_path / "images" / subset / "one.png")
        write(tmp_path / f"annotations/instances_{subset}.json", coco())
    source = read_coco(tmp_path)
    assert source.names("train") == ["Rear-one", "default-one"]
    assert [source.record("train", name).image.parent.name for name in source.names("train")] == ["Rear", "default"]


def test_paths_may_be_of_windows(tmp_path: Path) -> None:
    write(tmp_path / "JPEGImages/one.png")
    write(tmp_path / "labels.json", coco(images=[{**coco()["images"][0], "file_name": r"JPEGImages\one.png"}]))
    assert read_coco(tmp_path).record("train", "one").image == tmp_path / "JPEGImages/one.png"
    if sys.platform != "win32":  # where an archive of Windows was unpacked
        (tmp_path / "JPEGImages/one.png").rename(tmp_path / r"JPEGImages\one.png")
        (source,) = read_coco(tmp_path).names("train")
        assert source == r"JPEGImages\one"


def test_an_attribute_of_null_is_none(tmp_path: Path) -> None:
    write(tmp_path / "one.png")
    (image,) = coco()["images"]
    write(tmp_path / "labels.json", coco(images=[{**image, "attributes": {"weather": "rainy", "sequence": None}}]))
    assert read_coco(tmp_path).record("train", "one").attributes == {"weather": "rainy"}


def test_hidden_files_are_passed_over(tmp_path: Path) -> None:
    write(tmp_path / "one.png")
    write(tmp_path / "labels.json", coco())
    (tmp_path / "._labels.json").write_bytes(b"\0\5\26\7")
    assert read_coco(tmp_path).names("train") == ["one"]
