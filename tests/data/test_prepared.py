from __future__ import annotations

import concurrent.futures
import contextlib
import errno
import logging
import os
import shutil
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from tests.data.published import write_annotation, write_published
from tests.data.serving import serving
from trilitenet.data.identity import identify, tell_apart
from trilitenet.data.loader import build_loader
from trilitenet.data.prepared import PreparedDataset, default_cache, open_dataset, prepare
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.sample import VALID
from trilitenet.data.transforms import TrainTransform
from trilitenet.errors import Claim, ConfigError, DataError, OutputError

CANVAS = (64, 96)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "data"
    write_published(root, "train", 11)
    write_published(root, "val", 3, (50, 90))
    mask = np.zeros((72, 128), np.uint8)
    mask[60:] = 255
    cv2.imwrite(str(root / "bonnet.png"), mask)
    for folder, name in (("da_seg_annotations", "train_0001"), ("ll_seg_annotations", "train_0002")):
        path = root / folder / "train" / f"{name}.png"
        labels = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        labels[20:40, :50] = 64
        cv2.imwrite(str(path), labels)
    (root / "dataset.yaml").write_text(
        "ego_masks: {train_000: bonnet.png}\ndrivable: {ignore: [64]}\nlane: {ignore: [64]}\n"
    )
    return root


@pytest.mark.parametrize("images", ["raw", "jpeg"])
def test_training_sees_the_same_batches(root: Path, tmp_path: Path, images: str) -> None:
    counts = prepare(root, tmp_path / "out", canvas=CANVAS, images=images, shard_size=4)  # type: ignore[arg-type]
    assert counts == {"train": 11, "val": 3}
    assert len(list((tmp_path / "out").glob("train-*.tar"))) == 3
    raw = DrivingDataset(root, "train")
    packed = open_dataset(tmp_path / "out", "train", canvas=CANVAS)
    assert isinstance(packed, PreparedDataset)
    transform = TrainTransform(CANVAS)
    loaders = [build_loader(dataset, transform, batch_size=3, seed=4) for dataset in (raw, packed)]
    for one, two in zip(*(loader.epoch(2) for loader in loaders), strict=True):
        assert one.names == two.names
        difference = (one.images.int() - two.images.int()).abs()
        assert difference.max() == 0 if images == "raw" else difference.float().mean() < 4
        for field in ("drivable", "lane", "detection_labelled"):
            assert torch.equal(getattr(one, field), getattr(two, field)), field
        torch.testing.assert_close(one.boxes, two.boxes, atol=1e-3, rtol=0)
        torch.testing.assert_close(one.ignored, two.ignored, atol=1e-3, rtol=0)


def test_attributes_tasks_and_missing_labels(root: Path, tmp_path: Path) -> None:
    prepare(root, tmp_path / "out", canvas=CANVAS)
    raw, packed = DrivingDataset(root, "train"), PreparedDataset(tmp_path / "out", "train")
    assert packed.names == raw.names
    for index in range(len(raw)):
        assert packed.attributes(index) == raw.attributes(index)
        one, two = raw[index], packed[index]
        for field in ("boxes", "class_id", "drivable", "lane", *VALID):
            assert (getattr(one, field) is None) == (getattr(two, field) is None), field
    assert any(len(sample.ignored) for sample in packed)
    for lanes in (
        PreparedDataset(tmp_path / "out", "train", tasks=["lane"]),
        DrivingDataset(root, "train", tasks=["lane"]),
    ):
        assert lanes[0].boxes is None
        assert lanes[0].drivable is None
        assert lanes[0].lane is not None
        assert lanes[1].drivable_valid is None
        assert lanes[2].lane_valid is not None
        assert not any(len(sample.ignored) for sample in lanes)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # webdataset leaves files open
def test_webdataset_reads_the_shards(root: Path, tmp_path: Path) -> None:
    """They are ordinary shards, for readers that know nothing of the index."""
    webdataset = pytest.importorskip("webdataset")
    prepare(root, tmp_path / "out", canvas=CANVAS, splits=["val"], images="jpeg")
    packed = PreparedDataset(tmp_path / "out", "val")
    shards = str(tmp_path / "out/val-000000.tar")
    for raw, sample in zip(webdataset.WebDataset(shards, shardshuffle=False).decode("rgb8"), packed, strict=True):
        assert raw["__key__"] == sample.name
        assert raw["jpg"].shape == sample.image.shape
        assert np.abs(raw["jpg"].astype(int) - sample.image).max() <= 3  # another JPEG decoder
        assert raw["json"]["class_names"] == ["vehicle"]
        if sample.drivable is not None:
            width = sample.size[1]
            np.testing.assert_array_equal(np.unpackbits(raw["drivable.npy"], axis=1, count=width), sample.drivable)


def test_a_data_set_uses_its_prepared_copy_by_itself(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    prepare(root, canvas=CANVAS)
    assert isinstance(open_dataset(root, "train", canvas=CANVAS), PreparedDataset)
    assert isinstance(open_dataset(root, "train"), DrivingDataset)  # wanted as they are
    assert isinstance(open_dataset(root, "train", canvas=(96, 96)), DrivingDataset)
    assert isinstance(open_dataset(root, "train", canvas=CANVAS, class_names=["car"]), DrivingDataset)
    assert isinstance(open_dataset(root, "train", canvas=CANVAS, mask_above=1), PreparedDataset)
    with caplog.at_level(logging.WARNING):
        assert isinstance(open_dataset(root, "train", canvas=CANVAS, mask_above=64), DrivingDataset)
    assert "prepared with --mask-above 1 and not used, as 64 is wanted" in caplog.text
    for name in ("images/train/.DS_Store", "images/train/Thumbs.db", "det_annotations/train/._train_0000.json"):
        (root / name).touch()  # by looking at the folder
    assert isinstance(open_dataset(root, "train", canvas=CANVAS), PreparedDataset)
    path = root / "da_seg_annotations/train/train_0000.png"
    path.unlink()
    with caplog.at_level(logging.WARNING):
        assert isinstance(open_dataset(root, "train", canvas=CANVAS), DrivingDataset)
    assert "changed since it was prepared" in caplog.text


def test_twice_changes_nothing_and_changes_are_seen(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    prepare(root, out, canvas=CANVAS, shard_size=4)
    before = {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in out.glob("train-*")}
    prepare(root, out, canvas=CANVAS, shard_size=4)
    assert {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in out.glob("train-*")} == before
    # A mask of the second shard is drawn anew, and an image of the last one goes.
    path = root / "da_seg_annotations/train/train_0004.png"
    cv2.imwrite(str(path), np.zeros((72, 128), np.uint8))
    later = (out / "prepared.json").stat().st_mtime + 10
    os.utime(path, (later, later))
    (root / "images/train/train_0010.jpg").unlink()
    (out / ".train-000001.tar.x7.part").write_bytes(b"of a run that was killed")
    prepare(root, out, canvas=CANVAS, shard_size=4)
    assert not list(out.glob(".*"))
    after = {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in out.glob("train-*")}
    assert after["train-000000.tar"] == before["train-000000.tar"]
    assert after["train-000001.tar"] != before["train-000001.tar"]
    packed = PreparedDataset(out, "train")
    assert len(packed) == 10
    drivable = packed[4].drivable
    assert drivable is not None
    assert not drivable.any()


def test_prepared_from_files_of_another_day_it_is_the_same_data(root: Path, tmp_path: Path) -> None:
    prepare(root, tmp_path / "one", canvas=CANVAS)
    for path in root.glob("*/train/*"):
        os.utime(path, (10**9, 10**9))  # as by a copy to another machine
    prepare(root, tmp_path / "two", canvas=CANVAS)
    one, two = (identify(PreparedDataset(tmp_path / name, "train")) for name in ("one", "two"))
    assert tell_apart(one, two, strict=True) is None


def test_two_at_once_are_kept_apart(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    prepare(root, out, canvas=CANVAS)
    part = out / ".train-000000.tar.0a1b2c3d.part"
    part.touch()  # of the other
    with contextlib.closing(Claim(out / "prepared.json")), pytest.raises(OutputError, match="is being written already"):
        prepare(root, out, canvas=CANVAS)
    assert part.exists()
    prepare(root, out, canvas=CANVAS)
    assert not list(out.glob("*.part"))


def describe(root: Path, text: str) -> None:
    (root / "dataset.yaml").write_text(text)


def put_older_label(root: Path) -> None:
    path = root / "ll_seg_annotations/train/train_0001.png"
    cv2.imwrite(str(path), np.full((72, 128), 255, np.uint8))
    os.utime(path, (10**9, 10**9))


def swap_labels(root: Path) -> None:
    """Rename two files, which leaves the number, the bytes and the times of the split's files as they were."""
    first, second = (root / f"det_annotations/train/train_000{number}.json" for number in (0, 3))
    other = first.with_suffix(".other")
    first.rename(other), second.rename(first), other.rename(second)


CHANGES: dict[str, Callable[[Path], object]] = {
    "a label goes": lambda root: (root / "det_annotations/train/train_0001.json").unlink(),
    "an older label comes": put_older_label,
    "classes": lambda root: describe(root, "classes: {vehicle: [bus]}\nego_masks: {train_000: bonnet.png}\n"),
    "thresholds": lambda root: describe(root, "drivable: {above: 254}\nego_masks: {train_000: bonnet.png}\n"),
    "two labels change places": swap_labels,
    "no ego mask": lambda root: describe(root, ""),
    "another ego mask": lambda root: cv2.imwrite(str(root / "bonnet.png"), np.full((72, 128), 255, np.uint8)),
    "attributes": lambda root: (root / "index.csv").write_text("name,split,source\ntrain_0001,train,city\n"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_change_is_seen_and_prepared(root: Path, tmp_path: Path, change: str) -> None:
    prepare(root, canvas=CANVAS)
    CHANGES[change](root)
    assert isinstance(open_dataset(root, "train", canvas=CANVAS), DrivingDataset)
    prepare(root, canvas=CANVAS)
    again = open_dataset(root, "train", canvas=CANVAS)
    assert isinstance(again, PreparedDataset)
    prepare(root, tmp_path / "fresh", canvas=CANVAS)
    for name in ("train-000000.tar", "train-000000.index.jsonl"):
        assert (root / ".prepared" / name).read_bytes() == (tmp_path / "fresh" / name).read_bytes()


def test_splits_that_begin_alike_keep_their_shards(root: Path, tmp_path: Path) -> None:
    write_published(root, "train-2024", 3)
    for _ in range(2):
        prepare(root, tmp_path / "out", canvas=CANVAS, shard_size=2)
        for split, count in (("train", 11), ("train-2024", 3), ("val", 3)):
            assert len(PreparedDataset(tmp_path / "out", split).names) == count


def test_an_interrupted_change_of_the_shard_size_loses_nothing(root: Path) -> None:
    prepare(root, canvas=CANVAS, shard_size=4)

    def interrupt(done: int, _: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        prepare(root, canvas=CANVAS, shard_size=2, progress=interrupt)
    assert isinstance(open_dataset(root, "train", canvas=CANVAS), DrivingDataset)
    prepare(root, canvas=CANVAS, shard_size=2)
    assert PreparedDataset(root / ".prepared", "train").names == DrivingDataset(root, "train").names


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_progress_is_told_within_a_shard(root: Path, tmp_path: Path, workers: int) -> None:
    told: list[tuple[int, int]] = []
    prepare(
        root, tmp_path / "out", canvas=CANVAS, shard_size=7, workers=workers, progress=lambda *done: told.append(done)
    )
    assert told == sorted(told)
    assert told[-1] == (14, 14)
    if not workers:
        assert told == [(done, 14) for done in range(1, 15)]
    prepare(root, tmp_path / "out", canvas=CANVAS, shard_size=7, progress=lambda *done: told.append(done))
    assert told[-3:] == [(7, 14), (11, 14), (14, 14)]  # shards that are there


def test_long_names(root: Path, tmp_path: Path) -> None:
    name = "straße" * 20
    (root / "images/val/val_0000.jpg").rename(root / f"images/val/{name}.jpg")
    prepare(root, tmp_path / "out", canvas=CANVAS, splits=["val"])
    raw, packed = DrivingDataset(root, "val"), PreparedDataset(tmp_path / "out", "val")
    assert name in packed.names
    for index, whole in enumerate(raw):
        assert packed[index].name == whole.name
        assert (packed[index].lane is None) == (whole.lane is None)


def test_remote_shards_are_copied_when_used(root: Path, tmp_path: Path) -> None:
    pytest.importorskip("webdataset")
    prepare(root, tmp_path / "out", canvas=CANVAS)
    address = (tmp_path / "out").as_uri()
    remote = PreparedDataset(address, "val", cache=tmp_path / "copies")
    np.testing.assert_array_equal(remote[1].image, PreparedDataset(tmp_path / "out", "val")[1].image)
    assert not (tmp_path / "copies/train-000000.tar").exists()
    with pytest.raises(DataError, match="give `cache`"):
        PreparedDataset(address, "val")


def test_copies_of_remote_shards_are_of_one_state(root: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("webdataset")
    copies = tmp_path / "copies"
    prepare(root, tmp_path / "out", canvas=CANVAS)
    address = (tmp_path / "out").as_uri()
    first = PreparedDataset(address, "val", cache=copies)
    image = first[0].image
    other = tmp_path / "other"
    write_published(other, "val", 3, (50, 90), seed=7)
    prepare(other, tmp_path / "two", canvas=CANVAS)
    second = PreparedDataset((tmp_path / "two").as_uri(), "val", cache=copies)[0].image
    assert not np.array_equal(second, image)
    for folder in ("images", "det_annotations"):
        shutil.rmtree(root / folder / "val")
        shutil.copytree(other / folder / "val", root / folder / "val")
    prepare(root, tmp_path / "out", canvas=CANVAS)
    again = PreparedDataset(address, "val", cache=copies)
    for index, sample in enumerate(PreparedDataset(tmp_path / "out", "val")):
        np.testing.assert_array_equal(again[index].image, sample.image)
        np.testing.assert_array_equal(again[index].boxes, sample.boxes)
    open_since = PreparedDataset(address, "train", cache=copies)
    shutil.rmtree(tmp_path / "out")
    prepare(root, tmp_path / "out", canvas=CANVAS, images="jpeg")
    with pytest.raises(DataError, match=r"train-000000\.tar: was prepared anew since it was opened; begin again$"):
        open_since[0]
    anew = PreparedDataset(address, "val", cache=copies)
    for index, sample in enumerate(PreparedDataset(tmp_path / "out", "val")):
        np.testing.assert_array_equal(anew[index].image, sample.image)
    (tmp_path / "out/prepared.json").write_text("<html>Sign in</html>")  # what answers is something else
    np.testing.assert_array_equal(PreparedDataset(address, "val", cache=copies)[0].image, anew[0].image)
    with pytest.raises(DataError, match=rf"^{address}/prepared\.json: cannot be read .*; prepare the data set again$"):
        PreparedDataset(address, "val", cache=tmp_path / "no copies")
    shutil.rmtree(tmp_path / "out")  # as if the network were down
    np.testing.assert_array_equal(PreparedDataset(address, "val", cache=copies)[0].image, anew[0].image)
    assert "going on with the copies" in caplog.text


def test_a_data_set_at_an_address_is_opened_like_a_folder(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr("trilitenet.data.prepared._PAUSES", (0.0,))
    prepare(root, tmp_path / "out", canvas=CANVAS, shard_size=4)
    here = PreparedDataset(tmp_path / "out", "train")
    with serving(tmp_path) as site:
        address = f"{site.address}/out"
        there = open_dataset(address, "train", canvas=CANVAS)
        assert isinstance(there, PreparedDataset)
        assert identify(there) == identify(here)
        assert "train-000000.tar" not in site.asked
        site.fails = {"train-000001.tar": 1}  # it breaks off, and comes whole when it is asked for again
        told: list[tuple[int, int]] = []
        there.copy(lambda *counts: told.append(counts))
        assert told == [(1, 3), (2, 3), (3, 3)]
        assert site.asked.count("train-000001.tar") == 2
        np.testing.assert_array_equal(there[5].image, here[5].image)
        count = len(site.asked)
        again = open_dataset(Path(f"{address}/"), "train")  # a path eats a slash
        assert isinstance(again, PreparedDataset)
        again.copy()
        assert open_dataset(f"{address}/", "train").names == here.names
        assert len(site.asked) == count + 2  # for prepared.json
        assert default_cache() == tmp_path / "home/trilitenet"
        assert len(list(tmp_path.glob("home/trilitenet/*.json"))) == 1
        with pytest.raises(DataError, match=rf"^{address}: prepared with --mask-above 1, 64 is wanted"):
            open_dataset(address, "train", canvas=CANVAS, mask_above=64)
        site.fails = {"train-000000.tar": 2}
        other = open_dataset(address, "train", cache=tmp_path / "cache")
        with pytest.raises(DataError, match=r"/train-000000\.tar: cannot be fetched \(999990 bytes are missing at"):
            other[0]
        site.busy = {"prepared.json"}
        with pytest.raises(DataError, match=r"/prepared\.json: cannot be fetched \(HTTP Error 503: [^)]*\)$"):
            open_dataset(address, "train", cache=tmp_path / "none")
        site.busy = set()
        with pytest.raises(DataError, match=r"/no/prepared\.json: cannot be fetched \(HTTP Error 404: .*\); give the"):
            open_dataset(f"{site.address}/no", "train")
    there.copy()
    with pytest.raises(DataError, match=rf"^{address}/prepared\.json: cannot be fetched \(.*refused\)$"):
        open_dataset(address, "train", cache=tmp_path / "another")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"file.*: cannot be written"):
        open_dataset(address, "train", cache=tmp_path / "file" / "cache")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's /dev/full")
def test_a_shard_for_which_there_is_no_room_is_asked_for_once(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare(root, tmp_path / "out", canvas=CANVAS)
    plain = Path.open
    with serving(tmp_path / "out") as site:
        dataset = PreparedDataset(site.address, "val", cache=tmp_path / "copies")

        def full(path: Path, *options: Any, **more: Any) -> Any:
            return plain(Path("/dev/full") if path.suffix == ".part" else path, *options, **more)

        monkeypatch.setattr(Path, "open", full)
        with pytest.raises(OutputError, match="No space left"):
            dataset[0]
        assert site.asked.count("val-000000.tar") == 1


def test_a_shard_is_copied_once_whoever_wants_it(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fcntl")
    prepare(root, tmp_path / "out", canvas=CANVAS)
    with serving(tmp_path / "out") as site:
        dataset = PreparedDataset(site.address, "val", cache=tmp_path / "copies")
        both = threading.Barrier(2)
        plain = Path.is_file

        def is_file(path: Path) -> bool:
            found = plain(path)
            if path.suffix == ".tar" and not both.broken and not found:
                with contextlib.suppress(threading.BrokenBarrierError):
                    both.wait(1)  # both see that it is not there
            return found

        monkeypatch.setattr(Path, "is_file", is_file)
        with concurrent.futures.ThreadPoolExecutor(2) as pool:
            first, second = pool.map(dataset.__getitem__, (0, 0))
        np.testing.assert_array_equal(first.image, second.image)
        assert site.asked.count("val-000000.tar") == 1


def test_other_pixels_make_another_data_set(root: Path, tmp_path: Path) -> None:
    identities = []
    for _ in range(2):
        prepare(root, tmp_path / "out", canvas=CANVAS)
        identities.append(identify(PreparedDataset(tmp_path / "out", "val")))
        path = root / "ll_seg_annotations/val/val_0001.png"
        cv2.imwrite(str(path), 255 - np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))
    assert tell_apart(*identities) is None
    assert tell_apart(*identities, strict=True) == "other images or labels of the same names"


@pytest.mark.slow
def test_processes_write_the_same_shards(root: Path, tmp_path: Path) -> None:
    prepare(root, tmp_path / "one", canvas=CANVAS, shard_size=4)
    prepare(root, tmp_path / "two", canvas=CANVAS, shard_size=4, workers=2)
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes(), path.name


def test_errors(root: Path, tmp_path: Path) -> None:
    prepare(root, tmp_path / "out", canvas=CANVAS)
    with pytest.raises(OutputError, match="other settings"):
        prepare(root, tmp_path / "out", canvas=(96, 96))
    with pytest.raises(OutputError, match="not empty"):
        prepare(root, root)
    faults: list[dict[str, Any]] = [
        {"canvas": (100, 160)},
        {"canvas": (0, 0)},
        {"quality": 500},
        {"mask_above": 300},
        {"shard_size": 0},
    ]
    for fault in faults:
        with pytest.raises(ConfigError):
            prepare(root, tmp_path / "other", **{"canvas": CANVAS, **fault})
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match=r"file.*cannot be written"):
        prepare(root, tmp_path / "file", canvas=CANVAS)
    with pytest.raises(DataError, match="no split 'test'"):
        PreparedDataset(tmp_path / "out", "test")
    with pytest.raises(DataError, match="prepared with the classes"):
        PreparedDataset(tmp_path / "out", "val", class_names=["car"])
    (tmp_path / "out/val-000000.tar").unlink()
    with pytest.raises(DataError, match=r"val-000000\.tar: missing"):
        PreparedDataset(tmp_path / "out", "val")[0]
    (tmp_path / "out/prepared.json").write_text("{}")
    with pytest.raises(DataError, match="format None"):
        PreparedDataset(tmp_path / "out", "val")


def test_damaged_shards_are_named_and_made_anew(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    prepare(root, out, canvas=CANVAS, splits=["train"], shard_size=4)
    shard, index = out / "train-000001.tar", out / "train-000001.index.jsonl"
    whole = {path: path.read_bytes() for path in (shard, index)}

    def read() -> list[str]:
        return [sample.name for sample in PreparedDataset(out, "train")]

    names = read()
    for path, content, message in (
        (shard, whole[shard][: len(whole[shard]) // 2], r"train-000001\.tar: is cut short; prepare the data set again"),
        (index, whole[index][:-9], r"train-000001\.index\.jsonl: is damaged; prepare the data set again"),
        (
            index,
            b"[]\n" + whole[index].partition(b"\n")[2],
            r"train-000001\.index\.jsonl: is damaged; prepare the data set again",
        ),
        (index, b"", r"train-000001\.index\.jsonl: is empty; prepare the data set again"),
        (index, whole[index].partition(b"\n")[2], "out: the index of train holds 10 images, not 11; prepare the data"),
    ):
        path.write_bytes(content)
        with pytest.raises(DataError, match=message):
            read()
        prepare(root, out, canvas=CANVAS, splits=["train"], shard_size=4)
        assert {path: path.read_bytes() for path in whole} == whole
        assert read() == names
    for text, message in (("[1]", "format None"), ('{"format": 1}', "lacks canvas"), ("{", "cannot be read")):
        (out / "prepared.json").write_text(text)
        with pytest.raises(
            DataError, match=rf"prepared\.json: {message}.*; remove .*out and prepare the data set again"
        ):
            read()


def test_a_split_without_images_is_left_out(root: Path, tmp_path: Path) -> None:
    (root / "images" / "test").mkdir()
    assert set(prepare(root, tmp_path / "out", canvas=CANVAS)) == {"train", "val"}
    with pytest.raises(DataError, match="no images"):
        prepare(root, tmp_path / "other", canvas=CANVAS, splits=["test"])


def test_what_is_prepared_again_is_read_anew(root: Path, tmp_path: Path) -> None:
    prepare(root, tmp_path / "out", canvas=CANVAS)
    assert PreparedDataset(tmp_path / "out", "val")[0].image.any()
    for path in (root / "images/val").iterdir():
        cv2.imwrite(str(path), np.full((50, 90, 3), 200, np.uint8))
    prepare(root, tmp_path / "out", canvas=CANVAS)
    assert abs(PreparedDataset(tmp_path / "out", "val")[0].image.astype(int) - 200).max() < 4


def test_whether_a_task_is_labelled_is_known(root: Path, tmp_path: Path) -> None:
    for path in (root / "ll_seg_annotations/train").iterdir():
        path.unlink()
    prepare(root, tmp_path / "out", canvas=CANVAS)
    for dataset in (DrivingDataset(root, "train"), PreparedDataset(tmp_path / "out", "train")):
        assert [dataset.has_labels(task) for task in ("detection", "drivable", "lane")] == [True, True, False]
    assert not PreparedDataset(tmp_path / "out", "train", tasks=("lane",)).has_labels("detection")


def test_images_that_are_gone_are_gone_from_the_prepared_copy_too(root: Path, tmp_path: Path) -> None:
    prepare(root, tmp_path / "out", canvas=CANVAS, splits=["train"], shard_size=4)
    names = sorted(path.stem for path in (root / "images/train").iterdir())
    for name in names[4:]:
        (root / f"images/train/{name}.jpg").unlink()
    prepare(root, tmp_path / "out", canvas=CANVAS, splits=["train"], shard_size=4)
    assert PreparedDataset(tmp_path / "out", "train").names == names[:4]
    assert len(list((tmp_path / "out").glob("train-*"))) == 2  # a shard and its index


def test_names_that_differ_in_an_escape_alone_are_two(root: Path, tmp_path: Path) -> None:
    folder = root / "images" / "test"
    folder.mkdir()
    for number, name in enumerate(("a.b", "a%2Eb")):
        cv2.imwrite(str(folder / f"{name}.png"), np.full((64, 96, 3), 100 * number, np.uint8))
    prepare(root, tmp_path / "out", canvas=CANVAS, splits=["test"])
    packed = PreparedDataset(tmp_path / "out", "test")
    assert {sample.name: int(sample.image.max()) for sample in packed} == {"a.b": 0, "a%2Eb": 100}


def test_an_own_car_mask_elsewhere(root: Path, tmp_path: Path) -> None:
    elsewhere = (root / "bonnet.png").rename(tmp_path / "bonnet.png")
    describe(root, f"ego_mask: {elsewhere}\n")
    prepare(root, canvas=CANVAS)
    assert isinstance(open_dataset(root, "train", canvas=CANVAS), PreparedDataset)
    os.utime(elsewhere, ns=(1, 1))
    assert isinstance(open_dataset(root, "train", canvas=CANVAS), DrivingDataset)


def test_a_split_of_any_name_is_copied_from_an_address(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trilitenet.data.prepared._PAUSES", ())
    split = "jour d'été #1 50%"
    for folder in root.glob("*/val"):
        folder.rename(folder.with_name(split))
    prepare(root, tmp_path / "out", canvas=CANVAS, splits=[split])
    with serving(tmp_path / "out") as site:
        there = open_dataset(site.address, split, cache=tmp_path / "cache")
        assert len(there) == 3
        np.testing.assert_array_equal(there[2].image, PreparedDataset(tmp_path / "out", split)[2].image)


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are text elsewhere")
def test_names_that_are_no_text_are_prepared(root: Path, tmp_path: Path) -> None:
    name = os.fsdecode(b"\xff")
    for folder, ending in (("images", "jpg"), ("det_annotations", "json")):
        (root / folder / "val" / f"val_0000.{ending}").rename(root / folder / "val" / f"{name}.{ending}")
    prepare(root, canvas=CANVAS, splits=["val"])
    packed = open_dataset(root, "val", canvas=CANVAS)
    assert isinstance(packed, PreparedDataset)
    assert packed[-1].name == DrivingDataset(root, "val")[2].name == name
    assert tell_apart(identify(packed), identify(DrivingDataset(root, "val"))) is None


def test_a_full_disk_is_told(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare(root, tmp_path / "out", canvas=CANVAS, splits=["val"])

    def full(self: Path, *args: Any, **more: Any) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OutputError, match="out: cannot be written"):
        prepare(root, tmp_path / "out", canvas=CANVAS, splits=["val"])


def test_classes_that_no_box_is_of_are_told(root: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(DataError, match="no box is of the class out, zebra; a folder to write goes before --classes"):
        prepare(root, canvas=CANVAS, splits=["val"], class_names=("car", "zebra", "out"))
    assert not (root / ".prepared").exists()
    prepare(root, tmp_path / "own", canvas=CANVAS, splits=["val"])
    assert not caplog.text
    write_annotation(root, "val", "val_0000", [{"category": "Zebra", "box2d": {"x1": 1, "y1": 1, "x2": 9, "y2": 9}}])
    describe(root, "classes: {car: [car], zebra: [zebra]}\n")
    prepare(root, tmp_path / "out", canvas=CANVAS, splits=["val"])
    assert "is of the class zebra, and those of Zebra are of none; say under classes: in dataset.yaml" in caplog.text
    caplog.clear()
    describe(root, "classes: {car: [car], zebra: [zebra]}\nignore: [Zebra]\n")
    prepare(root, tmp_path / "ignored", canvas=CANVAS, splits=["val"])
    assert not caplog.text
