"""The deploy graph equals the network: relative error below 1e-5, more than 0.99999 of mask pixels."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.utils import prune

from tests.deploy.networks import lively_network
from trilitenet.config import STRIDES, ArtefactInfo, Thresholds
from trilitenet.deploy.graph import AttentionGraph, DeployGraph, Traceable
from trilitenet.deploy.layers import Layout
from trilitenet.deploy.layouts import LAYOUTS
from trilitenet.errors import ConfigError, ShapeError
from trilitenet.inference.openvino_backend import openvino_core
from trilitenet.inference.torch_backend import TorchBackend
from trilitenet.models.attention import PCAA
from trilitenet.models.blocks import DepthwiseESP
from trilitenet.models.segmentation import SegmentationHead
from trilitenet.models.trilitenet import TriLiteNet, normalise_images
from trilitenet.processing.letterbox import Letterbox
from trilitenet.processing.postprocess import threshold_mask


def by_cell(detection: Tensor, height: int, width: int) -> Tensor:
    """Bring the network's order (anchor, row, column) into the graph's (row, column, anchor)."""
    parts, start = [], 0
    for stride in STRIDES:
        cells = height // stride * (width // stride)
        level = detection[:, start : start + 3 * cells].view(len(detection), 3, cells, -1)
        parts.append(level.transpose(1, 2).flatten(1, 2))
        start += 3 * cells
    return torch.cat(parts, 1)


def relative_error(value: Tensor, wanted: Tensor) -> float:
    return float((value - wanted).norm() / wanted.norm())


def check(network: TriLiteNet, size: tuple[int, int] = (64, 128), batch: int = 1, **options: Any) -> None:
    images = torch.randint(0, 256, (batch, *size, 3), dtype=torch.uint8)
    with torch.inference_mode():
        outputs = network(normalise_images(images.permute(0, 3, 1, 2), network.card.mean, network.card.std))
        logits = DeployGraph(network, masks="logit", **options)(images)
        decided = DeployGraph(network, **options)(images)
        if outputs.detection is None:
            assert decided.detection is None
        else:
            assert relative_error(decided.detection, by_cell(network.decode(outputs), *size)) < 1e-5
        for name in ("drivable", "lane"):
            wanted = getattr(outputs, name)
            if wanted is None:
                assert getattr(decided, name) is None
                continue
            difference = wanted[:, 1] - wanted[:, 0]
            assert relative_error(getattr(logits, name), difference) < 1e-5
            mask = getattr(decided, name)
            assert mask.dtype == torch.uint8
            assert mask.shape == difference.shape
            assert ((mask == 1) == (difference > 0)).float().mean() > 0.99999


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("variant", ["tiny", "small", "base"])
def test_variants_and_layouts(variant: str, layout: str) -> None:
    check(lively_network(variant), layout=LAYOUTS[layout])


@pytest.mark.parametrize("layout", ["pixels", "planar", "vectors-tiny"])
@pytest.mark.parametrize("scale", [0.0, 1e-9])
def test_a_channel_whose_normalisation_has_next_to_no_scale(scale: float, layout: str) -> None:
    network = lively_network()
    for block in network.encoder.level2:
        assert isinstance(block, DepthwiseESP)
        with torch.no_grad():
            block.bn_act.bn.weight[3] = scale
    check(network, layout=LAYOUTS[layout])
    images = torch.randint(0, 256, (1, 64, 128, 3), dtype=torch.uint8)
    graph = DeployGraph(network, LAYOUTS[layout])
    wanted, half = graph(images), graph.reduced(torch.float16)(images)
    assert relative_error(half.detection, wanted.detection) < 0.01


@pytest.mark.parametrize("size", [(384, 640), (256, 448), (640, 640)])
@pytest.mark.parametrize("layout", ["tiles-tiny", "pixels", "planar-maximum-heads"])
def test_sizes(size: tuple[int, int], layout: str) -> None:
    check(lively_network(), size, layout=LAYOUTS[layout])


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["small", "base"])
@pytest.mark.parametrize("size", [(384, 640), (256, 448), (640, 640)])
def test_sizes_of_larger_variants(variant: str, size: tuple[int, int]) -> None:
    check(lively_network(variant), size)


@pytest.mark.parametrize(
    "tasks",
    [("detection",), ("drivable",), ("lane",), ("detection", "lane"), ("drivable", "lane"), ("detection", "drivable")],
)
def test_task_subsets(tasks: tuple[str, ...]) -> None:
    check(lively_network(tasks=tasks))


@pytest.mark.parametrize("classes", [1, 10])
def test_classes(classes: int) -> None:
    check(lively_network(classes=classes))


@pytest.mark.parametrize("part", ["pcaa", "litepan", "spp"])
def test_ablated_networks(part: str) -> None:
    options: dict[str, Any] = {part: False}
    check(lively_network(**options))


def test_batches() -> None:
    check(lively_network(), batch=3)


def test_anchors_are_those_of_the_network() -> None:
    anchors = tuple(tuple((3.0 + i + j, 5.0 + 2 * i + j) for j in range(3)) for i in range(3))
    check(lively_network(anchors=anchors))


@pytest.mark.parametrize("layout", ["tiles-tiny", "vectors-base", "pixels", "planar", "planar-maximum-heads"])
def test_bgr_and_doubled_masks(layout: str) -> None:
    network = lively_network()
    images = torch.randint(0, 256, (1, 64, 128, 3), dtype=torch.uint8)
    with torch.inference_mode():
        logits = DeployGraph(network, LAYOUTS[layout], masks="logit")(images).lane
        doubled = DeployGraph(network, LAYOUTS[layout], bgr=True, mask_scale=2)(images.flip(3)).lane
    assert logits is not None
    assert doubled is not None
    wanted = torch.nn.functional.interpolate(logits[None], scale_factor=2, mode="bilinear")[0]
    assert doubled.shape == (1, 128, 256)
    assert ((doubled == 1) == (wanted > 0)).float().mean() > 0.9999


def test_thresholds_and_probabilities() -> None:
    network = lively_network()
    images = torch.randint(0, 256, (1, 64, 128, 3), dtype=torch.uint8)
    with torch.inference_mode():
        probability = DeployGraph(network, masks="probability")(images).lane
        strict = DeployGraph(network, thresholds=Thresholds(lane=0.51))(images).lane
        other = DeployGraph(network, masks="probability", thresholds=Thresholds(lane=0.9))(images).lane
        outputs = network(normalise_images(images.permute(0, 3, 1, 2)))
    assert probability is not None
    assert strict is not None
    assert outputs.lane is not None
    wanted = outputs.lane.softmax(1)[:, 1]
    assert (probability.float() - wanted * 255).abs().max() <= 0.51
    assert ((strict == 1) == ((wanted * 255).round() > int(0.51 * 255))).float().mean() > 0.9999
    assert torch.equal(probability, other)


@pytest.mark.parametrize("layout", ["vectors-tiny", "planar", "planar-maximum-heads"])
def test_each_task_has_the_threshold_of_the_card(layout: str) -> None:
    network = lively_network()
    images = torch.randint(0, 256, (1, 64, 128, 3), dtype=torch.uint8)
    with torch.inference_mode():
        outputs = network(normalise_images(images.permute(0, 3, 1, 2)))
        shares = {task: getattr(outputs, task).softmax(1)[:, 1] for task in ("drivable", "lane")}
        middle = {task: float(share.quantile(at)) for (task, share), at in zip(shares.items(), (0.3, 0.7), strict=True)}
        network.card = dataclasses.replace(
            network.card, thresholds=Thresholds(drivable=middle["drivable"], lane=middle["lane"])
        )
        decided = DeployGraph(network, LAYOUTS[layout])(images)
    for task, share in shares.items():
        wanted = (share * 255).round() > int(middle[task] * 255)
        assert ((getattr(decided, task) == 1) == wanted).float().mean() > 0.999


@pytest.mark.parametrize("layout", ["vectors-tiny", "planar"])
@pytest.mark.parametrize("threshold", [0.0, 0.2, 0.4, 0.5, 0.8, 0.999])
def test_masks_are_decided_as_the_network_decides_its_rounded_probabilities(layout: str, threshold: float) -> None:
    network = lively_network(tasks=("drivable", "lane"))
    images = torch.randint(0, 256, (1, 64, 128, 3), dtype=torch.uint8)
    decided = DeployGraph(network, LAYOUTS[layout], thresholds=Thresholds(drivable=threshold, lane=threshold))
    raw = TorchBackend(network, "cpu").run(images.numpy())
    letterbox = Letterbox.fit((64, 128), canvas=(64, 128))
    with torch.inference_mode():
        outputs = decided(images)
    for task in ("drivable", "lane"):
        wanted = threshold_mask(getattr(raw, task)[0], letterbox, threshold)
        assert (getattr(outputs, task)[0].numpy() == wanted).mean() > 0.9995


def test_boxes_are_decoded_in_full_precision() -> None:
    network = lively_network(tasks=("detection",))
    full, reduced = DeployGraph(network).detection, DeployGraph(network).reduced(torch.bfloat16).detection
    assert full is not None
    assert reduced is not None
    logits = torch.randn(1, 3 * 6, 2, 4).to(torch.bfloat16)
    torch.testing.assert_close(reduced.decode(1, logits), full.decode(1, logits.float()), rtol=0, atol=0)


def test_sizes_of_a_program_are_multiples_of_32_to_4096() -> None:
    network = lively_network(tasks=("lane",))
    graph = DeployGraph(network, LAYOUTS["pixels"])
    for form, axes in (("uint8_nhwc", [1, 2]), ("float_nchw", [2, 3])):
        sizes = Traceable(graph, network.card, ArtefactInfo("torch", size=None, input=form)).dynamic  # type: ignore[arg-type]
        assert sizes is not None
        assert list(sizes[0]) == axes
        assert {(side.root.min, side.root.max, side.fn(3)) for side in sizes[0].values()} == {(2, 128, 96)}


def test_portable_input() -> None:
    network = lively_network()
    images = torch.randint(0, 256, (1, 64, 128, 3), dtype=torch.uint8)
    graph = DeployGraph(network, LAYOUTS["planar"])
    with torch.inference_mode():
        pixels, planes = graph(images), graph(images.permute(0, 3, 1, 2).float())
    assert torch.equal(pixels.detection, planes.detection)
    assert torch.equal(pixels.lane, planes.lane)


def test_wrong_options_and_shapes() -> None:
    network = lively_network(tasks=("lane",))
    with pytest.raises(ConfigError, match="mask_scale"):
        DeployGraph(network, masks="probability", mask_scale=2)
    with pytest.raises(ConfigError, match="mask_scale"):
        DeployGraph(network, masks="logit", mask_scale=2)
    with pytest.raises(ConfigError, match=r"to float16 or bfloat16, not torch\.float32"):
        DeployGraph(network).reduced(torch.float32)
    with pytest.raises(ConfigError, match="unknown masks"):
        DeployGraph(network, masks="soft")  # type: ignore[arg-type]
    with pytest.raises(ShapeError, match="uint8"):
        DeployGraph(network)(torch.zeros(1, 3, 64, 64))


def test_a_network_of_other_layers_is_refused() -> None:
    network = lively_network()
    network.encoder.pool = torch.nn.MaxPool2d(3, 2, 1)  # type: ignore[assignment]
    with pytest.raises(ConfigError, match=r"not encoder\.pool \(MaxPool2d\)"):
        DeployGraph(network)


def test_hooks_are_refused() -> None:
    network = lively_network()
    assert network.lane is not None
    hook = network.lane.register_forward_hook(lambda _layer, _inputs, output: 2 * output)
    with pytest.raises(ConfigError, match="the hooks of lane"):
        DeployGraph(network)
    hook.remove()
    prune.random_unstructured(network.encoder.level1.conv, "weight", 0.5)
    with pytest.raises(ConfigError, match=r"the hooks of encoder\.level1\.conv"):
        DeployGraph(network)
    prune.remove(network.encoder.level1.conv, "weight")
    check(network)


def test_wider_heads_and_more_blocks() -> None:
    network = lively_network()
    network.encoder.level2.append(DepthwiseESP(16))
    network.lane = SegmentationHead(8, 8, 16)
    check(network.eval())


@pytest.mark.filterwarnings("ignore:.*torch.jit.trace:DeprecationWarning")
@pytest.mark.parametrize("channels", [32, 128, 256])
@pytest.mark.parametrize("channels_last", [True, False])
def test_attention_on_openvino_is_exact(channels: int, channels_last: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    openvino = pytest.importorskip("openvino")
    monkeypatch.setenv("CI", "true")  # else the conversion reports every operator to its makers, by a process each
    torch.manual_seed(0)
    attention = PCAA(channels).eval()
    graph = AttentionGraph(attention, Layout(channels_last=channels_last)).eval()
    x = 3 * torch.randn(1, channels, 24, 40)
    with torch.no_grad():
        wanted = attention(x)
    model = openvino.convert_model(graph, example_input=x, input=[list(x.shape)])
    compiled = openvino_core(openvino).compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    got = compiled([x.numpy()])[0]
    assert np.abs(got - wanted.numpy()).max() < 1e-4


def test_pixels_are_normalised_as_the_card_says() -> None:
    network = lively_network()
    network.card = dataclasses.replace(network.card, mean=(0.1, 0.2, 0.3), std=(0.5, 0.6, 0.7))
    check(network)
