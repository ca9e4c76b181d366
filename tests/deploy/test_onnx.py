from __future__ import annotations

import logging
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.artefacts import SIZE, Artefacts
from tests.deploy.networks import lively_network
from trilitenet.config import ARTEFACT_KEY, CARD_KEY, GRAPH_HASH_KEY, ArtefactInfo, Thresholds
from trilitenet.deploy import onnx as deploy_onnx
from trilitenet.deploy.graph import DeployGraph
from trilitenet.deploy.layouts import LAYOUTS, pick_layout
from trilitenet.deploy.onnx import PORTABLE_OPERATORS, build_onnx, save_onnx
from trilitenet.deploy.quantize import KEEP_STEPS, kept_nodes
from trilitenet.deploy.quiet import quiet
from trilitenet.deploy.tensorrt import trtexec_line
from trilitenet.errors import BackendError, ConfigError
from trilitenet.inference.openvino_backend import openvino_core
from trilitenet.processing.boxes import cxcywh_to_xyxy
from trilitenet.processing.nms import nms

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")


def test_a_program_that_is_not_ours_accepts_it(artefacts: Artefacts) -> None:
    model = onnx.load(str(artefacts.folder / "model.onnx"))
    onnx.checker.check_model(model, full_check=True)
    assert [value.name for value in model.graph.output] == ["detection", "drivable", "lane"]
    assert [entry.key for entry in model.metadata_props] == [CARD_KEY, ARTEFACT_KEY, GRAPH_HASH_KEY]
    names = [node.name for node in model.graph.node]
    assert len(set(names)) == len(names)
    assert any(name.startswith("lane/up2/conv1/Conv") for name in names)
    assert str(Path(__file__).parent) not in str(model)
    noted = [*model.graph.node, *model.graph.input, *model.graph.output, *model.graph.value_info]
    assert not [part.name for part in noted if part.metadata_props]  # the exporter writes stack traces there
    assert (model.producer_name, model.producer_version) == ("trilitenet", "0")


def test_suppression_inside_keeps_what_suppression_outside_keeps(tmp_path: Path) -> None:
    from trilitenet.inference.onnx_backend import OnnxBackend
    from trilitenet.inference.torch_backend import TorchBackend
    from trilitenet.processing.letterbox import Letterbox
    from trilitenet.processing.postprocess import to_perceptions

    network = lively_network(classes=3, tasks=("detection",))
    images = np.random.default_rng(0).integers(0, 256, (2, *SIZE, 3), np.uint8)
    images[0] //= 2  # so that the other has more boxes
    outside = TorchBackend(network, "cpu").run(images)
    assert outside.detection is not None
    scores = np.sort(outside.detection[0, :, 4] * outside.detection[0, :, 5:].max(1))
    thresholds = Thresholds(confidence=float((scores[-100] + scores[-101]) / 2), iou=0.5)
    info = ArtefactInfo("onnx", size=SIZE, nms=True)
    save_onnx(build_onnx(DeployGraph(network), network.card, info, nms=thresholds), tmp_path / "a.onnx")
    inside = OnnxBackend(tmp_path / "a.onnx").run(images)
    assert inside.detection is not None
    kept = (inside.detection[..., 4] > 0).sum(1)
    assert 1 < kept[0] < kept[1] < 200
    letterboxes = [Letterbox.fit(SIZE, canvas=SIZE)] * 2
    found = [to_perceptions(raw, letterboxes, thresholds, network.card.class_names) for raw in (inside, outside)]
    for one, other in zip(*found, strict=True):
        assert one.boxes is not None
        assert other.boxes is not None
        assert len(one.boxes) == len(other.boxes)
        assert np.abs(np.sort(one.boxes.confidence) - np.sort(other.boxes.confidence)).max() < 1e-4


@pytest.mark.parametrize(("classes", "size", "bgr"), [(1, SIZE, False), (3, (96, 64), True)])
def test_portable_graphs_keep_to_their_operators(classes: int, size: tuple[int, int], bgr: bool) -> None:
    network = lively_network(classes=classes)
    info = ArtefactInfo("onnx", size=size, input="float_nchw", masks="logit")
    model = build_onnx(DeployGraph(network, LAYOUTS["planar"], masks="logit", bgr=bgr), network.card, info)
    assert {node.op_type for node in model.graph.node} <= PORTABLE_OPERATORS
    inferred = onnx.shape_inference.infer_shapes(model)
    ranks = [len(value.type.tensor_type.shape.dim) for value in inferred.graph.value_info]
    assert max(ranks) <= 4


@pytest.mark.slow
def test_dynamic_sizes_and_half_weights(tmp_path: Path) -> None:
    from trilitenet.inference.onnx_backend import OnnxBackend
    from trilitenet.inference.torch_backend import TorchBackend

    network = lively_network(tasks=("lane",))
    info = ArtefactInfo("onnx", "fp16", None)
    model = build_onnx(DeployGraph(network, LAYOUTS["vectors-tiny"]), network.card, info, half=True)
    save_onnx(model, tmp_path / "a.onnx")
    backend = OnnxBackend(tmp_path / "a.onnx")
    assert backend.canvas is None
    for size in ((64, 128), (96, 64)):
        image = np.random.default_rng(0).integers(0, 256, (1, *size, 3), np.uint8)
        got, wanted = backend.run(image), TorchBackend(network, "cpu").run(image)
        assert got.lane is not None
        assert wanted.lane is not None
        assert np.mean((got.lane > 0) == (wanted.lane > 127)) > 0.99


def test_what_cannot_be_traced_is_one_plain_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_args: object, **_options: object) -> None:
        cause = RuntimeError("Expected \x1b[1mshape[1] = 360\x1b[0m to be of the form 32*rows\n\nadvice")
        raise torch.onnx.errors.OnnxExporterError("\x1b[96mThis is step 1/3\x1b[0m. Next steps:\n- ...") from cause

    monkeypatch.setattr(torch.onnx, "export", fail)
    network = lively_network()
    talkers = [logging.getLogger(name) for name in ("torch.onnx", "onnx_ir")]
    levels = [talker.level for talker in talkers]
    with pytest.raises(BackendError, match=r"\(Expected shape\[1\] = 360 to be of the form 32\*rows\)$"):
        build_onnx(DeployGraph(network, LAYOUTS["vectors-tiny"]), network.card, ArtefactInfo("onnx"))
    assert [talker.level for talker in talkers] == levels


def test_large_weights_are_stored_by_half() -> None:
    import onnxruntime

    helper = onnx.helper
    x = helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 64])
    y = helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1, 63])
    matrix = np.random.default_rng(0).random((64, 63), np.float32)
    small = np.full(63, 1 / 3, np.float32)
    weights = [onnx.numpy_helper.from_array(matrix, "matrix"), onnx.numpy_helper.from_array(small, "small")]
    nodes = [helper.make_node("MatMul", ["x", "matrix"], ["z"]), helper.make_node("Add", ["z", "small"], ["y"])]
    graph = helper.make_graph(nodes, "g", [x], [y], weights)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    deploy_onnx._store_half(onnx, model)
    onnx.checker.check_model(model, full_check=True)
    kinds = {entry.name: entry.data_type for entry in model.graph.initializer}
    assert kinds == {"small": onnx.TensorProto.FLOAT, "matrix_fp16": onnx.TensorProto.FLOAT16}
    (got,) = onnxruntime.InferenceSession(model.SerializeToString()).run(None, {"x": np.ones((1, 64), np.float32)})
    np.testing.assert_allclose(got[0], matrix.astype(np.float16).astype(np.float32).sum(0) + small, rtol=1e-5)


def test_layouts_are_picked() -> None:
    assert pick_layout("auto", "tiny", "openvino", unit="amx") == LAYOUTS["tiles-tiny"]
    assert pick_layout("auto", "base", "openvino", unit="avx512") == LAYOUTS["vectors-base"]
    assert pick_layout("auto", "tiny", "openvino", unit="other") == LAYOUTS["vectors-small"]
    assert pick_layout("auto", "base", "torch-cuda") == LAYOUTS["pixels"]
    assert pick_layout("auto", "base", "torch-cpu") == LAYOUTS["vectors-base"]
    assert pick_layout("auto", "tiny", "onnxruntime") == LAYOUTS["planar-maximum-heads"]
    assert pick_layout("auto", "base", "onnxruntime") == LAYOUTS["planar-maximum-split"]
    assert pick_layout("auto", "tiny", "planar") == LAYOUTS["planar"]
    with pytest.raises(ConfigError, match="did you mean 'pixels'"):
        pick_layout("pixel", "tiny", "openvino")


def test_kept_nodes_follow_modules() -> None:
    names = ["stem/Conv_1", "lane/out/Conv_2", "lane/up2/conv1/Conv_3", "detection/heads/0/Conv_4"]
    assert kept_nodes(names, KEEP_STEPS[0]) == []
    assert kept_nodes(names, KEEP_STEPS[1]) == ["detection/heads/0/Conv_4"]
    assert set(kept_nodes(names, KEEP_STEPS[3])) == set(names)
    assert kept_nodes(["pcaa/merge2/Conv_1", "stem2/Conv_2"], KEEP_STEPS[4]) == []  # whole names of modules


def test_quantisers_are_quiet_and_others_heard_again(caplog: pytest.LogCaptureFixture) -> None:
    log = logging.getLogger("somebody")
    with quiet():
        log.warning("of the quantiser")
    log.warning("of others")
    assert caplog.messages == ["of others"]


def test_other_threads_and_errors_are_heard_beside_quantisers(caplog: pytest.LogCaptureFixture) -> None:
    with quiet(), ThreadPoolExecutor(1) as others:
        new = logging.getLogger("somebody.new")
        new.addHandler(caplog.handler)
        new.propagate = False
        for log in (logging.getLogger("somebody"), logging.root, new):
            log.warning("of the quantiser")
            others.submit(log.warning, "of others").result()
            log.error("an error")
    new.removeHandler(caplog.handler)
    assert caplog.messages == ["of others", "an error"] * 3


def test_quantisers_of_two_threads_leave_the_process_as_it_was() -> None:
    before = sys.stdout, logging.Logger.handle, list(warnings.filters)
    entered = threading.Event()

    def quantise() -> None:
        with quiet():
            entered.set()

    first, other = quiet(), threading.Thread(target=quantise)
    with first:
        other.start()
        assert not entered.wait(0.2)
    other.join()
    assert (sys.stdout, logging.Logger.handle, list(warnings.filters)) == before


def test_trtexec_line() -> None:
    line = trtexec_line(Path("a b.onnx"), Path("a.plan"), "fp16")
    assert line == "trtexec '--onnx=a b.onnx' --saveEngine=a.plan --fp16 --useCudaGraph"
    assert trtexec_line(Path("a"), Path("b"), "bf16") == "trtexec --onnx=a --saveEngine=b --bf16 --useCudaGraph"
    assert trtexec_line(Path("a"), Path("b"), "fp32") == "trtexec --onnx=a --saveEngine=b --useCudaGraph"


@pytest.mark.parametrize(("classes", "most"), [(1, 300), (80, 300), (80, 25)])
def test_suppression_inside_is_exact_for_any_number_of_classes(classes: int, most: int) -> None:
    import onnxruntime

    rng = np.random.default_rng(5)
    rows = np.zeros((1, 300, 5 + classes), np.float32)
    rows[0, :, :2], rows[0, :, 2:4] = rng.uniform(0, 60, (300, 2)), rng.uniform(5, 15, (300, 2))
    rows[0, :, 4] = rng.uniform(0.3, 1, 300)
    rows[0, :, 5:] = rng.uniform(0, 0.2, (300, classes))
    rows[0, np.arange(300), 5 + rng.choice([0, classes - 1], 300)] = 0.9
    helper = onnx.helper
    value = {name: helper.make_tensor_value_info(name, 1, list(rows.shape)) for name in ("rows", "detection")}
    graph = helper.make_graph(
        [helper.make_node("Identity", ["rows"], ["detection"])], "g", [value["rows"]], [value["detection"]]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    thresholds = Thresholds(confidence=0.4, iou=0.4, max_boxes=most)
    deploy_onnx._append_nms(onnx, model, classes, thresholds)
    onnx.checker.check_model(model, full_check=True)
    (output,) = model.graph.output
    shape = [axis.dim_param or axis.dim_value for axis in output.type.tensor_type.shape.dim]
    assert shape == [1, "kept", 5 + classes]
    (inside,) = onnxruntime.InferenceSession(model.SerializeToString()).run(None, {"rows": rows})
    confidence, class_id = rows[0, :, 4] * rows[0, :, 5:].max(1), rows[0, :, 5:].argmax(1)
    likely = (confidence > 0.4).nonzero()[0]
    boxes = cxcywh_to_xyxy(rows[0, likely, :4])
    outside = likely[nms(boxes, confidence[likely], class_id[likely], 0.4, most)]
    np.testing.assert_array_equal(inside[0], rows[0, outside])


@pytest.mark.parametrize("runtime", ["onnxruntime", "openvino"])
def test_suppression_inside_at_an_iou_of_0_leaves_boxes_that_do_not_touch(runtime: str) -> None:
    rows = np.array([[[10, 10, 8, 8, 0.9, 1], [11, 10, 8, 8, 0.8, 1], [40, 10, 8, 8, 0.7, 1]]], np.float32)
    helper = onnx.helper
    value = {name: helper.make_tensor_value_info(name, 1, list(rows.shape)) for name in ("rows", "detection")}
    node = helper.make_node("Identity", ["rows"], ["detection"])
    graph = helper.make_graph([node], "g", [value["rows"]], [value["detection"]])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    deploy_onnx._append_nms(onnx, model, 1, Thresholds(confidence=0.4, iou=0.0))
    if runtime == "onnxruntime":
        session = pytest.importorskip("onnxruntime").InferenceSession(model.SerializeToString())
        (kept,) = session.run(None, {"rows": rows})
    else:
        core = openvino_core(pytest.importorskip("openvino"))
        kept = core.compile_model(core.read_model(model.SerializeToString(), b""), "CPU")([rows])[0]
    np.testing.assert_allclose(kept[0], rows[0, [0, 2]], rtol=1e-2)


def test_an_interruption_while_pytorch_imports_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object, **__: object) -> None:
        try:
            try:
                raise KeyboardInterrupt
            finally:
                raise AttributeError("module 'torch._dynamo' has no attribute 'exc'")
        except AttributeError as error:
            raise RuntimeError("cannot be exported") from error

    monkeypatch.setattr(torch.onnx, "export", interrupted)
    network = lively_network()
    with pytest.raises(KeyboardInterrupt):
        build_onnx(DeployGraph(network), network.card, ArtefactInfo("onnx", size=SIZE))
