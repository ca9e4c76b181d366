"""Each rewrite against the layers it replaces, in float64: the algebra must be exact."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from tests.deploy.networks import lively_network
from trilitenet.deploy import rewrites
from trilitenet.deploy.rewrites import Kernel
from trilitenet.models.attention import PCAA
from trilitenet.models.blocks import ConvBNPReLU, DepthwiseSeparableConv, StrideESP, TransposedConvBNPReLU
from trilitenet.models.detection import SPP


def assert_same(value: Tensor, wanted: Tensor) -> None:
    torch.testing.assert_close(value, wanted, rtol=1e-9, atol=1e-10)


def apply(kernel: Kernel, x: Tensor) -> Tensor:
    top, left, bottom, right = kernel.padding
    x = F.pad(x, (left, right, top, bottom))
    return F.conv2d(x, kernel.weight, kernel.bias, kernel.stride, 0, kernel.dilation, kernel.groups)


def space_to_depth(x: Tensor, blocks: tuple[int, int]) -> Tensor:
    batch, channels, height, width = x.shape
    rows, columns = blocks
    x = x.view(batch, channels, height // rows, rows, width // columns, columns)
    return x.permute(0, 3, 5, 1, 2, 4).reshape(batch, -1, height // rows, width // columns)


def double(module: nn.Module) -> nn.Module:
    return module.double().eval()


def image(channels: int, height: int = 16, width: int = 24) -> Tensor:
    return torch.randn(2, channels, height, width, dtype=torch.float64)


def lively(module: nn.Module) -> nn.Module:
    for part in module.modules():
        if isinstance(part, nn.BatchNorm2d):
            nn.init.normal_(part.weight)
            nn.init.normal_(part.bias)
            assert part.running_mean is not None
            assert part.running_var is not None
            part.running_mean.normal_()
            part.running_var.uniform_(0.5, 2)
        elif isinstance(part, nn.PReLU):
            nn.init.uniform_(part.weight, -0.5, 1.5)
    return double(module)


def test_fold_batch_norm() -> None:
    block = lively(ConvBNPReLU(3, 5, stride=2))
    assert isinstance(block, ConvBNPReLU)
    kernel = rewrites.fold_batch_norm(rewrites.conv_kernel(block.conv), block.bn)
    x = image(3)
    torch.testing.assert_close(apply(kernel, x), block.bn(block.conv(x)))


def test_fold_normalisation() -> None:
    mean, std = (0.4, 0.5, 0.6), (0.2, 0.3, 0.4)
    scale, shift = rewrites.fold_normalisation(mean, std)
    pixels = torch.arange(256, dtype=torch.float64).unsqueeze(1)
    wanted = (pixels / 255 - torch.tensor(mean, dtype=torch.float64)) / torch.tensor(std, dtype=torch.float64)
    assert_same(pixels * scale + shift, wanted)


@pytest.mark.parametrize("kernel_size", [1, 3])
def test_compose_pointwise_merges_depthwise_and_pointwise(kernel_size: int) -> None:
    block = double(DepthwiseSeparableConv(6, 4, kernel_size))
    assert isinstance(block, DepthwiseSeparableConv)
    merged = rewrites.compose_pointwise(rewrites.conv_kernel(block.depthwise), rewrites.conv_kernel(block.pointwise))
    assert merged.groups == 1
    x = image(6)
    assert_same(apply(merged, x), block(x))


def test_compose_pointwise_keeps_both_biases() -> None:
    spp, lateral = double(SPP(8)), nn.Conv2d(8, 4, 1).double()
    assert isinstance(spp, SPP)
    merged = rewrites.compose_pointwise(rewrites.conv_kernel(spp.expand), rewrites.conv_kernel(lateral))
    x = image(16)
    assert_same(apply(merged, x), lateral(spp.expand(x)))


def test_hierarchical_sums_are_one_matrix() -> None:
    block = lively(StrideESP(4, 16))
    assert isinstance(block, StrideESP)
    x = image(4)
    reduced = block.reduce(x)
    branches = [conv(reduced) for conv in (block.d1, block.d2, block.d4, block.d8, block.d16)]
    matrix = rewrites.hierarchical_sum_matrix(branches[0].shape[1], branches[1].shape[1])
    merge = Kernel(matrix.view(*matrix.shape, 1, 1), torch.zeros(len(matrix), dtype=torch.float64))
    merged = apply(rewrites.fold_batch_norm(merge, block.bn), torch.cat(branches, 1))
    assert_same(block.act(merged), block(x))
    assert torch.equal(matrix, matrix.tril())


def test_split_inputs_is_convolution_of_the_concatenation() -> None:
    conv = nn.Conv2d(7, 5, 3, padding=1).double()
    x, y = image(4), image(3)
    first, second = rewrites.split_inputs(rewrites.conv_kernel(conv), 4, 3)
    assert_same(apply(first, x) + apply(second, y), conv(torch.cat((x, y), 1)))


def test_pad_inputs_ignores_the_channels_before() -> None:
    conv = nn.Conv2d(3, 2, 3, padding=1).double()
    x = image(7)
    assert_same(apply(rewrites.pad_inputs(rewrites.conv_kernel(conv), 4), x), conv(x[:, 4:]))


def test_reverse_inputs_takes_bgr() -> None:
    conv = nn.Conv2d(3, 2, 3, padding=1).double()
    x = image(3)
    assert_same(apply(rewrites.reverse_inputs(rewrites.conv_kernel(conv)), x.flip(1)), conv(x))


def test_pool_kernel_counts_the_padding() -> None:
    x = image(3)
    pool = nn.AvgPool2d(3, stride=2, padding=1)
    assert_same(apply(rewrites.pool_kernel(3), x), pool(x))


def test_level1_and_pool_are_one_convolution() -> None:
    block = lively(ConvBNPReLU(3, 4, stride=2))
    assert isinstance(block, ConvBNPReLU)
    stem = rewrites.fold_batch_norm(rewrites.conv_kernel(block.conv), block.bn)
    kernel, slopes = rewrites.merge_pool_into_stem(stem, rewrites.prelu_slopes(block.act, 4))
    x = image(3)
    wanted = torch.cat((block(x), nn.AvgPool2d(3, 2, 1)(x)), 1)
    assert_same(F.prelu(apply(kernel, x), slopes), wanted)


def test_transposed_convolution_is_pointwise_and_depth_to_space() -> None:
    block = lively(TransposedConvBNPReLU(6, 3))
    assert isinstance(block, TransposedConvBNPReLU)
    kernel = rewrites.transposed_as_pointwise(block.deconv.weight, block.bn)
    x = image(6, 4, 5)
    assert_same(apply(kernel, x), space_to_depth(block.bn(block.deconv(x)), (2, 2)))


def test_nest_blocks_orders_a_doubled_map() -> None:
    block = lively(TransposedConvBNPReLU(6, 3))
    assert isinstance(block, TransposedConvBNPReLU)
    kernel = rewrites.transposed_as_pointwise(block.deconv.weight, block.bn)
    kernel = rewrites.nest_blocks(rewrites.space_to_depth_kernel(kernel, (2, 2), (2, 2)), (2, 2))
    x = image(6, 4, 6)
    wanted = space_to_depth(block.bn(block.deconv(x)), (4, 4))
    assert_same(apply(kernel, space_to_depth(x, (2, 2))), wanted)


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize(
    ("source", "target"),
    [
        ((1, 1), (1, 1)),
        ((2, 2), (1, 1)),
        ((2, 2), (2, 2)),
        ((4, 4), (2, 2)),
        ((1, 1), (2, 2)),
        ((2, 1), (2, 1)),
        ((1, 4), (2, 2)),
    ],
)
@pytest.mark.parametrize("size", [1, 3])
def test_space_to_depth_kernel(stride: int, source: tuple[int, int], target: tuple[int, int], size: int) -> None:
    if any((stride * t) % s for s, t in zip(source, target, strict=True)):
        pytest.skip("cells of the input would straddle cells of the output")
    conv = nn.Conv2d(3, 5, size, stride, padding=size // 2).double()
    x = image(3)
    kernel = rewrites.space_to_depth_kernel(rewrites.conv_kernel(conv), source, target)
    assert_same(apply(kernel, space_to_depth(x, source)), space_to_depth(conv(x), target))


@pytest.mark.parametrize("dilation", [1, 2, 4, 8])
@pytest.mark.parametrize("depthwise", [True, False])
@pytest.mark.parametrize("columns", [2, 4])
def test_dilated_convolutions_in_cells_of_columns(columns: int, depthwise: bool, dilation: int) -> None:
    groups = 3 if depthwise else 1
    conv = nn.Conv2d(3, 3, 3, padding=dilation, dilation=dilation, groups=groups).double()
    x = image(3)
    kernel = rewrites.space_to_depth_kernel(rewrites.conv_kernel(conv), (1, columns), (1, columns))
    assert_same(apply(kernel, space_to_depth(x, (1, columns))), space_to_depth(conv(x), (1, columns)))
    divides = dilation % columns == 0
    assert kernel.groups == (3 * columns if depthwise and divides else 1)
    assert kernel.dilation == (dilation, dilation // columns if divides else 1)


def test_concatenated_cells_take_the_parts_cells() -> None:
    conv = nn.Conv2d(7, 5, 3, padding=1).double()
    x, y = image(4), image(3)
    kernel = rewrites.concatenated_cells(rewrites.conv_kernel(conv), (4, 3), (1, 4))
    cells = torch.cat([space_to_depth(part, (1, 4)) for part in (x, y)], 1)
    assert_same(apply(kernel, cells), space_to_depth(conv(torch.cat((x, y), 1)), (1, 4)))


@pytest.mark.parametrize("columns", [1, 2])
def test_transposed_convolution_in_cells_of_columns(columns: int) -> None:
    conv = nn.ConvTranspose2d(6, 3, 2, 2, bias=False).double()
    x = image(6, 4, 8)
    weight = rewrites.transposed_in_columns(conv.weight.detach(), columns)
    cells = F.conv_transpose2d(space_to_depth(x, (1, columns)), weight, None, (2, 1))
    assert_same(cells, space_to_depth(conv(x), (1, 2 * columns)))


@pytest.mark.parametrize("threshold", [0.2, 0.5, 0.9])
def test_mask_difference_decides_like_soft_max(threshold: float) -> None:
    logits = torch.randn(1, 8, 30, 40, dtype=torch.float64) * 3
    decided = apply(rewrites.mask_difference(4, threshold), logits) > 0
    probability = logits.view(1, 4, 2, 30, 40).softmax(2)[:, :, 1]
    assert torch.equal(decided, probability > threshold)
    assert decided.any()
    assert not decided.all()


def test_upsample_kernel_has_the_sign_of_bilinear_interpolation() -> None:
    x = image(1)
    ours = apply(rewrites.upsample_kernel(), x)
    wanted = space_to_depth(F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False), (2, 2))
    assert_same(ours[..., 1:-1, 1:-1], wanted[..., 1:-1, 1:-1])
    assert torch.equal(ours > 0, wanted > 0)


@pytest.mark.parametrize("dilation", [1, 2])
def test_trim_taps(dilation: int) -> None:
    weight = torch.randn(3, 2, 3, 5, dtype=torch.float64)
    weight[:, :, 0] = 0
    weight[:, :, :, 3:] = 0
    weight[0, 1, 1:, 0] = 0  # one column of one input alone stays
    padding = (dilation, 2 * dilation, dilation, 2 * dilation)
    kernel = Kernel(weight, torch.randn(3, dtype=torch.float64), padding, dilation=(dilation, dilation))
    trimmed = rewrites.trim_taps(kernel)
    assert trimmed.weight.shape == (3, 2, 2, 3)
    assert trimmed.padding == (0, 2 * dilation, dilation, 0)
    x = image(2)
    assert_same(apply(trimmed, x), apply(kernel, x))


def test_taps_that_read_the_image_are_not_trimmed() -> None:
    kernel = Kernel(torch.zeros(1, 1, 3, 3, dtype=torch.float64), torch.ones(1, dtype=torch.float64), (0, 1, 0, 1))
    trimmed = rewrites.trim_taps(kernel)
    assert trimmed.weight.shape == (1, 1, 3, 2)
    x = image(1)
    assert torch.equal(apply(trimmed, x), apply(kernel, x))


@pytest.mark.parametrize("columns", [1, 2, 8])
def test_rows_of_a_doubled_mask_read_two_or_one_rows_of_cells(columns: int) -> None:
    blocks = (2, 2 * columns)
    kernel = rewrites.space_to_depth_kernel(rewrites.upsample_kernel(), blocks, blocks)
    kernel = rewrites.nest_blocks(kernel, blocks)
    rows = [rewrites.trim_taps(rewrites.take_outputs(kernel, row)) for row in torch.arange(16 * columns).view(4, -1)]
    assert [row.weight.shape[2:] for row in rows] == [(2, 3), (1, 3), (1, 3), (2, 3)]
    x = image(len(kernel.weight) // 4, 4, 6)
    assert_same(torch.cat([apply(row, x) for row in rows], 1), apply(kernel, x))


def test_prelu_as_maximum_only_where_it_is_exact() -> None:
    x = torch.linspace(-3, 3, 50)
    for slope in (-0.5, 0.0, 0.3, 1.0, 1.5):
        same = torch.allclose(torch.maximum(x, slope * x), F.prelu(x, torch.tensor([slope])))
        assert rewrites.prelu_as_maximum(torch.tensor([slope])) == same


def test_fold_attention() -> None:
    pcaa = lively(PCAA(8))
    assert isinstance(pcaa, PCAA)
    w = rewrites.fold_attention(pcaa)
    x = image(8, 8, 16)
    from trilitenet.models.attention import merge_bins, split_bins

    pixels = split_bins(x)
    maps = pixels @ w.maps.T
    confidence = torch.sigmoid(pixels.mean(2) @ w.maps.T + w.maps_bias).unsqueeze(-1)
    local = maps.softmax(2).transpose(2, 3) @ pixels * confidence
    active = F.prelu(torch.einsum("ij,bjkc->bikc", w.nodes, local), w.nodes_slopes)
    total = torch.einsum("i,bikc->bkc", w.fuse, active).unsqueeze(1) @ w.channels + w.fuse_bias
    total = F.leaky_relu(total, w.fuse_slope)
    bias = (active @ w.key_bias).unsqueeze(2)
    affinity = (pixels @ (active @ w.key).transpose(2, 3) + bias).softmax(-1)
    out = F.prelu(merge_bins(affinity @ (total @ w.value + w.value_bias), 8, 16), w.out_slopes)
    torch.testing.assert_close(x + out, pcaa(x), rtol=1e-6, atol=1e-7)  # one slope passes through float32


def test_rewrites_leave_the_network_alone() -> None:
    from trilitenet.deploy.graph import DeployGraph

    network = lively_network()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    DeployGraph(network, bgr=True)
    assert all(torch.equal(before[name], value) for name, value in network.state_dict().items())


@pytest.mark.parametrize("threshold", [0.0, 1.0])
def test_the_ends_of_a_threshold_decide_everything(threshold: float) -> None:
    kernel = rewrites.mask_difference(1, threshold)
    decision = F.conv2d(torch.tensor([-5.0, 5.0]).double().view(1, 2, 1, 1), kernel.weight, kernel.bias)
    assert bool(decision > 0) == (threshold == 0)
