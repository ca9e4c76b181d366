"""What a synthetic scene consists of, before anything is drawn, all in metres.

Road coordinates: s metres along the road from the ego vehicle, d metres to the left of the ego lane's centre.
Vehicle coordinates: x forward, y left, z up (see `trilitenet.processing.geometry`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Final, Literal

import numpy as np

from trilitenet.processing.geometry import Camera, Floats

__all__ = [
    "FAR",
    "Barrier",
    "Colour",
    "Course",
    "Item",
    "Layout",
    "Light",
    "Marking",
    "SceneKind",
    "TimeOfDay",
    "Vehicle",
    "Weather",
    "World",
]

Colour = tuple[float, float, float]
SceneKind = Literal["motorway", "country", "city", "residential", "one-way"]
TimeOfDay = Literal["day", "dusk", "night"]
Weather = Literal["clear", "overcast", "rain", "fog"]

FAR: Final = 260.0
"""Metres ahead that the road is drawn to."""


class Course:
    """The road's centre of the ego lane (d = 0) ahead of the vehicle, integrated from its curvature.

    Args:
        curvature: Curvature in 1/m at arc lengths in metres from the ego vehicle (positive bends to the left).
        offset: Metres the ego vehicle is left of d = 0.
        heading: Radians the ego vehicle points to the left of the road.
    """

    STEP: Final = 0.25
    BEHIND: Final = 12.0

    def __init__(self, curvature: Callable[[Floats], Floats], offset: float, heading: float) -> None:
        self.offset, self.heading = offset, heading
        s = np.arange(-self.BEHIND, FAR * 1.3, self.STEP)
        bend = np.asarray(curvature(s), np.float64)
        start = round(self.BEHIND / self.STEP)
        angle = np.concatenate([[0.0], np.cumsum((bend[1:] + bend[:-1]) / 2 * self.STEP)])
        angle = np.clip(angle - angle[start] - heading, -1.1, 1.1)
        middle = (angle[1:] + angle[:-1]) / 2
        x = np.concatenate([[0.0], np.cumsum(np.cos(middle) * self.STEP)])
        y = np.concatenate([[0.0], np.cumsum(np.sin(middle) * self.STEP)])
        # The foot of the perpendicular from the vehicle is s = 0.
        self.s, self.angle, self.bend = s, angle, bend
        self.x = x - x[start] + offset * math.sin(-heading)
        self.y = y - y[start] - offset * math.cos(heading)
        self.grid = np.arange(0.0, FAR + self.STEP, self.STEP)
        self.grid_y = np.interp(self.grid, self.x, self.y)
        self.grid_angle = np.interp(self.grid, self.x, self.angle)
        self.grid_s = np.interp(self.grid, self.x, self.s)

    @property
    def curvature(self) -> float:
        """1/m at the ego vehicle."""
        return float(np.interp(0.0, self.s, self.bend))

    def at(self, s: float, d: float) -> tuple[float, float, float]:
        """Return (x, y, direction of the road in radians) of a point in road coordinates."""
        x, y = float(np.interp(s, self.s, self.x)), float(np.interp(s, self.s, self.y))
        angle = float(np.interp(s, self.s, self.angle))
        return x - d * math.sin(angle), y + d * math.cos(angle), angle

    def line(self, d: float, start: float = 0.0, end: float = 100.0, step: float = 1.0) -> Floats:
        """Return (N, 2) x, y of the line at constant d, at every ``step`` metres of x, exactly as it is drawn."""
        x = np.arange(start, end + step / 2, step)
        y = np.interp(x, self.grid, self.grid_y) + d / np.cos(np.interp(x, self.grid, self.grid_angle))
        return np.stack([x, y], axis=1)


@dataclasses.dataclass(frozen=True)
class Marking:
    """A painted line along the road.

    Attributes:
        d: Metres left of the ego lane's centre.
        width: Metres.
        dash: Metres of paint in a period; 0 = solid.
        gap: Metres without paint in a period.
        colour: ``"white"`` or ``"yellow"``.
        wear: Share of the paint that is gone, in [0, 1].
        twin: True for the second of a double line, which is no line of its own.
    """

    d: float
    width: float = 0.15
    dash: float = 0.0
    gap: float = 0.0
    colour: Literal["white", "yellow"] = "white"
    wear: float = 0.1
    twin: bool = False


@dataclasses.dataclass(frozen=True)
class Barrier:
    """A long thing beside the road: a guard rail, a concrete barrier, a wall, a hedge or a fence.

    Attributes:
        d: Metres left of the ego lane's centre.
        kind: ``"rail"``, ``"concrete"``, ``"wall"`` or ``"hedge"``.
        height: Metres.
        colour: RGB, 0..255.
        start: Metres along the road where it begins.
        end: Where it ends.
    """

    d: float
    kind: Literal["rail", "concrete", "wall", "hedge"]
    height: float
    colour: Colour
    start: float = 0.0
    end: float = FAR


@dataclasses.dataclass(frozen=True)
class Layout:
    """The road's cross-section; every number is d in metres unless said otherwise.

    Attributes:
        kind: The kind of scene.
        lane_width: Metres.
        drivable: (right, left) bounds of the ego vehicle's own carriageway.
        paved: (right, left) bounds of the asphalt it lies in.
        opposite: (right, left) bounds of a separate carriageway; None without one.
        markings: Painted lines.
        kerbs: Kerbs, which annotators label as lines too.
        pavement: Width in metres of the footway beyond the kerbs; 0 = none.
        barriers: Long things beside the road.
        lanes: Centres of lanes with traffic in the ego vehicle's direction.
        oncoming: Centres of lanes with traffic against it.
        parking: Centres of rows of parked cars.
        asphalt: RGB.
        verge: RGB of the ground next to the road.
        terrain: RGB of the ground farther away.
        rough: Strength of the asphalt's texture.
    """

    kind: SceneKind
    lane_width: float
    drivable: tuple[float, float]
    paved: tuple[float, float]
    opposite: tuple[float, float] | None
    markings: tuple[Marking, ...]
    kerbs: tuple[float, ...]
    pavement: float
    barriers: tuple[Barrier, ...]
    lanes: tuple[float, ...]
    oncoming: tuple[float, ...]
    parking: tuple[float, ...]
    asphalt: Colour
    verge: Colour
    terrain: Colour
    rough: float

    def mirrored(self) -> Layout:
        """Return the layout for traffic on the other side."""

        def swap(pair: tuple[float, float]) -> tuple[float, float]:
            return -pair[1], -pair[0]

        return dataclasses.replace(
            self,
            drivable=swap(self.drivable),
            paved=swap(self.paved),
            opposite=None if self.opposite is None else swap(self.opposite),
            markings=tuple(dataclasses.replace(m, d=-m.d) for m in self.markings),
            kerbs=tuple(-d for d in self.kerbs),
            barriers=tuple(dataclasses.replace(b, d=-b.d) for b in self.barriers),
            lanes=tuple(-d for d in self.lanes),
            oncoming=tuple(-d for d in self.oncoming),
            parking=tuple(-d for d in self.parking),
        )


@dataclasses.dataclass(frozen=True)
class Light:
    """Time of day and weather, and what they do to the picture.

    Attributes:
        time: ``"day"``, ``"dusk"`` or ``"night"``.
        weather: ``"clear"``, ``"overcast"``, ``"rain"`` or ``"fog"``.
        ambient: RGB gain on every surface.
        sun: Strength of direct sun, 0 = none; it casts shadows.
        azimuth: Radians to the left of the road where the sun stands.
        zenith: RGB of the sky overhead.
        horizon: RGB of the sky at the horizon, which distant things fade into.
        haze: Extinction in 1/m.
        clouds: Share of the sky under cloud, in [0, 1].
        headlights: Strength of the ego vehicle's headlights.
        lamps: True when vehicles have their lights on.
        wet: How wet the road is, in [0, 1].
    """

    time: TimeOfDay
    weather: Weather
    ambient: Colour
    sun: float
    azimuth: float
    zenith: Colour
    horizon: Colour
    haze: float
    clouds: float
    headlights: float
    lamps: bool
    wet: float

    def tone(self, colour: Colour, x: float, y: float) -> Colour:
        """Return the colour that a surface at (x, y) metres shows."""
        beam = 0.0
        if self.headlights:
            spread = y / (1.6 + 0.22 * max(x, 0.0))
            beam = self.headlights * math.exp(-spread * spread) * math.exp(-max(x, 0.0) / 38.0) * 0.8
        clear = math.exp(-self.haze * max(x, 0.0))
        red, green, blue = (
            min(255.0, c * (a + beam)) * clear + h * (1 - clear)
            for c, a, h in zip(colour, self.ambient, self.horizon, strict=True)
        )
        return red, green, blue

    def lamp_tone(self, colour: Colour, x: float) -> Colour:
        """As `tone`, for what shines by itself, ``x`` metres ahead."""
        clear = math.exp(-self.haze * 0.5 * max(x, 0.0))
        red, green, blue = (c * clear + h * (1 - clear) for c, h in zip(colour, self.horizon, strict=True))
        return red, green, blue


@dataclasses.dataclass(frozen=True)
class Vehicle:
    """A vehicle on the road.

    Attributes:
        kind: Name of a shape in `trilitenet.data.synthetic_vehicles.SHAPES`.
        s: Metres along the road to its rear (its end nearest to the ego vehicle for one that goes the same way).
        d: Metres left of the ego lane's centre, of its axis.
        yaw: Radians it points to the left of the road; pi for one that comes towards the ego vehicle.
        colour: RGB.
        scale: Size relative to the shape's.
        braking: Brake lights on.
        number: Identity over the frames of a drive.
        speed: m/s along the road, against it negative.
    """

    kind: str
    s: float
    d: float
    yaw: float
    colour: Colour
    scale: float = 1.0
    braking: bool = False
    number: int = 0
    speed: float = 0.0


@dataclasses.dataclass(frozen=True)
class Item:
    """A thing beside or over the road that is no vehicle.

    Attributes:
        kind: What it is.
        s: Metres along the road.
        d: Metres left of the ego lane's centre.
        width: Metres across (along the road for a building).
        height: Metres.
        style: Picks one of the prepared pictures or colours.
    """

    kind: Literal["tree", "bush", "building", "lamp", "sign", "gantry", "post", "pedestrian"]
    s: float
    d: float
    width: float
    height: float
    style: int


@dataclasses.dataclass(frozen=True)
class World:
    """All of one scene.

    Attributes:
        camera: The camera it is seen by.
        course: The road's course.
        layout: The road's cross-section.
        light: Time of day and weather.
        vehicles: In any order.
        items: In any order.
        texture: Seed of the noise on surfaces.
        travelled: Metres from the start of the drive, which dashes and textures are anchored to.
        bearing: Radians the vehicle has turned to the left since the start, which the skyline is anchored to.
        skyline: Height of the skyline in radians, of (hills, trees or houses).
        urban: True when the skyline is houses.
        bonnet: Share of the image's height that the own bonnet covers; 0 = none.
    """

    camera: Camera
    course: Course
    layout: Layout
    light: Light
    vehicles: tuple[Vehicle, ...]
    items: tuple[Item, ...]
    texture: int
    travelled: float = 0.0
    bearing: float = 0.0
    skyline: tuple[float, float] = (0.03, 0.05)
    urban: bool = False
    bonnet: float = 0.0

    @property
    def ego_lane(self) -> float:
        """Centre of the lane that the ego vehicle is in: d in metres."""
        return min(self.layout.lanes, key=lambda d: abs(d - self.course.offset))
