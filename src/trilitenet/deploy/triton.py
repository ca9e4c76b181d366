"""A model repository for NVIDIA Triton from an exported ONNX graph: ``NAME/config.pbtxt`` and ``NAME/1/model.onnx``.

Names, types and shapes in ``config.pbtxt`` are those of the artefact itself; its parameters ``trilitenet.card`` and
``trilitenet.artefact`` are the artefact's own metadata: classes and thresholds, order of colours and kind of masks.
Triton runs the network alone: preparing the image and reading the outputs stay with the client, which finds what both
take in `trilitenet.inference.exported` and `trilitenet.processing`.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, ModelCard
from trilitenet.errors import OutputError, WeightsError, folder_beside, import_extra, writing

__all__ = ["write_triton_repository"]

_ONNX_TYPES: Final = {1: "FP32", 2: "UINT8", 3: "INT8", 6: "INT32", 7: "INT64", 9: "BOOL", 10: "FP16", 11: "FP64"}


class _TensorSpec(NamedTuple):
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
    artefact: Path, folder: Path, card: ModelCard, *, name: str | None = None, overwrite: bool = False
) -> Path:
    """Write a model repository that ``tritonserver --model-repository FOLDER`` serves.

    The model is there whole or not at all, so that a server that watches the repository loads no half of it.

    Args:
        artefact: An exported ``.onnx`` file, with its description in its metadata.
        folder: The repository; other models in it are left alone.
        card: The artefact's model card.
        name: Of the model; that of the variant if left out.
        overwrite: Replace the model if it is there already; what else is in its folder, such as other versions, stays.

    Returns:
        The model's folder.

    Raises:
        WeightsError: If the artefact is broken, or was not exported by this package.
        OutputError: If the model is in the repository already, or cannot be written.
        MissingExtraError: If onnx is not installed.
    """
    proto = _load(artefact)
    metadata = {entry.key: entry.value for entry in proto.metadata_props}
    if ARTEFACT_KEY not in metadata:
        raise WeightsError(f"{artefact}: no {ARTEFACT_KEY!r} in its metadata; export it with: trilitenet export")
    parameters = {CARD_KEY: card.to_json(), ARTEFACT_KEY: metadata[ARTEFACT_KEY]}
    model = folder / (name or f"trilitenet_{card.variant}")
    if model.exists() and not overwrite:
        raise OutputError(f"{model}: exists already; give another --output or --overwrite")
    with writing(model), folder_beside(model) as place:
        made, former = place / "made", place / "former"
        (made / "1").mkdir(parents=True)
        _copy(model, made, without=("config.pbtxt", "1"))
        _copy(model / "1", made / "1", without=("model.onnx",))
        shutil.copyfile(artefact, made / "1" / "model.onnx")
        (made / "config.pbtxt").write_text(_config(model.name, *_tensors(proto.graph), parameters), encoding="utf-8")
        if model.exists():
            model.replace(former)
        made.replace(model)
    return model


def _copy(folder: Path, target: Path, without: Collection[str]) -> None:
    """Copy what is in a folder, if there is one, but the names in ``without``; links stay links."""
    for entry in folder.iterdir() if folder.is_dir() else ():
        if entry.name in without:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.copytree(entry, target / entry.name, symlinks=True)
        else:
            shutil.copy2(entry, target / entry.name, follow_symlinks=False)


def _load(artefact: Path) -> Any:
    """Return an ``onnx.ModelProto``."""
    onnx = import_extra("onnx", "onnx")
    try:
        return onnx.load(str(artefact), load_external_data=False)
    except Exception as error:  # protobuf's own error type is none that can be named here
        raise WeightsError(f"{artefact}: is no ONNX model ({error})") from error


def _tensors(graph: Any) -> tuple[list[_TensorSpec], list[_TensorSpec]]:
    """Return the inputs and the outputs of an ``onnx.GraphProto``."""
    constants = {tensor.name for tensor in graph.initializer}

    def spec(value: Any) -> _TensorSpec:
        tensor = value.type.tensor_type
        shape = tuple(axis.dim_value if axis.HasField("dim_value") else -1 for axis in tensor.shape.dim)
        return _TensorSpec(value.name, _ONNX_TYPES[tensor.elem_type], shape)

    return [spec(v) for v in graph.input if v.name not in constants], [spec(v) for v in graph.output]


def _config(name: str, inputs: list[_TensorSpec], outputs: list[_TensorSpec], parameters: Mapping[str, str]) -> str:
    lines = [
        f"name: {_quote(name)}",
        'backend: "onnxruntime"',
        "max_batch_size: 0",  # the batch of 1 is part of the graph's shapes
        *(_tensor("input", tensor) for tensor in inputs),
        *(_tensor("output", tensor) for tensor in outputs),
        "instance_group [ { kind: KIND_AUTO, count: 1 } ]",
        *(
            f"parameters {{ key: {_quote(key)} value {{ string_value: {_quote(text)} }} }}"
            for key, text in parameters.items()
        ),
    ]
    return "\n".join(lines) + "\n"


def _tensor(field: str, tensor: _TensorSpec) -> str:
    shape = ", ".join(map(str, tensor.shape))
    return f"{field} [ {{ name: {_quote(tensor.name)}, data_type: TYPE_{tensor.datatype}, dims: [ {shape} ] }} ]"


def _quote(text: str) -> str:
    """Return a string of protobuf's text format; JSON's escapes are among its own."""
    return json.dumps(text, ensure_ascii=False)
