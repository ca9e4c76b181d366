"""Exported ``.engine`` artefacts on TensorRT. PyTorch is not needed; TensorRT and cuda-python are.

No GPU was at hand when this was written: the reading of files is tested, the run on a GPU is not.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, ArtefactInfo, ModelCard, parse_json
from trilitenet.errors import BackendError, WeightsError, import_extra
from trilitenet.inference.backend import held
from trilitenet.inference.exported import ArtefactBackend, prepare_input, read_metadata

__all__ = ["MAGIC", "TensorRTBackend", "pack_engine", "unpack_engine"]

MAGIC: Final = b"TRILITENET-ENGINE\n"


def pack_engine(engine: bytes, card: ModelCard, info: ArtefactInfo) -> bytes:
    """Return the file of an engine: magic, length of the header (4 bytes, little endian), JSON header, engine."""
    header = json.dumps({CARD_KEY: card.to_json(), ARTEFACT_KEY: info.to_json()}).encode()
    return MAGIC + struct.pack("<I", len(header)) + header + engine


def unpack_engine(path: Path) -> tuple[ModelCard, ArtefactInfo, bytes]:
    """Read what `pack_engine` made.

    Raises:
        WeightsError: If it is not such a file, or of a newer layout.
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
    return *read_metadata(header, str(path)), data[start + length :]


class TensorRTBackend(ArtefactBackend):  # pragma: no cover - needs a GPU and TensorRT
    """An artefact of ``trilitenet export --format tensorrt``.

    Args:
        path: The ``.engine`` file.

    Raises:
        MissingExtraError: If TensorRT or cuda-python is not installed.
        WeightsError: If the file is missing, broken or foreign, or of a newer layout.
        BackendError: If TensorRT refuses the engine, as on another kind of GPU.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = Path(path)
        self._card, self.info, engine = unpack_engine(self._path)
        tensorrt = import_extra("tensorrt", "tensorrt")
        self._cuda = import_extra("cuda.bindings.runtime", "tensorrt")
        runtime = tensorrt.Runtime(tensorrt.Logger(tensorrt.Logger.ERROR))
        self._engine = runtime.deserialize_cuda_engine(engine)
        if self._engine is None:
            raise BackendError(f"{path}: TensorRT refuses this engine; build it on the GPU that runs it")
        self._context: Any = self._engine.create_execution_context()
        self._stream = self._call(self._cuda.cudaStreamCreate())
        self._names = [self._engine.get_tensor_name(i) for i in range(self._engine.num_io_tensors)]
        self._memory: dict[str, int] = {}
        self._host: dict[str, NDArray[Any]] = {}
        for name in self._names:
            shape = tuple(self._engine.get_tensor_shape(name))
            self._host[name] = np.empty(shape, tensorrt.nptype(self._engine.get_tensor_dtype(name)))
            self._memory[name] = self._call(self._cuda.cudaMalloc(self._host[name].nbytes))
            self._context.set_tensor_address(name, self._memory[name])

    @property
    def name(self) -> str:
        """The runtime and the precision."""
        return f"tensorrt cuda {self.info.precision}"

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
