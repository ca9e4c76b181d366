"""From a ROS image to an array, and from what was seen to standard messages.

Nothing here imports ROS: the message types come in as an argument, so that the logic is tested without it. The fields
are those of sensor_msgs, vision_msgs 4, nav_msgs and geometry_msgs.
"""

from __future__ import annotations

import array
import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Types", "fill_detections", "fill_mask", "fill_path", "read_image"]

_STEP = 1.0
"""Metres between the poses of a lane line."""

_CHANNELS = {"rgb8": (3, False), "bgr8": (3, True), "rgba8": (4, False), "bgra8": (4, True), "mono8": (1, False)}


@dataclasses.dataclass(frozen=True)
class Types:
    """The message classes that are filled."""

    Image: Any
    Detection2DArray: Any
    Detection2D: Any
    ObjectHypothesisWithPose: Any
    Path: Any
    PoseStamped: Any


def read_image(message: Any) -> NDArray[np.uint8]:
    """Return the picture of a ``sensor_msgs/Image``.

    Args:
        message: With encoding rgb8, bgr8, rgba8, bgra8 or mono8; rows may be padded.

    Returns:
        (height, width, 3) uint8 RGB.

    Raises:
        ValueError: If the encoding is another, or the data is shorter than the message says.
    """
    if message.encoding not in _CHANNELS:
        raise ValueError(f"encoding {message.encoding!r} is not supported; known: {', '.join(_CHANNELS)}")
    channels, reverse = _CHANNELS[message.encoding]
    height, width, step = message.height, message.width, message.step
    data = np.frombuffer(message.data, np.uint8)
    if step < width * channels or len(data) < step * height:
        raise ValueError(
            f"an image of {width}x{height} {message.encoding} cannot have {len(data)} bytes in rows of {step}"
        )
    pixels = data[: step * height].reshape(height, step)[:, : width * channels].reshape(height, width, channels)
    if channels == 1:
        return np.repeat(pixels, 3, axis=2)
    return np.ascontiguousarray(pixels[..., 2::-1] if reverse else pixels[..., :3])


def fill_detections(perception: Any, header: Any, types: Types) -> Any:
    """Return a ``vision_msgs/Detection2DArray`` of the boxes, in pixels.

    Args:
        perception: A `trilitenet.Perception` with boxes.
        header: Of the image they were seen in.
        types: The message classes.
    """
    detections = []
    boxes = perception.boxes
    for index in range(len(boxes)):
        left, top, right, bottom = (float(value) for value in boxes.xyxy[index])
        detection = types.Detection2D()
        detection.header = header
        detection.bbox.center.position.x = (left + right) / 2
        detection.bbox.center.position.y = (top + bottom) / 2
        detection.bbox.size_x = right - left
        detection.bbox.size_y = bottom - top
        if boxes.track_id is not None and boxes.track_id[index] >= 0:
            detection.id = str(int(boxes.track_id[index]))
        result = types.ObjectHypothesisWithPose()
        result.hypothesis.class_id = perception.class_names[int(boxes.class_id[index])]
        result.hypothesis.score = float(boxes.confidence[index])
        detection.results = [result]
        detections.append(detection)
    message = types.Detection2DArray()
    message.header = header
    message.detections = detections
    return message


def fill_mask(mask: NDArray[np.bool_], header: Any, types: Types) -> Any:
    """Return a ``sensor_msgs/Image`` of encoding mono8: 255 where the mask is true.

    Args:
        mask: (height, width) bool.
        header: Of the image it was seen in.
        types: The message classes.
    """
    message = types.Image()
    message.header = header
    message.height, message.width = (int(side) for side in mask.shape)
    message.encoding = "mono8"
    message.is_bigendian = 0
    message.step = message.width
    # An array.array is taken as it is; any other sequence would be checked number by number.
    message.data = array.array("B", (mask.view(np.uint8) * np.uint8(255)).tobytes())
    return message


def fill_path(line: Any, header: Any, types: Types) -> Any | None:
    """Return a ``nav_msgs/Path`` of a lane line on the road, or None if it is not known in metres.

    Args:
        line: A `trilitenet.road.structures.LaneLine`.
        header: With the vehicle's frame: x forward, y left.
        types: The message classes.
    """
    if line.ground is None:
        return None
    poses = []
    for x in np.arange(line.ground.start, line.ground.end + 1e-9, _STEP):
        c1, c2, c3 = (float(c) for c in line.ground.polynomial[1:])
        heading = float(np.arctan(c1 + x * (2 * c2 + x * 3 * c3)))
        pose = types.PoseStamped()
        pose.header = header
        pose.pose.position.x = float(x)
        pose.pose.position.y = float(line.ground.at(x))
        pose.pose.orientation.z = float(np.sin(heading / 2))
        pose.pose.orientation.w = float(np.cos(heading / 2))
        poses.append(pose)
    message = types.Path()
    message.header = header
    message.poses = poses
    return message
