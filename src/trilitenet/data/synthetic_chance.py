"""Draws synthetic worlds by chance: cameras, light, traffic and scenery, as different as can be."""

from __future__ import annotations

import dataclasses
import math
from typing import Final, Literal

import numpy as np

from trilitenet.data.synthetic_layout import random_layout
from trilitenet.data.synthetic_world import (
    Colour,
    Course,
    Item,
    Layout,
    Light,
    SceneKind,
    TimeOfDay,
    Vehicle,
    Weather,
    World,
)
from trilitenet.processing.geometry import Camera

__all__ = [
    "random_camera",
    "random_light",
    "random_scenery",
    "random_traffic",
    "random_vehicle",
    "random_world",
]


def random_world(rng: np.random.Generator, size: tuple[int, int]) -> World:
    """Draw a scene.

    Args:
        rng: Source of all chance.
        size: (height, width) of the image in pixels.
    """
    kind: SceneKind = rng.choice(
        ["motorway", "country", "city", "residential", "one-way"], p=[0.34, 0.24, 0.24, 0.08, 0.10]
    )
    light = random_light(rng)
    layout = random_layout(rng, kind)
    if rng.random() < 0.3:
        layout = layout.mirrored()
    sharpest = {"motorway": 1 / 400, "country": 1 / 110, "city": 1 / 160, "residential": 1 / 90, "one-way": 1 / 200}
    bend = float(rng.normal(0.0, 0.5)) * sharpest[kind] if rng.random() < 0.75 else 0.0
    bend = float(np.clip(bend, -sharpest[kind], sharpest[kind]))
    rate = float(rng.normal(0.0, 0.6)) * sharpest[kind] / 80
    offset, heading = float(np.clip(rng.normal(0.0, 0.25), -0.6, 0.6)), float(rng.normal(0.0, 0.012))
    if len(layout.lanes) > 1 and rng.random() < 0.12:
        neighbour = min((d for d in layout.lanes if d != 0.0), key=abs)
        offset, heading = (
            neighbour * float(rng.uniform(0.2, 0.5)),
            math.copysign(float(rng.uniform(0, 0.05)), neighbour),
        )
    course = Course(lambda s: bend + rate * np.clip(s, 0, 160), offset, heading)
    urban = kind in ("city", "residential", "one-way") and rng.random() < 0.7
    skyline = (float(rng.uniform(0.0, 0.09)) if rng.random() < 0.6 else 0.0, float(rng.uniform(0.015, 0.10)))
    return World(
        camera=random_camera(rng, size),
        course=course,
        layout=layout,
        light=light,
        # What is cut off beside the camera is left to drives.
        vehicles=tuple(car for car in random_traffic(rng, layout) if course.at(car.s, car.d)[0] > 2.0),
        items=random_scenery(rng, layout, urban),
        texture=int(rng.integers(1 << 30)),
        travelled=float(rng.uniform(0, 100)),
        bearing=float(rng.uniform(-3, 3)),
        skyline=skyline,
        urban=urban,
        bonnet=float(rng.uniform(0.03, 0.13)) if rng.random() < 0.3 else 0.0,
    )


def random_camera(rng: np.random.Generator, size: tuple[int, int]) -> Camera:
    """Draw a dashboard camera: its lens, and how it is mounted."""
    degrees = float(rng.uniform(42, 86))
    height = float(rng.uniform(2.0, 2.6)) if rng.random() < 0.08 else float(rng.uniform(1.1, 1.75))
    level = Camera.from_field_of_view(size, degrees, height)
    row = size[0] * float(np.clip(rng.normal(0.45, 0.06), 0.3, 0.6))
    pitch = math.atan((level.cy - row) / level.fy)
    yaw, roll = float(rng.normal(0.0, 0.02)), float(rng.normal(0.0, 0.011))
    return dataclasses.replace(level, pitch=pitch, yaw=yaw, roll=roll)


def random_light(rng: np.random.Generator) -> Light:
    """Draw time of day and weather."""
    time: TimeOfDay = rng.choice(["day", "dusk", "night"], p=[0.64, 0.14, 0.22])
    weather: Weather = rng.choice(["clear", "overcast", "rain", "fog"], p=[0.45, 0.33, 0.14, 0.08])
    tint = rng.normal(0.0, 0.025, 3)

    def gain(level: float, warm: float = 0.0) -> Colour:
        red, green, blue = level * (1 + np.array([warm, 0.0, -warm]) + tint)
        return float(red), float(green), float(blue)

    grey = float(rng.uniform(150, 235))
    haze = float(rng.uniform(0.0008, 0.004))
    sun = 0.0
    clouds = float(rng.uniform(0.0, 0.7))
    if time == "day":
        ambient = gain(float(rng.uniform(0.75, 1.1)))
        zenith, horizon = (70.0, 125.0, float(rng.uniform(185, 235))), (190.0, 212.0, 232.0)
        if weather == "clear":
            sun = float(rng.uniform(0.3, 0.75))
        else:
            zenith, horizon = (grey * 0.86, grey * 0.9, grey * 0.95), (grey, grey, grey * 1.01)
            ambient, clouds = gain(float(rng.uniform(0.55, 0.9))), 1.0
    elif time == "dusk":
        ambient = gain(float(rng.uniform(0.28, 0.55)), float(rng.uniform(-0.12, 0.15)))
        glow = float(rng.uniform(0.5, 1.0))
        zenith, horizon = (50.0, 62.0, 100.0), (120 + 120 * glow, 120 + 50 * glow, 130.0)
        if weather != "clear":
            zenith, horizon, clouds = (70.0, 78.0, 95.0), (130.0, 130.0, 135.0), 1.0
    else:
        level = float(rng.uniform(0.035, 0.2))
        ambient = gain(level, float(rng.uniform(0.0, 0.3)))
        sky = float(rng.uniform(3, 22))
        zenith, horizon = (sky, sky, sky * 1.2), (sky * 2.0, sky * 1.8, sky * 1.7)
    if weather == "fog":
        haze = float(rng.uniform(0.012, 0.045))
        zenith = horizon if time != "night" else zenith
    elif weather == "rain":
        haze = float(rng.uniform(0.004, 0.012))
    return Light(
        time=time,
        weather=weather,
        ambient=ambient,
        sun=sun,
        azimuth=float(rng.uniform(-math.pi, math.pi)),
        zenith=zenith,
        horizon=horizon,
        haze=haze,
        clouds=clouds,
        headlights={"day": 0.0, "dusk": float(rng.uniform(0.0, 0.25)), "night": float(rng.uniform(0.5, 1.1))}[time],
        lamps=time != "day" or (weather in ("rain", "fog") and rng.random() < 0.7),
        wet=float(rng.uniform(0.4, 1.0)) if weather == "rain" else 0.0,
    )


_PAINTS: Final[tuple[Colour, ...]] = (
    (225, 226, 228), (200, 202, 205), (150, 152, 156), (95, 98, 103), (52, 54, 58), (26, 27, 30), (38, 58, 105),
    (120, 22, 26), (168, 30, 30), (70, 92, 118), (120, 108, 88), (34, 62, 48), (190, 150, 60), (120, 140, 165),
)  # fmt: skip


def random_vehicle(
    rng: np.random.Generator,
    s: float,
    d: float,
    yaw: float,
    *,
    heavy: float = 0.18,
    number: int = 0,
) -> Vehicle:
    """Draw a vehicle's kind and colour.

    Args:
        rng: Source of chance.
        s: Metres along the road.
        d: Metres left of the ego lane's centre.
        yaw: Radians it points to the left of the road.
        heavy: Share of trucks, buses and vans.
        number: Its identity.
    """
    if rng.random() < heavy:
        kind = str(rng.choice(["van", "truck", "bus", "lorry"], p=[0.4, 0.3, 0.12, 0.18]))
    else:
        kind = str(rng.choice(["sedan", "hatchback", "estate", "suv", "pickup"], p=[0.3, 0.27, 0.14, 0.22, 0.07]))
    base = np.array(_PAINTS[int(rng.integers(len(_PAINTS)))]) * rng.uniform(0.85, 1.1)
    red, green, blue = np.clip(base + rng.normal(0, 5, 3), 8, 245)
    return Vehicle(
        kind, s, d, yaw, (float(red), float(green), float(blue)), float(rng.uniform(0.93, 1.07)),
        bool(rng.random() < 0.25), number,
    )  # fmt: skip


def random_traffic(rng: np.random.Generator, layout: Layout) -> tuple[Vehicle, ...]:
    """Draw the vehicles on every lane, with room between them."""
    vehicles: list[Vehicle] = []
    density = float(rng.choice([0.0, 0.4, 1.0, 1.8, 3.0], p=[0.08, 0.25, 0.32, 0.22, 0.13]))

    def fill(d: float, yaw: float, start: float, mean_gap: float, limit: int, heavy: float, wobble: float) -> None:
        s = start + float(rng.exponential(mean_gap))
        for _ in range(limit):
            if s > 190:
                return
            turn = yaw + float(rng.normal(0, 0.012))
            vehicle = random_vehicle(rng, s, d + float(rng.normal(0, wobble)), turn, heavy=heavy)
            vehicles.append(vehicle)
            length = 17.0 if vehicle.kind in ("truck", "bus", "lorry") else 5.5
            s += length + 2.5 + float(rng.exponential(mean_gap))

    if density > 0:
        heavy = 0.28 if layout.kind == "motorway" else 0.15
        for d in layout.lanes:
            start = 5.5 if abs(d) < 0.1 else 1.0
            fill(d, 0.0, start, 42 / density, 6, heavy, 0.2)
        for d in layout.oncoming:
            fill(d, math.pi, 4.0, 45 / density, 5, heavy, 0.2)
    for d in layout.parking:
        if rng.random() < 0.8:
            fill(d, 0.0 if rng.random() < 0.75 else math.pi, 3.0, float(rng.uniform(0.8, 8.0)), 9, 0.1, 0.08)
    if layout.kind in ("city", "residential", "one-way", "country") and rng.random() < 0.14:
        side = float(rng.choice([-1.0, 1.0]))
        d = layout.paved[0 if side < 0 else 1] + side * float(rng.uniform(-1.5, 4.0))
        vehicles.append(
            random_vehicle(rng, float(rng.uniform(14, 60)), d, -side * float(rng.uniform(0.5, 2.6)), heavy=0.1)
        )
    return tuple(vehicles)


def random_scenery(rng: np.random.Generator, layout: Layout, urban: bool, start: float = 4.0) -> tuple[Item, ...]:
    """Draw trees, houses, lamps, signs, posts and people beside the road."""
    items: list[Item] = []
    beyond = layout.opposite or layout.paved
    outer = (min(layout.paved[0], beyond[0]) - layout.pavement, max(layout.paved[1], beyond[1]) + layout.pavement)
    for side, edge in ((-1.0, outer[0]), (1.0, outer[1])):
        trees = float(rng.choice([0.0, 0.3, 1.0, 2.2], p=[0.2, 0.3, 0.3, 0.2])) * (0.5 if urban else 1.0)
        setback = float(rng.uniform(0.5, 3.0)) if urban else float(rng.uniform(1.5, 8.0))
        s = start + float(rng.exponential(12))
        while trees > 0 and s < 190:
            away = setback + float(rng.exponential(2.0 if urban else 6.0))
            tall = float(rng.uniform(3.5, 11.0))
            if rng.random() < 0.25:
                tall = float(rng.uniform(0.7, 2.2))
            kind: Literal["tree", "bush"] = "bush" if tall < 2.5 else "tree"
            spread = tall * (float(rng.uniform(1.0, 1.9)) if kind == "bush" else float(rng.uniform(0.55, 0.95)))
            away = max(away, spread / 2 + 0.2) if not layout.pavement else away
            items.append(Item(kind, s, edge + side * away, spread, tall, int(rng.integers(1000))))
            s += float(rng.exponential(14 / trees)) + 1.0
        if urban:
            s = start + float(rng.uniform(-8, 12))
            front = edge + side * float(rng.uniform(0.5, 6.0))
            while s < 150:
                long = float(rng.uniform(7, 24))
                if rng.random() < 0.88:
                    items.append(Item("building", s, front + side * float(rng.uniform(0, 2)), long,
                                      float(rng.uniform(4.5, 17)), int(rng.integers(1000))))  # fmt: skip
                s += long + (0.0 if rng.random() < 0.6 else float(rng.uniform(2, 12)))
        if rng.random() < 0.5:
            step, s = float(rng.uniform(24, 40)), start + float(rng.uniform(2, 30))
            tall = float(rng.uniform(6, 10))
            while s < 150:
                items.append(Item("lamp", s, edge - side * 0.3, 1.8 * -side, tall, 0))
                s += step
        if rng.random() < 0.5 and not layout.pavement:
            s = start + float(rng.uniform(2, 30))
            while s < 140:
                items.append(Item("post", s, edge + side * 0.6, 0.12, 1.0, 0))
                s += 25.0 if layout.kind == "country" else 50.0
        for _ in range(int(rng.integers(0, 3))):
            items.append(
                Item("sign", float(rng.uniform(14, 110)), edge + side * float(rng.uniform(0.4, 1.5)),
                     float(rng.choice([0.6, 0.75, 1.6, 3.0], p=[0.4, 0.3, 0.2, 0.1])), float(rng.uniform(2.2, 3.2)),
                     int(rng.integers(1000)))
            )  # fmt: skip
        if layout.pavement:
            for _ in range(int(rng.integers(0, 4))):
                s, d = float(rng.uniform(7, 60)), edge - side * float(rng.uniform(0.2, layout.pavement))
                items.append(Item("pedestrian", s, d, 0.5, float(rng.uniform(1.55, 1.9)), int(rng.integers(1000))))
    if layout.kind == "motorway" and rng.random() < 0.3:
        items.append(Item("gantry", float(rng.uniform(30, 120)), 0.0, 1.0, 5.8, int(rng.integers(1000))))
    return tuple(items)
