from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tests.formats.readers.conftest import SIZE
from trilitenet.data.converting import convert
from trilitenet.data.reading import DrivingDataset
from trilitenet.errors import ConfigError, DataError
from trilitenet.formats.readers.mapping import LabelMapping, MaskRule, parse_colour, read_mapping
from trilitenet.formats.readers.masks import read_masks

YAML = """
images: frames/{split}
splits: [train, val]
drivable_mask:
  path: road/{split}/{name}_label.png
  values: {"128, 64, 128": direct, "#0000ff": alternative, "9 9 9": ignore}
lane_mask:
  path: markings/{split}/{name}.png
  values: {7: foreground, 200: background}
"""


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "data"
    for folder in ("frames/train", "road/train", "markings/train"):
        (root / folder).mkdir(parents=True)
    for name in ("a", "b"):
        cv2.imwrite(str(root / f"frames/train/{name}.jpg"), np.zeros((*SIZE, 3), np.uint8))
    colours = np.zeros((*SIZE, 3), np.uint8)  # OpenCV writes BGR
    colours[10:20] = (128, 64, 128)
    colours[20:30] = (255, 0, 0)
    colours[30:35] = (9, 9, 9)
    cv2.imwrite(str(root / "road/train/a_label.png"), colours)
    ids = np.zeros(SIZE, np.uint8)
    ids[5], ids[6], ids[7] = 7, 8, 200
    cv2.imwrite(str(root / "markings/train/a.png"), ids)
    (tmp_path / "mapping.yaml").write_text(YAML)
    return root


def test_colours_and_ids(root: Path, tmp_path: Path) -> None:
    source = read_masks(root, read_mapping(tmp_path / "mapping.yaml"))
    assert source.found == ("train: 2 images, 1 drivable masks, 1 lane masks",)
    convert(source, tmp_path / "out")
    dataset = DrivingDataset(tmp_path / "out", "train")
    sample = dataset[0]
    assert sample.drivable is not None
    assert np.flatnonzero(sample.drivable.all(axis=1)).tolist() == list(range(10, 30))
    assert sample.drivable.sum() == 20 * SIZE[1]
    assert sample.valid is None
    assert sample.drivable_valid is not None
    assert np.flatnonzero(~sample.drivable_valid.any(axis=1)).tolist() == list(range(30, 35))
    assert sample.lane is not None
    assert np.flatnonzero(sample.lane.any(axis=1)).tolist() == [5]
    assert sample.boxes is None
    assert dataset[1].drivable is None
    assert dataset[1].lane is None


def test_what_was_written_comes_back(root: Path, tmp_path: Path) -> None:
    """A converted data set read again as plain masks gives the same masks."""
    convert(read_masks(root, read_mapping(tmp_path / "mapping.yaml")), tmp_path / "once")
    (tmp_path / "again.yaml").write_text(
        "drivable_mask: {path: 'da_seg_annotations/{split}/{name}.png', values: {255: direct, 64: ignore}}\n"
        "lane_mask: {path: 'll_seg_annotations/{split}/{name}.png'}\n"
    )
    convert(read_masks(tmp_path / "once", read_mapping(tmp_path / "again.yaml")), tmp_path / "twice")
    for folder in ("da_seg_annotations", "ll_seg_annotations"):
        one, two = (cv2.imread(str(tmp_path / run / folder / "train/a.png"), 0) for run in ("once", "twice"))
        np.testing.assert_array_equal(np.asarray(one), np.asarray(two))


@pytest.mark.parametrize(
    ("values", "count"),
    [({7: "foreground"}, 0), ({7: "foreground", 200: "background"}, 1), ({7: "foreground", 200: "background",
     8: "background"}, 0), ({1: "foreground"}, 1), ({}, 0)],
)  # fmt: skip
def test_values_that_nothing_explains_are_told(
    root: Path, tmp_path: Path, values: dict[str | int, str], count: int
) -> None:
    rule = MaskRule("markings/{split}/{name}.png", values)
    mapping = LabelMapping(images="frames/{split}", tasks=("lane",), lane_mask=rule)
    cv2.imwrite(str(root / "markings/train/b.png"), np.zeros(SIZE, np.uint8))
    report = convert(read_masks(root, mapping), tmp_path / "out")
    assert report.labelled["train"] == {"lane": 2}
    assert report.dropped["train"].get("lane: values of a mask that nothing explains", 0) == count


def test_default_is_everything_above_zero(tmp_path: Path) -> None:
    assert MaskRule("x").meanings() == {}
    with pytest.raises(DataError, match="no images"):
        read_masks(tmp_path)


def test_tasks_choose_the_masks_that_are_read(root: Path, tmp_path: Path) -> None:
    (tmp_path / "mapping.yaml").write_text(f"{YAML}tasks: [lane]\n")
    record = read_masks(root, read_mapping(tmp_path / "mapping.yaml")).record("train", "a")
    assert record.drivable is None
    assert record.lane is not None


def test_a_mask_of_another_size_is_counted(root: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(root / "markings/train/a.png"), np.zeros((9, 9), np.uint8))
    report = convert(read_masks(root, read_mapping(tmp_path / "mapping.yaml")), tmp_path / "out")
    assert report.images == {"train": 1}
    assert report.dropped["train"] == {"image: labels or image broken": 1}


@pytest.mark.parametrize(
    ("value", "parsed"), [(7, 7), ("7", 7), ("1, 2, 3", (1, 2, 3)), ("(1,2,3)", (1, 2, 3)), ("#0aFF10", (10, 255, 16))]
)
def test_values(value: str | int, parsed: int | tuple[int, int, int]) -> None:
    assert parse_colour(value) == parsed


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("drivable_mask: {path: x, values: {red: direct}}", "neither a level"),
        ("drivable_mask: {path: x, values: {1: road}}", "known: direct"),
        ("drivable_mask: {path: x, values: {1: direct, '1,2,3': direct}}", "all levels or all colours"),
        ("classes: {light: [red, off]}", "got False; put it into quotes"),
        ("drivabel: [road]", "did you mean 'drivable'"),
        ("classes: {a: [x], b: [x]}", r"category 'x' belongs to both 'a' and 'b'"),
        ("[1, 2", "not YAML"),
        ("- 1", "must hold 'key: value' lines"),
    ],
)
def test_bad_mappings(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mapping.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=f"^{re.escape(str(path))}: .*{message}"):
        read_mapping(path)


@pytest.mark.parametrize(
    "mapping",
    [
        {"images": "images/{name}"},
        {"drivable_mask": {"path": "m/{image}.png"}},
        {"lane_mask": {"path": "m/{.png"}},
        {"lane_mask": {"path": "m/{0}.png"}},
    ],
)
def test_a_place_in_braces_that_is_not_known_is_named(tmp_path: Path, mapping: dict[str, object]) -> None:
    path = tmp_path / "classes.yaml"
    path.write_text(yaml.safe_dump(mapping))
    with pytest.raises(ConfigError, match=r"may hold \{split\}"):
        read_mapping(path)


def test_images_without_any_mask_are_refused(root: Path) -> None:
    mapping = LabelMapping(images="frames/{split}")
    with pytest.raises(
        DataError, match=r"no mask of any image at drivable/\{split\}/\{name\}\.png or lane/.*--classes"
    ):
        read_masks(root, mapping)
