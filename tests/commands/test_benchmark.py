from __future__ import annotations

import dataclasses
import json
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from tests.artefacts import Artefacts
from tests.fakes import ColourBackend
from trilitenet.commands import benchmark as command
from trilitenet.commands.benchmark import benchmark
from trilitenet.commands.predict import predict_with
from trilitenet.errors import ConfigError, InputError, MissingExtraError, OutputError
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.torch_backend import TorchBackend
from trilitenet.inference.video import VideoWriter
from trilitenet.models.cost import count_multiply_adds, count_parameters
from trilitenet.models.trilitenet import build_network
from trilitenet.models.weights import save_network
from trilitenet.structures import RawOutputs


@pytest.mark.skipif(sys.platform == "win32", reason="the size of files is not limited there")
def test_a_plot_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    import resource

    pytest.importorskip("matplotlib")
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    entry = SimpleNamespace(model="tiny", runtime="a runtime")
    call: Any = SimpleNamespace(milliseconds=[1.0, 2.0], batch=1, stage="network", entry=entry)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with pytest.raises(OutputError, match=r"a\.png: cannot be written"):
            command._plot([call], path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
    command._plot([call], path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_models_take_turns(artefacts: Artefacts, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    weights, xml = (str(artefacts.folder / name) for name in ("weights.safetensors", "model.xml"))
    result = benchmark(
        weights,
        xml,
        batch=(1, 2),
        rounds=3,
        warmup=0,
        size=(64, 128),
        output=tmp_path / "a.json",
        plot=tmp_path / "a.svg",
    )
    assert [(row.model, row.batch) for row in result.timings] == [
        ("weights.safetensors", 1),
        ("weights.safetensors", 2),
        ("model.xml", 1),
        ("model.xml", 2),
    ]
    assert result.timings[0].ratio == 1
    for row in result.timings:
        assert 0 < row.p50 <= row.p90 <= row.p99
        assert row.frames_per_second == pytest.approx(1e3 * row.batch / row.p50)
        assert row.first_result > 0
    assert json.loads((tmp_path / "a.json").read_text())["rounds"] == 3
    assert "model.xml" in (tmp_path / "a.svg").read_text()
    assert "| model.xml | openvino cpu" in result.summary()


def test_the_table_tells_the_input_of_each_model(monkeypatch: pytest.MonkeyPatch) -> None:
    canvases = {"small.onnx": (32, 64), "large.onnx": (64, 128), "any": None}
    monkeypatch.setattr(
        "trilitenet.commands.benchmark.load", lambda model, **_: Predictor(ColourBackend(canvases[model]))
    )
    rows = benchmark(*canvases, rounds=1, warmup=0, size=(96, 160)).summary().splitlines()[4:7]
    assert [row.split(" | ")[3] for row in rows] == ["64x32", "128x64", "160x96"]


@pytest.mark.parametrize(
    ("size", "inputs"), [(None, ["96x64", "224x128", "64x32"]), ((96, 160), ["160x96"] * 2 + ["64x32"])]
)
@pytest.mark.parametrize("stage", ["network", "frame"])
def test_each_model_is_measured_at_the_size_it_was_trained_at_unless_another_is_asked_for(
    size: tuple[int, int] | None, inputs: list[str], stage: Literal["network", "frame"], monkeypatch: pytest.MonkeyPatch
) -> None:
    backends = {"a": ColourBackend(), "b": ColourBackend(), "fixed.onnx": ColourBackend((32, 64))}
    for backend, trained in zip(backends.values(), ((64, 96), (128, 224), (64, 96)), strict=True):
        backend.card = dataclasses.replace(backend.card, input_size=trained)
    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(backends[model]))
    source = (90, 160) if stage == "frame" else None
    result = benchmark(*backends, stage=stage, rounds=1, warmup=0, size=size, source=source)
    assert [f"{row.size[1]}x{row.size[0]}" for row in result.timings] == inputs


def test_whole_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    backend, seen = ColourBackend(canvas=(64, 128)), []
    plain = Predictor.perceive

    def perceive(self: Predictor, images: list[NDArray[np.uint8]]) -> object:
        seen.append([image.shape for image in images])
        return plain(self, images)

    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(backend))
    monkeypatch.setattr(Predictor, "perceive", perceive)
    (row,) = benchmark("a", stage="frame", batch=(10,), rounds=2, warmup=0, source=(90, 160)).timings
    assert (row.stage, row.size) == ("frame", (64, 128))
    assert seen == [[(90, 160, 3)] * 10] * 3
    assert backend.batches == [(10, 64, 128, 3)] * 3  # in one batch


def test_cost_table() -> None:
    result = benchmark(table="cost", size=(64, 128))
    assert [cost.parameters for cost in result.costs] == [151_413, 592_338, 2_350_206]
    assert "| tiny | 0.151 | 0.022 | 128x64 |" in result.summary()
    assert {cost.size for cost in benchmark(table="cost").costs} == {(384, 640)}


def test_cost_of_own_weights(tmp_path: Path) -> None:
    network = build_network("tiny", 10, ("detection", "lane"))
    card = dataclasses.replace(network.card, input_size=(64, 128))
    save_network(network, tmp_path / "own.safetensors", card)
    own, base = benchmark(tmp_path / "own.safetensors", "base", table="cost").costs
    assert (own.model, own.variant, own.classes, own.tasks) == ("own.safetensors", "tiny", 10, ("detection", "lane"))
    assert (own.parameters, own.size) == (count_parameters(network), (64, 128))
    assert own.multiply_adds == count_multiply_adds(network, (64, 128))
    assert (base.model, base.parameters, base.size) == ("base", 2_350_206, (384, 640))
    with pytest.raises(ConfigError, match=r"^a\.xml: is an exported file; --table cost counts weights"):
        benchmark("base", "a.xml", table="cost")


def test_the_cost_table_is_the_papers_once_it_is_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(ColourBackend()))
    result = benchmark(table="cost", size=(32, 64), rounds=1, warmup=0)
    assert [(row.model, row.batch) for row in result.timings] == [
        (model, batch) for model in ("tiny", "small", "base") for batch in (1, 8, 32)
    ]
    speeds = [f"{row.frames_per_second:.1f}" for row in result.timings]
    lines = result.summary().splitlines()
    assert lines[2] == (
        "| model | runtime | frames/s at batch 1 | frames/s at batch 8 | frames/s at batch 32 | parameters, M "
        "| multiply-adds, G | input |"
    )
    assert lines[4].startswith(f"| tiny | fake | {speeds[0]} | {speeds[1]} | {speeds[2]} | 0.151 | ")
    assert lines[6].startswith(f"| base | fake | {speeds[6]} | {speeds[7]} | {speeds[8]} | 2.350 | ")
    with pytest.raises(ConfigError, match="name files of weights, or leave --batch out"):
        benchmark(table="cost", batch=(1,), network="blocks.py:excited")


def test_numbers_must_be_positive() -> None:
    with pytest.raises(ConfigError, match="at least 1"):
        benchmark(rounds=0)


@pytest.mark.parametrize("size", [(0, 0), (-32, 64), (100, 128)])
@pytest.mark.parametrize("table", ["latency", "cost"])
def test_a_size_that_the_network_cannot_take_is_refused(
    size: tuple[int, int], table: Literal["latency", "cost"]
) -> None:
    with pytest.raises(ConfigError, match=f"--size must be multiples of 32, got {size[0]}x{size[1]}"):
        benchmark(size=size, table=table)


@pytest.mark.parametrize("options", [{"threads": 0}, {"threads": -1}, {"streams": 0}])
def test_no_threads_or_streams_are_refused(options: dict[str, int]) -> None:
    ((name, count),) = options.items()
    with pytest.raises(ConfigError, match=f"^{name} must be at least 1, got {count}$"):
        benchmark(threads=options.get("threads"), streams=options.get("streams", 1))


def test_nothing_to_measure_and_a_place_that_cannot_be_written_are_told_before(tmp_path: Path) -> None:
    for nothing in ({"batch": ()}, {"backend": ()}):
        with pytest.raises(ConfigError, match="nothing to measure"):
            benchmark(**nothing)  # type: ignore[arg-type]
    (tmp_path / "file").touch()
    place = tmp_path / "file" / "a.png"
    for output, plot in ((place, None), (None, place)):
        with pytest.raises(OutputError, match="file is no folder"):
            benchmark("no such model", output=output, plot=plot)


def test_what_would_be_ignored_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^--plot would change nothing: .*; add --batch 1 8 32 for frames a second$"):
        benchmark(table="cost", plot=tmp_path / "a.png")
    with pytest.raises(ConfigError, match=r"^--stage and --warmup and --source and --device and --threads would chan"):
        benchmark("base", table="cost", stage="frame", warmup=1, source=(90, 160), device="cpu", threads=1)
    with pytest.raises(ConfigError, match=r"^--video and --streams would change nothing"):
        benchmark("base", table="cost", video=tmp_path / "a.mp4", streams=2)
    with pytest.raises(ConfigError, match=r"a\.mp4: --video is for --stage video"):
        benchmark(video=tmp_path / "a.mp4")
    with pytest.raises(ConfigError, match=r"a\.mp4: --video has a size of its own; leave --source out"):
        benchmark(video=tmp_path / "a.mp4", stage="video", source=(90, 160))
    with pytest.raises(ConfigError, match=r"^--source is for --stage frame and video; --size is that of the network's"):
        benchmark(source=(90, 160))
    for stage in ("frame", "video"):
        message = f"^--table cost tells the speed of the network alone; leave --stage {stage} out$"
        with pytest.raises(ConfigError, match=message):
            benchmark("tiny", table="cost", batch=(1,), stage=stage)
    with pytest.raises(ConfigError, match="--plot must end in"):
        benchmark(plot=tmp_path / "a.xyz")
    with pytest.raises(ConfigError, match="--output and --plot are one file"):
        benchmark(output=tmp_path / "a.png", plot=tmp_path / "a.png")
    with pytest.raises(ConfigError, match="--source must be at least 1x1, got 0x100"):
        benchmark(stage="frame", source=(0, 100))


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of temporary files, and a film of four frames."""
    pytest.importorskip("av")
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    monkeypatch.setattr(command, "_RENDERED", 2)
    return tmp_path / "scratch"


def test_a_video_from_file_to_file(scratch: Path, watch: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
    backends = {"a": Taking(watch, [100] * 9), "b": Taking(watch, [20] * 9)}
    written = []

    def watched(predictor: Predictor, sources: list[Path], output: Path, **options: Any) -> Any:
        report = predict_with(predictor, sources, output, **options)
        written.append(sorted(path.name for path in output.iterdir()))
        return report

    monkeypatch.setattr(command, "predict_with", watched)
    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(backends[model]))
    result = benchmark("a", "b", stage="video", rounds=2, source=(90, 160), size=(64, 128), batch=(3,))
    assert written == [["clip.json", "clip.mp4"]] * 6  # once, and two rounds, of both
    assert backends["a"].batches == [(3, 96, 128, 3), (1, 96, 128, 3)] * 3
    assert list(scratch.iterdir()) == []
    first, second = result.timings
    assert (first.stage, first.batch, first.size) == ("video", 3, (96, 128))
    assert first.p50 == pytest.approx(200 / 4)  # two batches for four frames
    assert first.frames_per_second == pytest.approx(20)
    assert (first.ratio, second.ratio) == pytest.approx((1, 5))
    assert "| a | fake | video | 128x96 | 3 | 50.00 |" in result.summary()
    assert "ms: a frame of the video" in result.summary()


def test_the_energy_of_a_video_is_of_its_timed_rounds(
    scratch: Path, watch: Watch, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = Taking(watch, [700, 700, 100, 100, 300, 300])  # two batches each: the first result, and two rounds
    began = 50.0 + 1.4
    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(backend))
    monkeypatch.setattr(command, "energy_meters", lambda names: nullcontext([lambda: 10 * (watch.now - began)]))
    (row,) = benchmark("a", stage="video", rounds=2, source=(90, 160), size=(64, 128), batch=(3,)).timings
    assert backend.runs == 2 + 2 * 2  # none for the energy alone
    assert row.p50 == pytest.approx((200 + 600) / 2 / 4)
    assert row.joules == pytest.approx((2 + 6) / 2 / 4)
    assert (row.watts, row.watts_std) == pytest.approx((10, 0))


def test_a_clip_of_ones_own(scratch: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    backend = ColourBackend()
    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(backend))
    clip = tmp_path / "own.mp4"
    with VideoWriter(clip, 25.0) as writer:
        for _ in range(5):
            writer.write(np.zeros((72, 128, 3), np.uint8))
    (row,) = benchmark("a", stage="video", rounds=1, video=clip).timings
    assert backend.batches == [(4, 384, 640, 3), (1, 384, 640, 3)] * 2
    assert row.batch == 4
    Image.new("RGB", (64, 32)).save(tmp_path / "a.jpg")
    for name, what in (("a.jpg", "is no video"), ("none.mp4", "no such file")):
        with pytest.raises(InputError, match=f"{name}: {what}"):
            benchmark("a", stage="video", video=tmp_path / name)
    clip.write_bytes(clip.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"own\.mp4"):
        benchmark("a", stage="video", video=clip)


def test_ctrl_c_ends_it_and_leaves_nothing(scratch: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Interrupting(ColourBackend):
        def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
            if self.batches:
                raise KeyboardInterrupt
            return super().run(batch)

    backend = Interrupting()
    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(backend))
    with pytest.raises(KeyboardInterrupt):
        benchmark("a", stage="video", rounds=1, source=(90, 160), size=(64, 128), batch=(1,))
    assert list(scratch.iterdir()) == []
    assert backend.closed


def test_without_what_reads_videos_it_is_told_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingExtraError, match=r"trilitenet\[video\]"):
        benchmark("no such model", stage="video")


def test_whole_frames_take_the_size_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    plain = TorchBackend.run

    def run(self: TorchBackend, batch: NDArray[np.uint8]) -> RawOutputs:
        seen.append(batch.shape)
        return plain(self, batch)

    monkeypatch.setattr(TorchBackend, "run", run)
    result = benchmark("tiny", stage="frame", device="cpu", rounds=1, warmup=0, size=(64, 128), source=(72, 128))
    assert set(seen) == {(1, 96, 128, 3)}
    assert result.timings[0].size == (96, 128)


def test_a_ratio_above_1_is_faster_than_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    class Resting(ColourBackend):
        """A backend that takes so many seconds a batch."""

        def __init__(self, seconds: float) -> None:
            super().__init__()
            self.seconds = seconds

        def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
            time.sleep(self.seconds)
            return super().run(batch)

    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(Resting(float(model))))
    first, second = benchmark("0.1", "0.01", rounds=3, warmup=0, size=(32, 64)).timings
    assert first.ratio == 1
    assert second.ratio > 2


class Watch:
    """A clock that stands still but for what the backend below takes."""

    def __init__(self) -> None:
        self.now = 50.0

    def __call__(self) -> float:
        return self.now


class Taking(ColourBackend):
    """A backend that takes so many milliseconds, one time after the other."""

    def __init__(self, watch: Watch, milliseconds: list[int]) -> None:
        super().__init__()
        self.watch, self.milliseconds = watch, milliseconds
        self.runs = 0

    def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
        self.watch.now += self.milliseconds[self.runs] / 1e3
        self.runs += 1
        return super().run(batch)


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Watch:
    watch = Watch()
    monkeypatch.setattr("trilitenet.commands.benchmark.time.perf_counter", watch)
    return watch


def test_figures_by_hand(watch: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
    # The first, two to warm up, 100 to 200 ms, and the five seconds in which energy is measured.
    backend = Taking(watch, [700, 9000, 9000, *range(100, 201), *[150] * 35])
    power = iter([8, 9, 10, 11, 12])  # watts, of one second after the other
    joules = 0.0
    began: float | None = None

    def load(model: str, **_: object) -> Predictor:
        watch.now += 2.0
        return Predictor(backend)

    def meter() -> float:
        nonlocal joules, began
        joules, began = (joules, watch.now) if began is None else (joules + next(power) * (watch.now - began), None)
        return joules

    monkeypatch.setattr("trilitenet.commands.benchmark.load", load)
    monkeypatch.setattr(command, "energy_meters", lambda names: nullcontext([meter] * len(names)))
    result = benchmark("a", batch=(2,), rounds=101, warmup=2, size=(32, 64))
    (row,) = result.timings
    assert backend.runs == 1 + 2 + 101 + 5 * 7
    assert (row.p50, row.p90, row.p99) == pytest.approx((150, 190, 199))
    assert row.frames_per_second == pytest.approx(2 / 0.15)
    assert row.first_result == pytest.approx(2.7)
    assert row.joules == pytest.approx(10 * 0.15 / 2)
    assert row.watts == pytest.approx(10)
    assert (row.mean, row.std) == pytest.approx((150, np.sqrt(101 * 102 / 12)))
    assert row.watts_std == pytest.approx(np.sqrt(10 / 4))
    cells = "| a | fake | network | 64x32 | 2 | 150.00 | 190.00 | 199.00 | 150.00 ± 29.30 | 13.3 | 1.00 | 2.70 | - "
    assert result.summary().splitlines()[4] == cells + "| 0.75 | 10.00 ± 1.58 |"


def test_the_first_result_is_that_of_the_first_call(watch: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
    backend = Taking(watch, [700, 10, 10, 10])
    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(backend))
    rows = benchmark("a", batch=(2, 1), rounds=1, warmup=0, size=(32, 64)).timings
    assert [row.first_result for row in rows] == pytest.approx([0.7, 0.7])
    assert [row.ratio for row in rows] == pytest.approx([1.0, 0.5])  # of an image
    assert backend.batches == [(2, 32, 64, 3), (1, 32, 64, 3)] * 2


class Streaming(ColourBackend):
    """A backend that computes several images at once."""

    def __init__(self, streams: int) -> None:
        super().__init__()
        self.streams = streams


def test_what_is_asked_of_a_model_reaches_it(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def load(model: str, **options: object) -> Predictor:
        asked.append((model, options))
        return Predictor(Streaming(2 if options["backend"] == "openvino" else 1))

    monkeypatch.setattr("trilitenet.commands.benchmark.load", load)
    backends = ("onnxruntime", "openvino")
    result = benchmark(
        "a.onnx", backend=backends, device="cuda:1", streams=2, threads=3, rounds=1, warmup=0, size=(32, 64)
    )
    both = {"network": None, "device": "cuda:1", "streams": 2, "threads": 3}
    assert asked == [("a.onnx", {"backend": backend, **both}) for backend in backends]
    assert (result.machine["threads"], result.machine["streams"]) == ("3", "2")
    assert [row.threads for row in result.timings] == [3, 3]
    assert [row.streams for row in result.timings] == [1, 2]


def test_of_several_runtimes_each_file_runs_on_its_own(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked = []

    def load(model: str, *, backend: str, **_: object) -> Predictor:
        asked.append((model, backend))
        return Predictor(ColourBackend())

    monkeypatch.setattr("trilitenet.commands.benchmark.load", load)
    benchmark("a.xml", "a.onnx", backend=("openvino", "onnxruntime"), rounds=1, warmup=0, size=(32, 64))
    assert asked == [("a.xml", "openvino"), ("a.onnx", "openvino"), ("a.onnx", "onnxruntime")]
    assert caplog.messages == ["left out, since these files are for other runtimes: a.xml on onnxruntime"]
    with pytest.raises(ConfigError, match=r"^a\.pte runs on executorch, not on openvino or onnxruntime$"):
        benchmark("a.onnx", "a.pte", backend=("openvino", "onnxruntime"))
    with pytest.raises(ConfigError, match=r"^no model here runs on ncnn; make a file for it with trilitenet export"):
        benchmark("a.onnx", backend=("openvino", "ncnn"))


@pytest.mark.parametrize(
    ("runtime", "asked", "told"),
    [
        ("torch program cpu", None, 7),
        ("torch cpu graph", 3, 3),
        ("executorch cpu fp32", None, None),
        ("onnxruntime cpu fp32", 3, 3),
        ("torch cuda:1 graph", 3, None),
        ("torch program cuda", None, None),
        ("openvino gpu fp16", 3, None),
    ],
)
def test_threads_are_those_of_a_runtime_on_the_processor(
    runtime: str, asked: int | None, told: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Named(ColourBackend):
        name = runtime

    monkeypatch.setattr(torch, "get_num_threads", lambda: 7)
    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(Named()))
    (row,) = benchmark("a", threads=asked, rounds=1, warmup=0, size=(32, 64)).timings
    assert row.threads == told


def test_the_threads_of_pytorch_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    (row,) = benchmark("tiny", device="cpu", rounds=1, warmup=0, size=(64, 128)).timings
    assert row.threads == torch.get_num_threads()
    assert row.std is None


def test_the_gpu_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    class OnGpu(ColourBackend):
        name = "torch cuda:1 graph"

    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(OnGpu()))
    monkeypatch.setattr(command, "describe_hardware", lambda runtime: f"hardware of {runtime}")
    result = benchmark("a", rounds=1, warmup=0, size=(32, 64))
    assert result.machine["hardware"] == "hardware of torch cuda:1 graph"
    assert result.timings[0].threads is None


def test_each_model_has_its_own_energy_though_the_meter_moves_in_steps(
    watch: Watch, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn = [(0.0, 0.0)]  # (time, joules) of each call's end

    class Drawing(Taking):
        """A backend that draws so many watts for 2 ms a call."""

        def __init__(self, watts: float) -> None:
            super().__init__(watch, [2] * 4000)
            self.watts = watts

        def run(self, batch: NDArray[np.uint8]) -> RawOutputs:
            outputs = super().run(batch)
            drawn.append((watch.now, drawn[-1][1] + 0.002 * self.watts))
            return outputs

    def meter() -> float:  # moves every 20 ms
        shown = watch.now // 0.02 * 0.02
        return next(joules for time, joules in reversed(drawn) if time <= shown)

    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(Drawing(float(model))))
    monkeypatch.setattr(command, "energy_meters", lambda names: nullcontext([meter] * len(names)))
    rows = benchmark("100", "400", rounds=5, warmup=0, size=(32, 64)).timings
    assert [row.joules for row in rows] == pytest.approx([0.2, 0.8], rel=0.05)
    assert [row.watts for row in rows] == pytest.approx([100, 400], rel=0.05)


def test_models_of_one_file_name_are_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(ColourBackend()))
    models = ("a/final.safetensors", "b/final.safetensors", "c/other.onnx")
    result = benchmark(*models, rounds=1, warmup=0, size=(32, 64))
    assert [row.model for row in result.timings] == [*models[:2], "other.onnx"]
    cells = [line.split(" | ")[0] for line in result.summary().splitlines()[4:7]]
    assert cells == ["| a/final.safetensors", "| b/final.safetensors", "| other.onnx"]


def test_no_first_result_pays_for_importing_a_runtime(watch: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = []

    def load(model: str, **_: object) -> Predictor:
        if "ncnn" not in sys.modules:
            watch.now += 5.0
            monkeypatch.setitem(sys.modules, "ncnn", ModuleType("ncnn"))
        opened.append(Taking(watch, [700, 10]))
        return Predictor(opened[-1])

    monkeypatch.delitem(sys.modules, "ncnn", raising=False)
    monkeypatch.setattr("trilitenet.commands.benchmark.load", load)
    rows = benchmark("a", "b", rounds=1, warmup=0, size=(32, 64)).timings
    assert [row.first_result for row in rows] == pytest.approx([0.7, 0.7])
    assert [backend.runs for backend in opened] == [0, 2, 2]


def test_energy_is_told_only_where_it_was_read_before_and_after(watch: Watch, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(Taking(watch, [200] * 50)))
    for readings in ([1.0, 0.5], [1.0, None], [None, 1.0]):  # the counter began anew; it is gone; it was not there
        left = iter(readings * 5)
        monkeypatch.setattr(command, "energy_meters", lambda names, left=left: nullcontext([lambda: next(left)]))
        result = benchmark("a", rounds=2, warmup=0, size=(32, 64))
        assert (result.timings[0].joules, result.timings[0].watts) == (None, None)
        assert "| - | - |" in result.summary()
    left = iter([1.0, 3.0, 3.0, 0.0, 0.0, 2.0, 2.0, 4.0, 4.0, 6.0])  # it began anew once
    monkeypatch.setattr(command, "energy_meters", lambda names: nullcontext([lambda: next(left)]))
    (row,) = benchmark("a", rounds=2, warmup=0, size=(32, 64)).timings
    assert (row.joules, row.watts, row.watts_std) == pytest.approx((2 / 5, 2, 0))


def test_memory_is_told_in_bytes(artefacts: Artefacts, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    result = benchmark(str(artefacts.folder / "model.xml"), rounds=1, warmup=0, plot=tmp_path / "a.PNG")
    assert result.peak_memory is not None
    assert 2**26 < result.peak_memory < 2**40
    assert (tmp_path / "a.PNG").is_file()
    assert f"peak memory {result.peak_memory / 2**20:.0f} MiB in all" in result.summary()


def test_memory_is_left_out_where_the_system_does_not_tell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trilitenet.commands.benchmark.load", lambda model, **_: Predictor(ColourBackend()))
    monkeypatch.setattr(command, "peak_memory", lambda: float("nan"))
    result = benchmark("a", rounds=1, warmup=0, size=(32, 64))
    assert result.peak_memory is None
    assert "memory" not in result.summary()


def test_options_that_change_no_entry_are_refused(artefacts: Artefacts) -> None:
    file = str(artefacts.folder / "model.onnx")
    with pytest.raises(ConfigError, match=r"--size would change nothing: inputs are fixed to \d+x\d+; leave it out"):
        benchmark(file, backend="onnxruntime", rounds=1, warmup=0, size=(32, 64))
    with pytest.raises(ConfigError, match="--streams would change nothing: OpenVINO alone"):
        benchmark(file, backend="onnxruntime", rounds=1, warmup=0, streams=2)


@pytest.mark.parametrize(
    ("times", "scale", "rows"),
    [
        ([2.0, 14.0, 283.0], "log", ["median 2.00, p99 2.00", "median 14.00, p99 14.00", "median 283.00, p99 283.00"]),
        ([0.42, 4.83], "log", ["median 0.42, p99 0.42", "median 4.83, p99 4.83"]),
        ([9.0, 22.25], "linear", ["median 9.00, p99 9.00", "median 22.25, p99 22.25"]),
    ],
)
def test_a_plot_tells_its_numbers_and_is_logarithmic_over_decades(
    times: list[float], scale: str, rows: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    drawn: list[Figure] = []
    plain = Figure.savefig

    def savefig(figure: Figure, *args: Any, **options: Any) -> None:
        plain(figure, *args, **options)
        drawn.append(figure)

    monkeypatch.setattr(Figure, "savefig", savefig)
    entry = SimpleNamespace(model="tiny", runtime="a runtime")
    calls: Any = [SimpleNamespace(milliseconds=[one] * 3, batch=1, stage="network", entry=entry) for one in times]
    command._plot(calls, tmp_path / "a.png")
    (axes,) = drawn[0].axes
    (right,) = axes.child_axes
    assert axes.get_xscale() == scale
    assert [label.get_text() for label in right.get_yticklabels()] == rows
    numbers = [label.get_text() for label in axes.get_xticklabels(which="both")]
    assert not any("times" in number for number in numbers)  # as it is, not as a power of ten
