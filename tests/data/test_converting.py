from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.formats.readers import raw_bdd
from trilitenet.data.converting import ConversionOptions, convert
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.records import ImageRecord
from trilitenet.errors import ConfigError, DataError, OutputError
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
        self.splits = source.splits

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
    with pytest.raises(ConfigError, match="above 0"):
        ConversionOptions(lane_width={"*": 0})
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
