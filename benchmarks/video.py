"""How much of pure inference speed a whole video keeps: decode, inference, drawing, JSON and encoding together.

    python benchmarks/video.py VIDEO --model tiny --device cpu
    python benchmarks/video.py VIDEO --model tiny.xml --camera camera.yaml     # and the road in metres, with tracks
    python benchmarks/video.py VIDEO --long-side 320 --memory 10000     # resident memory over 10,000 frames, only

Runs of pure inference and of the pipeline take turns in one process, so that a busy machine slows both; the ratio is
the median over the rounds. Then each stage alone, in processor time a frame, tells what bounds the pipeline.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np

import trilitenet
from trilitenet.commands.predict import RoadOptions, predict_with
from trilitenet.engine.provenance import describe_hardware
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.sources import Clip, VideoReader
from trilitenet.inference.video import VideoWriter
from trilitenet.processing.drawing import draw
from trilitenet.processing.letterbox import Letterbox
from trilitenet.road.drawing import draw_road
from trilitenet.road.structures import Road
from trilitenet.structures import Perception, RawOutputs


def pure_inference(predictor: Predictor, batch: np.ndarray, frames: int) -> float:
    """Return frames a second of the backend alone, on images that are letterboxed already."""
    began = time.perf_counter()
    for _ in range(-(-frames // len(batch))):
        predictor.backend.run(batch)
    return -(-frames // len(batch)) * len(batch) / (time.perf_counter() - began)


def pipeline(predictor: Predictor, video: Path, frames: int, overlay: bool, road: RoadOptions) -> float:
    """Return frames a second from file to file."""
    with tempfile.TemporaryDirectory() as folder:
        report = predict_with(
            predictor, [video], Path(folder), clip=Clip(max_frames=frames), overlay=overlay, road=road
        )
    return report.frames / report.seconds


def stages(predictor: Predictor, video: Path, frames: int, options: RoadOptions) -> dict[str, float]:
    """Return each stage's processor time a frame in milliseconds, run alone."""
    taken: dict[str, float] = {}

    def measure(name: str, work: Callable[[], object]) -> None:
        began = time.process_time()
        work()
        taken[name] = (time.process_time() - began) / frames * 1e3

    images: list[np.ndarray] = []
    measure("decode", lambda: images.extend(f.image for f in VideoReader(video, Clip(max_frames=frames))))
    boxed: list[tuple[np.ndarray, Letterbox]] = []
    measure("letterbox", lambda: boxed.extend(predictor.preprocess(image) for image in images))
    raws: list[RawOutputs] = []
    size = predictor.batch_size
    batches = [np.stack([canvas for canvas, _ in boxed[i : i + size]]) for i in range(0, frames, size)]
    measure("inference", lambda: raws.extend(predictor.backend.run(batch) for batch in batches))
    perceptions: list[Perception] = []

    def post() -> None:
        for number, raw in enumerate(raws):
            part = slice(number * size, number * size + size)
            perceptions.extend(predictor.postprocess(raw, [letterbox for _, letterbox in boxed[part]], images[part]))

    measure("post-process", post)
    steady, monitor = options.open(still=False)
    roads: list[Road] = []
    if steady is not None:
        measure("track", lambda: perceptions.__setitem__(slice(None), [steady(one) for one in perceptions]))
    if monitor is not None:
        measure("road", lambda: roads.extend(monitor(perception) for perception in perceptions))
    canvases: list[np.ndarray] = []
    measure("draw", lambda: canvases.extend(draw(one, out=one.image) for one in perceptions))
    if roads:
        measure("draw road", lambda: [draw_road(*drawn) for drawn in zip(canvases, perceptions, roads, strict=True)])
    measure("JSON", lambda: [json.dumps(perception.to_dict()) for perception in perceptions])
    if roads:
        measure("JSON of road", lambda: [json.dumps(road.to_dict()) for road in roads])
    with tempfile.TemporaryDirectory() as folder:

        def encode() -> None:
            with VideoWriter(Path(folder) / "out.mp4", 25.0) as writer:
                for number, image in enumerate(canvases):
                    writer.write(image, number / 25)

        measure("encode", encode)
    return taken


def repeat(video: Path, target: Path, frames: int) -> None:
    """Write a video again and again into one file, without encoding it anew, until it has so many frames."""
    written, shift = 0, 0
    with av.open(str(target), "w") as out:
        stream = None
        while written < frames:
            with av.open(str(video)) as source:
                if stream is None:
                    stream = out.add_stream_from_template(source.streams.video[0])
                packets = [packet for packet in source.demux(video=0) if packet.pts is not None]
                for packet in packets:
                    packet.pts += shift
                    packet.dts = packet.dts + shift if packet.dts is not None else None
                    packet.stream = stream
                shift = max(packet.pts + (packet.duration or 1) for packet in packets)
                for packet in packets:
                    out.mux(packet)
                written += len(packets)


def resident() -> float:
    """Return the process's resident memory in MB (Linux)."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def memory(predictor: Predictor, video: Path, frames: int, overlay: bool, road: RoadOptions) -> None:
    """Print resident memory along a long run from file to file: every tenth of it, and at the end."""
    run, seen, told, marks = predictor.backend.run, 0, 0, []

    def counted(batch: np.ndarray) -> RawOutputs:
        nonlocal seen, told
        seen += len(batch)
        if seen * 10 // frames > told:
            told = seen * 10 // frames
            gc.collect()
            marks.append(resident())
            print(f"{seen:7d} frames: {marks[-1]:7.1f} MB resident", flush=True)
        return run(batch)

    predictor.backend.run = counted  # type: ignore[method-assign]
    with tempfile.TemporaryDirectory() as folder:
        long = Path(folder) / "long.mp4"
        repeat(video, long, frames)
        began = time.perf_counter()
        report = predict_with(
            predictor, [long], Path(folder) / "out", clip=Clip(max_frames=frames), overlay=overlay, road=road
        )
        size = sum(file.stat().st_size for file in (Path(folder) / "out").iterdir()) / 1e6
    taken = time.perf_counter() - began
    print(f"{report.frames} frames in {taken:.0f} s, {size:.0f} MB written; {resident():.1f} MB resident after")
    print(f"growth from the third tenth to the last: {marks[-1] - marks[2]:.1f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("video", type=Path)
    parser.add_argument("--model", default="tiny")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--batch-size", type=int, default=4)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--overlay", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--camera", type=Path, help="measure the road with this camera, and track vehicles")
    parser.add_argument("--long-side", type=int, help="of the network's input")
    parser.add_argument("--memory", type=int, metavar="FRAMES", help="only watch memory, over so many frames")
    options = parser.parse_args()
    road = RoadOptions() if options.camera is None else RoadOptions(measure=True, camera=options.camera, track=True)
    predictor = trilitenet.load(
        options.model,
        device=options.device,
        backend=options.backend,
        batch_size=options.batch_size,
        long_side=options.long_side,
    )
    if options.memory:
        memory(predictor, options.video, options.memory, options.overlay, road)
        return
    first = next(iter(VideoReader(options.video))).image
    batch = np.stack([predictor.preprocess(first)[0]] * options.batch_size)
    pure_inference(predictor, batch, 20)
    rounds = []
    for _ in range(options.rounds):
        alone = pure_inference(predictor, batch, options.frames)
        rounds.append((alone, pipeline(predictor, options.video, options.frames, options.overlay, road)))
    print(f"machine: {describe_hardware(predictor.backend.name)}; {predictor.backend.name}")
    for alone, whole in rounds:
        print(f"pure inference {alone:7.1f} frames/s   pipeline {whole:7.1f} frames/s   ratio {whole / alone:.2f}")
    print(f"median ratio {statistics.median(whole / alone for alone, whole in rounds):.2f}")
    print("processor time a frame, each stage alone:")
    for name, milliseconds in stages(predictor, options.video, min(100, options.frames), road).items():
        print(f"  {name:12s} {milliseconds:7.2f} ms")


if __name__ == "__main__":
    main()
