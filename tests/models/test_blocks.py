"""Blocks against slow, independent forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from trilitenet.config import STRIDES, VARIANTS
from trilitenet.data.batches import collate
from trilitenet.data.synthetic import SyntheticScenes
from trilitenet.data.transforms import EvalTransform
from trilitenet.losses.detection import DetectionLoss
from trilitenet.losses.multitask import MultiTaskLoss
from trilitenet.models.attention import merge_bins, split_bins
from trilitenet.models.blocks import DepthwiseESP, DilatedConv, StrideESP
from trilitenet.models.detection import DetectionHead
from trilitenet.models.encoder import Encoder
from trilitenet.models.trilitenet import build_network, normalise_images


def test_split_bins_inverts_and_keeps_bins_apart() -> None:
    x = torch.arange(2 * 3 * 4 * 8).view(2, 3, 4, 8).float()
    bins = split_bins(x)
    assert bins.shape == (2, 8, 4, 3)
    assert torch.equal(merge_bins(bins, 4, 8), x)
    # Bin 5 of 2 x 4 is row 1, column 1: rows 2-3, columns 2-3.
    assert torch.equal(bins[0, 5, :, 0], x[0, 0, 2:4, 2:4].flatten())


@pytest.mark.parametrize("channels", [16, 32, 64, 128])
def test_esp_keeps_its_channels(channels: int) -> None:
    x = torch.randn(1, channels, 8, 12)
    assert DepthwiseESP(channels)(x).shape == x.shape
    assert StrideESP(channels, 2 * channels)(x).shape == (1, 2 * channels, 4, 6)


def test_esp_fuses_hierarchically() -> None:
    """With one branch switched on at a time, that branch reaches exactly the sums that contain it."""
    block = StrideESP(5, 10).eval()
    x = torch.randn(1, 5, 16, 16)
    reached = {}
    for name in ("d1", "d2", "d4", "d8", "d16"):
        with torch.no_grad():
            for other in ("d1", "d2", "d4", "d8", "d16"):
                conv = getattr(block, other)
                conv.weight.fill_(0.1 if other == name else 0.0)
            reached[name] = [bool(block(x)[0, c].abs().sum() > 0) for c in range(0, 10, 2)]
    assert reached == {
        "d1": [True, False, False, False, False],
        "d2": [False, True, True, True, True],
        "d4": [False, False, True, True, True],
        "d8": [False, False, False, True, True],
        "d16": [False, False, False, False, True],
    }


def test_pooled_images_count_the_zeros_of_the_padding() -> None:
    outputs = Encoder(VARIANTS["tiny"]).eval()(torch.ones(1, 3, 32, 32))
    assert outputs.i1[0, 0, 0, 0] == pytest.approx(4 / 9)
    assert outputs.i1[0, 0, 1, 1] == pytest.approx(1)


@pytest.mark.parametrize("dilation", [1, 2, 4, 8, 16])
@pytest.mark.parametrize(("channels", "groups"), [(6, 6), (25, 1), (26, 1), (12, 1)])
def test_dilated_gradient_under_bf16_autocast(channels: int, groups: int, dilation: int) -> None:
    """PyTorch 2.13.0 on CPU gives a wrong weight gradient for bf16, channels-last and dilation; ours must not."""
    torch.manual_seed(0)
    conv = DilatedConv(channels, channels, 3, dilation=dilation, groups=groups)
    conv = conv.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    x = torch.randn(2, channels, 48, 80).to(memory_format=torch.channels_last)
    target = torch.randn(2, channels, 48, 80)
    conv(x).mul(target).sum().backward()
    assert conv.weight.grad is not None
    expected = conv.weight.grad.clone()
    conv.weight.grad = None
    with torch.autocast("cpu", torch.bfloat16):
        out = conv(x.bfloat16())
    out.float().mul(target).sum().backward()
    error = (conv.weight.grad - expected).norm() / expected.norm()
    assert np.isfinite(error.item())
    assert error < 0.02


@pytest.mark.parametrize("training", [True, False])
def test_the_stem_is_trained_in_fp32_under_autocast(training: bool) -> None:
    encoder = Encoder(VARIANTS["tiny"]).train(training)
    kinds: dict[str, torch.dtype] = {}
    for name in ("level1", "b1", "level2_down", "b2"):
        encoder.get_submodule(name).register_forward_hook(
            lambda module, inputs, out, name=name: kinds.update({name: out.dtype})
        )
    with torch.autocast("cpu", torch.bfloat16):
        encoder(torch.zeros(2, 3, 64, 64))
    stem = torch.float32 if training else torch.bfloat16
    assert kinds == {"level1": stem, "b1": stem, "level2_down": stem, "b2": torch.bfloat16}


@pytest.mark.parametrize("variant", list(VARIANTS))
def test_bf16_gradient_of_the_network_is_no_worse_in_channels_last(variant: str) -> None:
    """Beside fp32 both layouts differ by bf16's own rounding; what PyTorch gets wrong in one would stand out."""
    transform = EvalTransform((96, 160))
    batch = collate([transform(scene) for scene in (SyntheticScenes(0)[0], SyntheticScenes(0)[1])])
    errors, gradients = [], []
    for layout, enabled in (
        (torch.contiguous_format, False),
        (torch.contiguous_format, True),
        (torch.channels_last, True),
    ):
        torch.manual_seed(0)
        network = build_network(variant).to(memory_format=layout).train()  # type: ignore[call-overload]
        loss = MultiTaskLoss(DetectionLoss(network.anchors, 1))
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            outputs = network(normalise_images(batch.images.contiguous(memory_format=layout)))
        loss(outputs, batch).total.backward()
        gradients.append(torch.cat([p.grad.flatten() for p in network.parameters() if p.grad is not None]))
        errors.append(((gradients[-1] - gradients[0]).norm() / gradients[0].norm()).item())
    assert np.isfinite(errors).all()
    assert errors[1] < 0.3
    assert errors[2] < 1.5 * errors[1]


def test_a_fresh_head_expects_eight_objects_an_image() -> None:
    head = DetectionHead(4096, 1)  # so many channels that the random part of a bias is at most 1 / 64
    for conv, stride in zip(head.convs, STRIDES, strict=True):
        assert isinstance(conv.bias, torch.Tensor)
        objectness = conv.bias.detach().view(3, -1)[:, 4]
        assert objectness.tolist() == pytest.approx([math.log(8 / (640 / stride) ** 2)] * 3, abs=0.02)


@pytest.mark.parametrize(("classes", "bias"), [(1, 4.094), (2, -0.521), (10, -2.709)])
def test_a_fresh_head_expects_every_class_alike(classes: int, bias: float) -> None:
    for conv in DetectionHead(64, classes).convs:
        assert isinstance(conv.bias, torch.Tensor)
        assert conv.bias.detach().view(3, -1)[:, 5:].flatten().tolist() == pytest.approx([bias] * 3 * classes, abs=0.2)


def test_normalisations_are_the_published_ones() -> None:
    norms = [module for module in build_network("tiny").modules() if isinstance(module, torch.nn.BatchNorm2d)]
    assert norms
    assert {(norm.eps, norm.momentum) for norm in norms} == {(1e-3, 0.03)}
