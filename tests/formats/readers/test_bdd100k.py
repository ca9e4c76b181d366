from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tests.formats.readers import raw_bdd
from trilitenet.data.converting import ConversionOptions, convert
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.records import MaskFile
from trilitenet.errors import DataError
from trilitenet.formats.readers import bdd100k
from trilitenet.formats.readers.bdd100k import parse_labels, read_bdd100k

OPTIONS = ConversionOptions(lane_width={"*": raw_bdd.WIDTH_AT_1280}, max_gap=100.0)

FORMS: dict[str, Callable[[Path], None]] = {
    "2018 one file an image": raw_bdd.write_2018_documents,
    "2018 merged": raw_bdd.write_2018_merged,
    "2020": raw_bdd.write_2020,
}


@pytest.fixture(params=FORMS)
def raw(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    root = tmp_path / "bdd100k"
    raw_bdd.write_images(root)
    FORMS[request.param](root)
    return root


def test_masks_agree_pixel_for_pixel(raw: Path, tmp_path: Path) -> None:
    report = convert(read_bdd100k(raw), tmp_path / "out", OPTIONS)
    drivable = cv2.imread(str(tmp_path / "out/da_seg_annotations/train/a1.png"), cv2.IMREAD_UNCHANGED)
    lane = cv2.imread(str(tmp_path / "out/ll_seg_annotations/train/a1.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(drivable, raw_bdd.drivable_truth())
    np.testing.assert_array_equal(lane, raw_bdd.lane_truth())
    assert report.images == {"train": 2, "val": 1}
    assert report.lanes["train"] == {"pairs": 2, "single lines": 1}
    assert report.dropped["train"]["lane: crosswalk"] == 1
    assert report.dropped["train"]["lane: across the road"] == 1
    assert report.dropped["train"]["object: box empty or outside the image"] == 1


def test_boxes_and_attributes(raw: Path, tmp_path: Path) -> None:
    report = convert(read_bdd100k(raw), tmp_path / "out", OPTIONS)
    sample = DrivingDataset(tmp_path / "out", "train")[0]
    assert sample.name == "a1"
    assert sample.boxes is not None
    np.testing.assert_array_equal(sample.boxes[0], [50, 20, 64, 30])
    assert len(sample.boxes) == 4  # car, truck, bus, train
    assert report.objects["train"] == {"vehicle": 4}
    assert raw_bdd.ATTRIBUTES.items() <= sample.attributes.items()
    assert sum(count for reason, count in report.dropped["train"].items() if "not in a class" in reason) == 6


def test_missing_labels_stay_missing(raw: Path, tmp_path: Path) -> None:
    convert(read_bdd100k(raw), tmp_path / "out", OPTIONS)
    sample = DrivingDataset(tmp_path / "out", "train")[1]
    assert sample.boxes is None
    assert sample.drivable is None
    if (raw / "labels/lane").exists():
        # The 2020 lane file lists a2 without labels: labelled, and no marking in it.
        assert sample.lane is not None
        assert not sample.lane.any()
    else:
        assert sample.lane is None


@pytest.mark.parametrize("kind", ["ids 2018", "ids 2020", "colours 2018", "colours 2020"])
@pytest.mark.parametrize("keep", [False, True])
def test_drivable_masks_of_every_kind(tmp_path: Path, kind: str, keep: bool) -> None:
    raw = tmp_path / "raw"
    raw_bdd.write_images(raw)
    raw_bdd.write_2020(raw, polygons=False, masks=kind)
    options = ConversionOptions(keep_alternative=keep)
    convert(read_bdd100k(raw), tmp_path / "out", options)
    mask = cv2.imread(str(tmp_path / "out/da_seg_annotations/train/a1.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask, raw_bdd.drivable_truth(alternative=127 if keep else 255))
    dataset = DrivingDataset(tmp_path / "out", "train")
    np.testing.assert_array_equal(dataset[0].drivable, raw_bdd.drivable_truth() // 255)
    assert dataset.description.drivable.values == ({255: "direct", 127: "alternative"} if keep else {255: "drivable"})
    assert dataset[1].drivable is None


@pytest.mark.parametrize("kind", ["ids 2018", "ids 2020"])
def test_values_that_the_masks_of_bdd100k_do_not_have_are_told(tmp_path: Path, kind: str) -> None:
    raw_bdd.write_images(tmp_path)
    raw_bdd.write_2020(tmp_path, polygons=False, masks=kind)
    (path,) = tmp_path.rglob("a1*.png")
    mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert mask is not None
    for value, count in ((0, 0), (3, 1)):
        mask[0] = value
        cv2.imwrite(str(path), mask)
        report = convert(read_bdd100k(tmp_path), tmp_path / "out")
        assert report.dropped["train"].get("drivable: values of a mask that nothing explains", 0) == count


def test_several_entries_of_one_image_are_told(tmp_path: Path) -> None:
    raw_bdd.write_images(tmp_path)
    entries: list[dict[str, Any]] = [{"name": name, "labels": []} for name in ("one/a1.jpg", "two/a1.jpg", "a2.jpg")]
    write_entries(tmp_path / "labels/det_20/det_train.json", entries)
    source = read_bdd100k(tmp_path)
    with pytest.raises(DataError, match=r"det_train\.json: has several entries called 'a1'"):
        source.record("train", "a1")
    assert source.record("train", "a2").objects == ()


def test_polygons_can_keep_two_areas(raw: Path, tmp_path: Path) -> None:
    convert(read_bdd100k(raw), tmp_path / "out", ConversionOptions(keep_alternative=True))
    mask = cv2.imread(str(tmp_path / "out/da_seg_annotations/train/a1.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask, raw_bdd.drivable_truth(alternative=127))


def test_crosswalks_and_stop_lines_by_option(raw: Path, tmp_path: Path) -> None:
    both = ConversionOptions(lane_width={"*": raw_bdd.WIDTH_AT_1280}, max_gap=100.0, crosswalk=True, vertical=True)
    convert(read_bdd100k(raw), tmp_path / "out", both)
    lane = cv2.imread(str(tmp_path / "out/ll_seg_annotations/train/a1.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(lane, raw_bdd.lane_truth(crosswalk=True, vertical=True))


def test_lane_masks_of_2020_are_read_where_there_are_no_polygons(tmp_path: Path) -> None:
    raw = tmp_path / "raw"
    raw_bdd.write_images(raw)
    raw_bdd.write_2020(raw, polygons=False)
    folder = raw / "labels/lane/masks/train"
    folder.mkdir(parents=True)
    mask = np.full(raw_bdd.SIZE, 255, np.uint8)
    mask[1] = 0  # crosswalk
    mask[2] = 6 | 16  # single white, dashed
    mask[3] = 6 | 32  # single white across the road
    cv2.imwrite(str(folder / "a1.png"), mask)
    cv2.imwrite(str(folder / "a2.png"), np.full(raw_bdd.SIZE, 255, np.uint8))
    report = convert(read_bdd100k(raw), tmp_path / "out")
    assert not [reason for reason in report.dropped["train"] if "nothing explains" in reason]
    lane = cv2.imread(str(tmp_path / "out/ll_seg_annotations/train/a1.png"), cv2.IMREAD_UNCHANGED)
    assert np.flatnonzero(np.asarray(lane).any(axis=1)).tolist() == [2]
    assert report.lanes["train"] == {"masks": 2}


def test_index_of_a_large_file_survives_chunk_borders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = tmp_path / "raw"
    raw_bdd.write_images(raw)
    raw_bdd.write_2018_merged(raw)
    whole = read_bdd100k(raw).record("train", "a1")
    monkeypatch.setattr("trilitenet.formats.readers.bdd100k._CHUNK", 61)
    pieces = read_bdd100k(raw).record("train", "a1")
    assert pieces.objects == whole.objects


def test_label_files_of_other_names_are_told(tmp_path: Path) -> None:
    raw_bdd.write_images(tmp_path)
    raw_bdd.write_2020(tmp_path)
    assert not [line for line in read_bdd100k(tmp_path).found if "not read" in line]
    path = tmp_path / "labels/det_20/det_train.json"
    path.rename(path.with_name("det_v2_train_release.json"))
    source = read_bdd100k(tmp_path)
    assert source.record("train", "a1").objects is None
    assert source.found[-1].endswith("no images): labels/det_20/det_v2_train_release.json")
    newer = tmp_path / "labels/det_21/det_val.json"
    newer.parent.mkdir()
    shutil.copy(tmp_path / "labels/det_20/det_val.json", newer)
    found = read_bdd100k(tmp_path).found[-1]
    assert found.startswith("not read (another of that name is, ")
    assert found.endswith("): labels/det_20/det_v2_train_release.json, labels/det_20/det_val.json")


def test_errors_name_the_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        read_bdd100k(tmp_path / "nowhere")
    with pytest.raises(DataError, match="no BDD100K images"):
        read_bdd100k(tmp_path)
    raw_bdd.write_images(tmp_path)
    raw_bdd.write_2018_merged(tmp_path)
    path = tmp_path / "labels/bdd100k_labels_images_train.json"
    path.write_text(path.read_text()[:-40])
    with pytest.raises(DataError, match=r"bdd100k_labels_images_train\.json"):
        read_bdd100k(tmp_path)
    path.write_text('[{"name": ' + "[" * 500_000)
    with pytest.raises(DataError, match="nested too deeply"):
        read_bdd100k(tmp_path)
    path.write_text('"hello"')
    with pytest.raises(DataError, match="neither a list"):
        read_bdd100k(tmp_path)
    with pytest.raises(DataError, match="neither 'frames'"):
        parse_labels({"hello": 1}, Path("x.jpg"), "x.json")
    with pytest.raises(DataError, match="not as BDD100K has it"):
        parse_labels({"labels": [{"category": "car", "box2d": {"x1": 1}}]}, Path("x.jpg"), "x.json")
    box = {"x1": 1, "y1": 1, "x2": 10**400, "y2": 2}
    with pytest.raises(DataError, match="not as BDD100K has it"):
        parse_labels({"labels": [{"category": "car", "box2d": box}]}, Path("x.jpg"), "x.json")


@pytest.mark.parametrize(
    "content",
    [
        '{"name": "a2"',
        '{"name": "a2", "attributes": 1}',
        '{"frames": 1}',
        '{"frames": [null]}',
        '{"frames": [{"objects": [7]}]}',
        '{"labels": 1}',
        "[]",
    ],
)
def test_a_broken_document_is_counted_and_the_rest_converted(tmp_path: Path, content: str) -> None:
    raw = tmp_path / "raw"
    raw_bdd.write_images(raw)
    raw_bdd.write_2018_documents(raw)
    (raw / "labels/100k/train/a2.json").write_text(content)
    report = convert(read_bdd100k(raw), tmp_path / "out")
    assert report.images == {"train": 1, "val": 1}
    assert report.dropped["train"]["image: labels or image broken"] == 1


def test_labels_that_the_first_documents_lack_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bdd100k, "_DOCUMENTS_LOOKED_AT", 1)
    raw_bdd.write_images(tmp_path)
    raw_bdd.write_2018_documents(tmp_path)
    folder = tmp_path / "labels/100k/train"
    content = json.loads((folder / "a1.json").read_text())
    (folder / "a2.json").write_text(json.dumps(content | {"name": "a2"}))
    items = content["frames"][0]["objects"]
    content["frames"][0]["objects"] = [item for item in items if item["category"].startswith("area/")]
    (folder / "a1.json").write_text(json.dumps(content))
    source = read_bdd100k(tmp_path)
    first, second = (source.record("train", name) for name in ("a1", "a2"))
    assert (first.objects, first.lane) == (None, None)
    assert len(second.objects or ()) == len(raw_bdd.boxes(raw_bdd.CATEGORIES_OLD))
    assert second.drivable
    assert second.lane


@pytest.mark.parametrize("key", ["crowd", "ignored"])
def test_crowd_may_be_text(key: str) -> None:
    box = {"x1": 1, "y1": 2, "x2": 3, "y2": 4}
    values = (True, "true", False, "false", None)
    labels = [{"category": "car", "box2d": box, "attributes": {key: value}} for value in values]
    objects = parse_labels({"labels": labels}, Path("x.jpg"), "x.json").objects
    assert objects is not None
    assert [item.crowd for item in objects] == [True, True, False, False, False]


@pytest.mark.parametrize("ascii_only", [False, True])
def test_names_beyond_ascii_keep_their_labels(tmp_path: Path, ascii_only: bool) -> None:
    raw = tmp_path / "raw"
    raw_bdd.write_images(raw)
    raw_bdd.write_2018_merged(raw)
    path = raw / "labels/bdd100k_labels_images_train.json"
    content = json.loads(path.read_text().replace("a1.jpg", "stra\u00dfe \u65e5.jpg"))
    path.write_text(json.dumps(content, ensure_ascii=ascii_only), encoding="utf-8")
    (raw / "images/100k/train/a1.jpg").rename(raw / "images/100k/train/stra\u00dfe \u65e5.jpg")
    assert read_bdd100k(raw).record("train", "stra\u00dfe \u65e5").objects


def test_two_images_of_one_name_are_told_and_a_copy_is_not(tmp_path: Path) -> None:
    root = tmp_path / "bdd100k"
    raw_bdd.write_images(root)
    raw_bdd.write_2020(root)
    folder = next(path for path in root.rglob("train") if "images" in path.parts)
    other = root / "more" / folder.relative_to(root)
    shutil.copytree(folder, other)
    assert read_bdd100k(root).names("train") == ["a1", "a2"]
    cv2.imwrite(str(next(other.glob("a1.*"))), np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(DataError, match="two images are called 'a1'"):
        read_bdd100k(root)


AREA = {"category": "drivable area", "poly2d": raw_bdd.new_poly(raw_bdd.DIRECT, "LLLL", closed=True)}
LANE = {"category": "lane", "attributes": {"laneType": "single white"}}


def test_what_is_not_said_of_areas_and_lanes() -> None:
    ring = {**LANE, "poly2d": raw_bdd.new_poly(raw_bdd.DIRECT, "LLLL", closed=True)}
    edge = {**LANE, "poly2d": raw_bdd.new_poly(raw_bdd.CURB, "LL", closed=False)}
    point = {**LANE, "poly2d": raw_bdd.new_poly([[1.0, 2.0]], "L", closed=False)}
    thin = {**AREA, "poly2d": raw_bdd.new_poly(raw_bdd.CURB, "LL", closed=True)}
    record = parse_labels({"labels": [AREA, ring, edge, point, thin]}, Path("x.jpg"), "x.json")
    assert record.drivable is not None
    assert record.lane is not None
    assert [area.kind for area in record.drivable] == ["direct"]  # type: ignore[union-attr]
    assert [(lane.category, lane.closed, lane.edge) for lane in record.lane] == [  # type: ignore[union-attr]
        ("single white", True, False),
        ("single white", False, True),
    ]
    assert record.dropped == {"lane with too few points": 1, "area with too few points": 1}


def write_entries(path: Path, entries: list[dict[str, Any]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(entries))


def test_the_first_of_several_files_is_believed(tmp_path: Path) -> None:
    raw_bdd.write_images(tmp_path)
    raw_bdd.write_2020(tmp_path, masks="ids 2020")
    write_entries(
        tmp_path / "labels/lane/polygons/lane_train.json",
        [{"name": "a1.jpg", "attributes": {"weather": "clear", "lanes": "4", "sequence": None}, "labels": []}],
    )
    record = read_bdd100k(tmp_path).record("train", "a1")
    assert record.attributes == {**raw_bdd.ATTRIBUTES, "lanes": "4"}
    assert isinstance(record.drivable, tuple)  # polygons before masks
    assert record.lane == ()


def test_a_file_is_of_the_task_that_its_name_says(tmp_path: Path) -> None:
    raw_bdd.write_images(tmp_path)
    write_entries(tmp_path / "labels/det_20/det_train.json", [{"name": "a1.jpg", "labels": []}])
    source = read_bdd100k(tmp_path)
    assert "labels from labels/det_20/det_train.json (detection)" in source.found[0]
    assert source.record("train", "a1").objects == ()
    assert source.record("train", "a2").objects is None


def test_the_later_of_two_releases_is_read(tmp_path: Path) -> None:
    raw_bdd.write_images(tmp_path)
    for release, category in (("det_19", "car"), ("det_20", "bus")):
        label = {"category": category, "box2d": {"x1": 1, "y1": 2, "x2": 9, "y2": 9}}
        write_entries(tmp_path / f"labels/{release}/det_train.json", [{"name": "a1.jpg", "labels": [label]}])
    objects = read_bdd100k(tmp_path).record("train", "a1").objects
    assert objects is not None
    assert [item.category for item in objects] == ["bus"]


def test_a_file_that_is_passed_over_for_another_is_told(tmp_path: Path) -> None:
    raw_bdd.write_images(tmp_path)
    for release in ("det_19", "det_20"):
        write_entries(tmp_path / f"labels/{release}/det_train.json", [{"name": "a1.jpg", "labels": []}])
    told = "of several files of one kind, labels/det_20/det_train.json is read, not labels/det_19/det_train.json"
    assert f"train: {told}" in read_bdd100k(tmp_path).found


def shapeless(category: str) -> dict[str, Any]:
    return {"category": category, "rle": {"counts": "abc", "size": [*raw_bdd.SIZE]}}


def test_run_lengths_beside_polygons_do_not_disturb(tmp_path: Path) -> None:
    raw_bdd.write_images(tmp_path)
    raw_bdd.write_2020(tmp_path)
    before = read_bdd100k(tmp_path)
    for folder, name, category in (
        ("drivable/rles", "drivable", "direct"),
        ("lane/rles", "lane", "single white"),
        ("det_20/rles", "det", "car"),
        ("ins_seg/polygons", "ins_seg", "car"),
        ("pan_seg/polygons", "pan_seg", "road"),
    ):
        entry = {"name": "a1.jpg", "labels": [shapeless(category)]}
        write_entries(tmp_path / f"labels/{folder}/{name}_train.json", [entry])
    source = read_bdd100k(tmp_path)
    assert source.found[:-1] == before.found
    assert source.found[-1].startswith("not read (")
    record = source.record("train", "a1")
    assert record.objects
    assert isinstance(record.drivable, tuple)
    assert len(record.drivable) == 2
    assert record.lane
    assert not record.dropped


@pytest.mark.parametrize("form", ["one file a task", "one file for all", "one file an image"])
def test_labels_without_a_shape_are_no_empty_ones(tmp_path: Path, form: str) -> None:
    raw_bdd.write_images(tmp_path)
    raw_bdd.write_2020(tmp_path, polygons=False, masks="ids 2020")
    (tmp_path / "labels/det_20/det_train.json").unlink()
    labels = [shapeless("car"), shapeless("direct"), shapeless("single white")]
    entry = {"name": "a1.jpg", "labels": labels}
    if form == "one file a task":
        for name, label in zip(("det_20/det", "drivable/drivable", "lane/lane"), labels, strict=True):
            write_entries(tmp_path / f"labels/{name}_train.json", [{**entry, "labels": [label]}])
    elif form == "one file for all":
        write_entries(tmp_path / "labels/bdd100k_labels_images_train.json", [entry, {"name": "a2.jpg", "labels": []}])
    else:
        folder = tmp_path / "labels/100k/train"
        folder.mkdir(parents=True)
        for name, objects in (("a1", labels), ("a2", [])):
            (folder / f"{name}.json").write_text(json.dumps({"name": name, "frames": [{"objects": objects}]}))
    source = read_bdd100k(tmp_path)
    record, other = (source.record("train", name) for name in ("a1", "a2"))
    assert (record.objects, record.lane) == (None, None)
    assert isinstance(record.drivable, MaskFile)
    assert sum(record.dropped.values()) == 3
    assert (other.objects, other.drivable, other.lane) == (None, None, None)


def test_one_label_without_a_shape_leaves_the_others(tmp_path: Path) -> None:
    unknown = {"category": "area/unknown"}
    record = parse_labels({"labels": [AREA, shapeless("direct"), unknown]}, Path("x.jpg"), "x.json")
    assert len(record.drivable or ()) == 1  # type: ignore[arg-type]
    assert record.objects == ()
    assert parse_labels({"labels": [unknown]}, Path("x.jpg"), "x.json").drivable == ()


def test_documents_are_of_all_the_tasks_that_any_of_them_has(tmp_path: Path) -> None:
    raw_bdd.write_images(tmp_path)
    box = {"category": "car", "box2d": {"x1": 1, "y1": 2, "x2": 9, "y2": 9}}
    lane = {"category": "lane/road curb", "poly2d": raw_bdd.old_poly(raw_bdd.CURB, "LL")}
    for name, objects in (("a1", [box]), ("a2", [lane])):
        path = tmp_path / f"labels/100k/train/{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"name": name, "frames": [{"objects": objects}]}))
    first, second = (read_bdd100k(tmp_path).record("train", name) for name in ("a1", "a2"))
    assert (first.lane, second.objects, first.drivable) == ((), (), None)
    assert first.objects
    assert second.lane


def test_folders_that_are_links_are_followed_and_hidden_ones_are_not_looked_at(tmp_path: Path) -> None:
    root = tmp_path / "root"
    raw_bdd.write_images(tmp_path / "elsewhere")
    root.mkdir()
    (root / "images").symlink_to(tmp_path / "elsewhere" / "images")
    raw_bdd.write_2020(root)
    raw_bdd.write_images(root / ".trash")
    cv2.imwrite(str(root / ".trash/images/100k/train/a1.jpg"), np.zeros((9, 9, 3), np.uint8))
    assert read_bdd100k(root).names("train") == ["a1", "a2"]


def test_curves_are_curves_in_both_forms() -> None:
    points = [[0.0, 0.0], [0.0, 40.0], [40.0, 40.0], [40.0, 0.0]]
    forms = [raw_bdd.old_poly(points, "LCCC"), raw_bdd.new_poly(points, "LCCC", closed=False)]
    lanes = [parse_labels({"labels": [{**LANE, "poly2d": form}]}, Path("x.jpg"), "x.json").lane for form in forms]
    old, new = (np.asarray(lane[0].points) for lane in lanes if isinstance(lane, tuple))  # type: ignore[union-attr]
    np.testing.assert_array_equal(old, new)
    assert np.abs(old - (20, 30)).sum(axis=1).min() < 1  # a cubic is there half-way: (0 + 3 x 40 + 3 x 40 + 0) / 8
    assert old[:, 1].max() < 31


def test_pictures_among_the_labels_are_no_images(tmp_path: Path) -> None:
    (tmp_path / "labels" / "train").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "labels" / "train" / "a1.jpg"), np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(DataError, match="no BDD100K images"):
        read_bdd100k(tmp_path)


@pytest.mark.parametrize(
    "place", ["labelled/bdd100k/images/100k", "my_labels/images/100k", "labelled/100k", "labelled"]
)
def test_images_may_be_in_a_folder_called_labelled(tmp_path: Path, place: str) -> None:
    raw_bdd.write_images(tmp_path, prefix=place)
    assert read_bdd100k(tmp_path).names("train") == ["a1", "a2"]


@pytest.mark.parametrize("moved", [{"a2": "trainA"}, {"a1": "trainA", "a2": "testB/more"}])
def test_images_in_folders_below_that_of_their_split_are_found(tmp_path: Path, moved: dict[str, str]) -> None:
    raw_bdd.write_images(tmp_path)
    raw_bdd.write_2018_merged(tmp_path)
    folder = tmp_path / "images/100k/train"
    for name, where in moved.items():
        (folder / where).mkdir(parents=True)
        (folder / f"{name}.jpg").rename(folder / where / f"{name}.jpg")
    source = read_bdd100k(tmp_path)
    assert {split: source.names(split) for split in source.splits} == {"train": ["a1", "a2"], "val": ["b1"]}
    assert source.record("train", "a1").objects
    own = source.record("train", "a1").image
    twin = own.with_suffix(".jpeg")
    twin.write_bytes(own.read_bytes() + b" ")
    with pytest.raises(DataError, match="two images are called 'a1'"):
        read_bdd100k(tmp_path)
    twin.unlink()
    other = folder / "other"
    other.mkdir()
    cv2.imwrite(str(other / "a1.jpg"), np.zeros((9, 9, 3), np.uint8))
    if own.parent == folder:  # below it is a small copy, or a picture of its labels
        assert read_bdd100k(tmp_path).record("train", "a1").image == own
    else:
        with pytest.raises(DataError, match="two images are called 'a1'"):
            read_bdd100k(tmp_path)


def test_images_may_be_beside_their_annotations(tmp_path: Path) -> None:
    raw_bdd.write_2018_merged(tmp_path)
    for split, name in (("train", "a1"), ("val", "b1")):
        path = tmp_path / f"{split}/annotations/bdd100k_labels_images_{split}.json"
        path.parent.mkdir(parents=True)
        (tmp_path / f"labels/{path.name}").rename(path)
        for folder, width in (("images", 9), ("labels", 900)):  # the latter of drawn ones
            (tmp_path / split / folder).mkdir()
            cv2.imwrite(str(tmp_path / split / folder / f"{name}.jpg"), np.zeros((9, width, 3), np.uint8))
    source = read_bdd100k(tmp_path)
    assert [source.names(split) for split in source.splits] == [["a1"], ["b1"]]
    assert source.record("train", "a1").image.parent.name == "images"
    assert source.record("train", "a1").objects


def test_a_folder_above_that_of_another_split_is_none_of_a_split(tmp_path: Path) -> None:
    raw_bdd.write_images(tmp_path / "test/bdd100k")
    assert read_bdd100k(tmp_path).splits == ("train", "val")


def test_labels_without_images_and_images_without_labels_are_counted(raw: Path) -> None:
    folder = raw / "images/100k/train"
    (folder / "a1.jpg").rename(folder / "a3.jpg")
    found = read_bdd100k(raw).found
    lane = (raw / "labels/lane").exists()  # whose file lists a2, too
    assert "train: labels of 1 images that are not there, such as a1" in found
    assert f"train: {1 if lane else 2} images that no label file has, such as {'a3' if lane else 'a2'}" in found


@pytest.mark.parametrize("kind", ["ids 2018", "ids 2020"])
def test_masks_without_images_are_counted(tmp_path: Path, kind: str) -> None:
    raw_bdd.write_images(tmp_path)
    raw_bdd.write_masks(tmp_path, kind)
    lane = tmp_path / "lane/masks/train/a4.png"
    lane.parent.mkdir(parents=True)
    for path in (lane, lane.with_name("._a5.png")):
        path.touch()
    told = "train: labels of {} images that are not there, such as {}".format
    assert told(1, "a4") in read_bdd100k(tmp_path).found
    (tmp_path / "images/100k/train/a1.jpg").unlink()
    found = read_bdd100k(tmp_path).found
    assert told(2, "a1") in found
    assert "train: 1 images that no label file has, such as a2" in found
    assert not [line for line in found if line.startswith("val: ") and "no label file" in line]  # told as 'nowhere'


def test_hidden_files_are_passed_over(tmp_path: Path) -> None:
    raw_bdd.write_images(tmp_path)
    raw_bdd.write_2018_documents(tmp_path)
    before = read_bdd100k(tmp_path)
    for path in [path for path in tmp_path.rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"\0\5\26\7")
    for number in range(400):  # more than are looked at for what is labelled
        (tmp_path / f"labels/100k/train/._{number}.json").touch()
    source = read_bdd100k(tmp_path)
    assert source.found == before.found
    assert source.names("train") == before.names("train")
