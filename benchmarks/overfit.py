"""Whether tiny learns a few synthetic frames by heart: the network, its losses and the predictor, end to end.

    python benchmarks/overfit.py --scenes 8 --size 384 640

Prints drivable IoU and lane IoU, each over all frames together, how many boxes are found at IoU 0.5, and whether they
hold: above 0.95, above 0.6, all of them. The frames are the first ones of the seed, in one batch, without augmentation.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np
import torch
from numpy.typing import NDArray

from trilitenet.data.batches import collate
from trilitenet.data.sample import Sample
from trilitenet.data.synthetic import SyntheticScenes
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.torch_backend import TorchBackend
from trilitenet.losses.detection import DetectionLoss
from trilitenet.losses.multitask import MultiTaskLoss
from trilitenet.losses.segmentation import SegmentationLoss
from trilitenet.models.trilitenet import TriLiteNet, build_network, normalise_images
from trilitenet.processing.boxes import box_iou
from trilitenet.processing.memory import STEPS, keep_freed_memory

DRIVABLE, LANE = 0.95, 0.6


def learn(samples: list[Sample], steps: int, rate: float, seed: int) -> TriLiteNet:
    """Return tiny trained on the frames as `tests/engine/test_overfit.py` does, telling how far it is."""
    torch.manual_seed(seed)
    torch.set_flush_denormal(True)
    network = build_network("tiny").train()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    loss = MultiTaskLoss(
        DetectionLoss(network.anchors, 1),
        SegmentationLoss(0.5, 0.5),
        SegmentationLoss(0.5, 0.5),
        weights=(1.0, 0.3, 0.6),
    )
    optimiser = torch.optim.AdamW(network.parameters(), lr=rate, betas=(0.9, 0.99), weight_decay=0)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=steps, pct_start=0.1)
    batch = collate(samples)
    images = normalise_images(batch.images.contiguous(memory_format=torch.channels_last))
    start = time.perf_counter()
    for step in range(1, steps + 1):
        optimiser.zero_grad()
        total = loss(network(images), batch).total
        total.backward()
        optimiser.step()
        schedule.step()
        if step % 20 == 0:
            print(f"step {step}: loss {total.item():.4f}, {time.perf_counter() - start:.0f} s", flush=True)
    return network.eval()


def pooled_iou(predicted: list[NDArray[np.bool_] | None], truth: list[NDArray[np.uint8] | None]) -> float:
    """Return the IoU of masks over all frames together."""
    hit = union = 0
    for seen, label in zip(predicted, truth, strict=True):
        assert seen is not None
        assert label is not None
        hit += int((seen & (label > 0)).sum())
        union += int((seen | (label > 0)).sum())
    return hit / union


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=8)
    parser.add_argument("--size", type=int, nargs=2, default=(384, 640), metavar=("HEIGHT", "WIDTH"))
    parser.add_argument("--steps", type=int, default=420)
    parser.add_argument("--rate", type=float, default=0.012, help="highest learning rate")
    parser.add_argument("--seed", type=int, default=0, help="of the scenes and of the initial weights")
    options = parser.parse_args()
    keep_freed_memory(STEPS)
    scenes = SyntheticScenes(options.seed, size=tuple(options.size))
    samples = [scenes[index] for index in range(options.scenes)]
    network = learn(samples, options.steps, options.rate, options.seed)
    seen = Predictor(TorchBackend(network, "cpu"), long_side=max(options.size))([sample.image for sample in samples])

    drivable = pooled_iou([each.drivable for each in seen], [sample.drivable for sample in samples])
    lane = pooled_iou([each.lane for each in seen], [sample.lane for sample in samples])
    boxes = found = 0
    for sample, each in zip(samples, seen, strict=True):
        assert sample.boxes is not None
        assert each.boxes is not None
        best = box_iou(sample.boxes, each.boxes.xyxy).max(1, initial=0)
        boxes, found = boxes + len(best), found + int((best > 0.5).sum())
        for box, overlap in zip(sample.boxes, best, strict=True):
            if overlap <= 0.5:
                print(f"missed: {sample.name}, a box of {box[2] - box[0]:.0f}x{box[3] - box[1]:.0f} pixels at {box}")
    holds = drivable > DRIVABLE and lane > LANE and found == boxes
    verdict = "holds" if holds else "missed"
    print(f"drivable IoU {drivable:.3f}, lane IoU {lane:.3f}, {found} of {boxes} boxes: {verdict}")
    sys.exit(not holds)


if __name__ == "__main__":
    main()
