"""NCNN on exported artefacts: parity, its three files, refusals, and no PyTorch."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trilitenet
from tests.artefacts import SIZE, Artefacts, check_backend
from trilitenet.config import ARTEFACT_KEY, CARD_KEY, GRAPH_HASH_KEY
from trilitenet.errors import BackendError, ConfigError, ShapeError, WeightsError
from trilitenet.inference.ncnn_backend import NcnnBackend

pytest.importorskip("ncnn")
pytest.importorskip("pnnx")

Change = Callable[[dict[str, Any]], Any]


@pytest.fixture
def copied(artefacts: Artefacts, tmp_path: Path) -> Path:
    for file in artefacts.folder.glob("model.ncnn.*"):
        shutil.copy(file, tmp_path)
    return tmp_path / "model.ncnn.param"


def test_equals_the_network(artefacts: Artefacts) -> None:
    backend = NcnnBackend(artefacts.folder / "model.ncnn.param", threads=1)
    assert backend.name == "ncnn cpu fp32"
    check_backend(backend, artefacts)


def test_load_finds_it(artefacts: Artefacts, copied: Path) -> None:
    assert trilitenet.load(copied).backend.name == "ncnn cpu fp32"
    assert trilitenet.load(str(copied.parent), backend="ncnn", threads=1).backend.canvas == SIZE
    with pytest.raises(ConfigError, match="runs on ncnn, not on openvino"):
        trilitenet.load(copied, backend="openvino")
    with pytest.raises(ConfigError, match="trilitenet export"):
        trilitenet.load(artefacts.folder / "weights.safetensors", backend="ncnn")
    shutil.copy(copied, copied.with_name("other.param"))
    with pytest.raises(WeightsError, match=r"2 \.param files"):
        trilitenet.load(copied.parent)


def test_refusals(artefacts: Artefacts) -> None:
    path = artefacts.folder / "model.ncnn.param"
    with pytest.raises(ShapeError, match="128x64"):
        NcnnBackend(path).run(np.zeros((1, 96, 128, 3), np.uint8))
    with pytest.raises(BackendError, match="runs on the CPU"):
        NcnnBackend(path, "cuda")
    with pytest.raises(ConfigError, match="precision"):
        NcnnBackend(path, precision="bf16")


@pytest.mark.parametrize(("half", "precision"), [(True, "fp16"), (False, "fp32")])
def test_halves_are_for_processors_that_compute_in_them(
    artefacts: Artefacts, half: bool, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ncnn.cpu_support_arm_asimdhp", lambda: half)
    assert NcnnBackend(artefacts.folder / "model.ncnn.param", precision="fp16").precision == precision
    assert NcnnBackend(artefacts.folder / "model.ncnn.param").precision == "fp32"


@pytest.mark.parametrize("suffix", [".param", ".bin", ".json"])
def test_a_file_that_is_missing_or_broken_is_one_line(copied: Path, suffix: str) -> None:
    file = copied.with_suffix(suffix)
    content = file.read_bytes()
    # Cut short, foreign, and for the layers, whole at the start but not to the end.
    reasons = {".param": "not a usable NCNN model|not the graph", ".bin": "not the weights", ".json": "not JSON"}
    for broken in (content[: len(content) // 2], b"not a model\n" * 20, b""):
        file.write_bytes(broken)
        with pytest.raises(WeightsError, match=reasons[suffix]) as caught:
            NcnnBackend(copied)
        assert "\n" not in str(caught.value)
    file.unlink()
    with pytest.raises(WeightsError, match="no such file") as caught:
        NcnnBackend(copied)
    assert ("it belongs beside" in str(caught.value)) == (suffix != ".param")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda found: [found], "not an object"),
        (lambda found: {}, "no 'trilitenet.card' in its metadata"),
        (lambda found: found | {ARTEFACT_KEY: found[ARTEFACT_KEY] | {"schema": 99}}, "schema 99 is newer"),
        (lambda found: found | {CARD_KEY: found[CARD_KEY] | {"schema": 99}}, "upgrade trilitenet"),
        (lambda found: found | {CARD_KEY: "x"}, "model.ncnn.json"),
    ],
)
def test_foreign_and_newer_metadata_is_refused(copied: Path, change: Change, message: str) -> None:
    side = copied.with_suffix(".json")
    side.write_text(json.dumps(change(json.loads(side.read_text(encoding="utf-8")))), encoding="utf-8")
    with pytest.raises(WeightsError, match=message) as caught:
        NcnnBackend(copied)
    assert "\n" not in str(caught.value)


def test_a_piece_of_a_graph_is_refused(copied: Path) -> None:
    lines = copied.read_text(encoding="utf-8").splitlines(keepends=True)
    copied.write_text("".join(lines[: len(lines) // 2]), encoding="utf-8")
    with pytest.raises(WeightsError, match=r"model\.ncnn\.param: not the graph that model\.ncnn\.json was written for"):
        NcnnBackend(copied)


def test_a_graph_without_a_task_is_refused(copied: Path) -> None:
    graph = copied.read_text(encoding="utf-8").replace(" lane ", " road ")
    copied.write_text(graph, encoding="utf-8")
    side = copied.with_suffix(".json")
    found = json.loads(side.read_text(encoding="utf-8"))
    found[GRAPH_HASH_KEY] = hashlib.sha256(graph.encode()).hexdigest()
    side.write_text(json.dumps(found), encoding="utf-8")
    with pytest.raises(WeightsError, match="has no lane"):
        NcnnBackend(copied)


def test_prediction_needs_no_torch(artefacts: Artefacts) -> None:
    code = (
        "import sys, numpy, trilitenet\n"
        f"predictor = trilitenet.load({str(artefacts.folder / 'model.ncnn.param')!r}, threads=1)\n"
        "perception = predictor(numpy.zeros((90, 160, 3), numpy.uint8))\n"
        "assert perception.lane.shape == (90, 160)\n"
        "assert predictor.class_names == ('class_0', 'class_1')\n"
        "heavy = {'torch', 'pnnx', 'onnx', 'openvino', 'onnxruntime'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    assert not done.stderr


def test_without_ncnn_the_extra_is_named(artefacts: Artefacts, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ncnn", None)
    with pytest.raises(trilitenet.errors.MissingExtraError, match=r"trilitenet\[ncnn\]"):
        NcnnBackend(artefacts.folder / "model.ncnn.param")
