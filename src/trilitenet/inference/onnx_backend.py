"""Exported ``.onnx`` artefacts on ONNX Runtime. PyTorch is not needed."""

from __future__ import annotations

import functools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import BackendError, WeightsError, gist, import_extra
from trilitenet.inference.backend import ParallelSessions, held
from trilitenet.inference.exported import ArtefactBackend, check_graph, prepare_input, read_metadata, read_onnx

__all__ = ["OnnxBackend"]


class OnnxBackend(ParallelSessions, ArtefactBackend):
    """An artefact of ``trilitenet export --format onnx`` on ONNX Runtime.

    Args:
        path: The ``.onnx`` file.
        device: ``"auto"`` (CUDA where this ONNX Runtime has it), ``"cpu"`` or ``"cuda"``.
        threads: Threads of the CPU provider; ONNX Runtime's own choice if left out.

    Raises:
        MissingExtraError: If ONNX Runtime is not installed.
        WeightsError: If the file is missing, broken, changed or foreign, or of a newer layout.
        BackendError: If the device is not there.
    """

    def __init__(self, path: str | os.PathLike[str], device: str = "auto", *, threads: int | None = None) -> None:
        runtime = import_extra("onnxruntime", "onnx")
        path = Path(path)
        read_onnx(path)
        available = runtime.get_available_providers()
        if device not in ("auto", "cpu", "cuda"):
            raise BackendError(f"device {device!r} is not one of ONNX Runtime's here; use auto, cpu or cuda")
        if device == "cuda" and "CUDAExecutionProvider" not in available:
            raise BackendError("this ONNX Runtime has no CUDA; install onnxruntime-gpu, or use device='cpu'")
        providers = ["CPUExecutionProvider"]
        if device != "cpu" and "CUDAExecutionProvider" in available:
            providers.insert(0, "CUDAExecutionProvider")
        self._runtime, self._providers, self._threads = runtime, providers, threads
        self._path, self._file = path, path.absolute()  # which stays the same where the process changes its folder
        self._session = self._open(threads)
        self._card, self.info = read_metadata(self._session.get_modelmeta().custom_metadata_map, str(path))
        inputs = self._session.get_inputs()
        self._outputs = [output.name for output in self._session.get_outputs()]
        shapes = [[side if isinstance(side, int) else None for side in each.shape] for each in inputs]
        check_graph(shapes, self._outputs, self._card, self.info, str(path))
        self._input = inputs[0].name
        self._device = "cuda" if self._session.get_providers()[0].startswith("CUDA") else "cpu"
        if device == "cuda" and self._device != device:  # it goes on with the CPU, and says so on standard error alone
            raise BackendError(
                "ONNX Runtime could not start on CUDA; see that the driver, CUDA and cuDNN are those that this "
                "onnxruntime-gpu is made for, or use device='cpu'"
            )

    def _open(self, threads: int | None) -> Any:
        options = self._runtime.SessionOptions()
        options.log_severity_level = 3
        # Between two frames the threads would spin, while the next frame is read and prepared on the same cores.
        options.add_session_config_entry("session.force_spinning_stop", "1")
        if threads is not None:
            options.intra_op_num_threads = threads
        try:
            return self._runtime.InferenceSession(str(self._file), options, providers=self._providers)
        except Exception as error:  # its exceptions share no base class of their own
            reason = "cut off or damaged; export it again" if "INVALID_PROTOBUF" in str(error) else gist(error)
            raise WeightsError(f"{self._path}: not a usable ONNX model ({reason})") from error

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it as what opens it again: its file, which must be there, and its options."""
        return functools.partial(OnnxBackend, self._file, self._device, threads=self._threads), ()

    @property
    def name(self) -> str:
        """The runtime and the device."""
        return f"onnxruntime {self._device} {self.info.precision}"

    def _compute(self, batch: NDArray[np.uint8]) -> list[Mapping[str, NDArray[Any]]]:
        session = held(self._session, self._path)
        runs = (session.run(None, {self._input: prepare_input(image, self.info)}) for image in batch)
        return [dict(zip(self._outputs, values, strict=True)) for values in runs]

    def close(self) -> None:
        """Free the session."""
        self._session = None
