from __future__ import annotations

import functools
import http.server
import io
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rich.progress import Progress, TaskID

from tests.fakes import ColourBackend, coloured_scene
from trilitenet.apps import cli
from trilitenet.commands import predict as command
from trilitenet.commands.predict import RoadOptions, predict_with
from trilitenet.errors import BackendError, ConfigError, InputError, MissingExtraError, OutputError, ShapeError
from trilitenet.formats.writers.native import JsonWriter
from trilitenet.formats.writers.yolo import YoloWriter
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.sources import Clip, StreamReader, VideoReader
from trilitenet.inference.video import PerceptionStream, VideoWriter
from trilitenet.models.trilitenet import build_network
from trilitenet.models.weights import save_network
from trilitenet.processing.geometry import Camera
from trilitenet.structures import Perception


@pytest.fixture
def predictor() -> Predictor:
    return Predictor(ColourBackend(), batch_size=4)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    network = build_network("tiny")
    save_network(network, tmp_path / "random.safetensors", network.card)
    return tmp_path / "random.safetensors"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with good pictures of every kind, and bad files."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    scene = coloured_scene()
    Image.fromarray(scene).save(folder / "photo.jpg", quality=95)
    Image.fromarray(scene[..., 1]).save(folder / "grey.png")
    Image.fromarray(np.dstack([scene, np.full(scene.shape[:2], 200, np.uint8)])).save(folder / "alpha.png")
    Image.fromarray(scene[..., 0].astype(np.uint16) * 257).save(folder / "deep.png")
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned clockwise to be upright
    Image.fromarray(np.ascontiguousarray(np.rot90(scene))).save(folder / "turned.jpg", exif=exif, quality=95)
    jpeg = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (200, 200, 3), dtype=np.uint8)).save(jpeg, "JPEG")
    (folder / "truncated.jpg").write_bytes(jpeg.getvalue()[:4000])
    (folder / "text.txt").write_text("no picture")
    (folder / "empty.jpg").write_bytes(b"")
    (folder / ".hidden").write_bytes(b"x")
    return folder


def drive(path: Path, frames: int = 12, rate: float = 10) -> Path:
    with VideoWriter(path, rate) as writer:
        for i in range(frames):
            scene = coloured_scene(180, 320)
            scene[:20, : 10 * i + 2] = 255
            writer.write(scene)
    return path


def test_a_folder_of_good_and_bad(folder: Path, tmp_path: Path, predictor: Predictor) -> None:
    output = tmp_path / "out"
    report = predict_with(predictor, [folder, tmp_path / "absent.jpg"], output)
    assert report.images == 5
    assert report.exit_code == 1
    assert {Path(failure.source).name for failure in report.failures} == {
        "truncated.jpg", "text.txt", "empty.jpg", "absent.jpg",
    }  # fmt: skip
    assert all(failure.source in failure.reason for failure in report.failures)
    names = {"photo", "grey", "alpha", "deep", "turned"}
    assert {path.name for path in output.iterdir()} == {f"{n}.{e}" for n in names for e in ("jpg", "json")}
    for name in ("photo", "alpha", "turned"):
        perception = Perception.from_dict(json.loads((output / f"{name}.json").read_text()))
        assert perception.size == (360, 640), "the rotation must have been applied"
        assert perception.boxes is not None
        np.testing.assert_allclose(perception.boxes.xyxy, [[160, 90, 320, 180]], atol=4)
        assert perception.drivable is not None
        assert perception.drivable.mean() == pytest.approx(0.5, abs=0.02)
        overlay = np.asarray(Image.open(output / f"{name}.jpg"))
        assert overlay.shape == (360, 640, 3)
        assert np.abs(overlay.astype(int) - coloured_scene()).mean() > 5


def test_the_command_line(folder: Path, tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["predict", str(folder), "--output", str(tmp_path / "out"), "--model", str(weights), "--device", "cpu"]
    assert cli.main(words) == 1
    captured = capsys.readouterr()
    assert "5 images" in captured.out
    assert "3 failed" in captured.out
    assert [line.partition(": ")[0] for line in captured.err.splitlines()] == ["error"] * 3
    for name in ("truncated.jpg", "text.txt", "empty.jpg"):
        assert f"{folder / name}: " in captured.err
    assert cli.main(words) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert cli.main([*words, "--overwrite", "--hide", "labels", "--hide", "lane"]) == 1
    assert cli.main(["predict", "--output", "x"]) == 1
    assert "no source was given" in capsys.readouterr().err


def test_texts_do_in_python(folder: Path, tmp_path: Path, predictor: Predictor) -> None:
    report = predict_with(predictor, str(folder / "photo.jpg"), str(tmp_path / "out"), format="coco", hide="labels")
    assert report.images == 1
    assert (tmp_path / "out" / "coco.json").is_file()


def test_existing_results_are_refused_before_the_work_begins(
    folder: Path, tmp_path: Path, predictor: Predictor
) -> None:
    output = tmp_path / "out"
    output.mkdir()
    for name in ("photo.jpg", "photo.json"):
        (output / name).write_text("kept")
        with pytest.raises(OutputError, match=f"{name}: exists already; choose another --output or add --overwrite"):
            predict_with(predictor, [folder], output)
        assert (output / name).read_text() == "kept"
        assert len(list(output.iterdir())) == 1
        (output / name).unlink()
    assert predictor.backend.batches == []  # type: ignore[attr-defined]
    (output / "other.jpg").write_text("kept")
    assert predict_with(predictor, [folder / "photo.jpg"], output).exit_code == 0
    assert predict_with(predictor, [folder / "photo.jpg"], output, overwrite=True).exit_code == 0
    assert (output / "other.jpg").read_text() == "kept"


def test_a_run_that_predicts_nothing_replaces_nothing(folder: Path, tmp_path: Path, predictor: Predictor) -> None:
    output, formats = tmp_path / "out", ("jsonl", "coco", "csv", "parquet", "scalabel")
    assert predict_with(predictor, [folder / "photo.jpg"], output, format=formats).exit_code == 0
    before = {path: path.read_bytes() for path in output.iterdir()}
    report = predict_with(predictor, [folder / "text.txt"], output, format=formats, overwrite=True)
    assert (report.images, report.exit_code) == (0, 1)
    assert {path: path.read_bytes() for path in output.iterdir()} == before


def test_a_format_without_its_package_is_refused_before_anything_is_made(
    folder: Path, tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'trilitenet\[parquet\]'"):
        predict_with(predictor, [folder / "photo.jpg"], tmp_path / "out", format=("jsonl", "parquet"))
    assert not (tmp_path / "out").exists()


def test_a_source_is_never_overwritten(folder: Path, predictor: Predictor) -> None:
    before = (folder / "photo.jpg").read_bytes()
    with pytest.raises(OutputError, match="beside their source"):
        predict_with(predictor, [folder / "photo.jpg"], folder, overwrite=True)
    assert (folder / "photo.jpg").read_bytes() == before


def test_sources_of_one_name_are_told_apart(tmp_path: Path, predictor: Predictor) -> None:
    for place in ("a/x", "b/x", "c/X"):  # one name on Windows and macOS
        (tmp_path / place).parent.mkdir()
        Image.fromarray(coloured_scene(90, 160)).save(tmp_path / f"{place}.png")
    (tmp_path / "a" / "x.png").write_bytes(b"broken")
    report = predict_with(predictor, [str(tmp_path / "*" / "[xX].png")], tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"x-2.jpg", "x-2.json", "X-3.jpg", "X-3.json"}
    assert json.loads((tmp_path / "out" / "X-3.json").read_text())["source"].endswith("c/X.png")
    assert len(report.failures) == 1


def test_two_rows_of_pictures_of_one_name_are_two_videos(tmp_path: Path, predictor: Predictor) -> None:
    for ending, count in (("jpg", 2), ("png", 3)):
        for number in range(count):
            Image.fromarray(coloured_scene(90, 160)).save(tmp_path / f"f{number}.{ending}")
    sources = [str(tmp_path / "f%d.jpg"), str(tmp_path / "f%d.png")]
    report = predict_with(predictor, sources, tmp_path / "out")
    assert (report.videos, report.frames, report.exit_code) == (2, 5, 0)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"f.mp4", "f.json", "f-2.mp4", "f-2.json"}
    for name, count in (("f", 2), ("f-2", 3)):
        frames = json.loads((tmp_path / "out" / f"{name}.json").read_text())["frames"]
        assert [frame["frame"] for frame in frames] == list(range(count))
        assert len(list(VideoReader(tmp_path / "out" / f"{name}.mp4"))) == count


@pytest.mark.parametrize("overlay", [True, False])
def test_a_video_that_fails_in_its_middle_is_counted_with_its_frames(
    tmp_path: Path, predictor: Predictor, overlay: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = 0

    def follow(perception: Perception, parts: object) -> tuple[Perception, None]:
        nonlocal seen
        seen += 1
        if seen == 4:
            raise ShapeError("another shape")
        return perception, None

    monkeypatch.setattr("trilitenet.commands.predict.follow", follow)
    report = predict_with(predictor, [drive(tmp_path / "drive.mp4")], tmp_path / "out", overlay=overlay)
    assert (report.videos, report.frames, len(report.failures)) == (1, 3, 1)


def test_a_camera_file_is_read_once(tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[Path] = []

    def read_camera(path: Path) -> Camera:
        read.append(path)
        return Camera.from_field_of_view((90, 160), 90, height=1.4)

    monkeypatch.setattr("trilitenet.commands.predict_road.read_camera", read_camera)
    for number in range(3):
        Image.fromarray(coloured_scene(90, 160)).save(tmp_path / f"{number}.png")
    road = RoadOptions(camera=Path("camera.yaml"))
    report = predict_with(predictor, [str(tmp_path / "*.png")], tmp_path / "out", road=road)
    assert (report.images, read) == (3, [Path("camera.yaml")])


def test_what_is_assumed_of_the_camera_reaches_the_monitor_or_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monitor = RoadOptions(measure=True, field_of_view=100.0, lane_width=3.75).open(still=False)[1]
    assert monitor is not None
    assert monitor._assumed == (100.0, 3.75)
    monitor = RoadOptions(measure=True).open(still=True)[1]
    assert monitor is not None
    assert monitor._assumed == (60.0, 3.5)
    for options, told in (
        (RoadOptions(field_of_view=100.0), "--field-of-view would change nothing: that is for --road"),
        (
            RoadOptions(camera="c.yaml", lane_width=3.0),
            "--lane-width would change nothing: with --camera nothing is assumed",
        ),
        (RoadOptions(measure=True, field_of_view=180.0), "between 1 and 179 degrees, got 180"),
        (RoadOptions(measure=True, lane_width=0.0), "lane width must be above 0 metres"),
    ):
        with pytest.raises(ConfigError, match=told):
            options.open(still=False)


def test_a_video(tmp_path: Path, predictor: Predictor) -> None:
    source, output = drive(tmp_path / "drive.mp4"), tmp_path / "out"
    report = predict_with(predictor, [source], output, format=("json", "jsonl"))
    assert (report.videos, report.frames, report.exit_code) == (1, 12, 0)
    assert {path.name for path in output.iterdir()} == {"drive.mp4", "drive.json", "perceptions.jsonl"}
    frames = json.loads((output / "drive.json").read_text())["frames"]
    assert [frame["frame"] for frame in frames] == list(range(12))
    assert [frame["timestamp"] for frame in frames] == pytest.approx([i / 10 for i in range(12)], abs=1e-3)
    overlay = list(VideoReader(output / "drive.mp4"))
    assert [frame.timestamp for frame in overlay] == pytest.approx([i / 10 for i in range(12)], abs=1e-3)
    tinted = overlay[3].image[150, 20].astype(int)
    np.testing.assert_allclose(tinted, np.array([20, 200, 20]) * 0.58 + np.array([0, 158, 115]) * 0.42, atol=12)


def test_the_overlay_keeps_the_shape_of_pixels(tmp_path: Path, predictor: Predictor) -> None:
    with VideoWriter(tmp_path / "wide.mp4") as writer:
        writer.pixel_aspect = Fraction(4, 3)
        writer.write(coloured_scene())
    predict_with(predictor, [tmp_path / "wide.mp4"], tmp_path / "out")
    overlay = VideoReader(tmp_path / "out" / "wide.mp4")
    assert next(iter(overlay)).image.shape == (360, 640, 3)
    assert overlay.pixel_aspect == Fraction(4, 3)


def test_parts_of_a_video(tmp_path: Path, predictor: Predictor) -> None:
    source = drive(tmp_path / "drive.mp4")
    clip = Clip(every=2, start=0.3, end=1.0, max_frames=3)
    report = predict_with(predictor, [source], tmp_path / "out", clip=clip, format=("jsonl",), overlay=False)
    lines = (tmp_path / "out" / "perceptions.jsonl").read_text().splitlines()
    assert [json.loads(line)["frame"] for line in lines] == [3, 5, 7]
    assert report.frames == 3
    assert report.files == ()


def test_a_broken_video_among_good_sources(tmp_path: Path, predictor: Predictor) -> None:
    good, broken, empty = drive(tmp_path / "good.mp4"), tmp_path / "broken.mp4", tmp_path / "empty.mp4"
    broken.write_bytes(good.read_bytes()[:500])
    empty.write_bytes(b"")
    report = predict_with(predictor, [broken, good, empty], tmp_path / "out")
    assert report.videos == 1
    assert report.frames == 12
    assert {Path(failure.source).name for failure in report.failures} == {"broken.mp4", "empty.mp4"}


def write_until(frame: int, interrupt: Callable[[], object]) -> Callable[..., None]:
    """Return what `VideoWriter.write` does, with an interruption before the frame of this number, from 1."""
    write, numbers = VideoWriter.write, itertools.count(1)

    def interrupted(self: VideoWriter, image: np.ndarray, timestamp: float | None = None) -> None:
        if next(numbers) == frame:
            interrupt()
        write(self, image, timestamp)

    return interrupted


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_leaves_a_playable_video_of_the_frames_in_the_other_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    predictor = Predictor(ColourBackend(), batch_size=1)
    interrupted = write_until(6, lambda: signal.raise_signal(number))
    source = drive(tmp_path / "drive.mp4", frames=40)
    monkeypatch.setattr(VideoWriter, "write", interrupted)
    before = signal.signal(number, signal.default_int_handler)
    try:
        report = predict_with(predictor, [source, source], tmp_path / "out")
    finally:
        signal.signal(number, before)
    assert report.interrupted
    assert report.exit_code == 130
    assert report.summary().startswith("interrupted: 1 video of 6 frames")
    assert len(list(VideoReader(tmp_path / "out" / "drive.mp4"))) == 6
    assert len(json.loads((tmp_path / "out" / "drive.json").read_text())["frames"]) == 6


def test_an_interrupted_run_goes_on_where_it_was(
    folder: Path, tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = [drive(tmp_path / f"{name}.mp4", frames=8) for name in ("a", "b", "c")]
    output, formats = tmp_path / "out", ("json", "openlabel", "cvat")
    interrupted = write_until(12, lambda: signal.default_int_handler(signal.SIGINT, None))
    with monkeypatch.context() as patch:
        patch.setattr(VideoWriter, "write", interrupted)
        assert predict_with(predictor, sources, output, format=formats).interrupted
    files = {f"{name}.{ending}" for name in "abc" for ending in ("mp4", "json", "openlabel.json", "cvat-video.xml")}
    there = {path.name for path in output.iterdir()}
    assert there == {name for name in files if name[0] != "c"} | {"b.unfinished.part"}
    before = {path: path.stat().st_mtime_ns for path in output.glob("a.*")}
    report = predict_with(predictor, sources, output, format=formats, skip_existing=True)
    assert (report.videos, report.frames, report.skipped, report.exit_code) == (2, 16, 1, 0)
    assert report.summary().endswith("; 1 skipped, done already")
    assert {path: path.stat().st_mtime_ns for path in output.glob("a.*")} == before
    assert {path.name for path in output.iterdir()} == files
    assert len(json.loads((output / "b.json").read_text())["frames"]) == 8
    (output / "c.mp4").unlink()
    report = predict_with(predictor, sources, output, format=formats, skip_existing=True)
    assert (report.videos, report.skipped) == (1, 2)
    pictures = [folder / "photo.jpg", folder / "grey.png"]
    assert predict_with(predictor, pictures[:1], tmp_path / "two").images == 1
    report = predict_with(predictor, pictures, tmp_path / "two", skip_existing=True)
    assert (report.images, report.skipped) == (1, 1)


def test_what_an_interruption_left_of_a_video_is_done_anew_though_other_results_were_finished_since(
    tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, output = drive(tmp_path / "a.mp4", frames=8), tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(VideoWriter, "write", write_until(4, lambda: signal.default_int_handler(signal.SIGINT, None)))
        assert predict_with(predictor, [source], output).interrupted
    options: dict[str, Any] = {"overlay": False, "skip_existing": True}
    assert predict_with(predictor, [source], output, format=("openlabel",), **options).frames == 8
    assert predict_with(predictor, [source], output, format=("openlabel",), **options).skipped == 1
    assert predict_with(predictor, [source], output, **options).frames == 8
    assert (output / "a.unfinished.part").is_file()  # of the overlay
    assert predict_with(predictor, [source], output, skip_existing=True).frames == 8
    assert len(list(VideoReader(output / "a.mp4"))) == 8
    assert list(output.glob("*.part")) == []
    (output / "a.unfinished.part").touch()  # one that names nothing is of any file
    assert predict_with(predictor, [source], output, skip_existing=True).frames == 8
    assert list(output.glob("*.part")) == []


def test_results_in_other_forms_may_lie_in_the_folder(folder: Path, tmp_path: Path, predictor: Predictor) -> None:
    sources, output = [folder / "photo.jpg", drive(tmp_path / "drive.mp4", frames=2)], tmp_path / "out"
    predict_with(predictor, sources, output, overlay=False)
    before = {path: path.read_bytes() for path in output.iterdir()}
    predict_with(predictor, sources, output, format=("openlabel", "coco"))
    assert {path: path.read_bytes() for path in before} == before
    for there in ("photo.jpg", "drive.mp4"):
        with pytest.raises(OutputError, match=f"{there}: exists already"):
            predict_with(predictor, [sources[there == "drive.mp4"]], output, format=("csv",))


@pytest.mark.parametrize("count", [1, 2, 3, 20])
def test_shards_do_each_source_once_and_call_it_as_one_process_would(
    folder: Path, tmp_path: Path, predictor: Predictor, count: int
) -> None:
    again = shutil.copytree(folder, tmp_path / "again")
    videos = [drive(tmp_path / "one.mp4", 3), shutil.copy(tmp_path / "one.mp4", again / "one.mp4")]
    (tmp_path / "broken.mp4").write_bytes(b"no video")
    sources = [folder, videos[0], tmp_path / "broken.mp4", again, tmp_path / "absent.jpg"]
    whole = predict_with(predictor, sources, tmp_path / "whole")
    parts = [
        predict_with(predictor, sources, tmp_path / "parts", shard=f"{index}/{count}", skip_existing=count == 2)
        for index in range(count)
    ]
    written = [{path.name: path.read_bytes() for path in (tmp_path / each).iterdir()} for each in ("whole", "parts")]
    assert written[0].keys() == written[1].keys() >= {"one.json", "one-2.json", "one-2.mp4", "grey-2.jpg"}
    assert all(written[0][name] == content for name, content in written[1].items() if name.endswith("json"))
    for figure in ("images", "videos", "frames"):
        assert sum(getattr(part, figure) for part in parts) == getattr(whole, figure)
    reasons = [failure.reason for part in parts for failure in part.failures]
    assert sorted(reasons) == sorted(failure.reason for failure in whole.failures)


def test_a_shard_opens_neither_what_others_do_nor_what_is_done(
    tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    videos = [drive(tmp_path / f"{index}.mp4", 2) for index in range(4)]
    opened: list[str] = []
    plain = VideoReader.look

    def look(self: VideoReader) -> None:
        opened.append(Path(self.name).stem)
        plain(self)

    monkeypatch.setattr(VideoReader, "look", look)
    options: dict[str, Any] = {"shard": "1/2", "skip_existing": True}
    assert predict_with(predictor, videos, tmp_path / "out", **options).videos == 2
    assert opened == ["1", "3"]
    read: list[str] = []
    monkeypatch.setattr("trilitenet.commands.predict_plan._check_source", lambda path, name: read.append(path.stem))
    assert predict_with(predictor, videos, tmp_path / "out", **options).skipped == 2
    assert opened == read == ["1", "3"]


def test_a_url_that_does_not_answer_keeps_its_place_in_every_shard(tmp_path: Path, predictor: Predictor) -> None:
    for index in range(4):
        (tmp_path / "www" / str(index)).mkdir(parents=True)
        drive(tmp_path / "www" / str(index) / "front.mp4", 2)
    asked: list[str] = []
    down = {"/0/front.mp4"}

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            if self.path in down:
                self.send_error(503)
            else:
                super().do_GET()

        def log_message(self, *_: Any) -> None:
            pass

    with http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Handler, directory=str(tmp_path / "www"))
    ) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        urls = [f"http://127.0.0.1:{server.server_port}/{index}/front.mp4" for index in range(4)]
        options: dict[str, Any] = {"overlay": False, "skip_existing": True}
        for index, failed in ((0, 1), (1, 0), (0, 0)):
            asked.clear()
            report = predict_with(predictor, urls, tmp_path / "out", shard=f"{index}/2", **options)
            assert len(report.failures) == failed
            assert {int(path[1]) for path in asked} == {index} | ({index + 2} if index or failed else set())
            down.clear()
        server.shutdown()
    names = ("front", "front-2", "front-3", "front-4")
    assert [json.loads((tmp_path / "out" / f"{name}.json").read_text())["source"] for name in names] == urls


def test_of_many_sources_few_bars_are_shown(
    tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[int] = []
    bars: list[Progress] = []

    class Bars(Progress):
        def add_task(self, *words: Any, **options: Any) -> TaskID:
            bars.append(self)
            added = super().add_task(*words, **options)
            shown.append(len(self.tasks))
            return added

    monkeypatch.setattr("trilitenet.commands.progress.Progress", Bars)
    monkeypatch.setattr(command, "_MOST_BARS", 3)
    clips = [tmp_path / f"{number}.mp4" for number in range(4)]
    for clip in clips:
        drive(clip, frames=2)
    for count, most in ((3, 3), (4, 2)):
        shown.clear()
        report = predict_with(predictor, clips[:count], tmp_path / str(count), overlay=False)
        assert report.frames == 2 * count
        assert max(shown) == most
    (left,) = bars[-1].tasks
    assert (left.description, left.completed, left.total) == ("all sources", 4, 4)


@pytest.mark.parametrize("shard", ["", "1", "2/2", "-1/2", "1/0", "0/0", "1.0/2", "a/b", "0 / 2", "1/" + "9" * 5000])
def test_what_is_no_shard_is_one_line(folder: Path, tmp_path: Path, predictor: Predictor, shard: str) -> None:
    with pytest.raises(ConfigError, match="--shard must be I/N with I from 0 to N - 1, such as 0/16, got "):
        predict_with(predictor, [folder], tmp_path / "out", shard=shard)


def test_sources_may_stand_in_a_file(
    folder: Path, tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    listing = tmp_path / "list.txt"
    lines = f"{folder / 'grey.png'}\n\n  {folder / 'deep.png'}  \r\n{folder / 'grey.png'}\n"
    listing.write_text(lines, encoding="utf-8-sig")  # as Windows writes it
    words = ["predict", str(folder / "alpha.png"), "--model", str(weights), "--output", str(tmp_path / "out")]
    assert cli.main([*words, "--from-file", str(listing)]) == 0
    assert {path.stem for path in (tmp_path / "out").iterdir()} == {"alpha", "grey", "deep"}
    (tmp_path / "empty.txt").write_text("\n \n")
    (tmp_path / "bytes.txt").write_bytes(b"\xff\xfe")
    capsys.readouterr()
    for name, told in {
        "absent.txt": "cannot be read as text (No such file or directory)",
        "bytes.txt": "cannot be read as text ('utf-8' codec can't decode",
        "empty.txt": "names no source; write one a line",
    }.items():
        assert cli.main([*words, "--overwrite", "--from-file", str(tmp_path / name)]) == 1
        assert told in capsys.readouterr().err


def test_results_of_another_source_of_the_same_name_are_not_taken_for_done(
    folder: Path, tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    for place in ("one", 'tw"o'):
        (tmp_path / place).mkdir()
        shutil.copy(folder / "photo.jpg", tmp_path / place / "x.jpg")
    one, two, output = tmp_path / "one/x.jpg", tmp_path / 'tw"o/x.jpg', tmp_path / "out"
    predict_with(predictor, [two, one], output)
    (output / "x-2.jpg").unlink()
    with pytest.raises(OutputError, match=r'x\.json: is of .*tw"o/x\.jpg, not of .*one/x\.jpg; name the same sources'):
        predict_with(predictor, [one, two], output, skip_existing=True)
    monkeypatch.chdir(one.parent)
    report = predict_with(predictor, [two, "x.jpg"], output, skip_existing=True)
    assert (report.images, report.skipped) == (1, 1)
    two.rename(two.with_name("y.jpg"))
    assert predict_with(predictor, [one], output, skip_existing=True).skipped == 1  # nobody knows better


def test_the_mark_of_a_video_that_failed_is_there_before_its_results(
    tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = [drive(tmp_path / f"{name}.mp4", frames=8) for name in ("a", "b")]
    output = tmp_path / "out"
    decode, write = VideoReader._decode, VideoWriter.write
    there: list[set[str]] = []

    def lost(self: VideoReader) -> Iterator[Any]:
        yield from itertools.islice(decode(self), 4 if self.name.endswith("a.mp4") else None)
        if self.name.endswith("a.mp4"):
            raise InputError(f"{self.name}: the connection was lost")

    def watched(self: VideoWriter, image: np.ndarray, timestamp: float | None = None) -> None:
        there.append({path.name for path in output.iterdir()})
        write(self, image, timestamp)

    monkeypatch.setattr(VideoReader, "_decode", lost)
    monkeypatch.setattr(VideoWriter, "write", watched)
    assert predict_with(predictor, sources, output).exit_code == 1
    assert {"a.json", "a.mp4", "a.unfinished.part"} <= there[4]
    assert {path.name for path in output.glob("*.part")} == {"a.unfinished.part"}


def test_a_stream_that_is_lost_is_a_failure_and_what_came_is_marked_unfinished(
    tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lost(self: StreamReader, *_: object) -> Iterator[Any]:
        for number in range(3):
            yield number / 10, functools.partial(coloured_scene, 90, 160)
        raise InputError(f"{self.name}: given up after 8 attempts (the stream ended)")

    monkeypatch.setattr(StreamReader, "_decode", lost)
    sources: list[str | Path] = ["rtsp://127.0.0.1/live", drive(tmp_path / "drive.mp4")]
    output = tmp_path / "out"
    report = predict_with(predictor, sources, output)
    assert [failure.reason for failure in report.failures] == [
        "rtsp://127.0.0.1/live: given up after 8 attempts (the stream ended)"
    ]
    assert (report.exit_code, report.videos) == (1, 2)
    assert report.dropped + report.frames == 3 + 12
    frames = json.loads((output / "live.json").read_text())["frames"]
    assert len(frames) == report.frames - 12 > 0
    assert {path.name for path in output.glob("*.part")} == {"live.unfinished.part"}
    assert predict_with(predictor, sources, output, skip_existing=True).skipped == 1


def test_frames_that_were_left_out_are_told(
    tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = drive(tmp_path / "drive.mp4", frames=2)
    for dropped, told in (
        (0, "frames at"),
        (1, "frames, 1 frame left out, at"),
        (28, "frames, 28 frames left out, at"),
    ):
        monkeypatch.setattr(PerceptionStream, "dropped", dropped)
        report = predict_with(predictor, [source], tmp_path / str(dropped))
        assert report.summary().startswith(f"1 video of 2 {told} ")


def test_a_file_of_all_sources_is_marked_until_it_has_them_all(
    folder: Path, tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "out"
    formats = ("parquet", "jsonl", "json")
    marks = {f"perceptions.{ending}.unfinished.part" for ending in ("parquet", "jsonl")}
    with monkeypatch.context() as patch:
        write, done = JsonWriter._write, itertools.count(1)

        def interrupted(self: JsonWriter, *arguments: Any) -> None:
            write(self, *arguments)
            if next(done) == 2:
                signal.default_int_handler(signal.SIGINT, None)

        patch.setattr(JsonWriter, "_write", interrupted)
        report = predict_with(predictor, [folder], output, format=formats)
    assert report.exit_code == 130
    assert [path.name for path in report.partial] == ["perceptions.parquet", "perceptions.jsonl"]
    assert "perceptions.parquet and perceptions.jsonl without the rest: make anew with --overwrite" in report.summary()
    assert {path.name for path in output.glob("*.part")} == marks
    whole = predict_with(predictor, [folder], output, format=formats, overwrite=True)
    assert (whole.partial, list(output.glob("*.part"))) == ((), [])


def test_a_live_source_that_comes_last_leaves_no_rest_behind(
    tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, output = drive(tmp_path / "drive.mp4", frames=6), tmp_path / "out"
    write = YoloWriter._write

    def interrupted(self: YoloWriter, *arguments: Any) -> None:
        write(self, *arguments)
        signal.default_int_handler(signal.SIGINT, None)

    monkeypatch.setattr(YoloWriter, "_write", interrupted)
    for live in (False, True):
        monkeypatch.setattr(VideoReader, "live", live)
        report = predict_with(predictor, [source], output / str(live), format=("jsonl", "yolo"), overlay=False)
        assert report.exit_code == 130
        assert [path.name for path in report.partial] == ([] if live else ["perceptions.jsonl"])
        marks = {path.name for path in (output / str(live)).glob("*.part")} - {"drive.unfinished.part"}
        assert marks == (set() if live else {"perceptions.jsonl.unfinished.part"})


def test_a_source_that_is_not_opened_yet_is_a_rest_though_a_live_one_came_before(
    tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, other = (drive(tmp_path / f"{name}.mp4", frames=2) for name in ("a", "b"))
    monkeypatch.setattr(VideoReader, "live", True)
    look = VideoReader.look

    def interrupted(self: VideoReader) -> None:
        if self.name == str(other):
            raise KeyboardInterrupt
        look(self)

    monkeypatch.setattr(VideoReader, "look", interrupted)
    report = predict_with(predictor, [one, other], tmp_path / "out", format=("jsonl",), overlay=False)
    assert report.frames > 0
    assert [path.name for path in report.partial] == ["perceptions.jsonl"]


@pytest.mark.parametrize("format", ["jsonl", "csv", "coco", "yolo", "cvat"])
def test_results_of_several_sources_in_one_file_cannot_be_skipped(
    format: str, folder: Path, tmp_path: Path, predictor: Predictor
) -> None:
    with pytest.raises(ConfigError, match=r"--skip-existing needs .* is one for all"):
        predict_with(predictor, [folder], tmp_path / "out", format=("json", format), skip_existing=True)
    with pytest.raises(ConfigError, match="exclude each other"):
        predict_with(predictor, [folder], tmp_path / "out", skip_existing=True, overwrite=True)
    assert not (tmp_path / "out").exists()


def test_a_failing_backend_is_an_error_and_no_thread_hangs(tmp_path: Path) -> None:
    predictor = Predictor(ColourBackend(fail_after=2), batch_size=2)
    with pytest.raises(BackendError, match="as it was told to"):
        predict_with(predictor, [drive(tmp_path / "drive.mp4")], tmp_path / "out")


def test_a_full_disk_is_named_and_leaves_no_half_file(tmp_path: Path) -> None:
    """Stand in for a full disk by a limit on the size of files, in a process of its own."""
    with VideoWriter(tmp_path / "drive.mp4") as writer:
        for i in range(12):
            writer.write(np.random.default_rng(i).integers(0, 256, (180, 320, 3), dtype=np.uint8))
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (900, 900, 3), dtype=np.uint8)).save(tmp_path / "a.png")
    script = f"""
import resource, sys
from pathlib import Path
from tests.fakes import ColourBackend
from trilitenet.commands.predict import predict_with
from trilitenet.errors import OutputError
from trilitenet.inference.predictor import Predictor
tries = [("drive.mp4", ()), ("a.png", ())]
formats = ("json", "coco", "scalabel", "openlabel", "cvat", "yolo", "parquet", "jsonl", "csv")
tries += [("a.png", (name,)) for name in formats]
for source, formats in tries:
    resource.setrlimit(resource.RLIMIT_FSIZE, (20 if formats else 50_000, 50_000))
    try:
        predict_with(Predictor(ColourBackend()), [Path({str(tmp_path)!r}) / source], Path({str(tmp_path)!r}) / "out",
                     format=formats, overlay=not formats)
    except OutputError as error:
        assert "cannot be written (" in str(error) and "File too large" in str(error), error
    else:
        sys.exit(f"{{source}}: nothing was raised")
"""
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120, cwd=Path(__file__).parents[2]
    )
    assert done.returncode == 0, done.stderr
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()] == []


def test_mistakes_are_named_before_anything_is_written(tmp_path: Path, predictor: Predictor, folder: Path) -> None:
    output = tmp_path / "out"
    with pytest.raises(ConfigError, match="did you mean 'labels'"):
        predict_with(predictor, [folder], output, hide=("label",))
    with pytest.raises(ConfigError, match="did you mean 'coco'"):
        predict_with(predictor, [folder], output, format=("cocoo",))
    with pytest.raises(InputError, match="no source"):
        predict_with(predictor, [], output)
    with pytest.raises(ConfigError, match="--hide lines above would change nothing: that is for --road"):
        predict_with(predictor, [folder], output, hide=("lines", "labels", "above"))
    with pytest.raises(ConfigError, match="--hide would change nothing: with --no-overlay nothing is drawn"):
        predict_with(predictor, [folder], output, hide=("labels",), overlay=False)
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="is a file"):
        predict_with(predictor, [folder], tmp_path / "file")


def test_options_for_videos_alone_are_told_where_there_is_none(
    tmp_path: Path, predictor: Predictor, caplog: pytest.LogCaptureFixture
) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    Image.fromarray(coloured_scene(90, 160)).save(pictures / "a.png")
    numbers = itertools.count()

    def told(*sources: str | Path, **options: Any) -> list[str]:
        caplog.clear()
        predict_with(predictor, sources, tmp_path / str(next(numbers)), format="jsonl", overlay=False, **options)
        return [record.getMessage() for record in caplog.records]

    options = {"clip": Clip(every=2, max_frames=5), "road": RoadOptions(track=True, smoothing=0.5)}
    idle = "--every and --max-frames and --track and --smoothing without effect: no source is a video"
    rate = "--rate without effect: no source is numbered pictures, such as frames/%06d.jpg"
    assert told(pictures) == told(pictures, clip=Clip(every=1), rate=30) == []
    assert told(pictures, rate=10, **options) == [idle, rate]
    assert told(pictures, shard="0/2", **options) == [idle]
    assert told(pictures, shard="1/2", **options) == []
    assert told(pictures, tmp_path / "absent.mp4", **options) == []  # which is told itself
    assert told(tmp_path / "absent.mp4", **options) == []
    drive(pictures / "drive.mp4", frames=2)
    assert told(pictures, rate=10, **options) == [rate]
    Image.fromarray(coloured_scene(90, 160)).save(pictures / "0.png")
    assert told(str(pictures / "%d.png"), rate=10, **options) == []


@pytest.mark.parametrize("format", ["scalabel", "openlabel", "coco", "yolo", "cvat", "csv"])
def test_other_formats(format: str, folder: Path, tmp_path: Path, predictor: Predictor) -> None:
    report = predict_with(predictor, [folder / "photo.jpg"], tmp_path / "out", format=(format,), overlay=False)
    assert report.exit_code == 0
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


def test_a_refused_command_leaves_nothing(tmp_path: Path, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "out"
    for source, options, reason in (
        ("photo.jpg", ["--model", "nope"], "nope: does not exist"),
        ("photo.jpg", ["--confidence", "2"], "confidence must be"),
        ("photo.jpg", ["--format", "nope"], "unknown format"),
        ("absent.jpg", [], "no such file"),
        ("photo.jpg", ["--end", "nan"], "end after it"),
    ):
        command = ["predict", str(folder / source), "--output", str(output), "--format", "coco", "--format", "csv"]
        assert cli.main([*command, *options]) == 1
        assert reason in capsys.readouterr().err
        assert not output.exists()


def test_names_that_two_formats_want_are_refused(tmp_path: Path, predictor: Predictor) -> None:
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for name in ("coco", "drive-0000003"):
        Image.fromarray(coloured_scene()).save(pictures / f"{name}.jpg")
    video = drive(tmp_path / "drive.mp4")
    with pytest.raises(OutputError, match=r"coco\.json would be written twice"):
        predict_with(predictor, [pictures], tmp_path / "out", format=("json", "coco"))
    with pytest.raises(OutputError, match=r"drive-0000003\.txt would be written twice"):
        predict_with(predictor, [video, pictures], tmp_path / "out", format=("yolo",), overwrite=True)
    assert not (tmp_path / "out").exists()
    assert predict_with(predictor, [pictures], tmp_path / "out", format=("jsonl", "coco")).exit_code == 0


def test_a_picture_may_be_called_like_a_video(tmp_path: Path, predictor: Predictor) -> None:
    Image.fromarray(coloured_scene()).save(tmp_path / "drive.jpg")
    sources = [drive(tmp_path / "drive.mp4"), tmp_path / "drive.jpg"]
    assert predict_with(predictor, sources, tmp_path / "out", format=("yolo",), overlay=False).exit_code == 0
    assert {"drive-0000000.txt", "drive-2.txt"} <= {path.name for path in (tmp_path / "out/labels").iterdir()}


@pytest.mark.parametrize(
    ("format", "there"),
    [
        ("openlabel", "photo.openlabel.json"),
        ("openlabel", "drive.openlabel.json"),
        ("cvat", "drive.cvat-video.xml"),
        ("cvat", "cvat-images.xml"),
        ("yolo", "labels/drive-0000007.txt"),
        ("yolo", "data.yaml"),
        ("csv", "boxes.csv"),
    ],
)
def test_results_of_every_format_are_refused_before_the_work(
    format: str, there: str, folder: Path, tmp_path: Path, predictor: Predictor
) -> None:
    output = tmp_path / "out"
    (output / there).parent.mkdir(parents=True)
    (output / there).write_text("mine")
    sources = [folder / "alpha.png", folder / "photo.jpg", drive(tmp_path / "drive.mp4")]
    with pytest.raises(OutputError, match=f"{Path(there).name}: exists already"):
        predict_with(predictor, sources, output, format=(format,), overlay=False)
    assert [path for path in output.rglob("*") if path.is_file()] == [output / there]
    assert (output / there).read_text() == "mine"


def test_labels_that_an_earlier_run_left_of_a_video_go_once_it_is_done(
    tmp_path: Path, predictor: Predictor, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, output = drive(tmp_path / "drive.mp4", frames=6), tmp_path / "out"

    def run(**options: Any) -> list[int]:
        predict_with(predictor, [source], output, format=("yolo",), **options)
        return sorted(int(path.stem[-7:]) for path in (output / "labels").iterdir())

    assert run(overlay=False) == [0, 1, 2, 3, 4, 5]
    with monkeypatch.context() as patch:
        patch.setattr(VideoWriter, "write", write_until(2, lambda: signal.default_int_handler(signal.SIGINT, None)))
        assert run(overwrite=True) == [0, 1, 2, 3, 4, 5]
    for part in (Clip(start=0.1), Clip(end=0.1), Clip(max_frames=1)):  # the rest may be of another run
        assert run(overwrite=True, clip=part) == [0, 1, 2, 3, 4, 5]
    assert run(overwrite=True, clip=Clip(every=3)) == [0, 3]


def test_a_source_too_large_for_its_overlay_does_not_stop_the_others(
    tmp_path: Path, predictor: Predictor, capfd: pytest.CaptureFixture[str]
) -> None:
    large, wide, small = tmp_path / "a.png", tmp_path / "w1.png", tmp_path / "z.png"
    Image.new("RGB", (65_501, 8)).save(large)
    Image.new("RGB", (16_386, 8)).save(wide)
    Image.fromarray(coloured_scene()).save(small)
    report = predict_with(predictor, [large, tmp_path / "w%d.png", small], tmp_path / "out")
    assert (report.images, report.videos, report.exit_code) == (2, 1, 1)
    assert [Path(failure.source).name for failure in report.failures] == ["a.png", "w"]
    for failure, told in zip(report.failures, ("JPEG does not take 65501 x 8", "16384 pixels a side"), strict=True):
        assert failure.reason.startswith(f"{failure.source}: an overlay cannot be made (")
        assert told in failure.reason
    assert {"a.json", "z.json", "z.jpg"} <= {path.name for path in (tmp_path / "out").iterdir()}
    assert capfd.readouterr().err == ""


def test_a_picture_of_another_shape_than_the_camera_does_not_stop_the_others(
    tmp_path: Path, predictor: Predictor
) -> None:
    square = tmp_path / "square.png"
    Image.fromarray(coloured_scene(240, 240)).save(square)
    (tmp_path / "camera.yaml").write_text("image_width: 320\nimage_height: 180\nfield_of_view: 60\nheight: 1.4\n")
    other = tmp_path / "other.png"
    Image.fromarray(coloured_scene(180, 320)).save(other)
    road = RoadOptions(measure=True, camera=tmp_path / "camera.yaml")
    video = drive(tmp_path / "drive.mp4")
    report = predict_with(predictor, [square, other, video], tmp_path / "out", road=road)
    assert (report.images, report.videos) == (1, 1)
    assert [Path(failure.source).name for failure in report.failures] == ["square.png"]
    assert "another shape" in report.failures[0].reason
    assert report.failures[0].reason.startswith(str(square))


@pytest.mark.skipif(sys.platform != "linux", reason="file names are bytes on Linux alone")
def test_names_that_no_file_can_have_are_failures_of_their_own(
    tmp_path: Path, predictor: Predictor, folder: Path
) -> None:
    odd = tmp_path / os.fsdecode(b"\xe4.png")
    Image.fromarray(coloured_scene()).save(odd)
    report = predict_with(predictor, [odd, "a" * 300, folder / "photo.jpg"], tmp_path / "out", format=("json", "coco"))
    assert report.images == 1
    assert ["not UTF-8" in report.failures[0].reason, "too long" in report.failures[1].reason] == [True, True]
    assert "\\xe4.png" in report.failures[0].reason


@pytest.mark.parametrize(
    ("formats", "stem", "images"),
    [(("json",), 251, 1), (("json", "openlabel", "cvat"), 240, 2), (("openlabel",), 241, 1), (("json",), 250, 2)],
)
def test_the_longest_names_are_no_trouble_or_a_failure_of_their_own(
    tmp_path: Path, predictor: Predictor, formats: tuple[str, ...], stem: int, images: int
) -> None:
    (tmp_path / "in").mkdir()
    for name in ("n" * stem + ".png", "photo.png"):
        Image.fromarray(coloured_scene()).save(tmp_path / "in" / name)
    video = tmp_path / "in" / ("v" * stem + ".mkv")
    with VideoWriter(tmp_path / "v.mp4") as writer:
        writer.write(coloured_scene())
    (tmp_path / "v.mp4").rename(video)
    report = predict_with(predictor, [tmp_path / "in"], tmp_path / "out", format=formats)
    assert (report.images, report.videos) == (images, images - 1)
    assert ["name is too long" in failure.reason for failure in report.failures] == [True] * 2 * (2 - images)
    assert not list((tmp_path / "out").glob("*.part"))


@pytest.mark.skipif(sys.platform == "win32", reason="signals are sent in another way")
def test_ctrl_c_in_a_process_of_its_own(tmp_path: Path) -> None:
    source, output = drive(tmp_path / "drive.mp4", frames=600), tmp_path / "out"
    script = f"""
import signal, sys, time
from pathlib import Path
from tests.fakes import ColourBackend
from trilitenet.commands.predict import predict_with
from trilitenet.inference.predictor import Predictor

class Slow(ColourBackend):
    def run(self, batch):
        time.sleep(0.1)
        return super().run(batch)

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would ignore it
report = predict_with(Predictor(Slow(), batch_size=1), [{str(source)!r}], Path({str(output)!r}))
print(report.summary())
sys.exit(report.exit_code)
"""
    with subprocess.Popen(
        [sys.executable, "-c", script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    ) as process:
        until = time.monotonic() + 120
        while process.poll() is None and not (output / "drive.mp4.part").exists() and time.monotonic() < until:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        printed, complaints = process.communicate(timeout=120)
    assert process.returncode == 130, complaints
    assert "interrupted: 1 video of" in printed
    frames = json.loads((output / "drive.json").read_text())["frames"]
    assert 0 < len(frames) < 600
    assert len(list(VideoReader(output / "drive.mp4"))) == len(frames)


def test_hidden_parts_are_not_drawn(folder: Path, tmp_path: Path, predictor: Predictor) -> None:
    apart = {}
    for hide in ((), ("drivable", "lane", "boxes")):
        output = tmp_path / f"without-{len(hide)}"
        predict_with(predictor, [folder / "alpha.png"], output, hide=hide)
        overlay = np.asarray(Image.open(output / "alpha.jpg"))
        apart[len(hide)] = float(np.abs(overlay.astype(int) - coloured_scene()).mean())
    assert apart[3] < 2 < 5 < apart[0]


def test_what_is_asked_of_the_model_reaches_it(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, object] = {}

    def load(model: str, **options: object) -> Predictor:
        given.update(options, model=model)
        return Predictor(ColourBackend())

    monkeypatch.setattr("trilitenet.commands.predict.load", load)
    asked = {"model": "m.onnx", "device": "cpu", "backend": "openvino", "confidence": 0.4, "long_side": 320}
    asked |= {"iou": 0.3, "drivable": 0.6, "lane": 0.7, "ego_mask": "bonnet.png"}
    words = [word for name, value in asked.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    output = str(tmp_path / "out")
    assert cli.main(["predict", str(folder / "alpha.png"), *words, "--batch-size", "2", "--output", output]) == 0
    assert given == {**asked, "ego_mask": Path("bonnet.png"), "network": None, "batch_size": 2}


def test_nothing_is_found_where_an_ego_mask_shows_the_own_car(
    folder: Path, tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = np.zeros((360, 640), np.uint8)
    own[250:] = 255
    Image.fromarray(own).save(tmp_path / "bonnet.png")
    drive(folder / "drive.mp4")
    Image.fromarray(coloured_scene(640, 360)).save(folder / "upright.png")
    output = tmp_path / "out"
    words = ["predict", *(str(folder / name) for name in ("alpha.png", "upright.png", "drive.mp4")), "--no-overlay"]
    words += ["--model", str(weights), "--ego-mask", str(tmp_path / "bonnet.png"), "--output", str(output), "--quiet"]
    assert cli.main([*words, "--max-frames", "2"]) == 1
    written = capsys.readouterr().err
    assert "upright.png: the ego mask is of 640x360 pixels, the picture of 360x640, which is another shape" in written
    frames = [json.loads((output / "alpha.json").read_text())]
    frames += json.loads((output / "drive.json").read_text())["frames"]
    assert len(frames) == 3
    for frame in frames:
        perception = Perception.from_dict(frame)
        assert perception.drivable is not None
        assert not perception.drivable[-perception.size[0] // 4 :].any()


def test_an_ego_mask_that_is_none_is_one_line_and_leaves_nothing(
    folder: Path, tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Image.fromarray(np.zeros((360, 640), np.uint8)).save(tmp_path / "black.png")
    for name, message in (("black.png", "marks nothing"), ("absent.png", "no such file"), ("a.txt", "not an image")):
        (tmp_path / "a.txt").write_text("text")
        words = ["predict", str(folder / "alpha.png"), "--model", str(weights), "--output", str(tmp_path / "out")]
        assert cli.main([*words, "--ego-mask", str(tmp_path / name)]) == 1
        written = capsys.readouterr().err
        assert written.count("\n") == 1
        assert f"{name}: " in written
        assert message in written
    assert not (tmp_path / "out").exists()
