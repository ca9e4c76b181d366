from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from trilitenet.commands import export as command
from trilitenet.commands.export import Exported, export
from trilitenet.errors import BackendError, OutputError


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
