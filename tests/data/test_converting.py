from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any, ClassVar, Literal

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.formats.readers import raw_bdd
from trilitenet.data.converting import ConversionOptions, convert, drivable_mask, lane_mask
from trilitenet.data.description import DatasetDescription, MaskMeaning, read_description
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.records import (
    AreaLabel,
    CocoRuns,
    ImageRecord,
    LaneLabel,
    ListedRecords,
    MaskFile,
    ObjectLabel,
    RowRuns,
)
from trilitenet.errors import Claim, ConfigError, DataError, OutputError
from trilitenet.formats.readers.bdd100k import BddSource, read_bdd100k

Tree = dict[str, tuple[bytes, int]]


def tree(root: Path, *, times: bool = True) -> Tree:
    """Every file with its content and, if wanted, when it was last written."""
    return {
        path.relative_to(root).as_posix(): (path.read_bytes(), path.stat().st_mtime_ns if times else 0)
        for path in sorted(root.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    root = tmp_path / "raw"
    raw_bdd.write_images(root)
    raw_bdd.write_2020(root)
    # More images, so that there is a middle to stop in.
    for index in range(20):
        image = np.full((*raw_bdd.SIZE, 3), 10 * index, np.uint8)
        cv2.imwrite(str(root / f"images/100k/train/c{index:02}.jpg"), image)
    return root


class Interrupted:
    """A source that stops after some records, as a user's Ctrl-C does."""

    def __init__(self, source: BddSource, after: int) -> None:
        self._source = source
        self._left = after
        self.found = source.found
        self.splits = source.splits
        self.origin = source.origin

    def names(self, split: str) -> list[str]:
        return self._source.names(split)

    def record(self, split: str, name: str) -> ImageRecord:
        if not self._left:
            raise KeyboardInterrupt
        self._left -= 1
        return self._source.record(split, name)


def test_twice_changes_nothing(raw: Path, tmp_path: Path) -> None:
    first = convert(read_bdd100k(raw), tmp_path / "out")
    before = tree(tmp_path / "out")
    second = convert(read_bdd100k(raw), tmp_path / "out")
    assert tree(tmp_path / "out") == before
    assert first == second


@pytest.mark.parametrize("after", [0, 1, 7, 22])
def test_interrupted_and_run_again_ends_the_same(raw: Path, tmp_path: Path, after: int) -> None:
    whole = convert(read_bdd100k(raw), tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        convert(Interrupted(read_bdd100k(raw), after), tmp_path / "parts")
    # What a kill in the middle of writing leaves behind: half a line, half a file, a file without its line.
    journal = tmp_path / "parts/.conversion/train.jsonl"
    with journal.open("a") as file:
        file.write('{"name": "c0')
    (tmp_path / "parts/images/train/.c05.jpg.part").write_bytes(b"half")
    (tmp_path / "parts/ll_seg_annotations/train/c19.png").write_bytes(b"half")
    (tmp_path / "parts/ll_seg_annotations/train/c19.png").unlink()
    with contextlib.closing(Claim(tmp_path / "parts/conversion.json")):  # of the same call elsewhere
        with pytest.raises(OutputError, match="is being written already"):
            convert(read_bdd100k(raw), tmp_path / "parts")
        assert (tmp_path / "parts/images/train/.c05.jpg.part").exists()
    again = convert(read_bdd100k(raw), tmp_path / "parts")
    one, two = tree(tmp_path / "whole", times=False), tree(tmp_path / "parts", times=False)
    two["dataset.yaml"] = (two["dataset.yaml"][0].replace(b"name: parts", b"name: whole"), 0)
    assert one == two
    assert whole == again


def test_only_what_is_missing_is_made_again(raw: Path, tmp_path: Path) -> None:
    convert(read_bdd100k(raw), tmp_path / "out")
    before = tree(tmp_path / "out")
    (tmp_path / "out/ll_seg_annotations/train/a1.png").unlink()
    convert(read_bdd100k(raw), tmp_path / "out")
    after = tree(tmp_path / "out")
    changed = {name for name in before if after[name] != before[name]}
    assert changed <= {"ll_seg_annotations/train/a1.png", ".conversion/train.jsonl"}
    assert after["ll_seg_annotations/train/a1.png"][0] == before["ll_seg_annotations/train/a1.png"][0]


@pytest.mark.slow
def test_processes_make_the_same_files(raw: Path, tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    convert(read_bdd100k(raw), tmp_path / "one")
    convert(read_bdd100k(raw), tmp_path / "two", workers=2, progress=lambda done, total: steps.append((done, total)))
    one, two = tree(tmp_path / "one", times=False), tree(tmp_path / "two", times=False)
    del one["dataset.yaml"], two["dataset.yaml"]
    assert one == two
    assert steps[-1] == (23, 23)


def test_widths_differ_by_split(tmp_path: Path) -> None:
    raw = tmp_path / "raw"
    for split in ("train", "val"):
        (raw / "images/100k" / split).mkdir(parents=True)
        cv2.imwrite(str(raw / f"images/100k/{split}/x.jpg"), np.zeros((720, 1280, 3), np.uint8))
        path = raw / f"labels/lane/polygons/lane_{split}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        curb = {
            "category": "road curb",
            "poly2d": [{"vertices": [[300, 100], [300, 600]], "types": "LL", "closed": False}],
        }
        path.write_text(json.dumps([{"name": "x.jpg", "labels": [curb]}]))
    convert(read_bdd100k(raw), tmp_path / "out")
    widths = {
        split: int((DrivingDataset(tmp_path / "out", split)[0].lane[400] > 0).sum())  # type: ignore[index]
        for split in ("train", "val")
    }
    assert widths == {"train": 8, "val": 2}


def test_options_are_checked_and_kept(raw: Path, tmp_path: Path) -> None:
    for width in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="above 0 and finite"):
            ConversionOptions(lane_width={"*": width})
    for gap in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="max_gap must be finite and not negative"):
            ConversionOptions(max_gap=gap)
    with pytest.raises(DataError, match="both"):
        ConversionOptions(classes={"small": ("car",), "large": ("car",)})
    convert(read_bdd100k(raw), tmp_path / "out")
    with pytest.raises(OutputError, match="other options"):
        convert(read_bdd100k(raw), tmp_path / "out", ConversionOptions(crosswalk=True))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="not empty"):
        convert(read_bdd100k(raw), tmp_path / "mine")
    with pytest.raises(DataError, match="no split 'trian'"):
        convert(read_bdd100k(raw), tmp_path / "other", splits=["trian"])


def test_several_classes_and_ignored_categories(raw: Path, tmp_path: Path) -> None:
    classes = {"car": ("car",), "large": ("truck", "bus", "train"), "two-wheeler": ("bicycle", "motorcycle")}
    options = ConversionOptions(classes=classes, ignore=("rider",))
    report = convert(read_bdd100k(raw), tmp_path / "out", options)
    assert report.objects["train"] == {"car": 1, "large": 3, "two-wheeler": 2, "ignored": 1}
    dataset = DrivingDataset(tmp_path / "out", "train")
    assert dataset.class_names == ("car", "large", "two-wheeler")
    sample = dataset[0]
    assert sample.class_id is not None
    assert sample.class_id.tolist() == [0, 1, 1, 1, 2, 2]
    assert len(sample.ignored) == 1


@pytest.mark.parametrize("images", ["link", "copy", "symlink"])
def test_images_are_linked_or_copied(raw: Path, tmp_path: Path, images: str) -> None:
    options = dataclasses.replace(ConversionOptions(), images=images)  # type: ignore[arg-type]
    convert(read_bdd100k(raw), tmp_path / "out", options)
    source, target = raw / "images/100k/train/a1.jpg", tmp_path / "out/images/train/a1.jpg"
    assert target.read_bytes() == source.read_bytes()
    assert target.is_symlink() == (images == "symlink")
    assert (target.stat().st_ino == source.stat().st_ino) == (images != "copy")


def test_a_broken_image_is_left_out_and_counted(raw: Path, tmp_path: Path) -> None:
    (raw / "images/100k/train/c03.jpg").write_bytes(b"not a picture")
    report = convert(read_bdd100k(raw), tmp_path / "out")
    assert report.images["train"] == 21
    assert report.dropped["train"]["image: labels or image broken"] == 1
    assert "c03" not in DrivingDataset(tmp_path / "out", "train").names


class Records:
    """Records that a test makes, as a source."""

    found: ClassVar[tuple[str, ...]] = ()
    origin: ClassVar[dict[str, str]] = {"kind": "test"}

    def __init__(self, **splits: list[ImageRecord]) -> None:
        self._splits = {split: {record.name: record for record in items} for split, items in splits.items()}

    @property
    def splits(self) -> tuple[str, ...]:
        return tuple(self._splits)

    def names(self, split: str) -> list[str]:
        return sorted(self._splits[split])

    def record(self, split: str, name: str) -> ImageRecord:
        return self._splits[split][name]


def picture(path: Path, shape: tuple[int, int] = (6, 8), **more: Any) -> ImageRecord:
    """Write an image and return its record."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        Image.new("RGB", shape[::-1]).save(file, "PNG")
    return ImageRecord(path.stem, path, **more)


CAR = ObjectLabel("car", (1.0, 1.0, 4.0, 4.0))
BOX = AreaLabel("direct", np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]]))


def test_again_ends_as_a_fresh_conversion(tmp_path: Path) -> None:
    """Changed labels, changed and removed images and splits: nothing of the first run stays."""
    kept, gone = picture(tmp_path / "raw/a.png", objects=(CAR,)), picture(tmp_path / "raw/b.png", objects=(CAR,))
    relabelled = picture(tmp_path / "raw/c.png", objects=(CAR,), drivable=(BOX,))
    replaced = picture(tmp_path / "raw/d.png", objects=(CAR,))
    convert(Records(train=[kept, gone, relabelled, replaced], val=[kept]), tmp_path / "out")
    before = (tmp_path / "out/det_annotations/train/a.json").stat().st_mtime_ns
    (tmp_path / "out/images/train/mine.png").write_bytes(b"a user's own")
    replaced.image.unlink()
    moved = picture(tmp_path / "raw/d.jpg", (12, 8), objects=(CAR, dataclasses.replace(CAR, category="bus")))
    second = Records(train=[kept, dataclasses.replace(relabelled, objects=(), drivable=None), moved])
    again = convert(second, tmp_path / "out")
    fresh = convert(second, tmp_path / "fresh")
    assert (tmp_path / "out/images/train/mine.png").is_file()
    (tmp_path / "out/images/train/mine.png").unlink()
    one, two = tree(tmp_path / "out", times=False), tree(tmp_path / "fresh", times=False)
    two["dataset.yaml"] = (two["dataset.yaml"][0].replace(b"name: fresh", b"name: out"), 0)
    assert one == two
    assert again == fresh
    assert not (tmp_path / "out/images/val").exists()
    assert (tmp_path / "out/det_annotations/train/a.json").stat().st_mtime_ns == before


def test_an_image_or_mask_that_changed_is_made_again(tmp_path: Path) -> None:
    picture(tmp_path / "mask.png")
    record = picture(tmp_path / "raw/a.png", lane=MaskFile(tmp_path / "mask.png", {}))
    source = Records(train=[record])
    convert(source, tmp_path / "out", ConversionOptions(images="copy"))
    cv2.imwrite(str(tmp_path / "mask.png"), np.ones((6, 8), np.uint8))
    cv2.imwrite(str(record.image), np.full((6, 8, 3), 9, np.uint8))
    convert(source, tmp_path / "out", ConversionOptions(images="copy"))
    sample = DrivingDataset(tmp_path / "out", "train")[0]
    assert sample.lane is not None
    assert sample.lane.all()
    assert (sample.image == 9).all()


def test_another_source_is_refused(tmp_path: Path) -> None:
    source = Records(train=[picture(tmp_path / "raw/a.png")])
    convert(source, tmp_path / "out")
    source.origin = {"kind": "another"}  # type: ignore[misc]
    with pytest.raises(OutputError, match="another source"):
        convert(source, tmp_path / "out")


def test_splits_one_by_one_are_reported_together(tmp_path: Path) -> None:
    record = picture(tmp_path / "raw/a.png", objects=(CAR,))
    source = Records(train=[record], val=[record], test=[])
    convert(source, tmp_path / "out", splits=["train"])
    with (tmp_path / "out/.conversion/train.jsonl").open("a") as file:
        file.write('{"name": "cut off')
    report = convert(source, tmp_path / "out", splits=["val"])
    assert report.images == {"train": 1, "val": 1}
    assert json.loads((tmp_path / "out/conversion.json").read_text()) == report.to_dict()


def test_what_was_added_to_the_description_stays(tmp_path: Path) -> None:
    first = picture(tmp_path / "raw/a.png", objects=(CAR,))
    source = Records(train=[first])
    convert(source, tmp_path / "out", description=DatasetDescription(licence="MIT"))
    with (tmp_path / "out/dataset.yaml").open("a") as file:
        file.write("ego_mask: bonnet.png\ntasks: [detection]\nignore: [train]\n")
    before = (tmp_path / "out/dataset.yaml").read_text()
    convert(source, tmp_path / "out")
    assert (tmp_path / "out/dataset.yaml").read_text() == before
    source = Records(train=[first], val=[picture(tmp_path / "raw/b.png", objects=(CAR,))])
    convert(source, tmp_path / "out", description=DatasetDescription(licence="CC0"))
    about = read_description(tmp_path / "out")
    assert (about.ego_mask, about.tasks, about.ignore) == ("bonnet.png", ("detection",), ("train",))
    assert (about.name, about.licence, about.splits) == ("out", "CC0", ("train", "val"))
    text = (tmp_path / "out/dataset.yaml").read_text().replace("above: 1\n", "above: 100\n", 1)
    (tmp_path / "out/dataset.yaml").write_text(text.replace("ignore: []\n", "ignore: [127]\n", 1))
    ignored = picture(tmp_path / "raw/b.png", drivable=(AreaLabel("ignore", np.zeros((3, 2))),))
    convert(Records(train=[first, ignored]), tmp_path / "out")
    assert read_description(tmp_path / "out").drivable == MaskMeaning(100, {255: "drivable"}, (64, 127))


def test_splits_without_images_are_left_out(tmp_path: Path) -> None:
    broken = ImageRecord("b", tmp_path / "raw/nowhere.png")
    report = convert(Records(train=[picture(tmp_path / "raw/a.png")], val=[], test=[broken]), tmp_path / "out")
    assert read_description(tmp_path / "out").splits == ("train",)
    assert [path.name for path in (tmp_path / "out/images").iterdir()] == ["train"]
    assert report.dropped["test"] == {"image: labels or image broken": 1}


@pytest.mark.parametrize("split", ["../../evil", "/evil", "a/b", "..", ".", "", "a\0b"])
def test_a_split_that_is_no_folder_name_is_refused(tmp_path: Path, split: str) -> None:
    source = Records(train=[picture(tmp_path / "raw/a.png")], **{split: [picture(tmp_path / "raw/b.png")]})
    before = tree(tmp_path)
    with pytest.raises(DataError, match="is not the name of one folder; rename it"):
        convert(source, tmp_path / "some/where/out")
    assert tree(tmp_path) == before


def test_attributes_leave_the_columns_of_the_index_alone(tmp_path: Path) -> None:
    record = picture(tmp_path / "raw/a.png", attributes={"name": "Ann", "split": "left", "weather": "rainy"})
    convert(Records(train=[record]), tmp_path / "out")
    expected = {"attribute_name": "Ann", "attribute_split": "left", "weather": "rainy"}
    assert DrivingDataset(tmp_path / "out", "train")[0].attributes == expected


NAN = float("nan")


@pytest.mark.parametrize(
    ("name", "more", "message"),
    [
        ("a.tif", {}, "training reads .jpg"),
        ("a\udce9.png", {}, "not UTF-8"),
        ("a.png", {"attributes": {"by": "\ud800"}}, "not UTF-8"),
        ("a.png", {"size": (12, 16)}, "is 8x6, its labels are for 16x12"),
        ("a.png", {"drivable": (AreaLabel("direct", np.array([[0, 0], [4, NAN], [4, 4]])),)}, "not a number"),
        ("a.png", {"lane": (LaneLabel("lane", np.array([[0, 0], [np.inf, 1]])),)}, "not a number"),
        ("a.png", {"lane": (LaneLabel("lane", np.array([[0, 0], [NAN, 1]]), edge=True),) * 2}, "not a number"),
        ("a.png", {"drivable": (RowRuns("direct", 0, 0, 4, 2, (4, -1, 5)),)}, "negative"),
        ("a.png", {"drivable": (CocoRuns("direct", (6, 8), "zz!!zz"),)}, "run-length"),
    ],
    ids=["kind", "name", "attribute", "size", "area", "line", "edges", "row runs", "runs"],
)
def test_what_cannot_be_used_is_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, name: str, more: dict[str, Any], message: str
) -> None:
    bad = picture(tmp_path / "bad" / name, **more)
    good = picture(tmp_path / "raw/good.png", objects=(CAR,))
    report = convert(Records(train=[good, bad]), tmp_path / "out")
    assert report.images == {"train": 1}
    assert report.dropped["train"] == {"image: labels or image broken": 1}
    assert message in caplog.text
    assert DrivingDataset(tmp_path / "out", "train").names == ["good"]


def test_a_size_is_compared_with_the_turned_image(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (8, 6)).save(path, exif=exif)
    records = [ImageRecord("a", path, size=(8, 6)), ImageRecord("b", path, size=(6, 8))]
    assert convert(Records(train=records), tmp_path / "out").images == {"train": 1}


@pytest.mark.parametrize(
    ("mode", "values"),
    [
        ("I;16", {}), ("L", {}), ("RGB", {}), ("1", {}), ("I;16", {65535: "foreground"}), ("1", {255: "foreground"}),
        ("1", {1: "foreground"}), ("L", {1: "foreground"}),
    ],
)  # fmt: skip
def test_mask_pictures_of_every_depth(tmp_path: Path, mode: str, values: dict[int | tuple[int, int, int], str]) -> None:
    truth = np.zeros((6, 8), np.bool_)
    truth[2:4, 3:] = True
    masks = {
        "I;16": Image.fromarray(truth.astype(np.uint16) * 65535),
        "L": Image.fromarray(truth.astype(np.uint8)),
        "RGB": Image.fromarray(truth[..., None] * np.array([0, 0, 1], np.uint8)),
        "1": Image.fromarray(truth),
    }
    assert masks[mode].mode == mode
    masks[mode].save(tmp_path / "mask.png")
    record = picture(tmp_path / "raw/a.png", lane=MaskFile(tmp_path / "mask.png", values))
    convert(Records(train=[record]), tmp_path / "out")
    np.testing.assert_array_equal(DrivingDataset(tmp_path / "out", "train")[0].lane, truth)


def test_a_level_beyond_all_colours_has_no_meaning(tmp_path: Path) -> None:
    levels = np.array([[7, 7, -1, 1 << 24, 0, 3, 0x7FFFFFFF, 7]] * 6, np.int32)
    Image.fromarray(levels).save(tmp_path / "mask.tif")
    record = picture(tmp_path / "raw/a.png", lane=MaskFile(tmp_path / "mask.tif", {7: "foreground", 0: "background"}))
    report = convert(Records(train=[record]), tmp_path / "out")
    lane = DrivingDataset(tmp_path / "out", "train")[0].lane
    np.testing.assert_array_equal(lane, levels == 7)
    assert report.dropped["train"] == {"lane: values of a mask that nothing explains": 1}


def test_gaps_and_widths_are_those_of_an_image_1280_pixels_wide() -> None:
    y = np.arange(100.0, 341.0, 20.0)
    edges = [LaneLabel("single white", np.stack([np.full_like(y, x), y], axis=1), edge=True) for x in (300.0, 330.0)]
    for width, drawn, pixels in ((1280, {"pairs": 1}, 8), (640, {"single lines": 2}, 2 * 4)):
        mask, found, _ = lane_mask(edges, (360, width), 8.0, ConversionOptions())
        assert found == drawn
        assert np.count_nonzero(mask[200]) == pixels


def test_an_interrupted_copy_of_an_image_is_not_taken_for_it(
    raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(source: Path, target: Path) -> None:
        target.write_bytes(source.read_bytes()[:100])
        raise KeyboardInterrupt

    monkeypatch.setattr(shutil, "copy2", interrupted)
    with pytest.raises(KeyboardInterrupt):
        convert(read_bdd100k(raw), tmp_path / "out", ConversionOptions(images="copy"))
    assert not list((tmp_path / "out" / "images").rglob("[!.]*.jpg"))


def test_ignored_areas_are_drawn_over_all() -> None:
    """In the order of a file of COCO there is no meaning."""
    ignored = AreaLabel("ignore", np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 6.0], [0.0, 6.0]]))
    road = AreaLabel("direct", np.array([[0.0, 0.0], [8.0, 0.0], [8.0, 6.0], [0.0, 6.0]]))
    other = dataclasses.replace(road, kind="alternative", points=np.add(road.points, (4.0, 0.0)))
    mask = drivable_mask([ignored, road, other], (6, 8), keep_alternative=True)
    assert mask.tolist() == [[64] * 2 + [255] * 2 + [127] * 4] * 6


def test_shapes_of_too_few_points_are_counted(tmp_path: Path) -> None:
    areas = tuple(AreaLabel("direct", np.zeros((count, 2))) for count in range(4))
    lines = tuple(LaneLabel("lane", np.zeros((count, 2))) for count in range(3))
    outlines = tuple(LaneLabel("lane", np.zeros((count, 2)), closed=True) for count in range(4))
    record = picture(tmp_path / "raw/a.png", drivable=areas, lane=lines + outlines)
    report = convert(Records(train=[record]), tmp_path / "out")
    assert report.dropped["train"] == {"area with too few points": 3, "lane with too few points": 5}
    assert report.lanes["train"] == {"outlines": 1, "single lines": 1}
    whole = picture(tmp_path / "raw/b.png", drivable=areas[3:], lane=lines[2:])
    assert convert(Records(train=[whole]), tmp_path / "other").dropped == {"train": {}}


@pytest.mark.parametrize("images", ["link", "copy", "symlink"])
def test_images_of_long_names_are_placed(tmp_path: Path, images: Literal["link", "copy", "symlink"]) -> None:
    image = tmp_path / f"{'n' * 250}.jpg"
    cv2.imwrite(str(image), np.zeros((36, 64, 3), np.uint8))
    source = ListedRecords({"train": [ImageRecord(image.stem, image, objects=())]}, origin={"kind": "test"})
    convert(source, tmp_path / "out", ConversionOptions(images=images))
    assert DrivingDataset(tmp_path / "out", "train").names == [image.stem]
