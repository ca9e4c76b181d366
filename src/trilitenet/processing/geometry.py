"""A pinhole camera over a flat road: the one home of the maths between pixels and metres. NumPy and OpenCV only.

Frames of reference:

- *vehicle* (ISO 8855): origin on the ground below the camera, x forward, y left, z up, in metres;
- *image*: u to the right, v down, in pixels; the centre of the first pixel is (0, 0), as in OpenCV.

Angles are in radians and follow the right-hand rule: yaw > 0 looks to the left, pitch > 0 looks down, roll > 0 lowers
the right side of the camera.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from trilitenet.errors import ConfigError

__all__ = ["Camera", "Floats"]

Floats = NDArray[np.float64]

_EXACT: Final = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-9)
"""When the inverse of a lens is found: OpenCV's usual five steps leave wide lenses pixels off."""
_HIGHEST: Final = 10.0
"""Metres above the road that a camera in a vehicle can be: more is meant in other units."""
_OF_VEHICLE: Final = {"front": (0.0, 10.0), "left": (-2.0, 2.0), "vehicle_width": (0.5, 4.0)}
"""Metres between which a camera's place in a vehicle, and the vehicle's width, can be."""
_MAX_MISS: Final = 0.5
"""Pixels by which a pixel may miss itself, there and back through the lens; beyond, the lens cannot show it."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """Intrinsics and mounting of a camera.

    Attributes:
        size: (height, width) of the image in pixels.
        fx: Focal length along u in pixels.
        fy: Focal length along v in pixels.
        cx: Principal point, u in pixels.
        cy: Principal point, v in pixels.
        height: Metres of the optical centre above the road.
        pitch: Radians the camera looks down.
        yaw: Radians the camera looks to the left of the vehicle's axis.
        roll: Radians the right side of the camera is lowered.
        distortion: OpenCV's coefficients (k1, k2, p1, p2[, k3[, ...]]); empty for an ideal lens.
        front: Metres from the lens forward to the vehicle's front bumper. This and the next two move no pixel.
        left: Metres the lens is left of the vehicle's middle.
        vehicle_width: Metres; None where it is not known.

    Raises:
        ConfigError: If a number is not finite, a length not positive, the height above 10 metres, an angle not between
            -pi/2 and pi/2, the number of distortion coefficients not one of OpenCV's, or the vehicle not one of a
            road's.
    """

    size: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    height: float
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0
    distortion: tuple[float, ...] = ()
    front: float = 0.0
    left: float = 0.0
    vehicle_width: float | None = None

    def __post_init__(self) -> None:
        for name in ("fx", "fy", "height"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ConfigError(f"camera {name} must be positive, got {value}")
        if self.height > _HIGHEST:
            raise ConfigError(f"camera height must be at most {_HIGHEST} metres above the road, got {self.height}")
        if not all(map(math.isfinite, (self.cx, self.cy, *self.distortion))):
            raise ConfigError("camera cx, cy and distortion must be finite numbers")
        for name in ("pitch", "yaw", "roll"):
            value = getattr(self, name)
            if not abs(value) < math.pi / 2:
                raise ConfigError(f"camera {name} must be between -90 and 90 degrees, got {math.degrees(value):.1f}")
        for name, (least, most) in _OF_VEHICLE.items():
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise ConfigError(f"camera {name} must be between {least} and {most} metres, got {value}")
        if len(self.size) != 2 or min(self.size) < 1:
            raise ConfigError(f"camera size must be (height, width) in pixels, got {self.size}")
        if len(self.distortion) not in (0, 4, 5, 8, 12, 14):
            raise ConfigError(f"distortion takes 0, 4, 5, 8, 12 or 14 coefficients, got {len(self.distortion)}")

    @classmethod
    def from_field_of_view(
        cls,
        size: tuple[int, int],
        degrees: float,
        height: float,
        *,
        pitch: float = 0.0,
        yaw: float = 0.0,
        roll: float = 0.0,
    ) -> Camera:
        """Return an ideal camera with square pixels.

        Args:
            size: (height, width) in pixels.
            degrees: Horizontal field of view.
            height: Metres above the road.
            pitch: Radians down.
            yaw: Radians to the left.
            roll: Radians the right side is lowered.

        Raises:
            ConfigError: If the field of view is not between 1 and 179 degrees.
        """
        if not 1.0 < degrees < 179.0:
            raise ConfigError(f"field of view must be between 1 and 179 degrees, got {degrees}")
        focal = size[1] / 2 / math.tan(math.radians(degrees) / 2)
        return cls(size, focal, focal, (size[1] - 1) / 2, (size[0] - 1) / 2, height, pitch, yaw, roll)

    @functools.cached_property
    def matrix(self) -> Floats:
        """(3, 3) intrinsics."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @functools.cached_property
    def rotation(self) -> Floats:
        """(3, 3): takes OpenCV's camera axes (right, down, forward) to the vehicle's (forward, left, up)."""
        axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
        sy, cy = math.sin(self.yaw), math.cos(self.yaw)
        sp, cp = math.sin(self.pitch), math.cos(self.pitch)
        sr, cr = math.sin(self.roll), math.cos(self.roll)
        yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
        pitch = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
        roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
        return np.asarray(yaw @ pitch @ roll @ axes, np.float64)

    @functools.cached_property
    def ground_homography(self) -> Floats:
        """(3, 3): takes (x, y, 1) on the road in metres to homogeneous pixels; an ideal lens is assumed."""
        to_camera = self.rotation.T
        columns = np.stack([to_camera[:, 0], to_camera[:, 1], -self.height * to_camera[:, 2]], axis=1)
        return np.asarray(self.matrix @ columns, np.float64)

    def rays(self, pixels: ArrayLike) -> Floats:
        """Return the directions that pixels look in.

        Args:
            pixels: (N, 2) u, v.

        Returns:
            (N, 3) in the vehicle's axes, not normalised: the component along the optical axis is 1; NaN where the
            model of the lens shows nothing.
        """
        x, y = ((self.undistorted(pixels) - (self.cx, self.cy)) / (self.fx, self.fy)).T
        return np.asarray(np.stack([x, y, np.ones_like(x)], axis=1) @ self.rotation.T, np.float64)

    def undistorted(self, pixels: ArrayLike) -> Floats:
        """Return where an ideal lens would show what pixels show.

        Args:
            pixels: (N, 2) u, v.

        Returns:
            (N, 2) u, v; NaN for pixels that the model of the lens shows nothing at, as far from the middle as it may
            fold back.
        """
        points = np.asarray(pixels, np.float64).reshape(-1, 2)
        if not self.distortion or not len(points):
            return points
        lens = np.array(self.distortion)
        found = cv2.undistortImagePoints(points[:, None], self.matrix, lens, None, _EXACT)  # so in OpenCV 4, too
        ideal = np.asarray(found, np.float64).reshape(-1, 2)
        local = np.column_stack([(ideal - (self.cx, self.cy)) / (self.fx, self.fy), np.ones(len(ideal))])
        back, _ = cv2.projectPoints(local[:, None], np.zeros(3), np.zeros(3), self.matrix, lens)
        missed = np.linalg.norm(np.asarray(back, np.float64).reshape(-1, 2) - points, axis=1)
        ideal[~(missed <= _MAX_MISS)] = np.nan
        return ideal

    def to_ground(self, pixels: ArrayLike) -> Floats:
        """Return where pixels meet the flat road.

        Args:
            pixels: (N, 2) u, v.

        Returns:
            (N, 2) x forward, y left in metres; NaN on and above the horizon, and where the lens shows nothing.
        """
        rays = self.rays(pixels)
        down = -rays[:, 2]
        below = down > 1e-6
        scale = np.where(below, self.height / np.where(below, down, 1.0), np.nan)
        return rays[:, :2] * scale[:, None]

    def to_pixels(self, points: ArrayLike) -> Floats:
        """Return where points are seen.

        Args:
            points: (N, 3) x, y, z, or (N, 2) x, y on the road, in metres.

        Returns:
            (N, 2) u, v, also outside of the image; NaN for points that are not in front of the camera.
        """
        given = np.asarray(points, np.float64)
        if given.shape[1] == 2:
            given = np.concatenate([given, np.zeros((len(given), 1))], axis=1)
        local = (given - (0.0, 0.0, self.height)) @ self.rotation
        if not self.distortion and len(local) and local[:, 2].min() > 1e-3:
            seen = local @ self.matrix.T
            return np.asarray(seen[:, :2] / seen[:, 2:], np.float64)
        front = local[:, 2] > 1e-3
        depth = np.where(front, local[:, 2], np.nan)
        if self.distortion and len(given):
            ideal = np.where(front[:, None], local, (0.0, 0.0, 1.0))
            seen, _ = cv2.projectPoints(
                ideal[:, None], np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion)
            )
            return np.where(front[:, None], np.asarray(seen, np.float64).reshape(-1, 2), np.nan)
        return np.stack([self.fx * local[:, 0] / depth + self.cx, self.fy * local[:, 1] / depth + self.cy], axis=1)

    def vanishing_point(self, heading: float = 0.0) -> tuple[float, float]:
        """Return the pixel (u, v) that a straight road vanishes in.

        Args:
            heading: Radians the road points to the left of the vehicle's axis.
        """
        direction = self.rotation.T @ np.array([math.cos(heading), math.sin(heading), 0.0])
        u, v, w = self.matrix @ direction
        return float(u / w), float(v / w)

    def horizon(self, columns: ArrayLike) -> Floats:
        """Return the row of the horizon at each of the columns (an ideal lens is assumed)."""
        normal = np.linalg.inv(self.matrix).T @ self.rotation.T @ np.array([0.0, 0.0, 1.0])
        return np.asarray(-(normal[0] * np.asarray(columns, np.float64) + normal[2]) / normal[1], np.float64)

    def resized(self, size: tuple[int, int]) -> Camera:
        """Return the camera of the same view at another resolution.

        Args:
            size: (height, width) in pixels.
        """
        sy, sx = size[0] / self.size[0], size[1] / self.size[1]
        return dataclasses.replace(
            self,
            size=size,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes by name; angles in radians."""
        return {
            "size": list(self.size),
            "fx": self.fx,
            "fy": self.fy,
            "cx": self.cx,
            "cy": self.cy,
            "height": self.height,
            "pitch": self.pitch,
            "yaw": self.yaw,
            "roll": self.roll,
            "distortion": list(self.distortion),
            "front": self.front,
            "left": self.left,
            "vehicle_width": self.vehicle_width,
        }
