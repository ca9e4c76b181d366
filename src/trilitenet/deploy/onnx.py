"""The deploy graph as ONNX: checked, with the card and the description of the artefact in its metadata."""

from __future__ import annotations

import ast
import hashlib
import os
import re
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from trilitenet.config import ARTEFACT_KEY, CARD_KEY, GRAPH_HASH_KEY, ArtefactInfo, ModelCard, Thresholds
from trilitenet.deploy.graph import DeployGraph, Traceable
from trilitenet.deploy.quiet import quiet
from trilitenet.errors import BackendError, import_extra

__all__ = ["OPSET", "PORTABLE_OPERATORS", "build_onnx", "save_onnx"]

OPSET: Final = 18

PORTABLE_OPERATORS: Final = frozenset(
    {
        "Add", "AveragePool", "Concat", "Conv", "ConvTranspose", "LeakyRelu", "MatMul", "MaxPool", "Mul", "PRelu",
        "ReduceMean", "Reshape", "Resize", "Sigmoid", "Slice", "Softmax", "Sub", "Transpose", "Unsqueeze", "Squeeze",
    }
)  # fmt: skip
"""All that a portable graph uses, on tensors of at most four dimensions: operators that TensorRT, TFLite converters,
NCNN and vendor compilers share."""


def build_onnx(
    graph: DeployGraph, card: ModelCard, info: ArtefactInfo, *, nms: Thresholds | None = None, half: bool = False
) -> Any:
    """Trace the deploy graph into a checked ONNX model.

    Args:
        graph: The deploy graph.
        card: What the network is; goes into the metadata.
        info: How the artefact takes pixels and returns results; goes into the metadata. Its ``size`` of None makes
            height and width dynamic.
        nms: Append class-aware non-maximum suppression with these thresholds.
        half: Store weights as fp16; they are widened when the model is loaded.

    Returns:
        An ``onnx.ModelProto``.

    Raises:
        MissingExtraError: If onnx or onnxscript is not installed.
        BackendError: If tracing fails or the result is not valid ONNX.
    """
    onnx = import_extra("onnx", "onnx")
    import_extra("onnxscript", "onnx")
    traceable = Traceable(graph, card, info)
    try:
        with quiet(), torch.no_grad():
            program = torch.onnx.export(
                traceable,
                (traceable.image,),
                dynamo=True,
                opset_version=OPSET,
                input_names=["image"],
                output_names=list(card.tasks),
                dynamic_shapes=traceable.dynamic,
                optimize=True,  # PyTorch 2.6 would not
                verbose=False,
            )
            assert program is not None
            model = program.model_proto
    except (RuntimeError, torch.onnx.errors.OnnxExporterError) as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, KeyboardInterrupt):  # PyTorch, interrupted while it imports, raises others for it
                raise cause from None
            cause = cause.__cause__ or cause.__context__
        raise BackendError(f"PyTorch cannot trace the deploy graph ({_reason(error)})") from error
    if nms is not None:
        _append_nms(onnx, model, card.classes, nms)
    if half:
        _store_half(onnx, model)
    model.producer_name = "trilitenet"
    model.producer_version = info.trilitenet
    onnx.helper.set_model_props(model, {CARD_KEY: card.to_json(), ARTEFACT_KEY: info.to_json()})
    _name_nodes(model)
    for value in (*model.graph.value_info, *model.graph.input, *model.graph.output):
        del value.metadata_props[:]
    try:
        onnx.checker.check_model(model, full_check=True)
    except onnx.checker.ValidationError as error:
        raise BackendError(f"the exported graph is not valid ONNX ({str(error).splitlines()[0]})") from error
    return model


def save_onnx(model: Any, path: str | os.PathLike[str]) -> None:
    """Write an ONNX model to one file, which ends with an entry of metadata: the SHA-256 of all before it."""
    content = model.SerializeToString()
    end = type(model)()
    end.metadata_props.add(key=GRAPH_HASH_KEY, value=hashlib.sha256(content).hexdigest())
    Path(path).write_bytes(content + end.SerializeToString())  # put together, two messages are one


def _reason(error: BaseException) -> str:
    """Return what the tracing failed of in one line; the exporter's own words are advice, in colours."""
    text = re.sub(r"\x1b\[[0-9;]*m", "", str(error.__cause__ or error)).strip()
    return text.split("\n", maxsplit=1)[0] or type(error).__name__


def _name_nodes(model: Any) -> None:
    """Name nodes after the modules they come from, ``lane/up2/conv1/Conv_17``, and drop the exporter's own notes.

    The notes hold stack traces of the machine that exported; the names tell layers apart in profiles, and let INT8
    leave parts of the graph alone.
    """
    for index, node in enumerate(model.graph.node):
        notes = {entry.key: entry.value for entry in node.metadata_props}
        scopes = ast.literal_eval(notes.get("pkg.torch.onnx.name_scopes", "[]"))
        modules = [scope for scope in scopes[:-1] if scope.startswith("network.")]
        path = modules[-1].removeprefix("network.").replace(".", "/") + "/" if modules else ""
        node.name = f"{path}{node.op_type}_{index}"
        del node.metadata_props[:]


def _append_nms(onnx: Any, model: Any, classes: int, thresholds: Thresholds) -> None:
    """Append suppression: detection becomes (1, kept, 5 + classes), best first.

    As after the graph, a box has one class, its most probable, and meets only boxes of that class: its confidence
    stands in the row of that class alone. Of all classes together the best ``max_boxes`` are kept. The IoU is never 0:
    OpenVINO suppresses from the threshold on, ONNX Runtime and this package above it.
    """
    helper, numpy_helper, graph = onnx.helper, onnx.numpy_helper, model.graph
    for node in graph.node:
        for index, name in enumerate(node.output):
            if name == "detection":
                node.output[index] = "detection_all"
        for index, name in enumerate(node.input):
            if name == "detection":
                node.input[index] = "detection_all"

    def const(name: str, value: Any) -> str:
        graph.initializer.append(numpy_helper.from_array(value, f"nms_{name}"))
        return f"nms_{name}"

    def add(operator: str, inputs: list[str], outputs: list[str], **attributes: Any) -> None:
        graph.node.append(helper.make_node(operator, inputs, outputs, name=f"nms_{outputs[0]}", **attributes))

    axis = const("axis", np.array([2], np.int64))

    def cut(name: str, start: int, stop: int) -> str:
        ends = [const(f"{name}_{what}", np.array([at], np.int64)) for what, at in (("start", start), ("stop", stop))]
        add("Slice", ["detection_all", *ends, axis], [name])
        return name

    boxes = cut("nms_boxes", 0, 4)
    objectness, scores = cut("nms_objectness", 4, 5), cut("nms_classes", 5, 5 + classes)
    add("ReduceMax", [scores, axis], ["nms_best"], keepdims=1)
    add("Mul", [objectness, "nms_best"], ["nms_confidence"])
    rows = "nms_confidence"
    if classes > 1:
        rows = "nms_rows"
        add("ArgMax", [scores], ["nms_class"], axis=2, keepdims=1)
        add("Equal", ["nms_class", const("ids", np.arange(classes).reshape(1, 1, -1))], ["nms_own"])
        add("Where", ["nms_own", "nms_confidence", const("none", np.array(0, np.float32))], [rows])
    add("Transpose", [rows], ["nms_scores"], perm=[0, 2, 1])
    limits = [
        const("max", np.array([thresholds.max_boxes], np.int64)),
        const("iou", np.array([max(thresholds.iou, 1e-6)], np.float32)),
        const("score", np.array([thresholds.confidence], np.float32)),
    ]
    add("NonMaxSuppression", [boxes, "nms_scores", *limits], ["nms_selected"], center_point_box=1)
    add("Slice", ["nms_selected", const("two", np.array([2], np.int64)), const("three", np.array([3], np.int64)),
                  const("one", np.array([1], np.int64))], ["nms_column"])  # fmt: skip
    flat = const("flat", np.array([-1], np.int64))
    add("Reshape", ["nms_column", flat], ["nms_index"])
    chosen = "nms_index"
    if classes > 1:  # each class has up to max_boxes, one class after the other
        chosen = "nms_ranked"
        add("Reshape", ["nms_confidence", flat], ["nms_all"])
        add("Gather", ["nms_all", "nms_index"], ["nms_kept"], axis=0)
        add("Shape", ["nms_kept"], ["nms_count"])
        add("Min", ["nms_count", limits[0]], ["nms_k"])
        add("TopK", ["nms_kept", "nms_k"], ["nms_values", "nms_order"], axis=0)
        add("Gather", ["nms_index", "nms_order"], [chosen], axis=0)
    add("Gather", ["detection_all", chosen], ["detection"], axis=1)
    for output in graph.output:
        if output.name == "detection":
            shape = [1, "kept", 5 + classes]
            output.CopyFrom(helper.make_tensor_value_info("detection", onnx.TensorProto.FLOAT, shape))


def _store_half(onnx: Any, model: Any) -> None:
    """Store large float32 weights as fp16, each behind a Cast that runtimes fold away when they load the model."""
    graph = model.graph
    casts = []
    for tensor in list(graph.initializer):
        if tensor.data_type != onnx.TensorProto.FLOAT or np.prod(tensor.dims, dtype=np.int64) < 64:
            continue
        name = tensor.name
        values = onnx.numpy_helper.to_array(tensor).astype(np.float16)
        graph.initializer.remove(tensor)
        graph.initializer.append(onnx.numpy_helper.from_array(values, f"{name}_fp16"))
        casts.append(onnx.helper.make_node("Cast", [f"{name}_fp16"], [name], name=f"{name}_cast", to=1))
    nodes = list(graph.node)
    del graph.node[:]
    graph.node.extend([*casts, *nodes])
