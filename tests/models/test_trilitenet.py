"""The whole network: size, cost, shapes, tasks, decoding, and agreement with recorded published outputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn

from tests.models.conftest import published_state
from trilitenet import build_network, load_network
from trilitenet.config import DEFAULT_ANCHORS, IMAGE_MEAN, IMAGE_STD, TASKS, VARIANTS
from trilitenet.errors import ConfigError, ShapeError
from trilitenet.models.attention import PCAA
from trilitenet.models.blocks import ConvBNPReLU, DepthwiseESP, DilatedConv
from trilitenet.models.cost import count_multiply_adds, count_parameters
from trilitenet.models.detection import decode_level
from trilitenet.models.segmentation import SegmentationHead
from trilitenet.models.trilitenet import NetworkOutputs, foreign_layers, normalise_images
from trilitenet.models.weights import import_published

SUBSETS = [("detection",), ("drivable",), ("lane",), ("detection", "lane"), ("drivable", "lane"), TASKS]


@pytest.mark.parametrize(
    ("variant", "parameters", "multiply_adds"),
    [("tiny", 151_413, 0.517), ("small", 592_338, 1.948), ("base", 2_350_206, 7.685)],
)
def test_size_and_cost_are_the_published_ones(variant: str, parameters: int, multiply_adds: float) -> None:
    network = build_network(variant)
    assert count_parameters(network) == parameters
    assert round(count_multiply_adds(network, (384, 640)) / 1e9, 3) == multiply_adds


def test_ablations_have_the_sizes_of_the_papers_table() -> None:
    """Table "Ablation experiments": 0.45, 0.51, 0.55 and 0.59 M parameters for small."""
    steps = [
        build_network("small", pcaa=False, litepan=False, spp=False),
        build_network("small", litepan=False, spp=False),
        build_network("small", spp=False),
        build_network("small"),
    ]
    assert [round(count_parameters(network) / 1e6, 2) for network in steps] == [0.45, 0.51, 0.55, 0.59]


def test_single_tasks_have_the_sizes_of_the_papers_table() -> None:
    """Table "multi-tasking versus single-task": 0.47, 0.18 and 0.18 M parameters for small."""
    sizes = [round(count_parameters(build_network("small", tasks=(task,))) / 1e6, 2) for task in TASKS]
    assert sizes == [0.47, 0.18, 0.18]


def test_outputs_agree_with_the_published_network(golden: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    torch.save(published_state("tiny", golden), tmp_path / "tiny.pth")
    import_published(tmp_path / "tiny.pth", tmp_path / "tiny.safetensors")
    network = load_network(tmp_path / "tiny.safetensors")
    image = np.random.RandomState(0).uniform(-2, 2, (2, 3, 384, 640)).astype(np.float32)
    with torch.no_grad():
        outputs = network(torch.from_numpy(image))
        decoded = network.decode(outputs)
    for name, tensor in (("decoded", decoded), ("da", outputs.drivable), ("ll", outputs.lane)):
        assert tensor is not None
        assert tuple(tensor.shape) == tuple(golden[f"{name}_shape"])
        expected = golden[name]
        got = tensor.flatten().numpy()[golden[f"{name}_idx"]]
        assert np.linalg.norm(got - expected) / np.linalg.norm(expected) < 1e-4


@pytest.mark.parametrize("tasks", SUBSETS, ids="+".join)
@pytest.mark.parametrize("classes", [1, 2, 10])
def test_every_subset_of_tasks_and_any_class_count(tasks: tuple[str, ...], classes: int) -> None:
    network = build_network("tiny", classes, tasks).eval()
    with torch.no_grad():
        outputs = network(torch.zeros(2, 3, 64, 96))
    assert (outputs.detection is not None) == ("detection" in tasks)
    if outputs.detection is not None:
        assert [tuple(level.shape) for level in outputs.detection] == [
            (2, 3, 8, 12, 5 + classes),
            (2, 3, 4, 6, 5 + classes),
            (2, 3, 2, 3, 5 + classes),
        ]
        assert network.decode(outputs).shape == (2, 3 * (96 + 24 + 6), 5 + classes)
    else:
        with pytest.raises(ConfigError, match="without the detection task"):
            network.decode(outputs)
    for task, mask in (("drivable", outputs.drivable), ("lane", outputs.lane)):
        assert (mask is not None) == (task in tasks)
        if mask is not None:
            assert mask.shape == (2, 2, 64, 96)
    prefixes = {name.split(".")[0] for name, _ in network.named_parameters()}
    assert ("detection" in prefixes, "drivable" in prefixes, "lane" in prefixes) == tuple(t in tasks for t in TASKS)


@pytest.mark.parametrize("size", [(32, 32), (256, 448), (640, 640), (96, 1024)])
def test_any_multiple_of_32_is_a_legal_size(size: tuple[int, int]) -> None:
    with torch.no_grad():
        outputs = build_network("tiny").eval()(torch.zeros(1, 3, *size))
    assert outputs.drivable is not None
    assert outputs.drivable.shape == (1, 2, *size)


@pytest.mark.parametrize(
    "shape",
    [
        (1, 3, 360, 640),
        (1, 3, 384, 624),
        (3, 384, 640),
        (1, 1, 64, 64),
        (1, 384, 640, 3),
        (0, 3, 64, 64),
        (1, 3, 0, 64),
    ],
)
def test_any_other_shape_is_a_clear_error(shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match="multiples of 32"):
        build_network("tiny")(torch.zeros(shape))


@pytest.mark.parametrize(
    ("image", "told"),
    [
        (torch.zeros(1, 3, 64, 64, dtype=torch.uint8), r"as floats, got uint8; use trilitenet\..*normalise_images$"),
        (np.zeros((1, 3, 64, 64), np.float32), "takes a tensor of .*, got a ndarray"),
        ([torch.zeros(3, 64, 64)], "takes a tensor of .*, got a list"),
        (None, "takes a tensor of .*, got a NoneType"),
    ],
)
def test_pixels_and_what_is_no_tensor_are_refused_with_the_cure(image: Any, told: str) -> None:
    with pytest.raises(ShapeError, match=told):
        build_network("tiny").eval()(image)


def test_only_what_the_network_returned_is_decoded() -> None:
    network = build_network("tiny").eval()
    with torch.no_grad():
        outputs = network(torch.zeros(1, 3, 64, 64))
    for other in (outputs.detection, tuple(outputs), None):
        with pytest.raises(ShapeError, match=r"^decode takes what the network returned \(NetworkOutputs\), got a "):
            network.decode(other)  # type: ignore[arg-type]


def test_type_checkers_know_what_the_network_returns() -> None:  # mypy looks at the calls, as at a user's
    network = build_network("tiny", tasks=("lane",)).eval()
    outputs: int = network(torch.zeros(1, 3, 32, 32))  # type: ignore[assignment]
    assert isinstance(outputs, NetworkOutputs)


def test_bad_arguments_name_what_is_valid() -> None:
    with pytest.raises(ConfigError, match="tiny, small, base"):
        build_network("large")
    with pytest.raises(ConfigError, match="did you mean 'lane'"):
        build_network("tiny", tasks=("lanes",))
    for tasks in (5, None, [1]):
        with pytest.raises(ConfigError, match=r"unknown task .*; known: detection, drivable, lane"):
            build_network("tiny", tasks=tasks)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="unknown variant"):
        build_network(["tiny"])  # type: ignore[arg-type]


@pytest.mark.parametrize("classes", [0, "2", 1.5, None, ["car", "bus"]])
def test_a_class_count_that_is_none_is_refused(classes: Any) -> None:
    with pytest.raises(ConfigError, match=r"^classes must be how many there are, at least 1, got "):
        build_network("tiny", classes)


@pytest.mark.parametrize("anchors", [5, "abc", ((1, 2),), torch.ones(3, 3, 3), [[["a", 2]] * 3] * 3])
def test_anchors_that_are_no_sizes_are_refused_in_one_line(anchors: Any) -> None:
    with pytest.raises(ConfigError, match=r"^anchors must be 3 levels of 3 sizes, each a width and a height, got .*$"):
        build_network("tiny", anchors=anchors)


@pytest.mark.parametrize("kind", [torch.tensor, np.array, list])
def test_anchors_may_be_a_tensor_an_array_or_lists_and_are_kept_as_numbers(kind: Any) -> None:
    assert build_network("tiny", np.int64(2), anchors=kind(DEFAULT_ANCHORS)).card.anchors == DEFAULT_ANCHORS


def test_type_checkers_take_anchors_as_lists_and_as_arrays() -> None:  # mypy looks at the calls, as at a user's
    lists = [[(8, 6), [16, 12.5], (22, 18)]] * 3
    array = np.array(lists)
    assert build_network("tiny", anchors=lists).card.anchors == build_network("tiny", anchors=array).card.anchors


def test_shapes_are_told_without_computing() -> None:
    with torch.device("meta"):
        outputs = build_network("base").train()(torch.zeros(2, 3, 64, 96))
    assert outputs.lane is not None
    assert outputs.lane.shape == (2, 2, 64, 96)


def test_decode_by_hand() -> None:
    """One hot cell a level, worked out by the formulas of `decode_level`; order: level, anchor, row, column."""
    network = build_network("tiny", anchors=(((8, 6),) * 3, ((30, 20),) * 3, ((90, 60),) * 3))
    levels = [torch.zeros(1, 3, height, width, 6) for height, width in ((8, 8), (4, 4), (2, 2))]
    levels[0][0, 2, 1, 3] = torch.tensor([2.0, -2.0, 1.0, -1.0, 3.0, 0.5])
    decoded = network.decode(NetworkOutputs((levels[0], levels[1], levels[2]), None, None))
    sigmoid = 1 / (1 + np.exp(-np.array([2.0, -2.0, 1.0, -1.0, 3.0, 0.5])))
    expected = [
        (2 * sigmoid[0] - 0.5 + 3) * 8,
        (2 * sigmoid[1] - 0.5 + 1) * 8,
        (2 * sigmoid[2]) ** 2 * 8,
        (2 * sigmoid[3]) ** 2 * 6,
        sigmoid[4],
        sigmoid[5],
    ]
    np.testing.assert_allclose(decoded[0, 2 * 64 + 1 * 8 + 3].numpy(), expected, rtol=1e-5)
    # All-zero logits: the centre of the cell, the anchor itself; the last row is level 1/32, cell (1, 1).
    np.testing.assert_allclose(decoded[0, -1].numpy(), [48, 48, 90, 60, 0.5, 0.5], rtol=1e-6)


def test_boxes_are_decoded_in_full_precision() -> None:
    logits = torch.full((1, 3, 1, 1, 6), 0.3, dtype=torch.bfloat16)
    decoded = decode_level(logits, torch.tensor([[90.0, 60.0]] * 3), 32)
    assert decoded.dtype is torch.float32
    sigmoid = 1 / (1 + np.exp(-float(logits[0, 0, 0, 0, 0])))
    expected = [(2 * sigmoid - 0.5) * 32] * 2 + [4 * sigmoid**2 * 90, 4 * sigmoid**2 * 60, sigmoid, sigmoid]
    np.testing.assert_allclose(decoded[0, 0].numpy(), expected, rtol=1e-5)


def test_the_card_names_what_the_network_has() -> None:
    assert build_network("tiny").card.class_names == ("vehicle",)
    assert build_network("tiny", 2).card.class_names == ("class_0", "class_1")
    for tasks, blocks in ((("lane",), ("pcaa",)), (("detection",), ("litepan", "spp"))):
        network = build_network("tiny", tasks=tasks)
        assert network.blocks == network.card.blocks == blocks
    assert build_network("tiny", tasks="lane").tasks == ("lane",)


@pytest.mark.parametrize("variant", VARIANTS)
def test_initial_objectness_is_rare(variant: str) -> None:
    network = build_network(variant, classes=2).eval()
    with torch.no_grad():
        decoded = network.decode(network(torch.zeros(1, 3, 64, 64)))
    assert decoded[..., 4].mean() < 0.1


def test_normalise_images_is_per_channel_rgb() -> None:
    image = torch.tensor([255, 0, 128], dtype=torch.uint8).view(1, 3, 1, 1)
    expected = (np.array([1, 0, 128 / 255]) - IMAGE_MEAN) / np.array(IMAGE_STD)
    np.testing.assert_allclose(normalise_images(image).flatten().numpy(), expected, rtol=1e-5)


def test_what_is_given_is_left_as_it_is() -> None:
    pixels = torch.full((1, 3, 4, 4), 100.0)
    assert not torch.equal(normalise_images(pixels), pixels)
    assert torch.equal(pixels, torch.full_like(pixels, 100.0))
    network = build_network("tiny").train()
    network.encoder.eval()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    count_multiply_adds(network, (64, 64))
    torch.testing.assert_close(network.state_dict(), before, rtol=0, atol=0)
    assert network.training
    assert not network.encoder.training


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("part", ["pcaa", "litepan", "spp"])
def test_no_layer_of_a_network_as_built_is_foreign(variant: str, part: str) -> None:
    left_out: dict[str, Any] = {part: False}
    assert foreign_layers(build_network(variant, 3, **left_out)) == []


def test_widths_and_the_number_of_blocks_are_free() -> None:
    network = build_network("tiny")
    network.encoder.level2.append(DepthwiseESP(16))
    network.lane = SegmentationHead(8, 8, 16)
    assert foreign_layers(network) == []


class Scaled(PCAA):
    """Attention of other arithmetic with the same tensors."""


@pytest.mark.parametrize(
    ("name", "layer"),
    [
        ("pcaa", Scaled(64)),
        ("encoder.pool", nn.MaxPool2d(3, 2, 1)),
        ("encoder.level1.act", nn.ReLU()),
        ("encoder.b1", nn.Sequential(ConvBNPReLU(7, 8), ConvBNPReLU(8, 8))),
        ("encoder.b1.bn", nn.BatchNorm2d(8)),  # another eps
        ("encoder.level2.0.d2.depthwise", DilatedConv(3, 3, 3, dilation=2)),  # dense
        ("encoder.b1.conv", nn.Conv2d(7, 8, 3, padding=1, padding_mode="reflect", bias=False)),
        ("reduce.conv", nn.Conv2d(64, 16, 3, padding=1, groups=2, bias=False)),
        ("lane.out.deconv", nn.ConvTranspose2d(4, 2, 2, 2)),  # with a bias
    ],
)
def test_layers_that_compute_something_else_are_named(name: str, layer: nn.Module) -> None:
    network = build_network("tiny")
    outer, _, last = name.rpartition(".")
    setattr(network.get_submodule(outer), last, layer)
    assert foreign_layers(network) == [f"{name} ({type(layer).__name__})"]


def test_a_forward_of_its_own_is_named() -> None:
    network = build_network("tiny")
    assert network.pcaa is not None
    network.pcaa.forward = lambda x: x  # type: ignore[method-assign]
    assert foreign_layers(network) == ["pcaa (PCAA)"]
