"""Gradients in bf16 against fp32: the whole network, real frames, both memory layouts.

    python benchmarks/gradients.py --data DATA --batch 16 --variants tiny small base

For initial and for shipped weights, prints the norm of the difference to the gradient in fp32 (contiguous) over that
gradient's norm. fp32 in channels-last is there as the measure of what another order of summation alone does, and
``noise`` is fp32 with a relative noise of 2^-11 (TF32's rounding) on every convolution's output.
"""

from __future__ import annotations

import argparse
from typing import Any

import torch
from torch import Tensor, nn

from trilitenet.data.batches import Batch, collate
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.transforms import EvalTransform
from trilitenet.losses.detection import DetectionLoss
from trilitenet.losses.multitask import MultiTaskLoss
from trilitenet.models.trilitenet import TriLiteNet, build_network, normalise_images
from trilitenet.models.weights import load_network

WAYS: dict[str, tuple[torch.memory_format, bool, float]] = {
    "fp32": (torch.contiguous_format, False, 0),
    "fp32 channels-last": (torch.channels_last, False, 0),
    "bf16": (torch.contiguous_format, True, 0),
    "bf16 channels-last": (torch.channels_last, True, 0),
    "noise": (torch.channels_last, False, 2**-11),
}


def disturb(network: TriLiteNet, noise: float) -> None:
    """Multiply the output of every convolution by 1 + uniform noise, which gradients take no notice of."""
    generator = torch.Generator().manual_seed(0)

    def hook(module: nn.Module, inputs: Any, out: Tensor) -> Tensor:
        return out + out.detach() * torch.empty_like(out).uniform_(-noise, noise, generator=generator)

    for module in network.modules():
        if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
            module.register_forward_hook(hook)


def gradient(
    variant: str, trained: bool, batch: Batch, layout: torch.memory_format, bf16: bool, noise: float
) -> Tensor:
    """Return the gradient of all parameters, one vector."""
    torch.manual_seed(0)
    network = load_network(variant) if trained else build_network(variant)
    network = network.float().to(memory_format=layout).train()  # type: ignore[call-overload]
    if noise:
        disturb(network, noise)
    loss = MultiTaskLoss(DetectionLoss(network.anchors, 1))
    with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        outputs = network(normalise_images(batch.images.contiguous(memory_format=layout)))
    loss(outputs, batch).total.backward()
    return torch.cat([p.grad.flatten() for p in network.parameters() if p.grad is not None])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True)
    parser.add_argument("--variants", nargs="+", default=["tiny", "small", "base"])
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--input-size", type=int, nargs=2, default=(384, 640))
    options = parser.parse_args()
    dataset, canvas = DrivingDataset(options.data, "train"), EvalTransform(tuple(options.input_size))
    if len(dataset) < options.batch:
        parser.error(f"{options.data}: {len(dataset)} frames are fewer than --batch {options.batch}")
    stride = len(dataset) // options.batch
    batch = collate([canvas(dataset[index * stride]) for index in range(options.batch)])
    for variant in options.variants:
        for trained in (False, True):
            gradients = {name: gradient(variant, trained, batch, *way) for name, way in WAYS.items()}
            first = gradients["fp32"]
            errors = {name: ((other - first).norm() / first.norm()).item() for name, other in gradients.items()}
            finite = all(bool(torch.isfinite(each).all()) for each in gradients.values())
            cells = "  ".join(f"{name} {100 * error:.2f}%" for name, error in errors.items() if name != "fp32")
            print(f"{variant:6}{'shipped' if trained else 'initial':8} finite {finite}  {cells}", flush=True)


if __name__ == "__main__":
    main()
