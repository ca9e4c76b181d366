"""The node: subscribes to a camera, publishes what is seen. All logic is in `trilitenet_ros.messages`.

Subscribes to ``image`` (sensor_msgs/Image). Publishes, of the tasks that the model has, ``~/detections``
(vision_msgs/Detection2DArray), ``~/drivable`` and ``~/lane_markings`` (sensor_msgs/Image, mono8), ``~/lane_left`` and
``~/lane_right`` (nav_msgs/Path in the vehicle's frame, once the camera is known). Advisory only: no safety function may
rest on it.
"""

from __future__ import annotations

import copy
import dataclasses
import sys
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2D, Detection2DArray, ObjectHypothesisWithPose

import trilitenet
from trilitenet.errors import TriLiteNetError
from trilitenet.road.camera import read_camera
from trilitenet.road.monitor import RoadMonitor
from trilitenet_ros.messages import Types, fill_detections, fill_mask, fill_path, read_image

TYPES = Types(Image, Detection2DArray, Detection2D, ObjectHypothesisWithPose, Path, PoseStamped)

# Only the newest picture counts: while one is worked on, older ones are dropped instead of queued.
NEWEST = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class PerceptionNode(Node):
    """Sees every picture of a camera that it has time for."""

    def __init__(self) -> None:
        super().__init__("trilitenet")
        confidence = self._parameter("confidence", -1.0)
        camera_file = self._parameter("camera_file", "")
        self._vehicle_frame = self._parameter("vehicle_frame", "base_link")
        self._publish_masks = self._parameter("publish_masks", True)
        self._predictor = trilitenet.load(
            self._parameter("model", "tiny"),
            device=self._parameter("device", "auto"),
            backend=self._parameter("backend", "auto"),
            confidence=None if confidence < 0 else confidence,
            ego_mask=self._parameter("ego_mask", "") or None,
        )
        self._monitor = RoadMonitor(
            read_camera(camera_file) if camera_file else None,
            field_of_view=self._parameter("field_of_view", 60.0),
            lane_width=self._parameter("lane_width", 3.5),
        )
        self._start: float | None = None
        self._frame = 0
        self._detections = self.create_publisher(Detection2DArray, "~/detections", 1)
        self._masks = {name: self.create_publisher(Image, f"~/{name}", 1) for name in ("drivable", "lane_markings")}
        self._lanes = [self.create_publisher(Path, f"~/lane_{side}", 1) for side in ("left", "right")]
        self.create_subscription(Image, "image", self._on_image, NEWEST)
        self.get_logger().info(f"ready: {self._predictor.backend.name}")

    def _parameter(self, name: str, default: Any) -> Any:
        """Return a parameter. It is read here only, so it cannot be set later."""
        return self.declare_parameter(name, default, ParameterDescriptor(read_only=True)).value

    def _on_image(self, message: Image) -> None:
        try:
            self._see(message)
        except (TriLiteNetError, ValueError) as error:  # such as a picture that the camera file does not describe
            self.get_logger().error(str(error), throttle_duration_sec=5.0)

    def _see(self, message: Image) -> None:
        pixels = read_image(message)
        stamp = message.header.stamp
        if not (stamp.sec or stamp.nanosec):  # the camera does not say when: by the time of arrival
            stamp = self.get_clock().now().to_msg()
        seconds = stamp.sec + stamp.nanosec * 1e-9
        self._start = seconds if self._start is None else self._start
        perception = dataclasses.replace(self._predictor(pixels), frame=self._frame, timestamp=seconds - self._start)
        self._frame += 1
        if perception.boxes is not None:  # no detections would mean that nothing is there
            self._detections.publish(fill_detections(perception, message.header, TYPES))
        if self._publish_masks:
            for name, mask in (("drivable", perception.drivable), ("lane_markings", perception.lane)):
                if mask is not None:
                    self._masks[name].publish(fill_mask(mask, message.header, TYPES))
        header = copy.deepcopy(message.header)
        header.frame_id = self._vehicle_frame
        for publisher, line in zip(self._lanes, self._monitor(perception).ego_lines, strict=True):
            path = None if line is None else fill_path(line, header, TYPES)
            if path is not None:
                publisher.publish(path)


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    try:
        rclpy.spin(PerceptionNode())
    except (TriLiteNetError, ParameterException) as error:  # a parameter's value, or its type
        sys.exit(f"error: {error}")
    except (KeyboardInterrupt, ExternalShutdownException):  # Ctrl-C, also while the model loads; SIGTERM
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
