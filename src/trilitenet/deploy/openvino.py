"""The deploy graph as OpenVINO IR, by way of ONNX, with the same metadata."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, WEIGHTS_HASH_KEY, ArtefactInfo, ModelCard
from trilitenet.deploy.layouts import Unit
from trilitenet.errors import OutputError, gist, import_extra
from trilitenet.processing.cores import processor

__all__ = ["build_openvino", "save_openvino", "vector_unit", "with_own_biases"]


def build_openvino(model: Any) -> Any:
    """Convert an ONNX model in memory.

    Args:
        model: What `trilitenet.deploy.onnx.build_onnx` returned.

    Returns:
        An ``openvino.Model``.
    """
    openvino = import_extra("openvino", "openvino")
    return openvino.Core().read_model(with_own_biases(model).SerializeToString(), b"")


def with_own_biases(model: Any) -> Any:
    """Return a copy of an ONNX model whose convolutions share no bias: OpenVINO adds a shared one by a further pass."""
    own = type(model)()
    own.CopyFrom(model)
    biases = {constant.name: constant for constant in own.graph.initializer}
    seen: set[str] = set()
    for node in own.graph.node:
        if node.op_type != "Conv" or len(node.input) < 3:
            continue
        name = node.input[2]
        if name in seen and name in biases:
            node.input[2] = f"{node.name}.bias"
            copy = own.graph.initializer.add()
            copy.CopyFrom(biases[name])
            copy.name = node.input[2]
        seen.add(name)
    return own


def save_openvino(model: Any, path: str | os.PathLike[str], card: ModelCard, info: ArtefactInfo) -> None:
    """Write ``.xml``, with the SHA-256 of the weights, and ``.bin``.

    Args:
        model: The ``openvino.Model``.
        path: The ``.xml`` file.
        card: What the network is.
        info: How the artefact takes pixels and returns results; weights of an fp16 artefact are stored as fp16.

    Raises:
        OutputError: If they cannot be written.
    """
    openvino, path = import_extra("openvino", "openvino"), Path(path)
    model.set_rt_info(card.to_json(), CARD_KEY.split("."))
    model.set_rt_info(info.to_json(), ARTEFACT_KEY.split("."))
    half = info.precision == "fp16"
    try:
        openvino.save_model(model, path, compress_to_fp16=half)
        weights = hashlib.sha256(path.with_suffix(".bin").read_bytes()).hexdigest()
        model.set_rt_info(weights, WEIGHTS_HASH_KEY.split("."))
        openvino.save_model(model, path, compress_to_fp16=half)  # the weights are the same each time
    except RuntimeError as error:  # "basic_ios::clear: iostream error" where the disk is full
        raise OutputError(f"{path}: cannot be written ({gist(error)}); is there room?") from error


def vector_unit() -> Unit:
    """Return what the processor multiplies with, as far as the system tells."""
    _, flags = processor()
    if "amx_bf16" in flags:
        return "amx"
    return "avx512" if "avx512f" in flags else "other"
