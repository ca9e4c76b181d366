from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from trilitenet.formats.writers.cvat import CvatWriter, cvat_mask
from trilitenet.road.structures import Road
from trilitenet.structures import Perception

xmlschema = pytest.importorskip("xmlschema")
SCHEMA = Path(__file__).with_name("cvat-1.1.xsd")


def write(output: Path, perceptions: list[Perception]) -> ElementTree.Element:
    with CvatWriter(output) as writer:
        for perception in perceptions:
            writer.write(perception)
    (path,) = writer.files
    xmlschema.XMLSchema(SCHEMA).validate(path)
    return ElementTree.parse(path).getroot()


def decode(node: ElementTree.Element, size: tuple[int, int]) -> np.ndarray:
    """Decode CVAT's mask as CVAT's documentation describes it."""
    left, top, width, height = (int(node.attrib[name]) for name in ("left", "top", "width", "height"))
    inside: list[int] = []
    for index, run in enumerate(node.attrib["rle"].split(",")):
        inside += [index % 2] * int(run)
    mask = np.zeros(size, np.bool_)
    mask[top : top + height, left : left + width] = np.array(inside, np.bool_).reshape(height, width)
    return mask


def test_pictures(tmp_path: Path, pictures: list[Perception]) -> None:
    images = write(tmp_path, pictures).findall("image")
    assert [image.get("name") for image in images] == ["road.jpg", "night/road.jpg"]
    assert [box.get("label") for box in images[0].findall("box")] == ["vehicle", "rider & bike"]
    assert images[0].findall("box")[0].get("xtl") == "10.25"
    assert [mask.get("label") for mask in images[0].findall("mask")] == ["drivable", "lane"]
    for node, mask in zip(images[0].findall("mask"), (pictures[0].drivable, pictures[0].lane), strict=True):
        np.testing.assert_array_equal(decode(node, pictures[0].size), mask)
    assert len(images[1]) == 0
    assert [image.get("id") for image in images] == ["0", "1"]
    orders = {node.tag: node.get("z_order") for node in images[0]}
    assert orders == {"mask": "0", "box": "1"}  # boxes lie above what they stand on


def test_names_are_whatever_they_are(tmp_path: Path, pictures: list[Perception]) -> None:
    odd = dataclasses.replace(pictures[0], source='a&"<b>.jpg', class_names=("vehicle", 'rider & "bike" <2>'))
    (image,) = write(tmp_path, [odd]).findall("image")
    assert image.get("name") == 'a&"<b>.jpg'
    root = write(tmp_path / "video", [dataclasses.replace(odd, frame=0)])
    assert [box.get("label") for box in image.findall("box")] == ["vehicle", 'rider & "bike" <2>']
    assert 'rider & "bike" <2>' in {name.text for name in root.iter("name")}
    assert 'rider & "bike" <2>' in {track.get("label") for track in root.findall("track")}


def test_a_name_that_xml_cannot_hold_spoils_no_file(tmp_path: Path, pictures: list[Perception]) -> None:
    odd = dataclasses.replace(pictures[0], source="a\x01b\uffff\r\n.jpg", class_names=("vehicle", "bike\x00"))
    images = write(tmp_path, [odd, *pictures[1:]]).findall("image")
    assert images[0].get("name") == "a\\x01b\\uffff\r\n.jpg"
    assert [box.get("label") for box in images[0].findall("box")] == ["vehicle", "bike\\x00"]
    assert len(images) == len(pictures) > 1


def test_each_video_has_a_file(tmp_path: Path, video: list[Perception]) -> None:
    other = [dataclasses.replace(frame, source="other.mp4") for frame in video[:2]]
    with CvatWriter(tmp_path) as writer:
        for frame in [*video, *other]:
            writer.write(frame)
    sizes = {path.name: ElementTree.parse(path).getroot().findtext("meta/task/size") for path in writer.files}
    assert sizes == {"drive.cvat-video.xml": "4", "other.cvat-video.xml": "2"}


def test_polygons_of_a_video_are_in_the_middle_of_pixels(tmp_path: Path) -> None:
    mask = np.zeros((20, 30), np.bool_)
    mask[5:15, 10:21] = True
    root = write(tmp_path, [Perception((20, 30), drivable=mask, source="a.mp4", frame=0)])
    (polygon,) = root.iter("polygon")
    points = {tuple(map(float, point.split(","))) for point in polygon.attrib["points"].split(";")}
    assert points == {(10.5, 5.5), (10.5, 14.5), (20.5, 14.5), (20.5, 5.5)}
    assert polygon.get("z_order") == "0"


@pytest.mark.parametrize(
    ("kept", "labels"),
    [("boxes", {"vehicle", "rider & bike"}), ("drivable", {"drivable"}), ("lane", {"lane", "lane line"})],
)
def test_what_was_not_looked_for_has_no_label(
    tmp_path: Path, pictures: list[Perception], kept: str, labels: set[str]
) -> None:
    others: dict[str, Any] = {field: None for field in ("boxes", "drivable", "lane") if field != kept}
    root = write(tmp_path, [dataclasses.replace(pictures[0], **others)])
    assert {name.text for name in root.findall("meta/task/labels/label/name")} == labels


def test_video_ends_tracks_where_they_end(tmp_path: Path, video: list[Perception]) -> None:
    root = write(tmp_path, video)
    tracks = root.findall("track")
    vehicle = next(track for track in tracks if track.get("label") == "vehicle")
    assert [(box.get("frame"), box.get("outside")) for box in vehicle] == [
        ("0", "0"),
        ("1", "0"),
        ("2", "1"),
        ("3", "0"),
    ]
    riders = [track for track in tracks if track.get("label") == "rider & bike"]
    assert len(riders) == 4, "a box without identity is a track of its own"
    lanes = [track for track in tracks if track.get("label") == "lane"]
    assert len(lanes) == 2
    assert [(shape.get("frame"), shape.get("outside")) for shape in lanes[0]][-1] == ("3", "1")
    assert root.findtext("meta/task/size") == "4"


def test_a_track_that_changes_its_class_is_two(tmp_path: Path, video: list[Perception]) -> None:
    boxes = video[1].boxes
    assert boxes is not None
    changed = dataclasses.replace(video[1], boxes=dataclasses.replace(boxes, class_id=1 - boxes.class_id))
    tracks = [track for track in write(tmp_path, [video[0], changed]).findall("track") if track.find("box") is not None]
    assert sorted(track.get("label") or "" for track in tracks) == ["rider & bike"] * 2 + ["vehicle"] * 2


def test_skipped_frames_do_not_hide_a_track(tmp_path: Path, video: list[Perception]) -> None:
    vehicle = next(t for t in write(tmp_path, [video[0], video[3]]).findall("track") if t.get("label") == "vehicle")
    assert [(box.get("frame"), box.get("outside")) for box in vehicle] == [("0", "0"), ("3", "0")]


def test_mask_runs_by_hand() -> None:
    mask = np.array([[0, 0, 0, 0], [0, 0, 1, 1], [0, 1, 1, 0]], np.bool_)
    assert cvat_mask(mask) == ("1, 4, 1", 1, 1, 3, 2)
    assert cvat_mask(np.ones((2, 2), np.bool_)) == ("0, 4", 0, 0, 2, 2)
    assert cvat_mask(np.zeros((2, 2), np.bool_)) is None


def test_datumaro_opens_it(tmp_path: Path, pictures: list[Perception]) -> None:
    datumaro = pytest.importorskip("datumaro")
    write(tmp_path, pictures[:1])
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "road.jpg"), np.zeros((*pictures[0].size, 3), np.uint8))
    (item,) = datumaro.Dataset.import_from(str(tmp_path), "cvat")
    kinds = [annotation.type.name for annotation in item.annotations]
    assert sorted(kinds) == ["bbox", "bbox", "mask", "mask"]
    mask = next(annotation for annotation in item.annotations if annotation.type.name == "mask")
    np.testing.assert_array_equal(mask.image.astype(bool), pictures[0].drivable)


def test_lines_of_lanes_are_polylines(
    tmp_path: Path, pictures: list[Perception], video: list[Perception], road: Road
) -> None:
    with CvatWriter(tmp_path) as writer:
        writer.write(pictures[0], road.to_dict())
        writer.write(video[0], road.to_dict())
    for path in writer.files:
        xmlschema.XMLSchema(SCHEMA).validate(path)
        (line,) = ElementTree.parse(path).getroot().iter("polyline")
        assert line.get("points") == "40.50,119.50;60.50,96.00;95.50,60.50"
