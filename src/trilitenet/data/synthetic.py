"""Procedural road scenes and drives with exact labels: a real pinhole camera over a flat road, no downloads.

`SyntheticScenes` gives single pictures as different from each other as they can be, for training and tests;
`SyntheticDrive` gives the frames of a video with a known camera. Both are deterministic: a picture depends only on
(seed, index). Colours are RGB.
"""

from __future__ import annotations

import dataclasses
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from trilitenet.config import as_size
from trilitenet.data.sample import Sample
from trilitenet.data.synthetic_chance import random_world
from trilitenet.data.synthetic_render import FIRST_VEHICLE, Rendering, render
from trilitenet.data.synthetic_vehicles import VehiclePose, in_front
from trilitenet.data.synthetic_world import World
from trilitenet.errors import ConfigError
from trilitenet.processing.geometry import Camera

__all__ = ["LaneLabels", "LineTruth", "ObjectTruth", "Scene", "SceneTruth", "SyntheticScenes", "label_scene"]

LaneLabels = Literal["lines", "paint"]
LineKind = Literal["solid", "dashed", "double", "kerb"]
LineColour = Literal["white", "yellow", "none"]

MIN_SIDE: Final = 7.0
"""A vehicle lower or narrower than this many pixels at 640 pixels of image width is ignored."""
MIN_VISIBLE: Final = 0.25
"""A vehicle of which less than this share is visible is ignored."""


@dataclasses.dataclass(frozen=True, eq=False)
class LineTruth:
    """A painted line or kerb.

    Attributes:
        d: Metres left of the ego lane's centre.
        points: (N, 2) x forward, y left in metres, one a metre.
        polynomial: (4,) coefficients of y(x) = c0 + c1 x + c2 x^2 + c3 x^3, fitted from 0 to 60 m.
        kind: ``"solid"``, ``"dashed"``, ``"double"`` or ``"kerb"``.
        colour: ``"white"``, ``"yellow"`` or ``"none"`` for a kerb.
    """

    d: float
    points: NDArray[np.float64]
    polynomial: NDArray[np.float64]
    kind: LineKind
    colour: LineColour


@dataclasses.dataclass(frozen=True, eq=False)
class ObjectTruth:
    """A vehicle of which something is visible.

    Attributes:
        kind: Name of its shape.
        number: Its identity over the frames of a drive.
        box: (4,) left, top, right, bottom in pixels, of the visible part.
        visible: Share of its outline within the image that nothing hides, in [0, 1].
        distance: Metres forward to its nearest end (the rear bumper of one ahead); may be negative for one beside.
        lateral: Metres left of the ego vehicle's axis.
        d: Metres left of the ego lane's centre.
        speed: m/s along the road.
        ignored: True when it is too small, too hidden or too dark to be asked for.
    """

    kind: str
    number: int
    box: NDArray[np.float32]
    visible: float
    distance: float
    lateral: float
    d: float
    speed: float
    ignored: bool


@dataclasses.dataclass(frozen=True, eq=False)
class SceneTruth:
    """What is exactly known of a scene.

    Attributes:
        camera: The camera, calibrated.
        lines: Painted lines and kerbs, left to right.
        objects: Vehicles, near to far.
        lane_width: Metres.
        offset: Metres the vehicle is left of its lane's centre.
        heading: Radians the vehicle points to the left of its lane.
        curvature: 1/m of its lane where the vehicle is, positive to the left.
        speed: The vehicle's own speed in m/s; 0 for a single picture.
        timestamp: Seconds from the start of the drive.
        paint: (H, W) uint8 {0, 1}: pixels that are painted, without the gaps of dashes.
    """

    camera: Camera
    lines: tuple[LineTruth, ...]
    objects: tuple[ObjectTruth, ...]
    lane_width: float
    offset: float
    heading: float
    curvature: float
    speed: float
    timestamp: float
    paint: NDArray[np.uint8]

    @property
    def lead(self) -> ObjectTruth | None:
        """The nearest vehicle ahead in the ego lane that is not ignored; None without one."""
        ahead = [o for o in self.objects if o.distance > 0 and abs(o.d) < self.lane_width / 2 and not o.ignored]
        return min(ahead, key=lambda o: o.distance, default=None)


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """A picture with its labels and with what is known of it."""

    sample: Sample
    truth: SceneTruth


class SyntheticScenes:
    """Endless single road scenes.

    Args:
        seed: Another seed gives other scenes.
        size: (height, width) in pixels.
        count: Length of the sequence.
        labels: ``"lines"`` marks lanes as annotators of driving data do: lines of constant width, through the gaps of
            dashed ones, and kerbs. ``"paint"`` marks painted pixels.
        faults: Add the blur, noise and compression of a cheap camera.
    """

    def __init__(
        self,
        seed: int = 0,
        size: tuple[int, int] = (384, 640),
        count: int = 1_000_000,
        *,
        labels: LaneLabels = "lines",
        faults: bool = True,
    ) -> None:
        if labels not in get_args(LaneLabels):
            raise ConfigError(f"labels must be 'lines' or 'paint', got {labels!r}")
        size = as_size(size)
        if min(size) < 32:
            raise ConfigError(f"size must be at least 32 pixels each way, got {size}")
        for name, value in (("seed", seed), ("count", count)):
            if value < 0:
                raise ConfigError(f"{name} must not be negative, got {value}")
        self.seed, self.size, self.length, self.labels, self.faults = seed, size, count, labels, faults

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> Sample:
        return self.scene(index).sample

    def name(self, index: int) -> str:
        """Return what scene ``index`` is called, without drawing it."""
        return f"synthetic_{self.seed}_{index:06d}"

    def scene(self, index: int) -> Scene:
        """Return scene ``index`` with its truth.

        Raises:
            IndexError: If it is out of range.
        """
        if not 0 <= index < self.length:
            raise IndexError(f"scene {index} of {self.length}")
        rng = np.random.default_rng((self.seed, index))
        world = random_world(rng, self.size)
        drawn = render(world, rng, faults=self.faults)
        return label_scene(world, drawn, self.name(index), labels=self.labels)


_TIMES: Final = {"day": "daytime", "dusk": "dawn/dusk", "night": "night"}
_WEATHER: Final = {"clear": "clear", "overcast": "overcast", "rain": "rainy", "fog": "foggy"}
_SCENES: Final = {
    "motorway": "highway",
    "country": "highway",
    "city": "city street",
    "one-way": "city street",
    "residential": "residential",
}


def label_scene(
    world: World,
    drawn: Rendering,
    name: str,
    *,
    labels: LaneLabels = "lines",
    speed: float = 0.0,
    timestamp: float = 0.0,
) -> Scene:
    """Turn a drawn world into a sample and its truth.

    Args:
        world: What was drawn.
        drawn: The picture and its masks.
        name: Name of the sample.
        labels: ``"lines"`` or ``"paint"``.
        speed: The ego vehicle's speed in m/s.
        timestamp: Seconds from the start of the drive.
    """
    objects = _objects(world, drawn)
    kept = [o for o in objects if not o.ignored]
    sample = Sample(
        name=name,
        image=drawn.image,
        boxes=np.array([o.box for o in kept], np.float32).reshape(-1, 4),
        class_id=np.zeros(len(kept), np.int64),
        ignored=np.array([o.box for o in objects if o.ignored], np.float32).reshape(-1, 4),
        drivable=drawn.drivable,
        lane=drawn.lines if labels == "lines" else drawn.paint,
        attributes={
            "timeofday": _TIMES[world.light.time],
            "weather": _WEATHER[world.light.weather],
            "scene": _SCENES[world.layout.kind],
            "source": "synthetic",
        },
    )
    truth = SceneTruth(
        camera=world.camera,
        lines=_lines(world),
        objects=objects,
        lane_width=world.layout.lane_width,
        offset=world.course.offset - world.ego_lane,
        heading=world.course.heading,
        curvature=world.course.curvature,
        speed=speed,
        timestamp=timestamp,
        paint=drawn.paint,
    )
    return Scene(sample, truth)


def _lines(world: World) -> tuple[LineTruth, ...]:
    course, layout = world.course, world.layout
    twins = [mark.d for mark in layout.markings if mark.twin]
    found: list[LineTruth] = []

    def add(d: float, kind: LineKind, colour: LineColour) -> None:
        points = course.line(d)
        near = points[:, 0] <= 60
        polynomial = np.polynomial.polynomial.polyfit(points[near, 0], points[near, 1], 3)
        found.append(LineTruth(d - world.ego_lane, points, polynomial, kind, colour))

    for mark in layout.markings:
        if mark.twin:
            continue
        twin = next((d for d in twins if abs(d - mark.d) < 0.5), None)
        if twin is not None:
            add((mark.d + twin) / 2, "double", mark.colour)
        else:
            add(mark.d, "dashed" if mark.dash else "solid", mark.colour)
    for kerb in layout.kerbs:
        add(kerb, "kerb", "none")
    return tuple(sorted(found, key=lambda line: -line.d))


_ALONG_EDGES: Final = [0, 1, 2, 3, 0, 4, 5, 1, 5, 6, 2, 6, 7, 3, 7, 4]
"""A closed way along all edges of a block: corners 0 to 3 are its lower ones, 4 to 7 those above them."""


def _objects(world: World, drawn: Rendering) -> tuple[ObjectTruth, ...]:
    height, width = world.camera.size
    found: list[ObjectTruth] = []
    smallest = MIN_SIDE * width / 640
    for index, (pose, lit) in enumerate(zip(drawn.poses, drawn.lit, strict=True)):
        full = _outline(world.camera, pose)
        if full is None:
            continue
        x0, y0 = max(0, int(full[0]) - 2), max(0, int(full[1]) - 2)
        x1, y1 = min(width, int(full[2]) + 3), min(height, int(full[3]) + 3)
        if x1 <= x0 or y1 <= y0:
            continue
        mask = drawn.ids[y0:y1, x0:x1] == FIRST_VEHICLE + index
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        if len(rows) < 2 or len(columns) < 2:
            continue
        # An outline fills every pixel that it touches, so that it ends in the middle of the outermost ones, on average.
        box = np.array([x0 + columns[0], y0 + rows[0], x0 + columns[-1], y0 + rows[-1]], np.float32) + np.float32(0.5)
        box[:2][box[:2] < 1] = 0.0
        box[2:] = np.where(box[2:] > (width - 1, height - 1), (width, height), box[2:])
        inside = (min(full[2], width) - max(full[0], 0)) * (min(full[3], height) - max(full[1], 0))
        visible = float(min(1.0, mask.sum() / max(inside * 0.8, 1.0)))
        hidden = visible < MIN_VISIBLE or lit < 0.12
        tiny = box[2] - box[0] < smallest or box[3] - box[1] < smallest
        footprint = pose.ground_box
        found.append(
            ObjectTruth(
                kind=pose.vehicle.kind,
                number=pose.vehicle.number,
                box=box,
                visible=visible,
                distance=float(footprint[:, 0].min()) if abs(np.sin(pose.angle)) > 0.5 else pose.x,
                lateral=pose.y,
                d=pose.vehicle.d - world.ego_lane,
                speed=pose.vehicle.speed,
                ignored=bool(hidden or tiny),
            )
        )
    return tuple(sorted(found, key=lambda o: o.distance))


def _outline(camera: Camera, pose: VehiclePose) -> tuple[float, float, float, float] | None:
    """Return the box in pixels around what of the block about the vehicle lies before the camera; None if nothing."""
    low = pose.ground_box
    high = low + np.array([0.0, 0.0, pose.shape.height * pose.vehicle.scale])
    corners = in_front(camera, np.concatenate([low, high])[_ALONG_EDGES])
    if not len(corners):
        return None
    pixels = camera.to_pixels(corners)
    left, top = pixels.min(axis=0)
    right, bottom = pixels.max(axis=0)
    return float(left), float(top), float(right), float(bottom)
