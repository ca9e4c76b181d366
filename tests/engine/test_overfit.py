"""The whole way, end to end: tiny learns three synthetic scenes by heart, and the predictor reads them back."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

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

SIZE = (192, 320)
STEPS = 420  # with a quarter less the lane lines end at 0.5 to 0.67, by the processor's rounding; so at 0.7 to 0.84
LEARNING_RATE = 0.012


def _learn_by_heart(samples: list[Sample]) -> TriLiteNet:
    torch.manual_seed(0)
    network = build_network("tiny").train()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    loss = MultiTaskLoss(
        DetectionLoss(network.anchors, 1),
        SegmentationLoss(0.5, 0.5),
        SegmentationLoss(0.5, 0.5),
        weights=(1.0, 0.3, 0.6),
    )
    optimiser = torch.optim.AdamW(network.parameters(), lr=LEARNING_RATE, betas=(0.9, 0.99), weight_decay=0)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=STEPS, pct_start=0.1)
    batch = collate(samples)
    images = normalise_images(batch.images.contiguous(memory_format=torch.channels_last))
    torch.set_flush_denormal(True)  # numbers near 0 take some processors twice the time in all
    try:
        for _ in range(STEPS):
            optimiser.zero_grad()
            loss(network(images), batch).total.backward()
            optimiser.step()
            schedule.step()
    finally:
        torch.set_flush_denormal(False)
    return network.eval()


def _resolvable(sample: Sample) -> bool:
    """Whether no vehicle is tiny, and no two share a cell of the finest level: at this small size, far ones may."""
    assert sample.boxes is not None
    centres = (sample.boxes[:, :2] + sample.boxes[:, 2:]) / 2
    apart = np.abs(centres[:, None] - centres[None]).max(-1) + 1e3 * np.eye(len(centres))
    sides = sample.boxes[:, 2:] - sample.boxes[:, :2]
    return len(centres) > 0 and bool((apart > 12).all()) and bool((sides > 6).all())


def _pooled_iou(predicted: list[np.ndarray], truth: list[np.ndarray]) -> float:
    pairs = list(zip(predicted, truth, strict=True))
    hit = sum(int((p & t).sum()) for p, t in pairs)
    union = sum(int((p | t).sum()) for p, t in pairs)
    return hit / union


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_tiny_learns_three_scenes_by_heart() -> None:
    scenes = SyntheticScenes(0, size=SIZE)
    drawn = (scenes[index] for index in itertools.count())
    samples = list(itertools.islice((sample for sample in drawn if _resolvable(sample)), 3))
    network = _learn_by_heart(samples)
    predictor = Predictor(TorchBackend(network, "cpu"), long_side=SIZE[1])
    seen = predictor([sample.image for sample in samples])

    drivable = [sample.drivable.astype(bool) for sample in samples if sample.drivable is not None]
    lane = [sample.lane.astype(bool) for sample in samples if sample.lane is not None]
    assert _pooled_iou([p.drivable for p in seen if p.drivable is not None], drivable) > 0.95
    assert _pooled_iou([p.lane for p in seen if p.lane is not None], lane) > 0.6
    boxes = 0
    for sample, perception in zip(samples, seen, strict=True):
        assert sample.boxes is not None
        assert perception.boxes is not None
        if len(sample.boxes):
            overlaps = box_iou(sample.boxes, perception.boxes.xyxy)
            assert (overlaps.max(1) > 0.5).all(), sample.name
            boxes += len(sample.boxes)
    assert boxes >= 8
