"""Message classes with the fields, and the strictness about types, of those that ROS 2 generates."""

from __future__ import annotations

import array
import types
from os import PathLike
from typing import Any, ClassVar


class Message:
    """Takes only the fields of its definition, and only values of their types."""

    fields: ClassVar[dict[str, type]] = {}

    def __init__(self) -> None:
        for name, kind in self.fields.items():
            super().__setattr__(name, array.array("B") if kind is array.array else kind())

    def __setattr__(self, name: str, value: Any) -> None:
        assert name in self.fields, f"{type(self).__name__} has no field {name}"
        kind = self.fields[name]
        assert isinstance(value, kind), (
            f"{type(self).__name__}.{name} takes {kind.__name__}, got {type(value).__name__}"
        )
        super().__setattr__(name, value)

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"{type(self).__name__} has no field {name}")


def _message(name: str, **fields: type) -> type[Message]:
    return type(name, (Message,), {"fields": fields})


Time = _message("Time", sec=int, nanosec=int)
Header = _message("Header", stamp=Time, frame_id=str)
Image = _message(
    "Image", header=Header, height=int, width=int, encoding=str, is_bigendian=int, step=int, data=array.array
)
Point2D = _message("Point2D", x=float, y=float)
Pose2D = _message("Pose2D", position=Point2D, theta=float)
BoundingBox2D = _message("BoundingBox2D", center=Pose2D, size_x=float, size_y=float)
ObjectHypothesis = _message("ObjectHypothesis", class_id=str, score=float)
ObjectHypothesisWithPose = _message("ObjectHypothesisWithPose", hypothesis=ObjectHypothesis)
Detection2D = _message("Detection2D", header=Header, results=list, bbox=BoundingBox2D, id=str)
Detection2DArray = _message("Detection2DArray", header=Header, detections=list)
Point = _message("Point", x=float, y=float, z=float)
Quaternion = _message("Quaternion", x=float, y=float, z=float, w=float)
Pose = _message("Pose", position=Point, orientation=Quaternion)
PoseStamped = _message("PoseStamped", header=Header, pose=Pose)
Path = _message("Path", header=Header, poses=list)


class ParameterDescriptor:
    def __init__(self, *, read_only: bool = False) -> None:
        self.read_only = read_only


class ParameterError(Exception):
    pass


class ExternalShutdownError(Exception):
    pass


class Publisher:
    def __init__(self) -> None:
        self.published: list[Any] = []

    def publish(self, message: Any) -> None:
        self.published.append(message)


class Node:
    """The part of rclpy's node that is used."""

    def __init__(self, name: str) -> None:
        self.publishers: dict[str, Publisher] = {}
        self.subscriptions: dict[str, Any] = {}
        self.messages: list[str] = []
        self.looks = 0
        self.settable: set[str] = set()

    overrides: ClassVar[dict[str, Any]] = {}

    def declare_parameter(self, name: str, default: Any, descriptor: ParameterDescriptor | None = None) -> Any:
        value = self.overrides.get(name, default)
        if type(value) is not type(default):  # InvalidParameterTypeException
            raise ParameterError(
                f"Trying to set parameter '{name}' to '{value}' of type '{type(value).__name__}', "
                f"expecting type '{type(default).__name__}'"
            )
        if descriptor is None or not descriptor.read_only:
            self.settable.add(name)
        return types.SimpleNamespace(value=value)

    def get_clock(self) -> Any:
        """Return a clock that goes on by a second each time it is looked at."""
        self.looks += 1
        now = types.SimpleNamespace(sec=1000 + self.looks, nanosec=0)
        return types.SimpleNamespace(now=lambda: types.SimpleNamespace(to_msg=lambda: now))

    def create_publisher(self, kind: type, topic: str, depth: int) -> Publisher:
        self.publishers[topic] = Publisher()
        return self.publishers[topic]

    def create_subscription(self, kind: type, topic: str, callback: Any, profile: Any) -> None:
        self.subscriptions[topic] = callback

    def get_logger(self) -> Any:
        def log(text: str, **options: Any) -> None:
            self.messages.append(text)

        return types.SimpleNamespace(info=log, error=log)


def module(name: str, **names: Any) -> types.ModuleType:
    made = types.ModuleType(name)
    made.__dict__.update(names)
    return made


def launch_modules(share: PathLike[str]) -> dict[str, types.ModuleType]:
    """Return what a launch file imports; actions become their arguments."""

    def action(*arguments: Any, **options: Any) -> Any:
        return arguments, options

    return {
        "ament_index_python": module("ament_index_python"),
        "ament_index_python.packages": module(
            "ament_index_python.packages", get_package_share_directory=lambda name: str(share)
        ),
        "launch": module("launch", LaunchDescription=list),
        "launch.actions": module("launch.actions", DeclareLaunchArgument=action),
        "launch.substitutions": module("launch.substitutions", LaunchConfiguration=lambda name: f"${name}"),
        "launch_ros": module("launch_ros"),
        "launch_ros.actions": module("launch_ros.actions", Node=action),
    }


def modules() -> dict[str, types.ModuleType]:
    """Return what ``import rclpy`` and the message packages would find."""

    class Policy:
        KEEP_LAST = BEST_EFFORT = 1

    return {
        "rclpy": module("rclpy", init=lambda: None, spin=lambda node: None, try_shutdown=lambda: None),
        "rclpy.exceptions": module("rclpy.exceptions", ParameterException=ParameterError),
        "rclpy.executors": module("rclpy.executors", ExternalShutdownException=ExternalShutdownError),
        "rclpy.node": module("rclpy.node", Node=Node),
        "rclpy.qos": module("rclpy.qos", HistoryPolicy=Policy, ReliabilityPolicy=Policy, QoSProfile=dict),
        "geometry_msgs": module("geometry_msgs"),
        "geometry_msgs.msg": module("geometry_msgs.msg", PoseStamped=PoseStamped),
        "nav_msgs": module("nav_msgs"),
        "nav_msgs.msg": module("nav_msgs.msg", Path=Path),
        "rcl_interfaces": module("rcl_interfaces"),
        "rcl_interfaces.msg": module("rcl_interfaces.msg", ParameterDescriptor=ParameterDescriptor),
        "sensor_msgs": module("sensor_msgs"),
        "sensor_msgs.msg": module("sensor_msgs.msg", Image=Image),
        "vision_msgs": module("vision_msgs"),
        "vision_msgs.msg": module(
            "vision_msgs.msg",
            Detection2D=Detection2D,
            Detection2DArray=Detection2DArray,
            ObjectHypothesisWithPose=ObjectHypothesisWithPose,
        ),
    }
