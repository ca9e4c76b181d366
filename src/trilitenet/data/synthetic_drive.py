"""A drive on a motorway as the frames of a video: coherent in time, with a known camera and exact truth a frame."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Final

import numpy as np

from trilitenet.config import as_size
from trilitenet.data.synthetic import Scene, label_scene
from trilitenet.data.synthetic_chance import random_light, random_scenery, random_vehicle
from trilitenet.data.synthetic_layout import random_layout
from trilitenet.data.synthetic_render import render
from trilitenet.data.synthetic_world import FAR, Course, Item, Layout, Light, TimeOfDay, Vehicle, Weather, World
from trilitenet.errors import ConfigError
from trilitenet.processing.geometry import Camera, Floats

__all__ = ["SyntheticDrive"]

_CHUNK: Final = 150.0
"""Metres of scenery that are drawn up at once."""


class SyntheticDrive:
    """The frames of a drive in the middle one of three lanes.

    There is a vehicle ahead, which the ego vehicle closes on; a change to the lane on the left at 45% of the drive; a
    second vehicle ahead there; and traffic on the other lanes and against.

    Args:
        seed: Another seed gives another road, light and traffic.
        frames: How many frames.
        fps: Frames a second.
        size: (height, width) in pixels.
        time: Time of day.
        weather: The weather.
        faults: Add the noise and blur of a cheap camera.
    """

    def __init__(
        self,
        seed: int = 0,
        frames: int = 1500,
        fps: float = 25.0,
        size: tuple[int, int] = (720, 1280),
        *,
        time: TimeOfDay = "day",
        weather: Weather = "clear",
        faults: bool = True,
    ) -> None:
        if frames < 1 or not 0 < fps < math.inf:
            raise ConfigError(f"a drive needs at least one frame and a positive rate, got {frames} and {fps}")
        if seed < 0:
            raise ConfigError(f"seed must not be negative, got {seed}")
        self.seed, self.frames, self.fps, self.faults = seed, frames, fps, faults
        self.camera = Camera.from_field_of_view(as_size(size), 60.0, 1.4, pitch=0.03)
        self.duration = frames / fps
        rng = np.random.default_rng((seed, 0xD21FE))
        self._speed = float(rng.uniform(20, 25))
        self._light = _find_light(rng, time, weather)
        self._layout = _find_layout(rng)
        self._waves = [
            (float(rng.uniform(0.6, 1.0)) / 700, float(rng.uniform(350, 500)), float(rng.uniform(0, 6.28))),
            (float(rng.uniform(0.4, 1.0)) / 1600, float(rng.uniform(150, 220)), float(rng.uniform(0, 6.28))),
        ]
        self._texture = int(rng.integers(1 << 28)) * 55 + 1  # no cracks, patches or bars across the road
        self._skyline = (float(rng.uniform(0.02, 0.06)), float(rng.uniform(0.02, 0.05)))
        self._change_at = 0.45 * self.duration
        self._actors = self._draw_actors(rng)

    def __len__(self) -> int:
        return self.frames

    def __getitem__(self, index: int) -> Scene:
        """Return frame ``index``.

        Raises:
            IndexError: If it is out of range.
        """
        if not 0 <= index < self.frames:
            raise IndexError(f"frame {index} of {self.frames}")
        time = index / self.fps
        world = self.world(time)
        drawn = render(
            world,
            np.random.default_rng((self.seed, 1)),
            faults=self.faults,
            moment=np.random.default_rng((self.seed, 2, index)),
        )
        return label_scene(world, drawn, f"drive_{self.seed}_{index:06d}", speed=self._speed, timestamp=time)

    def world(self, time: float) -> World:
        """Return everything there is, ``time`` seconds after the start."""
        travelled = self._speed * time
        offset, rate = self._aside(time)
        course = Course(lambda s: self._curvature(s + travelled), offset, math.atan2(rate, self._speed))
        vehicles = [vehicle for actor in self._actors if (vehicle := actor(time)) is not None]
        first = int((travelled + 3) // _CHUNK)
        items = [
            dataclasses.replace(item, s=item.s + chunk * _CHUNK - travelled)
            for chunk in range(first, first + 3)
            for item in _scenery(self.seed, chunk, self._layout)
        ]
        return World(
            camera=self.camera,
            course=course,
            layout=self._layout,
            light=self._light,
            vehicles=tuple(vehicles),
            items=tuple(item for item in items if 2 < item.s < FAR * 0.85),
            texture=self._texture,
            travelled=travelled,
            bearing=self._turned(travelled) + course.heading,
            skyline=self._skyline,
        )

    def _curvature(self, s: Floats) -> Floats:
        return np.asarray(sum(a * np.sin(2 * math.pi * s / long + phase) for a, long, phase in self._waves))

    def _turned(self, s: float) -> float:
        """Integral of the curvature from the start to s."""
        return sum(
            a * long / (2 * math.pi) * (math.cos(phase) - math.cos(2 * math.pi * s / long + phase))
            for a, long, phase in self._waves
        )

    def _aside(self, time: float) -> tuple[float, float]:
        """Return the ego vehicle's d and its rate in m/s: weaving a little, and the change of lanes."""
        weave, period = 0.14, 7.0
        phase = 2 * math.pi * time / period
        d, rate = weave * math.sin(phase), weave * math.cos(phase) * 2 * math.pi / period
        long = 4.5
        share = min(1.0, max(0.0, (time - self._change_at) / long))
        width = self._layout.lane_width
        d += width * share**3 * (10 - 15 * share + 6 * share**2)
        rate += width * 30 * share**2 * (1 - share) ** 2 / long
        return d, rate

    def _draw_actors(self, rng: np.random.Generator) -> list[_Actor]:
        actors: list[_Actor] = []
        width, speed = self._layout.lane_width, self._speed

        def add(d: float, s: float, relative: float, *, wave: float = 0.0, heavy: float = 0.2) -> None:
            number = len(actors) + 1
            model = random_vehicle(rng, 0.0, d, 0.0, heavy=heavy, number=number)
            actors.append(_Actor(model, s, relative, wave, float(rng.uniform(12, 18)), speed))

        # The one ahead: the ego vehicle closes in on it until it changes lanes, and passes it afterwards.
        change = self._change_at
        add(0.0, 13.0 + 1.3 * change, -1.3, wave=1.5, heavy=0.0)
        add(width, 38.0, 0.0, wave=9.0, heavy=0.0)
        for i in range(6):
            add(-width, 14.0 + 34 * i + float(rng.uniform(-8, 8)), -2.2, heavy=0.6)
        for i in range(2):
            add(0.0, 95.0 + 1.3 * change + 45 * i + float(rng.uniform(-5, 5)), -0.6)
            add(width, 105.0 + 50 * i, 0.1)
        far = int(self.duration * (speed + 27) / 85) + 4
        for i in range(far):
            lane = self._layout.oncoming[int(rng.integers(len(self._layout.oncoming)))]
            number = len(actors) + 1
            model = random_vehicle(rng, 0.0, lane, math.pi, heavy=0.25, number=number)
            actors.append(_Actor(model, 30 + 85.0 * i + float(rng.uniform(-25, 25)), -27.0 - speed, 0.0, 1.0, speed))
        return actors


class _Actor:
    """Another vehicle: it keeps its lane, and its distance to the ego vehicle changes smoothly."""

    def __init__(
        self, model: Vehicle, start: float, relative: float, wave: float, period: float, ego_speed: float
    ) -> None:
        self.model, self.start, self.relative, self.wave, self.period = model, start, relative, wave, period
        self.ego_speed = ego_speed

    def __call__(self, time: float) -> Vehicle | None:
        phase = 2 * math.pi * time / self.period
        s = self.start + self.relative * time + self.wave * math.sin(phase)
        rate = self.relative + self.wave * math.cos(phase) * 2 * math.pi / self.period
        if not -Course.BEHIND < s < FAR * 0.8:
            return None
        model = self.model
        braking = rate < -2.5 and model.yaw == 0.0
        return dataclasses.replace(model, s=s, braking=braking, speed=self.ego_speed + rate)


@functools.lru_cache(maxsize=64)
def _scenery(seed: int, chunk: int, layout: Layout) -> tuple[Item, ...]:
    items = random_scenery(np.random.default_rng((seed, 3, chunk)), layout, urban=False, start=0.0)
    return tuple(item for item in items if item.s < _CHUNK and (item.kind != "gantry" or chunk % 4 == 0))


def _find_light(rng: np.random.Generator, time: str, weather: str) -> Light:
    for _ in range(10_000):
        light = random_light(rng)
        if light.time == time and light.weather == weather:
            return light
    raise ConfigError(f"no such light: time {time!r}, weather {weather!r}")


def _find_layout(rng: np.random.Generator) -> Layout:
    while True:
        layout = random_layout(rng, "motorway")
        if len(layout.lanes) == 3 and abs(layout.lanes[1]) < 1e-9 and all(m.wear < 0.4 for m in layout.markings):
            # They stand for the whole drive: where they begin and end is told from the ego vehicle.
            barriers = tuple(dataclasses.replace(barrier, start=0.0, end=FAR) for barrier in layout.barriers)
            return dataclasses.replace(layout, barriers=barriers)
