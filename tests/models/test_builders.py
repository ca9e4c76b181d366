"""Networks with blocks of one's own: found by name, checked, saved and loaded only where they are asked for."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from trilitenet.config import TASKS
from trilitenet.errors import ConfigError, WeightsError
from trilitenet.models.blocks import DepthwiseESP
from trilitenet.models.builders import build_by, name_of, telling
from trilitenet.models.trilitenet import TriLiteNet, build_network
from trilitenet.models.weights import load_network, read_builder, read_card, save_network

BEGINNING = "from torch import nn\nfrom trilitenet import build_network\n"


class Doubled(nn.Module):
    """A block without tensors: weights fit a network with it and one with nothing in its place alike."""

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        return 2 * x


def doubled(*args: Any, **options: Any) -> TriLiteNet:
    network = build_network(*args, **{**options, "pcaa": False})
    network.pcaa = Doubled()  # type: ignore[assignment]
    return network


def deeper(*args: Any, **options: Any) -> TriLiteNet:
    network = build_network(*args, **options)
    network.encoder.level2.append(DepthwiseESP(16))
    return network


def write(folder: Path, text: str, name: str = "blocks.py") -> str:
    (folder / name).write_text(BEGINNING + text)
    return f"{folder / name}:build"


def build(reference: str, classes: int = 1, tasks: tuple[str, ...] = TASKS) -> TriLiteNet:
    return build_by(reference, "tiny", classes, tasks, size=(64, 96), pcaa=True, litepan=True, spp=True, anchors=None)


def test_without_a_function_it_is_the_network_of_the_paper() -> None:
    torch.manual_seed(0)
    network = build_by(None, "tiny", 2, ("lane",))
    torch.manual_seed(0)
    same = build_network("tiny", 2, ("lane",)).state_dict()
    assert network.built_by is None
    assert all(torch.equal(tensor, same[name]) for name, tensor in network.state_dict().items())


@pytest.mark.parametrize(("classes", "tasks"), [(1, TASKS), (10, ("detection",)), (2, ("drivable",)), (2, ("lane",))])
def test_a_file_may_import_what_lies_beside_it(tmp_path: Path, classes: int, tasks: tuple[str, ...]) -> None:
    (tmp_path / "beside_blocks.py").write_text("from torch import nn\n\n\nclass Own(nn.Identity):\n    pass\n")
    text = "import beside_blocks\ndef build(*args, **options):\n    network = build_network(*args, **options)\n"
    text += "    network.spp = beside_blocks.Own()\n    return network\n"
    before = list(sys.path)
    network = build(write(tmp_path, text), classes, tasks)
    assert (network.classes, network.tasks) == (classes, tasks)
    assert network.built_by == f"{tmp_path / 'blocks.py'}:build"
    assert network.training
    assert sys.path == before


def test_a_function_of_a_module_or_itself() -> None:
    assert name_of(doubled) == f"{__name__}:doubled"
    assert build(name_of(doubled)).built_by == build_by(doubled, "tiny", 1, TASKS).built_by == name_of(doubled)


def test_trying_a_network_takes_no_random_numbers_and_moves_no_statistics(tmp_path: Path) -> None:
    text = "class Noise(nn.Dropout):\n    def forward(self, x):\n        return x + 0 * x.new_zeros(1).normal_()\n"
    text += "def build(*args, **options):\n    network = build_network(*args, **options)\n"
    text += "    network.spp = Noise()\n    return network\n"
    torch.manual_seed(0)
    build_network("tiny")
    after = torch.rand(1)
    torch.manual_seed(0)
    network = build(write(tmp_path, text))
    assert torch.equal(torch.rand(1), after)
    assert not network.reduce.bn.running_mean.any()  # type: ignore[union-attr]


RETURNS = "def build(*args, **options):\n    network = build_network(*args, **options)\n"
MISTAKES = {
    "no function named": ("blocks.py", "must be FILE.py:FUNCTION or MODULE:FUNCTION, got 'blocks.py'"),
    "no file": ("absent.py:build", r"absent\.py:build: absent\.py does not exist"),
    "a folder": ("folder.py:build", r"folder\.py is a folder"),
    "no module": ("blocks:build", "there is no module 'blocks'; a file is named as FILE.py:FUNCTION"),
    "no module in a package": ("trilitenet.absent:build", r"there is no module 'trilitenet\.absent'"),
}
FAULTS = {
    "another name": ("def built():\n    pass\n", "no function 'build' in it; did you mean 'built'"),
    "no function": ("build = 3\n", "no function 'build' in it"),
    "syntax": ("def build(:\n", r"blocks\.py:3: SyntaxError: "),
    "import": ("import absent_module\n", r"blocks\.py:3: ModuleNotFoundError: No module named 'absent_module'"),
    "in the file": ("nn.Absent\n", r"blocks\.py:3: AttributeError: .*Absent"),
    "in the function": ("def build(*args, **options):\n    return nn.Absent\n", r"blocks\.py:4: AttributeError: "),
    "nothing returned": ("def build(*args, **options):\n    pass\n", "returned NoneType, not a TriLiteNet"),
    "other classes": (
        "def build(variant, classes, tasks, **options):\n    return build_network(variant, 7, tasks)\n",
        "built 7 classes and detection, drivable, lane, asked for were 1 and detection, drivable, lane",
    ),
    "other tasks": (
        "def build(variant, classes, tasks, **options):\n    return build_network(variant, classes, 'lane')\n",
        "built 1 classes and lane, asked for were 1 and detection, drivable, lane",
    ),
    "an unknown option": ("def build(variant, classes, tasks):\n    pass\n", "TypeError: .*unexpected keyword"),
    "a variant that there is not": ("def build(*args, **options):\n    return build_network('huge')\n", "'huge'"),
    "channels that do not fit": (
        RETURNS + "    network.spp = nn.Conv2d(5, 64, 1)\n    return network\n",
        r"blocks\.py:build: in spp: RuntimeError: .*expected input.* to have 5 channels",
    ),
    "channels within a part": (
        RETURNS + "    network.pcaa = nn.Sequential(nn.Identity(), nn.Conv2d(7, 64, 1))\n    return network\n",
        r"blocks\.py:build: in pcaa\.1: RuntimeError: ",
    ),
    "called with more than it takes": (
        RETURNS + "    network.lane = nn.Sequential(nn.Identity())\n    return network\n",
        r"blocks\.py:build: in lane: TypeError: .*takes 2 positional arguments but 4 were given",
    ),
    "rows taken for columns": (
        "class Block(nn.Module):\n    def forward(self, x):\n        b, c, h, w = x.shape\n"
        "        return x.reshape(b, c, w, h) + x\n" + RETURNS + "    network.pcaa = Block()\n    return network\n",
        r"blocks\.py:6: in pcaa: RuntimeError: The size of tensor",
    ),
    "in its block": (
        "class Block(nn.Module):\n    def forward(self, x):\n        return x.absent\n"
        + RETURNS
        + "    network.spp = Block()\n    return network\n",
        r"blocks\.py:5: in spp: AttributeError: 'Tensor' object has no attribute 'absent'",
    ),
    "another size": (
        RETURNS + "    network.drivable.out = nn.Identity()\n    return network\n",
        r"drivable of a 96x64 image has the shape \(1, 4, 32, 48\), must be \(1, 2, 64, 96\)",
    ),
    "another kind of outputs": (
        "class Net(__import__('trilitenet').models.trilitenet.TriLiteNet):\n"
        "    def forward(self, image):\n        return tuple(super().forward(image))\n"
        "def build(variant, classes, tasks, anchors, **options):\n"
        "    return Net(variant, classes, tasks, ('pcaa',), build_network(variant).anchors)\n",
        "the network returns tuple, not NetworkOutputs",
    ),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_a_name_of_nothing_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("folder.py").mkdir()
    reference, message = MISTAKES[what]
    with pytest.raises(ConfigError, match=message) as caught:
        build(reference)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("what", FAULTS)
def test_what_is_wrong_with_the_code_is_one_line_with_its_place(tmp_path: Path, what: str) -> None:
    text, message = FAULTS[what]
    with pytest.raises(ConfigError, match=message) as caught:
        build(write(tmp_path, text))
    assert "\n" not in str(caught.value)


class Placed(nn.Module):
    """A block that fits one size of image alone."""

    def __init__(self, channels: int, height: int, width: int) -> None:
        super().__init__()
        self.place = nn.Parameter(torch.zeros(1, channels, height, width))

    def forward(self, x: Tensor) -> Tensor:
        """Apply the block."""
        return x + self.place


def placed(*args: Any, **options: Any) -> TriLiteNet:
    network = build_network(*args, **options)
    network.pcaa = Placed(64, 8, 16)  # type: ignore[assignment]
    return network


def test_a_network_is_tried_at_the_size_that_it_is_for(saved: Callable[[TriLiteNet], Path]) -> None:
    network = build_by(placed, "tiny", 1, ("lane",), size=(64, 128))
    network.card = dataclasses.replace(network.card, input_size=(64, 128))
    assert load_network(saved(network), placed).card.input_size == (64, 128)
    with pytest.raises(ConfigError, match="in pcaa: RuntimeError: The size of tensor"):
        build_by(placed, "tiny", 1, ("lane",))  # at that of its card


def test_what_a_running_network_raises_is_told_and_what_other_code_raises_is_left() -> None:
    network = build_by(placed, "tiny", 1, ("lane",), size=(64, 128)).train()
    told = r"test_builders\.py:\d+: in pcaa: RuntimeError: The size"
    with pytest.raises(ConfigError, match=told), telling("blocks.py:build", running=True):
        network(torch.zeros(2, 3, 128, 128))
    ordinary = build_network("tiny", tasks=("lane",))
    ordinary.pcaa = Placed(64, 8, 16)  # type: ignore[assignment]
    for wrong in (lambda: ordinary(torch.zeros(1, 3, 64, 64)), lambda: torch.zeros(2) + torch.zeros(3)):
        with pytest.raises(RuntimeError, match="The size of tensor"), telling("blocks.py:build", running=True):
            wrong()


@pytest.fixture
def saved(tmp_path: Path) -> Callable[[TriLiteNet], Path]:
    def save(network: TriLiteNet) -> Path:
        for parameter in network.parameters():
            nn.init.normal_(parameter, std=0.05)
        save_network(network, tmp_path / "net.safetensors", network.card)
        return tmp_path / "net.safetensors"

    return save


@pytest.mark.parametrize("function", [doubled, deeper])
def test_weights_come_back_where_the_function_is_named(
    saved: Callable[[TriLiteNet], Path], function: Callable[..., TriLiteNet]
) -> None:
    network = build_by(function, "tiny", 2, ("drivable", "lane"))
    path = saved(network)
    assert read_builder(path) == name_of(function)
    assert read_card(path).classes == 2
    loaded = load_network(path, function)
    assert loaded.built_by == load_network(path, name_of(function)).built_by == name_of(function)
    image = torch.rand(1, 3, 64, 96)
    with torch.no_grad():
        for found, wanted in zip(loaded(image)[1:], network.eval()(image)[1:], strict=True):
            assert isinstance(found, torch.Tensor)
            assert isinstance(wanted, torch.Tensor)
            assert torch.equal(found, wanted)
    with pytest.raises(WeightsError, match=rf"is of a network that {name_of(function)} builds; .*--network"):
        load_network(path)


def test_a_function_that_builds_other_layers_than_the_weights_are_of_is_refused(
    saved: Callable[[TriLiteNet], Path],
) -> None:
    ordinary = saved(build_network("tiny", pcaa=False))
    assert read_builder(ordinary) is None
    with pytest.raises(WeightsError, match=r"with no layers but those of build_network, .* builds one with pcaa \(Dou"):
        load_network(ordinary, doubled)  # whose tensors would fit
    with pytest.raises(WeightsError, match=r"missing encoder\.level2\.1"):
        load_network(ordinary, deeper)
    other = saved(build_by(doubled, "tiny", 1, TASKS))
    with pytest.raises(WeightsError, match=r"with pcaa \(Doubled\), .* builds one with no layers but those of"):
        load_network(other, deeper)
