"""Exported artefacts for tests, made once for all processes of a session."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock
from numpy.typing import NDArray

from trilitenet.config import ArtefactInfo, Thresholds

SIZE = (64, 128)


@dataclasses.dataclass(frozen=True)
class Artefacts:
    """Files of one small-input tiny network, and what it returns.

    Attributes:
        folder: Holds weights.safetensors, model.onnx, model.xml and, where NCNN is installed, model.ncnn.param.
        images: (2, 64, 128, 3) uint8 RGB.
    """

    folder: Path
    images: NDArray[np.uint8]


def shared_artefacts(folder: Path) -> Artefacts:
    """Return what is in a folder, which the first process to come makes."""
    with FileLock(folder.with_suffix(".lock")):
        if not folder.exists():
            part = folder.with_suffix(".part")
            part.mkdir(exist_ok=True)
            _make_artefacts(part)
            part.rename(folder)
    return Artefacts(folder, np.random.default_rng(0).integers(0, 256, (2, *SIZE, 3), np.uint8))


def _make_artefacts(folder: Path) -> None:
    pytest.importorskip("onnxscript")
    pytest.importorskip("openvino")
    from tests.deploy.networks import lively_network
    from trilitenet.deploy.graph import DeployGraph
    from trilitenet.deploy.layouts import LAYOUTS
    from trilitenet.deploy.onnx import build_onnx, save_onnx
    from trilitenet.deploy.openvino import build_openvino, save_openvino
    from trilitenet.models.weights import save_network

    network = lively_network(classes=2)
    card = dataclasses.replace(network.card, thresholds=Thresholds(confidence=0.4, lane=0.49), licence="MIT")
    network.card = card
    save_network(network, folder / "weights.safetensors", card)
    info = ArtefactInfo("onnx", size=SIZE, trilitenet="0")
    model = build_onnx(DeployGraph(network, LAYOUTS["vectors-tiny"]), card, info)
    save_onnx(model, folder / "model.onnx")
    info = dataclasses.replace(info, format="openvino", precision="bf16")
    save_openvino(build_openvino(model), folder / "model.xml", card, info)
    if importlib.util.find_spec("pnnx") is not None:
        from trilitenet.deploy.ncnn import build_ncnn, save_ncnn

        info = ArtefactInfo("ncnn", size=SIZE, input="float_nchw", masks="logit", trilitenet="0")
        graph = DeployGraph(network, LAYOUTS["planar"], masks="logit")
        save_ncnn(build_ncnn(graph, card, info), folder / "model.ncnn.param", card, info)
