"""INT8: post-training static quantisation of the rewritten graph, symmetric.

Activations are quantised symmetrically: the other way leaves the matrix units of the processor in OpenVINO. NNCF
corrects biases; ONNX Runtime's quantiser does not. Matrix products of the attention and depthwise convolutions stay
out, since they gain nothing; so do, step by step, the layers whose errors reach the results directly, until the scores
stay within a budget (`KEEP_STEPS`).

Weights take 7 of the 8 bits. Processors of x86 without VNNI add two products of 8 bits in 16, which else overflows: on
an AVX2 processor tiny lost 4.5 points of lane IoU so on OpenVINO and 10.9 on ONNX Runtime, and neither the calibration
nor the parity gate of another processor could have told.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from numpy.typing import NDArray

from trilitenet.deploy.quiet import quiet
from trilitenet.errors import ConfigError, import_extra, scratch_folder

__all__ = ["KEEP_STEPS", "kept_nodes", "quantize_onnx", "quantize_openvino"]

KEEP_STEPS: Final[tuple[tuple[str, ...], ...]] = (
    (),
    ("difference", "detection", "c5"),
    ("difference", "detection", "c5", "c4", "out", "stem", "i1", "i2"),
    ("difference", "detection", "c5", "c4", "out", "stem", "i1", "i2", "up2"),
    ("difference", "detection", "c5", "c4", "out", "stem", "i1", "i2", "up2", "up1", "merge", "level2", "b1"),
)
"""Parts of the deploy graph that stay in floating point, one step of the fall-back after the other: nothing; what
decides masks, and the way to the boxes behind the map at 1/16, whose maps are small and which INT8 costs points of
AP50; the rest of that way, and the first and last layers; the heads at 1/2; the heads and the encoder down to 1/4."""


def kept_nodes(names: Sequence[str], parts: Sequence[str]) -> list[str]:
    """Return the nodes that belong to one of the parts.

    Args:
        names: Node names, paths of modules joined by ``/``.
        parts: Names of modules of the deploy graph.
    """
    return [name for name in names if set(parts) & set(name.split("/"))]


def quantize_openvino(model: Any, images: Sequence[NDArray[Any]], keep: Sequence[str] = ()) -> Any:
    """Quantise an OpenVINO model with NNCF.

    Args:
        model: The ``openvino.Model``; it is not changed.
        images: Inputs of the artefact, each with a leading 1, from the training split.
        keep: Parts that stay in floating point, see `KEEP_STEPS`.

    Returns:
        The quantised ``openvino.Model``.

    Raises:
        ConfigError: If there are no images.
        MissingExtraError: If NNCF is not installed.
    """
    _check(images)
    nncf = import_extra("nncf", "int8")
    names = [node.get_friendly_name() for node in model.get_ops() if node.get_type_name() != "Constant"]
    with quiet():
        nncf.set_log_level(logging.ERROR)
        return nncf.quantize(
            model,
            nncf.Dataset(images),
            preset=nncf.QuantizationPreset.PERFORMANCE,
            target_device=nncf.TargetDevice.CPU,
            subset_size=len(images),
            fast_bias_correction=True,
            advanced_parameters=nncf.AdvancedQuantizationParameters(overflow_fix=nncf.OverflowFix.ENABLE),
            ignored_scope=nncf.IgnoredScope(
                names=kept_nodes(names, keep), types=["MatMul", "GroupConvolution"], validate=False
            ),
        )


def quantize_onnx(model: Any, images: Sequence[NDArray[Any]], keep: Sequence[str] = ()) -> Any:
    """Quantise an ONNX model with ONNX Runtime: QDQ, symmetric 8-bit activations, 7-bit weights a channel.

    Activations are unsigned around 128: the same numbers as signed ones around 0, for which x86 has the better kernels.
    Their range is the mean of the frames' ranges: one outlier among the frames would cost small 3 points of lane IoU.

    Args:
        model: The ``onnx.ModelProto``; it is not changed.
        images: Inputs of the artefact, each with a leading 1, from the training split.
        keep: Parts that stay in floating point, see `KEEP_STEPS`.

    Returns:
        The quantised ``onnx.ModelProto``, with the metadata of the model.

    Raises:
        ConfigError: If there are no images.
        MissingExtraError: If ONNX Runtime is not installed.
        OutputError: If there is no room for temporary files.
    """
    _check(images)
    onnx = import_extra("onnx", "onnx")
    quantization = import_extra("onnxruntime.quantization", "onnx")
    shape_inference = import_extra("onnxruntime.quantization.shape_inference", "onnx")
    convolutions = [node for node in model.graph.node if node.op_type == "Conv"]
    depthwise = [
        node.name
        for node in convolutions
        if any(attribute.name == "group" and attribute.i > 1 for attribute in node.attribute)
    ]

    class Frames(quantization.CalibrationDataReader):  # type: ignore[misc, name-defined]
        def __init__(self) -> None:
            self.rest: Iterator[Mapping[str, NDArray[Any]]] = iter({"image": image} for image in images)

        def get_next(self) -> Mapping[str, NDArray[Any]] | None:
            return next(self.rest, None)

    with scratch_folder() as folder, quiet():
        source, prepared, target = (folder / name for name in ("a.onnx", "b.onnx", "c.onnx"))
        source.write_bytes(model.SerializeToString())
        shape_inference.quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        quantization.quantize_static(
            str(prepared),
            str(target),
            Frames(),
            quant_format=quantization.QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            per_channel=True,
            reduce_range=True,
            activation_type=quantization.QuantType.QUInt8,
            weight_type=quantization.QuantType.QInt8,
            nodes_to_exclude=[*depthwise, *kept_nodes([node.name for node in convolutions], keep)],
            extra_options={"ActivationSymmetric": True, "CalibMovingAverage": True},
        )
        quantized = onnx.load(str(target))
    onnx.helper.set_model_props(quantized, {entry.key: entry.value for entry in model.metadata_props})
    return quantized


def _check(images: Sequence[NDArray[Any]]) -> None:
    if not images:
        raise ConfigError("INT8 needs calibration frames; give --calibration with a folder of road frames")
