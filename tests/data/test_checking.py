from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.data.published import write_annotation, write_published
from trilitenet.data import checking
from trilitenet.data.checking import KINDS, CheckReport, check_dataset, detect_layout
from trilitenet.data.reading import DrivingDataset, split_folders
from trilitenet.errors import DataError

pytest.importorskip("imagehash")


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("clean")
    write_published(root, "train", 30)
    write_published(root, "val", 10, seed=1)
    rows = [
        f"{split}_{i:04},{split},s{split}{i // 5}"
        for split, count in (("train", 30), ("val", 10))
        for i in range(count)
    ]
    (root / "index.csv").write_text("name,split,sequence\n" + "\n".join(rows) + "\n")
    (root / "dataset.yaml").write_text("splits: [train, val]\n")
    return root


@pytest.fixture
def root(clean: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(clean, tmp_path / "data"))


def kinds(report: CheckReport) -> set[str]:
    return {finding.kind for finding in report.findings}


def test_clean_is_clean(clean: Path) -> None:
    report = check_dataset(clean)
    assert report.findings == ()
    assert report.ok
    assert report.images == {"train": 30, "val": 10}
    assert report.labelled["train"] == {"detection": 26, "lane": 24, "drivable": 23}
    assert report.conditions["timeofday"]["night"] == {"train": 13, "val": 5}
    assert report.sizes == {"128x72": 40}
    assert 0.3 < report.drivable["train"] < 0.5
    assert report.layout.startswith("the published layout")
    assert json.loads(json.dumps(report.to_dict()))["ok"] is True


def box(x1: float, y1: float, x2: float, y2: float, category: str = "car") -> dict[str, object]:
    return {"category": category, "box2d": {"x1": x1, "y1": y1, "x2": x2, "y2": y2}, "attributes": {}}


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def unlink(*paths: Path) -> None:
    for path in paths:
        path.unlink()


def link_to_nothing(path: Path) -> None:
    path.unlink()
    path.symlink_to("moved.jpg")


def annotate(root: Path, *items: dict[str, object]) -> None:
    write_annotation(root, "train", "train_0000", list(items))


def draw_mask(root: Path, mask: np.ndarray, name: str = "train_0000") -> None:
    cv2.imwrite(str(root / f"da_seg_annotations/train/{name}.png"), mask)


def add_image(root: Path, split: str, name: str, image: np.ndarray) -> None:
    """A further image, annotated and listed, so that it has no other fault than the one planted."""
    cv2.imwrite(str(root / f"images/{split}/{name}.jpg"), image)
    write_annotation(root, split, name, [])
    with (root / "index.csv").open("a") as file:
        file.write(f"{name},{split},own-{split}-{name}\n")


def brighter(root: Path, by: int = 2, gamma: float = 1.0) -> np.ndarray:
    image = cv2.imread(str(root / "images/train/train_0003.jpg"))
    assert image is not None
    return np.asarray(np.clip((image / 255) ** gamma * 255 + by, 0, 255), np.uint8)


def put(root: Path, *names: str) -> None:
    """Write files in folders that may be new; what is in them does not matter."""
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"x")


def copy_image(root: Path, split: str, name: str) -> None:
    shutil.copy(root / "images/train/train_0002.jpg", root / f"images/{split}/{name}.jpg")
    write_annotation(root, split, name, [])
    with (root / "index.csv").open("a") as file:
        file.write(f"{name},{split},own-{split}-{name}\n")


FAULTS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "truncated image": ("image-unreadable", lambda root: truncate(root / "images/train/train_0001.jpg")),
    "empty image": ("image-unreadable", lambda root: (root / "images/val/val_0001.jpg").write_bytes(b"")),
    "text as image": ("image-unreadable", lambda root: (root / "images/val/val_0002.jpg").write_text("hello")),
    "link to nothing": ("image-unreadable", lambda root: link_to_nothing(root / "images/train/train_0004.jpg")),
    "broken annotation": (
        "annotation-unreadable",
        lambda root: (root / "det_annotations/train/train_0001.json").write_text('{"frames": ['),
    ),
    "truncated mask": ("mask-unreadable", lambda root: truncate(root / "ll_seg_annotations/train/train_0001.png")),
    "mask of another size": ("mask-size", lambda root: draw_mask(root, np.zeros((36, 64), np.uint8))),
    "mask values": ("mask-values", lambda root: draw_mask(root, np.full((72, 128), 77, np.uint8))),
    "mask of 16 bits": ("mask-values", lambda root: draw_mask(root, np.full((72, 128), 255, np.uint16))),
    "mask of ones": ("mask-invisible", lambda root: draw_mask(root, np.ones((72, 128), np.uint8))),
    "swapped corners": ("box-invalid", lambda root: annotate(root, box(50, 10, 40, 30))),
    "infinite box": ("box-invalid", lambda root: annotate(root, box(50, 10, float("inf"), 30))),
    "box outside": ("box-outside", lambda root: annotate(root, box(100, 10, 140, 30))),
    "box twice": ("box-twice", lambda root: annotate(root, box(10, 10, 40, 30), box(10, 10, 40, 30))),
    "unknown category": ("category-unknown", lambda root: annotate(root, box(10, 10, 40, 30, "cra"))),
    "no box of a class": (
        "no-class",
        lambda root: (root / "dataset.yaml").open("a").write("classes: {vehicle: [lorry]}\n"),
    ),
    "orphan annotation": (
        "orphan",
        lambda root: write_annotation(root, "train", "gone", []),
    ),
    "orphan mask": ("orphan", lambda root: draw_mask(root, np.zeros((72, 128), np.uint8), "gone")),
    "annotation in capitals": ("not-read", lambda root: (root / "det_annotations/val/val_0003.JSON").write_text("{}")),
    "mask of another kind": (
        "not-read",
        lambda root: cv2.imwrite(str(root / "da_seg_annotations/val/val_0003.bmp"), np.zeros((72, 128), np.uint8)),
    ),
    "masks a folder too deep": (
        "not-read",
        lambda root: put(root, "da_seg_annotations/bdd_seg_gt/train/train_0003.png"),
    ),
    "a mask in no folder of a split": ("not-read", lambda root: put(root, "ll_seg_annotations/train_0004.png")),
    "images a folder too deep": ("not-read", lambda root: put(root, "images/train/day1/0001.jpg")),
    "an image in no folder of a split": ("not-read", lambda root: put(root, "images/0001.jpg")),
    "image of another kind": ("not-read", lambda root: put(root, "images/train/0001.tif")),
    "no label at all": (
        "unlabelled",
        lambda root: unlink(*root.glob("*_annotations/train/train_0000.*")),
    ),
    "one name twice": (
        "name-in-two-splits",
        lambda root: add_image(root, "val", "train_0000", np.random.default_rng(9).integers(0, 255, (72, 128, 3))),
    ),
    "two endings": (
        "name-twice",
        lambda root: cv2.imwrite(
            str(root / "images/train/train_0000.png"), np.random.default_rng(9).integers(0, 255, (72, 128, 3))
        ),
    ),
    "copy in a split": ("duplicate", lambda root: copy_image(root, "train", "copy")),
    "copy across splits": ("leak-duplicate", lambda root: copy_image(root, "val", "copied")),
    "near copy across splits": ("leak-near-duplicate", lambda root: add_image(root, "val", "near", brighter(root))),
    "brighter copy across splits": (
        "leak-near-duplicate",
        lambda root: add_image(root, "val", "brighter", brighter(root, by=15)),
    ),
    "copy of another gamma across splits": (
        "leak-near-duplicate",
        lambda root: add_image(root, "val", "gamma", brighter(root, by=0, gamma=0.85)),
    ),
    "sequence across splits": (
        "leak-sequence",
        lambda root: (root / "index.csv").write_text((root / "index.csv").read_text().replace("sval1", "strain1")),
    ),
    "index is not UTF-8": (
        "index",
        lambda root: (root / "index.csv").write_bytes("name,split\nstraße,train\n".encode("latin-1")),
    ),
    "index names no image": ("index", lambda root: (root / "index.csv").open("a").write("nobody,train,x\n")),
    "index lists an image twice": (
        "index",
        lambda root: (root / "index.csv").open("a").write("train_0007,train,strain1\n"),
    ),
    "no such split": ("split-missing", lambda root: (root / "dataset.yaml").write_text("splits: [train, val, test]\n")),
    "a split without images": ("split-missing", lambda root: (root / "images" / "test").mkdir()),
    "no such ego mask": ("ego-mask", lambda root: (root / "dataset.yaml").open("a").write("ego_mask: nope.png\n")),
    "odd shapes": (
        "anchors",
        lambda root: annotate(root, *(box(1, 1 + n / 10, 120, 1.5 + n / 10) for n in range(60))),
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_every_planted_fault_is_found_and_nothing_else(root: Path, fault: str) -> None:
    kind, plant = FAULTS[fault]
    plant(root)
    report = check_dataset(root)
    assert kinds(report) == {kind}
    assert report.findings[0].examples
    assert not report.ok


def test_a_sequence_that_annotations_name_is_looked_at_too(root: Path) -> None:
    (root / "index.csv").unlink()
    for split, name in (("train", "train_0001"), ("val", "val_0001")):
        write_annotation(root, split, name, [], source="city", sequence="7")
    (finding,) = check_dataset(root).findings
    assert (finding.kind, finding.split, finding.examples) == ("leak-sequence", "train, val", ("city/7",))
    (root / "index.csv").write_text("name,split,sequence\nval_0001,val,8\n")  # which counts more
    assert kinds(check_dataset(root)) == {"index"}


def test_attributes_of_null_are_not_stated(root: Path) -> None:
    (root / "index.csv").unlink()
    for split, name in (("train", "train_0001"), ("val", "val_0001")):
        content = {"frames": [], "attributes": {"weather": "rainy", "sequence": None, "scene": None}}
        (root / f"det_annotations/{split}/{name}.json").write_text(json.dumps(content))
    report = check_dataset(root)
    assert report.ok
    assert report.conditions.keys() == {"timeofday", "weather"}


def test_a_file_that_is_not_read_is_named_with_the_cure(root: Path) -> None:
    for name in ("x.PNG", "y.bmp", ".z.bmp"):
        (root / f"ll_seg_annotations/val/{name}").touch()
    (finding,) = check_dataset(root).findings
    assert finding.examples == (
        "ll_seg_annotations/val/x.PNG is not read; rename it to .png",
        "ll_seg_annotations/val/y.bmp is not read; save it as .png",
    )


def test_where_files_that_are_not_read_belong_is_told(root: Path) -> None:
    put(
        root,
        "images/0001.jpg",
        "images/100k/val/0001.jpg",
        "images/train/day1/0001.jpg",
        "images/train/day1/0002.JPG",
        "images/train/day1/am/0001.tif",
        "images/val/0001.HEIC",
        "det_annotations/labels.json",
        "det_annotations/new/more/0001.json",
        "da_seg_annotations/bdd_seg_gt/val/val_0000.png",
    )
    findings = {finding.split: finding for finding in check_dataset(root).findings if finding.kind == "not-read"}
    assert {split: finding.examples for split, finding in findings.items()} == {
        "": (
            "images/0001.jpg is not read; move it to images/SPLIT",
            "det_annotations/labels.json is not read; move it to det_annotations/SPLIT",
            "det_annotations/new/more is not read; move its files (1) to det_annotations/SPLIT",
        ),
        "train": (
            "images/train/day1 is not read; move its files (2) to images/train",
            "images/train/day1/am is not read; move its files (1) to images/train",
        ),
        "val": (
            "images/100k/val is not read; move its files (1) to images/val",
            "images/val/0001.HEIC is not read; save it as .jpg",
            "da_seg_annotations/bdd_seg_gt/val is not read; move its files (1) to da_seg_annotations/val",
        ),
    }


def test_other_files_beside_images_and_labels_are_no_fault(root: Path) -> None:
    put(
        root,
        ".prepared/train/0001.png",
        "README.md",
        "human_road/train/train_0000.png",
        "bdd_seg_gt/train/train_0000.png",  # left after a copy of it was made
        "images/LICENSE.txt",
        "images/.cache/train/0001.jpg",
        "images/train/notes.txt",
        "images/train/.thumbnails/0001.jpg",
        "images/train/meta/._0001.jpg",
        "images/train/meta/notes.txt",
        "det_annotations/README.md",
        "ll_seg_annotations/LICENSE",
    )
    shutil.copy(root / "da_seg_annotations/train/train_0000.png", root / "da_seg_annotations/bonnet.png")
    (root / "dataset.yaml").write_text("ego_masks: {train_: da_seg_annotations/bonnet.png}\n")
    assert check_dataset(root).findings == ()


@pytest.mark.parametrize("made", [True, False])
def test_folders_of_the_published_archives_are_named(root: Path, made: bool) -> None:
    for folder, name in (("da_seg_annotations", "bdd_seg_gt"), ("ll_seg_annotations", "bdd_lane_gt")):
        (root / folder).rename(root / name)
        if made:
            (root / folder).mkdir()
    cure = "move its folders to" if made else "rename it to"
    findings = {finding.kind: finding for finding in check_dataset(root).findings if finding.kind != "unlabelled"}
    assert findings.keys() == {"not-read"}
    assert findings["not-read"].examples == (
        f"bdd_seg_gt is not read; {cure} da_seg_annotations",
        f"bdd_lane_gt is not read; {cure} ll_seg_annotations",
    )
    (root / "dataset.yaml").write_text("tasks: [detection]\n")
    assert kinds(check_dataset(root)) == {"unlabelled"}


def test_folders_that_lead_back_are_looked_at_once(root: Path) -> None:
    for name in ("one", "two"):
        (root / f"images/train/{name}").symlink_to(root / "images")
    findings = check_dataset(root).findings
    assert [(finding.kind, finding.split, finding.count) for finding in findings] == [
        ("not-read", "train", 2),
        ("not-read", "val", 2),
    ]
    assert findings[1].examples[0] == "images/train/one/val is not read; move its files (10) to images/val"


def test_an_ego_mask_of_a_name_that_no_system_has(root: Path) -> None:
    (root / "dataset.yaml").write_text('ego_mask: "\\uD800.png"\n')
    assert kinds(check_dataset(root)) == {"ego-mask"}
    with pytest.raises(DataError, match="cannot be read"):
        DrivingDataset(root, "train")[0]


def test_all_kinds_are_planted() -> None:
    assert {kind for kind, _ in FAULTS.values()} == set(KINDS)
    assert len(FAULTS) >= 15


ONE_PLACE = (
    "swapped corners", "infinite box", "box outside", "box twice", "unknown category",
    "mask values", "mask of 16 bits", "mask of another size", "no label at all", "one name twice", "two endings",
    "index is not UTF-8", "no box of a class",
)  # fmt: skip
"""Faults planted in the same file as another, so that only the last one would be there."""


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_faults_do_not_hide_one_another(root: Path) -> None:
    planted = _planted_at_once()
    for _, plant in planted.values():
        plant(root)
    assert kinds(check_dataset(root)) == {kind for kind, _ in planted.values()}


def _planted_at_once() -> dict[str, tuple[str, Callable[[Path], object]]]:
    return {fault: planted for fault, planted in FAULTS.items() if fault not in ONE_PLACE}


def test_the_documentation_says_how_many_are_planted() -> None:
    words = f"{len(FAULTS)} faults of all {len(KINDS)} kinds one by one, and {len(_planted_at_once())} at once;"
    assert words in (Path(__file__).resolve().parents[2] / "docs/data.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_processes_find_the_same(root: Path) -> None:
    write_published(root, "train", 70)
    assert check_dataset(root, workers=2) == check_dataset(root)


def test_other_layouts_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        check_dataset(tmp_path / "nowhere")
    for name, layout in (
        ("images/100k/train", "bdd100k"),
        ("annotations/instances.json", "coco"),
        ("data.yaml", "yolo"),
        ("annotations.xml", "cvat"),
        ("prepared.json", "prepared"),
        ("notes.txt", "unknown"),
    ):
        folder = tmp_path / layout
        path = folder / name
        path.parent.mkdir(parents=True)
        path.mkdir() if not path.suffix else path.write_text("{}")
        assert detect_layout(folder)[0] == layout
        with pytest.raises(DataError, match=r"looks like|prepared data set"):
            check_dataset(folder)


def test_images_without_folders_of_splits_are_not_found_clean(root: Path) -> None:
    for folder in root.glob("*/train"):
        shutil.copytree(folder, root / "flat" / folder.parent.name)
    (root / "flat/images/.ipynb_checkpoints").mkdir()  # by looking at the folder
    with pytest.raises(DataError, match="looks like images that are in no folder of a split, not the published layout"):
        check_dataset(root / "flat")


def test_pictures_of_16_bits_are_told_apart(root: Path) -> None:
    """They were all white to it, and so the same picture in every split."""
    for path in root.glob("images/*/*.jpg"):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        cv2.imwrite(str(path.with_suffix(".png")), grey.astype(np.uint16) * 200 + 2000)
        path.unlink()
    assert check_dataset(root).findings == ()


def test_coco_in_one_file_at_the_root_is_named(tmp_path: Path) -> None:
    (tmp_path / "empty.json").touch()
    (tmp_path / "notes.json").write_text('{"images": []}')
    assert detect_layout(tmp_path)[0] == "unknown"
    (tmp_path / "labels.json").write_text('{"images": [], "annotations": [], "categories": []}')
    assert detect_layout(tmp_path) == ("coco", "COCO (labels.json)")


def test_described_values_are_expected(root: Path) -> None:
    (root / "dataset.yaml").write_text(
        "drivable: {values: {255: direct, 77: alternative}}\nclasses: {vehicle: [car, cra]}\n"
    )
    draw_mask(root, np.full((72, 128), 77, np.uint8))
    annotate(root, box(10, 10, 40, 30, "cra"))
    assert check_dataset(root).ok


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_masks_of_16_bits_are_refused_as_by_training(root: Path, channels: int) -> None:
    draw_mask(root, np.full((72, 128, channels), 65535, np.uint16))
    (finding,) = check_dataset(root).findings
    assert finding.kind == "mask-values"
    assert finding.examples == ("da_seg_annotations/train/train_0000.png: has 16 bits a pixel; save it with 8",)
    with pytest.raises(DataError, match="has 16 bits a pixel; save it with 8"):
        DrivingDataset(root, "train")[0]


@pytest.mark.parametrize("colour", [(244, 35, 232), (0, 255, 0), (128, 64, 128)])
def test_the_value_of_a_colour_is_that_of_training(root: Path, colour: tuple[int, int, int]) -> None:
    draw_mask(root, np.full((72, 128, 3), colour[::-1], np.uint8))
    (finding,) = check_dataset(root).findings
    value = finding.examples[0].split()[-1]
    (root / "dataset.yaml").write_text(f"drivable: {{ignore: [{value}]}}\n")
    assert check_dataset(root).ok
    valid = DrivingDataset(root, "train")[0].drivable_valid
    assert valid is not None
    assert not valid.any()


@pytest.mark.parametrize(
    ("meaning", "values", "found"),
    [
        ("{above: 127, ignore: [64]}", (0, 64), set()),
        ("{above: 127, values: {255: road, 64: pavement}}", (0, 64), set()),
        ("{above: 127, values: {255: road}}", (0, 64), {"mask-invisible"}),
        ("{above: 127, values: {255: road}, ignore: [64]}", (0, 32, 64), {"mask-invisible"}),
        ("{above: 127, values: {255: road, 64: pavement}}", (0, 32, 255), {"mask-values"}),
        ("{values: {1: drivable}}", (0, 1), {"mask-invisible"}),
        ("{values: {1: drivable, 255: unclear}, ignore: [255]}", (0, 1, 255), {"mask-invisible"}),
    ],
)
def test_labels_that_are_meant_as_background_are_not_invisible(
    root: Path, meaning: str, values: tuple[int, ...], found: set[str]
) -> None:
    (root / "dataset.yaml").write_text(f"drivable: {meaning}\n")
    for path in root.glob("da_seg_annotations/*/*.png"):
        path.unlink()
    draw_mask(root, np.resize(np.array(values, np.uint8), (72, 128)))
    assert kinds(check_dataset(root)) == found


@pytest.mark.parametrize(
    ("target", "reason"),
    [
        ("moved.jpg", "links to moved.jpg, which is not there"),
        ("train_0004.jpg", "Too many levels of symbolic links"),
    ],
)
def test_what_is_wrong_with_a_link_is_told(root: Path, target: str, reason: str) -> None:
    image = root / "images/train/train_0004.jpg"
    image.unlink()
    image.symlink_to(target)
    (finding,) = [finding for finding in check_dataset(root).findings if finding.kind == "image-unreadable"]
    assert finding.examples == (f"images/train/train_0004.jpg ({reason})",)


def test_flat_pictures_of_other_brightness_are_no_copies(root: Path) -> None:
    for split, level in (("train", 20), ("val", 90)):
        add_image(root, split, f"flat_{split}", np.full((72, 128, 3), level, np.uint8))
    assert check_dataset(root).findings == ()


def test_copies_are_found_among_many_pictures_of_one_hash() -> None:
    rng = np.random.default_rng(0)

    def fact(number: int) -> checking._Facts:
        thumb = rng.integers(0, 256, 256, dtype=np.uint8).tobytes() if number != 1 else same
        digest = number.to_bytes(12, "big")
        return checking._Facts(str(number), (9, 16), digest, 5, thumb, (), {}, np.zeros((0, 2), np.float32), {}, {}, ())

    same = bytes(range(256))
    facts = {"train": [fact(number) for number in range(2000)]}
    facts["val"] = [dataclasses.replace(facts["train"][1], digest=b"other"), *(fact(2000 + i) for i in range(300))]
    collector = checking._Collector()
    checking._find_near_duplicates(facts, collector)
    (finding,) = collector.findings()
    assert (finding.count, finding.examples) == (1, ("val/1 ~ train/1",))


def test_a_condition_that_an_image_lacks_is_undefined(root: Path) -> None:
    index = root / "index.csv"
    lines = index.read_text(encoding="utf-8").splitlines()
    rows = [f"{line},{'' if number % 2 else 'rain'}" for number, line in enumerate(lines[1:])]
    index.write_text("\n".join([f"{lines[0]},weather", *rows]), encoding="utf-8")
    assert check_dataset(root).conditions["weather"] == {
        "rain": {"train": 15, "val": 5},
        "undefined": {"train": 15, "val": 5},
    }
    index.unlink()
    write_annotation(root, "train", "train_0000", [], weather="rain", speed="30")
    conditions = check_dataset(root).conditions
    assert conditions["weather"] == {"rain": {"train": 1}, "undefined": {"train": 29, "val": 10}}
    assert "speed" not in conditions  # numbers


def test_hidden_files_are_passed_over(root: Path) -> None:
    before = check_dataset(root)
    for path in [path for path in root.rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"\0\5\26\7")
    for folder in ("images", "da_seg_annotations"):
        shutil.copytree(root / folder / "val", root / folder / ".ipynb_checkpoints")
    assert check_dataset(root) == before
    assert [path.name for path in split_folders(root)] == ["train", "val"]


def test_labels_of_tasks_that_are_not_labelled_at_all_do_not_count(root: Path) -> None:
    (root / "dataset.yaml").write_text("tasks: [lane]\n")
    truncate(root / "da_seg_annotations/train/train_0001.png")
    for name in ("stray.png", "train_0001.jpg"):
        (root / "da_seg_annotations/train" / name).touch()
    annotate(root, box(1, 2, 30, 40, "unicorn"), box(1, 2, 30, 40, "unicorn"), {"category": "car", "box2d": {"x1": 3}})
    assert DrivingDataset(root, "train")[0].boxes is None
    report = check_dataset(root)
    assert report.labelled["train"] == {"lane": 24}
    assert report.drivable == {}
    assert report.objects == {"train": {}, "val": {}}
    assert report.conditions["timeofday"]["night"] == {"train": 13, "val": 5}
    assert kinds(report) == {"unlabelled"}
