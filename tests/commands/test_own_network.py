"""A network with a block of one's own, as docs/network.md has it, in every command that takes a model."""

from __future__ import annotations

import dataclasses
import importlib
import json
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import trilitenet
from trilitenet.apps.cli import main
from trilitenet.commands.benchmark import benchmark
from trilitenet.commands.evaluate import evaluate
from trilitenet.commands.export import export
from trilitenet.commands.train import train
from trilitenet.commands.train_table import train_table
from trilitenet.commands.weights import finish
from trilitenet.config import VARIANTS
from trilitenet.data.synthetic_files import write_dataset
from trilitenet.engine.checkpoint import read_checkpoint
from trilitenet.engine.train import TrainResult
from trilitenet.errors import ConfigError, WeightsError
from trilitenet.models.builders import build_by
from trilitenet.models.cost import count_parameters
from trilitenet.models.trilitenet import foreign_layers
from trilitenet.models.weights import load_network, read_builder, read_card, save_network

pytest.importorskip("lightning_fabric")

PAGE = Path(__file__).resolve().parents[2] / "docs" / "network.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return the working folder of somebody who has the page's file, and scenes to train on."""
    root = tmp_path_factory.mktemp("own")
    (code,) = re.findall(r"^```python\n(# blocks\.py\n.*?)^```$", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    (root / "blocks.py").write_text(code, encoding="utf-8")
    write_dataset(root / "scenes", "train", 8, 0, size=(96, 160))
    write_dataset(root / "scenes", "val", 2, 1, size=(96, 160))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        yield root


def settings(output: str, **more: Any) -> dict[str, Any]:
    return {
        "data": "scenes",
        "output": output,
        "network": "blocks.py:excited",
        "init": "tiny",
        "input_size": (64, 128),
        "batch_size": 4,
        "epochs": 10,
        "max_steps": 2,
        "workers": 0,
        "val_split": "",
        "device": "cpu",
        "precision": "32-true",
        "loggers": (),
        **more,
    }


@pytest.fixture(scope="module")
def excited(folder: Path) -> TrainResult:
    return train(**settings("excited"))


def test_it_is_trained_and_its_weights_tell_of_it(excited: TrainResult) -> None:
    card = read_card(excited.weights)
    assert card.provenance["network"] == read_builder(excited.weights) == "blocks.py:excited"
    network = load_network(excited.weights, "blocks.py:excited")
    assert foreign_layers(network) == ["pcaa (SqueezeExcitation)"]
    near, started = network.encoder.b2.conv.weight, load_network("tiny").encoder.b2.conv.weight
    assert 0 < (near - started).abs().max() < 0.01  # two steps away from the initial weights


def test_it_goes_on_as_if_it_had_never_stopped_and_as_no_other(excited: TrainResult) -> None:
    train(**settings("parts", max_steps=1))
    with pytest.raises(WeightsError, match=r"network 'blocks\.py:excited', this run has 'blocks\.py:deeper'"):
        train(resume=True, **settings("parts", network="blocks.py:deeper"))
    train(resume=True, **settings("parts"))
    straight, parts = (read_checkpoint(Path(name) / "last.ckpt")["network"] for name in (excited.folder, "parts"))
    assert all(torch.equal(straight[name], parts[name]) for name in straight)


def test_a_decoder_of_ones_own_takes_the_place_of_one(folder: Path) -> None:
    for tasks, layers in ((("drivable", "lane"), ["lane (Upsampled)"]), (("drivable",), [])):
        network = build_by("blocks.py:decoded", "tiny", 1, tasks, size=(64, 96))
        assert foreign_layers(network) == layers


def write(folder: Path, name: str, block: str, where: str = "pcaa") -> str:
    """Write a function that builds a network with a block in it; return its name."""
    text = "import torch\nfrom torch import nn\nfrom trilitenet import build_network\n"
    text += f"class Block(nn.Module):\n{textwrap.indent(textwrap.dedent(block), '    ')}\n"
    text += "def build(*args, **options):\n    network = build_network(*args, **options)\n"
    (folder / name).write_text(f"{text}    network.{where} = Block()\n    return network\n")
    return f"{name}:build"


FAULTS_IN_TRAINING: dict[str, tuple[str, dict[str, Any], str]] = {
    "statistics of one value": (
        """
        def __init__(self):
            super().__init__()
            self.mean = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.BatchNorm2d(64))
        def forward(self, x):
            return x + self.mean(x)
        """,
        {"batch_size": 1},
        r"faulty\.py:10: in pcaa\.mean\.1: ValueError: Expected more than 1 value per channel",
    ),
    "another size": (
        """
        def __init__(self):
            super().__init__()
            self.place = nn.Parameter(torch.zeros(64, 8, 16))
        def forward(self, x):
            return x + self.place
        """,
        {"multi_scale": (2.0, 2.0)},
        r"faulty\.py:10: in pcaa: RuntimeError: The size of tensor a \(32\)",  # but not that of the run
    ),
    "changed in place": (
        """
        def forward(self, x):
            y = x.sigmoid()
            return y.mul_(2)
        """,
        {},
        r"^faulty\.py:build: in the backward pass: RuntimeError: one of the variables",
    ),
}


@pytest.mark.parametrize("what", FAULTS_IN_TRAINING)
def test_what_a_network_raises_in_training_is_one_line(folder: Path, tmp_path: Path, what: str) -> None:
    block, more, message = FAULTS_IN_TRAINING[what]
    with pytest.raises(ConfigError, match=message) as caught:
        train(**settings(str(tmp_path), network=write(folder, "faulty.py", block), **more))
    assert "\n" not in str(caught.value)


def test_a_part_of_ones_own_is_frozen_as_its_function_gives_it_but_not_at_random(folder: Path, tmp_path: Path) -> None:
    block = """
    def __init__(self):
        super().__init__()
        self.learnt = nn.Conv2d(64, 64, 1)
    def forward(self, x):
        return x + self.learnt(x)
    """
    options = settings(str(tmp_path), network=write(folder, "own_pcaa.py", block), freeze=("pcaa",), max_steps=1)
    with pytest.raises(ConfigError, match=r"--freeze pcaa: 2 of its 2 tensors .* \(learnt\.weight, learnt\.bias\)"):
        train(**options)
    text = (folder / "own_pcaa.py").read_text()
    loaded = "    for parameter in network.pcaa.parameters():\n        nn.init.constant_(parameter, 0.01)\n"
    (folder / "own_pcaa.py").write_text(text.replace("    return network", f"{loaded}    return network"))
    assert train(**options).finished


def test_a_function_itself_is_refused_by_the_name_to_give(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(folder))
    write(folder, "imported_blocks.py", "def forward(self, x):\n    return x\n")
    build = importlib.import_module("imported_blocks").build
    with pytest.raises(ConfigError, match=r"^network takes a name here, .*: 'imported_blocks\.py:build'$"):
        train(**settings(str(tmp_path), network=build))
    with pytest.raises(ConfigError, match=r"^network takes a name here, .*: 'FILE\.py:FUNCTION'$"):
        train(**settings(str(tmp_path), network=lambda *args, **options: build(*args, **options)))


def test_it_is_what_another_run_starts_from_and_learns_from(excited: TrainResult) -> None:
    again = train(**settings("again", init=str(excited.weights), teacher=str(excited.weights), max_steps=1))
    assert read_card(again.weights).provenance["initial weights"] == excited.weights.name
    with pytest.raises(WeightsError, match=r"is of a network that blocks\.py:excited builds"):
        train(**settings("ordinary", network=None, init=str(excited.weights)))


def test_it_is_measured_and_predicts(excited: TrainResult, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights = str(excited.weights)
    report = evaluate(weights, network="blocks.py:excited", data="scenes", resamples=0, worst=0)
    assert report.figures
    picture = sorted((folder / "scenes/images/val").iterdir())[0]
    words = ["predict", str(picture), "--model", weights, "--output", "results"]
    assert main([*words, "--network", "blocks.py:excited"]) == 0
    assert json.loads((folder / "results" / f"{picture.stem}.json").read_text())["size"]
    capsys.readouterr()
    assert main([*words, "--overwrite"]) == 1
    assert "--network blocks.py:excited" in capsys.readouterr().err
    with trilitenet.load(weights, network="blocks.py:excited", device="cpu") as predictor:
        image = np.asarray(Image.open(picture))
        drivable = predictor(image).drivable
        network = load_network(weights, "blocks.py:excited")
        with trilitenet.load(weights, network=lambda *a, **o: build_by("blocks.py:excited", *a, **o)) as other:
            np.testing.assert_array_equal(other(image).drivable, drivable)
    assert network.built_by == "blocks.py:excited"


def test_on_cuda_it_is_the_network_itself(excited: TrainResult, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trilitenet.inference.torch_backend.pick_device", lambda _: torch.device("cuda"))
    monkeypatch.setattr("trilitenet.inference.torch_backend.TorchBackend", lambda network, _: network)
    from trilitenet.commands.load import open_backend

    network: Any = open_backend(excited.weights, "cuda", "auto", network="blocks.py:excited")
    assert foreign_layers(network) == ["pcaa (SqueezeExcitation)"]


def test_it_is_finished_for_use(excited: TrainResult) -> None:
    card = finish(excited.weights, "finished.safetensors", data="scenes", network="blocks.py:excited")
    assert card.metrics
    assert read_builder("finished.safetensors") == "blocks.py:excited"
    assert load_network("finished.safetensors", "blocks.py:excited").card == card


def test_what_it_costs_stands_beside_the_network_as_it_is(excited: TrainResult) -> None:
    costs = {cost.model: cost for cost in benchmark(table="cost", size=(64, 128), network="blocks.py:excited").costs}
    assert list(costs) == [name for variant in VARIANTS for name in (variant, f"{variant}, blocks.py:excited")]
    network = load_network(excited.weights, "blocks.py:excited")
    assert costs["tiny, blocks.py:excited"].parameters == count_parameters(network) < costs["tiny"].parameters
    plain, own = benchmark("tiny", excited.weights, table="cost", network="blocks.py:excited").costs
    assert (own.model, own.parameters) == (excited.weights.name, count_parameters(network))
    assert plain.parameters == costs["tiny"].parameters
    timed = benchmark("tiny", str(excited.weights), network="blocks.py:excited", rounds=1, warmup=0, size=(64, 128))
    assert [row.model for row in timed.timings] == ["tiny", excited.weights.name]


def test_rows_of_a_table_have_networks_of_their_own(folder: Path) -> None:
    (folder / "own.yaml").write_text("network: blocks.py:deeper\nvariant: tiny\n")
    (folder / "table.yaml").write_text("title: Blocks\nrows: {Deeper: own.yaml}\n")
    plain = {key: value for key, value in settings("").items() if key not in {"data", "output", "network", "max_steps"}}
    result = train_table("table.yaml", data="scenes", output="table", settings=json.dumps({**plain, "max_steps": 1}))
    assert [row.name for row in result.rows] == ["Deeper"]
    assert result.rows[0].parameters > count_parameters(load_network("tiny"))


def test_other_widths_and_numbers_of_blocks_are_exported_and_other_layers_are_not(excited: TrainResult) -> None:
    pytest.importorskip("ncnn")
    pytest.importorskip("pnnx")
    with pytest.raises(ConfigError, match=r"not pcaa \(SqueezeExcitation\); run the network itself on PyTorch"):
        export(excited.weights, network="blocks.py:excited", size="64x128")
    network = build_by("blocks.py:deeper", "tiny", 1, ("drivable",))
    save_network(network, "deeper.safetensors", dataclasses.replace(network.card, input_size=(64, 128)))
    done = export("deeper.safetensors", format="ncnn", network="blocks.py:deeper", size="64x128")
    assert done.parity is not None
    assert done.parity.failures == []
    with pytest.raises(ConfigError, match=r"deeper.*: is an exported file, which holds its network; leave --net"):
        trilitenet.load(done.path, network="blocks.py:deeper")
    with trilitenet.load(done.path) as predictor:
        assert predictor.card.tasks == ("drivable",)
