from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.fakes import ColourBackend, coloured_scene, written_by_another_process
from trilitenet.errors import BackendError, ConfigError, InputError, OutputError, ShapeError
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.sources import Failure, Frame, FrameReader, Stills, VideoReader
from trilitenet.inference.video import PerceptionStream, Prefetch, VideoWriter
from trilitenet.structures import Perception, RawOutputs

av = pytest.importorskip("av")


class Scenes(FrameReader):
    """Generated frames; it keeps count of how far it was read."""

    def __init__(self, count: int, size: tuple[int, int] = (96, 160), *, live: bool = False, pause: float = 0) -> None:
        super().__init__("scenes")
        self.count, self.size, self.pause, self.given = count, size, pause, 0
        self.live = live

    def _decode(self) -> Iterator[tuple[float, object]]:
        for i in range(self.count):
            self.given += 1
            time.sleep(self.pause)
            yield i / 30, lambda: coloured_scene(*self.size)


def test_prefetch_gives_all_in_order_and_the_error_at_its_place() -> None:
    def items() -> Iterator[int]:
        yield from range(5)
        raise ValueError("at the end")

    ahead = Prefetch(items(), 2)
    assert [next(ahead) for _ in range(5)] == list(range(5))
    with pytest.raises(ValueError, match="at the end"):
        next(ahead)
    assert list(ahead) == []


def test_a_prefetch_that_nobody_closed_ends_before_the_process() -> None:
    script = """
import itertools, time
from trilitenet.inference.video import Prefetch

def items():
    try:
        for i in itertools.count():
            time.sleep(0.01)
            yield i
    finally:
        print("closed")

next(Prefetch(items(), 1))
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (ended.stdout, ended.stderr) == ("closed\n", "")


def test_prefetch_runs_only_so_far_ahead() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        for i in range(100):
            taken += 1
            yield i

    ahead = Prefetch(items(), 3)
    time.sleep(0.2)
    assert taken <= 4
    next(ahead)
    time.sleep(0.2)
    assert taken <= 5
    ahead.close()
    assert list(ahead) == []


def test_prefetch_closes_the_generator_and_ends_its_thread() -> None:
    closed = threading.Event()

    def items() -> Iterator[int]:
        try:
            while True:
                yield 1
        finally:
            closed.set()

    before = threading.active_count()
    ahead = Prefetch(items(), 1)
    ahead.close()
    assert closed.is_set()
    assert threading.active_count() == before
    freed = weakref.ref(ahead)
    del ahead
    assert freed() is None


def test_prefetch_forgets_the_oldest_of_a_live_source() -> None:
    ahead = Prefetch(range(50), 2, drop_oldest=True)
    time.sleep(0.3)
    assert list(ahead) == [48, 49]
    assert ahead.dropped == 48


def test_frames_of_a_file_are_batched_and_stay_in_order() -> None:
    backend = ColourBackend()
    with PerceptionStream(Scenes(10), Predictor(backend, batch_size=4)) as stream:
        perceptions = list(stream)  # for type checkers, too, a video gives nothing but perceptions
    assert [shape[0] for shape in backend.batches] == [4, 4, 2]
    assert [perception.frame for perception in perceptions] == list(range(10))
    assert [perception.timestamp for perception in perceptions] == pytest.approx([i / 30 for i in range(10)])
    assert all(perception.source == "scenes" for perception in perceptions)


def test_frames_before_a_failure_are_seen_though_they_fill_no_batch() -> None:
    class Lost(Scenes):
        def _decode(self) -> Iterator[tuple[float, object]]:
            yield from super()._decode()
            raise InputError("scenes: lost")

    perceptions: list[Perception | Failure] = []
    with (
        PerceptionStream(Lost(6), Predictor(ColourBackend(), batch_size=4)) as stream,
        pytest.raises(InputError, match="lost"),
    ):
        perceptions.extend(stream)
    assert len(perceptions) == 6


def test_a_live_source_goes_one_by_one_and_never_piles_up() -> None:
    backend = ColourBackend()
    source = Scenes(60, live=True, pause=0.002)
    with PerceptionStream(source, Predictor(backend, batch_size=4)) as stream:
        frames = []
        for item in stream:
            frames.append(item.frame or 0)
            time.sleep(0.02)
    assert all(shape[0] == 1 for shape in backend.batches)
    assert frames == sorted(frames)
    assert stream.dropped > 10
    assert len(frames) + stream.dropped <= 60


def test_leaving_early_ends_the_threads() -> None:
    before = threading.active_count()
    source = Scenes(100_000)
    with PerceptionStream(source, Predictor(ColourBackend(), batch_size=2)) as stream:
        next(iter(stream))
    assert source.given < 60
    assert threading.active_count() == before


def test_leaving_ends_a_wait_for_a_stream_that_broke() -> None:
    class Broken(Scenes):
        def _decode(self) -> Iterator[tuple[float, object]]:
            yield from super()._decode()
            assert self._closed.wait(20)

    with PerceptionStream(Broken(1, live=True), Predictor(ColourBackend())) as stream:
        next(iter(stream))
        began = time.monotonic()
    assert time.monotonic() - began < 10


def test_an_error_of_the_backend_arrives() -> None:
    predictor = Predictor(ColourBackend(fail_after=1), batch_size=1)
    with PerceptionStream(Scenes(10), predictor) as stream, pytest.raises(BackendError):
        list(stream)


def test_failures_keep_their_place(tmp_path: Path) -> None:
    paths = []
    for i in range(5):
        paths.append(tmp_path / f"{i}.ppm")
        paths[-1].write_bytes(b"P6 64 64 255\n" + bytes(64 * 64 * 3 if i != 2 else 7))
    with PerceptionStream(Stills(tuple(paths)), Predictor(ColourBackend(), batch_size=4)) as stream:
        sources = [item.source for item in stream]
    assert sources == [str(path) for path in paths]


class WideOnly(ColourBackend):
    """Refuses batches of upright pictures, as an artefact with bounds does."""

    def run(self, batch: np.ndarray) -> RawOutputs:
        if batch.shape[1] > batch.shape[2]:
            raise ShapeError("sides from 64 to 160 pixels are possible")
        return super().run(batch)


def test_a_picture_that_the_backend_cannot_take_stops_no_other(tmp_path: Path) -> None:
    sizes = [(64, 96), (64, 96), (128, 64), (64, 96), (96, 160)]
    paths = [tmp_path / f"{i}.ppm" for i in range(len(sizes))]
    for path, (height, width) in zip(paths, sizes, strict=True):
        path.write_bytes(b"P6 %d %d 255\n" % (width, height) + bytes(height * width * 3))
    with PerceptionStream(Stills(tuple(paths)), Predictor(WideOnly(), batch_size=4)) as stream:
        items = list(stream)
    assert [item.source for item in items] == [str(path) for path in paths]
    assert [item.reason for item in items if isinstance(item, Failure)] == [
        f"{paths[2]}: sides from 64 to 160 pixels are possible"
    ]
    with (
        PerceptionStream(Scenes(3, (160, 96)), Predictor(WideOnly(), batch_size=2)) as video,
        pytest.raises(InputError, match="scenes: sides from 64"),
    ):
        list(video)


def test_stages_overlap() -> None:
    """Reading, inference and the caller's work are under way at the same time."""
    lock = threading.Lock()
    busy: set[str] = set()
    seen: set[frozenset[str]] = set()

    def work(stage: str) -> None:
        with lock:
            busy.add(stage)
            seen.add(frozenset(busy))
        time.sleep(0.01)
        with lock:
            busy.discard(stage)

    class BusyScenes(Scenes):
        def _decode(self) -> Iterator[tuple[float, object]]:
            for item in super()._decode():
                work("read")
                yield item

    class BusyBackend(ColourBackend):
        def run(self, batch: np.ndarray) -> RawOutputs:
            work("infer")
            return super().run(batch)

    with PerceptionStream(BusyScenes(60, (32, 32)), Predictor(BusyBackend(), long_side=32, batch_size=1)) as stream:
        for _ in stream:
            work("draw")
    assert frozenset({"read", "infer", "draw"}) in seen


@pytest.mark.parametrize("size", [(96, 160), (97, 161), (1, 1)])
def test_a_browser_plays_it(tmp_path: Path, size: tuple[int, int]) -> None:
    with VideoWriter(tmp_path / "a.mp4", 25) as writer:
        for _ in range(5):
            writer.write(coloured_scene(*size))
    data = (tmp_path / "a.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat"), "the index must be at the front"
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.pix_fmt == "yuv420p"
        context = stream.codec_context  # without these, players take what is high for BT.709
        assert (context.colorspace, context.color_primaries, context.color_trc, context.color_range) == (6, 6, 6, 1)
        assert (stream.height, stream.width) == tuple(side + side % 2 for side in size)
        assert len(list(container.decode(stream))) == 5
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_time_stamps_that_stand_still_or_go_back_are_mended(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4") as writer:
        for timestamp in (0.0, 0.0, 0.2, 0.1, 0.3):
            writer.write(coloured_scene(32, 32), timestamp)
    times = [frame.timestamp or 0.0 for frame in VideoReader(tmp_path / "a.mp4")]
    assert len(times) == 5
    assert times == sorted(set(times))


@pytest.mark.parametrize(
    ("given", "written"),
    [
        ([2.5, 2.6, 2.9], [0.0, 0.1, 0.4]),
        ([1.0, 0.5, 1.2], [0.0, 1 / 90_000, 0.2]),
        ([5.0, 30_005.0, 30_005.1, 90_000.0, 90_001.0], [0.0, 1000.0, 1000.1, 2000.1, 2001.1]),
    ],
)
def test_a_video_begins_with_its_first_frame_and_shows_none_for_hours(
    tmp_path: Path, given: list[float], written: list[float]
) -> None:
    with VideoWriter(tmp_path / "a.mp4") as writer:
        for timestamp in given:
            writer.write(coloured_scene(32, 32), timestamp)
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert [float(frame.time) for frame in container.decode(video=0)] == pytest.approx(written, abs=1e-5)


@pytest.mark.parametrize("rate", [1e-9, 0.0001, 0.0004, 1000.0])
def test_any_rate_can_be_written(tmp_path: Path, rate: float) -> None:
    with VideoWriter(tmp_path / "a.mp4", rate) as writer:
        for _ in range(6):
            writer.write(coloured_scene(32, 32))
    times = [frame.timestamp for frame in VideoReader(tmp_path / "a.mp4")]
    assert times == pytest.approx([i * min(1000, 1 / rate) for i in range(6)])
    with av.open(str(tmp_path / "a.mp4")) as container:  # the last is shown as long as the others
        assert container.duration / 1e6 == pytest.approx(6 * min(1000, 1 / rate))


def test_a_change_of_size_is_brought_to_the_first(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4") as writer:
        writer.write(coloured_scene(64, 96))
        writer.write(coloured_scene(96, 64))
    assert [frame.image.shape for frame in VideoReader(tmp_path / "a.mp4")] == [(64, 96, 3)] * 2


def test_without_frames_there_is_no_file(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_an_unfinished_video_has_no_final_name(tmp_path: Path) -> None:
    folder = tmp_path / "made"
    writer = VideoWriter(folder / "a.mp4")
    for _ in range(3):
        writer.write(coloured_scene(32, 32))
    assert not (folder / "a.mp4").exists()
    writer.close()
    assert [file.name for file in folder.iterdir()] == ["a.mp4"]


def test_a_frame_after_the_end_is_refused(tmp_path: Path) -> None:
    writer = VideoWriter(tmp_path / "a.mp4")
    writer.write(coloured_scene(32, 32))
    writer.close()
    with pytest.raises(OutputError, match=r"a\.mp4: the video was closed"):
        writer.write(coloured_scene(32, 32))
    writer.close()
    assert (tmp_path / "a.mp4").exists()


@pytest.mark.parametrize(
    ("name", "rate", "told"), [("a.avi", None, r"a\.avi: .* as \.mp4"), ("a.mp4", -1.0, "above 0, got -1")]
)
def test_a_video_of_another_kind_or_without_time_is_refused(
    tmp_path: Path, name: str, rate: float | None, told: str
) -> None:
    with pytest.raises(ConfigError, match=told):
        VideoWriter(tmp_path / name, rate)


def test_a_frame_that_is_no_picture_takes_nothing_from_the_video(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4") as writer:
        with pytest.raises(ShapeError, match=r"H\.264 takes at most 16384 pixels a side, got 16385 x 8"):
            writer.write(np.zeros((8, 16385, 3), np.uint8))
        writer.write(coloured_scene(32, 32))
        for wrong in (np.zeros((32, 32, 3)), np.zeros((32, 32, 2), np.uint8), np.zeros((0, 32, 3), np.uint8)):
            with pytest.raises(ShapeError, match="an image must be"):
                writer.write(wrong)  # type: ignore[arg-type]
        writer.write(coloured_scene(32, 32)[..., 0])
    assert [frame.index for frame in VideoReader(tmp_path / "a.mp4")] == [0, 1]


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    writer = VideoWriter(tmp_path / "file" / "a.mp4")
    for _ in range(20):  # more than wait in the queue: writing must not hang
        try:
            writer.write(coloured_scene(32, 32))
        except OutputError:
            break
    with pytest.raises(OutputError, match=r"a\.mp4: the video cannot be written"):
        writer.close()


@pytest.mark.skipif(sys.platform == "win32", reason="files are not locked there")
def test_a_video_that_another_process_writes_is_left_to_it(tmp_path: Path) -> None:
    with written_by_another_process(tmp_path / "a.mp4"):
        writer = VideoWriter(tmp_path / "a.mp4")
        writer.write(coloured_scene(32, 32))
        with pytest.raises(OutputError, match=r"a\.mp4: it is being written already; wait for its end"):
            writer.close()
        assert (tmp_path / "a.mp4.part").read_text() == "half\n"
    with VideoWriter(tmp_path / "a.mp4") as writer:
        writer.write(coloured_scene(32, 32))
    assert [file.name for file in tmp_path.iterdir()] == ["a.mp4"]


def resident() -> float:
    """Return the process's resident memory in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux's /proc")
def test_memory_is_flat_over_10000_frames(tmp_path: Path) -> None:
    marks = []
    predictor = Predictor(ColourBackend(), long_side=64, batch_size=4)
    stream = PerceptionStream(Scenes(10_000, (72, 128)), predictor)
    with stream, VideoWriter(tmp_path / "a.mp4", preset="ultrafast") as writer:
        for i, item in enumerate(stream):
            assert isinstance(item, Perception)
            writer.write(item.draw(), item.timestamp)
            if i % 1000 == 999:
                gc.collect()
                marks.append(resident())
    assert len(marks) == 10
    assert marks[-1] - marks[2] < 12, f"resident memory grew: {marks}"


def test_frame_is_what_it_says() -> None:
    frame = next(iter(Scenes(1)))
    assert isinstance(frame, Frame)
    assert (frame.index, frame.timestamp, frame.source) == (0, 0.0, "scenes")


def test_a_lower_quality_makes_a_smaller_file(tmp_path: Path) -> None:
    sizes = []
    for quality in (10, 45):
        with VideoWriter(tmp_path / f"{quality}.mp4", quality=quality) as writer:
            for seed in range(5):
                writer.write(np.random.default_rng(seed).integers(0, 256, (96, 160, 3), np.uint8))
        sizes.append((tmp_path / f"{quality}.mp4").stat().st_size)
    assert sizes[0] > 2 * sizes[1]
