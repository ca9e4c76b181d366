"""Training throughput: this package's step against a plain eager fp32 step of the same network.

    python benchmarks/training.py --variants tiny small base --batch 16 --rounds 3

The ways take turns, each in a process of its own, so that a busy machine slows all alike; the ratio to the first is
what counts. The plain one is what an ordinary script does: PyTorch's own layers, contiguous, the system's allocator as
it is (`--allocator kept` gives it the setting that `trilitenet train` makes too). Images a second of wall time and of
processor time (all threads) are medians over the rounds.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from trilitenet.data.batches import Batch, collate
from trilitenet.data.synthetic import SyntheticScenes
from trilitenet.data.transforms import EvalTransform
from trilitenet.engine.ema import MovingAverage
from trilitenet.engine.optim import build_optimiser
from trilitenet.losses.detection import DetectionLoss
from trilitenet.losses.multitask import MultiTaskLoss
from trilitenet.models import activation
from trilitenet.models.trilitenet import build_network, normalise_images
from trilitenet.processing.memory import STEPS, keep_freed_memory

WAYS = {"plain fp32": (True, False), "fp32": (False, False), "bf16": (False, True)}
"""Way -> whether it is the plain one, and whether it computes in bf16."""


class PlainMaskLoss(torch.nn.Module):
    """Focal and Tversky loss of one mask, written operation by operation."""

    def __init__(self, alpha: float, beta: float) -> None:
        super().__init__()
        self.alpha, self.beta = alpha, beta

    def forward(self, logits: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        logits = logits.float()
        truth = torch.stack([(target == 0).float(), (target == 1).float()], 1)
        log_p = F.logsigmoid(logits * (2 * truth - 1))
        balance = 0.25 * truth + 0.75 * (1 - truth)
        focal = -(balance * (1 - log_p.exp()).pow(2) * log_p).sum() / target.numel()
        p = logits.softmax(1)
        hit = (p * truth).sum((0, 2, 3))
        wrong, missed = (p * (1 - truth)).sum((0, 2, 3)), ((1 - p) * truth).sum((0, 2, 3))
        return focal, (1 - hit / (hit + self.alpha * wrong + self.beta * missed)).mean() ** (4 / 3)


def make(variant: str, batch: Batch, *, plain: bool, bf16: bool, device: str) -> Callable[[], None]:
    torch.manual_seed(0)
    layout = torch.contiguous_format if plain else torch.channels_last
    network = build_network(variant).train().to(device, memory_format=layout)
    masks = (PlainMaskLoss(0.7, 0.3), PlainMaskLoss(0.9, 0.1)) if plain else (None, None)
    loss = MultiTaskLoss(DetectionLoss(network.anchors, 1), *masks).to(device)
    if plain:
        optimiser = torch.optim.AdamW(network.parameters(), 1e-3)
    else:
        optimiser = build_optimiser([network], lr=1e-3, betas=(0.937, 0.999), weight_decay=0.01)
    ema = MovingAverage(network)

    def step() -> None:
        images = normalise_images(batch.images.contiguous(memory_format=layout))
        with torch.autocast(device, dtype=torch.bfloat16, enabled=bf16):
            outputs = network(images)
        loss(outputs, batch).total.backward()
        optimiser.step()
        optimiser.zero_grad()
        ema.update(network)
        if device == "cuda":
            torch.cuda.synchronize()

    return step


def serve(pipe: Any, variant: str, way: str, options: argparse.Namespace) -> None:
    """Make one way's steps in a process of its own, one whenever asked; answer seconds of wall and of processor."""
    plain, bf16 = WAYS[way]
    if plain:  # PyTorch's own layers
        activation._by_rows = lambda x: False
    if options.device == "cpu" and not (plain and options.allocator == "default"):
        keep_freed_memory(STEPS)  # as `trilitenet train` does
    if options.threads:
        torch.set_num_threads(options.threads)
    scenes, canvas = SyntheticScenes(0), EvalTransform()
    batch = collate([canvas(scenes[index]) for index in range(options.batch)]).to(options.device)
    step = make(variant, batch, plain=plain, bf16=bf16, device=options.device)
    while pipe.recv():
        began, began_cpu = time.perf_counter(), time.process_time()
        step()
        pipe.send((time.perf_counter() - began, time.process_time() - began_cpu))


def measure(variant: str, options: argparse.Namespace) -> dict[str, list[tuple[float, float]]]:
    """Return for each way the seconds of wall and of processor of every round, after two to warm up."""
    context = multiprocessing.get_context("spawn")
    pipes, processes = {}, []
    for way in WAYS:
        pipes[way], far = context.Pipe()
        processes.append(context.Process(target=serve, args=(far, variant, way, options)))
        processes[-1].start()
        far.close()  # so that a process that fails is heard of
    times: dict[str, list[tuple[float, float]]] = {way: [] for way in WAYS}
    for round_number in range(options.rounds + 2):
        for way, pipe in pipes.items():
            pipe.send(True)
            took = pipe.recv()
            if round_number > 1:
                times[way].append(took)
    for pipe in pipes.values():
        pipe.send(False)
    for process in processes:
        process.join()
    return times


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--variants", nargs="+", default=["tiny"])
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--allocator", choices=("default", "kept"), default="default", help="of the plain way")
    options = parser.parse_args()
    for variant in options.variants:
        times = measure(variant, options)
        for way, rounds in times.items():
            seconds, busy = (statistics.median(column) for column in zip(*rounds, strict=True))
            ratios = [
                statistics.median(a / b for a, b in zip(plain, ours, strict=True))
                for plain, ours in zip(zip(*times["plain fp32"], strict=True), zip(*rounds, strict=True), strict=True)
            ]
            print(
                f"{variant:6} {way:11} {options.batch / seconds:6.2f} images/s (x{ratios[0]:.2f})"
                f"   {options.batch / busy:6.2f} images/processor-s (x{ratios[1]:.2f})",
                flush=True,
            )


if __name__ == "__main__":
    main()
