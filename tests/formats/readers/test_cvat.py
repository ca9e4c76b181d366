from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest

from tests.formats.readers.conftest import CLASSES, SIZE, check_round_trip
from trilitenet.config import TASKS
from trilitenet.data.converting import ConversionOptions, convert
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.records import ImageRecord, ObjectLabel
from trilitenet.errors import DataError
from trilitenet.formats.readers.cvat import read_cvat
from trilitenet.formats.readers.mapping import LabelMapping
from trilitenet.formats.writers.base import open_writer
from trilitenet.structures import Perception


def test_what_the_writer_writes_comes_back(perceptions: list[Perception], tmp_path: Path) -> None:
    with open_writer("cvat", tmp_path / "data") as writer:
        for perception in [*perceptions, dataclasses.replace(perceptions[0], source="drive.mp4", frame=0)]:
            writer.write(perception)
    assert (tmp_path / "data" / "drive.cvat-video.xml").exists()
    source = read_cvat(tmp_path / "data", LabelMapping(classes=CLASSES))
    assert source.found[-1] == "files of the kind 'CVAT for video', left out: 1"
    check_round_trip(source, perceptions, tmp_path / "out")


XML = """<?xml version="1.0" encoding="utf-8"?>
<annotations>
  <version>1.1</version>
  <meta><task><labels><label><name>vehicle</name></label><label><name>lane</name></label>
    <label><name>drivable</name></label></labels></task></meta>
  <image id="0" name="clips/one.png" subset="Validation" width="80" height="48">
    <box label="vehicle" occluded="1" xtl="1" ytl="2" xbr="5.5" ybr="7" z_order="0">
      <attribute name="crowd">true</attribute></box>
    <polygon label="drivable" points="10,20;30,20;30,40;10,40" z_order="0"></polygon>
    <polyline label="lane" points="50,5;50,45" z_order="0"></polyline>
    <polyline label="lane" points="54,45;54,5" z_order="0"></polyline>
    <points label="vehicle" points="1,2"></points>
    <tag label="scene"><attribute name="weather">rainy</attribute></tag>
  </image>
  <image id="1" name="gone.png" width="80" height="48"></image>
</annotations>
"""


@pytest.mark.parametrize(("edges", "columns"), [(False, [49, 50, 53, 54]), (True, [51, 52])])
def test_shapes(tmp_path: Path, edges: bool, columns: list[int]) -> None:
    (tmp_path / "annotations.xml").write_text(XML)
    cv2.imwrite(str(tmp_path / "one.png"), np.zeros((*SIZE, 3), np.uint8))
    source = read_cvat(tmp_path, LabelMapping(lane_edges=edges))
    assert source.found == ("val: 1 images", "1 listed images are not there")
    options = ConversionOptions(lane_width={"*": 2 * 1280 / SIZE[1]}, max_gap=100)
    report = convert(source, tmp_path / "out", options)
    sample = DrivingDataset(tmp_path / "out", "val")[0]
    assert sample.ignored.tolist() == [[1, 2, 5.5, 7]]
    assert sample.boxes is not None
    assert len(sample.boxes) == 0
    assert sample.drivable is not None
    assert sample.drivable.sum() == 400
    assert sample.lane is not None
    assert np.flatnonzero(sample.lane[25]).tolist() == columns
    assert sample.attributes["weather"] == "rainy"
    assert report.dropped["val"] == {"shape of kind 'points'": 1}


def test_errors(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no \.xml file"):
        read_cvat(tmp_path)
    path = tmp_path / "annotations.xml"
    for text in ("<annotations>", '<?xml version="1.0" encoding="utf-9"?><annotations/>'):
        path.write_text(text)
        with pytest.raises(DataError, match="not XML"):
            read_cvat(tmp_path)
    path.write_text('<annotations><track id="0" label="car"></track></annotations>')
    with pytest.raises(DataError, match="CVAT for video"):
        read_cvat(tmp_path)
    path.write_text(XML)
    with pytest.raises(DataError, match="none of the images"):
        read_cvat(tmp_path)


def read_shapes(
    tmp_path: Path, shapes: str, mapping: LabelMapping, size: str = 'width="80" height="48"'
) -> ImageRecord:
    """Read an image with these shapes."""
    (tmp_path / "annotations.xml").write_text(
        f'<annotations><image id="0" name="one.png" {size}>{shapes}</image></annotations>'
    )
    cv2.imwrite(str(tmp_path / "one.png"), np.zeros((*SIZE, 3), np.uint8))
    return read_cvat(tmp_path, mapping).record("train", "one")


def test_crowd_is_no_text(tmp_path: Path) -> None:
    """CVAT writes the attribute of every box, and its text 'false' would be true."""
    box = '<box label="car" xtl="1" ytl="2" xbr="9" ybr="7"><attribute name="crowd">{}</attribute></box>'
    record = read_shapes(tmp_path, "".join(map(box.format, ("false", "true"))), LabelMapping())
    assert record.objects is not None
    assert [(item.crowd, item.attributes["crowd"]) for item in record.objects] == [(False, False), (True, True)]
    convert(read_cvat(tmp_path), tmp_path / "out")
    content = json.loads((tmp_path / "out/det_annotations/train/one.json").read_text())
    assert [item["attributes"]["crowd"] for item in content["frames"][0]["objects"]] == [False, True]


@pytest.mark.parametrize(
    "shape",
    [
        '<polygon label="mud" points="10,20;30,20;30,40;10,40"></polygon>',
        '<mask label="mud" rle="0, 400" left="10" top="20" width="20" height="20"></mask>',
    ],
)
def test_ignored_shapes_are_area_and_object(tmp_path: Path, shape: str) -> None:
    record = read_shapes(tmp_path, shape, LabelMapping(ignore=("mud",), tasks=("detection", "drivable")))
    assert record.objects == (ObjectLabel("mud", (10, 20, 30, 40), crowd=True),)
    assert [area.kind for area in record.drivable or ()] == ["ignore"]  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("degrees", "corners"),
    [("90.0", (20, 10, 40, 50)), ("180", (10, 20, 50, 40)), ("315", (8.787, 8.787, 51.213, 51.213))],
)
def test_turned_boxes(tmp_path: Path, degrees: str, corners: tuple[float, ...]) -> None:
    box = f'<box label="car" xtl="10" ytl="20" xbr="50" ybr="40" rotation="{degrees}"></box>'
    record = read_shapes(tmp_path, box, LabelMapping())
    assert record.objects is not None
    assert record.objects[0].box == pytest.approx(corners, abs=1e-3)


@pytest.mark.parametrize(("size", "images"), [('width="80" height="48"', 1), ("", 1), ('width="160" height="96"', 0)])
def test_labels_made_at_another_size_are_left_out(tmp_path: Path, size: str, images: int) -> None:
    read_shapes(tmp_path, '<box label="car" xtl="1" ytl="2" xbr="9" ybr="7"></box>', LabelMapping(), size)
    assert convert(read_cvat(tmp_path), tmp_path / "out").images == {"train": images}


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ('<polygon label="car" points="1;2;3;4"/>', "polygon of label 'car': points must be numbers 'x,y;x,y;...'"),
        ('<polygon label="car" points="1,2,3;4,5,6"/>', "polygon of label 'car': points must be numbers"),
        ('<polygon label="car" points="1,2;3"/>', "polygon of label 'car': points must be numbers"),
        ('<polyline label="lane" points=""/>', "polyline of label 'lane': points must be numbers"),
        ('<box label="car" xtl="x" ytl="2" xbr="9" ybr="7"/>', "box of label 'car': xtl, ytl, xbr, ybr and rotation"),
        ('<box label="car" xtl="1" ytl="2" xbr="9"/>', "box of label 'car': xtl, ytl, xbr, ybr and rotation"),
        ('<mask label="car" rle="" left="1" top="2" width="3" height="4"/>', "mask of label 'car': left, top, width"),
        ('<box label="car" z_order="x"/>', "not as CVAT has it"),
    ],
)
def test_an_image_with_a_broken_shape_is_left_out_and_named(tmp_path: Path, shape: str, message: str) -> None:
    with pytest.raises(DataError, match=f"image 'one.png', {message}"):
        read_shapes(tmp_path, shape, LabelMapping())
    report = convert(read_cvat(tmp_path), tmp_path / "out")
    assert report.dropped["train"] == {"image: labels or image broken": 1}


def test_labels_that_all_mean_nothing_are_refused(tmp_path: Path) -> None:
    box = '<box label="{}" xtl="1" ytl="2" xbr="9" ybr="7"></box>'
    with pytest.raises(DataError, match=r"none of its categories \('Car'\) .* --classes FILE"):
        read_shapes(tmp_path, box.format("Car"), LabelMapping())
    assert read_shapes(tmp_path, box.format("Car") + box.format("car"), LabelMapping()).objects
    assert read_shapes(tmp_path, "", LabelMapping()).objects is None


@pytest.mark.parametrize("missing", [None, "empty", "unlabelled"])
def test_images_that_nobody_has_labelled(tmp_path: Path, missing: Literal["empty", "unlabelled"] | None) -> None:
    box, area = '<box label="{}" xtl="1" ytl="2" xbr="9" ybr="7"/>', '<polygon label="{}" points="1,2;30,2;30,40"/>'
    shapes = {
        "all": box.format("car") + area.format("drivable") + '<polyline label="lane" points="50,5;50,45"/>',
        "boxes": box.format("car"),
        "areas": area.format("drivable"),
        "others": box.format("tree") + area.format("mud"),
        "none": '<tag label="scene"/>',
    }
    images = [f'<image name="{name}.png" width="80" height="48">{text}</image>' for name, text in shapes.items()]
    (tmp_path / "annotations.xml").write_text(f"<annotations>{''.join(images)}</annotations>")
    for name in shapes:
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((*SIZE, 3), np.uint8))
    source = read_cvat(tmp_path, LabelMapping(ignore=("mud",), missing=missing))
    told = "train: 1 images without any label are taken as looked at, with nothing there; 'missing: unlabelled'"
    assert [line.startswith(told) for line in source.found[1:]] == ([True] if missing is None else [])
    report = convert(source, tmp_path / "out")
    counts = (2, 2, 1) if missing == "unlabelled" else (5, 5, 5)
    assert report.labelled == {"train": dict(zip(TASKS, counts, strict=True))}
    sample = DrivingDataset(tmp_path / "out", "train")[2]
    assert sample.name == "boxes"
    assert sample.boxes is not None
    assert (sample.drivable is None) == (sample.lane is None) == (missing == "unlabelled")


def test_images_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    lines = []
    for folder in ("monday", "tuesday"):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "one.png"), np.zeros((*SIZE, 3), np.uint8))
        lines.append(f'<image name="{folder}/one.png" width="80" height="48"><tag label="road"/></image>')
    (tmp_path / "annotations.xml").write_text(f"<annotations>{''.join(lines)}</annotations>")
    assert read_cvat(tmp_path, LabelMapping(drivable=("road",))).names("train") == ["monday-one", "tuesday-one"]


def test_a_picture_is_not_that_of_another_image_of_its_name(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "one.png"), np.zeros((*SIZE, 3), np.uint8))
    for name, subset in (("monday/one.png", "train"), ("tuesday/one.png", "val")):
        image = f'<image name="{name}" subset="{subset}" width="80" height="48"><tag label="road"/></image>'
        (tmp_path / f"{subset}.xml").write_text(f"<annotations>{image}</annotations>")
    with pytest.raises(
        DataError, match=r"one\.png: is the only picture of both 'monday/one\.png' and 'tuesday/one\.png'"
    ):
        read_cvat(tmp_path, LabelMapping(drivable=("road",)))


def test_a_project_as_cvat_exports_it(tmp_path: Path) -> None:
    """Pictures are in a folder a subset, called as in CVAT, and frames of a video are named without their ending."""
    lines = []
    for subset, file in (("default", "frame_000000.PNG"), ("Validation", "frame_000000.PNG"), ("Night", "one.jpg")):
        (tmp_path / "images" / subset).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "images" / subset / file), np.zeros((*SIZE, 3), np.uint8))
        name = file.removesuffix(".PNG")
        lines.append(f'<image name="{name}" subset="{subset}" width="80" height="48"><tag label="road"/></image>')
    (tmp_path / "annotations.xml").write_text(f"<annotations>{''.join(lines)}</annotations>")
    source = read_cvat(tmp_path, LabelMapping(drivable=("road",)))
    assert {split: source.names(split) for split in source.splits} == {
        "train": ["frame_000000"],
        "val": ["frame_000000"],
        "night": ["one"],
    }
    assert source.record("val", "frame_000000").image == tmp_path / "images/Validation/frame_000000.PNG"


def test_hidden_files_are_passed_over(tmp_path: Path) -> None:
    (tmp_path / "._annotations.xml").write_bytes(b"\0\5\26\7")
    assert read_shapes(tmp_path, '<box label="car" xtl="1" ytl="2" xbr="9" ybr="7"></box>', LabelMapping()).objects
