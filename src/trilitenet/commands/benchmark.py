"""Measure speed: models and runtimes in turn, so that a busy machine slows all of them alike."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
import logging
import math
import os
import platform
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

import trilitenet
from trilitenet.commands.energy import Meter, energy_meters
from trilitenet.commands.load import BACKENDS, check_parallel, is_exported, load, own_builder, runtimes_of
from trilitenet.commands.paths import NameOrPath, StrPath, check_writable, one_for_several, optional_path
from trilitenet.commands.predict import predict_with
from trilitenet.commands.tables import markdown_row
from trilitenet.config import TASKS, VARIANTS, check_size
from trilitenet.data.synthetic_drive import SyntheticDrive
from trilitenet.engine.provenance import describe_hardware, peak_memory
from trilitenet.errors import ConfigError, InputError, import_extra, scratch_folder, write_file
from trilitenet.inference.backend import streams_of
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.sources import Clip, FrameReader, find_sources
from trilitenet.inference.video import VideoWriter
from trilitenet.processing.cores import processor

__all__ = ["Benchmark", "Cost", "Timing", "benchmark"]

_LOGGER: Final = logging.getLogger(__name__)
_PLOTS: Final = (".png", ".svg", ".pdf")
_APART: Final = 10.0
"""Where one median is more times another than this, the axis of a plot is logarithmic."""
_RUNTIMES: Final = frozenset(BACKENDS) - {"auto"}
_ENERGY_WINDOW: Final = 1.0
"""Seconds that each call is repeated for to measure its energy."""
_ENERGY_WINDOWS: Final = 5
"""Such windows an entry, in turns; the paper's watts are of five runs as well. Of a video, each timed round is one."""
_PAPER_BATCHES: Final = (1, 8, 32)
"""Batch sizes of the paper's cost table."""
_RENDERED: Final = 30
"""Frames of the clip that is made for ``--stage video``, which shows them forth and back."""
_RATE: Final = 30.0
"""Frames a second of that clip."""


@dataclasses.dataclass(frozen=True)
class Timing:
    """One model on one runtime at one batch size.

    Attributes:
        model: The name of its file; as it was named where several files have that.
        backend: The runtime, device and precision.
        stage: ``"network"`` (letterboxed pixels to raw outputs), ``"frame"`` (image to boxes and masks of its size) or
            ``"video"`` (file to overlay and JSON).
        batch: Images a call; of a video, images that go through the network at once.
        size: (height, width) of the network's input in pixels.
        p50: Median milliseconds a call; of a video, a frame: the time of the whole by the number of its frames.
        p90: 90th percentile.
        p99: 99th percentile.
        mean: Mean.
        std: Standard deviation over the rounds; None of a single one.
        frames_per_second: Images a second at the median.
        ratio: Median over the rounds of the first entry's time an image over this one's: above 1 is faster.
        first_result: Seconds from loading the model to its first result, of a video to its end; its runtime had been
            imported before.
        threads: Of a runtime on the CPU, as asked for, or as PyTorch tells; None where that is not known.
        streams: Images it computes at once, which ``backend`` tells as well; 1 where a runtime has none.
        joules: A frame, of the GPU where the runtime is on one, else of all processor packages; of a Jetson, the whole
            module's. From five seconds in which nothing else was measured, of a video from the rounds; None where it
            cannot be read.
        watts: Mean over these seconds or rounds; None likewise.
        watts_std: Standard deviation of the means of each; None likewise, and of a single one.
    """

    model: str
    backend: str
    stage: str
    batch: int
    size: tuple[int, int]
    p50: float
    p90: float
    p99: float
    mean: float
    std: float | None
    frames_per_second: float
    ratio: float
    first_result: float
    threads: int | None = None
    streams: int = 1
    joules: float | None = None
    watts: float | None = None
    watts_std: float | None = None


@dataclasses.dataclass(frozen=True)
class Cost:
    """What a network costs (the counterpart of the paper's cost table, whose frames a second are in the timings).

    Attributes:
        model: The name of its file, as in the timings; of a variant its name, and that of the function that built it if
            it is one's own.
        variant: Its size.
        classes: Number of detection classes.
        tasks: What it does.
        parameters: Number of parameters.
        multiply_adds: Of convolutions and matrix products for one image of ``size``.
        size: (height, width) in pixels.
    """

    model: str
    variant: str
    classes: int
    tasks: tuple[str, ...]
    parameters: int
    multiply_adds: int
    size: tuple[int, int]


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """The measurements, and what they were made on.

    Attributes:
        timings: A row an entry; the first is the baseline of the ratios.
        costs: A row a model, with ``--table cost``.
        machine: Hardware, threads, versions.
        rounds: Timed calls an entry.
        peak_memory: Bytes of the process at its largest, all entries together, without a GPU's; None where unknown.
    """

    timings: tuple[Timing, ...]
    costs: tuple[Cost, ...]
    machine: dict[str, str]
    rounds: int
    peak_memory: int | None

    def to_dict(self) -> dict[str, Any]:
        """Return what ``json.dumps`` takes."""
        return dataclasses.asdict(self)

    def summary(self) -> str:
        """Return the tables that the command line prints."""
        lines = [", ".join(f"{key} {value}" for key, value in self.machine.items())]
        if self.costs:
            lines += ["", *self._cost_table()]
        if self.timings:
            lines += [
                "",
                "| model | runtime | stage | input | batch | p50 ms | p90 | p99 | mean ± std | frames/s | ratio "
                "| first s | threads | J/frame | W ± std |",
                "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
            ]
            lines += [
                f"| {row.model} | {row.backend} | {row.stage} | {row.size[1]}x{row.size[0]} | {row.batch} "
                f"| {row.p50:.2f} | {row.p90:.2f} | {row.p99:.2f} | {_spread(row.mean, row.std)} "
                f"| {row.frames_per_second:.1f} | {row.ratio:.2f} | {row.first_result:.2f} "
                f"| {'-' if row.threads is None else row.threads} | {_spread(row.joules)} "
                f"| {_spread(row.watts, row.watts_std)} |"
                for row in self.timings
            ]
            memory = ""
            if self.peak_memory is not None:
                memory = f", peak memory {self.peak_memory / 2**20:.0f} MiB in all (of the process, without a GPU's)"
            unit = "; ms: a frame of the video" if self.timings[0].stage == "video" else ""
            lines.append(f"{self.rounds} interleaved rounds{memory}{unit}; ratio: to the first row, above 1 is faster")
        return "\n".join(lines)

    def _cost_table(self) -> list[str]:
        """Return the paper's cost table: frames a second at each batch size, where they were timed, and the cost."""
        speeds = {(row.model, row.backend, row.batch): f"{row.frames_per_second:.1f}" for row in self.timings}
        batches = list(dict.fromkeys(row.batch for row in self.timings))
        timed = ["runtime", *(f"frames/s at batch {batch}" for batch in batches)] if batches else []
        heads = ["model", *timed, "parameters, M", "multiply-adds, G", "input"]
        lines = [markdown_row(heads), "|" + "---|" * len(heads)]
        for cost in self.costs:
            height, width = cost.size
            own = [f"{cost.parameters / 1e6:.3f}", f"{cost.multiply_adds / 1e9:.3f}", f"{width}x{height}"]
            runtimes = dict.fromkeys(row.backend for row in self.timings if row.model == cost.model)
            rows = [[one, *(speeds[cost.model, one, batch] for batch in batches)] for one in runtimes]
            lines += [markdown_row([cost.model, *row, *own]) for row in rows or [[]]]
        return lines


@one_for_several
def benchmark(
    *models: NameOrPath,
    backend: Sequence[str] | None = None,
    batch: Sequence[int] | None = None,
    stage: Literal["network", "frame", "video"] = "network",
    table: Literal["latency", "cost"] = "latency",
    rounds: int | None = None,
    warmup: int | None = None,
    size: tuple[int, int] | None = None,
    source: tuple[int, int] | None = None,
    video: StrPath | None = None,
    network: str | None = None,
    device: str = "auto",
    streams: int = 1,
    threads: int | None = None,
    output: StrPath | None = None,
    plot: StrPath | None = None,
) -> Benchmark:
    """Measure latency, its tail, frames a second, first-result time and energy of models and runtimes, in turn.

    Args:
        models: Names of shipped weights (tiny if left out), weight files or artefacts; the first is the baseline.
        backend: Runtimes to try each model on, auto if left out. Of several, a file is left out on those that do not
            run it.
        batch: Images a call, 1 if left out; with --stage video, images that go through the network at once, 4 if left
            out.
        stage: network (letterboxed pixels to raw outputs), frame (image to boxes and masks of its own size) or video
            (from file to file as predict does it: decode, network, overlay, encode, JSON; times are of a frame).
        table: latency, or cost: parameters and multiply-adds of weights, the three variants if left out (with --network
            of one's own beside them); and frames a second with --batch (such as 1 8 32), --backend or --rounds.
        rounds: Timed calls an entry, 50 if left out and 5 of a video; every round calls each entry once.
        warmup: Calls before, 5 if left out and none of a video, whose first run is not timed anyway.
        size: Height and width of the network's input (384 640), where a model takes any; by default what each was
            trained at. --stage frame and video take the longer side.
        source: Height and width of the image for --stage frame, and of the synthetic clip for --stage video; 720 1280
            if left out.
        video: Clip for --stage video, all of which is done in each call; two synthetic seconds if left out.
        network: The function that built the network of those weight files that are of one of your own:
            FILE.py:FUNCTION or MODULE:FUNCTION.
        device: auto, cpu, cuda.
        streams: Images OpenVINO computes at once; use with --batch of as many or more.
        threads: Threads of every runtime; their own choice if left out.
        output: JSON file to write.
        plot: Picture (.png, .svg) of the distributions to write.

    Returns:
        The measurements.

    Raises:
        ConfigError: If there is nothing to measure, a number is not positive, the size is not of multiples of 32, or an
            option would change nothing.
        InputError: If the clip is missing, broken or no video.
        OutputError: If a file cannot be written.
        MissingExtraError: If the extra ``evaluate`` is not installed, for a plot, or ``video``, for videos.
    """
    output, plot, video = optional_path(output), optional_path(plot), optional_path(video)
    timed = table == "latency" or any(given is not None for given in (backend, batch, rounds))
    if not timed:
        _refuse_idle(
            stage=stage != "network",
            warmup=warmup is not None,
            source=source is not None,
            video=video is not None,
            device=device != "auto",
            streams=streams != 1,
            threads=threads is not None,
            plot=plot is not None,
        )
    elif table == "cost" and stage != "network":
        raise ConfigError(f"--table cost tells the speed of the network alone; leave --stage {stage} out")
    backend = ("auto",) if backend is None else backend
    if batch is None:
        batch = _PAPER_BATCHES if table == "cost" else (4,) if stage == "video" else (1,)
    if not backend or not batch:
        raise ConfigError("nothing to measure: name at least one --backend and one --batch")
    rounds = rounds if rounds is not None else 5 if stage == "video" else 50
    warmup = warmup if warmup is not None else 0 if stage == "video" else 5
    if min(rounds, *batch) < 1 or warmup < 0:
        raise ConfigError("--rounds and --batch must be at least 1, --warmup not negative")
    check_parallel(streams=streams, threads=threads)
    if size is not None:
        check_size(size, "--size")
    if video is not None and (stage != "video" or source is not None):
        what = "is for --stage video" if stage != "video" else "has a size of its own; leave --source out"
        raise ConfigError(f"{video}: --video {what}")
    if source is not None and stage == "network":
        raise ConfigError("--source is for --stage frame and video; --size is that of the network's input")
    source = source or (720, 1280)
    if min(source) < 1:
        raise ConfigError(f"--source must be at least 1x1, got {source[0]}x{source[1]} (height x width)")
    if plot is not None and plot.suffix.lower() not in _PLOTS:
        raise ConfigError(f"{plot}: --plot must end in {', '.join(_PLOTS)}")
    if output is not None and output == plot:
        raise ConfigError(f"{plot}: --output and --plot are one file; give two names")
    for file in (output, plot):
        if file is not None:
            check_writable(file)
    if plot is not None:
        import_extra("matplotlib", "evaluate")
    if stage == "video":
        import_extra("av", "video")
    names = [os.fspath(model) for model in models]
    if timed and table == "cost" and not names:
        if network is not None:
            raise ConfigError("only weights can be timed: with --network name files of weights, or leave --batch out")
        names = [*VARIANTS]
    costs = _costs(names, size, network) if table == "cost" else ()
    result = Benchmark((), costs, _machine(threads, streams, ()), 0, None)
    with ExitStack() as stack:
        calls: list[_Call] = []
        entries: list[_Entry] = []
        if timed:
            pairs = _fitting(names or ["tiny"], backend)
            film = None
            if stage == "video":
                film = _Film(video, source, stack.enter_context(scratch_folder()))
            for name, one in pairs:
                entry = _Entry(name, one, device, streams, threads, own_builder(name, network))
                stack.enter_context(entry.predictor)
                entries.append(entry)
            _refuse_without_effect(entries, size, streams)
            calls = [_Call(entry, count, stage, size, source, film) for entry in entries for count in batch]
            timings, memory = _measure(calls, rounds, warmup), peak_memory()
            machine = _machine(threads, streams, [call.entry.runtime for call in calls])
            bytes_held = None if math.isnan(memory) else round(memory * 2**20)
            result = Benchmark(timings, costs, machine, rounds, bytes_held)
        if output is not None:
            write_file(output, json.dumps(result.to_dict(), indent=2) + "\n")
        if plot is not None and calls:
            _plot(calls, plot)
    return result


def _refuse_idle(**options: bool) -> None:
    """Refuse options that were given to a cost table that times nothing.

    Raises:
        ConfigError: If there are any.
    """
    idle = [f"--{name}" for name, given in options.items() if given]
    if idle:
        raise ConfigError(
            f"{' and '.join(idle)} would change nothing: --table cost times nothing by itself; add --batch 1 8 32 for "
            "frames a second"
        )


def _refuse_without_effect(entries: Sequence[_Entry], size: tuple[int, int] | None, streams: int) -> None:
    """Refuse options that change none of the entries.

    Raises:
        ConfigError: If there are any.
    """
    canvases = {entry.predictor.backend.canvas for entry in entries}
    if size is not None and None not in canvases and canvases != {size}:
        inputs = " and ".join(f"{width}x{height}" for height, width in sorted(filter(None, canvases)))
        raise ConfigError(f"--size would change nothing: inputs are fixed to {inputs}; leave it out, or export anew")
    if streams > 1 and all(entry.streams == 1 for entry in entries):
        raise ConfigError(
            "--streams would change nothing: OpenVINO alone computes several images at once; leave it out"
        )


def _fitting(models: Sequence[str], backends: Sequence[str]) -> list[tuple[str, str]]:
    """Return each model with each backend; where several are named, without those that do not run its file.

    Raises:
        ConfigError: If a model or a backend would be left with none.
    """
    pairs = list(itertools.product(models, backends))
    if len(backends) == 1:
        return pairs
    fitting = [(model, one) for model, one in pairs if one not in _RUNTIMES or one in runtimes_of(model)]
    for model in models:
        if not any(model == other for other, _ in fitting):
            raise ConfigError(f"{model} runs on {' or '.join(runtimes_of(model))}, not on {' or '.join(backends)}")
    for one in backends:
        if not any(one == other for _, other in fitting):
            raise ConfigError(
                f"no model here runs on {one}; make a file for it with trilitenet export, or leave it out"
            )
    left = ", ".join(f"{model} on {one}" for model, one in pairs if (model, one) not in fitting)
    if left:
        _LOGGER.warning("left out, since these files are for other runtimes: %s", left)
    return fitting


class _Entry:
    """A model on a runtime, and how long it took to load."""

    def __init__(
        self, model: str, backend: str, device: str, streams: int, threads: int | None, network: str | None
    ) -> None:
        self.model = model
        imported = _RUNTIMES & sys.modules.keys()
        while True:
            started = time.perf_counter()
            self.predictor: Predictor = load(
                model, network=network, backend=backend, device=device, streams=streams, threads=threads
            )
            self.loading = time.perf_counter() - started
            if _RUNTIMES & sys.modules.keys() == imported:
                break
            imported = _RUNTIMES & sys.modules.keys()  # the first of a runtime would pay for all
            self.predictor.close()
        self.first: float | None = None
        words = self.runtime.split()
        self.threads = None if any(word.startswith(("cuda", "gpu", "npu")) for word in words) else threads
        if self.threads is None and words[0] == "torch" and "cpu" in words:
            self.threads = sys.modules["torch"].get_num_threads()
        self.streams = streams_of(self.predictor.backend) or 1

    @property
    def runtime(self) -> str:
        """The runtime, device and precision."""
        return self.predictor.backend.name


class _Film:
    """The clip that is done from file to file.

    Args:
        path: The clip; None to make one.
        size: (height, width) in pixels of the one that is made.
        scratch: Folder for it and for what is made of it.

    Attributes:
        first: Its first frame.

    Raises:
        InputError: If it is missing, broken or no video.
    """

    def __init__(self, path: Path | None, size: tuple[int, int], scratch: Path) -> None:
        self._results = scratch / "results"
        if path is None:
            path = scratch / "clip.mp4"
            drive = SyntheticDrive(frames=_RENDERED, fps=_RATE, size=size)
            frames = [drive[index].sample.image for index in range(_RENDERED)]
            with VideoWriter(path, _RATE) as writer:
                for frame in (*frames, *reversed(frames)):
                    writer.write(frame)
        if not path.is_file():
            raise InputError(f"{path}: no such file")
        self._path = path.absolute()
        found, failures = find_sources([self._path], Clip(max_frames=1))
        reader = next(iter(found), None)
        if not isinstance(reader, FrameReader):
            raise InputError(failures[0].reason if failures else f"{path}: is no video")
        self.first = next(iter(reader)).image

    def play(self, predictor: Predictor) -> int:
        """Do all of it as ``trilitenet predict`` does, and return the number of its frames.

        Raises:
            InputError: If it cannot be read to its end.
        """
        report = predict_with(predictor, [self._path], self._results, overwrite=True)
        if report.interrupted:
            raise KeyboardInterrupt
        if report.failures:
            raise InputError(report.errors[0])
        return report.frames


class _Call:
    """What is timed."""

    def __init__(
        self,
        entry: _Entry,
        batch: int,
        stage: str,
        size: tuple[int, int] | None,
        source: tuple[int, int],
        film: _Film | None,
    ) -> None:
        self.entry, self.batch, self.stage = entry, batch, stage
        generator = np.random.default_rng(0)
        self.milliseconds: list[float] = []
        self.joules: list[float] = []
        self.watts: list[float] = []
        self.images = batch  # a call
        self.unit = batch if film is None else 1  # images that a time is told of
        predictor = entry.predictor
        size = size or predictor.card.input_size
        if stage == "network":
            self.size = predictor.backend.canvas or size
            images = generator.integers(0, 256, (batch, *self.size, 3), np.uint8)
            self.run: Callable[[], object] = lambda: predictor.backend.run(images)
        else:
            frame = generator.integers(0, 256, (*source, 3), np.uint8) if film is None else film.first
            whole = Predictor(predictor.backend, predictor.thresholds, long_side=max(size), batch_size=batch)
            self.size = whole.fit(frame).canvas
            frames = [frame] * batch
            self.run = (lambda: whole.perceive(frames)) if film is None else (lambda: self._play(film, whole))

    def _play(self, film: _Film, predictor: Predictor) -> None:
        self.images = film.play(predictor)

    def time(self) -> None:
        """Run once and note the milliseconds."""
        started = time.perf_counter()
        self.run()
        self.milliseconds.append(1e3 * (time.perf_counter() - started) * self.unit / self.images)

    def once(self) -> None:
        """Run once and note how long the model took to its first result, loading and all."""
        started = time.perf_counter()
        self.run()
        if self.entry.first is None:
            self.entry.first = self.entry.loading + time.perf_counter() - started

    def draw(self, meter: Meter) -> None:
        """Note the joules an image and the watts of a second alone: meters move in steps of up to 0.1 seconds."""
        before, started, images = meter(), time.perf_counter(), 0
        while before is not None and time.perf_counter() - started < _ENERGY_WINDOW:
            self.run()
            images += self.images
        self._note_energy(meter, before, started, images)

    def time_and_draw(self, meter: Meter) -> None:
        """Run once and note the milliseconds, the joules an image and the watts."""
        before, started = meter(), time.perf_counter()
        self.time()
        self._note_energy(meter, before, started, self.images)

    def _note_energy(self, meter: Meter, before: float | None, started: float, images: int) -> None:
        after, seconds = meter(), time.perf_counter() - started
        if before is not None and after is not None and after >= before:  # the counter begins anew now and then
            self.joules.append((after - before) / images)
            self.watts.append((after - before) / seconds)


def _measure(calls: Sequence[_Call], rounds: int, warmup: int) -> tuple[Timing, ...]:
    for call in calls:
        call.once()
    for _ in range(warmup):
        for call in calls:
            call.run()
    filmed = calls[0].stage == "video"
    for _ in range(0 if filmed else rounds):
        for call in calls:
            call.time()
    with energy_meters([call.entry.runtime for call in calls]) as meters:
        for _ in range(rounds if filmed else _ENERGY_WINDOWS):
            for call, meter in zip(calls, meters, strict=True):
                if filmed:
                    call.time_and_draw(meter)
                else:
                    call.draw(meter)
    names = _short([call.entry.model for call in calls])
    first = np.array(calls[0].milliseconds) / calls[0].unit
    timings = []
    for call in calls:
        times = np.array(call.milliseconds)
        p50, p90, p99 = (float(np.percentile(times, percent)) for percent in (50, 90, 99))
        timings.append(
            Timing(
                model=names[call.entry.model],
                backend=call.entry.runtime,
                stage=call.stage,
                batch=call.batch,
                size=call.size,
                p50=p50,
                p90=p90,
                p99=p99,
                mean=float(times.mean()),
                std=_std(call.milliseconds),
                frames_per_second=1e3 * call.unit / p50,
                ratio=float(np.median(first / (times / call.unit))),
                first_result=call.entry.first or 0.0,
                threads=call.entry.threads,
                streams=call.entry.streams,
                joules=float(np.mean(call.joules)) if call.joules else None,
                watts=float(np.mean(call.watts)) if call.watts else None,
                watts_std=_std(call.watts),
            )
        )
    return tuple(timings)


def _std(values: Sequence[float]) -> float | None:
    """Return the standard deviation of a sample; None of fewer than two."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def _machine(threads: int | None, streams: int, runtimes: Sequence[str]) -> dict[str, str]:
    instructions = processor()[1]
    known = ("avx2", "avx512f", "avx512_bf16", "avx512_vnni", "amx_bf16", "amx_int8")
    flags = " ".join(flag for flag in known if flag in instructions)
    return {
        "hardware": describe_hardware(" ".join(runtimes)),
        **({"instructions": flags} if flags else {}),
        "threads": "the runtime's choice" if threads is None else str(threads),
        "streams": str(streams),
        "system": platform.platform(terse=True),
        "trilitenet": trilitenet.__version__,
    }


def _costs(names: Sequence[str], size: tuple[int, int] | None, network: str | None) -> tuple[Cost, ...]:
    """Return what weights cost; without names the variants, and beside them those that a function builds."""
    exported = next((name for name in names if is_exported(name)), None)
    if exported is not None:
        raise ConfigError(f"{exported}: is an exported file; --table cost counts weights: name those it was made from")
    from trilitenet.models.builders import build_by
    from trilitenet.models.cost import count_multiply_adds, count_parameters
    from trilitenet.models.weights import load_network

    short = _short(names)
    built = [(short[name], load_network(name, own_builder(name, network))) for name in short]
    for variant, builder in () if names else itertools.product(VARIANTS, dict.fromkeys((None, network))):
        name = variant if builder is None else f"{variant}, {builder}"
        built.append((name, build_by(builder, variant, 1, TASKS)))
    costs = []
    for name, one in built:
        card = one.card
        canvas = size or card.input_size
        parameters, multiply_adds = count_parameters(one), count_multiply_adds(one, canvas)
        costs.append(Cost(name, card.variant, card.classes, card.tasks, parameters, multiply_adds, canvas))
    return tuple(costs)


def _plot(calls: Sequence[_Call], path: Path) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    names = _short([call.entry.model for call in calls])
    figure = Figure(figsize=(8, 1 + 0.6 * len(calls)), layout="constrained")
    axes = figure.subplots()
    axes.boxplot([call.milliseconds for call in calls], orientation="horizontal", whis=(1, 99), showfliers=False)
    axes.set_yticks(
        range(1, len(calls) + 1),
        [f"{names[call.entry.model]}\n{call.entry.runtime}, batch {call.batch}" for call in calls],
    )
    axes.invert_yaxis()
    what = "frame of the video" if calls[0].stage == "video" else "call"
    axes.set_xlabel(f"milliseconds a {what} (box: quartiles, whiskers: 1st and 99th percentile)")
    medians = [float(np.median(call.milliseconds)) for call in calls]
    if max(medians) > _APART * min(medians):
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_xlim(left=0)
    rows = axes.secondary_yaxis("right")
    tails = (np.percentile(call.milliseconds, 99) for call in calls)
    rows.set_yticks(
        range(1, len(calls) + 1),
        [f"median {middle:.2f}, p99 {tail:.2f}" for middle, tail in zip(medians, tails, strict=True)],
    )
    picture = io.BytesIO()
    figure.savefig(picture, format=path.suffix[1:].lower())
    write_file(path, picture.getvalue())


def _short(models: Sequence[str]) -> dict[str, str]:
    """Return what to call each model: the name of its file, where no other has it."""
    count = Counter(Path(model).name for model in set(models))
    return {model: Path(model).name if count[Path(model).name] == 1 else model for model in models}


def _spread(mean: float | None, std: float | None = None) -> str:
    """Return a mean and how far values are from it, as far as they are known."""
    return "-" if mean is None else f"{mean:.2f}" + ("" if std is None else f" ± {std:.2f}")
