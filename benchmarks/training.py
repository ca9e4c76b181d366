"""Training throughput: this package's step against a plain eager fp32 step of the same network.

    python benchmarks/training.py --variants tiny small base --batch 4 --rounds 3

All ways take turns within one process, so that a busy machine slows all alike; the ratio to the first is what counts.
Images a second of wall time and of processor time (all threads) are medians over the rounds.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from trilitenet.data.batches import Batch, collate
from trilitenet.data.synthetic import SyntheticScenes
from trilitenet.data.transforms import EvalTransform
from trilitenet.engine.ema import MovingAverage
from trilitenet.engine.optim import build_optimiser
from trilitenet.engine.runtime import keep_freed_memory
from trilitenet.losses.detection import DetectionLoss
from trilitenet.losses.multitask import MultiTaskLoss
from trilitenet.models import activation
from trilitenet.models.trilitenet import build_network, normalise_images


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


@contextmanager
def plain_layers(on: bool) -> Any:
    """Let PReLU and batch normalisation run as PyTorch's own layers."""
    kept = activation._by_rows
    if on:
        activation._by_rows = lambda x: False
    try:
        yield
    finally:
        activation._by_rows = kept


def make(variant: str, batch: Batch, *, plain: bool, bf16: bool, device: str) -> Callable[[], None]:
    torch.manual_seed(0)
    layout = torch.contiguous_format if plain else torch.channels_last
    network = build_network(variant).train().to(device, memory_format=layout)
    masks = (PlainMaskLoss(0.7, 0.3), PlainMaskLoss(0.9, 0.1)) if plain else (None, None)
    loss = MultiTaskLoss(DetectionLoss(network.anchors, 1), *masks).to(device)
    if plain:
        optimiser = torch.optim.AdamW(network.parameters(), 1e-3, foreach=False)
    else:
        optimiser = build_optimiser([network], lr=1e-3, betas=(0.937, 0.999), weight_decay=0.01)
    ema = MovingAverage(network)

    def step() -> None:
        with plain_layers(plain):
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--variants", nargs="+", default=["tiny"])
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    if options.device == "cpu":
        keep_freed_memory()  # as `trilitenet train` does; the plain way gains as much
    if options.threads:
        torch.set_num_threads(options.threads)
    scenes, canvas = SyntheticScenes(0), EvalTransform()
    batch = collate([canvas(scenes[index]) for index in range(options.batch)]).to(options.device)
    ways = {"plain fp32": (True, False), "fp32": (False, False), "bf16": (False, True)}
    for variant in options.variants:
        steps = {
            name: make(variant, batch, plain=plain, bf16=bf16, device=options.device)
            for name, (plain, bf16) in ways.items()
        }
        wall: dict[str, list[float]] = {name: [] for name in ways}
        cpu: dict[str, list[float]] = {name: [] for name in ways}
        for round_number in range(options.rounds + 1):
            for name, step in steps.items():
                began, began_cpu = time.perf_counter(), time.process_time()
                step()
                if round_number:
                    wall[name].append(time.perf_counter() - began)
                    cpu[name].append(time.process_time() - began_cpu)
        for name in ways:
            seconds, busy = statistics.median(wall[name]), statistics.median(cpu[name])
            ratios = [
                statistics.median(a / b for a, b in zip(kind["plain fp32"], kind[name], strict=True))
                for kind in (wall, cpu)
            ]
            print(
                f"{variant:6} {name:11} {options.batch / seconds:6.2f} images/s (x{ratios[0]:.2f})"
                f"   {options.batch / busy:6.2f} images/processor-s (x{ratios[1]:.2f})",
                flush=True,
            )


if __name__ == "__main__":
    main()
