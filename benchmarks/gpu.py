"""fp16 on a CUDA device: the deploy graph under CUDA graphs against plain eager AMP, interleaved, with joules by NVML.

    python benchmarks/gpu.py --variant tiny small base --batch 1 8 32

Prepared for a machine with a GPU; its figures have not been measured (docs/speed.md says so). Without CUDA it says
that in one line and exits 1.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
import torch

from trilitenet.deploy.graph import DeployGraph
from trilitenet.deploy.layouts import LAYOUTS
from trilitenet.models.trilitenet import TriLiteNet, build_network, normalise_images


def eager_amp(network: TriLiteNet, batch: int) -> Callable[[], object]:
    images = torch.randint(0, 256, (batch, 3, 384, 640), dtype=torch.uint8, device="cuda")

    def call() -> None:
        with torch.inference_mode(), torch.autocast("cuda", torch.float16):
            outputs = network(normalise_images(images))
            network.decode(outputs)
            for logits in (outputs.drivable, outputs.lane):
                logits.argmax(1)

    return call


def deploy_graphed(network: TriLiteNet, batch: int, layout: str) -> Callable[[], object]:
    """Return the deploy graph in fp16, captured once and replayed: no launch is paid for twice.

    Decoding stays in fp32: sides of boxes do not survive ten bits.
    """
    graph = DeployGraph(network, LAYOUTS[layout]).cuda().eval()
    images = torch.randint(0, 256, (batch, 384, 640, 3), dtype=torch.uint8, device="cuda")
    side = torch.cuda.Stream()
    with torch.inference_mode(), torch.autocast("cuda", torch.float16):
        with torch.cuda.stream(side):
            for _ in range(5):
                graph(images)
        torch.cuda.current_stream().wait_stream(side)
        captured = torch.cuda.CUDAGraph()
        with torch.cuda.graph(captured):
            graph(images)
    return captured.replay


def energy() -> Callable[[], float] | None:
    try:
        import pynvml
    except ImportError:
        return None
    pynvml.nvmlInit()
    device = pynvml.nvmlDeviceGetHandleByIndex(0)
    return lambda: pynvml.nvmlDeviceGetTotalEnergyConsumption(device) / 1e3


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
    parser.add_argument("--layout", default="planar", choices=list(LAYOUTS))
    parser.add_argument("--rounds", type=int, default=20)
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        print("error: no CUDA device here", file=sys.stderr)
        return 1
    joules = energy()
    print(torch.cuda.get_device_name())
    for variant in arguments.variant:
        torch.manual_seed(0)
        network = build_network(variant).eval().cuda()
        for batch in arguments.batch:
            calls = {
                "plain eager AMP": eager_amp(network, batch),
                "deploy fp16, CUDA graph": deploy_graphed(build_network(variant).eval(), batch, arguments.layout),
            }
            for call in calls.values():
                timed(call, 5)
            times: dict[str, list[float]] = {name: [] for name in calls}
            spent: dict[str, list[float]] = {name: [] for name in calls}
            for _ in range(arguments.rounds):
                for name, call in calls.items():
                    before = joules() if joules else 0.0
                    times[name].append(timed(call, 20))
                    spent[name].append(((joules() - before) if joules else float("nan")) / 20 / batch)
            plain = np.array(times["plain eager AMP"])
            for name, values in times.items():
                seconds = statistics.median(values)
                print(
                    f"{variant} batch {batch} {name}: {batch / seconds:.0f} frames/s, "
                    f"{statistics.median(spent[name]):.4f} J/frame, "
                    f"{statistics.median(spent[name]) * batch / seconds:.0f} W, "
                    f"ratio {np.median(plain / np.array(values)):.2f}"
                )
    return 0


if __name__ == "__main__":
    sys.exit(main())
