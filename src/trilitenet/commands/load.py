"""Load a model as a predictor, on whatever runtime its file is for."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from trilitenet.config import VARIANTS
from trilitenet.errors import ConfigError, did_you_mean, needing_torch
from trilitenet.inference.backend import Backend
from trilitenet.inference.exported import is_int8_onnx
from trilitenet.inference.predictor import ImageLike, Predictor
from trilitenet.processing.ego_mask import EgoMask

if TYPE_CHECKING:
    import torch

    from trilitenet.models.builders import Builder

__all__ = ["BACKENDS", "check_parallel", "is_exported", "load", "open_backend", "own_builder", "runtimes_of"]

BACKENDS = ("auto", "torch", "onnxruntime", "openvino", "ncnn", "executorch", "tensorrt")
"""What ``backend`` may be."""
_RUNS: Final[dict[str, tuple[str, ...]]] = {
    ".onnx": ("openvino", "onnxruntime"),
    ".xml": ("openvino",),
    ".param": ("ncnn",),
    ".pte": ("executorch",),
    ".engine": ("tensorrt",),
    ".plan": ("tensorrt",),
}
"""Runtimes of a file by its suffix; others run on PyTorch."""
_EXPORTED: Final = frozenset({*_RUNS, ".pt2"})
"""Suffixes of files that hold their network."""
_MADE: Final = {"onnxruntime": "onnx"}
"""What to export for a runtime that is not called as its format is."""


def load(
    model: str | os.PathLike[str] = "tiny",
    *,
    network: Builder | None = None,
    device: str | torch.device = "auto",
    backend: str = "auto",
    confidence: float | None = None,
    iou: float | None = None,
    drivable: float | None = None,
    lane: float | None = None,
    long_side: int | None = None,
    batch_size: int = 8,
    streams: int = 1,
    threads: int | None = None,
    ego_mask: ImageLike | None = None,
) -> Predictor:
    """Load a model as a predictor.

    Args:
        model: Name of shipped weights, a file of weights, or an exported artefact (.onnx, .xml, .param or the folder
            it is in, .pte, .engine, .plan, .pt2).
        network: The function that builds the network of a file of weights, or its name, where that is not
            `build_network`; see `load_network`.
        device: auto (the best there is), cpu, cuda, cuda:1, mps; or a ``torch.device``.
        backend: auto (the fastest present that runs the file), torch, onnxruntime, openvino, ncnn, executorch or
            tensorrt. A file of weights runs on PyTorch: auto is its deploy graph, on CUDA in fp16 under CUDA graphs,
            torch the plain network in fp32.
        confidence: Keep boxes whose confidence is above this, in [0, 1]; the model's own if left out.
        iou: A box goes when it overlaps a better one by more, in [0, 1]; the model's own if left out.
        drivable: A pixel is drivable above this probability, in [0, 1]; the model's own if left out.
        lane: A pixel is lane marking above this probability, in [0, 1]; the model's own if left out.
        long_side: The longer side of an image is resized to so many pixels; by default as in training, or as the input
            of an artefact is fixed to.
        batch_size: At most so many images go through the network at once.
        streams: Images that OpenVINO computes at once: more frames a second, more latency. Other runtimes have none.
        threads: Threads of the runtime; its own choice if left out. PyTorch and ExecuTorch have one number for the
            whole process.
        ego_mask: Where images show the own car, as a picture that is bright there: nothing is found on it; see
            `EgoMask`.

    Returns:
        The predictor.

    Raises:
        WeightsError: If the file is missing, broken or foreign.
        BackendError: If the device or the runtime is not there.
        MissingExtraError: If the runtime is not installed.
        ConfigError: If an option is unknown, out of range, or of no effect on this model's input.
        InputError: If the ego mask cannot be read, or marks nothing, or everything.
    """
    own_car = None if ego_mask is None else EgoMask(ego_mask)
    if backend not in BACKENDS:
        raise ConfigError(f"unknown backend {backend!r}{did_you_mean(backend, BACKENDS)}")
    check_parallel(streams=streams, threads=threads)
    with needing_torch():
        runtime = open_backend(model, str(device), backend, streams, threads, network)
    try:
        if long_side is not None and runtime.canvas is not None and long_side != max(runtime.canvas):
            height, width = runtime.canvas
            raise ConfigError(
                f"its input is fixed to {width}x{height}, so long_side has no effect; leave it out, or export it with "
                "another --size HEIGHTxWIDTH"
            )
        given = {"confidence": confidence, "iou": iou, "drivable": drivable, "lane": lane}
        own: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        thresholds = dataclasses.replace(runtime.card.thresholds, **own)
        return Predictor(runtime, thresholds, long_side=long_side, batch_size=batch_size, ego_mask=own_car)
    except ConfigError as error:
        runtime.close()
        raise ConfigError(f"{model}: {error}") from error


def own_builder(model: str | os.PathLike[str], network: str | None) -> str | None:
    """Return the function that built a model's network if the file is of weights of a network of one's own, else None.

    Args:
        model: One of several models, of which others are of other networks, or exported.
        network: The function's name as it was given.

    Raises:
        WeightsError: If the file is broken.
    """
    if network is None or is_exported(model) or Path(model).is_dir():
        return None
    from trilitenet.models.weights import read_builder

    return network if read_builder(model) is not None else None


def is_exported(model: str | os.PathLike[str]) -> bool:
    """Return whether a model is an exported file, which holds its network; else it is weights, by file or name."""
    return _suffix(model) in _EXPORTED


def runtimes_of(model: str | os.PathLike[str]) -> tuple[str, ...]:
    """Return the runtimes that run a model, by the kind of its file."""
    return _RUNS.get(_suffix(model), ("torch",))


def _suffix(model: str | os.PathLike[str]) -> str:
    """Return the suffix of a model's file, in small letters; of a folder with an artefact of NCNN that of its graph."""
    path = Path(os.fspath(model))
    if str(model) not in VARIANTS and path.is_dir() and any(path.glob("*.param")):
        return ".param"
    return path.suffix.lower()


def check_parallel(**counts: int | None) -> None:
    """Refuse a number of streams or threads below 1, by its name.

    Raises:
        ConfigError: If one is.
    """
    for name, count in counts.items():
        if count is not None and count < 1:
            raise ConfigError(f"{name} must be at least 1, got {count}")


def open_backend(
    model: str | os.PathLike[str],
    device: str,
    backend: str,
    streams: int = 1,
    threads: int | None = None,
    network: Builder | None = None,
) -> Backend:
    """Open a file on the runtime asked for, or on the fastest one here that runs it."""
    fastest, runs = backend == "auto", runtimes_of(model)
    if network is not None and is_exported(model):
        raise ConfigError(f"{model}: is an exported file, which holds its network; leave --network out")
    if backend == "auto":
        # OpenVINO was the faster of the two on every processor measured (docs/speed.md); it has no CUDA.
        usable = [name for name in runs if importlib.util.find_spec(name) is not None]
        if "onnxruntime" in usable and (device.startswith("cuda") or is_int8_onnx(model)):
            usable = ["onnxruntime"]
        backend = (usable or runs)[0]
    elif backend not in runs:
        cure = f"; make a file for it with: trilitenet export {model} --format {_MADE.get(backend, backend)}"
        raise ConfigError(f"{model} runs on {' or '.join(runs)}, not on {backend}{'' if is_exported(model) else cure}")
    if backend == "openvino":
        from trilitenet.inference.openvino_backend import OpenVINOBackend

        return OpenVINOBackend(model, device, streams=streams, threads=threads)
    if backend == "onnxruntime":
        from trilitenet.inference.onnx_backend import OnnxBackend

        return OnnxBackend(model, device, threads=threads)
    if backend == "ncnn":
        from trilitenet.inference.ncnn_backend import NcnnBackend

        return NcnnBackend(model, device, threads=threads)
    if backend == "executorch":
        from trilitenet.inference.executorch_backend import ExecuTorchBackend

        return ExecuTorchBackend(model, device, threads=threads)
    if backend == "tensorrt":
        from trilitenet.inference.tensorrt_backend import TensorRTBackend

        return TensorRTBackend(model)
    if threads is not None:
        import torch

        torch.set_num_threads(threads)
    if _suffix(model) == ".pt2":
        from trilitenet.inference.exported_torch_backend import ExportedTorchBackend

        return ExportedTorchBackend(model, device)
    return _open_torch(model, device, network, fastest=fastest)


def _open_torch(model: str | os.PathLike[str], device: str, builder: Builder | None, *, fastest: bool) -> Backend:
    from trilitenet.inference.torch_backend import TorchBackend, check_threads, pick_device
    from trilitenet.models.trilitenet import foreign_layers
    from trilitenet.models.weights import load_network

    check_threads()
    network = load_network(model, builder)
    kind = pick_device(device).type
    # Without a function of its own there are no layers but ours: `load_network` sees to that.
    if not fastest or kind not in {"cpu", "cuda"} or (builder is not None and foreign_layers(network)):
        return TorchBackend(network, device)
    import torch

    from trilitenet.deploy.graph import DeployGraph
    from trilitenet.deploy.layouts import pick_layout

    graph = DeployGraph(network, pick_layout("auto", network.variant, f"torch-{kind}"), masks="probability").eval()
    if kind == "cpu":
        return TorchBackend(network, device, graph=graph)
    from trilitenet.inference.cuda_graph_backend import CudaGraphBackend

    graph = graph.reduced(torch.float16)
    graph.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return CudaGraphBackend(graph, network.card, str(pick_device(device)))
