"""The ROS 2 package without ROS: strict stand-ins for its messages and for rclpy."""

from __future__ import annotations

import array
import importlib
import importlib.util
import math
import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.ros2 import fakes
from trilitenet.config import ModelCard
from trilitenet.inference.predictor import Predictor
from trilitenet.road.structures import GroundCurve, LaneLine
from trilitenet.structures import Boxes, Perception, RawOutputs

PACKAGE = Path(__file__).resolve().parents[2] / "ros2" / "trilitenet_ros"


@pytest.fixture
def messages(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(PACKAGE))
    return importlib.import_module("trilitenet_ros.messages")


@pytest.fixture
def node_module(messages: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    for name, module in fakes.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "trilitenet_ros.node", raising=False)
    return importlib.import_module("trilitenet_ros.node")


@pytest.fixture
def types(messages: Any) -> Any:
    return messages.Types(
        **{name: getattr(fakes, name) for name in messages.Types.__dataclass_fields__},
    )


@pytest.fixture
def header() -> Any:
    header = fakes.Header()
    header.frame_id = "camera"
    return header


def _image(encoding: str, pixels: np.ndarray, padding: int = 0) -> Any:
    message = fakes.Image()
    message.encoding = encoding
    message.height, message.width = pixels.shape[:2]
    rows = pixels.reshape(pixels.shape[0], -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    message.step = rows.shape[1]
    message.data = array.array("B", rows.astype(np.uint8).tobytes())
    return message


@pytest.mark.parametrize("padding", [0, 5])
def test_images_of_every_encoding_become_rgb(messages: Any, rng: np.random.Generator, padding: int) -> None:
    rgb = rng.integers(0, 256, (4, 6, 3), dtype=np.uint8)
    alpha = np.full((4, 6, 1), 9, np.uint8)
    stored = {
        "rgb8": rgb,
        "bgr8": rgb[..., ::-1],
        "rgba8": np.concatenate([rgb, alpha], axis=2),
        "bgra8": np.concatenate([rgb[..., ::-1], alpha], axis=2),
    }
    for encoding, pixels in stored.items():
        np.testing.assert_array_equal(messages.read_image(_image(encoding, pixels, padding)), rgb)
    grey = messages.read_image(_image("mono8", rgb[..., :1], padding))
    np.testing.assert_array_equal(grey, np.repeat(rgb[..., :1], 3, axis=2))


def test_images_that_cannot_be_are_refused(messages: Any) -> None:
    with pytest.raises(ValueError, match="16UC1"):
        messages.read_image(_image("16UC1", np.zeros((2, 2, 2), np.uint8)))
    short = _image("rgb8", np.zeros((2, 2, 3), np.uint8))
    short.height = 3
    with pytest.raises(ValueError, match="cannot have 12 bytes"):
        messages.read_image(short)


def test_boxes_become_detections(messages: Any, types: Any, header: Any) -> None:
    boxes = Boxes(
        np.array([[10, 20, 30, 60], [0, 0, 5, 5]], np.float32),
        np.array([0.75, 0.5], np.float32),
        np.array([1, 0]),
        np.array([7, -1]),
    )
    filled = messages.fill_detections(Perception((100, 200), ("car", "bus"), boxes), header, types)
    first, second = filled.detections
    assert (first.bbox.center.position.x, first.bbox.center.position.y) == (20.0, 40.0)
    assert (first.bbox.size_x, first.bbox.size_y) == (20.0, 40.0)
    assert (first.results[0].hypothesis.class_id, first.results[0].hypothesis.score) == ("bus", 0.75)
    assert (first.id, second.id) == ("7", "")
    assert filled.header is first.header is header
    nothing = Perception((9, 9), boxes=Boxes.empty())
    assert messages.fill_detections(nothing, header, types).detections == []


def test_masks_become_mono8(messages: Any, types: Any, header: Any) -> None:
    mask = np.zeros((3, 5), bool)
    mask[1, 2:] = True
    filled = messages.fill_mask(mask, header, types)
    assert (filled.height, filled.width, filled.step, filled.encoding) == (3, 5, 5, "mono8")
    np.testing.assert_array_equal(messages.read_image(filled)[..., 0], mask * np.uint8(255))


def _line(position: int, ground: GroundCurve | None) -> LaneLine:
    return LaneLine(0, position, np.zeros((2, 2), np.float32), np.zeros(6), (0.0, 1.0), 0.0, 1.0, ground)


def test_lanes_become_paths_that_point_along_them(messages: Any, types: Any, header: Any) -> None:
    curve = GroundCurve(np.array([1.5, 0.1, 0.01, 0.0]), 5.0, 20.0)
    path = messages.fill_path(_line(-1, curve), header, types)
    assert len(path.poses) == 16
    last = path.poses[-1].pose
    assert last.position.x == 20.0
    assert last.position.y == pytest.approx(1.5 + 2.0 + 4.0)
    assert 2 * math.atan2(last.orientation.z, last.orientation.w) == pytest.approx(math.atan(0.1 + 0.02 * 20))
    assert messages.fill_path(_line(1, None), header, types) is None


class _Backend:
    name = "fake"
    canvas = None
    card = ModelCard("tiny")

    def run(self, batch: np.ndarray) -> RawOutputs:
        count, height, width, _ = batch.shape
        detection = np.zeros((count, 1, 6), np.float32)
        detection[:, 0] = [width / 2, height / 2, 20, 20, 0.9, 1.0]
        mask = np.zeros((count, height, width), np.uint8)
        return RawOutputs(detection, mask, mask)

    def close(self) -> None: ...


def test_the_node_publishes_what_is_seen(node_module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trilitenet.load", lambda model, **options: Predictor(_Backend()), raising=False)
    node = node_module.PerceptionNode()
    message = _image("bgr8", np.zeros((96, 160, 3), np.uint8))
    for second in range(3):
        message.header.stamp.sec = 100 + second
        node.subscriptions["image"](message)
    counts = {topic: len(publisher.published) for topic, publisher in node.publishers.items()}
    assert counts == {"~/detections": 3, "~/drivable": 3, "~/lane_markings": 3, "~/lane_left": 0, "~/lane_right": 0}
    (detection,) = node.publishers["~/detections"].published[0].detections
    assert detection.bbox.center.position.x == pytest.approx(80, abs=1)
    message.encoding = "yuv422"
    node.subscriptions["image"](message)
    assert "yuv422" in node.messages[-1]
    message.encoding, message.height = "bgr8", 0
    node.subscriptions["image"](message)
    assert "(0, 160, 3)" in node.messages[-1]


def test_pictures_without_a_stamp_are_as_far_apart_as_they_come(
    node_module: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trilitenet.load", lambda model, **options: Predictor(_Backend()), raising=False)
    node = node_module.PerceptionNode()
    seen: list[float] = []
    monitor = node._monitor

    def noted(perception: Any) -> Any:
        seen.append(perception.timestamp)
        return monitor(perception)

    monkeypatch.setattr(node, "_monitor", noted)
    for _ in range(3):
        node.subscriptions["image"](_image("bgr8", np.zeros((96, 160, 3), np.uint8)))
    assert seen == [0.0, 1.0, 2.0]


def test_a_model_without_detection_publishes_no_detections(node_module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    backend = _Backend()
    monkeypatch.setattr(backend, "run", lambda batch: RawOutputs(None, *(np.zeros(batch.shape[:3], np.uint8),) * 2))
    monkeypatch.setattr("trilitenet.load", lambda model, **options: Predictor(backend), raising=False)
    node = node_module.PerceptionNode()
    node.subscriptions["image"](_image("bgr8", np.zeros((96, 160, 3), np.uint8)))
    assert [len(node.publishers[topic].published) for topic in ("~/detections", "~/drivable")] == [0, 1]


def test_a_camera_file_of_another_shape_is_told_and_the_rest_published(
    node_module: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("trilitenet.load", lambda model, **options: Predictor(_Backend()), raising=False)
    file = tmp_path / "camera.yaml"
    file.write_text("image_width: 100\nimage_height: 100\nheight: 1.5\nfield_of_view: 60\n", encoding="utf-8")
    monkeypatch.setattr(fakes.Node, "overrides", {"camera_file": str(file)})
    node = node_module.PerceptionNode()
    for count in (1, 2):
        node.subscriptions["image"](_image("bgr8", np.zeros((96, 160, 3), np.uint8)))
        assert len(node.publishers["~/detections"].published) == count
    assert "the camera file is for 100x100 pixels" in "".join(node.messages)


@pytest.mark.parametrize(
    "parameters",
    [
        {"model": "nomodel"},
        {"camera_file": "missing.yaml"},
        {"ego_mask": "missing.png"},
        {"confidence": 2.0},
        {"confidence": 1},
        {"confidence": "x"},
    ],
)
def test_a_wrong_parameter_is_one_line(
    node_module: Any, monkeypatch: pytest.MonkeyPatch, parameters: dict[str, Any]
) -> None:
    monkeypatch.setattr(fakes.Node, "overrides", parameters)
    with pytest.raises(SystemExit) as ended:
        node_module.main()
    assert re.fullmatch(r"error: .*(nomodel|missing\.yaml|missing\.png|confidence).*", str(ended.value.code))


@pytest.mark.parametrize("interrupted", ["load", "spin"])
@pytest.mark.parametrize("stop", [KeyboardInterrupt, fakes.ExternalShutdownError])
def test_a_node_that_is_told_to_stop_ends_quietly(
    node_module: Any, monkeypatch: pytest.MonkeyPatch, stop: type[BaseException], interrupted: str
) -> None:
    def end(*_: Any, **__: Any) -> None:
        raise stop

    ended: list[bool] = []
    monkeypatch.setattr(node_module.rclpy, "try_shutdown", lambda: ended.append(True))
    monkeypatch.setattr("trilitenet.load", lambda model, **options: Predictor(_Backend()), raising=False)
    monkeypatch.setattr({"load": "trilitenet.load", "spin": "rclpy.spin"}[interrupted], end)
    node_module.main()
    assert ended == [True]


def test_parameters_cannot_be_set_to_no_effect(node_module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trilitenet.load", lambda model, **options: Predictor(_Backend()), raising=False)
    assert node_module.PerceptionNode().settable == set()


def test_the_documented_topics_are_those_of_the_node(node_module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trilitenet.load", lambda model, **options: Predictor(_Backend()), raising=False)
    node = node_module.PerceptionNode()
    text = (PACKAGE.parents[1] / "docs" / "serving.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"^\| Topic \|.*\n((?:\|.*\n)+)", text, re.MULTILINE)
    documented = re.findall(r"`([^`]+)`", "".join(row.split("|")[1] for row in table.splitlines()))
    assert documented == [*node.subscriptions, *node.publishers]


def test_the_launch_file_takes_a_file_of_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, module in fakes.launch_modules(PACKAGE).items():
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location("launch_file", PACKAGE / "launch" / "trilitenet.launch.py")
    assert spec is not None
    assert spec.loader is not None
    launch_file = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(launch_file)
    *arguments, node = launch_file.generate_launch_description()
    defaults = {name: options["default_value"] for (name,), options in arguments}
    assert defaults == {"image": "/camera/image_raw", "parameters": str(PACKAGE / "config" / "trilitenet.yaml")}
    assert node[1]["parameters"] == ["$parameters"]
    assert node[1]["remappings"] == [("image", "$image")]


def test_the_package_is_described_once_and_alike() -> None:
    manifest = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert manifest.findtext("name") == PACKAGE.name
    needed = {element.text for element in manifest.findall("exec_depend")}
    source = (PACKAGE / "trilitenet_ros" / "node.py").read_text(encoding="utf-8")
    for package in ("rclpy", "rcl_interfaces", "geometry_msgs", "nav_msgs", "sensor_msgs", "vision_msgs"):
        assert f"from {package}" in source
        assert package in needed
    parameters = yaml.safe_load((PACKAGE / "config" / "trilitenet.yaml").read_text(encoding="utf-8"))
    for name in parameters["trilitenet"]["ros__parameters"]:
        assert f'_parameter("{name}"' in source
    assert f'version="{manifest.findtext("version")}"' in (PACKAGE / "setup.py").read_text(encoding="utf-8")
    assert (PACKAGE / "resource" / PACKAGE.name).exists()
