from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.deploy.networks import lively_network
from trilitenet.config import ArtefactInfo, ModelCard, Thresholds
from trilitenet.deploy.graph import DeployGraph
from trilitenet.deploy.layouts import LAYOUTS, pick_layout
from trilitenet.deploy.onnx import build_onnx
from trilitenet.deploy.openvino import build_openvino, save_openvino, vector_unit, with_own_biases
from trilitenet.errors import OutputError
from trilitenet.inference.openvino_backend import openvino_core

openvino = pytest.importorskip("openvino")


def test_what_cannot_be_written_is_told_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "a.bin").mkdir()
    image = openvino.opset13.parameter([1, 3], np.float32)
    model = openvino.Model([openvino.opset13.relu(image)], [image], "a")
    with pytest.raises(OutputError, match=r"a\.xml: cannot be written .*is there room\?$"):
        save_openvino(model, tmp_path / "a.xml", ModelCard("tiny"), ArtefactInfo("openvino"))


@pytest.mark.parametrize(("precision", "bytes_each"), [("fp32", 4), ("bf16", 4), ("fp16", 2)])
def test_weights_of_fp16_are_stored_as_such(tmp_path: Path, precision: Any, bytes_each: int) -> None:
    image = openvino.opset13.parameter([1, 1000], np.float32)
    matrix = openvino.opset13.constant(np.random.default_rng(0).random((1000, 50), np.float32))
    model = openvino.Model([openvino.opset13.matmul(image, matrix, False, False)], [image], "a")
    save_openvino(model, tmp_path / "a.xml", ModelCard("tiny"), ArtefactInfo("openvino", precision))
    assert (tmp_path / "a.bin").stat().st_size == pytest.approx(50_000 * bytes_each, rel=0.01)


@pytest.mark.parametrize(
    ("flags", "unit"),
    [
        ("avx2 avx512f avx512_vnni amx_bf16 amx_int8", "amx"),
        ("avx2 avx512f amx_int8", "avx512"),
        ("avx2 avx512f", "avx512"),
        ("avx avx2", "other"),
        (None, "other"),
    ],
)
def test_what_the_processor_multiplies_with(flags: str | None, unit: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def read_text(path: Path, **_: str) -> str:
        if flags is None:
            raise FileNotFoundError(path)
        return f"model name : x\nflags : fpu {flags}\nbugs :\n"

    monkeypatch.setattr(Path, "read_text", read_text)
    assert vector_unit() == unit


@pytest.mark.parametrize("variant", ["tiny", "base"])
def test_cells_of_columns_are_views(variant: str) -> None:
    """Outside the attention, which regroups bins, nothing is copied to be laid out anew."""
    pytest.importorskip("onnx")
    if vector_unit() != "amx":
        pytest.skip("layouts of processors with matrix tiles")
    if openvino.__version__ < "2026":
        pytest.skip("older ones copy one map")
    network = lively_network(variant)
    graph = DeployGraph(network, pick_layout("auto", variant, "openvino", unit="amx"))
    info = ArtefactInfo("openvino", "bf16", (384, 640))
    model = build_openvino(build_onnx(graph, network.card, info))
    compiled = openvino_core(openvino).compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "bf16"})
    copying = [
        node.get_friendly_name()
        for node in compiled.get_runtime_model().get_ordered_ops()
        if node.get_rt_info()["layerType"].astype(str) in ("Transpose", "DepthToSpace")
    ]
    assert not [name for name in copying if not name.startswith("pcaa/")]


def test_convolutions_that_share_a_bias_get_their_own() -> None:
    pytest.importorskip("onnx")
    network = lively_network(tasks=("lane",))
    graph = DeployGraph(network, LAYOUTS["tiles-tiny"], thresholds=Thresholds(lane=0.4))
    shared = build_onnx(graph, network.card, ArtefactInfo("openvino", "bf16", (64, 128)))

    def biases(model: Any) -> list[str]:
        return [node.input[2] for node in model.graph.node if node.op_type == "Conv" and len(node.input) > 2]

    own = with_own_biases(shared)
    assert len(set(biases(shared))) < len(biases(shared)) == len(set(biases(own)))
    values = [{entry.name: entry.raw_data for entry in model.graph.initializer} for model in (shared, own)]
    assert [values[0][name] for name in biases(shared)] == [values[1][name] for name in biases(own)]
