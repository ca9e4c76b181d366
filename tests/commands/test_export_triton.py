from __future__ import annotations

import dataclasses
import shutil
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import trilitenet
from tests.artefacts import Artefacts
from tests.test_readme import ROOT, blocks
from trilitenet.commands import export as command
from trilitenet.commands.export import Exported, export
from trilitenet.errors import BackendError, OutputError
from trilitenet.models.weights import load_network, save_network


class _Client:
    """Answers as Triton does: the configuration of a model as JSON, and its graph on ONNX Runtime."""

    folder: Path

    def __init__(self, _url: str) -> None:
        pass

    def get_model_config(self, name: str) -> dict[str, Any]:
        from tests.deploy.test_triton import parse_config, triton_schema

        json_format = pytest.importorskip("google.protobuf.json_format")
        config = parse_config(triton_schema(), self.folder / name)
        mapping: dict[str, Any] = json_format.MessageToDict(config, preserving_proto_field_name=True)
        return mapping

    def infer(self, name: str, inputs: list[Any]) -> Any:
        (image,) = inputs
        pixels = np.frombuffer(image._get_binary_data(), {"UINT8": np.uint8, "FP32": np.float32}[image.datatype()])
        session = pytest.importorskip("onnxruntime").InferenceSession(self.folder / name / "1" / "model.onnx")
        values = session.run(None, {image.name(): pixels.reshape(image.shape())})
        outputs = dict(zip([output.name for output in session.get_outputs()], values, strict=True))
        return types.SimpleNamespace(as_numpy=outputs.get)


@pytest.mark.parametrize("options", [{}, {"nms": True}, {"bgr": True, "masks": "probability"}], ids=str)
def test_the_documented_client_gets_what_a_predictor_gives(
    artefacts: Artefacts, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: Any
) -> None:
    triton = pytest.importorskip("tritonclient.http")
    if "bgr" not in options:  # that and the masks are traced
        request.getfixturevalue("traced")
    network = load_network(artefacts.folder / "weights.safetensors")
    thresholds = dataclasses.replace(network.card.thresholds, confidence=0.004)  # it is sure of nothing
    weights = tmp_path / "tiny.safetensors"
    save_network(network, weights, dataclasses.replace(network.card, thresholds=thresholds))
    exported = export(weights, format="triton", output=tmp_path, size="64x128", **options)
    pixels = np.random.default_rng(0).integers(0, 256, (90, 160, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "photo.jpg")
    wanted = trilitenet.load(exported.path / "1" / "model.onnx", backend="onnxruntime")(tmp_path / "photo.jpg")
    assert len(wanted.boxes or ()) > 5
    assert wanted.drivable is not None
    assert 0 < wanted.drivable.mean() < 1
    (code,) = [block for block in blocks(ROOT / "docs" / "serving.md", "python") if "get_model_config" in block]
    monkeypatch.setattr(_Client, "folder", tmp_path, raising=False)
    monkeypatch.setattr(triton, "InferenceServerClient", _Client)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(code, "docs/serving.md, a client of Triton", "exec"), names)
    assert names["perception"].to_dict() == dict(wanted.to_dict(), source=None)


def test_a_triton_repository_holds_a_checked_graph_and_the_card(traced: str, tmp_path: Path) -> None:
    weights = shutil.copy(traced, tmp_path / "mine.safetensors")
    exported = export(str(weights), format="triton", output=tmp_path / "repository", size="64x128")
    assert exported.path == tmp_path / "repository" / "mine"
    assert exported.parity is not None
    assert not exported.parity.failures
    assert (exported.path / "1" / "model.onnx").stat().st_size > 100_000
    config = (exported.path / "config.pbtxt").read_text(encoding="utf-8")
    assert 'name: "mine"' in config
    assert "dims: [ 1, 64, 128, 3 ]" in config
    assert r"\"licence\": \"MIT\"" in config
    assert "tritonserver --model-repository" in exported.summary()
    with pytest.raises(OutputError, match="exists already"):
        export(str(weights), format="triton", output=tmp_path / "repository", size="64x128")


def test_what_is_not_written_is_named_as_the_user_knows_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def keep(_network: object, _built: object, _info: object, path: Path, _checks: object) -> Exported:
        raise BackendError(f"{path}: not written, it differs from the network")

    monkeypatch.setattr("trilitenet.commands.export.build_onnx", lambda *_, **__: None)
    monkeypatch.setattr("trilitenet.commands.export._keep", keep)
    with pytest.raises(BackendError) as caught:
        export("tiny", format="triton", output=tmp_path, size="64x96")
    assert str(caught.value) == f"{tmp_path / 'tiny'}: not written, it differs from the network"


def test_what_is_asked_of_a_graph_reaches_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}

    def build(_model: str, *, output: Path, **options: Any) -> Exported:
        asked.update(options)
        raise BackendError(f"{output}: not written")

    monkeypatch.setattr(command, "export", build)
    plain: dict[str, Any] = {
        "precision": "fp32", "size": None, "calibration": None, "calibration_frames": 500, "max_drop": None,
        "nms": False, "portable": False, "masks": None, "mask_scale": 1, "bgr": False, "layout": "auto", "frames": None,
        "network": None,
    }  # fmt: skip
    quantised: dict[str, Any] = {
        "precision": "int8", "size": "64x128", "calibration": tmp_path, "calibration_frames": 7, "max_drop": 1.0,
        "masks": "probability", "mask_scale": 2, "bgr": True, "layout": "pixels", "frames": tmp_path / "frames",
    }  # fmt: skip
    for options in (quantised, {"nms": True}, {"portable": True}):
        with pytest.raises(BackendError):
            export("tiny", format="triton", output=tmp_path / "repository", **options)
        assert asked == {"format": "onnx"} | plain | options
