from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from trilitenet.commands.export import export
from trilitenet.errors import OutputError


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
