from __future__ import annotations

import contextlib
import functools
import http.server
import io
import itertools
import logging
import re
import subprocess
import sys
import threading
import types
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from trilitenet.errors import ConfigError, InputError
from trilitenet.inference import sources
from trilitenet.inference.sources import (
    CameraReader,
    Clip,
    Failure,
    Frame,
    FrameReader,
    SequenceReader,
    Stills,
    StreamReader,
    VideoReader,
    find_sources,
)
from trilitenet.inference.video import VideoWriter

av = pytest.importorskip("av")


def shade(index: int, height: int = 96, width: int = 160) -> np.ndarray:
    """Return an image whose brightness tells its index, with its upper left corner white."""
    image = np.full((height, width, 3), 20 + 10 * index, np.uint8)
    image[: height // 4, : width // 4] = 255
    return image


def index_of(frame: Frame) -> int:
    return round((float(frame.image[-10:, -10:].mean()) - 20) / 10)


def video(path: Path, frames: int = 20, rate: float = 10, times: list[float] | None = None) -> Path:
    with VideoWriter(path, rate, quality=10) as writer:
        for i in range(frames):
            writer.write(shade(i), None if times is None else times[i])
    return path


def encoded(
    first: int, frames: int, form: str, codec: str, *, pixels: str = "yuv420p", key_every: int = 1, b_frames: int = 0
) -> bytes:
    """Return a video at 10 frames a second, of one of FFmpeg's formats."""
    buffer = io.BytesIO()
    with av.open(buffer, "w", format=form) as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 96, pixels
        stream.codec_context.gop_size, stream.codec_context.max_b_frames = key_every, b_frames
        stream.bit_rate = 2_000_000
        for i in range(first, first + frames):
            frame = av.VideoFrame.from_ndarray(shade(i), "rgb24").reformat(format=pixels)
            frame.pts, frame.time_base = i - first, Fraction(1, 10)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)
    return buffer.getvalue()


def transport_stream(first: int, frames: int) -> bytes:
    """Return an MPEG-TS stream, which can be cut anywhere."""
    return encoded(first, frames, "mpegts", "mpeg2video")


def test_a_video_gives_every_frame_in_order_with_its_time(tmp_path: Path) -> None:
    reader = VideoReader(video(tmp_path / "a.mp4"))
    frames = list(reader)
    assert [index_of(frame) for frame in frames] == [frame.index for frame in frames] == list(range(20))
    assert [frame.timestamp for frame in frames] == pytest.approx([i / 10 for i in range(20)])
    assert (reader.rate, reader.expected, reader.broken) == (10, 20, 0)
    assert frames[0].source == str(tmp_path / "a.mp4")


def test_colours_survive_the_way_there_and_back(tmp_path: Path) -> None:
    scene = np.zeros((96, 160, 3), np.uint8)
    colours = np.array([(200, 30, 30), (30, 160, 30), (30, 30, 200), (120, 120, 120)])
    for i, colour in enumerate(colours):
        scene[:, 40 * i : 40 * i + 40] = colour
    with VideoWriter(tmp_path / "colours.mp4", 10, quality=10) as writer:
        writer.write(scene)
    (frame,) = VideoReader(tmp_path / "colours.mp4")
    np.testing.assert_allclose(frame.image[48, [20, 60, 100, 140]].astype(int), colours, atol=6)


@pytest.mark.parametrize(
    ("clip", "expected"),
    [
        (Clip(every=6), [0, 6, 12, 18]),
        (Clip(start=1.5), [15, 16, 17, 18, 19]),
        (Clip(end=0.3), [0, 1, 2]),
        (Clip(start=0.52, end=1.2, every=3), [6, 9]),
        (Clip(start=0.55, end=1.2, every=3), [6, 9]),
        (Clip(end=100, every=10), [0, 10]),
        (Clip(max_frames=2), [0, 1]),
        (Clip(start=1.0, max_frames=2, every=4), [10, 14]),
    ],
)
def test_parts_of_a_video(tmp_path: Path, clip: Clip, expected: list[int]) -> None:
    reader = VideoReader(video(tmp_path / "a.mp4"), clip)
    frames = list(reader)
    assert [index_of(frame) for frame in frames] == [frame.index for frame in frames] == expected
    assert [frame.timestamp for frame in frames] == pytest.approx([i / 10 for i in expected])
    assert reader.expected is not None
    assert abs(reader.expected - len(expected)) <= 1


@pytest.mark.parametrize(("clip", "indices"), [(Clip(start=0.666667), [2, 3, 4]), (Clip(end=0.666667), [0, 1])])
def test_a_time_is_met_to_six_places(tmp_path: Path, clip: Clip, indices: list[int]) -> None:
    path = video(tmp_path / "a.mp4", frames=5, rate=3)
    assert [frame.index for frame in VideoReader(path, clip)] == indices


@pytest.mark.parametrize(
    ("form", "codec", "pixels"),
    [("h264", "libx264", "yuv420p"), ("mjpeg", "mjpeg", "yuvj420p"), ("mpegts", "libx264", "yuv420p")],
    ids=["no time stamps", "no first time stamp", "nothing to decode behind the last key frame"],
)
def test_a_part_is_that_of_the_whole_where_seeking_leads_astray(
    tmp_path: Path, form: str, codec: str, pixels: str
) -> None:
    path = tmp_path / "video"
    path.write_bytes(encoded(0, 20, form, codec, pixels=pixels, key_every=12))
    whole = [(index_of(frame), frame.index, frame.timestamp) for frame in VideoReader(path)]
    assert [index for index, _, _ in whole] == list(range(20))
    for first in (7, 18):
        part = VideoReader(path, Clip(start=whole[first][2] or 0.0))
        assert [(index_of(frame), frame.index, frame.timestamp) for frame in part] == whole[first:]


def test_mpeg_ts_is_not_read_from_its_beginning_where_a_key_frame_is_near(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.ts"
    path.write_bytes(encoded(0, 20, "mpegts", "libx264", key_every=12))
    reader = VideoReader(path, Clip(start=1.5))
    opened, again = [], reader._open

    def noted() -> Any:
        opened.append(path)
        return again()

    monkeypatch.setattr(reader, "_open", noted)
    monkeypatch.setattr("trilitenet.inference.sources._KEY_FRAMES", 0.6)
    assert [index_of(frame) for frame in reader] == list(range(15, 20))
    assert len(opened) == 1


def test_a_variable_frame_rate_is_kept(tmp_path: Path) -> None:
    times = [0, 0.1, 0.15, 0.5, 0.9, 2.0]
    frames = list(VideoReader(video(tmp_path / "a.mp4", frames=6, times=times)))
    assert [frame.timestamp for frame in frames] == pytest.approx(times, abs=1e-3)
    assert [index_of(frame) for frame in frames] == list(range(6))


def test_the_index_at_a_variable_frame_rate_counts_what_was_skipped(tmp_path: Path) -> None:
    path = video(tmp_path / "a.mp4", frames=6, times=[0, 0.1, 0.15, 0.5, 0.9, 2.0])
    for start in (0.12, 0.4):
        frames = list(VideoReader(path, Clip(start=start)))
        assert [index_of(frame) for frame in frames] == [frame.index for frame in frames]


@pytest.mark.parametrize(
    ("matrix", "upright"),
    [
        ((0, 1, -1, 0), np.rot90(shade(0), -1)),
        ((-1, 0, 0, -1), np.rot90(shade(0), 2)),
        ((0, -1, 1, 0), np.rot90(shade(0), 1)),
        ((-1, 0, 0, 1), np.fliplr(shade(0))),
        ((1, 0, 0, -1), np.flipud(shade(0))),
        ((0, 1, 1, 0), shade(0).swapaxes(0, 1)),
        ((0, -1, -1, 0), np.rot90(shade(0), 2).swapaxes(0, 1)),
    ],
)
def test_rotation_and_mirroring_noted_in_the_file_are_applied(
    tmp_path: Path, matrix: tuple[int, ...], upright: np.ndarray
) -> None:
    path = video(tmp_path / "a.mp4", frames=2)
    data = bytearray(path.read_bytes())
    place = data.index(b"tkhd") + 4 + 40  # the transformation matrix of the track header, 16.16 fixed point
    a, b, c, d = (value << 16 for value in matrix)
    for offset, value in ((0, a), (4, b), (12, c), (16, d)):
        data[place + offset : place + offset + 4] = value.to_bytes(4, "big", signed=True)
    path.write_bytes(data)
    frame = next(iter(VideoReader(path)))
    assert frame.image.shape == upright.shape
    np.testing.assert_allclose(frame.image.astype(int), upright, atol=12)


@pytest.mark.parametrize(("turned", "aspect"), [(0, Fraction(4, 3)), (90, Fraction(3, 4)), (180, Fraction(4, 3))])
def test_pixels_that_are_no_squares_are_told(tmp_path: Path, turned: int, aspect: Fraction) -> None:
    with VideoWriter(tmp_path / "a.mp4", 10) as writer:
        writer.pixel_aspect = Fraction(4, 3)
        writer.write(shade(0))
    with av.open(str(tmp_path / "a.mp4")) as plain, av.open(str(tmp_path / "b.mp4"), "w") as container:
        stream = container.add_stream_from_template(plain.streams.video[0])
        stream.set_display_rotation(turned)
        for packet in plain.demux(plain.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                container.mux(packet)
    reader = VideoReader(tmp_path / "b.mp4")
    assert next(iter(reader)).image.shape == ((160, 96, 3) if turned == 90 else (96, 160, 3))
    assert reader.pixel_aspect == aspect
    reader = VideoReader(video(tmp_path / "c.mp4", frames=1))
    assert len(list(reader)) == 1
    assert reader.pixel_aspect is None


def test_broken_frames_are_left_out_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    data = bytearray(transport_stream(0, 20))
    rng = np.random.default_rng(0)
    for start in range(len(data) // 3, len(data) // 3 + 3000, 188):
        data[start : start + 100] = rng.integers(0, 256, 100, dtype=np.uint8).tobytes()
    (tmp_path / "a.ts").write_bytes(data)
    reader = VideoReader(tmp_path / "a.ts")
    with caplog.at_level(logging.WARNING):
        frames = list(reader)
    assert 10 <= len(frames) < 20
    times = [frame.timestamp or 0.0 for frame in frames]
    assert times == sorted(times)
    assert times[-1] == pytest.approx(1.9)
    indices = [frame.index or 0 for frame in frames]
    assert indices == sorted(set(indices))
    assert indices[-1] == len(frames) + reader.broken - 1


def test_a_frame_of_which_a_part_was_lost_is_left_out(tmp_path: Path) -> None:
    data = transport_stream(0, 20)
    lost = len(data) // 188 // 3 * 188
    (tmp_path / "a.ts").write_bytes(data[:lost] + data[lost + 188 :])
    reader = VideoReader(tmp_path / "a.ts")
    assert len(list(reader)) >= 18
    assert reader.broken == 1


def test_a_video_cut_short_gives_what_there_is(tmp_path: Path) -> None:
    data = transport_stream(0, 20)
    (tmp_path / "a.ts").write_bytes(data)
    assert VideoReader(tmp_path / "a.ts").expected == 20
    (tmp_path / "a.ts").write_bytes(data[: len(data) // 2])
    assert 6 <= len(list(VideoReader(tmp_path / "a.ts"))) <= 12


def noise(path: Path, frames: int = 40) -> Path:
    """Write a video at 10 frames a second whose frames take the same space each, its index first."""
    rng = np.random.default_rng(0)
    with VideoWriter(path, 10) as writer:
        for _ in range(frames):
            writer.write(rng.integers(0, 256, (96, 160, 3), np.uint8))
    return path


@pytest.mark.parametrize("ending", ["mp4", "mkv", "avi"])
def test_a_video_that_ends_before_its_length_is_told(
    tmp_path: Path, ending: str, caplog: pytest.LogCaptureFixture
) -> None:
    whole, cut = noise(tmp_path / "whole.mp4"), tmp_path / f"cut.{ending}"
    if ending != "mp4":
        with av.open(str(whole)) as plain, av.open(str(whole.with_suffix(f".{ending}")), "w") as container:
            stream = container.add_stream("mpeg4", rate=10)
            stream.width, stream.height, stream.bit_rate = 160, 96, 4_000_000
            for frame in [*plain.decode(video=0), None]:
                container.mux(stream.encode(frame))
        whole = whole.with_suffix(f".{ending}")
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    assert len(list(VideoReader(whole))) == 40
    assert caplog.text == ""
    assert len(list(VideoReader(cut, Clip(max_frames=5)))) == 5
    assert caplog.text == ""
    assert 5 < len(list(VideoReader(cut))) < 35
    assert "s of 4.0 s; the file may be cut off" in caplog.text
    assert "1 broken frames" not in caplog.text


def test_a_file_behind_a_url_whose_connection_is_lost_is_an_error_after_what_came(tmp_path: Path) -> None:
    data = noise(tmp_path / "a.mp4").read_bytes()
    frames: list[Frame] = []
    with Server([data[: len(data) * 2 // 3]] * 3, length=len(data)) as server:
        (source,), _ = find_sources([server.url])
        assert isinstance(source, VideoReader)
        with pytest.raises(InputError, match=r"live\.ts: the connection was lost after \d\.\d s \("):
            frames.extend(source)
    assert 5 < len(frames) < 35


@pytest.mark.parametrize("clip", [Clip(), Clip(start=0.05)])
def test_broken_frames_at_the_beginning_are_counted_once(tmp_path: Path, clip: Clip) -> None:
    whole, broken = noise(tmp_path / "whole.mp4", 1), tmp_path / "broken.avi"
    with av.open(str(whole)) as plain, av.open(str(broken), "w") as container:
        stream = container.add_stream("mjpeg", rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 96, "yuvj420p"
        (frame,) = plain.decode(video=0)
        for index in range(10):
            frame.pts, frame.time_base = index, Fraction(1, 10)
            container.mux(stream.encode(frame.reformat(format="yuvj420p")))
    data = bytearray(broken.read_bytes())
    with av.open(str(broken)) as container:
        packets = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    for position, size in packets[:3]:
        data[position + 8 : position + size] = bytes(size - 8)
    broken.write_bytes(data)
    assert [frame.index for frame in VideoReader(broken, clip)] == list(range(3, 10))


@pytest.mark.parametrize("ending", ["mkv", "flv"])
def test_sound_that_is_longer_than_the_video_does_not_make_it_cut_off(
    tmp_path: Path, ending: str, caplog: pytest.LogCaptureFixture
) -> None:
    path, cut = tmp_path / f"a.{ending}", tmp_path / f"cut.{ending}"
    with av.open(str(noise(tmp_path / "a.mp4", 10))) as plain, av.open(str(path), "w") as container:
        stream = container.add_stream("flv1" if ending == "flv" else "mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 96, "yuv420p"
        sound = container.add_stream("aac", rate=44100, layout="mono")
        for frame in [*plain.decode(video=0), None]:
            container.mux(stream.encode(frame))
        for index in range(130):  # 3 s
            samples = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
            samples.sample_rate, samples.pts, samples.time_base = 44100, index * 1024, Fraction(1, 44100)
            container.mux(sound.encode(samples))
        container.mux(sound.encode(None))
    assert len(list(VideoReader(path))) == 10
    assert caplog.text == ""
    cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert 0 < len(list(VideoReader(cut))) < 10
    assert "the file may be cut off" in caplog.text


def test_an_avi_whose_length_could_not_be_written_is_not_cut_off(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.avi"
    with av.open(str(noise(tmp_path / "a.mp4", 10))) as plain, path.open("wb") as file:
        pipe = types.SimpleNamespace(write=file.write)
        with av.open(pipe, "w", format="avi") as container:
            stream = container.add_stream("mpeg4", rate=10)
            stream.width, stream.height, stream.pix_fmt = 160, 96, "yuv420p"
            for frame in [*plain.decode(video=0), None]:
                container.mux(stream.encode(frame))
    assert len(list(VideoReader(path))) == 10
    assert caplog.text == ""


def test_what_is_no_video_is_named(tmp_path: Path) -> None:
    good = video(tmp_path / "good.mp4").read_bytes()
    for name, data in {"text.mp4": b"not a video" * 100, "empty.mp4": b"", "cut.mp4": good[:600]}.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=name):
            VideoReader(tmp_path / name)
    with av.open(str(tmp_path / "sound.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        silence.sample_rate = 44100
        for frame in (silence, None):
            for packet in stream.encode(frame):
                container.mux(packet)
    with pytest.raises(InputError, match=r"sound\.mp4: has no video stream"):
        VideoReader(tmp_path / "sound.mp4")


def test_no_frames_is_an_error(tmp_path: Path) -> None:
    reader = VideoReader(video(tmp_path / "a.mp4"), Clip(start=100))
    with pytest.raises(InputError, match="has no frames that can be decoded between --start and --end"):
        list(reader)

    class Empty(FrameReader):
        def _decode(self) -> Iterator[tuple[float, Callable[[], np.ndarray]]]:
            yield from ()

    with pytest.raises(InputError, match=r"empty: has no frames that can be decoded$"):
        list(Empty("empty"))


def read_piped(data: bytes) -> subprocess.CompletedProcess[bytes]:
    script = (
        "from trilitenet.inference.sources import VideoReader\n"
        "print([(f.index, f.source, f.image.shape) for f in VideoReader('-')])"
    )
    return subprocess.run([sys.executable, "-c", script], input=data, capture_output=True, timeout=60, check=False)


def test_standard_input() -> None:
    done = read_piped(transport_stream(0, 3))
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout.decode().strip() == str([(i, "stdin", (96, 160, 3)) for i in range(3)])


def test_an_mp4_read_in_one_go_with_its_index_at_the_end_is_told_with_the_cure() -> None:
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 320, 192, "yuv420p"
        stream.bit_rate = 20_000_000
        noise = np.random.default_rng(0)
        for _ in range(20):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(noise.integers(0, 256, (192, 320, 3), np.uint8))))
        container.mux(stream.encode(None))
    data = buffer.getvalue()
    message = read_piped(data).stderr.decode().splitlines()[-1]
    assert "InputError: stdin: " in message
    assert "+faststart" in message
    with Server([data] * 3, length=len(data)) as server:  # one that knows no parts of a file
        (source,), _ = find_sources([server.url])
        with pytest.raises(InputError, match=r"live\.ts: cannot be read in one go \(.*\+faststart"):
            list(source)


class Server:
    """An HTTP server on this machine that sends one part a connection and hangs up; then refuses."""

    def __init__(self, parts: list[bytes], *, length: int = 0) -> None:
        self.connections = 0
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if outer.connections >= len(parts):
                    self.send_error(404)
                    return
                part = parts[outer.connections]
                outer.connections += 1
                self.send_response(200)
                self.send_header("Content-Type", "video/mp2t")
                if length:
                    self.send_header("Content-Length", str(length))
                self.end_headers()
                self.wfile.write(part)

            def log_message(self, *args: Any) -> None:
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        self.url = f"http://user:secret@127.0.0.1:{self.server.server_port}/live.ts?token=x"

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self.server.shutdown()
        self.server.server_close()


def read_until_lost(reader: FrameReader, reason: str = "") -> list[Frame]:
    """Return the frames before a stream is given up, with an error of this reason."""
    frames: list[Frame] = []
    with pytest.raises(InputError, match=rf"^{re.escape(reader.name)}: given up after \d+ attempts \({reason}"):
        frames.extend(reader)
    return frames


def test_a_stream_that_dies_twice_is_picked_up(caplog: pytest.LogCaptureFixture) -> None:
    with Server([transport_stream(0, 15), transport_stream(15, 4), transport_stream(19, 4)]) as server:
        reader = StreamReader(server.url, retries=1, backoff=0.01)
        with caplog.at_level(logging.WARNING):
            frames = read_until_lost(reader, "is not a video")
    seen = [index_of(frame) for frame in frames]
    assert seen == sorted(seen)
    assert {0, 5, 6, 10, 11} <= set(seen)
    assert [frame.index for frame in frames] == list(range(len(frames)))
    times = [frame.timestamp or 0.0 for frame in frames]
    assert times[0] == pytest.approx(0, abs=1e-3)
    assert np.diff(times).min() > 0.05  # five frames of a tenth of a second come at once, so the clock is behind them
    assert reader.reconnections == 2
    assert "trying again" in caplog.text
    assert "secret" not in caplog.text
    assert "token" not in frames[0].source


def test_the_times_of_a_camera_that_sends_jpegs_are_the_clock_s(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(100 + 0.5 * i for i in range(100))  # far from the 25 frames a second that FFmpeg supposes
    monkeypatch.setattr("trilitenet.inference.sources.time", types.SimpleNamespace(monotonic=lambda: next(clock)))
    buffer = io.BytesIO()
    Image.fromarray(shade(1)).save(buffer, "jpeg")
    part = b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%s\r\n"
    with Server([part % (len(buffer.getvalue()), buffer.getvalue()) * 4]) as server:
        times = [frame.timestamp for frame in read_until_lost(StreamReader(server.url, retries=0))]
    assert times == [0.5, 1.0, 1.5, 2.0]


def test_a_playlist_whose_sender_wrote_its_end_is_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "live.ts").write_bytes(transport_stream(0, 5))
    head = "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:0.5,\nlive.ts\n"
    (tmp_path / "live.m3u8").write_text(f"{head}#EXT-X-ENDLIST\n")
    monkeypatch.setattr(sources, "_PATIENCE", None)  # it is a file here, on which nobody waits
    reader = StreamReader(str(tmp_path / "live.m3u8"), retries=1, backoff=0.01)
    assert [index_of(frame) for frame in itertools.islice(reader, 8)] == list(range(5))  # and not again and again


def test_a_stream_that_never_comes_is_an_error_at_once() -> None:
    with Server([]) as server, pytest.raises(InputError, match=r"http://127\.0\.0\.1:\d+/live\.ts: is not a video"):
        list(StreamReader(server.url, backoff=60))


def test_a_url_without_an_end_is_a_stream_and_one_without_an_answer_is_told_without_its_secrets() -> None:
    with Server([transport_stream(0, 5)]) as server:
        (source,), _ = find_sources([server.url])
        assert isinstance(source, StreamReader)
        (failure,) = find_sources([server.url])[1]
    assert failure.source == source.name
    assert failure.reason.startswith(f"{source.name}: is not a video")
    assert not {"secret", "token"} & set(re.findall(r"\w+", f"{failure.source} {failure.reason}"))


def test_a_url_may_be_left_alone_until_it_is_wanted(tmp_path: Path) -> None:
    data = video(tmp_path / "a.mp4", frames=5).read_bytes()
    for parts, length, live in (([data] * 3, len(data), False), ([transport_stream(0, 5)] * 2, 0, True)):
        with Server(parts, length=length) as server:
            (first, second), failures = find_sources([server.url, f"{server.url}&y"], unopened=True)
            assert isinstance(second, StreamReader)
            assert not failures
            assert server.connections == 0
            second.retries = 0
            assert second.live is live  # which it finds out
            assert (second.live, second.expected) == (live, None if live else 5)
            frames = read_until_lost(second) if live else list(second)
            assert [index_of(frame) for frame in frames] == [frame.index for frame in frames]
            assert len(frames) >= (4 if live else 5)  # the last may be lost where a stream breaks
            assert {frame.source for frame in frames} == {f"{server.url[:7]}{server.url[19:-8]}-2"}
            assert isinstance(first, FrameReader)
            with pytest.raises(InputError, match=rf"^{re.escape(first.name)}: is not a video"):
                list(first)


def test_each_frame_of_a_stream_is_there_as_soon_as_it_came(tmp_path: Path) -> None:
    video(tmp_path / "a.mp4", frames=3)
    for live, kind in ((True, "SLICE"), (False, "AUTO")):
        with sources._open_container(str(tmp_path / "a.mp4"), "a", live=live) as container:
            assert container.streams.video[0].thread_type.name == kind


def test_closing_ends_the_wait_for_a_stream() -> None:
    with Server([transport_stream(0, 3)]) as server:
        reader = StreamReader(server.url, backoff=60)
        threading.Timer(0.5, reader.close).start()
        assert len(list(reader)) >= 1


def test_the_wait_grows_up_to_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    with Server([transport_stream(0, 3)]) as server:
        reader = StreamReader(server.url, backoff=1, longest=5, retries=5)
        waits: list[float] = []

        def wait(seconds: float) -> bool:
            waits.append(seconds)
            return False

        monkeypatch.setattr(reader._closed, "wait", wait)
        read_until_lost(reader)
    assert waits == [1, 2, 4, 5, 5]


def test_a_url_of_a_file_of_this_machine_is_its_path(tmp_path: Path) -> None:
    path = tmp_path / "a drive.mp4"
    video(path, frames=5)
    for url in (path.as_uri(), path.as_uri().replace("file:///", "FILE://localhost/")):
        (source,), _ = find_sources([url, path])
        assert isinstance(source, VideoReader)
        assert source.name == str(path)
        assert len(list(source)) == 5


def test_a_url_of_a_file_is_read_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video(tmp_path / "a.mp4", frames=5)
    (tmp_path / "a.ts").write_bytes(transport_stream(0, 5))
    with av.open(str(tmp_path / "a.h264"), "w", format="h264") as raw:
        stream = raw.add_stream("h264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for i in range(5):
            raw.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((48, 64, 3), 40 * i, np.uint8), format="rgb24")))
        raw.mux(stream.encode(None))
    opened, plain = [], av.open

    def noted(*args: Any, **options: Any) -> Any:
        opened.append(options["timeout"])
        return plain(*args, **options)

    monkeypatch.setattr(av, "open", noted)
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(tmp_path))
    monkey: Any = http.server.SimpleHTTPRequestHandler
    quiet = type("Quiet", (monkey,), {"log_message": lambda *_: None})
    handler = functools.partial(quiet, directory=str(tmp_path))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        for name in ("a.mp4", "a.ts", "a.h264"):  # the last has no length in seconds
            (source,), failures = find_sources([f"http://127.0.0.1:{server.server_port}/{name}"])
            assert not failures
            assert isinstance(source, VideoReader)
            assert len(list(source)) == 5
        assert opened == [10.0] * len(opened)
        assert opened
    finally:
        server.shutdown()
        server.server_close()


def test_numbered_pictures_are_a_video(tmp_path: Path) -> None:
    for i in (3, 4, 5, 7):
        Image.fromarray(shade(i)).save(tmp_path / f"img_{i:04d}.png")
    (tmp_path / "img_0005.png").write_bytes(b"broken")
    for other in ("img_0005x.png", "img_6.png"):
        (tmp_path / other).write_bytes(b"another")
    reader = SequenceReader(str(tmp_path / "img_%04d.png"), rate=10)
    frames = list(reader)
    assert [index_of(frame) for frame in frames] == [3, 4, 7]
    assert [frame.timestamp for frame in frames] == [0, 0.1, pytest.approx(0.3)]
    assert [frame.index for frame in frames] == [0, 1, 3]
    assert (reader.broken, reader.expected) == (1, 4)
    assert reader.name == str(tmp_path / "img")
    later = list(SequenceReader(str(tmp_path / "img_%04d.png"), Clip(start=0.14), rate=10))
    assert [(frame.index, index_of(frame)) for frame in later] == [(3, 7)]
    with pytest.raises(InputError, match="no file matches"):
        SequenceReader(str(tmp_path / "other_%04d.png"))
    with pytest.raises(ConfigError, match="must be above 0"):
        SequenceReader(str(tmp_path / "img_%04d.png"), rate=0)
    with pytest.raises(ConfigError, match="must be above 0"):
        find_sources([tmp_path / "img_0003.png"], rate=0)


def test_a_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    released: list[Camera] = []

    class Camera:
        def __init__(self, number: int) -> None:
            self.left = 3 if number == 0 else 0
            self.opened = number == 0

        def isOpened(self) -> bool:  # noqa: N802 - as OpenCV calls it
            return self.opened

        def get(self, _: int) -> float:
            return 25.0

        def read(self) -> tuple[bool, np.ndarray | None]:
            self.left -= 1
            blue_in_bgr = np.zeros((8, 8, 3), np.uint8)
            blue_in_bgr[..., 0] = 255
            return self.left >= 0, blue_in_bgr

        def release(self) -> None:
            released.append(self)

    monkeypatch.setattr("cv2.VideoCapture", Camera)
    frames = list(CameraReader(0, Clip(max_frames=3)))
    assert len(frames) == 3
    assert len(released) == 1
    lost = iter(CameraReader(0))
    assert [next(lost).index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(InputError, match=r"^camera-0: gives no more frames; is it still connected"):
        next(lost)
    assert frames[0].source == "camera-0"
    np.testing.assert_array_equal(frames[0].image[0, 0], [0, 0, 255])
    with pytest.raises(InputError, match="camera-7: there is no such camera"):
        list(CameraReader(7))
    levels = [3]

    def set_level(level: int) -> int:
        levels.append(level)
        return levels[-2]

    monkeypatch.setattr("cv2.setLogLevel", set_level, raising=False)  # as in OpenCV 4
    assert len(list(CameraReader(0, Clip(max_frames=3)))) == 3
    assert levels == [3, 0, 3]


def test_stills_go_on_past_a_broken_one(tmp_path: Path) -> None:
    Image.fromarray(shade(1)).save(tmp_path / "a.png")
    (tmp_path / "b.png").write_bytes(b"broken")
    first, second = Stills((tmp_path / "a.png", tmp_path / "b.png"))
    assert isinstance(first, Frame)
    assert first.index is first.timestamp is None
    assert isinstance(second, Failure)
    assert second.source == str(tmp_path / "b.png")


def test_what_a_user_names(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    (folder / "below").mkdir(parents=True)
    for name in ("10.png", "9.png", ".hidden.png", "below/1.png"):
        Image.fromarray(shade(0)).save(folder / name)
    video(folder / "7.MP4", frames=1)
    found, failures = find_sources([folder])
    assert [type(source) for source in found] == [VideoReader, Stills]
    assert isinstance(found[1], Stills)
    assert [path.name for path in found[1].paths] == ["9.png", "10.png"]
    assert failures == []

    found, failures = find_sources([str(folder / "**" / "*.png"), "0", tmp_path / "no.png", tmp_path / "no*.png"])
    assert [type(source) for source in found] == [Stills, CameraReader]
    assert isinstance(found[0], Stills)
    assert [path.name for path in found[0].paths] == ["9.png", "10.png", "1.png"]
    assert [failure.reason for failure in failures] == [
        f"{tmp_path / 'no.png'}: no such file or folder",
        f"{tmp_path / 'no*.png'}: no file matches",
    ]
    found, _ = find_sources([folder / "9.png", folder, folder / "9.png", "rtsp://c.local/s", "rtsp://c.local/s"])
    assert [len(source.paths) for source in found if isinstance(source, Stills)] == [1, 1]
    assert [type(source) for source in found if not isinstance(source, Stills)] == [VideoReader, StreamReader]
    found, _ = find_sources(["rtsp://camera.local/stream"])
    assert [type(source) for source in found] == [StreamReader]
    (tmp_path / "nothing").mkdir()
    assert find_sources([tmp_path / "nothing"])[1][0].reason.endswith("is an empty folder")
    (tmp_path / "nothing" / "below").mkdir()
    (failure,) = find_sources([tmp_path / "nothing"])[1]
    assert failure.reason.endswith(f"has no files itself; for those in its folders: {str(tmp_path / 'nothing/**/*')!r}")


def test_what_is_there_by_a_name_is_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("2024").mkdir()
    paths = tuple(map(Path, ("2024/a.png", "stdin", "100%done.png")))
    for path in (*paths, Path("1.png")):
        Image.fromarray(shade(0)).save(path, "png")
    assert find_sources(["2024", *paths[1:]]) == ([Stills(paths)], [])
    assert SequenceReader("%d.png").name == "sequence"


def test_a_picture_by_two_ways_is_one_and_a_link_of_another_name_is_its_own(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    Image.fromarray(shade(0)).save(tmp_path / "folder" / "a.png")
    (tmp_path / "folder" / "b.png").symlink_to("a.png")
    (tmp_path / "same").symlink_to("folder")
    found, _ = find_sources([tmp_path / way for way in ("folder", "folder/../folder/a.png", "same/a.png")])
    assert [path.name for source in found if isinstance(source, Stills) for path in source.paths] == ["a.png", "b.png"]


def test_a_link_to_a_folder_above_gives_each_file_once_by_its_shortest_way(tmp_path: Path) -> None:
    (tmp_path / "car").mkdir()
    for name in ("a.png", "z.png"):
        Image.fromarray(shade(0)).save(tmp_path / "car" / name)
    (tmp_path / "car" / "link.png").symlink_to("z.png")
    (tmp_path / "car" / "m").symlink_to("..")
    pictures = tuple(tmp_path / "car" / name for name in ("a.png", "link.png", "z.png"))
    assert find_sources([tmp_path / "**" / "*"]) == ([Stills(pictures)], [])


@pytest.mark.parametrize("wrong", [{"every": 0}, {"max_frames": 0}, {"start": -1}, {"start": 3, "end": 2}])
def test_impossible_clips_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        Clip(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "times", [[0, 100, 200, 340, 410, 430, 1000, 1050, 1490, 2000], [0, 100, 200, 500, 600, 700, 800, 900, 1000, 1100]]
)
def test_matroska_that_states_a_rate_it_does_not_keep_is_counted(tmp_path: Path, times: list[int]) -> None:
    with av.open(tmp_path / "a.mkv", "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 96, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 1000)
        for i, time in enumerate(times):
            frame = av.VideoFrame.from_ndarray(shade(i), "rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)
    frames = list(VideoReader(tmp_path / "a.mkv"))
    assert [frame.timestamp for frame in frames] == pytest.approx([time / 1000 for time in times], abs=2e-3)
    assert [frame.index for frame in frames] == list(range(10))


def test_frames_without_time_stamps_come_at_the_rate_of_the_stream(tmp_path: Path) -> None:
    path = tmp_path / "a.h264"
    path.write_bytes(encoded(0, 8, "h264", "libx264", key_every=12))
    for clip, indices in ((Clip(), range(8)), (Clip(start=0.4), range(4, 8))):
        frames = list(VideoReader(path, clip))
        assert [index_of(frame) for frame in frames] == [frame.index for frame in frames] == list(indices)
        assert [frame.timestamp for frame in frames] == pytest.approx([i / 10 for i in indices])


@pytest.mark.parametrize(("codec", "b_frames"), [("libx264", 3), ("mpeg4", 2)])
def test_frames_that_avi_stores_in_another_order_than_they_are_shown_in_have_their_times(
    codec: str, b_frames: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.avi"
    path.write_bytes(encoded(0, 20, "avi", codec, key_every=5, b_frames=b_frames))
    for clip, indices in ((Clip(), range(20)), (Clip(start=1.2), range(12, 20))):
        frames = list(VideoReader(path, clip))
        assert [index_of(frame) for frame in frames] == [frame.index for frame in frames] == list(indices)
        assert [frame.timestamp for frame in frames] == pytest.approx([i / 10 for i in indices])
    assert caplog.text == ""


def test_what_is_well_before_the_start_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(encoded(0, 20, "mp4", "mpeg4", key_every=5))
    reader = VideoReader(path, Clip(start=1.2))
    assert next(reader._decode())[0] == 1.0
    assert [frame.index for frame in reader] == list(range(12, 20))


def test_broken_frames_that_come_before_the_first_after_the_start_are_counted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def frames_of(_: Any, reader: FrameReader) -> Iterator[tuple[float, Callable[[], np.ndarray]]]:
        reader.broken += 2
        for i in (2, 3, 4):
            yield i / 10, functools.partial(shade, i)

    reader = VideoReader(video(tmp_path / "a.mp4"), Clip(start=0.3))
    monkeypatch.setattr("trilitenet.inference.sources._frames_of", frames_of)
    assert [frame.index for frame in reader] == [3, 4]


def test_recordings_one_after_the_other_are_one_video(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "a.ts"
    path.write_bytes(transport_stream(0, 8) + transport_stream(8, 8))
    frames = list(VideoReader(path))
    assert "time stamps jump back after 0.700 s" in caplog.text
    assert [index_of(frame) for frame in frames] == [frame.index for frame in frames] == list(range(16))
    assert [frame.timestamp for frame in frames] == pytest.approx([i / 10 for i in range(16)], abs=1e-3)
    for clip, indices in ((Clip(start=0.5, end=1.0), range(5, 10)), (Clip(start=1.2), range(12, 16))):
        part = list(VideoReader(path, clip))
        assert [index_of(frame) for frame in part] == [frame.index for frame in part] == list(indices)


def test_readers_of_one_name_are_told_apart(tmp_path: Path) -> None:
    for ending, count in (("jpg", 2), ("png", 3)):
        for i in range(count):
            Image.fromarray(shade(i)).save(tmp_path / f"f{i}.{ending}")
    sources, failures = find_sources([str(tmp_path / "f%d.jpg"), str(tmp_path / "f%d.png")])
    assert not failures
    assert [source.name for source in sources if isinstance(source, FrameReader)] == [
        str(tmp_path / "f"),
        str(tmp_path / "f-2"),
    ]
    assert [frame.source for source in sources for frame in source if isinstance(frame, Frame)] == [
        *[str(tmp_path / "f")] * 2,
        *[str(tmp_path / "f-2")] * 3,
    ]


def test_numbered_pictures_that_are_not_wanted_are_not_read(tmp_path: Path) -> None:
    folder = tmp_path / "drive [1]"  # which is no pattern
    folder.mkdir()
    for i in range(9):
        Image.fromarray(shade(i)).save(folder / f"{i}.png")
    (folder / "1.png").write_bytes(b"broken")
    (folder / "4.png").write_bytes(b"broken")
    reader = SequenceReader(str(folder / "%d.png"), Clip(every=4))
    assert [frame.index for frame in reader] == [0, 8]
    assert reader.broken == 1


def test_a_link_to_nothing_is_told(tmp_path: Path) -> None:
    (tmp_path / "gone.jpg").symlink_to(tmp_path / "nope.png")
    (tmp_path / "folder").mkdir()
    (tmp_path / "linked").symlink_to(tmp_path / "folder")
    for name in (str(tmp_path), str(tmp_path / "*")):
        (source,), failures = find_sources([name])
        assert not failures
        (item,) = source
        assert isinstance(item, Failure)
        assert "gone.jpg" in item.reason


def test_standard_input_is_opened_once_though_its_first_frame_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []

    def container(path: str, *_: Any, **__: Any) -> Any:
        opened.append(path)
        return contextlib.nullcontext()

    late = [(time, functools.partial(shade, i)) for i, time in enumerate((0.1, 0.2))]
    monkeypatch.setattr("trilitenet.inference.sources._open_container", container)
    monkeypatch.setattr("trilitenet.inference.sources._frames_of", lambda *_: iter(late))
    assert [frame.timestamp for frame in VideoReader("-")] == [0.1, 0.2]
    assert opened == ["-"]


def test_rtsp_comes_over_tcp_which_loses_no_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    av = pytest.importorskip("av")
    options: list[dict[str, str]] = []

    def refuse(path: str, **settings: Any) -> None:
        options.append(settings["options"])
        raise OSError("nobody is there")

    monkeypatch.setattr(av, "open", refuse)
    for url in ("rtsp://127.0.0.1/live", "http://127.0.0.1/live.ts"):
        with pytest.raises(InputError, match="nobody is there"):
            list(StreamReader(url))
    assert options == [{"rtsp_transport": "tcp"}, {}]
