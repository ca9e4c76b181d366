"""A model repository for NVIDIA Triton from an exported artefact: ``NAME/config.pbtxt`` and ``NAME/1/model.*``.

Names, types and shapes in ``config.pbtxt`` are those of the artefact itself; class names, thresholds and normalisation
travel as the model card in its parameter ``trilitenet.card``. Triton runs the network alone: letterboxing and
post-processing stay with the client, which has both in `trilitenet.processing`.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any, Final, NamedTuple

from trilitenet.config import ModelCard
from trilitenet.errors import ConfigError, OutputError, WeightsError, import_extra

__all__ = ["TensorSpec", "read_tensors", "write_triton_repository"]

_ONNX_TYPES: Final = {1: "FP32", 2: "UINT8", 3: "INT8", 6: "INT32", 7: "INT64", 9: "BOOL", 10: "FP16", 11: "FP64"}
_OPENVINO_TYPES: Final = {
    "f32": "FP32",
    "u8": "UINT8",
    "i8": "INT8",
    "i32": "INT32",
    "i64": "INT64",
    "boolean": "BOOL",
    "f16": "FP16",
    "f64": "FP64",
}
_BACKENDS: Final = {".onnx": ("onnxruntime", "model.onnx"), ".xml": ("openvino", "model.xml")}


class TensorSpec(NamedTuple):
    """An input or output of an artefact.

    Attributes:
        name: Of the tensor.
        datatype: In Triton's words: ``"UINT8"``, ``"FP32"`` and so on.
        shape: Sizes of all axes, -1 where any will do.
    """

    name: str
    datatype: str
    shape: tuple[int, ...]


def write_triton_repository(
    artefact: str | Path,
    folder: str | Path,
    card: ModelCard,
    *,
    name: str | None = None,
    max_batch: int = 8,
    delay: float = 0.002,
    gpu: bool = False,
    overwrite: bool = False,
) -> Path:
    """Write a model repository that ``tritonserver --model-repository FOLDER`` serves.

    Args:
        artefact: An exported ``.onnx`` file, or the ``.xml`` of an OpenVINO model.
        folder: The repository; other models in it are left alone.
        card: The artefact's model card.
        name: Of the model; that of the variant if left out.
        max_batch: The largest batch, where the artefact takes any.
        delay: Seconds that Triton may wait to fill a batch.
        gpu: Run on GPUs.
        overwrite: Replace the model if it is there already.

    Returns:
        The model's folder.

    Raises:
        WeightsError: If the artefact is missing or broken.
        ConfigError: If it is of a kind that Triton is not set up for here.
        OutputError: If the model is in the repository already.
        MissingExtraError: If what reads the artefact is not installed.
    """
    artefact = Path(artefact)
    if artefact.suffix not in _BACKENDS:
        raise ConfigError(f"{artefact}: a Triton repository is made of .onnx or .xml files; export one first")
    inputs, outputs = read_tensors(artefact)
    model = Path(folder) / (name or f"trilitenet_{card.variant}")
    if model.exists() and not overwrite:
        raise OutputError(f"{model}: exists already; give another --output or --overwrite")
    backend, file_name = _BACKENDS[artefact.suffix]
    version = model / "1"
    version.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(artefact, version / file_name)
    for companion, target in _companions(artefact):
        shutil.copyfile(companion, version / target)
    (model / "config.pbtxt").write_text(
        _config(model.name, backend, inputs, outputs, card, max_batch, delay, gpu), encoding="utf-8"
    )
    return model


def read_tensors(artefact: Path) -> tuple[list[TensorSpec], list[TensorSpec]]:
    """Return the inputs and the outputs of an ``.onnx`` file or an OpenVINO ``.xml``.

    Raises:
        WeightsError: If the file is missing or broken.
        MissingExtraError: If what reads it is not installed.
    """
    if not artefact.is_file():
        raise WeightsError(f"{artefact}: no such file")
    return _read_onnx(artefact) if artefact.suffix == ".onnx" else _read_openvino(artefact)


def _read_onnx(artefact: Path) -> tuple[list[TensorSpec], list[TensorSpec]]:
    onnx = import_extra("onnx", "onnx")
    try:
        graph = onnx.load(str(artefact), load_external_data=False).graph
    except Exception as error:  # protobuf's own error type is none that can be named here
        raise WeightsError(f"{artefact}: is no ONNX model ({error})") from error
    constants = {tensor.name for tensor in graph.initializer}

    def spec(value: Any) -> TensorSpec:
        tensor = value.type.tensor_type
        shape = tuple(axis.dim_value if axis.HasField("dim_value") else -1 for axis in tensor.shape.dim)
        return TensorSpec(value.name, _ONNX_TYPES[tensor.elem_type], shape)

    return [spec(v) for v in graph.input if v.name not in constants], [spec(v) for v in graph.output]


def _read_openvino(artefact: Path) -> tuple[list[TensorSpec], list[TensorSpec]]:
    openvino = import_extra("openvino", "openvino")
    try:
        model = openvino.Core().read_model(str(artefact))
    except RuntimeError as error:
        raise WeightsError(f"{artefact}: is no OpenVINO model ({str(error).splitlines()[0]})") from error

    def spec(port: Any) -> TensorSpec:
        shape = tuple(axis.get_length() if axis.is_static else -1 for axis in port.get_partial_shape())
        return TensorSpec(port.get_any_name(), _OPENVINO_TYPES[port.get_element_type().get_type_name()], shape)

    return [spec(port) for port in model.inputs], [spec(port) for port in model.outputs]


def _companions(artefact: Path) -> list[tuple[Path, str]]:
    """Return the files an artefact cannot do without, and their names beside the model."""
    if artefact.suffix == ".xml":
        return [(artefact.with_suffix(".bin"), "model.bin")]
    data = artefact.with_name(f"{artefact.name}.data")
    return [(data, data.name)] if data.exists() else []


def _config(
    name: str,
    backend: str,
    inputs: list[TensorSpec],
    outputs: list[TensorSpec],
    card: ModelCard,
    max_batch: int,
    delay: float,
    gpu: bool,
) -> str:
    batched = all(tensor.shape[:1] == (-1,) for tensor in [*inputs, *outputs])
    lines = [
        f"name: {_quote(name)}",
        f"backend: {_quote(backend)}",
        f"max_batch_size: {max_batch if batched else 0}",
        *(_tensor("input", tensor, batched) for tensor in inputs),
        *(_tensor("output", tensor, batched) for tensor in outputs),
    ]
    if batched and max_batch > 1:
        lines.append(f"dynamic_batching {{ max_queue_delay_microseconds: {round(delay * 1e6)} }}")
    lines += [
        f"instance_group [ {{ kind: {'KIND_GPU' if gpu else 'KIND_CPU'}, count: 1 }} ]",
        f'parameters {{ key: "trilitenet.card" value {{ string_value: {_quote(card.to_json())} }} }}',
    ]
    return "\n".join(lines) + "\n"


def _tensor(field: str, tensor: TensorSpec, batched: bool) -> str:
    shape = ", ".join(str(side) for side in tensor.shape[int(batched) :])
    return f"{field} [ {{ name: {_quote(tensor.name)}, data_type: TYPE_{tensor.datatype}, dims: [ {shape} ] }} ]"


def _quote(text: str) -> str:
    """Return a string of protobuf's text format; JSON's escapes are among its own."""
    return json.dumps(text, ensure_ascii=False)
