from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from trilitenet.errors import ShapeError
from trilitenet.losses.segmentation import IGNORED, SegmentationLoss


def slow_focal(logits: Tensor, target: Tensor, alpha: float = 0.25, gamma: float = 2.0) -> float:
    total, count = 0.0, 0
    for image, mask in zip(logits.tolist(), target.tolist(), strict=True):
        for row in range(len(mask)):
            for column in range(len(mask[0])):
                if mask[row][column] == IGNORED:
                    continue
                count += 1
                for channel in range(2):
                    truth = mask[row][column] == channel
                    p = 1 / (1 + math.exp(-image[channel][row][column]))
                    p_true = p if truth else 1 - p
                    total += (alpha if truth else 1 - alpha) * (1 - p_true) ** gamma * -math.log(p_true)
    return total / max(count, 1)


def slow_tversky(logits: Tensor, target: Tensor, alpha: float, beta: float) -> float:
    hit, wrong, missed, present = [0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0, 0]
    for image, mask in zip(logits.tolist(), target.tolist(), strict=True):
        for row in range(len(mask)):
            for column in range(len(mask[0])):
                if mask[row][column] == IGNORED:
                    continue
                scores = [math.exp(image[channel][row][column]) for channel in range(2)]
                for channel in range(2):
                    p = scores[channel] / sum(scores)
                    if mask[row][column] == channel:
                        hit[channel] += p
                        missed[channel] += 1 - p
                        present[channel] += 1
                    else:
                        wrong[channel] += p
    losses = [1 - hit[c] / (hit[c] + alpha * wrong[c] + beta * missed[c]) if present[c] else 0.0 for c in range(2)]
    return float((sum(losses) / 2) ** (4 / 3))


def random_case(seed: int, kind: str) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    logits = torch.randn(3, 2, 8, 10, generator=generator, dtype=torch.float64) * 3
    target = torch.randint(0, 2, (3, 8, 10), generator=generator, dtype=torch.uint8)
    if kind == "partly ignored":
        target[torch.rand(3, 8, 10, generator=generator) < 0.3] = IGNORED
    if kind == "absent image":
        target[1] = IGNORED
    if kind == "all absent":
        target[:] = IGNORED
    if kind == "no foreground":
        target[:] = 0
    return logits, target


KINDS = ["plain", "partly ignored", "absent image", "all absent", "no foreground"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("alpha", "beta"), [(0.7, 0.3), (0.9, 0.1)])
def test_agrees_with_plain_loops(kind: str, alpha: float, beta: float) -> None:
    logits, target = random_case(1, kind)
    terms = SegmentationLoss(alpha, beta)(logits, target)
    assert float(terms.focal) == pytest.approx(slow_focal(logits, target), rel=1e-6)
    assert float(terms.tversky) == pytest.approx(slow_tversky(logits, target, alpha, beta), rel=1e-6)


def test_by_hand() -> None:
    logits = torch.zeros(1, 2, 1, 2)
    target = torch.tensor([[[0, 1]]], dtype=torch.uint8)
    # Every probability is 1/2: each pixel has one true and one false channel.
    terms = SegmentationLoss(0.7, 0.3)(logits, target)
    assert float(terms.focal) == pytest.approx((0.25 + 0.75) * 0.25 * math.log(2))
    assert float(terms.tversky) == pytest.approx((1 - 0.5 / (0.5 + 0.7 * 0.5 + 0.3 * 0.5)) ** (4 / 3))


@pytest.mark.parametrize("kind", KINDS)
def test_gradients(kind: str) -> None:
    logits, target = random_case(2, kind)
    logits = logits[:, :, :3, :4].clone().requires_grad_()
    target = target[:, :3, :4].contiguous()
    assert torch.autograd.gradcheck(lambda x: sum(SegmentationLoss(0.9, 0.1)(x, target)), (logits,))
    if kind == "all absent":
        (gradient,) = torch.autograd.grad(sum(SegmentationLoss(0.9, 0.1)(logits, target)), logits)
        assert float(gradient.abs().sum()) == 0.0


def test_extreme_logits_stay_finite() -> None:
    logits = torch.tensor([1e4, -1e4]).view(1, 2, 1, 1).expand(1, 2, 4, 4).clone().requires_grad_()
    for value in (0, 1):
        target = torch.full((1, 4, 4), value, dtype=torch.uint8)
        total = sum(SegmentationLoss(0.7, 0.3)(logits, target))
        (gradient,) = torch.autograd.grad(total, logits)
        assert bool(torch.isfinite(total))
        assert bool(gradient.isfinite().all())


def test_computes_in_32_bits_under_autocast() -> None:
    logits, target = random_case(4, "plain")
    half = logits.bfloat16()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        terms = SegmentationLoss(0.7, 0.3)(half, target)
    assert terms.focal.dtype is torch.float32
    torch.testing.assert_close(terms, SegmentationLoss(0.7, 0.3)(half.float(), target))


def test_refuses_wrong_shapes() -> None:
    for channels, width in ((3, 4), (2, 5)):
        with pytest.raises(ShapeError, match="logits must be"):
            SegmentationLoss(0.7, 0.3)(torch.zeros(1, channels, 4, 4), torch.zeros(1, 4, width, dtype=torch.uint8))


def test_any_memory_format_will_do() -> None:
    logits, target = torch.randn(1, 2, 6, 4), torch.randint(0, 2, (1, 4, 6))
    turned = SegmentationLoss(0.7, 0.3)(logits.transpose(2, 3), target)
    torch.testing.assert_close(turned, SegmentationLoss(0.7, 0.3)(logits.transpose(2, 3).contiguous(), target))
