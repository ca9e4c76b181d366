"""The deploy graph through pnnx, run by plain NCNN, against the network."""

from __future__ import annotations

import importlib.metadata
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.deploy.networks import lively_network
from trilitenet.config import CARD_KEY, ArtefactInfo, ModelCard
from trilitenet.deploy.graph import DeployGraph
from trilitenet.deploy.layouts import LAYOUTS
from trilitenet.deploy.ncnn import NcnnModel, build_ncnn, save_ncnn
from trilitenet.errors import BackendError, MissingExtraError, OutputError
from trilitenet.models.trilitenet import TriLiteNet

ncnn = pytest.importorskip("ncnn")
pnnx = pytest.importorskip("pnnx")

INFO = ArtefactInfo("ncnn", size=(64, 96), input="float_nchw", masks="logit", trilitenet="0")


def build(network: TriLiteNet, layout: str = "planar", precision: Any = "fp32") -> NcnnModel:
    info = ArtefactInfo("ncnn", precision, (64, 96), "float_nchw", masks="logit", trilitenet="0")
    return build_ncnn(DeployGraph(network, LAYOUTS[layout], masks="logit"), network.card, info)


def run_plain(path: Path, pixels: np.ndarray, outputs: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Run it as NCNN's own documentation does."""
    with ncnn.Net() as net:
        net.opt.num_threads = 1
        assert net.load_param(str(path)) == 0
        assert net.load_model(str(path.with_suffix(".bin"))) == 0
        assert list(net.output_names()) == list(outputs)
        with net.create_extractor() as extractor:
            extractor.input("image", ncnn.Mat(pixels))
            return {name: np.array(extractor.extract(name)[1]) for name in outputs}


CASES = [
    pytest.param("tiny", {"classes": 10}, id="tiny-10-classes"),
    pytest.param("small", {}, id="small"),
    pytest.param("base", {}, id="base"),
    pytest.param("tiny", {"tasks": ("detection",)}, id="detection-alone"),
    pytest.param("tiny", {"tasks": ("drivable",)}, id="drivable-alone"),
    pytest.param("tiny", {"tasks": ("lane",), "pcaa": False}, id="lane-alone-without-pcaa"),
]


@pytest.mark.parametrize(("variant", "options"), CASES)
def test_plain_ncnn_computes_the_graph(
    tmp_path: Path, rng: np.random.Generator, variant: str, options: dict[str, Any]
) -> None:
    network = lively_network(variant, **options)
    save_ncnn(build(network), tmp_path / "a.ncnn.param", network.card, INFO)
    pixels = rng.integers(0, 256, (3, 64, 96)).astype(np.float32)
    got = run_plain(tmp_path / "a.ncnn.param", pixels, network.card.tasks)
    graph = DeployGraph(network, LAYOUTS["planar"], masks="logit")
    with torch.no_grad():
        wanted = graph(torch.from_numpy(pixels)[None])
    for task in network.card.tasks:
        expected = getattr(wanted, task)[0].numpy()
        assert got[task].shape == expected.shape
        scale = np.abs(expected).max()
        assert np.abs(got[task] - expected).max() < 2e-4 * scale, task


def test_files_and_metadata(tmp_path: Path) -> None:
    network = lively_network()
    full, half = build(network), build(network, precision="fp16")
    assert len(half.weights) < 0.8 * len(full.weights)
    assert full.param.startswith("7767517\n")
    save_ncnn(full, tmp_path / "a.ncnn.param", network.card, INFO)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.ncnn.bin", "a.ncnn.json", "a.ncnn.param"]
    found = json.loads((tmp_path / "a.ncnn.json").read_text(encoding="utf-8"))
    assert ModelCard.from_json(json.dumps(found[CARD_KEY]), "a") == network.card


@pytest.mark.skipif(importlib.metadata.version("pnnx") < "20261020", reason="older ones know how to express it")
def test_a_layout_beyond_ncnn_is_one_line() -> None:
    with pytest.raises(BackendError, match="leave --layout alone"):
        build(lively_network(tasks=("lane",)), "planar-maximum-heads")


def test_pnnx_that_fails_or_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network = lively_network(tasks=("lane",))
    broken = tmp_path / "pnnx"
    script = "touch graph.ncnn.param graph.ncnn.bin\necho first >&2\necho out of order >&2\nexit 3\n"
    broken.write_text(f"#!/bin/sh\n{script}", encoding="utf-8")
    broken.chmod(0o755)
    monkeypatch.setattr(pnnx, "EXEC_PATH", str(broken))
    with pytest.raises(BackendError, match="exit status 3: out of order"):
        build(network)
    script = "echo 7767518 > graph.ncnn.param\necho 0 0 >> graph.ncnn.param\ntouch graph.ncnn.bin\n"
    broken.write_text(f"#!/bin/sh\n{script}", encoding="utf-8")
    with pytest.raises(BackendError, match="of another layout"):
        build(network)
    monkeypatch.setattr(pnnx, "EXEC_PATH", str(tmp_path / "nothing"))
    with pytest.raises(BackendError, match="pnnx does not run here"):
        build(network)
    monkeypatch.setitem(sys.modules, "pnnx", None)
    with pytest.raises(MissingExtraError, match=r"trilitenet\[ncnn\]"):
        build(network)


def test_no_room_for_temporary_files_is_told(no_room: str) -> None:
    # PyTorch aborts the process where it cannot write: it never gets the file.
    with pytest.raises(OutputError, match=no_room):
        build(lively_network("tiny"))
