"""Where the camera comes from: a YAML file, or the lanes themselves; and what a picture from above shows."""

from __future__ import annotations

import dataclasses
import math
import re
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from numpy.typing import NDArray

from trilitenet.config import parse, parse_yaml
from trilitenet.errors import ConfigError, write_file
from trilitenet.processing.geometry import Camera
from trilitenet.road.lanes import VanishingPoint, vanishing_point
from trilitenet.road.structures import LATE, LaneLine
from trilitenet.structures import Boxes

__all__ = ["CameraErrors", "SelfCalibration", "View", "read_camera", "write_camera"]


@dataclasses.dataclass(frozen=True)
class CameraErrors:
    """How well a camera is known: one standard deviation each.

    Attributes:
        pitch: Radians.
        yaw: Radians.
        height: Share of the height.
        focal: Share of the focal length.
        roll: Radians.
    """

    pitch: float = 0.002
    yaw: float = 0.002
    height: float = 0.01
    focal: float = 0.005
    roll: float = 0.002


@dataclasses.dataclass(frozen=True)
class _Matrix:
    data: tuple[float, ...]
    rows: int = 0
    cols: int = 0
    dt: str = "d"


@dataclasses.dataclass(frozen=True)
class _CameraFile:
    image_width: int
    image_height: int
    height: float
    camera_matrix: _Matrix | None = None
    distortion_coefficients: _Matrix | None = None
    field_of_view: float | None = None
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0
    front: float = 0.0
    left: float = 0.0
    vehicle_width: float | None = None
    camera_name: str = ""


_OF_VEHICLE: Final = ("front", "left", "vehicle_width")
"""Where the camera is in the vehicle, and how wide that is: left out where it is not known."""
_LENSES: Final = ("plumb_bob", "rational_polynomial")
"""Distortion models of ROS that are OpenCV's, which `Camera` has."""
_ROS: Final = {"rectification_matrix", "projection_matrix"}
_OPENCV: Final = {
    *("aspectRatio", "avg_reprojection_error", "board_height", "board_width", "calibration_time", "fix_aspect_ratio"),
    *("extrinsic_parameters", "flags", "grid_points", "image_points", "marker_size", "nframes", "nr_of_frames"),
    *("per_view_reprojection_errors", "square_size"),
}
"""Keys of their calibration programs that do not bear on where a pixel looks."""


def read_camera(path: str | Path) -> Camera:
    """Read a camera from YAML.

    The intrinsics are as OpenCV and ROS write them (``image_width``, ``image_height``, ``camera_matrix`` and
    ``distortion_coefficients`` with their ``data``; what else their calibration programs write is passed over), or
    ``field_of_view`` in degrees for an ideal lens. To these come the mounting: ``height`` in metres, and ``pitch``
    (down), ``yaw`` (left), ``roll`` (right side lowered) in degrees. ``front`` (from the lens forward to the front
    bumper), ``left`` (lens left of the vehicle's middle) and ``vehicle_width`` in metres may be left out.

    Raises:
        ConfigError: If the file is missing or not YAML, has an unknown key, lacks one, a value is out of range, or the
            lens is of another model (a fisheye).
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"{path}: cannot be read as a camera file ({reason})") from error
    # OpenCV's FileStorage writes a directive and a tag that are no standard YAML.
    text = re.sub(r"\A%YAML.*\n", "", text).replace("!!opencv-matrix", "")
    content = parse_yaml(text, str(path))
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: must be a mapping of keys such as image_width, camera_matrix and height")
    lens_model = content.pop("distortion_model", _LENSES[0])
    if lens_model not in _LENSES or content.pop("fisheye_model", 0):
        name, known = "fisheye" if lens_model in _LENSES else lens_model, ", ".join(_LENSES)
        raise ConfigError(f"{path}: lenses of the model {name!r} are not known ({known} are); undistort pictures first")
    content = {key: value for key, value in content.items() if key not in _ROS | _OPENCV}
    for key in ("camera_matrix", "distortion_coefficients"):
        if isinstance(content.get(key), list):
            content[key] = {"data": _flat(content[key])}
    file = parse(_CameraFile, content, str(path))
    size = (file.image_height, file.image_width)
    pitch, yaw, roll = (math.radians(angle) for angle in (file.pitch, file.yaw, file.roll))
    lens = () if file.distortion_coefficients is None else file.distortion_coefficients.data
    of_vehicle: dict[str, Any] = {name: getattr(file, name) for name in _OF_VEHICLE}
    try:
        if file.camera_matrix is None:
            if file.field_of_view is None:
                raise ConfigError("needs camera_matrix, or field_of_view in degrees")
            if any(lens):
                raise ConfigError("field_of_view is for an ideal lens; distortion_coefficients need camera_matrix")
            camera = Camera.from_field_of_view(size, file.field_of_view, file.height, pitch=pitch, yaw=yaw, roll=roll)
            return dataclasses.replace(camera, **of_vehicle)
        if file.field_of_view is not None:
            raise ConfigError("camera_matrix and field_of_view exclude each other")
        matrix = file.camera_matrix.data
        if len(matrix) != 9:
            raise ConfigError(f"camera_matrix must have 9 numbers, got {len(matrix)}")
        if not np.allclose([matrix[i] for i in (1, 3, 6, 7, 8)], (0, 0, 0, 0, 1), rtol=0, atol=1e-6):
            raise ConfigError("camera_matrix must be [fx, 0, cx, 0, fy, cy, 0, 0, 1]: pixels cannot be skewed")
        return Camera(
            size, matrix[0], matrix[4], matrix[2], matrix[5], file.height, pitch, yaw, roll,
            lens if any(lens) else (), **of_vehicle,
        )  # fmt: skip
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def _flat(rows: list[Any]) -> list[Any]:
    """Return the numbers of a matrix that is written as rows."""
    return [number for row in rows for number in (row if isinstance(row, list) else [row])]


def write_camera(camera: Camera, path: str | Path) -> None:
    """Write a camera as `read_camera` reads it.

    Raises:
        OutputError: If the file cannot be written.
    """
    lens = [float(value) for value in camera.distortion]  # OpenCV calibrates to NumPy's numbers, which YAML refuses
    content = {
        "image_width": int(camera.size[1]),
        "image_height": int(camera.size[0]),
        "camera_matrix": {"rows": 3, "cols": 3, "data": [float(v) for v in camera.matrix.ravel()]},
        "distortion_coefficients": {"rows": 1, "cols": len(lens), "data": lens},
        "height": float(camera.height),
        **{name: math.degrees(getattr(camera, name)) for name in ("pitch", "yaw", "roll")},
        **{name: float(value) for name in _OF_VEHICLE if (value := getattr(camera, name)) is not None},
    }
    write_file(Path(path), yaml.safe_dump(content, sort_keys=False))


class SelfCalibration:
    """Estimates how the camera is mounted from the lanes alone.

    Pitch and yaw follow from where they vanish, the height from the width of a lane. It trusts itself once enough
    frames agree, unless vehicles would be too narrow or too wide beside the lane: then that is none, but a whole road,
    say. From then on it takes in frames by time, and few of lines that do not move: the car may stand, and not along
    the lane.

    The focal length cannot be seen from lanes: it follows from the assumed field of view, and its uncertainty goes into
    every distance. Offsets across the lane do not depend on it. Roll is taken to be 0, and lines to be straight: what a
    camera is tilted to the side by goes into offsets, and what a clip bends by for the most part into yaw; the errors
    have shares for both.

    Args:
        size: (height, width) of the pictures in pixels.
        field_of_view: Horizontal, in degrees.
        lane_width: Metres between the middles of a lane's two lines.
        still: A single picture is all there will be: one vanishing point is enough, of more lines than two.
    """

    WINDOW: Final = 250
    """Frames that are remembered, of those taken in."""
    INTERVAL: Final = 0.1
    """Seconds between frames that are taken in, once there is a camera."""
    UNMOVED: Final = 30
    """Frames that are taken in so while the lines vanish in one place; then they are rarer."""
    UNMOVED_INTERVAL: Final = 2.0
    """Seconds between those."""
    NEEDED: Final = 12
    """Frames with a vanishing point before it is trusted; and frames with vehicles before they may contradict it."""
    STILL_LINES: Final = 3
    """Lines that must agree on where they vanish in a single picture: two always meet somewhere."""
    VEHICLE_WIDTHS: Final = (1.4, 3.2)
    """Metres between which vehicles are wide in the median: a small car in a lane wider than assumed, a lorry in a
    narrower one."""
    FOCAL_ERROR: Final = 0.15
    """Standard deviation of the assumed focal length, as a share."""
    WIDTH_ERROR: Final = 0.10
    """Standard deviation of the assumed lane width, as a share."""
    ROLL_ERROR: Final = 0.02
    """Standard deviation of the roll, which is taken to be 0, in radians."""
    BEND_REACH: Final = 5.7
    """Radians of yaw for each 1/m of a bend: lines that bend vanish aside of where the camera looks, by half the metres
    to the middle of what is seen of them."""

    def __init__(
        self, size: tuple[int, int], *, field_of_view: float = 60.0, lane_width: float = 3.5, still: bool = False
    ) -> None:
        if not 0 < lane_width < math.inf:
            raise ConfigError(f"lane width must be above 0 metres, got {lane_width}")
        self.size, self.lane_width, self.still = size, lane_width, still
        self._level = Camera.from_field_of_view(size, field_of_view, 1.0)
        self._points: deque[tuple[float, float, float]] = deque(maxlen=self.WINDOW)
        self._spreads: deque[float] = deque(maxlen=self.WINDOW)
        self._bends: deque[float] = deque(maxlen=self.WINDOW)
        self._vehicles: deque[float] = deque(maxlen=self.WINDOW)
        self._last = -math.inf
        self._taken = False
        self._place: tuple[float, float] = (math.inf, math.inf)
        self._unmoved = 0
        self.camera: Camera | None = None
        self.errors = CameraErrors()

    def update(self, lines: Sequence[LaneLine], timestamp: float, boxes: Boxes | None = None) -> None:
        """Take in one frame.

        Args:
            lines: With their positions (see `assign_positions`) where known.
            timestamp: Seconds.
            boxes: Vehicles.
        """
        self._taken = False
        step = timestamp - self._last
        if self.camera is not None and -LATE <= step < self.INTERVAL - 1e-6:
            return
        found = vanishing_point(lines, self.size)
        height = self.size[0]
        if found is None or found.error > 0.03 * height or not 0.1 * height < found.v < 0.75 * height:
            return
        if self.still and found.lines < self.STILL_LINES:
            return
        if math.dist((found.u, found.v), self._place) > found.error:
            self._place, self._unmoved = (found.u, found.v), 0
        if self.camera is not None:
            if self._unmoved >= self.UNMOVED and -LATE <= step < self.UNMOVED_INTERVAL - 1e-6:
                return
            self._unmoved += 1
        self._last, self._taken = timestamp, True
        self._points.append((found.u, found.v, found.error))
        left = next((line for line in lines if line.position == -1), None)
        right = next((line for line in lines if line.position == 1), None)
        if left is not None and right is not None:
            low = min(left.origin[0], right.origin[0])
            if low - found.v > 0.2 * height:
                # The width of a lane in pixels grows in proportion to the distance below the horizon.
                self._spreads.append(float(right.column(low) - left.column(low)) / (low - found.v))
        if boxes is not None and len(widths := _vehicle_widths(boxes, self._level, found)):
            self._vehicles.append(float(np.median(widths)))
        self._solve()

    def see_bend(self, curvature: float) -> None:
        """Take in the curvature in 1/m of the last frame's lane: what most frames bend by may be in the yaw."""
        if self._taken:
            self._bends.append(curvature)

    def _solve(self) -> None:
        points = np.array(self._points)
        needed = 1 if self.still else self.NEEDED
        if len(points) < needed or not self._spreads:
            self.camera = None
            return
        u, v = np.median(points[:, 0]), np.median(points[:, 1])
        count = len(points)
        # Every five frames count as one; so far by rank may the middle of all there could be lie from that of these.
        ranks = 0.5 + np.array([-0.5, 0.5]) / math.sqrt(max(count / 5, 1.0))
        low, high = np.quantile(points[:, :2], ranks, axis=0)
        scatter = (high - low) / 2
        row_error = math.hypot(float(scatter[1]), float(np.median(points[:, 2])) / math.sqrt(count))
        focal = self._level.fy
        pitch = math.atan((self._level.cy - v) / focal)
        yaw = math.atan((u - self._level.cx) * math.cos(pitch) / focal)
        pitch_error = row_error / focal + 0.1 * self.FOCAL_ERROR * abs(pitch)
        if pitch_error > 0.02:
            self.camera = None
            return
        spread = float(np.median(self._spreads))
        # Pixels across a lane, a row below the horizon, are width / height of the camera (for square pixels).
        mounted = self.lane_width * math.cos(pitch) / spread if spread > 0 else math.nan
        if not 0.5 < mounted < 4.5:
            self.camera = None
            return
        low_width, high_width = self.VEHICLE_WIDTHS
        if len(self._vehicles) >= needed:
            wide = self.lane_width * float(np.median(self._vehicles)) / spread
            slack = 1.0 if self.camera is None else 1.05  # so that it does not come and go
            if not low_width / slack < wide < high_width * slack:
                self.camera = None
                return
        self.camera = dataclasses.replace(self._level, height=mounted, pitch=pitch, yaw=yaw)
        yaw_error = float(scatter[0]) / focal + (0.02 if self.still else 0.003)
        yaw_error += self.BEND_REACH * abs(float(np.median(self._bends))) if self._bends else 0.0
        self.errors = CameraErrors(pitch_error, yaw_error, self.WIDTH_ERROR, self.FOCAL_ERROR, self.ROLL_ERROR)


def _vehicle_widths(boxes: Boxes, level: Camera, point: VanishingPoint) -> NDArray[np.float64]:
    """Return widths of vehicles as `SelfCalibration` has those of lanes: pixels a row below the horizon.

    Left out are those that the picture's edge cuts, whose foot a nearer one hides, or that are far away or far aside.
    A box has some of a vehicle's side in it, too: as much again for each half radian that it stands aside.
    """
    height, width = level.size
    left, top, right, foot = boxes.xyxy.T.astype(np.float64) - 0.5
    aside = np.abs((left + right) / 2 - point.u) / level.fx
    beside = (left < right[:, None]) & (right > left[:, None])
    hidden = (beside & (foot > foot[:, None]) & (top < foot[:, None])).any(axis=1)
    whole = (left > 0.5) & (right < width - 1.5) & (foot < height - 1.5)
    keep = whole & ~hidden & (foot - point.v > 0.06 * height) & (aside < 0.3)
    return np.asarray(((right - left) / (foot - point.v) / (1 + 2 * aside))[keep])


@dataclasses.dataclass(frozen=True)
class View:
    """What a picture from above shows.

    Attributes:
        near: Metres ahead at its lower edge.
        far: Metres ahead at its upper edge.
        half_width: Metres to either side.
        scale: Pixels a metre.
    """

    near: float = 3.0
    far: float = 50.0
    half_width: float = 9.0
    scale: float = 8.0

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return round((self.far - self.near) * self.scale), round(2 * self.half_width * self.scale)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(3, 3): takes (u, v, 1) of the picture from above to (x, y, 1) in metres."""
        step = 1 / self.scale
        return np.array(
            [[0.0, -step, self.far - 0.5 * step], [-step, 0.0, self.half_width - 0.5 * step], [0.0, 0.0, 1.0]]
        )

    def to_pixels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N, 2) pixels u, v of the picture from above, of (N, 2) points x, y in metres."""
        u = (self.half_width - points[:, 1]) * self.scale - 0.5
        v = (self.far - points[:, 0]) * self.scale - 0.5
        return np.stack([u, v], axis=1)
