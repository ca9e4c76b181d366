"""Vehicles for synthetic scenes: side outlines swept across the width, with windows, lights, wheels and shadows.

A shape lives in its own frame: x from its rear (0) forward, y left, z up, in metres.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.data.synthetic_world import Colour, Vehicle
from trilitenet.processing.geometry import Camera, Floats

__all__ = ["SHAPES", "SHIFT", "Lamp", "Shape", "VehiclePose", "draw_shadow", "draw_vehicle", "fixed", "in_front"]

Surface = Literal["body", "glass", "roof", "dark", "cargo"]
Tone = Callable[[Colour, float, float], tuple[float, float, float]]
"""(colour, x forward in metres, y left in metres) -> colour under the scene's light and haze."""

SHIFT: Final = 4
"""Fractional bits of the coordinates that OpenCV draws at."""
_LIMIT: Final = 30000.0
_NEAR: Final = 1.0
"""Metres from the camera, along its axis, within which nothing of a vehicle is drawn."""
_MARGIN: Final = 4.0
"""Pixels beside the picture that vehicles that come nearer are drawn to."""


@dataclasses.dataclass(frozen=True)
class Part:
    """An outline (x, z) in metres from the rear bottom over the top to the front bottom, swept across the width.

    Attributes:
        outline: Its corners.
        surfaces: What each piece between two corners is made of.
        windows: Side windows: outlines (x, z).
        belt: Height in metres above which the sides lean inwards.
        lean: How much narrower the top is, in [0, 1).
        width: Metres.
        surface: What the sides are made of.
    """

    outline: tuple[tuple[float, float], ...]
    surfaces: tuple[Surface, ...]
    windows: tuple[tuple[tuple[float, float], ...], ...]
    belt: float
    lean: float
    width: float
    surface: Surface = "body"


@dataclasses.dataclass(frozen=True)
class Shape:
    """A kind of vehicle.

    Attributes:
        length: Metres.
        width: Metres.
        height: Metres.
        parts: Outlines, rear one first.
        wheels: (x of the axle, radius) in metres.
        lights: (lowest z, highest z, width, lowest front z, highest front z) of the lamps in metres.
        heavy: True for trucks and buses.
    """

    length: float
    width: float
    height: float
    parts: tuple[Part, ...]
    wheels: tuple[tuple[float, float], ...]
    lights: tuple[float, float, float, float, float]
    heavy: bool = False


def _car(
    length: float, width: float, height: float, *,
    boot: float, boot_z: float, rear: float, roof_front: float, screen: float, screen_z: float, bonnet_z: float,
) -> Shape:  # fmt: skip
    """Return a car; x as shares of the length, z as shares of the height."""
    outline = tuple(
        (x * length, z * height)
        for x, z in (
            (0.0, 0.17), (0.0, 0.40), (0.012, boot_z), (boot, boot_z + 0.03), (rear, 0.985),
            ((rear + roof_front) / 2, 1.0), (roof_front, 0.985), (screen, screen_z), (0.96, bonnet_z),
            (0.995, bonnet_z - 0.14), (1.0, 0.17),
        )
    )  # fmt: skip
    surfaces: tuple[Surface, ...] = (
        "body", "body", "body", "glass", "roof", "roof", "glass", "body", "body", "body",
    )  # fmt: skip
    low = boot_z + 0.04
    middle = (rear + roof_front) / 2 + 0.02
    windows = tuple(
        tuple((x * length, z * height) for x, z in pane)
        for pane in (
            ((boot + 0.03, low), (rear + 0.02, 0.93), (middle - 0.008, 0.94), (middle - 0.008, low)),
            ((middle + 0.008, low), (middle + 0.008, 0.94), (roof_front, 0.93), (screen - 0.03, screen_z + 0.05)),
        )
    )
    part = Part(outline, surfaces, windows, belt=boot_z * height, lean=0.2, width=width)
    radius = 0.215 * height if height < 1.6 else 0.21 * height
    lights = (
        boot_z * height * 0.78,
        boot_z * height * 1.0,
        0.2 * width,
        (bonnet_z - 0.15) * height,
        bonnet_z * height - 0.02,
    )
    return Shape(length, width, height, (part,), ((REAR_AXLE, radius), (length - 0.85, radius)), lights)


REAR_AXLE: Final = 0.82


def _box(
    length: float, width: float, height: float, *, nose: float, screen_z: float, windows: bool, low: float
) -> Shape:
    """Return a van or bus: a box with a (short) sloping nose."""
    outline = (
        (0.0, low), (0.0, height * 0.55), (0.02, height * 0.97), (0.1, height), (length - nose - 0.05, height),
        (length - nose * 0.35, height * screen_z), (length, height * screen_z * 0.8), (length, low),
    )  # fmt: skip
    surfaces: tuple[Surface, ...] = ("body", "body", "body", "roof", "glass", "body", "body")
    panes: list[tuple[tuple[float, float], ...]] = []
    if windows:
        step = (length - nose) / 7
        for i in range(7):
            x0, x1 = i * step + 0.12, (i + 1) * step - 0.06
            panes.append(((x0, height * 0.48), (x0, height * 0.82), (x1, height * 0.82), (x1, height * 0.48)))
    else:
        x0, x1 = length - nose - 0.9, length - nose * 0.55
        panes.append(((x0, height * 0.55), (x0, height * 0.86), (x1 - 0.25, height * 0.86), (x1 + 0.1, height * 0.55)))
    part = Part(outline, surfaces, tuple(panes), belt=height * 0.6, lean=0.05, width=width)
    radius = 0.34 if height < 2.6 else 0.48
    lights = (height * 0.3, height * 0.38, 0.1 * width, height * 0.25, height * 0.32)
    return Shape(
        length, width, height, (part,), ((max(0.85, length * 0.18), radius), (length - max(0.9, nose), radius)), lights,
        heavy=height > 2.6,
    )  # fmt: skip


def _truck(length: float, width: float, height: float, cab_height: float) -> Shape:
    """Return a cargo box on a frame with a cab before it."""
    split = length - 2.3
    cargo = Part(
        ((0.0, 0.95), (0.0, height), (split - 0.25, height), (split - 0.25, 0.95)), ("cargo", "roof", "cargo"), (),
        belt=height, lean=0.0, width=width, surface="cargo",
    )  # fmt: skip
    frame = Part(
        ((0.1, 0.5), (0.1, 0.95), (split, 0.95), (split, 0.5)), ("dark", "dark", "dark"), (), belt=9.0, lean=0.0,
        width=width * 0.88, surface="dark",
    )  # fmt: skip
    cab = Part(
        ((split, 0.45), (split, cab_height), (length - 0.5, cab_height), (length - 0.08, cab_height * 0.56),
         (length, 0.45)),
        ("body", "roof", "glass", "body"),
        (((split + 0.6, cab_height * 0.55), (split + 0.6, cab_height * 0.86), (length - 0.6, cab_height * 0.86),
          (length - 0.3, cab_height * 0.55)),),
        belt=cab_height * 0.6, lean=0.05, width=width * 0.97,
    )  # fmt: skip
    wheels = ((1.35, 0.5), (2.5, 0.5), (split + 0.9, 0.5)) if length > 8 else ((1.4, 0.42), (split + 0.9, 0.42))
    return Shape(length, width, height, (frame, cargo, cab), wheels, (0.62, 0.8, 0.3, 0.6, 0.85), heavy=True)


SHAPES: Final[dict[str, Shape]] = {
    "sedan": _car(4.6, 1.80, 1.45, boot=0.15, boot_z=0.64, rear=0.32, roof_front=0.55, screen=0.74, screen_z=0.64,
                  bonnet_z=0.54),
    "hatchback": _car(4.0, 1.74, 1.48, boot=0.035, boot_z=0.62, rear=0.15, roof_front=0.56, screen=0.78, screen_z=0.62,
                      bonnet_z=0.54),
    "estate": _car(4.7, 1.80, 1.47, boot=0.03, boot_z=0.62, rear=0.12, roof_front=0.56, screen=0.75, screen_z=0.62,
                   bonnet_z=0.53),
    "suv": _car(4.6, 1.88, 1.72, boot=0.025, boot_z=0.60, rear=0.09, roof_front=0.58, screen=0.76, screen_z=0.62,
                bonnet_z=0.56),
    "pickup": _car(5.3, 1.95, 1.85, boot=0.42, boot_z=0.56, rear=0.46, roof_front=0.62, screen=0.76, screen_z=0.60,
                   bonnet_z=0.56),
    "van": _box(5.6, 2.0, 2.4, nose=1.1, screen_z=0.55, windows=False, low=0.35),
    "bus": _box(11.5, 2.5, 3.1, nose=0.4, screen_z=0.42, windows=True, low=0.4),
    "truck": _truck(10.5, 2.5, 3.8, 3.0),
    "lorry": _truck(6.8, 2.3, 3.1, 2.35),
}  # fmt: skip
"""Every kind of vehicle, by name."""


@dataclasses.dataclass(frozen=True)
class Lamp:
    """A light in the picture.

    Attributes:
        u: Pixels.
        v: Pixels.
        radius: Of the lamp itself in pixels.
        colour: RGB.
        strength: How much it glares, about 0..1.
        owner: Mark of what it belongs to in the map of objects: it shines only where that is not hidden.
    """

    u: float
    v: float
    radius: float
    colour: Colour
    strength: float
    owner: int


@dataclasses.dataclass(frozen=True)
class VehiclePose:
    """A vehicle and where it stands in the ego vehicle's coordinates.

    Attributes:
        vehicle: What it is.
        x: Metres forward to the reference point (the middle of its rear, or of its front for oncoming ones).
        y: Metres left.
        angle: Radians it points to the left of the ego vehicle's axis.
    """

    vehicle: Vehicle
    x: float
    y: float
    angle: float

    @property
    def shape(self) -> Shape:
        """Its shape."""
        return SHAPES[self.vehicle.kind]

    def place(self, points: Floats) -> Floats:
        """Return (N, 3) points of the shape's frame in ego coordinates."""
        scale = self.vehicle.scale
        sin, cos = math.sin(self.angle), math.cos(self.angle)
        # One that comes towards us is placed by its front, so that s is always its end nearest to us.
        along = points[:, 0] * scale - (self.shape.length * scale if math.cos(self.vehicle.yaw) < -0.5 else 0.0)
        across = points[:, 1] * scale
        return np.stack(
            [self.x + along * cos - across * sin, self.y + along * sin + across * cos, points[:, 2] * scale], axis=1
        )

    def projection(self, camera: Camera) -> Floats:
        """Return (4, 3): takes (x, y, z, 1) of the shape's frame to homogeneous pixels, the last being depth."""
        corners = self.place(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64))
        frame = np.concatenate([corners[1:] - corners[0], corners[:1] - (0.0, 0.0, camera.height)])
        return np.asarray(frame @ camera.rotation @ camera.matrix.T, np.float64)

    @property
    def ground_box(self) -> Floats:
        """(4, 3) corners of its footprint in ego coordinates: rear right, rear left, front left, front right."""
        half, length = self.shape.width / 2, self.shape.length
        return self.place(np.array([[0, -half, 0], [0, half, 0], [length, half, 0], [length, -half, 0]], np.float64))


def fixed(points: Floats) -> NDArray[np.int32]:
    """Return pixels as OpenCV's fixed-point numbers with `SHIFT` fractional bits."""
    return np.round(np.clip(points, -_LIMIT, _LIMIT) * (1 << SHIFT)).astype(np.int32)


def in_front(camera: Camera, points: Floats) -> Floats:
    """Return the part of a polygon that lies before the camera.

    Args:
        camera: The camera.
        points: (N, 3) corners in ego coordinates.

    Returns:
        (M, 3), empty if nothing of it does.
    """
    return _cut(points, (points - (0.0, 0.0, camera.height)) @ camera.rotation[:, 2] - _NEAR)


def _cut(points: Floats, side: Floats) -> Floats:
    """Return the part of a polygon (N, K) on one side of a plane; it may be empty.

    Args:
        points: Its corners, in coordinates that the plane is straight in.
        side: (N,) how far each is on the side that stays, in any unit; negative beyond the plane.
    """
    gone = side < 0
    if not gone.any():
        return points
    crosses = gone != np.roll(gone, -1)
    share = side / np.where(crosses, side - np.roll(side, -1), 1.0)
    cuts = points + share[:, None] * (np.roll(points, -1, axis=0) - points)
    both = np.stack([points, cuts], axis=1).reshape(-1, points.shape[1])
    return np.asarray(both[np.stack([~gone, crosses], axis=1).ravel()])


def draw_shadow(image: NDArray[np.uint8], camera: Camera, pose: VehiclePose, depth: float) -> None:
    """Darken the road under a vehicle.

    Args:
        image: (H, W, 3) uint8, changed in place.
        camera: The camera.
        pose: The vehicle.
        depth: How dark, in [0, 1].
    """
    if depth <= 0:
        return
    footprint = pose.ground_box
    centre = footprint.mean(axis=0)
    for grow, share in ((1.22, 0.35), (1.05, 0.75)):
        outline = in_front(camera, centre + (footprint - centre) * (1 + (grow - 1) * np.array([0.4, 1.0, 1.0])))
        if not len(outline):
            return
        pixels = camera.to_pixels(outline)
        low = np.floor(pixels.min(axis=0)).astype(int) - 1
        high = np.ceil(pixels.max(axis=0)).astype(int) + 2
        left, top = max(low[0], 0), max(low[1], 0)
        right, bottom = min(high[0], image.shape[1]), min(high[1], image.shape[0])
        if right <= left or bottom <= top:
            return
        region = image[top:bottom, left:right]
        mask = np.full(region.shape[:2], 255, np.uint8)
        level = int(255 * (1 - depth * share))
        cv2.fillPoly(mask, [fixed(pixels - (left, top))], level, cv2.LINE_AA, SHIFT)
        if grow > 1.1 and min(bottom - top, right - left) > 4:
            size = max(3, (bottom - top) // 4 | 1)
            mask = np.asarray(cv2.blur(mask, (size, size)), np.uint8)
        cv2.multiply(region, cv2.merge([mask, mask, mask]), dst=region, scale=1 / 255)


class _Pen:
    """Draws polygons of one vehicle onto the picture and its number onto the map of objects."""

    def __init__(
        self,
        image: NDArray[np.uint8],
        ids: NDArray[np.uint8],
        number: int,
        camera: Camera,
        pose: VehiclePose,
        tone: Tone,
    ) -> None:
        self.image, self.ids, self.number, self.camera, self.pose = image, ids, number, camera, pose
        self.matrix = pose.projection(camera)
        white, black = tone((200.0, 200.0, 200.0), pose.x, pose.y), tone((0.0, 0.0, 0.0), pose.x, pose.y)
        self.gain = tuple((w - b) / 200.0 for w, b in zip(white, black, strict=True))
        self.base = black

    def polygon(self, points: Floats, colour: Colour, gain: float = 1.0, *, mark: bool = True) -> None:
        seen = points @ self.matrix[:3] + self.matrix[3]
        if seen[:, 2].min() < _NEAR:
            seen = _cut(seen, seen[:, 2] - _NEAR)
            # Of an edge that goes far beside the picture OpenCV misplaces what is within.
            seen = _cut(seen, seen[:, 0] + _MARGIN * seen[:, 2])
            seen = _cut(seen, (self.image.shape[1] + _MARGIN) * seen[:, 2] - seen[:, 0])
            if not len(seen):
                return
        outline = (np.clip(seen[:, :2] / seen[:, 2:], -_LIMIT, _LIMIT) * (1 << SHIFT) + 0.5).astype(np.int32)
        shade = tuple(b + g * c * gain for b, g, c in zip(self.base, self.gain, colour, strict=True))
        cv2.fillPoly(self.image, [outline], shade, cv2.LINE_AA, SHIFT)
        if mark:
            cv2.fillPoly(self.ids, [outline], self.number, cv2.LINE_8, SHIFT)


_GLASS: Final[Colour] = (42.0, 50.0, 58.0)
_RUBBER: Final[Colour] = (22.0, 22.0, 24.0)
_CARGO: Final[tuple[Colour, ...]] = ((215, 215, 212), (190, 192, 196), (60, 90, 140), (150, 60, 45), (90, 120, 90))


def draw_vehicle(
    image: NDArray[np.uint8],
    ids: NDArray[np.uint8],
    number: int,
    camera: Camera,
    pose: VehiclePose,
    tone: Tone,
    *,
    sun: tuple[float, float, float],
    lamps: bool,
    sky: float,
) -> list[Lamp]:
    """Draw one vehicle.

    Args:
        image: (H, W, 3) uint8 RGB, changed in place.
        ids: (H, W) uint8: set to ``number`` wherever the vehicle is.
        number: Its mark.
        camera: The camera.
        pose: The vehicle.
        tone: Light and haze.
        sun: Direction to the sun in ego coordinates, scaled by its strength.
        lamps: True when its lights are on.
        sky: Brightness of what glass mirrors, about 0..1.

    Returns:
        Lights whose glare is still to be added.
    """
    shape, vehicle = pose.shape, pose.vehicle
    footprint = in_front(camera, pose.ground_box)
    if not len(footprint):
        return []
    pixels = camera.to_pixels(footprint)
    span = float(np.ptp(pixels[:, 0]))
    if pixels[:, 0].max() < -40 or pixels[:, 0].min() > image.shape[1] + 40:
        return []
    fine = span > 12
    pen = _Pen(image, ids, number, camera, pose, tone)
    eye_x, eye_y = -pose.x, -pose.y
    sin, cos = math.sin(pose.angle), math.cos(pose.angle)
    eye = np.array([eye_x * cos + eye_y * sin, -eye_x * sin + eye_y * cos, camera.height]) / vehicle.scale
    if math.cos(vehicle.yaw) < -0.5:
        eye[0] += shape.length
    sun_local = np.array([sun[0] * cos + sun[1] * sin, -sun[0] * sin + sun[1] * cos, sun[2]])
    half = shape.width / 2
    side = 1.0 if eye[1] > 0 else -1.0
    sides_seen = abs(eye[1]) > half
    rear_seen, front_seen = eye[0] < 0, eye[0] > shape.length

    # Wheels and the dark underneath come first: the body hides their upper halves.
    under = 0.95 if shape.heavy and len(shape.parts) > 1 else 0.3
    if fine and (rear_seen or front_seen):
        x = 0.12 if rear_seen else shape.length - 0.12
        pen.polygon(_across(x, -half * 0.93, half * 0.93, 0.14, under), (26, 26, 28), 0.8)
    for axle, radius in shape.wheels:
        for at in (side, -side):
            y = at * (half - 0.02)
            if at == side and sides_seen:
                continue
            if fine:
                x = axle - radius * 0.9 if rear_seen else axle + radius * 0.9
                pen.polygon(_across(x, y - at * 0.24, y, radius * 0.56, radius * 1.5), _RUBBER)
            pen.polygon(_across(axle, y - at * 0.24, y, 0.0, radius * 1.5), _RUBBER)
    order = sorted(shape.parts, key=lambda part: -abs(float(np.mean([x for x, _ in part.outline])) - eye[0]))
    for part in order:
        _draw_part(pen, part, eye, sun_local, sky, vehicle, fine, sides_seen, side)
    if sides_seen:
        for axle, radius in shape.wheels:
            turn = np.linspace(0, 2 * math.pi, 14 if fine else 7, endpoint=False)
            y = side * (half + 0.005)
            for share, colour in ((1.0, _RUBBER), (0.6, (120.0, 122.0, 126.0)), (0.2, (60.0, 60.0, 62.0))):
                if share < 1 and not fine:
                    break
                ring = np.stack(
                    [
                        axle + radius * share * np.cos(turn),
                        np.full(len(turn), y),
                        radius + radius * share * np.sin(turn),
                    ],
                    axis=1,
                )
                pen.polygon(ring, colour)
    return _draw_lights(pen, shape, vehicle, lamps=lamps, fine=fine, rear_seen=rear_seen, front_seen=front_seen)


def _across(x: float, right: float, left: float, low: float, high: float) -> Floats:
    return np.array([[x, right, low], [x, right, high], [x, left, high], [x, left, low]])


def _draw_part(
    pen: _Pen, part: Part, eye: Floats, sun: Floats, sky: float, vehicle: Vehicle, fine: bool, sides_seen: bool,
    side: float,
) -> None:  # fmt: skip
    outline = np.array(part.outline)
    top = outline[:, 1].max()
    half = part.width / 2 * (1 - part.lean * np.clip((outline[:, 1] - part.belt) / max(top - part.belt, 0.2), 0, 1))
    cargo = _CARGO[int(sum(vehicle.colour)) % len(_CARGO)]
    colours: dict[Surface, Colour] = {
        "body": vehicle.colour,
        "roof": vehicle.colour,
        "glass": (_GLASS[0] + 70 * sky, _GLASS[1] + 75 * sky, _GLASS[2] + 82 * sky),
        "dark": (38, 38, 40),
        "cargo": cargo,
    }
    faces: list[tuple[float, Floats, Surface, Floats]] = []
    for i, surface in enumerate(part.surfaces):
        (x0, z0), (x1, z1) = outline[i], outline[i + 1]
        normal = np.array([-(z1 - z0), 0.0, x1 - x0])
        normal /= max(float(np.hypot(normal[0], normal[2])), 1e-6)
        middle = np.array([(x0 + x1) / 2, 0.0, (z0 + z1) / 2])
        if normal @ (eye - middle) <= 0:
            continue
        quad = np.array([[x0, -half[i], z0], [x1, -half[i + 1], z1], [x1, half[i + 1], z1], [x0, half[i], z0]])
        faces.append((float(np.linalg.norm(eye - middle)), quad, surface, normal))
    faces.sort(key=lambda face: -face[0])

    def light(normal: Floats) -> float:
        return 0.62 + 0.25 * float(normal[2] + 0.2) + 0.75 * max(0.0, float(normal @ sun))

    if sides_seen:
        wall = np.stack([outline[:, 0], side * half, outline[:, 1]], axis=1)
        bright = light(np.array([0.0, side, 0.1]))
        pen.polygon(wall, colours[part.surface], bright)
        if fine and part.surface == "body":
            low = outline[:, 1].min()
            rear, front, top_edge = (outline[0, 0], side * half[0]), (outline[-1, 0], side * half[-1]), low + 0.16
            sill = np.array([(*rear, low), (*rear, top_edge), (*front, top_edge), (*front, low)])
            pen.polygon(sill, vehicle.colour, bright * 0.55)
        for pane in part.windows:
            points = np.array(pane)
            inset = np.interp(points[:, 1], [part.belt, top], [part.width / 2, part.width / 2 * (1 - part.lean)])
            pen.polygon(np.stack([points[:, 0], side * (inset + 0.004), points[:, 1]], axis=1), colours["glass"], 0.9)
    for _, quad, surface, normal in faces:
        gain = light(normal) if surface != "glass" else 0.75 + 0.5 * float(max(normal[2], 0.0))
        if surface == "glass":
            pen.polygon(quad, vehicle.colour, light(normal) * 0.9)
            centre = quad.mean(axis=0)
            quad = centre + (quad - centre) * np.array([0.94, 0.86, 0.88])
        pen.polygon(quad, colours[surface], gain)
    if fine and part.surface == "cargo" and eye[0] < 0:
        pen.polygon(_across(-0.01, -0.015, 0.015, 1.0, top), (60, 60, 60))
        pen.polygon(_across(-0.01, -part.width / 2, part.width / 2, 0.95, 1.1), (70, 70, 72))


def _draw_lights(
    pen: _Pen, shape: Shape, vehicle: Vehicle, *, lamps: bool, fine: bool, rear_seen: bool, front_seen: bool
) -> list[Lamp]:
    if not (rear_seen or front_seen):
        return []
    low, high, wide, front_low, front_high = shape.lights
    half = shape.width / 2
    out: list[Lamp] = []
    x = -0.012 if rear_seen else shape.length + 0.012
    if fine:
        # Bumper, plate, rear window of boxes, grille.
        pen.polygon(_across(x, -half * 0.97, half * 0.97, 0.17 * shape.height if not shape.heavy else 0.45,
                            low * 0.62 if not shape.heavy else 0.58), vehicle.colour, 0.42)  # fmt: skip
        plate = low * 0.72 if rear_seen else front_low * 0.55
        pen.polygon(_across(x * 1.01, -0.27, 0.27, plate, plate + 0.12), (214, 208, 180))
        if vehicle.kind in ("van", "bus"):
            top = shape.height
            if rear_seen:
                for y0, y1 in ((-half * 0.82, -0.05), (0.05, half * 0.82)):
                    pen.polygon(_across(x, y0, y1, top * 0.58, top * 0.86), _GLASS)
            elif vehicle.kind == "bus":
                pen.polygon(_across(x, -half * 0.92, half * 0.92, top * 0.38, top * 0.8), _GLASS)
        if front_seen and not shape.heavy:
            pen.polygon(_across(x, -half * 0.5, half * 0.5, front_low - 0.06, front_high - 0.05), (30, 30, 33))
    for side in (-1.0, 1.0):
        outer = side * half * 0.97
        if rear_seen:
            lit = lamps or vehicle.braking
            colour: Colour = (250.0, 40.0, 30.0) if lit else (125.0, 22.0, 24.0)
            quad = _across(x * 1.01, outer - side * wide, outer, low, high)
        else:
            lit = lamps
            colour = (255.0, 250.0, 235.0) if lit else (190.0, 194.0, 198.0)
            quad = _across(x * 1.01, outer - side * wide * 1.1, outer - side * 0.05, front_low, front_high)
        pen.polygon(quad, colour, mark=False)
        if lit:
            centre = pen.pose.place(quad).mean(axis=0, keepdims=True)
            if centre[0, 0] < 1.0:
                continue
            u, v = pen.camera.to_pixels(centre)[0]
            radius = pen.camera.fx * 0.09 / float(centre[0, 0])
            if rear_seen:
                strength = 0.55 if vehicle.braking and lamps else 0.28
                out.append(Lamp(float(u), float(v), radius, (255.0, 30.0, 20.0), strength, pen.number))
            else:
                out.append(Lamp(float(u), float(v), radius * 1.3, (255.0, 244.0, 225.0), 1.0, pen.number))
    return out
