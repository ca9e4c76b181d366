"""Exported artefacts for tests, made once for all processes of a session."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock
from numpy.typing import NDArray

from trilitenet.config import ArtefactInfo, Thresholds
from trilitenet.errors import BackendError
from trilitenet.inference.backend import Backend

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


def check_backend(backend: Any, artefacts: Artefacts, *, pixels: float = 0.9999, error: float = 0.01) -> None:
    """Check that an artefact computes what the network does on PyTorch, and nothing once it is closed; it is then.

    Args:
        backend: One of `SIZE`, of the artefacts' own weights.
        artefacts: The weights and the images.
        pixels: More than this part of mask pixels must agree.
        error: Numbers of boxes are less than this apart.
    """
    import torch

    from tests.deploy.test_graph import by_cell
    from trilitenet.inference.torch_backend import TorchBackend
    from trilitenet.models.weights import load_network

    network = load_network(artefacts.folder / "weights.safetensors")
    wanted = TorchBackend(network, "cpu").run(artefacts.images)
    assert isinstance(backend, Backend)
    assert backend.card == network.card
    assert backend.canvas == SIZE
    got = backend.run(artefacts.images)
    assert wanted.detection is not None
    assert got.detection is not None
    reordered = by_cell(torch.from_numpy(wanted.detection), *SIZE).numpy()
    assert np.abs(got.detection - reordered).max() < error
    for task, threshold in (("drivable", 0.5), ("lane", 0.49)):
        mask = getattr(got, task)
        assert mask.shape == (2, *SIZE)
        assert set(np.unique(mask)) <= {0, 255}
        assert np.mean((mask > 0) == (getattr(wanted, task) > int(threshold * 255))) > pixels
    backend.close()
    backend.close()
    with pytest.raises(BackendError, match="the model was closed; load it again"):
        backend.run(artefacts.images)


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
