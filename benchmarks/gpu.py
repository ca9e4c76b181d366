"""fp16 on a CUDA device: the deploy graph under CUDA graphs against plain eager AMP, interleaved, with joules by NVML.

    python benchmarks/gpu.py --variant tiny small base --batch 1 8 32

Pixels lie on the device already; copies to and from it are not timed. Each way runs for a quarter of a second at a
time, so that the meter of the board's energy, which moves every few tens of milliseconds, can follow. Without CUDA it
says so in one line and exits 1.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import nn

from trilitenet.commands.energy import gpu_meter
from trilitenet.deploy.graph import DeployGraph
from trilitenet.deploy.layouts import LAYOUTS
from trilitenet.models.trilitenet import TriLiteNet, build_network, normalise_images

SIZE = (384, 640)


def eager_amp(network: TriLiteNet, batch: int) -> Callable[[], object]:
    images = torch.randint(0, 256, (batch, 3, *SIZE), dtype=torch.uint8, device="cuda")

    def call() -> None:
        with torch.inference_mode(), torch.autocast("cuda", torch.float16):
            outputs = network(normalise_images(images))
            network.decode(outputs)
            for logits in (outputs.drivable, outputs.lane):
                assert logits is not None
                logits.argmax(1)

    return call


def deploy_graphed(network: TriLiteNet, batch: int, layout: str) -> Callable[[], object]:
    """Return the deploy graph in fp16 (boxes decoded in fp32), captured once and replayed.

    Args:
        network: What to run.
        batch: Images a call.
        layout: A name of `LAYOUTS`; with ``:nhwc`` its convolutions' weights are channels-last.
    """
    name, _, memory = layout.partition(":")
    graph: nn.Module = DeployGraph(network, LAYOUTS[name]).reduced(torch.float16).cuda()
    if memory:
        graph = graph.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    images = torch.randint(0, 256, (batch, *SIZE, 3), dtype=torch.uint8, device="cuda")
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.inference_mode():
        with torch.cuda.stream(side):
            for _ in range(3):
                graph(images)
        torch.cuda.current_stream().wait_stream(side)
        captured = torch.cuda.CUDAGraph()
        with torch.cuda.graph(captured):
            graph(images)

    def replay(held: tuple[object, ...] = (graph, images)) -> None:  # the capture itself holds neither
        captured.replay()

    return replay


def timed(call: Callable[[], object], calls: int) -> float:
    torch.cuda.synchronize()
    started = time.perf_counter()
    for _ in range(calls):
        call()
    torch.cuda.synchronize()
    return (time.perf_counter() - started) / calls


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variant", nargs="+", default=["tiny", "small", "base"])
    parser.add_argument("--batch", nargs="+", type=int, default=[1, 8, 32])
    parser.add_argument("--layouts", nargs="+", default=["planar"], help="names of LAYOUTS, with or without :nhwc")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=0.25)
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        print("error: no CUDA device here", file=sys.stderr)
        return 1
    joules = gpu_meter(0)
    print(f"{torch.cuda.get_device_name()}, PyTorch {torch.__version__}, {SIZE[1]}x{SIZE[0]}", flush=True)
    print("| variant | batch | way | frames/s | ratio | J/frame | W |\n|---|---|---|---|---|---|---|")
    for variant in arguments.variant:
        torch.manual_seed(0)
        network = build_network(variant).eval().cuda()
        for batch in arguments.batch:
            calls = {"plain eager AMP": eager_amp(network, batch)}
            for layout in arguments.layouts:
                fresh = build_network(variant).eval()
                calls[f"deploy fp16, CUDA graph, {layout}"] = deploy_graphed(fresh, batch, layout)
            counts = {}
            for name, call in calls.items():
                timed(call, 3)
                counts[name] = max(1, round(arguments.seconds / timed(call, 5)))
            times: dict[str, list[float]] = {name: [] for name in calls}
            spent: dict[str, list[float]] = {name: [] for name in calls}
            for _ in range(arguments.rounds):
                for name, call in calls.items():
                    before = joules() if joules else float("nan")
                    times[name].append(timed(call, counts[name]))
                    after = joules() if joules else float("nan")
                    spent[name].append((after - before) / counts[name] / batch)
            plain = np.array(times["plain eager AMP"])
            for name, values in times.items():
                seconds, used = statistics.median(values), statistics.median(spent[name])
                print(
                    f"| {variant} | {batch} | {name} | {batch / seconds:.0f} "
                    f"| {float(np.median(plain / np.array(values))):.2f} | {used:.4f} | {used * batch / seconds:.0f} |",
                    flush=True,
                )
    return 0


if __name__ == "__main__":
    sys.exit(main())
