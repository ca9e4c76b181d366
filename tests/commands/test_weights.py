"""The weights commands as a user meets them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from numpy.typing import NDArray

from tests.models.conftest import golden as golden
from tests.models.conftest import published_state
from trilitenet.commands.weights import import_weights, info
from trilitenet.errors import OutputError, WeightsError


@pytest.fixture
def published(golden: dict[str, NDArray[Any]], tmp_path: Path) -> Path:
    torch.save(published_state("tiny", golden), tmp_path / "published.pth")
    return tmp_path / "published.pth"


def test_import_then_info(published: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "ours.safetensors"
    card = import_weights(published, out)
    assert card.variant == "tiny"
    assert "tiny, 1 class(es), from published.pth" in capsys.readouterr().out

    assert info(str(out)).anchors[2][2] == (124.0, 412.0)
    text = capsys.readouterr().out
    for part in ("variant", "tiny", "124x412", "640x384", "published.pth"):
        assert part in text
    info(str(out), json_output=True)
    assert json.loads(capsys.readouterr().out)["class_names"] == ["vehicle"]


def test_an_existing_file_is_kept(published: Path, tmp_path: Path) -> None:
    out = tmp_path / "ours.safetensors"
    out.write_text("precious")
    with pytest.raises(OutputError, match="--overwrite"):
        import_weights(published, out)
    assert out.read_text() == "precious"
    import_weights(published, out, overwrite=True)
    assert info(str(out)).variant == "tiny"


def test_info_of_what_is_not_there() -> None:
    with pytest.raises(WeightsError, match="does not exist"):
        info("nowhere.safetensors")
