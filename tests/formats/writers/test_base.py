from __future__ import annotations

import contextlib
import dataclasses
import errno
import gc
import importlib
import io
import json
import signal
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.fakes import written_by_another_process
from trilitenet.errors import ConfigError, OutputError, part_of
from trilitenet.formats.writers.base import WRITERS, JsonStream, open_writer, uninterrupted
from trilitenet.road.structures import Road
from trilitenet.structures import Boxes, Perception

TASKS_GONE = Perception(size=(120, 200), class_names=("vehicle",), source="tasks.jpg")


@pytest.fixture(params=sorted(WRITERS))
def format_name(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    if name == "parquet":
        pytest.importorskip("pyarrow")
    return name


def test_every_writer_takes_everything(
    format_name: str, tmp_path: Path, pictures: list[Perception], video: list[Perception]
) -> None:
    unnamed = dataclasses.replace(pictures[0], source=None)
    with open_writer(format_name, tmp_path) as writer:
        for perception in [*pictures, TASKS_GONE, unnamed, unnamed, *video]:
            writer.write(perception)
    writer.close()
    assert writer.files
    assert len(set(writer.files)) == len(writer.files)
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == set(writer.files), "and nothing else is left"


def test_no_writer_replaces_a_file_unasked(format_name: str, tmp_path: Path, pictures: list[Perception]) -> None:
    def write(overwrite: bool) -> None:
        with open_writer(format_name, tmp_path, overwrite=overwrite) as writer:
            writer.write(pictures[0])

    write(overwrite=False)
    with pytest.raises(OutputError, match="--overwrite"):
        write(overwrite=False)
    write(overwrite=True)


@pytest.mark.skipif(sys.platform == "win32", reason="files are not locked there")
@pytest.mark.parametrize(
    ("name", "file"),
    [("coco", "coco.json"), ("json", "a.json"), ("jsonl", "perceptions.jsonl"), ("csv", "boxes.csv")],
)
def test_a_file_that_another_process_writes_is_left_to_it(
    name: str, file: str, tmp_path: Path, video: list[Perception]
) -> None:
    def write() -> None:
        with open_writer(name, tmp_path, overwrite=True) as writer:
            for perception in video:
                writer.write(dataclasses.replace(perception, source="a.mp4"))

    with written_by_another_process(tmp_path / file):
        with pytest.raises(OutputError, match=rf"{file}: it is being written already; wait for its end"):
            write()
        assert part_of(tmp_path / file).read_text() == "half\n"
        gc.collect()
        assert list(tmp_path.iterdir()) == [part_of(tmp_path / file)]
    write()
    assert (tmp_path / file).exists()
    assert not list(tmp_path.glob("*.part"))


@pytest.mark.skipif(sys.platform == "win32", reason="files are not locked there")
@pytest.mark.parametrize(("name", "file"), [("jsonl", "perceptions.jsonl"), ("csv", "frames.csv")])
def test_a_file_that_grows_is_left_to_its_writer(name: str, file: str, tmp_path: Path, video: list[Perception]) -> None:
    with open_writer(name, tmp_path, overwrite=True) as writer:
        writer.write(dataclasses.replace(video[0], source="a.mp4"))
        files = sorted(tmp_path.iterdir())
        with pytest.raises(OutputError, match=rf"{file}: it is being written already; wait for its end"):
            open_writer(name, tmp_path, overwrite=True)
        assert sorted(tmp_path.iterdir()) == files
        writer.write(dataclasses.replace(video[1], source="a.mp4"))
    assert len((tmp_path / file).read_text().splitlines()) == 2 + (name == "csv")
    open_writer(name, tmp_path, overwrite=True).close()


def test_a_writer_that_is_given_nothing_replaces_nothing(
    format_name: str, tmp_path: Path, pictures: list[Perception]
) -> None:
    with open_writer(format_name, tmp_path) as writer:
        writer.write(pictures[0])
    before = {path: path.read_bytes() for path in writer.files}
    with open_writer(format_name, tmp_path, overwrite=True) as writer:
        pass
    assert writer.files == []
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_all_frames_of_a_video_go_into_the_same_files(format_name: str, tmp_path: Path) -> None:
    frame = Perception((4, 6), boxes=Boxes.empty(), drivable=np.ones((4, 6), np.bool_), source="a.mp4", frame=0)
    with open_writer(format_name, tmp_path) as writer:
        for index in range(300):
            writer.write(dataclasses.replace(frame, frame=index, timestamp=index / 30))
    assert len(writer.files) in {1, 2, 301}


def test_nothing_is_taken_after_the_end(format_name: str, tmp_path: Path, pictures: list[Perception]) -> None:
    with open_writer(format_name, tmp_path) as writer:
        writer.write(pictures[0])
    with pytest.raises(OutputError, match="the writer was closed"):
        writer.write(pictures[1])
    writer.close()


def test_unknown_format_names_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'openlabel'"):
        open_writer("openlable", tmp_path)


def test_a_file_gets_its_name_when_it_is_whole(tmp_path: Path) -> None:
    stream = JsonStream(tmp_path / "a.json", "[")
    stream.add({"a": 1})
    assert not (tmp_path / "a.json").exists()
    stream.close("]")
    assert json.loads(part_of(tmp_path / "a.json").read_text()) == [{"a": 1}]


def test_output_that_is_a_file_is_an_error(tmp_path: Path, pictures: list[Perception]) -> None:
    (tmp_path / "taken").write_text("x")
    with pytest.raises(OutputError, match="taken"), open_writer("jsonl", tmp_path / "taken") as writer:
        writer.write(pictures[0])


@pytest.fixture(params=[signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "sigterm"])
def interruption(request: pytest.FixtureRequest) -> Iterator[signal.Signals]:
    """A signal that interrupts: a process that a shell put into the background ignores Ctrl-C."""
    number: signal.Signals = request.param
    before = signal.signal(number, signal.default_int_handler)
    yield number
    signal.signal(number, before)


@pytest.mark.parametrize(
    ("name", "step"),
    [("coco", "coco.encode_mask"), ("cvat", "cvat.cvat_mask"), ("openlabel", "base.dumps"), ("scalabel", "base.dumps")],
)
def test_an_interruption_waits_until_a_result_is_whole(
    name: str,
    step: str,
    tmp_path: Path,
    pictures: list[Perception],
    monkeypatch: pytest.MonkeyPatch,
    interruption: signal.Signals,
) -> None:
    steps = 0

    def write() -> None:
        with open_writer(name, tmp_path) as writer:
            writer.write(pictures[0])
            module, _, function = f"trilitenet.formats.writers.{step}".rpartition(".")
            plain = getattr(importlib.import_module(module), function)

            def interrupted(value: Any) -> Any:
                nonlocal steps
                steps += 1
                signal.raise_signal(interruption)
                return plain(value)

            monkeypatch.setattr(f"{module}.{function}", interrupted)
            writer.write(dataclasses.replace(pictures[0], source="again.jpg"))

    with pytest.raises(KeyboardInterrupt):
        write()
    assert steps
    assert signal.getsignal(interruption) is signal.default_int_handler
    if name == "openlabel":
        written = [json.loads(path.read_text())["openlabel"] for path in tmp_path.glob("*.json")]
        assert [len(one["frames"]) for one in written] == [1, 1]
    elif name == "cvat":
        images = ElementTree.parse(tmp_path / "cvat-images.xml").findall("image")
        assert [len(image) for image in images] == [4, 4]
    elif name == "coco":
        coco = json.loads((tmp_path / "coco.json").read_text())
        assert [image["id"] for image in coco["images"]] == [1, 2]
        assert [label["image_id"] for label in coco["annotations"]] == [1, 1, 1, 1, 2, 2, 2, 2]
    else:
        assert len(json.loads((tmp_path / "scalabel.json").read_text())["frames"]) == 2
    assert not list(tmp_path.glob("*.part"))


def test_pictures_of_one_name_are_listed_with_their_folders(tmp_path: Path, pictures: list[Perception]) -> None:
    with open_writer("coco", tmp_path) as writer:
        for picture in pictures:
            writer.stem(picture.source)
        for picture in [*pictures, dataclasses.replace(pictures[0], source="day/other.jpg")]:
            writer.write(picture)
    images = json.loads((tmp_path / "coco.json").read_text())["images"]
    assert [image["file_name"] for image in images] == ["day/road.jpg", "night/road.jpg", "other.jpg"]


@pytest.mark.parametrize("name", ["coco", "json", "openlabel", "scalabel"])
def test_a_failed_write_leaves_no_file_with_a_gap(
    name: str, tmp_path: Path, video: list[Perception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(stream: JsonStream, value: Any, key: str | None = None) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def write() -> None:
        with open_writer(name, tmp_path) as writer:
            writer.write(video[0])
            with monkeypatch.context() as patch:
                patch.setattr(JsonStream, "add", full)
                with pytest.raises(OSError, match="No space left"):
                    writer.write(video[1])
            writer.write(video[2])  # there is room again

    with pytest.raises(OutputError, match="gap"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_a_name_that_is_not_utf_8_is_refused_and_spoils_no_other(
    format_name: str, tmp_path: Path, pictures: list[Perception], video: list[Perception]
) -> None:
    for folder, bad in (("one", ()), ("two", (pictures[0], video[0]))):
        with open_writer(format_name, tmp_path / folder) as writer:
            for perception in bad:
                with pytest.raises(OutputError, match=r"caf\\udce9: its name is not UTF-8; rename it"):
                    writer.write(dataclasses.replace(perception, source="caf\udce9"))
            for perception in [*pictures, *video]:
                writer.write(perception)
    files = {
        folder: {path.name: path.read_bytes() for path in (tmp_path / folder).rglob("*") if path.is_file()}
        for folder in ("one", "two")
    }
    assert files["two"] == files["one"]


def test_paths_and_numbers_of_numpy_are_written_as_others_are(
    format_name: str, tmp_path: Path, pictures: list[Perception], video: list[Perception]
) -> None:
    kinds: dict[str, tuple[Any, Any, Any]] = {"one": (str, int, float), "two": (Path, np.int64, np.float32)}
    for folder, (text, whole, number) in kinds.items():
        with open_writer(format_name, tmp_path / folder) as writer:
            for perception in (pictures[0], video[0], video[1]):
                origin: dict[str, Any] = {"source": text(perception.source), "size": tuple(map(whole, perception.size))}
                if perception.frame is not None:
                    origin |= {"frame": whole(perception.frame), "timestamp": number(perception.frame / 4)}
                writer.write(dataclasses.replace(perception, **origin))
    files = {
        folder: {path.name: path.read_bytes() for path in (tmp_path / folder).rglob("*") if path.is_file()}
        for folder in ("one", "two")
    }
    assert files["two"] == files["one"]


@pytest.mark.parametrize("name", ["json", "openlabel"])
def test_a_value_that_json_has_not_leaves_no_broken_file(
    name: str, tmp_path: Path, video: list[Perception], road: Road
) -> None:
    document = road.to_dict()
    document["ego_lane"]["offset"]["value"] = float("nan")
    with open_writer(name, tmp_path) as writer:
        writer.write(video[0])
        with pytest.raises(ValueError, match="JSON"):
            writer.write(video[1], document)
    (path,) = tmp_path.glob("*.json")
    assert json.loads(path.read_text())


@pytest.mark.skipif(sys.platform == "win32", reason="the size of files is not limited there")
@pytest.mark.parametrize("name", ["csv", "jsonl"])
def test_a_full_disk_leaves_whole_frames_in_files_that_grow(name: str, tmp_path: Path, video: list[Perception]) -> None:
    import resource

    with open_writer(name, tmp_path) as writer:
        for perception in video[:2]:
            writer.write(perception)
        before = {path: path.read_bytes() for path in writer.files}
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        smaller = min(map(len, before.values())) if name == "jsonl" else len(before[tmp_path / "boxes.csv"])
        resource.setrlimit(resource.RLIMIT_FSIZE, (smaller + 20, limits[1]))
        try:
            with pytest.raises(OSError, match="File too large") as caught:
                writer.write(video[2])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert Path(caught.value.filename) in writer.files
        with pytest.raises(OutputError, match="gap"):
            writer.write(video[2])
    assert {path: path.read_bytes() for path in writer.files} == before


@pytest.mark.parametrize(
    ("name", "file"), [("csv", "boxes.csv"), ("csv", "frames.csv"), ("jsonl", "perceptions.jsonl")]
)
def test_a_first_frame_that_cannot_be_written_replaces_nothing(
    name: str, file: str, tmp_path: Path, video: list[Perception]
) -> None:
    with open_writer(name, tmp_path) as writer:
        writer.write(video[0])
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    (tmp_path / f"{file}.part").mkdir()
    with open_writer(name, tmp_path, overwrite=True) as writer, pytest.raises(OSError, match=file):
        writer.write(video[1])
    assert writer.files == []
    (tmp_path / f"{file}.part").rmdir()
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("source", "stem"),
    [
        ("/", "image"),
        ("frames/a.b.jpg", "a.b"),
        ("rtsp://10.0.0.1:8554/front.sdp", "front"),
        ("rtsp://10.0.0.1", "10.0.0.1"),
        ("udp://10.0.0.1:1234", "10.0.0.1-1234"),
    ],
)
def test_files_are_called_as_their_source(tmp_path: Path, source: str, stem: str) -> None:
    with open_writer("coco", tmp_path) as writer:
        assert writer.stem(source) == stem


def test_a_folder_of_that_name_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "coco.json").mkdir()
    with pytest.raises(OutputError, match="exists"):
        open_writer("coco", tmp_path)


@pytest.mark.parametrize("name", ["csv", "jsonl"])
def test_a_disk_that_is_full_from_the_beginning_leaves_no_file(
    name: str, tmp_path: Path, video: list[Perception], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full(io.FileIO):
        def write(self, data: Any) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("trilitenet.formats.writers.base.io.FileIO", Full)
    with open_writer(name, tmp_path) as writer:
        with pytest.raises(OSError, match="No space left"):
            writer.write(video[0])
        assert writer.files == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["csv", "jsonl"])
@pytest.mark.parametrize("full", [False, True])
def test_no_file_is_renamed_or_removed_while_it_is_open(
    name: str, full: bool, tmp_path: Path, video: list[Perception], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[io.FileIO] = []
    moved: list[bool] = []  # Windows refuses what is still open

    class Watched(io.FileIO):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            opened.append(self)

        def write(self, data: Any) -> int:
            if full:
                raise OSError(errno.ENOSPC, "No space left on device")
            return super().write(data)

    def watch(method: str) -> None:
        original = getattr(Path, method)

        def watched(self: Path, *arguments: Any, **more: Any) -> Any:
            moved.append(any(not file.closed for file in opened if file.name == self))
            return original(self, *arguments, **more)

        monkeypatch.setattr(Path, method, watched)

    monkeypatch.setattr("trilitenet.formats.writers.base.io.FileIO", Watched)
    watch("replace")
    watch("unlink")
    with open_writer(name, tmp_path) as writer:
        for perception in video[:1] if full else video[:2]:
            with contextlib.suppress(OSError):
                writer.write(perception)
    assert moved
    assert not any(moved)
    if name == "jsonl" and not full:
        assert len((tmp_path / "perceptions.jsonl").read_text().splitlines()) == 2


def test_a_picture_whose_file_is_there_does_not_keep_others_from_theirs(
    tmp_path: Path, pictures: list[Perception]
) -> None:
    (tmp_path / "road.json").write_text("mine")
    with open_writer("json", tmp_path) as writer:
        with pytest.raises(OutputError, match="--overwrite"):
            writer.write(pictures[0])
        writer.write(dataclasses.replace(pictures[0], source="other.jpg"))
    assert (tmp_path / "road.json").read_text() == "mine"
    assert writer.files == [tmp_path / "other.json"]


def test_a_disk_that_is_still_full_at_the_end_is_not_told_twice(
    tmp_path: Path, pictures: list[Perception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(stream: JsonStream, *_: object, **__: object) -> None:
        stream._handle.close()
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(JsonStream, "add", full)
    monkeypatch.setattr(JsonStream, "close", full)
    with open_writer("coco", tmp_path) as writer, pytest.raises(OSError, match="No space left"):
        writer.write(pictures[0])
    assert list(tmp_path.iterdir()) == []
    other = open_writer("coco", tmp_path)
    with pytest.raises(OSError, match="No space left"), other:
        pass  # nothing was told before
    assert list(tmp_path.iterdir()) == []


def test_half_a_document_is_taken_back(
    tmp_path: Path, pictures: list[Perception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(path: Path, text: str, encoding: str) -> None:
        path.write_bytes(text[: len(text) // 2].encode())
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", half)
    with pytest.raises(OSError, match="No space left"), open_writer("json", tmp_path) as writer:
        writer.write(pictures[0])
    assert list(tmp_path.iterdir()) == []


def test_an_interruption_that_is_ignored_stays_so(interruption: signal.Signals) -> None:
    signal.signal(interruption, signal.SIG_IGN)
    with uninterrupted():
        signal.raise_signal(interruption)
    assert signal.getsignal(interruption) is signal.SIG_IGN
