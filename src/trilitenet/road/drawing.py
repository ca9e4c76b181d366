"""The road drawn on the overlay: lane curves, distances, a picture from above, a status bar.

Colours are those of Okabe and Ito (2008), RGB, like the rest of the overlay's.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Collection
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import ConfigError, ShapeError
from trilitenet.processing.drawing import check_parts, draw_label, label_font
from trilitenet.processing.geometry import Camera
from trilitenet.road.camera import View
from trilitenet.road.structures import LaneLine, Road
from trilitenet.structures import Perception

__all__ = ["ROAD_PARTS", "draw_road", "from_above"]

Colour = tuple[int, int, int]

ROAD_PARTS: Final = ("lines", "distances", "above", "status")
"""Parts of the road's drawing that can be left out."""

_EGO: Final[Colour] = (230, 159, 0)
_OTHER: Final[Colour] = (86, 180, 233)
_LEAD: Final[Colour] = (213, 94, 0)
_WARNING: Final[Colour] = (213, 94, 0)
_INK: Final[Colour] = (235, 235, 235)
_PLATE: Final[Colour] = (24, 26, 30)
_SHIFT: Final = 4
_SMALLEST: Final = 6
"""Height in pixels of the smallest letters that can be read."""
_WORDS: Final = {
    "lane_departure_left": "LANE DEPARTURE LEFT",
    "lane_departure_right": "LANE DEPARTURE RIGHT",
    "forward_collision": "COLLISION AHEAD",
}


def draw_road(
    canvas: NDArray[np.uint8], perception: Perception, road: Road, *, hide: Collection[str] = ()
) -> NDArray[np.uint8]:
    """Draw what a frame tells of the road.

    Args:
        canvas: (height, width, 3) uint8 RGB, changed in place: the image, or the overlay of masks and boxes.
        perception: The frame.
        road: What it tells of the road.
        hide: Parts to leave out, of `ROAD_PARTS`.

    Returns:
        The canvas.

    Raises:
        ShapeError: If the canvas has another size than the frame, or the road's camera.
        ConfigError: If a part is unknown.
    """
    hidden = check_parts(hide, ROAD_PARTS)
    if canvas.shape != (*perception.size, 3) or canvas.dtype != np.uint8:
        raise ShapeError(f"the canvas must be {(*perception.size, 3)} uint8, got {canvas.shape} {canvas.dtype}")
    above = None
    if "above" not in hidden and road.camera is not None:
        above = _draw_above(canvas, perception, road, road.camera)
    if "lines" not in hidden:
        for line in road.lines:
            _draw_line(canvas, line)
    if "distances" not in hidden:
        _draw_distances(canvas, perception, road)
    room = canvas.shape[1]
    if above is not None:
        margin = max(4, canvas.shape[1] // 100)
        height, width = above.shape[:2]
        if height + 2 * margin < canvas.shape[0] and width + 2 * margin < canvas.shape[1]:
            canvas[margin : margin + height, -margin - width : -margin] = above
            room -= width + 2 * margin
    if "status" not in hidden:
        _draw_status(canvas, perception, road, room)
    return canvas


def from_above(image: NDArray[np.uint8], camera: Camera, view: View | None = None) -> NDArray[np.uint8]:
    """Return the flat road as it would be seen from above, ahead being up.

    What stands on the road is smeared away from the camera; what the picture does not show is dark.

    Args:
        image: (height, width, 3) uint8 RGB, of the camera's size.
        camera: Where its pixels look: read by `trilitenet.road.camera.read_camera`, or a `Road`'s.
        view: The part of the road in metres and the pixels a metre; that of ``View()`` if left out.

    Returns:
        (height, width, 3) uint8 RGB of ``view.size``; `View.to_pixels` tells where a point of the road is in it.

    Raises:
        ShapeError: If the image has another size than the camera.
        ConfigError: If the view has no pixels.
    """
    view = View() if view is None else view
    height, width = view.size
    if image.shape != (*camera.size, 3) or image.dtype != np.uint8:
        raise ShapeError(
            f"the image must be {(*camera.size, 3)} uint8, as the camera's, got {image.shape} {image.dtype}; "
            "Camera.resized takes a camera to another resolution"
        )
    if min(height, width) < 1:
        raise ConfigError(f"a view needs far above near, and a half_width and scale above 0, got {view}")
    matrix = camera.ground_homography @ view.matrix
    if camera.distortion:
        place, part = _above_maps(camera, view)
        return np.asarray(cv2.remap(image, place, part, cv2.INTER_LINEAR, borderValue=_PLATE), np.uint8)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    picture = np.asarray(cv2.warpPerspective(image, matrix, (width, height), flags=flags, borderValue=_PLATE), np.uint8)
    depth = matrix[2, 0] * np.arange(width) + matrix[2, 1] * np.arange(height)[:, None] + matrix[2, 2]
    if depth.min() <= 0:  # the matrix shows what lies behind the camera, mirrored
        picture[depth <= 0] = _PLATE
    return picture


@functools.lru_cache(maxsize=8)
def _above_maps(camera: Camera, view: View) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Return where each pixel from above is seen through the lens, as `cv2.remap` takes it.

    It shows what an ideal lens would have in the picture: further out the lens's polynomial may fold.
    """
    rows, columns = np.indices(view.size).reshape(2, -1)
    ground = (np.stack([columns, rows, np.ones_like(rows)], axis=1) @ view.matrix.T)[:, :2]
    ideal = dataclasses.replace(camera, distortion=()).to_pixels(ground)
    inside = ((ideal > -0.5) & (ideal < np.array(camera.size[::-1]) - 0.5)).all(axis=1, keepdims=True)
    seen = np.where(inside, camera.to_pixels(ground), -10.0)
    place, part = cv2.convertMaps(seen.reshape(*view.size, 2).astype(np.float32), None, cv2.CV_16SC2)
    return np.asarray(place, np.int16), np.asarray(part, np.uint16)


def _fixed(points: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.round(np.clip(points, -20000, 20000) * (1 << _SHIFT)).astype(np.int32)


def _draw_line(canvas: NDArray[np.uint8], line: LaneLine) -> None:
    ego = abs(line.position) == 1
    thickness = max(2, round(canvas.shape[1] / (260 if ego else 420)))
    points = _fixed(line.points.astype(np.float64))
    cv2.polylines(canvas, [points], False, _PLATE, thickness + 2, cv2.LINE_AA, _SHIFT)
    cv2.polylines(canvas, [points], False, _EGO if ego else _OTHER, thickness, cv2.LINE_AA, _SHIFT)


def _draw_distances(canvas: NDArray[np.uint8], perception: Perception, road: Road) -> None:
    boxes = perception.boxes
    if boxes is None:
        return
    size = max(9, round(canvas.shape[1] / 80))
    lead = -1 if road.lead is None else road.lead.box
    for index, distance in enumerate(road.distances):
        left, _, right, bottom = (float(v) for v in boxes.xyxy[index])
        if index == lead and road.lead is not None:
            corners = [round(v) for v in boxes.xyxy[index].tolist()]
            cv2.rectangle(canvas, (corners[0], corners[1]), (corners[2], corners[3]), _LEAD, max(2, size // 5))
            text = f"{road.lead.distance.value:.0f} m"
            if road.lead.time_to_collision is not None:
                text += f"  {road.lead.time_to_collision.value:.1f} s"
            draw_label(canvas, text, (round(left), round(bottom) + size + size // 2), _LEAD, size=size)
        elif distance is not None and right - left > 2.2 * size:
            draw_label(canvas, f"{distance.value:.0f} m", (round(left), round(bottom) + size), _OTHER, size=size - 2)


def _draw_above(canvas: NDArray[np.uint8], perception: Perception, road: Road, camera: Camera) -> NDArray[np.uint8]:
    """Return a small picture of the road from above, with lines, vehicles and the own car."""
    height = max(64, round(canvas.shape[0] * 0.4))
    far = 48.0
    view = View(near=0.0, far=far, half_width=11.0, scale=height / far)
    size = view.size
    panel = from_above(canvas, camera, view)
    cv2.convertScaleAbs(panel, dst=panel, alpha=0.5)
    for line in road.lines:
        if line.ground is None:
            continue
        x = np.linspace(line.ground.start, min(line.ground.end, view.far), 24)
        pixels = view.to_pixels(np.stack([x, line.ground.at(x)], axis=1))
        colour = _EGO if abs(line.position) == 1 else _OTHER
        cv2.polylines(panel, [_fixed(pixels)], False, colour, max(1, height // 120), cv2.LINE_AA, _SHIFT)
    if perception.boxes is not None:
        for index, distance in enumerate(road.distances):
            if distance is None:
                continue
            left, _, right, bottom = perception.boxes.xyxy[index].astype(np.float64) - 0.5
            ground = camera.to_ground(np.array([[(left + right) / 2, bottom]]))
            lead = road.lead is not None and road.lead.box == index
            rear = camera.front + distance.value
            _draw_vehicle(panel, view, rear, float(ground[0, 1]), _LEAD if lead else _INK)
    _draw_vehicle(panel, view, (camera.front or 1.5) - 4.5, -camera.left, _EGO)
    cv2.rectangle(panel, (0, 0), (size[1] - 1, size[0] - 1), _INK, 1)
    return panel


def _draw_vehicle(panel: NDArray[np.uint8], view: View, rear: float, y: float, colour: Colour) -> None:
    """Draw a car of 4.5 x 1.8 m whose rear is at (rear, y) metres."""
    corners = np.array([[rear, y - 0.9], [rear, y + 0.9], [rear + 4.5, y + 0.9], [rear + 4.5, y - 0.9]])
    cv2.fillPoly(panel, [_fixed(view.to_pixels(corners))], colour, cv2.LINE_AA, _SHIFT)


def _draw_status(canvas: NDArray[np.uint8], perception: Perception, road: Road, room: int) -> None:
    """Write the figures on a bar at the bottom, and what is being warned of, one line each, within ``room`` columns."""
    height, width = canvas.shape[:2]
    size = max(9, round(width / 72))
    bar = 2 * size
    if bar * 2 > height:
        return
    region = canvas[height - bar :]
    colour = _WARNING if road.warnings else _PLATE
    cv2.addWeighted(region, 0.25, np.full_like(region, colour), 0.75, 0, dst=region)
    text = "   ".join(_figures(perception, road))
    fitting, _ = _fit([text], width - size // 2, size)
    draw_label(canvas, text, (size // 2, height - size // 4), colour, size=fitting)
    if road.warnings:
        lines = [_WORDS[kind] for kind in road.warnings]
        fitting, widths = _fit(lines, room, 2 * size)
        bottom = max(round(height * 0.12), 2 * fitting)
        for text, wide in zip(lines, widths, strict=True):
            draw_label(canvas[:, :room], text, ((room - wide) // 2, bottom), _WARNING, size=fitting)
            bottom += round(1.5 * fitting)


def _fit(lines: list[str], room: int, size: int) -> tuple[int, list[int]]:
    """Return the height of letters, ``size`` or less, at which labels fit into ``room``, and their widths: pixels."""
    while True:
        font = label_font(size)
        widths = [math.ceil(font.getlength(text)) + 2 * max(2, size // 4) for text in lines]
        if max(widths) <= room or size <= _SMALLEST:
            return size, widths
        size -= 1


def _signed(value: float, digits: int) -> str:
    return f"{round(value, digits) + 0.0:+.{digits}f}"  # -0.0 + 0.0 is 0.0


def _figures(perception: Perception, road: Road) -> list[str]:
    lane = road.ego_lane
    if lane is None:
        if road.camera is not None:
            return ["no lane"]
        picture = perception.frame is None and perception.timestamp is None
        return ["no camera" if picture else "calibrating"]
    figures = []
    if lane.offset is not None:
        side = "left" if lane.offset.value >= 0 else "right"
        figures.append(f"offset {abs(lane.offset.value):.2f} m {side}")
    if lane.heading is not None:
        figures.append(f"heading {_signed(math.degrees(lane.heading.value), 1)}°")
    if lane.curvature is not None:
        radius = 1 / max(abs(lane.curvature.value), 1e-6)
        if radius > 3000 or abs(lane.curvature.value) < lane.curvature.error:
            figures.append("straight")
        else:
            bend = "left" if lane.curvature.value > 0 else "right"
            figures.append(f"radius {radius:.0f} m {bend}")
    if road.lead is not None:
        figures.append(f"ahead {road.lead.distance.value:.1f} m")
        if road.lead.closing_speed is not None:
            figures.append(f"closing {_signed(road.lead.closing_speed.value * 3.6, 0)} km/h")
    return figures or ["no lane"]
