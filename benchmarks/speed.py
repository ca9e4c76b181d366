"""The deploy graph against the same network exported plainly, and against eager PyTorch, in one interleaved run.

    python benchmarks/speed.py --rounds 30
    python benchmarks/speed.py --weights tiny --threads 1 --cpu-time   # a busy machine: processor time, not wall time
    python benchmarks/speed.py --weights tiny --layout vectors-tiny vectors-small   # layouts in turn

'Plain' is the network as it is, traced to ONNX with float input and logits out: no decoding, no thresholds. 'Deploy'
takes pixels and gives decoded boxes and decided masks. OpenVINO computes in bf16 where the processor has it, else in
fp32 (it would emulate bf16 on AVX-512 without it). INT8 is calibrated on pictures of --calibration, else on eight
synthetic scenes. Weights are the shipped ones, or those that --weights names.
Random ones would slow both down: their PReLU slopes are all alike, which OpenVINO then does not fuse into convolutions.
Ratios are medians over the rounds of plain time / own time, and in calm of the times' 10th percentiles.
"""

from __future__ import annotations

import argparse
import functools
import json
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import openvino as ov
import torch

from trilitenet.commands.export import find_pictures
from trilitenet.config import ArtefactInfo, Thresholds
from trilitenet.data.synthetic import SyntheticScenes
from trilitenet.deploy.graph import DeployGraph
from trilitenet.deploy.layouts import LAYOUTS, pick_layout
from trilitenet.deploy.onnx import build_onnx
from trilitenet.deploy.openvino import build_openvino, save_openvino, vector_unit
from trilitenet.deploy.quantize import KEEP_STEPS, quantize_openvino
from trilitenet.inference.openvino_backend import OpenVINOBackend
from trilitenet.inference.predictor import Predictor
from trilitenet.models.trilitenet import TriLiteNet, normalise_images
from trilitenet.models.weights import load_network
from trilitenet.processing.images import read_image
from trilitenet.processing.letterbox import Letterbox
from trilitenet.processing.nms import nms

SIZE = (384, 640)
CORE = ov.Core()
OWN = "bf16" if "BF16" in CORE.get_property("CPU", "OPTIMIZATION_CAPABILITIES") else "fp32"
"""What OpenVINO computes in where it may choose: bf16 artefacts fall back so too."""
PLAIN, PLAIN_STREAMS = f"plain openvino {OWN}", f"plain openvino {OWN}, 8 frames on 2 streams"
HINTS = {"bf16": "bf16", "fp32": "f32"}


def plain_onnx(network: TriLiteNet) -> bytes:
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(network, (torch.zeros(1, 3, *SIZE),), dynamo=True, opset_version=18, verbose=False)
    assert program is not None
    return bytes(program.model_proto.SerializeToString())


def openvino_call(model: ov.Model, precision: str, threads: int | None, streams: int = 1) -> Callable[[], None]:
    options: dict[str, object] = {"INFERENCE_PRECISION_HINT": HINTS[precision], "NUM_STREAMS": str(streams)}
    options["PERFORMANCE_HINT"] = "LATENCY" if streams == 1 else "THROUGHPUT"
    if threads:
        options["INFERENCE_NUM_THREADS"] = threads
    compiled = CORE.compile_model(model, "CPU", options)
    source = compiled.inputs[0]
    pixels = np.random.default_rng(0).integers(0, 256, tuple(source.shape))
    value = pixels.astype(np.uint8 if source.element_type == ov.Type.u8 else np.float32)
    requests = [compiled.create_infer_request() for _ in range(streams)]

    def call() -> None:
        for _ in range(1 if streams == 1 else 4):
            for request in requests:
                request.wait()
                request.start_async([value], share_inputs=True)
        for request in requests:
            request.wait()

    return call


def onnxruntime_call(data: bytes, threads: int | None) -> Callable[[], None]:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    options.add_session_config_entry("session.force_spinning_stop", "1")  # else the next session's run is slowed down
    if threads:
        options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    source = session.get_inputs()[0]
    value = np.random.default_rng(0).integers(0, 256, source.shape)
    feed = {source.name: value.astype(np.uint8 if "uint8" in source.type else np.float32)}
    return lambda: session.run(None, feed)


def plain_frame(network: TriLiteNet, image: np.ndarray, argmax: bool) -> None:
    """Letterbox, eager network, interpolate, argmax (or a comparison), suppression: as published."""
    letterbox = Letterbox.fit(image.shape[:2])
    canvas = letterbox.image(image)
    with torch.inference_mode():
        outputs = network(normalise_images(torch.from_numpy(canvas).permute(2, 0, 1)[None].contiguous()))
        rows = network.decode(outputs)[0]
        for logits in (outputs.drivable, outputs.lane):
            inside = logits[:, :, letterbox.inside[0], letterbox.inside[1]]
            logits = torch.nn.functional.interpolate(inside, size=image.shape[:2], mode="bilinear")
            (logits.argmax(1) if argmax else logits[:, 1] > logits[:, 0]).numpy()
        kept = rows[rows[:, 4] > 0.25].numpy()
    xyxy = np.concatenate((kept[:, :2] - kept[:, 2:4] / 2, kept[:, :2] + kept[:, 2:4] / 2), 1)
    nms(xyxy, kept[:, 4] * kept[:, 5], np.zeros(len(rows), np.int64), 0.6, 300)


def calibration_frames(folder: Path | None) -> list[np.ndarray]:
    """Return what INT8 is calibrated on: at most 100 pictures of a folder or train split, or synthetic scenes."""
    if folder is None:
        scenes = SyntheticScenes(1, SIZE)
        return [scenes[index].image[None] for index in range(8)]
    images = (read_image(path) for path in find_pictures(folder, 100, "train"))
    return [Letterbox.fit(image.shape[:2], canvas=SIZE).image(image)[None] for image in images]


def measure(weights: str, arguments: argparse.Namespace, folder: Path) -> dict[str, dict[str, float]]:
    network = load_network(weights).eval()
    variant = network.card.variant
    plain = plain_onnx(network)
    plain_model = CORE.read_model(plain, b"")
    info = ArtefactInfo("openvino", "bf16", SIZE)
    names = list(dict.fromkeys(arguments.layout))
    endings = {name: "" if len(names) == 1 else f", {name}" for name in names}
    layouts = {name: pick_layout(name, variant, "openvino", unit=vector_unit()) for name in names}
    deploy = {
        name: build_openvino(build_onnx(DeployGraph(network, layout), network.card, info))
        for name, layout in layouts.items()
    }
    threads = arguments.threads
    if threads is not None:
        torch.set_num_threads(threads)
        cv2.setNumThreads(threads)
    image = SyntheticScenes(0, (720, 1280))[0].image if arguments.image is None else read_image(arguments.image)

    calls: dict[str, Callable[[], object]] = {}
    for precision in dict.fromkeys((OWN, "fp32")):
        calls[f"plain openvino {precision}"] = openvino_call(plain_model, precision, threads)
        for name, ending in endings.items():
            calls[f"deploy openvino {precision}{ending}"] = openvino_call(deploy[name], precision, threads)
    if arguments.int8:
        frames = calibration_frames(arguments.calibration)
        for name, ending in endings.items():
            quantised = quantize_openvino(deploy[name], frames, KEEP_STEPS[1])
            calls[f"deploy openvino int8 + {OWN}{ending}"] = openvino_call(quantised, OWN, threads)
    if arguments.eager:
        zeros = torch.zeros(1, 3, *SIZE)

        def eager() -> None:
            with torch.inference_mode():
                network(zeros)

        calls["plain eager fp32"] = eager
    if arguments.onnxruntime:
        layout = pick_layout("auto", variant, "onnxruntime")
        calls["plain onnxruntime fp32"] = onnxruntime_call(plain, threads)
        data = build_onnx(DeployGraph(network, layout), network.card, info).SerializeToString()
        calls["deploy onnxruntime fp32"] = onnxruntime_call(data, threads)
    if arguments.streams:
        calls[PLAIN_STREAMS] = openvino_call(plain_model, OWN, threads, 2)
        for name, ending in endings.items():
            entry = f"deploy openvino {OWN}, 8 frames on 2 streams{ending}"
            calls[entry] = openvino_call(deploy[name], OWN, threads, 2)
    if arguments.frame:
        calls["plain frame"] = lambda: plain_frame(network, image, argmax=True)
        calls["plain frame, comparing"] = lambda: plain_frame(network, image, argmax=False)
        doubled = ArtefactInfo("openvino", "bf16", SIZE, mask_scale=2)
        for index, name in enumerate(names):
            big = DeployGraph(network, layouts[name], mask_scale=2, thresholds=Thresholds())
            path = folder / f"{variant}-{index}.xml"
            save_openvino(build_openvino(build_onnx(big, network.card, doubled)), path, network.card, doubled)
            predictor = Predictor(OpenVINOBackend(path, threads=threads))
            calls[f"deploy frame{endings[name]}"] = functools.partial(predictor.perceive, [image])

    clock = time.process_time if arguments.cpu_time else time.perf_counter
    times: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
        call()
    for _ in range(arguments.rounds):
        for name, call in calls.items():
            started = clock()
            call()
            times[name].append(1e3 * (clock() - started))
    return {
        name: {
            "p10": float(np.percentile(values, 10)),
            "p50": float(np.median(values)),
            "p99": float(np.percentile(values, 99)),
            "ratio": float(np.median(np.array(times[plain_of(name)]) / np.array(values))),
            "calm": float(np.percentile(times[plain_of(name)], 10) / np.percentile(values, 10)),
        }
        for name, values in times.items()
    }


def plain_of(name: str) -> str:
    """Return what an entry is compared with."""
    if "onnxruntime" in name:
        return "plain onnxruntime fp32"
    if "streams" in name:
        return PLAIN_STREAMS
    return "plain frame" if "frame" in name else PLAIN


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--weights", nargs="+", default=["tiny", "small", "base"], help="names or files")
    parser.add_argument("--image", type=Path, help="of the whole frames; a synthetic 1280x720 one by default")
    parser.add_argument("--calibration", type=Path, help="pictures for INT8; synthetic scenes by default")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--threads", type=int)
    parser.add_argument(
        "--layout", nargs="+", default=["auto"], choices=["auto", *LAYOUTS], help="of OpenVINO's deploy graphs, in turn"
    )
    parser.add_argument("--cpu-time", action="store_true", help="processor time instead of wall time")
    for part in ("eager", "onnxruntime", "streams", "frame", "int8"):
        parser.add_argument(f"--no-{part}", dest=part, action="store_false")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for weights in arguments.weights:
            results[weights] = measure(weights, arguments, Path(folder))
            print(f"{weights}: milliseconds p10, p50, p99; plain / own, in calm")
            width = max(45, *map(len, results[weights]))
            for name, row in results[weights].items():
                times = " ".join(f"{row[key]:8.2f}" for key in ("p10", "p50", "p99"))
                print(f"  {name:{width}s} {times}  {row['ratio']:5.2f}  {row['calm']:5.2f}", flush=True)
    if arguments.output:
        arguments.output.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
