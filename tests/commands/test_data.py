from __future__ import annotations

import base64
import dataclasses
import errno
import json
import math
import os
import re
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.data.published import write_published
from tests.formats.readers import raw_bdd
from trilitenet.apps.cli import main
from trilitenet.commands import data as command
from trilitenet.commands.data import _widths, check, convert, prepare, show
from trilitenet.commands.evaluate import evaluate
from trilitenet.commands.train import training_data
from trilitenet.data.check_page import check_page
from trilitenet.data.checking import CheckReport
from trilitenet.data.contact_sheet import thumbnail
from trilitenet.data.converting import ConversionOptions
from trilitenet.data.description import DatasetDescription
from trilitenet.data.prepared import PreparedDataset, open_dataset
from trilitenet.data.reading import DrivingDataset
from trilitenet.engine.recipe import TrainConfig
from trilitenet.errors import ConfigError, DataError, OutputError
from trilitenet.formats.readers.mapping import LabelMapping


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    root = tmp_path / "raw"
    raw_bdd.write_images(root)
    raw_bdd.write_2020(root)
    return root


@pytest.fixture
def published(tmp_path: Path) -> Path:
    root = tmp_path / "data"
    write_published(root, "train", 12)
    write_published(root, "val", 6, seed=1)
    return root


def test_convert_both_ways(raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "convert", "bdd100k", str(raw), str(tmp_path / "one"), "--workers", "1"]) == 0
    shown = capsys.readouterr().out
    assert "train: 2 images; labels from labels/det_20/det_train.json (detection)" in shown
    assert "left out 1 x lane: crosswalk" in shown
    result = convert(str(raw), tmp_path / "two", kind="bdd100k", workers=1)
    assert result.report.images == {"train": 2, "val": 1}
    written = sorted((tmp_path / "one").rglob("*.png"))
    assert written
    for path in written:
        assert path.read_bytes() == (tmp_path / "two" / path.relative_to(tmp_path / "one")).read_bytes()


def test_convert_shows_that_it_reads_the_labels(
    raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Which are over a gigabyte of BDD100K, and minutes."""
    for name, value in (("FORCE_COLOR", "1"), ("TERM", "xterm"), ("COLUMNS", "80")):
        monkeypatch.setenv(name, value)
    convert("bdd100k", raw, tmp_path / "out", workers=1)
    shown = capsys.readouterr().err
    assert 0 < shown.index("reading the labels") < shown.index("images")


def test_convert_says_that_lane_masks_keep_their_width(raw: Path, tmp_path: Path) -> None:
    said = "lane masks keep the width they are drawn in; --lane-width is for lines"
    assert said not in convert("bdd100k", raw, tmp_path / "lines", workers=1).summary()
    (raw / "labels/lane/polygons/lane_train.json").unlink()
    (raw / "labels/lane/masks/train").mkdir(parents=True)
    cv2.imwrite(str(raw / "labels/lane/masks/train/a1.png"), np.full(raw_bdd.SIZE, 255, np.uint8))
    shown = convert("bdd100k", raw, tmp_path / "masks", lane_width=["20"], workers=1).summary()
    assert said in shown
    assert "1 masks" in shown


def test_convert_options(raw: Path, tmp_path: Path) -> None:
    (tmp_path / "classes.yaml").write_text("classes: {small: [car], large: [bus, truck]}\nlicence: mine\n")
    words = ["--classes", str(tmp_path / "classes.yaml"), "--lane-width", "train=40", "--max-gap", "100", "--crosswalk",
             "--vertical", "--keep-alternative", "--splits", "train", "--workers", "1"]  # fmt: skip
    assert main(["data", "convert", "bdd100k", str(raw), str(tmp_path / "out"), *words]) == 0
    lane = cv2.imread(str(tmp_path / "out/ll_seg_annotations/train/a1.png"), 0)
    np.testing.assert_array_equal(np.asarray(lane), raw_bdd.lane_truth(crosswalk=True, vertical=True))
    dataset = DrivingDataset(tmp_path / "out", "train")
    assert dataset.class_names == ("small", "large")
    assert dataset.description.licence == "mine"
    assert not (tmp_path / "out/images/val").exists()


def test_what_is_asked_of_a_conversion_reaches_it(raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}
    monkeypatch.setattr(command, "run_conversion", lambda _, out, chosen, **more: asked.update(more, chosen=chosen))
    classes = tmp_path / "classes.yaml"
    classes.write_text("classes: {small: [car]}\nignore: [rider]\nname: ours\nlicence: mine\n")
    options: dict[str, Any] = {"crosswalk": True, "vertical": True, "pair_edges": False, "max_gap": 7.0,
                               "keep_alternative": True, "images": "copy"}  # fmt: skip
    convert("bdd100k", raw, tmp_path, classes=classes, lane_width=("4",), splits=("val",), workers=3, **options)
    expected = ConversionOptions(classes={"small": ("car",)}, ignore=("rider",), lane_width={"*": 4.0}, **options)
    del asked["progress"]
    description = DatasetDescription(name="ours", licence="mine", source="bdd100k: raw")
    assert asked == {"chosen": expected, "splits": ("val",), "workers": 3, "description": description}


def test_each_kind_has_its_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = []
    for kind in ("coco", "yolo", "cvat", "masks"):
        monkeypatch.setattr(command, f"read_{kind}", lambda raw, mapping, kind=kind: read.append((kind, raw)))
        with pytest.raises(AttributeError):  # of the records, which are none
            convert("there", tmp_path, kind=kind)
    assert read == [("coco", "there"), ("yolo", "there"), ("cvat", "there"), ("masks", "there")]


@pytest.mark.parametrize("images", ["link", "copy"])
def test_a_full_disk_is_told_in_one_line(
    raw: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, images: Literal["link", "copy"]
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "the source")

    with monkeypatch.context() as patch:
        owner, name = (Path, "write_bytes") if images == "link" else (shutil, "copy2")
        patch.setattr(owner, name, full)
        with pytest.raises(OutputError, match=r"cannot be written .*No space left on device\)$"):
            convert("bdd100k", raw, tmp_path / "out", images=images, workers=1)
    assert not list((tmp_path / "out").rglob("*.part"))
    convert("bdd100k", raw, tmp_path / "out", images=images, workers=1)


def test_a_full_disk_is_told_in_one_line_when_preparing(published: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(tarfile.TarFile, "addfile", full)
    with pytest.raises(OutputError, match=r"\.prepared: cannot be written \(No space left on device\)$"):
        prepare(published, workers=1)


def test_a_report_is_whole_or_not_there(published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def half(path: Path, data: bytes) -> None:
        with path.open("wb") as file:
            file.write(data[:10])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(OutputError, match=r"a\.html: cannot be written \(No space left on device\)"):
        check(published, html=tmp_path / "a.html", workers=1)
    with pytest.raises(OutputError, match=r"a\.jpg: cannot be written \(No space left on device\)"):
        show(published, tmp_path / "a.jpg", count=1)
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


def test_a_conversion_without_images_or_labels_is_an_error(
    raw: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(raw / "labels")
    assert main(["data", "convert", "bdd100k", str(raw), str(tmp_path / "one"), "--workers", "1"]) == 1
    assert re.search(r"one: no image is labelled; .* missing label files, or .* --classes", capsys.readouterr().err)
    for image in raw.rglob("*.jpg"):
        image.write_bytes(b"")
    assert main(["data", "convert", "bdd100k", str(raw), str(tmp_path / "two"), "--workers", "1"]) == 1
    shown = capsys.readouterr()
    assert "train: left out 2 x image: labels or image broken" in shown.out
    assert "two: no image was written" in shown.err


@pytest.mark.parametrize("kind", ["bdd100k", "masks"])
def test_what_missing_labels_mean_is_refused_where_files_tell_it(raw: Path, tmp_path: Path, kind: Any) -> None:
    (tmp_path / "classes.yaml").write_text("missing: empty\n")
    with pytest.raises(ConfigError, match=f"'missing' .* is for coco, yolo, cvat; leave it out for {kind}"):
        convert(str(raw), tmp_path / "out", kind=kind, classes=tmp_path / "classes.yaml")


@pytest.mark.parametrize(
    ("line", "kinds"),
    [
        ("tasks: [detection]", "coco, yolo, cvat, masks"),
        ("drivable: [road]", "coco, yolo, cvat"),
        ("lane_edges: true", "cvat"),
        ("split: val", "coco, cvat, masks"),
        ("images: frames", "masks"),
    ],
)
def test_a_key_that_bdd100k_does_not_take_is_refused(raw: Path, tmp_path: Path, line: str, kinds: str) -> None:
    classes = tmp_path / "classes.yaml"
    classes.write_text(f"{line}\nname: ours\n")
    key = line.partition(":")[0]
    with pytest.raises(
        ConfigError, match=f"^'{key}' in the file of --classes is for {kinds}; leave it out for bdd100k$"
    ):
        convert("bdd100k", raw, tmp_path / "out", classes=classes)


@pytest.mark.parametrize(
    ("kind", "line"),
    [("yolo", "split: val"), ("yolo", "lane_edges: true"), ("coco", "lane_edges: true"), ("masks", "lane: [solid]")],
)
def test_a_key_that_another_format_does_not_take_is_refused(tmp_path: Path, kind: Any, line: str) -> None:
    classes = tmp_path / "classes.yaml"
    classes.write_text(f"{line}\n")
    with pytest.raises(ConfigError, match=f"; leave it out for {kind}$"):
        convert(str(tmp_path), tmp_path / "out", kind=kind, classes=classes)


def test_every_key_of_the_file_of_classes_is_taken_or_refused() -> None:
    taken = {"classes", "ignore", "name", "licence"}
    assert {field.name for field in dataclasses.fields(LabelMapping)} - taken == command._KEYS.keys()


def test_convert_wants_its_words(raw: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown kind of data set 'kitti'"):
        convert("kitti", raw, tmp_path / "out")
    with pytest.raises(ConfigError, match="data convert KIND SOURCE OUTPUT"):
        convert("bdd100k", raw)
    with pytest.raises(ConfigError, match="SOURCE and OUTPUT alone"):
        convert("bdd100k", raw, tmp_path / "out", kind="bdd100k")
    with pytest.raises(ConfigError, match="lane width"):
        convert("bdd100k", raw, tmp_path / "out", lane_width=["wide"])
    for width in ("nan", "inf", "0"):
        with pytest.raises(ConfigError, match=f"above 0 and finite, got 'train={width}'"):
            convert("bdd100k", raw, tmp_path / "out", lane_width=[f"train={width}"])
    with pytest.raises(ConfigError, match="no split 'trian'; there are train, val"):
        convert("bdd100k", raw, tmp_path / "out", lane_width=["trian=8", "4"])


@pytest.mark.parametrize(
    ("words", "widths"),
    [
        (["train=9", "4"], {"train": 9.0, "*": 4.0}),
        (["4", "train=9"], {"train": 9.0, "*": 4.0}),
        (["val=3"], {"train": 8.0, "*": 2.0, "val": 3.0}),
        (["3"], {"*": 3.0}),
    ],
)
def test_lane_widths_by_split_and_for_the_others(words: list[str], widths: dict[str, float]) -> None:
    assert _widths(words) == widths


@pytest.mark.parametrize("option", ["--html", "--json"])
def test_a_report_that_cannot_be_written_is_told_before_the_check(
    option: str, published: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trilitenet.commands.data.check_dataset", lambda *_, **__: pytest.fail("it has begun"))
    assert main(["data", "check", str(published), option, str(tmp_path)]) == 1
    assert capsys.readouterr().err == f"error: {tmp_path}: cannot be written (it is a folder)\n"


def test_check_says_what_is_wrong(
    published: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("imagehash")
    monkeypatch.setenv("COLUMNS", "200")
    html, document = tmp_path / "report.html", tmp_path / "report.json"
    words = ["data", "check", str(published), "--html", str(html), "--json", str(document), "--workers", "1"]
    assert main(words) == 0
    shown = capsys.readouterr().out
    assert "nothing wrong" in shown
    assert re.search(r"train\W+12\W+11\W+9\W+10\W+19 car, 4 ignored\W", shown)
    assert json.loads(document.read_text())["images"] == {"train": 12, "val": 6}
    page = html.read_text()
    assert page.count("<svg") == page.count(" viewBox=") >= 3  # which lets them get smaller on a phone
    assert "data:image/jpeg;base64," in page
    assert "http://" not in page
    for path in published.glob("*/train/train_0001.*"):
        path.rename(path.with_name(f"left[a]:car:{path.suffix}"))
    (published / "images/train/left[a]:car:.jpg").write_bytes(b"<broken>")
    assert main(words) == 1
    shown = capsys.readouterr().out
    assert "image-unreadable" in shown
    assert "images/train/left[a]:car:.jpg" in shown  # brackets and colons are no markup
    assert json.loads(document.read_text())["findings"][0]["kind"] == "image-unreadable"
    assert "image-unreadable" in html.read_text()
    monkeypatch.setenv("COLUMNS", "80")
    assert main(words[:3]) == 1
    faults = capsys.readouterr().out.partition("best possible recall")[2].splitlines()[1:]
    assert max(map(len, faults)) <= 80
    assert "\N{HORIZONTAL ELLIPSIS}" not in "".join(faults)
    with pytest.raises(DataError, match="looks like nothing known"):
        check(tmp_path)


@pytest.mark.parametrize("fault", ["two endings", "broken index"])
def test_a_page_tells_of_what_keeps_a_split_from_being_read(published: Path, tmp_path: Path, fault: str) -> None:
    pytest.importorskip("imagehash")
    if fault == "two endings":
        cv2.imwrite(str(published / "images/train/train_0000.png"), np.zeros((72, 128, 3), np.uint8))
    else:
        (published / "index.csv").write_text("file,weather\n")
    page = tmp_path / "report.html"
    found = check(published, html=page, workers=1)
    assert found.exit_code == 1
    assert found.report.findings[0].kind in page.read_text()


def test_a_page_shows_more_pictures_than_one_jpeg_has_room_for() -> None:
    sheet = np.zeros((65_600, 16, 3), np.uint8)
    report = CheckReport(Path("data"), "", {}, {}, {}, {}, {}, {}, {}, math.nan, (), ())
    page = check_page(report, sheet)
    pictures = [
        cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), 1) for data in re.findall(r'base64,([^"]+)', page)
    ]
    assert sum(len(picture) for picture in pictures if picture is not None) == len(sheet)


def test_show_sheets_and_pages(published: Path, tmp_path: Path) -> None:
    sheet = tmp_path / "sheets/all.png"
    assert show(published, sheet, count=4, columns=3, width=160).count == 8
    picture = cv2.imread(str(sheet))
    assert picture is not None
    assert picture.shape == (3 * (90 + 18), 3 * 160, 3)
    page = show(published, tmp_path / "night.html", split="train", where=["timeofday=night"])
    # Annotated images alternate between day and night; one night image has no annotation.
    assert page.count == 6
    assert (tmp_path / "night.html").read_text().count("<img") == 6
    both = re.findall(r"<img[^>]*>", show(published, tmp_path / "both.html", count=2).output.read_text())
    train, val = (
        re.findall(r"<img[^>]*>", show(published, tmp_path / f"{split}.html", split=split, count=2).output.read_text())
        for split in ("train", "val")
    )
    assert both == train + val
    assert len(set(both)) == 4
    others = show(published, tmp_path / "others.html", split="train", count=2, seed=1).output.read_text()
    assert not any(image in others for image in train)
    wrong: dict[str, Any] = {"columns": 0, "seed": -1, "count": 0, "width": 0}
    for name, value in wrong.items():
        with pytest.raises(ConfigError, match=name):
            show(published, tmp_path / "x.jpg", **{name: value})
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="cannot be written"):
        show(published, tmp_path / "file" / "x.jpg")
    rest = show(published, tmp_path / "rest.html", split="train", where=["timeofday=night"], start=4)
    assert rest.count == 2
    with pytest.raises(
        DataError, match=r"no image with timeofday=noon in any split: none has timeofday 'noon'; known: day, night$"
    ):
        show(published, sheet, where=["timeofday=noon"])
    with pytest.raises(DataError, match=r"none has timeofday 'nihgt'; did you mean 'night'\?$"):
        show(published, sheet, where=["timeofday=nihgt"])
    with pytest.raises(
        DataError, match=r"no image with time=night in val: none has .* 'time'; did you mean 'timeofday'\?"
    ):
        show(published, tmp_path / "x.jpg", split="val", where=["time=night"])
    with pytest.raises(DataError, match=r"no image after the first 24 in val$"):
        show(published, sheet, split="val", start=24)
    with pytest.raises(ConfigError, match="ATTRIBUTE=VALUE"):
        show(published, sheet, where=["night"])
    assert show(published, tmp_path / "none.html", where=["timeofday=undefined"]).count == 1
    with pytest.raises(DataError, match=r"none has the attribute 'timofday'; did you mean 'timeofday'\?$"):
        show(published, sheet, where=["timofday=undefined"])
    with pytest.raises(ConfigError, match="one value of an attribute, got timeofday=night and timeofday=day"):
        show(published, sheet, where=["timeofday=night", "timeofday=day"])
    with pytest.raises(OutputError, match="must end in"):
        show(published, tmp_path / "x.pdf")


def test_each_picture_is_named(published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in published.glob("*/val/val_0001.*"):
        path.rename(path.with_stem("a<b>&"))
    page = show(published, tmp_path / "page.html").output.read_text()
    figures = re.findall(r'<figure[^>]*><img alt="([^"]+)"[^>]*><figcaption>([^<]+)</figcaption></figure>', page)
    assert len(figures) == page.count("<img") == 18
    assert all(alt == caption for alt, caption in figures)
    assert {"a&lt;b&gt;&amp;, night", "train_0003, night, no area"} <= {caption for _, caption in figures}
    splits: list[str] = []

    def noted(*args: Any, split: str, **more: Any) -> Any:
        splits.append(split)
        return thumbnail(*args, split=split, **more)

    monkeypatch.setattr(command, "thumbnail", noted)
    show(published, tmp_path / "both.png", count=1)
    show(published, tmp_path / "one.png", count=1, split="val")
    check(published, html=tmp_path / "report.html", pictures=2, workers=1)
    assert splits == ["train", "val", "", "train", "val"]


def test_alternative_areas_are_tinted_less(published: Path, tmp_path: Path) -> None:
    def pages() -> list[set[str]]:
        page, report = tmp_path / "page.html", tmp_path / "report.html"
        show(published, page, split="val")
        check(published, html=report, workers=1)
        return [set(re.findall(r"<img[^>]*>", path.read_text())) for path in (page, report)]

    before = pages()
    for path in published.glob("da_seg_annotations/*/*.png"):
        mask = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        cv2.imwrite(str(path), mask // 2)
    page, report = (len(old - new) for old, new in zip(before, pages(), strict=True))
    assert (page, report) == (5, 1)  # one of the six images has no area


def test_a_sheet_keeps_its_colours(published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "contact_sheet", lambda *_, **__: np.full((2, 3, 3), (250, 100, 0), np.uint8))
    show(published, tmp_path / "sheet.png", count=1)
    assert (np.asarray(Image.open(tmp_path / "sheet.png")) == (250, 100, 0)).all()


def test_prepare_and_read_back(published: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "prepare", str(published), "--size", "64", "96", "--workers", "1"]) == 0
    assert "training uses it by itself" in capsys.readouterr().out
    assert isinstance(open_dataset(published, "train", canvas=(64, 96)), PreparedDataset)
    result = prepare(published, tmp_path / "out", size=(64, 96), images="raw", workers=1)
    assert result.images == {"train": 12, "val": 6}
    assert not result.by_itself
    with pytest.raises(DataError, match="prepared data set"):
        show(tmp_path / "out", tmp_path / "x.png")


def test_what_is_asked_of_a_preparation_reaches_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}

    def run(*folders: Path, **options: Any) -> dict[str, int]:
        asked.update(options, folders=folders)
        (tmp_path / "train-0.tar").write_bytes(b"12345")
        return {"val": 1}

    monkeypatch.setattr(command, "run_preparation", run)
    options: dict[str, Any] = {"splits": ("val",), "images": "jpeg", "quality": 80, "mask_above": 9, "shard_size": 5,
                               "workers": 3}  # fmt: skip
    done = prepare("data", tmp_path, size=(64, 96), classes=("car",), **options)
    del asked["progress"]
    assert asked == {"folders": ("data", tmp_path), "canvas": (64, 96), "class_names": ("car",), **options}
    assert (done.images, done.size) == ({"val": 1}, 5)


def test_training_uses_the_prepared_copy(published: Path) -> None:
    assert isinstance(training_data(TrainConfig(data=str(published))), DrivingDataset)
    prepare(published, workers=1)
    assert isinstance(training_data(TrainConfig(data=str(published))), PreparedDataset)


_TAKE_A_FOLDER: list[Callable[[Path, Path], object]] = [
    lambda root, out: check(root),
    lambda root, out: prepare(root, out),
    lambda root, out: show(root, out / "sheet.png"),
    lambda root, out: evaluate("tiny", data=root),
    lambda root, out: convert(root, out, kind="bdd100k"),
    lambda root, out: convert(root, out, kind="masks"),
    lambda root, out: convert(root, out, kind="coco"),
    lambda root, out: convert(root, out, kind="yolo"),
    lambda root, out: convert(root, out, kind="cvat"),
]


@pytest.mark.parametrize("call", _TAKE_A_FOLDER)
def test_a_folder_that_is_not_there_is_told(call: Callable[[Path, Path], object], tmp_path: Path) -> None:
    missing, out = tmp_path / "nowhere", tmp_path / "out"
    with pytest.raises(DataError, match=f"^{re.escape(str(missing))}: no such folder$"):
        call(missing, out)
    assert not out.exists()


@pytest.mark.parametrize("words", ["data check", "data show", "data prepare", "evaluate tiny --data"])
def test_an_address_in_place_of_the_folder_is_told_as_it_is(
    words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    address = "https://localhost:1/prep"
    assert main([*words.split(), address, *(["sheet.png"] if words == "data show" else [])]) == 1
    assert capsys.readouterr().err == f"error: {address}: is an address; give a folder on this machine\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("call", _TAKE_A_FOLDER[:6])
def test_a_file_in_place_of_the_folder_is_told(call: Callable[[Path, Path], object], tmp_path: Path) -> None:
    file = tmp_path / "notes.txt"
    file.touch()
    with pytest.raises(DataError, match=f"^{re.escape(str(file))}: is a file, not the folder of a data set$"):
        call(file, tmp_path / "out")
