from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.formats.readers.conftest import CLASSES, SIZE, check_round_trip
from trilitenet.data.converting import ConversionOptions, convert
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.records import ObjectLabel
from trilitenet.errors import DataError
from trilitenet.formats.readers.mapping import LabelMapping
from trilitenet.formats.readers.yolo import read_yolo
from trilitenet.formats.writers.base import open_writer
from trilitenet.structures import Perception


def test_what_the_writer_writes_comes_back(perceptions: list[Perception], tmp_path: Path) -> None:
    with open_writer("yolo", tmp_path / "data") as writer:
        for perception in perceptions:
            writer.write(perception)
    source = read_yolo(tmp_path / "data", LabelMapping(classes=CLASSES))
    assert source.splits == ("train",)
    boxes_alone = [dataclasses.replace(perception, drivable=None, lane=None) for perception in perceptions]
    check_round_trip(source, boxes_alone, tmp_path / "out", within=1e-3)


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
    (root / "labels/val/a.txt").write_text("")  # looked at, whatever a missing file means
    told = read_yolo(root, LabelMapping(classes={"car": ("car",)}, missing="unlabelled")).record("val", "a")
    assert told.objects == ()


@pytest.mark.parametrize(
    "line", ["0 0.5 0.5 half 0.5", "0 0.5 0.5", "0 0.1 0.2 0.3 0.4 0.5 0.6 0.7", "0 nan 0.5 0.5 0.5"]
)
def test_a_bad_line_is_named(root: Path, line: str) -> None:
    (root / "labels/train/a.txt").write_text(f"0 0.5 0.5 0.5 0.5\n{line}\n")
    with pytest.raises(DataError, match=r"a\.txt, line 2"):
        read_yolo(root).record("train", "a")


@pytest.mark.parametrize(
    ("line", "number"), [("0 320 180 50 40", "320"), ("0 0.5 0.5 0.5 0.5 0.9 17", "17"), ("0 1.01 0.5 -3 0.1", "-3")]
)
def test_pixels_and_numbers_of_tracks_are_no_coordinates(root: Path, line: str, number: str) -> None:
    (root / "labels/train/a.txt").write_text(line)
    with pytest.raises(DataError, match=rf"line 1: {number} is no coordinate in \[0, 1\]; divide pixels"):
        read_yolo(root).record("train", "a")


def test_key_points_are_no_polygon(root: Path) -> None:
    with (root / "data.yaml").open("a") as file:
        file.write("kpt_shape: [2, 2]\n")
    (root / "labels/train/a.txt").write_text("0 0.5 0.5 0.5 0.5 0.1 0.1 0.2 0.2\n")
    (item,) = read_yolo(root).record("train", "a").objects or ()
    assert item.box == pytest.approx((20, 12, 60, 36))
    text = (root / "data.yaml").read_text()
    (root / "data.yaml").write_text(text.replace("[2, 2]", "null"))
    (item,) = read_yolo(root).record("train", "a").objects or ()
    assert item.box == pytest.approx((8, 4.8, 40, 24))  # of four corners


def test_errors(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no data\.yaml"):
        read_yolo(tmp_path)
    (tmp_path / "data.yaml").write_text("names: [car]\ntrain: images/train\n")
    with pytest.raises(DataError, match=rf"no images; looked in {tmp_path}/images/train$"):
        read_yolo(tmp_path)
    (tmp_path / "data.yaml").write_text("names: [car]\n")
    with pytest.raises(DataError, match="it names no folder as train, val or test"):
        read_yolo(tmp_path)
    (tmp_path / "data.yaml").write_bytes("names: [K\u00e4fer]".encode("latin-1"))
    with pytest.raises(DataError, match=r"data\.yaml: not text in UTF-8"):
        read_yolo(tmp_path)
    (tmp_path / "data.yaml").write_text("names: [car\n")
    with pytest.raises(DataError, match=r"data\.yaml: not YAML \(line 2: while parsing a flow sequence"):
        read_yolo(tmp_path)


def test_a_byte_order_mark_is_no_text(root: Path) -> None:
    for path, text in (("labels/train/a.txt", "0 0.5 0.5 0.5 0.5\n"), ("data.yaml", (root / "data.yaml").read_text())):
        (root / path).write_text(text, encoding="utf-8-sig")
    assert len(read_yolo(root).record("train", "a").objects or ()) == 1


def test_labels_that_are_not_utf8_or_no_numbers(root: Path) -> None:
    (root / "labels/train/a.txt").write_bytes(b"0 0.5 0.5 0.5 0.5 \xe9")
    with pytest.raises(DataError, match=r"a\.txt: not text in UTF-8"):
        read_yolo(root).record("train", "a")
    (root / "labels/train/a.txt").write_text("inf 0.5 0.5 0.5 0.5")
    with pytest.raises(DataError, match=r"a\.txt, line 1: not numbers"):
        read_yolo(root).record("train", "a")


def test_images_of_one_name_are_told_apart_by_their_folders(root: Path) -> None:
    for folder, label in (("one", "0 0.5 0.5 0.5 0.5\n"), ("two", "")):
        (root / "images/train" / folder).mkdir()
        (root / "labels/train" / folder).mkdir()
        cv2.imwrite(str(root / "images/train" / folder / "c.png"), np.zeros((*SIZE, 3), np.uint8))
        (root / "labels/train" / folder / "c.txt").write_text(label)
    source = read_yolo(root)
    assert [name for name in source.names("train") if "c" in name] == ["one-c", "two-c"]
    assert [len(source.record("train", name).objects or ()) for name in ("one-c", "two-c")] == [1, 0]


def test_label_files_of_no_image_are_told(root: Path) -> None:
    for name in ("a", "classes"):
        (root / f"labels/train/{name}.txt").write_text("")
    assert read_yolo(root).found == ("train: 1 images", "val: 1 images")
    (root / "labels/train/a-2.txt").write_text("")
    (root / "images/train/a-2.jpg").symlink_to("a.jpg")
    (root / "train.txt").write_text("images/train/a.jpg\n")
    (root / "data.yaml").write_text("train: train.txt\nval: images/val\nnames: [car]\n")
    found = read_yolo(root).found[-1]
    assert found == f"1 label files are of no image in a split, such as {root / 'labels/train/a-2.txt'}"


def test_a_list_whose_images_are_all_elsewhere_names_them(root: Path) -> None:
    (root / "data.yaml").write_text("train: train.txt\nnames: [car]\n")
    (root / "train.txt").write_text("data/images/train/a.jpg\n" * 4)
    with pytest.raises(DataError, match=r"no images; looked in .*/train\.txt; listed and not there: .* and 1 more$"):
        read_yolo(root)


def test_images_of_one_name_and_folder_are_refused(root: Path) -> None:
    cv2.imwrite(str(root / "images/train/a.png"), np.zeros((*SIZE, 3), np.uint8))
    with pytest.raises(DataError, match=r"two images are called 'a' in split 'train': .*a\.\w+ and .*a\.\w+; rename"):
        read_yolo(root)


def test_ignored_polygons_are_area_and_object(root: Path) -> None:
    (root / "labels/train/a.txt").write_text("1 0.25 0.5 0.5 0.5 0.5 1.0 0.25 1.0\n")
    record = read_yolo(root, LabelMapping(ignore=("road",), tasks=("detection", "drivable"))).record("train", "a")
    assert record.objects == (ObjectLabel("road", (20, 24, 40, 48), crowd=True),)
    assert [area.kind for area in record.drivable or ()] == ["ignore"]  # type: ignore[union-attr]


@pytest.mark.parametrize(("turn", "box"), [(1, (20, 12, 60, 36)), (6, (12, 20, 36, 60)), (8, (12, 20, 36, 60))])
def test_boxes_are_parts_of_the_turned_image(root: Path, turn: int, box: tuple[float, ...]) -> None:
    exif = Image.Exif()
    exif[0x0112] = turn
    Image.new("RGB", SIZE[::-1]).save(root / "images/train/a.jpg", exif=exif)
    (root / "labels/train/a.txt").write_text("0 0.5 0.5 0.5 0.5\n")
    record = read_yolo(root).record("train", "a")
    assert record.objects is not None
    assert record.objects[0].box == box


@pytest.mark.parametrize("inside", [True, False])
def test_folders_as_roboflow_names_them(root: Path, inside: bool) -> None:
    """Its ``data.yaml`` says ``../train/images``, though ``train`` lies beside the file; what is there wins."""
    folder = root if inside else root / "yolo"
    folder.mkdir(exist_ok=True)
    (root / "images/train").rename(root / "images/images")
    (root / "images").rename(root / "train")
    (folder / "data.yaml").write_text("train: ../train/images\nval: ../valid/images\nnames: [car]\n")
    assert read_yolo(folder).names("train") == ["a"]


def test_lists_of_images(root: Path) -> None:
    cv2.imwrite(str(root / "images/train/b c.jpg"), np.zeros((*SIZE, 3), np.uint8))
    (root / "train.txt").write_text("images/train/a.jpg\n  images/train/b c.jpg \n\nimages/train/gone.jpg\n")
    (root / "data.yaml").write_text("train: train.txt\nnames: [car]\n")
    source = read_yolo(root)
    assert source.names("train") == ["a", "b c"]
    gone = root / "images/train/gone.jpg"
    assert source.found == ("train: 2 images", f"train: 1 listed images are not there, such as {gone}")


def test_the_validation_split_may_be_called_valid(root: Path) -> None:
    (root / "data.yaml").write_text("path: .\ntrain: images/train\nvalid: images/val\nnames: [car]\n")
    assert read_yolo(root).splits == ("train", "val")


def test_class_names_that_all_mean_nothing_are_refused(root: Path) -> None:
    (root / "data.yaml").write_text("train: images/train\nnames: {0: Car}\n")
    with pytest.raises(DataError, match=r"none of its categories \('Car'\) .* --classes FILE"):
        read_yolo(root)
    assert read_yolo(root, LabelMapping(tasks=("detection",))).names("train") == ["a"]


def test_hidden_files_are_passed_over(root: Path) -> None:
    (root / "data.yaml").rename(root / "yard.yaml")
    for file in ("._yard.yaml", "images/train/._a.jpg", "labels/train/._a.txt"):
        (root / file).write_bytes(b"\0\5\26\7\xff names")
    source = read_yolo(root)
    assert source.names("train") == ["a"]
    assert source.found == ("train: 1 images", "val: 1 images")
