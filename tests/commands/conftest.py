from __future__ import annotations

from typing import Any

import pytest

from tests.artefacts import Artefacts
from trilitenet.config import ARTEFACT_KEY, CARD_KEY, ArtefactInfo, ModelCard, Thresholds
from trilitenet.deploy import onnx as deploy_onnx


@pytest.fixture
def traced(artefacts: Artefacts, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the artefacts' weights, whose graph for the artefacts' size is there: PyTorch takes seconds to trace it.

    What comes after the tracing is as ever; tests of formats, sizes and layouts trace.
    """
    onnx = pytest.importorskip("onnx")

    def build(_graph: object, card: ModelCard, info: ArtefactInfo, *, nms: Thresholds | None, half: bool) -> Any:
        assert not half
        model = onnx.load(str(artefacts.folder / "model.onnx"))
        if nms is not None:
            deploy_onnx._append_nms(onnx, model, card.classes, nms)
        onnx.helper.set_model_props(model, {CARD_KEY: card.to_json(), ARTEFACT_KEY: info.to_json()})
        return model

    monkeypatch.setattr("trilitenet.commands.export.build_onnx", build)
    return str(artefacts.folder / "weights.safetensors")
