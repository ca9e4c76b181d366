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
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, WEIGHTS_HASH_KEY
from trilitenet.errors import BackendError, ConfigError, WeightsError, gist, import_extra
from trilitenet.inference.backend import MOST_PARALLEL, check_process, held, replaced
from trilitenet.inference.exported import ArtefactBackend, check_graph, prepare_input, read_metadata, read_onnx
from trilitenet.processing.cores import usable_cores

__all__ = ["OpenVINOBackend", "openvino_core"]

_FIRST_USE = threading.Lock()
_HINTS = {"fp32": "f32", "fp16": "f16", "bf16": "bf16"}
_LATEST: Final = 16
"""Of so many images the sizes are remembered, where an artefact takes any size."""
_OFTEN: Final = 5
"""A size that so many of these have is compiled for: no more than a warm-up runs, and mixed photos seldom have it."""
_SIZES: Final = 4
"""So many sizes stay compiled, each of which takes memory; the one longest unused makes room."""


class OpenVINOBackend(ArtefactBackend):
    """An artefact of ``trilitenet export --format openvino`` (or ``onnx``) on OpenVINO.

    One that takes any size is slower than one of a fixed size, so it is compiled again for a size that keeps coming.

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
        WeightsError: If the file is missing, broken, changed or foreign, or of a newer layout.
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
        if path.suffix.lower() == ".onnx":
            read_onnx(path)
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
        self._outputs = [output.get_any_name() for output in model.outputs]
        self._idle: queue.SimpleQueue[Any] | None = self._requests(streams)

    def _requests(self, streams: int) -> queue.SimpleQueue[Any]:
        """Compile the model for so many streams; return a request of each that is free to be used."""
        options: dict[str, Any] = {
            "INFERENCE_PRECISION_HINT": _HINTS[self.precision],
            "PERFORMANCE_HINT": "LATENCY" if streams == 1 else "THROUGHPUT",
        }
        if self._device == "CPU":
            options["NUM_STREAMS"] = str(streams)
            if self._threads is not None:
                options["INFERENCE_NUM_THREADS"] = self._threads
        core, device, path = self._core, self._device, self._path  # not self, which would hold itself by its requests

        def make(model: Any) -> list[Any]:
            try:
                compiled = core.compile_model(model, device, options)
                return [compiled.create_infer_request() for _ in range(streams)]
            except RuntimeError as error:
                raise BackendError(f"{path}: OpenVINO cannot compile it for {device} ({gist(error)})") from error

        requests = make(self._model)
        if self.info.size is None:
            sizes = _Sizes(self._model, make)
            requests = [_AnySize(request, stream, sizes) for stream, request in enumerate(requests)]
        idle: queue.SimpleQueue[Any] = queue.SimpleQueue()
        for request in requests:
            idle.put(request)
        return idle

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
        with replaced(self, "_idle", lambda: self._requests(count)):
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


class _Sizes:
    """The sizes for which a model that takes any is compiled as well. Several threads may use it at once.

    Args:
        model: The model.
        make: Compiles a model; returns a request for each stream.
    """

    def __init__(self, model: Any, make: Callable[[Any], list[Any]]) -> None:
        self._model, self._make = model, make
        self._latest: collections.deque[tuple[int, ...]] = collections.deque(maxlen=_LATEST)
        self._requests: collections.OrderedDict[tuple[int, ...], list[Any]] = collections.OrderedDict()
        self._lock, self._compiling = threading.Lock(), threading.Lock()

    def find(self, shape: tuple[int, ...]) -> list[Any]:
        """Return the requests for inputs of a shape, one a stream; none where it is not compiled for."""
        with self._lock:
            self._latest.append(shape)
            if shape in self._requests:
                self._requests.move_to_end(shape)
                return self._requests[shape]
            if self._latest.count(shape) < _OFTEN or not self._compiling.acquire(blocking=False):
                return []  # while one thread compiles, others compute without
        try:
            made = self._compile(shape)
            with self._lock:
                while len(self._requests) >= _SIZES:
                    self._requests.popitem(last=False)
                self._requests[shape] = made
        finally:
            self._compiling.release()
        return made

    def _compile(self, shape: tuple[int, ...]) -> list[Any]:
        """Return the requests for a shape; none where it cannot be compiled for, as where memory does not do."""
        try:
            model = self._model.clone()
            model.reshape(list(shape))
            return self._make(model)
        except (BackendError, RuntimeError):  # the model for any size goes on
            return []


class _AnySize:
    """A stream's request of a model that takes any size, which hands inputs of a size compiled for to that one's.

    Args:
        request: The request for any size.
        stream: Number of the stream, which computes one image at a time, whatever its size.
        sizes: The requests for sizes that keep coming.
    """

    def __init__(self, request: Any, stream: int, sizes: _Sizes) -> None:
        self._request = self._used = request
        self._stream, self._sizes = stream, sizes

    def start_async(self, inputs: Sequence[NDArray[Any]], share_inputs: bool = False) -> None:
        """Start to compute one image."""
        requests = self._sizes.find(inputs[0].shape)
        self._used = requests[self._stream] if requests else self._request
        self._used.start_async(inputs, share_inputs=share_inputs)

    def wait(self) -> None:
        """Wait until it is computed."""
        self._used.wait()

    def get_output_tensor(self, index: int) -> Any:
        """Return an output of it."""
        return self._used.get_output_tensor(index)


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
