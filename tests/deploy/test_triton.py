from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from trilitenet.config import ARTEFACT_KEY, ArtefactInfo, ModelCard
from trilitenet.deploy.triton import write_triton_repository
from trilitenet.errors import OutputError, WeightsError

onnx = pytest.importorskip("onnx")
text_format = pytest.importorskip("google.protobuf.text_format")


def triton_schema() -> Any:
    """Return Triton's own definition of config.pbtxt, out of tritonclient, without the gRPC around it."""
    package = pytest.importorskip("tritonclient")
    path = Path(next(iter(package.__path__))) / "grpc" / "model_config_pb2.py"
    spec = importlib.util.spec_from_file_location("model_config_pb2", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def schema() -> Any:
    return triton_schema()


def _artefact(path: Path, info: ArtefactInfo | None = None) -> Path:
    """A graph with an input, outputs and metadata like the network's."""
    helper = onnx.helper
    image = helper.make_tensor_value_info("image", onnx.TensorProto.UINT8, [1, 384, 640, 3])
    lane = helper.make_tensor_value_info("lane", onnx.TensorProto.UINT8, [1, 384, 640, 3])
    boxes = helper.make_tensor_value_info("detection", onnx.TensorProto.FLOAT, [1, "candidates", 6])
    weight = helper.make_tensor("weight", onnx.TensorProto.FLOAT, [1, 1, 6], np.zeros(6, np.float32))
    nodes = [helper.make_node("Identity", ["image"], ["lane"]), helper.make_node("Identity", ["weight"], ["detection"])]
    listed = helper.make_tensor_value_info("weight", onnx.TensorProto.FLOAT, [1, 1, 6])  # as older graphs do
    graph = helper.make_graph(nodes, "network", [image, listed], [boxes, lane], [weight])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, {ARTEFACT_KEY: (info or ArtefactInfo("onnx", size=(384, 640))).to_json()})
    onnx.save(model, path)
    return path


def parse_config(schema: Any, model: Path) -> Any:
    """Return the configuration of a model in a repository."""
    return text_format.Parse((model / "config.pbtxt").read_text(encoding="utf-8"), schema.ModelConfig())


def test_the_config_says_what_the_artefact_is(tmp_path: Path, schema: Any) -> None:
    card = ModelCard("small", class_names=("car", 'a "quoted"\nname'), licence="frei, für alle")
    info = ArtefactInfo("onnx", "fp16", (384, 640), colour="bgr", masks="probability", mask_scale=2, nms=True)
    artefact = _artefact(tmp_path / "x.onnx", info)
    model = write_triton_repository(artefact, tmp_path / "repository", card)
    config = parse_config(schema, model)
    assert (config.name, config.backend, config.max_batch_size) == ("trilitenet_small", "onnxruntime", 0)
    assert model.name == config.name
    (image,) = config.input
    assert (image.name, image.data_type, list(image.dims)) == ("image", schema.TYPE_UINT8, [1, 384, 640, 3])
    assert [(o.name, o.data_type, list(o.dims)) for o in config.output] == [
        ("detection", schema.TYPE_FP32, [1, -1, 6]),
        ("lane", schema.TYPE_UINT8, [1, 384, 640, 3]),
    ]
    assert config.instance_group[0].kind == schema.ModelInstanceGroup.KIND_AUTO
    assert ModelCard.from_json(config.parameters["trilitenet.card"].string_value, "x") == card
    assert ArtefactInfo.from_json(config.parameters["trilitenet.artefact"].string_value, "x") == info
    assert (model / "1" / "model.onnx").read_bytes() == artefact.read_bytes()


def test_a_model_is_replaced_whole(tmp_path: Path) -> None:
    artefact = _artefact(tmp_path / "x.onnx")
    repository = tmp_path / "repository"
    name = "m" * 255  # as long as file systems take names
    model = write_triton_repository(artefact, repository, ModelCard("tiny"), name=name)
    (model / "1" / "model.onnx").write_text("old")
    with pytest.raises(OutputError, match="exists already"):
        write_triton_repository(artefact, repository, ModelCard("tiny"), name=name)
    assert write_triton_repository(artefact, repository, ModelCard("base"), name=name, overwrite=True) == model
    assert [path.name for path in sorted(model.rglob("*"))] == ["1", "model.onnx", "config.pbtxt"]
    assert (model / "1" / "model.onnx").read_bytes() == artefact.read_bytes()
    assert "base" in (model / "config.pbtxt").read_text(encoding="utf-8")
    assert [path.name for path in repository.iterdir()] == [name]


def test_what_a_user_keeps_beside_a_model_stays(tmp_path: Path) -> None:
    artefact = _artefact(tmp_path / "x.onnx")
    model = write_triton_repository(artefact, tmp_path / "repository", ModelCard("tiny"))
    own = {name: model / name for name in ("labels.txt", "1/warm-up", "2/model.onnx", "2/1/config.pbtxt")}
    for name, path in own.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(name)
    (model / "3").symlink_to("2", target_is_directory=True)
    write_triton_repository(artefact, tmp_path / "repository", ModelCard("tiny"), overwrite=True)
    assert {name: path.read_text() for name, path in own.items()} == {name: name for name in own}
    assert (model / "3").readlink() == Path("2")


def test_types_are_named_as_triton_names_them(tmp_path: Path) -> None:
    helper, kinds = onnx.helper, {"FLOAT16": "FP16", "BOOL": "BOOL", "INT64": "INT64", "DOUBLE": "FP64"}
    values = [helper.make_tensor_value_info(kind, getattr(onnx.TensorProto, kind), [1]) for kind in kinds]
    outputs = [helper.make_tensor_value_info(f"{kind}2", getattr(onnx.TensorProto, kind), [1]) for kind in kinds]
    nodes = [helper.make_node("Identity", [kind], [f"{kind}2"]) for kind in kinds]
    model = helper.make_model(helper.make_graph(nodes, "g", values, outputs), ir_version=9)
    helper.set_model_props(model, {ARTEFACT_KEY: ArtefactInfo("onnx").to_json()})
    onnx.save(model, tmp_path / "a.onnx")
    config = write_triton_repository(tmp_path / "a.onnx", tmp_path / "out", ModelCard("tiny")) / "config.pbtxt"
    assert re.findall(r"data_type: TYPE_(\w+)", config.read_text(encoding="utf-8")) == [*kinds.values()] * 2


def test_a_broken_graph_is_named(tmp_path: Path) -> None:
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"\xff\xfe\xfd no model")
    with pytest.raises(WeightsError, match="no ONNX model"):
        write_triton_repository(broken, tmp_path / "repository", ModelCard("tiny"))
    assert not (tmp_path / "repository").exists()


def test_a_graph_that_does_not_say_what_it_takes_is_refused(tmp_path: Path) -> None:
    model = onnx.load(str(_artefact(tmp_path / "x.onnx")))
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "x.onnx")
    with pytest.raises(WeightsError, match=r"x\.onnx: no 'trilitenet\.artefact' in its metadata; export it with"):
        write_triton_repository(tmp_path / "x.onnx", tmp_path / "repository", ModelCard("tiny"))
    assert not (tmp_path / "repository").exists()


def test_a_repository_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match="file: cannot be written"):
        write_triton_repository(_artefact(tmp_path / "x.onnx"), tmp_path / "file", ModelCard("tiny"))
