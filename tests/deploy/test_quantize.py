from __future__ import annotations

import numpy as np
import pytest

from trilitenet.deploy.quantize import quantize_onnx
from trilitenet.errors import ConfigError, OutputError

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


def test_no_room_for_temporary_files_is_told(no_room: str) -> None:
    with pytest.raises(OutputError, match=no_room):
        quantize_onnx(onnx.ModelProto(), [np.zeros((1, 32, 32, 3), np.uint8)])


def test_frames_are_needed() -> None:
    with pytest.raises(ConfigError, match="INT8 needs calibration frames"):
        quantize_onnx(onnx.ModelProto(), [])


def test_kept_parts_and_depthwise_convolutions_stay_in_floating_point() -> None:
    helper, rng = onnx.helper, np.random.default_rng(0)
    nodes, weights, before = [], [], "image"
    for name, shape, groups in (("stem/Conv", (4, 3), 1), ("level2/Conv", (4, 1), 4), ("lane/out/Conv", (2, 4), 1)):
        weight = rng.normal(size=(*shape, 3, 3)).astype(np.float32)
        weights.append(onnx.numpy_helper.from_array(weight, f"{name}_weight"))
        nodes.append(helper.make_node("Conv", [before, f"{name}_weight"], [f"{name}_y"], name=name, group=groups))
        before = f"{name}_y"
    takes, gives = (
        helper.make_tensor_value_info(name, 1, shape)
        for name, shape in (("image", [1, 3, 9, 9]), (before, [1, 2, 3, 3]))
    )
    graph = helper.make_graph(nodes, "g", [takes], [gives], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    helper.set_model_props(model, {"key": "value"})
    images = [np.full((1, 3, 9, 9), level, np.float32) for level in (1, 3)]
    made = quantize_onnx(model, images, ("lane",))
    integers = {node.output[0] for node in made.graph.node if node.op_type == "DequantizeLinear"}
    convolutions = [node for node in made.graph.node if node.op_type == "Conv"]
    assert [node.name for node in convolutions if node.input[1] in integers] == ["stem/Conv"]
    values = {entry.name: onnx.numpy_helper.to_array(entry) for entry in made.graph.initializer}
    (image,) = (node for node in made.graph.node if node.op_type == "QuantizeLinear" and node.input[0] == "image")
    assert values[image.input[1]] == pytest.approx(2 * 2 / 255, rel=0.01)  # of the mean of 1 and 3
    assert {entry.key: entry.value for entry in made.metadata_props} == {"key": "value"}
