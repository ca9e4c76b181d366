"""Exported artefacts on OpenVINO: ``.xml`` of its own and ``.onnx``. PyTorch is not needed."""

from __future__ import annotations

import collections
import contextlib
import functools
import hashlib
import os
import queue
import re
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, WEIGHTS_HASH_KEY
from trilitenet.errors import BackendError, ConfigError, WeightsError, gist, import_extra
from trilitenet.inference.backend import MOST_PARALLEL, check_process, held, replaced
from trilitenet.inference.exported import ArtefactBackend, check_graph, prepare_input, read_metadata
from trilitenet.processing.cores import usable_cores

__all__ = ["OpenVINOBackend", "openvino_core"]

_FIRST_USE = threading.Lock()
_HINTS = {"fp32": "f32", "fp16": "f16", "bf16": "bf16"}


class OpenVINOBackend(ArtefactBackend):
    """An artefact of ``trilitenet export --format openvino`` (or ``onnx``) on OpenVINO.

    Args:
        path: The ``.xml`` file, with its ``.bin`` beside it, or an ``.onnx`` file.
        device: ``"auto"`` (the CPU), ``"cpu"``, ``"gpu"`` or another name of OpenVINO's.
        precision: What to compute in: ``"fp32"``, ``"bf16"`` or ``"fp16"``. By default what the artefact was exported
            for; INT8 layers stay INT8, the others of such an artefact compute in bf16 where the processor has it.
        streams: Images that are computed at once; more than one raises frames a second and latency.
        threads: Threads in all; OpenVINO's own choice if left out.

    Attributes:
        precision: What it computes in; bf16 falls back to fp32 where the processor lacks it.

    Raises:
        MissingExtraError: If OpenVINO is not installed.
        WeightsError: If the file is missing, broken or foreign, or of a newer layout.
        BackendError: If the device is not there, or the artefact is an INT8 ``.onnx``.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        device: str = "auto",
        *,
        precision: str | None = None,
        streams: int = 1,
        threads: int | None = None,
    ) -> None:
        openvino = import_extra("openvino", "openvino")
        path = Path(path)
        if not path.is_file():
            raise WeightsError(f"{path}: no such file")
        if streams < 1:
            raise ConfigError(f"streams must be at least 1, got {streams}")
        with path.open("rb") as file:
            start = file.read(64)
        # Checked here because OpenVINO tries every reader it has on a foreign file, and some of them talk.
        begins = (b"\x08",) if path.suffix.lower() == ".onnx" else (b"<?xml", b"<net")
        if len(start) < 64 or not start.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(begins):
            raise WeightsError(f"{path}: not a usable OpenVINO or ONNX model (it does not begin as one)")
        weights = path.with_suffix(".bin")
        if path.suffix.lower() == ".xml" and not weights.is_file():
            raise WeightsError(f"{path}: its weights are missing; keep {weights.name} beside it")
        with _FIRST_USE:
            core = openvino_core(openvino)
        try:
            model = core.read_model(path)
        except RuntimeError as error:
            said, reason = str(error), gist(error)
            if "ParseFromIstream" in said or "binary protobuf" in said:  # older versions say the latter
                reason = "cut off or damaged; export it again"
            elif "is_valid_weights_range" in said or "Incorrect weights" in said:
                reason = f"{weights.name} is cut off, or of another file; export it again"
            else:
                _check_weights(path)  # those of another graph are told by what they are read as
            raise WeightsError(f"{path}: not a usable OpenVINO or ONNX model ({reason})") from error
        self._card, self.info = read_metadata(_metadata(model), str(path))
        _check_weights(path)
        shapes = [
            [] if each.rank.is_dynamic else [None if side.is_dynamic else side.get_length() for side in each]
            for each in (entry.partial_shape for entry in model.inputs)
        ]
        names = {name for output in model.outputs for name in output.names}
        check_graph(shapes, names, self._card, self.info, str(path))
        if path.suffix.lower() == ".onnx" and self.info.precision == "int8":
            # Its low-precision passes change what such a graph computes: tiny lost 9.7 points of AP50 by them.
            raise BackendError(
                f"{path}: OpenVINO computes INT8 graphs of ONNX wrongly; use backend='onnxruntime' "
                "(pip install 'trilitenet[onnx]'), or export it with --format openvino"
            )
        self._device = "CPU" if device == "auto" else device.upper()
        if self._device.split(".")[0] not in {name.split(".")[0] for name in core.available_devices}:
            raise BackendError(f"OpenVINO has no device {device!r} here; it has {', '.join(core.available_devices)}")
        wanted = precision or ("bf16" if self.info.precision == "int8" else self.info.precision)
        if wanted not in _HINTS:
            raise ConfigError(f"unknown precision {wanted!r}; known: {', '.join(_HINTS)}")
        capable = {str(name).lower() for name in core.get_property(self._device, "OPTIMIZATION_CAPABILITIES")}
        self.precision = wanted if wanted in capable else "fp32"
        self._core, self._model, self._threads = core, model, threads
        self._path, self._file = path, path.absolute()  # which stays the same where the process changes its folder
        self.streams = streams
        self._process = os.getpid()
        compiled = self._compile(streams)
        self._outputs = [output.get_any_name() for output in compiled.outputs]
        self._idle: queue.SimpleQueue[Any] | None = _requests(compiled, streams)

    def _compile(self, streams: int) -> Any:
        options: dict[str, Any] = {
            "INFERENCE_PRECISION_HINT": _HINTS[self.precision],
            "PERFORMANCE_HINT": "LATENCY" if streams == 1 else "THROUGHPUT",
        }
        if self._device == "CPU":
            options["NUM_STREAMS"] = str(streams)
            if self._threads is not None:
                options["INFERENCE_NUM_THREADS"] = self._threads
        try:
            return self._core.compile_model(self._model, self._device, options)
        except RuntimeError as error:
            raise BackendError(
                f"{self._path}: OpenVINO cannot compile it for {self._device} ({gist(error)})"
            ) from error

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle it as what opens it again: its file, which must be there, and its options."""
        reopen = functools.partial(
            OpenVINOBackend,
            self._file,
            self._device,
            precision=self.precision,
            streams=self.streams,
            threads=self._threads,
        )
        return reopen, ()

    @property
    def name(self) -> str:
        """The runtime, the device, the precision and the streams."""
        precision = "int8" if self.info.precision == "int8" else self.precision
        return f"openvino {self._device.lower()} {precision}" + (f" x{self.streams}" if self.streams > 1 else "")

    def _compute(self, batch: NDArray[np.uint8]) -> list[Mapping[str, NDArray[Any]]]:
        """Compute the images of a batch at once, as far as there are streams."""
        idle = held(self._idle, self._path)
        check_process(self._process)
        results: list[Mapping[str, NDArray[Any]]] = []
        inputs = collections.deque(prepare_input(image, self.info) for image in batch)
        while inputs:
            busy: list[Any] = []
            try:
                busy.append(idle.get())
                while len(busy) < len(inputs) and not idle.empty():
                    try:
                        busy.append(idle.get_nowait())
                    except queue.Empty:  # another thread was quicker
                        break
                for request in busy:
                    request.start_async([inputs.popleft()], share_inputs=True)
                for request in busy:
                    request.wait()
                    # Copies: the request's own memory is written again by its next image.
                    results.append(
                        {name: np.array(request.get_output_tensor(i).data) for i, name in enumerate(self._outputs)}
                    )
            finally:
                for request in busy:
                    with contextlib.suppress(RuntimeError):
                        request.wait()  # Ctrl-C may have left it running
                    idle.put(request)
        return results

    @contextlib.contextmanager
    def in_parallel(self) -> Iterator[int]:
        """Inside, the model is compiled for one stream a core; yields from how many threads `run` is best called."""
        count = min(MOST_PARALLEL, self._threads or usable_cores()) if self._device == "CPU" else 1
        if count <= self.streams:
            yield self.streams
            return
        with replaced(self, "_idle", lambda: _requests(self._compile(count), count)):
            yield count

    def close(self) -> None:
        """Free the compiled model's requests."""
        self._idle = None


@functools.cache
def openvino_core(openvino: Any) -> Any:
    """Return the process's one core, which lives as long as the process.

    A core's CPU plugin gives its thread another stack for signals and, when it goes, the stack that it found. Of two
    cores that go in the order in which they came, the second gives back the memory that the first has freed, and the
    next signal that Python handles (Ctrl-C, the end of a child) kills the process.
    """
    # The first tensor of a process sets up NumPy for OpenVINO's binding; two threads that do so at once wait for each
    # other for ever.
    openvino.Tensor(np.zeros(1, np.uint8))
    return openvino.Core()


def _requests(compiled: Any, count: int) -> queue.SimpleQueue[Any]:
    """Return so many requests that are free to be used."""
    idle: queue.SimpleQueue[Any] = queue.SimpleQueue()
    for _ in range(count):
        idle.put(compiled.create_infer_request())
    return idle


def _check_weights(path: Path) -> None:
    """Refuse weights beside a graph that are not those whose hash it holds; older graphs hold none.

    Raises:
        WeightsError: If they are of another export.
    """
    if path.suffix.lower() != ".xml":
        return
    weights = path.with_suffix(".bin")
    key = WEIGHTS_HASH_KEY.rpartition(".")[2].encode()
    held = re.search(rb"<" + key + rb' value="([0-9a-f]+)"', path.read_bytes())
    if held is not None and hashlib.sha256(weights.read_bytes()).hexdigest() != held[1].decode():
        raise WeightsError(f"{weights}: not the weights that {path.name} was written for; export the model again")


def _metadata(model: Any) -> dict[str, str]:
    """Return an OpenVINO model's own key-value pairs, wherever the format keeps them."""
    found = {}
    for key in (CARD_KEY, ARTEFACT_KEY):
        for path in (key.split("."), ["framework", key], ["framework", *key.split(".")]):
            if model.has_rt_info(path):
                found[key] = str(model.get_rt_info(path).astype(str))
                break
    return found
