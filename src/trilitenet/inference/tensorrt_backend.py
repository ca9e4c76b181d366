"""Engines on TensorRT: ``.engine`` artefacts and ``.plan`` files. PyTorch is not needed; TensorRT and cuda-python are.

No GPU was at hand when this was written: the reading of files is tested, the run on a GPU with a stand-in alone.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, GRAPH_HASH_KEY, ArtefactInfo, ModelCard, parse_json
from trilitenet.errors import BackendError, WeightsError, import_extra
from trilitenet.inference.backend import held
from trilitenet.inference.exported import ArtefactBackend, check_graph, prepare_input, read_metadata, read_onnx_metadata

__all__ = ["MAGIC", "TensorRTBackend", "pack_engine", "read_plan", "unpack_engine"]

MAGIC: Final = b"TRILITENET-ENGINE\n"


def pack_engine(engine: bytes, card: ModelCard, info: ArtefactInfo) -> bytes:
    """Return the file of an engine: magic, length of the header (4 bytes, little endian), JSON header, engine."""
    digest = hashlib.sha256(engine).hexdigest()
    header = json.dumps({CARD_KEY: card.to_json(), ARTEFACT_KEY: info.to_json(), GRAPH_HASH_KEY: digest}).encode()
    return MAGIC + struct.pack("<I", len(header)) + header + engine


def unpack_engine(path: Path) -> tuple[ModelCard, ArtefactInfo, bytes]:
    """Read what `pack_engine` made; older files hold no hash of the engine.

    Raises:
        WeightsError: If it is not such a file, damaged, or of a newer layout.
    """
    if not path.is_file():
        raise WeightsError(f"{path}: no such file")
    data = path.read_bytes()
    start = len(MAGIC) + 4
    if not data.startswith(MAGIC) or len(data) < start:
        raise WeightsError(f"{path}: not an engine of ours; build it with: trilitenet export --format tensorrt")
    (length,) = struct.unpack("<I", data[len(MAGIC) : start])
    try:
        header = parse_json(data[start : start + length])
    except ValueError as error:
        raise WeightsError(f"{path}: its header is broken ({error})") from error
    if not isinstance(header, dict):
        raise WeightsError(f"{path}: its header is not a JSON object")
    card, info = read_metadata(header, str(path))
    engine = data[start + length :]
    if header.get(GRAPH_HASH_KEY) not in (None, hashlib.sha256(engine).hexdigest()):
        raise WeightsError(f"{path}: its engine is damaged; build it again with: trilitenet export --format tensorrt")
    return card, info, engine


def read_plan(path: Path) -> tuple[ModelCard, ArtefactInfo, bytes]:
    """Read what ``trtexec --saveEngine`` wrote; what it is stands in the ``.onnx`` file of the same name beside it.

    Returns:
        The card, the description, whose precision is that of the graph, and the engine.

    Raises:
        WeightsError: If one of the two is missing, or the ``.onnx`` is damaged, foreign or of a newer layout.
    """
    if not path.is_file():
        raise WeightsError(f"{path}: no such file")
    graph = path.with_suffix(".onnx")
    if not graph.is_file():
        raise WeightsError(f"{path}: its card is missing; keep {graph.name}, which it was built from, beside it")
    card, info = read_metadata(read_onnx_metadata(graph), str(graph))
    return card, dataclasses.replace(info, format="tensorrt"), path.read_bytes()


class TensorRTBackend(ArtefactBackend):
    """An artefact of ``trilitenet export --format tensorrt``.

    Args:
        path: The ``.engine`` file, or the ``.plan`` file that ``trtexec`` built, with the ``.onnx`` of the same name
            beside it.

    Raises:
        MissingExtraError: If TensorRT or cuda-python is not installed.
        WeightsError: If the file is missing, broken or foreign, or of a newer layout.
        BackendError: If TensorRT refuses the engine, as on another kind of GPU.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path)
        plan = self._path.suffix.lower() == ".plan"
        self._card, self.info, engine = read_plan(self._path) if plan else unpack_engine(self._path)
        self._built = "plan" if plan else self.info.precision  # which a plan does not tell
        tensorrt = import_extra("tensorrt", "tensorrt")
        self._cuda = import_extra("cuda.bindings.runtime", "tensorrt")
        runtime = tensorrt.Runtime(tensorrt.Logger(tensorrt.Logger.ERROR))
        self._engine = runtime.deserialize_cuda_engine(engine)
        if self._engine is None:
            raise BackendError(f"{path}: TensorRT refuses this engine; build it on the GPU that runs it")
        self._names = [self._engine.get_tensor_name(i) for i in range(self._engine.num_io_tensors)]
        shapes = {name: tuple(self._engine.get_tensor_shape(name)) for name in self._names}
        takes = [shape for name, shape in shapes.items() if name == "image"]
        check_graph(takes, self._names, self._card, self.info, str(path))
        if any(side < 0 for shape in shapes.values() for side in shape):
            raise BackendError(f"{path}: has no fixed sizes; build it from the graph of: export --format tensorrt")
        self._context: Any = self._engine.create_execution_context()
        self._stream = self._call(self._cuda.cudaStreamCreate())
        self._memory: dict[str, int] = {}
        self._host: dict[str, NDArray[Any]] = {}
        for name in self._names:
            self._host[name] = np.empty(shapes[name], tensorrt.nptype(self._engine.get_tensor_dtype(name)))
            self._memory[name] = self._call(self._cuda.cudaMalloc(self._host[name].nbytes))
            self._context.set_tensor_address(name, self._memory[name])

    @property
    def name(self) -> str:
        """The runtime and the precision; of a plan, which does not tell it, that it is one."""
        return f"tensorrt cuda {self._built}"

    def _compute(self, batch: NDArray[np.uint8]) -> list[Mapping[str, NDArray[Any]]]:
        context, kinds = held(self._context, self._path), self._cuda.cudaMemcpyKind
        results: list[Mapping[str, NDArray[Any]]] = []
        for image in batch:
            value = prepare_input(image, self.info)
            self._call(
                self._cuda.cudaMemcpyAsync(
                    self._memory["image"],
                    value.ctypes.data,
                    value.nbytes,
                    kinds.cudaMemcpyHostToDevice,
                    self._stream,
                )
            )
            context.execute_async_v3(self._stream)
            result = {}
            for name in self._names:
                if name != "image":
                    host = result[name] = np.empty_like(self._host[name])
                    self._call(
                        self._cuda.cudaMemcpyAsync(
                            host.ctypes.data,
                            self._memory[name],
                            host.nbytes,
                            kinds.cudaMemcpyDeviceToHost,
                            self._stream,
                        )
                    )
            self._call(self._cuda.cudaStreamSynchronize(self._stream))
            results.append(result)
        return results

    def close(self) -> None:
        """Free device memory."""
        for address in self._memory.values():
            self._cuda.cudaFree(address)
        self._memory = {}
        self._context = None

    def _call(self, answer: Any) -> Any:
        """Return the result of a CUDA call.

        Raises:
            BackendError: If it failed.
        """
        code, *values = answer if isinstance(answer, tuple) else (answer,)
        if int(code) != 0:
            raise BackendError(f"CUDA call failed with code {int(code)}")
        return values[0] if values else None
