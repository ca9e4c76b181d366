"""Measure speed: models and runtimes in turn, so that a busy machine slows all of them alike."""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
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
from numpy.typing import NDArray

import trilitenet
from trilitenet.commands.energy import Meter, energy_meters
from trilitenet.commands.load import BACKENDS, check_parallel, load, own_builder
from trilitenet.commands.paths import NameOrPath, StrPath, check_writable, one_for_several, optional_path
from trilitenet.config import TASKS, VARIANTS, check_size
from trilitenet.engine.provenance import peak_memory
from trilitenet.errors import ConfigError, import_extra, write_file
from trilitenet.inference.predictor import Predictor
from trilitenet.processing.cores import processor, usable_cores

__all__ = ["Benchmark", "Cost", "Timing", "benchmark"]

_PLOTS: Final = (".png", ".svg", ".pdf")
_RUNTIMES: Final = frozenset(BACKENDS) - {"auto"}
_ENERGY_WINDOW: Final = 1.0
"""Seconds that each call is repeated for to measure its energy."""


@dataclasses.dataclass(frozen=True)
class Timing:
    """One model on one runtime at one batch size.

    Attributes:
        model: The name of its file; as it was named where several files have that.
        backend: The runtime, device and precision.
        stage: ``"network"`` (letterboxed pixels to raw outputs) or ``"frame"`` (image to boxes and masks of its size).
        batch: Images a call.
        size: (height, width) of the network's input in pixels.
        p50: Median milliseconds a call.
        p90: 90th percentile.
        p99: 99th percentile.
        frames_per_second: Images a second at the median.
        ratio: Median over the rounds of the first entry's time an image over this one's: above 1 is faster.
        first_result: Seconds from loading the model to its first result; its runtime had been imported before.
        joules: A frame, of the GPU where the runtime is on one, else of the processor package; of a Jetson, the whole
            module's. From a second in which nothing else was measured; None where it cannot be read.
        watts: Mean over that second; None likewise.
    """

    model: str
    backend: str
    stage: str
    batch: int
    size: tuple[int, int]
    p50: float
    p90: float
    p99: float
    frames_per_second: float
    ratio: float
    first_result: float
    joules: float | None = None
    watts: float | None = None


@dataclasses.dataclass(frozen=True)
class Cost:
    """What a variant costs (the counterpart of the paper's cost table).

    Attributes:
        variant: Its name, and that of the function that built it if it is one's own.
        parameters: Number of parameters.
        multiply_adds: Of convolutions and matrix products for one image of ``size``.
        size: (height, width) in pixels.
    """

    variant: str
    parameters: int
    multiply_adds: int
    size: tuple[int, int]


@dataclasses.dataclass(frozen=True)
class Benchmark:
    """The measurements, and what they were made on.

    Attributes:
        timings: A row an entry; the first is the baseline of the ratios.
        costs: Of the variants, with ``--table cost``.
        machine: Processor, threads, versions.
        rounds: Timed calls an entry.
        peak_memory: Bytes of the process at its largest, all entries together; None where unknown.
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
            lines += ["", "| variant | parameters, M | multiply-adds, G | input |", "|---|---|---|---|"]
            lines += [
                f"| {cost.variant} | {cost.parameters / 1e6:.3f} | {cost.multiply_adds / 1e9:.3f} "
                f"| {cost.size[1]}x{cost.size[0]} |"
                for cost in self.costs
            ]
        if self.timings:
            lines += [
                "",
                "| model | runtime | stage | input | batch | p50 ms | p90 | p99 | frames/s | ratio | first s | J/frame "
                "| W |",
                "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
            ]
            lines += [
                f"| {row.model} | {row.backend} | {row.stage} | {row.size[1]}x{row.size[0]} | {row.batch} "
                f"| {row.p50:.2f} | {row.p90:.2f} | {row.p99:.2f} | {row.frames_per_second:.1f} | {row.ratio:.2f} "
                f"| {row.first_result:.2f} | {_or_dash(row.joules)} | {_or_dash(row.watts)} |"
                for row in self.timings
            ]
            memory = "" if self.peak_memory is None else f", peak memory {self.peak_memory / 2**20:.0f} MiB in all"
            lines.append(f"{self.rounds} interleaved rounds{memory}; ratio: to the first row, above 1 is faster")
        return "\n".join(lines)


@one_for_several
def benchmark(
    *models: NameOrPath,
    backend: Sequence[str] = ("auto",),
    batch: Sequence[int] = (1,),
    stage: Literal["network", "frame"] = "network",
    table: Literal["latency", "cost"] = "latency",
    rounds: int = 50,
    warmup: int = 5,
    size: tuple[int, int] | None = None,
    source: tuple[int, int] = (720, 1280),
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
        backend: Runtimes to try each model on; those that do not run a file are an error.
        batch: Images a call.
        stage: network (letterboxed pixels to raw outputs) or frame (image to boxes and masks of its own size).
        table: latency, or cost: parameters and multiply-adds of the three variants (with --network of one's own beside
            them), nothing timed.
        rounds: Timed calls an entry; every round calls each entry once.
        warmup: Calls before.
        size: Height and width of the network's input, where a model takes any; by default what each was trained at, and
            384 640 for --table cost. --stage frame takes the longer side.
        source: Height and width of the image for --stage frame.
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
        ConfigError: If there is nothing to measure, a number is not positive, or the size is not of multiples of 32.
        OutputError: If a file cannot be written.
        MissingExtraError: If the extra ``evaluate`` is not installed, for a plot.
    """
    output, plot = optional_path(output), optional_path(plot)
    if not backend or not batch:
        raise ConfigError("nothing to measure: name at least one --backend and one --batch")
    if min(rounds, *batch) < 1 or warmup < 0:
        raise ConfigError("--rounds and --batch must be at least 1, --warmup not negative")
    check_parallel(streams=streams, threads=threads)
    if size is not None:
        check_size(size, "--size")
    if min(source) < 1:
        raise ConfigError(f"--source must be at least 1x1, got {source[0]}x{source[1]} (height x width)")
    if table == "cost" and (models or plot is not None):
        raise ConfigError("--table cost is of the three variants, and nothing is timed; leave models and --plot out")
    if plot is not None and plot.suffix.lower() not in _PLOTS:
        raise ConfigError(f"{plot}: --plot must end in {', '.join(_PLOTS)}")
    if output is not None and output == plot:
        raise ConfigError(f"{plot}: --output and --plot are one file; give two names")
    for file in (output, plot):
        if file is not None:
            check_writable(file)
    if plot is not None:
        import_extra("matplotlib", "evaluate")
    machine = _machine(threads, streams)
    with ExitStack() as stack:
        calls: list[_Call] = []
        if table == "cost":
            result = Benchmark((), _costs(size, network), machine, 0, None)
        else:
            for name, one in itertools.product([os.fspath(model) for model in models or ("tiny",)], backend):
                entry = _Entry(name, one, device, streams, threads, own_builder(name, network))
                stack.enter_context(entry.predictor)
                calls += [_Call(entry, count, stage, size, source) for count in batch]
            timings, memory = _measure(calls, rounds, warmup), peak_memory()
            bytes_held = None if math.isnan(memory) else round(memory * 2**20)
            result = Benchmark(timings, (), machine, rounds, bytes_held)
        if output is not None:
            write_file(output, json.dumps(result.to_dict(), indent=2) + "\n")
        if plot is not None and calls:
            _plot(calls, plot)
    return result


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


class _Call:
    """What is timed."""

    def __init__(
        self, entry: _Entry, batch: int, stage: str, size: tuple[int, int] | None, source: tuple[int, int]
    ) -> None:
        self.entry, self.batch, self.stage = entry, batch, stage
        generator = np.random.default_rng(0)
        self.milliseconds: list[float] = []
        self.joules: float | None = None
        self.watts: float | None = None
        predictor = entry.predictor
        size = size or predictor.card.input_size
        if stage == "network":
            self.size = predictor.backend.canvas or size
            images = generator.integers(0, 256, (batch, *self.size, 3), np.uint8)
            self.run: Callable[[], object] = lambda: predictor.backend.run(images)
        else:
            frames: list[NDArray[np.uint8]] = [generator.integers(0, 256, (*source, 3), np.uint8)] * batch
            whole = Predictor(predictor.backend, predictor.thresholds, long_side=max(size), batch_size=batch)
            self.size = whole.fit(frames[0]).canvas
            self.run = lambda: whole.perceive(frames)

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
            images += self.batch
        after, seconds = meter(), time.perf_counter() - started
        if before is not None and after is not None and after >= before:  # the counter begins anew now and then
            self.joules, self.watts = (after - before) / images, (after - before) / seconds


def _measure(calls: Sequence[_Call], rounds: int, warmup: int) -> tuple[Timing, ...]:
    for call in calls:
        call.once()
    for _ in range(warmup):
        for call in calls:
            call.run()
    for _ in range(rounds):
        for call in calls:
            started = time.perf_counter()
            call.run()
            call.milliseconds.append(1e3 * (time.perf_counter() - started))
    with energy_meters([call.entry.predictor.backend.name for call in calls]) as meters:
        for call, meter in zip(calls, meters, strict=True):
            call.draw(meter)
    names = _short([call.entry.model for call in calls])
    first = np.array(calls[0].milliseconds) / calls[0].batch
    timings = []
    for call in calls:
        times = np.array(call.milliseconds)
        p50, p90, p99 = (float(np.percentile(times, percent)) for percent in (50, 90, 99))
        timings.append(
            Timing(
                model=names[call.entry.model],
                backend=call.entry.predictor.backend.name,
                stage=call.stage,
                batch=call.batch,
                size=call.size,
                p50=p50,
                p90=p90,
                p99=p99,
                frames_per_second=1e3 * call.batch / p50,
                ratio=float(np.median(first / (times / call.batch))),
                first_result=call.entry.first or 0.0,
                joules=call.joules,
                watts=call.watts,
            )
        )
    return tuple(timings)


def _machine(threads: int | None, streams: int) -> dict[str, str]:
    name, instructions = processor()
    known = ("avx2", "avx512f", "avx512_bf16", "avx512_vnni", "amx_bf16", "amx_int8")
    flags = " ".join(flag for flag in known if flag in instructions)
    return {
        "processor": f"{name} ({flags})" if flags else name,
        "cores": str(usable_cores()),
        "threads": "the runtime's choice" if threads is None else str(threads),
        "streams": str(streams),
        "system": platform.platform(terse=True),
        "trilitenet": trilitenet.__version__,
    }


def _costs(size: tuple[int, int] | None, network: str | None) -> tuple[Cost, ...]:
    from trilitenet.models.builders import build_by
    from trilitenet.models.cost import count_multiply_adds, count_parameters

    costs = []
    for variant, builder in itertools.product(VARIANTS, (None,) if network is None else (None, network)):
        built = build_by(builder, variant, 1, TASKS)
        name = variant if builder is None else f"{variant}, {builder}"
        canvas = size or built.card.input_size
        costs.append(Cost(name, count_parameters(built), count_multiply_adds(built, canvas), canvas))
    return tuple(costs)


def _plot(calls: Sequence[_Call], path: Path) -> None:
    from matplotlib.figure import Figure

    names = _short([call.entry.model for call in calls])
    figure = Figure(figsize=(8, 1 + 0.6 * len(calls)), layout="constrained")
    axes = figure.subplots()
    axes.boxplot([call.milliseconds for call in calls], orientation="horizontal", whis=(1, 99), showfliers=False)
    axes.set_yticks(
        range(1, len(calls) + 1),
        [f"{names[call.entry.model]}\n{call.entry.predictor.backend.name}, batch {call.batch}" for call in calls],
    )
    axes.invert_yaxis()
    axes.set_xlabel("milliseconds a call (box: quartiles, whiskers: 1st and 99th percentile)")
    axes.set_xlim(left=0)
    picture = io.BytesIO()
    figure.savefig(picture, format=path.suffix[1:].lower())
    write_file(path, picture.getvalue())


def _short(models: Sequence[str]) -> dict[str, str]:
    """Return what to call each model: the name of its file, where no other has it."""
    count = Counter(Path(model).name for model in set(models))
    return {model: Path(model).name if count[Path(model).name] == 1 else model for model in models}


def _or_dash(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
