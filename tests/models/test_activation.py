from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from trilitenet.models import activation
from trilitenet.models.activation import AveragePool, PReLU, batch_norm_prelu
from trilitenet.models.blocks import ConvBNPReLU


def case(channels: int, dtype: torch.dtype, memory_format: torch.memory_format) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(channels)
    shape = (2, channels, 8, 12)
    x = torch.randn(shape, generator=generator, dtype=torch.float64) * 2 + 1
    grad = torch.randn(shape, generator=generator, dtype=torch.float64)
    return (
        x.to(dtype).contiguous(memory_format=memory_format).requires_grad_(),
        grad.to(dtype).contiguous(memory_format=memory_format),
    )


def layers(channels: int, dtype: torch.dtype) -> tuple[nn.BatchNorm2d, PReLU]:
    torch.manual_seed(channels)
    bn, act = nn.BatchNorm2d(channels, eps=1e-3, momentum=0.03), PReLU(channels)
    for parameter in (bn.weight, bn.bias, act.weight):
        nn.init.normal_(parameter)
    return bn.to(dtype), act.to(dtype)


@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("channels", [2, 4, 8])
@pytest.mark.parametrize("block", [1, 250, 2**18])  # a row, a few, all at a time
def test_equals_the_plain_layers(
    channels: int, block: int, memory_format: torch.memory_format, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(activation, "BLOCK", block)
    x, grad = case(channels, torch.float64, memory_format)
    bn, act = layers(channels, torch.float64)
    other, _ = layers(channels, torch.float64)
    out = batch_norm_prelu(bn, act, x)
    expected = F.prelu(other(x), act.weight)
    torch.testing.assert_close(out, expected)
    torch.testing.assert_close(dict(bn.named_buffers()), dict(other.named_buffers()))
    ours = torch.autograd.grad(out, [x, bn.weight, bn.bias, act.weight], grad)
    theirs = torch.autograd.grad(expected, [x, other.weight, other.bias, act.weight], grad)
    torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("block", [1, 2**18])
def test_prelu_alone_equals_the_plain_layer(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(activation, "BLOCK", block)
    x, grad = case(6, torch.float64, torch.channels_last)
    _, act = layers(6, torch.float64)
    ours = torch.autograd.grad(act(x), [x, act.weight], grad)
    theirs = torch.autograd.grad(F.prelu(x, act.weight), [x, act.weight], grad)
    torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
def test_pool_equals_the_plain_layer(memory_format: torch.memory_format) -> None:
    x, _ = case(3, torch.float32, memory_format)
    pooled = AveragePool(3, stride=2, padding=1)(x)
    torch.testing.assert_close(pooled, nn.AvgPool2d(3, stride=2, padding=1)(x))
    assert pooled.is_contiguous(memory_format=memory_format)


@pytest.mark.parametrize("channels", [4, 12])
def test_sums_over_many_pixels_keep_their_digits(channels: int) -> None:
    """PyTorch 2.13's own channels-last kernel is a hundred times and more off here."""
    generator = torch.Generator().manual_seed(0)
    x = (torch.rand((4, channels, 192, 320), generator=generator) + 4).to(memory_format=torch.channels_last)
    weight = torch.randn(x.shape, generator=generator).to(memory_format=torch.channels_last)
    gradients: list[Tensor] = []
    for dtype in (torch.float32, torch.float64):
        bn, act = layers(channels, dtype)
        part = x.to(dtype).requires_grad_()
        gradients += torch.autograd.grad((batch_norm_prelu(bn, act, part) * weight.to(dtype)).sum(), part)
    error = (gradients[0] - gradients[1]).norm() / gradients[1].norm()
    assert error < 1e-5


def test_keeps_the_memory_format_and_type() -> None:
    x, _ = case(2, torch.bfloat16, torch.channels_last)
    bn, act = layers(2, torch.float32)
    out = batch_norm_prelu(bn, act, x)
    assert out.dtype is torch.bfloat16
    assert out.is_contiguous(memory_format=torch.channels_last)
    assert act(x).is_contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize("normalised", [True, False])
@pytest.mark.parametrize("block", [1, 2**18])
def test_gradients_in_bf16_are_those_of_the_rounded_input(
    block: int, normalised: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(activation, "BLOCK", block)
    x, grad = case(4, torch.bfloat16, torch.channels_last)
    bn, act = layers(4, torch.float32)
    out = batch_norm_prelu(bn, act, x) if normalised else act(x)
    (ours,) = torch.autograd.grad(out, x, grad)
    exact = x.detach().double().requires_grad_()
    bn, act = layers(4, torch.float64)
    (theirs,) = torch.autograd.grad(F.prelu(bn(exact) if normalised else exact, act.weight), exact, grad.double())
    assert ours.dtype is torch.bfloat16
    assert (ours - theirs).norm() < 0.005 * theirs.norm()  # a rounding or two of 2^-9


def test_evaluation_uses_the_running_statistics() -> None:
    x, _ = case(4, torch.float32, torch.channels_last)
    bn, act = layers(4, torch.float32)
    bn.running_mean = torch.full((4,), 0.5)
    bn.eval(), act.eval()
    torch.testing.assert_close(batch_norm_prelu(bn, act, x), F.prelu(bn(x), act.weight))


def test_gradient_at_zero_is_that_of_pytorch() -> None:
    x = torch.zeros(1, 2, 2, 2).contiguous(memory_format=torch.channels_last).requires_grad_()
    act = PReLU(2)
    (ours,) = torch.autograd.grad(act(x).sum(), x)
    (theirs,) = torch.autograd.grad(F.prelu(x, act.weight).sum(), x)
    torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("act", nn.ReLU()),
        ("act", nn.PReLU()),
        ("act", PReLU(1)),
        ("bn", nn.GroupNorm(2, 8)),
        ("bn", nn.Identity()),
        ("bn", nn.BatchNorm2d(8, momentum=None)),
        ("bn", nn.BatchNorm2d(8, affine=False)),
        ("bn", nn.BatchNorm2d(8, track_running_stats=False)),
    ],
)
def test_other_layers_may_take_their_places(name: str, part: nn.Module) -> None:
    block = ConvBNPReLU(3, 8).train()
    setattr(block, name, part)
    images = torch.randn(2, 3, 8, 8)
    plain = block(images)
    torch.testing.assert_close(block(images.to(memory_format=torch.channels_last)), plain, atol=1e-5, rtol=1e-4)


def test_hooks_are_called() -> None:
    block = ConvBNPReLU(3, 8).train()
    called: list[str] = []
    block.bn.register_forward_hook(lambda *_: called.append("bn"))
    block.act.register_forward_hook(lambda *_: called.append("act"))
    block(torch.randn(2, 3, 8, 8).to(memory_format=torch.channels_last))
    assert called == ["bn", "act"]
    block, called = ConvBNPReLU(3, 8).train(), []
    block.act.register_forward_hook(lambda *_: called.append("act alone"))
    block(torch.randn(2, 3, 8, 8).to(memory_format=torch.channels_last))
    assert called == ["act alone"]


def test_transforms_of_functions_take_the_plain_way() -> None:
    x, _ = case(6, torch.float64, torch.channels_last)
    _, act = layers(6, torch.float64)

    def loss(image: Tensor) -> Tensor:
        total: Tensor = act(image).square().sum()
        return total

    images = x.detach()[:, None]
    gradients = torch.func.vmap(torch.func.grad(loss))(images)
    for image, gradient in zip(images, gradients, strict=True):
        torch.testing.assert_close(gradient, torch.autograd.grad(loss(image.requires_grad_()), image)[0])
