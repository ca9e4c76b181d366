"""TensorRT engines, through its Python API where it is installed; else the exact ``trtexec`` line.

An engine only runs on the kind of GPU it was built on. A file of ours is a JSON header (card, description, SHA-256 of
the engine) of stated length behind a magic, then the serialised engine; what ``trtexec`` writes is the engine alone.
"""

from __future__ import annotations

import importlib.util
import shlex
from pathlib import Path
from typing import Any

from trilitenet.errors import BackendError, import_extra

__all__ = ["build_engine", "is_installed", "trtexec_line"]


def is_installed() -> bool:
    """Return whether TensorRT's Python API is here."""
    return importlib.util.find_spec("tensorrt") is not None


def trtexec_line(onnx_path: Path, engine_path: Path, precision: str) -> str:
    """Return the command that builds an engine with the tool that comes with TensorRT (and with JetPack).

    Args:
        onnx_path: The ``.onnx`` file.
        engine_path: The engine to write.
        precision: ``"fp32"``, ``"fp16"`` or ``"bf16"``.
    """
    flags = {"fp32": [], "fp16": ["--fp16"], "bf16": ["--bf16"]}[precision]
    words = ["trtexec", f"--onnx={onnx_path}", f"--saveEngine={engine_path}", *flags, "--useCudaGraph"]
    return shlex.join(words)


def build_engine(model: Any, precision: str) -> bytes:  # pragma: no cover - needs a GPU and TensorRT
    """Build an engine from an ONNX model.

    Raises:
        MissingExtraError: If TensorRT is not installed.
        BackendError: If it refuses the graph.
    """
    tensorrt = import_extra("tensorrt", "tensorrt")
    logger = tensorrt.Logger(tensorrt.Logger.ERROR)
    builder = tensorrt.Builder(logger)
    network = builder.create_network(0)
    parser = tensorrt.OnnxParser(network, logger)
    if not parser.parse(model.SerializeToString()):
        raise BackendError(f"TensorRT refuses the graph ({parser.get_error(0)})")
    config = builder.create_builder_config()
    if precision == "fp16":
        config.set_flag(tensorrt.BuilderFlag.FP16)
    if precision == "bf16":
        config.set_flag(tensorrt.BuilderFlag.BF16)
    engine = builder.build_serialized_network(network, config)
    if engine is None:
        raise BackendError("TensorRT could not build an engine")
    return bytes(engine)
