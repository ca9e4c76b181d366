"""Draws a synthetic world, with exact masks.

The ground is traced pixel by pixel, sky and skyline are drawn by direction, everything else far to near; then come
light, weather and the faults of a cheap camera.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.data.synthetic_ground import draw_ground
from trilitenet.data.synthetic_optics import Plane, look_up, noise, rays
from trilitenet.data.synthetic_scenery import draw_barrier, draw_item
from trilitenet.data.synthetic_vehicles import Lamp, VehiclePose, draw_shadow, draw_vehicle
from trilitenet.data.synthetic_weather import add_camera_faults, draw_bonnet, draw_glare, draw_rain, draw_reflections
from trilitenet.data.synthetic_world import FAR, Barrier, Colour, Item, World

__all__ = ["FIRST_VEHICLE", "Rendering", "render"]

FIRST_VEHICLE: Final = 2
"""Mark of the first vehicle in the map of objects."""


@dataclasses.dataclass(frozen=True, eq=False)
class Rendering:
    """A drawn world.

    Attributes:
        image: (H, W, 3) uint8 RGB.
        drivable: (H, W) uint8 {0, 1}: own carriageway that nothing hides.
        lines: (H, W) uint8 {0, 1}: lane lines as annotators draw them: of constant width, through gaps, and kerbs.
        paint: (H, W) uint8 {0, 1}: pixels mostly covered by paint.
        ids: (H, W) uint8: 0 ground or sky, 1 scenery, or `FIRST_VEHICLE` + index into ``poses``.
        poses: The vehicles that were in view, far to near.
        lit: For each of them, how visible it is through haze and darkness, in [0, 1].
    """

    image: NDArray[np.uint8]
    drivable: NDArray[np.uint8]
    lines: NDArray[np.uint8]
    paint: NDArray[np.uint8]
    ids: NDArray[np.uint8]
    poses: tuple[VehiclePose, ...]
    lit: tuple[float, ...]


def render(
    world: World, rng: np.random.Generator, *, faults: bool = True, moment: np.random.Generator | None = None
) -> Rendering:
    """Draw a world.

    Args:
        world: What there is.
        rng: Source of chance for the camera's faults.
        faults: Add blur, noise, exposure and compression of a cheap camera.
        moment: Source of chance for what differs between frames of one drive (noise, rain), which is then not
            compressed here; ``rng`` if left out.
    """
    camera = world.camera
    height, width = camera.size
    image = _draw_sky(world)
    ids = np.zeros((height, width), np.uint8)
    drivable, lines, paint = draw_ground(world, image)
    poses, lit, lamps = _draw_objects(world, image, ids)
    if world.light.wet:
        draw_reflections(world, image, ids)
    if lamps:
        draw_glare(image, ids, lamps, world.light.time == "night", world.light.haze)
    if world.bonnet:
        draw_bonnet(world, image, ids)
    clear = (ids == 0).astype(np.uint8)
    for mask in (drivable, lines, paint):
        mask *= clear
    if world.light.weather == "rain":
        draw_rain(image, moment or rng)
    if faults:
        image = add_camera_faults(image, world, rng, moment)
    return Rendering(image, drivable, lines, paint, ids, poses, lit)


def _draw_sky(world: World) -> NDArray[np.uint8]:
    """Return the picture with sky and skyline, and with the farthest ground below."""
    camera = world.camera
    height, width = camera.size
    forward, left, up = rays(camera)
    limit = int(np.clip(camera.horizon([0, width - 1]).max() + 3, 2, height))
    image = np.empty((height, width, 3), np.uint8)
    image[:] = np.clip(world.light.tone(world.layout.terrain, FAR, 50.0), 0, 255)
    # The air varies slowly: every second row and column is enough.
    air = _draw_air(world, *(plane[:limit:2, ::2] for plane in (forward, left, up)))
    image[:limit] = cv2.resize(air, (width, limit), interpolation=cv2.INTER_LINEAR)
    slope = up[:limit] / forward[:limit]
    reached = np.flatnonzero(slope.min(axis=1) < 1.7 * max(world.skyline))
    if len(reached):
        top = int(reached[0])
        azimuth = np.arctan2(left[limit - 1], forward[limit - 1]) + world.bearing + world.texture % 100
        _draw_skyline(world, image[top:limit], slope[top:], azimuth.astype(np.float32))
    return image


def _draw_air(world: World, forward: Plane, left: Plane, up: Plane) -> NDArray[np.uint8]:
    """Return sky, clouds and the glow around the sun, for pixels that look in these directions."""
    light = world.light
    aside, elevation = left / forward, np.maximum(up / forward, 0.0)
    share = np.minimum(1.0, elevation * 2.4) ** 0.7
    planes = [np.float32(h) + share * np.float32(z - h) for z, h in zip(light.zenith, light.horizon, strict=True)]
    if light.clouds > 0 and light.time != "night":
        depth = 60.0 / (elevation + 0.06)
        cos, sin = math.cos(world.bearing), math.sin(world.bearing)
        cx = depth * (cos - sin * aside) + world.texture % 997
        cy = depth * (sin + cos * aside) + world.texture % 877
        cloud = look_up(noise(2.6, 1), cx * 0.7, cy * 0.7)
        cover = np.clip(cloud * 0.55 + (light.clouds - 0.45) * 1.8, 0, 1) * np.minimum(1.0, elevation * 7 + 0.15)
        if light.clouds >= 1.0:
            cover = np.clip(cloud * 0.3 + 0.35, 0, 0.7) * np.minimum(1.0, elevation * 5)
        bright = (235.0, 238.0, 242.0) if light.weather == "clear" else (205.0, 207.0, 210.0)
        level = 1.0 if light.time == "day" else 0.55
        planes = [p + cover * (np.float32(b * level) - p) for p, b in zip(planes, bright, strict=True)]
    if light.sun and abs(light.azimuth) < 0.9:
        glow = np.exp(-((aside - math.tan(light.azimuth)) ** 2 + (elevation - 0.38) ** 2) * 18)
        planes = [p + glow * (255 - p) for p in planes]
    air: NDArray[np.uint8] = np.clip(cv2.merge(planes), 0, 255).astype(np.uint8)
    return air


def _draw_skyline(world: World, image: NDArray[np.uint8], slope: Plane, azimuth: Plane) -> None:
    """Draw hills, then trees or houses, into the rows above the horizon.

    Args:
        world: What there is.
        image: (h, W, 3) uint8, changed in place.
        slope: (h, W) tangent of each pixel's elevation.
        azimuth: (W,) direction of each column in radians.
    """
    light = world.light
    planes = [plane.astype(np.float32) for plane in cv2.split(image)]
    for layer, (tall, far) in enumerate(zip(world.skyline, (900.0, 230.0), strict=True)):
        if tall <= 0.004:
            continue
        houses = world.urban and layer == 1
        if houses:
            block = (azimuth * 17).astype(np.int32)
            line = tall * (0.45 + 0.55 * np.abs(np.sin(block * 12.9898 + world.texture % 17)))
            colour: Colour = (120.0, 114.0, 108.0)
        else:
            roughness, scale = (3.2, 60.0) if layer == 0 else (1.9, 230.0 if world.texture % 2 else 110.0)
            wave = look_up(noise(roughness, 2 + layer), azimuth[None] * scale, azimuth[None] * 3 + layer * 99)[0]
            line = tall * (0.62 + 0.22 * wave)
            colour = (84.0, 98.0, 92.0) if layer == 0 else (52.0, 64.0, 38.0)
        shade = light.tone(colour, far if light.weather != "fog" else far * 0.6, 200.0)
        cover = np.clip((line.astype(np.float32)[None] - slope) * np.float32(world.camera.fy) + np.float32(0.5), 0, 1)
        bumps = np.float32(0.0)
        if layer == 1:
            grain = look_up(noise(1.0, 5), np.broadcast_to(azimuth[None] * 350, slope.shape), slope * 350)
            depth = np.float32((0.12 if houses else 0.28) * math.exp(-light.haze * 230))
            bumps = depth * np.clip(grain, -1.5, 1.5)
        for plane, target, base, ambient in zip(planes, shade, colour, light.ambient, strict=True):
            plane += cover * (np.float32(target) + bumps * np.float32(base * ambient) - plane)
    image[:] = np.clip(cv2.merge(planes), 0, 255)


def _draw_objects(
    world: World, image: NDArray[np.uint8], ids: NDArray[np.uint8]
) -> tuple[tuple[VehiclePose, ...], tuple[float, ...], list[Lamp]]:
    """Draw everything that stands on the ground, far to near; barriers after what is beyond them."""
    light, course = world.light, world.course
    fences = sorted(world.layout.barriers, key=lambda barrier: -abs(barrier.d))

    def zone(d: float) -> int:
        """Return how many barriers stand between the ego vehicle and d."""
        return sum(1 for b in fences if b.d * d > 0 and abs(d) > abs(b.d))

    things: list[tuple[int, float, Item | VehiclePose | Barrier]] = []
    for vehicle in world.vehicles:
        x, y, angle = course.at(vehicle.s, vehicle.d)
        pose = VehiclePose(vehicle, x, y, angle + vehicle.yaw)
        if x < FAR * 0.9 and pose.ground_box[:, 0].max() > 0.0:
            things.append((zone(vehicle.d), x, pose))
    for item in world.items:
        x, y, _ = course.at(item.s, item.d)
        if 2.5 < x < FAR * 0.9:
            things.append((zone(item.d), x, item))
    for barrier in fences:
        things.append((zone(barrier.d) + 1, -math.inf, barrier))
    things.sort(key=lambda thing: (-thing[0], -thing[1]))
    sun = (
        light.sun * 0.8 * math.cos(light.azimuth),
        light.sun * 0.8 * math.sin(light.azimuth),
        light.sun * 0.6,
    )
    sky = sum(light.zenith) / 765 * sum(light.ambient) / 3
    poses: list[VehiclePose] = []
    lit: list[float] = []
    lamps: list[Lamp] = []
    for _, x, thing in things:
        if isinstance(thing, VehiclePose):
            if len(poses) >= 250:
                continue
            number = FIRST_VEHICLE + len(poses)
            draw_shadow(image, world.camera, thing, 0.75 if light.time != "night" else 0.5)
            lamps += draw_vehicle(
                image, ids, number, world.camera, thing, light.tone, sun=sun, lamps=light.lamps, sky=sky
            )
            poses.append(thing)
            bright = min(1.0, (light.tone((255.0, 255.0, 255.0), x, thing.y)[0] + 60 * light.lamps) / 90.0)
            lit.append(math.exp(-light.haze * max(x, 0.0)) * bright)
        elif isinstance(thing, Barrier):
            draw_barrier(world, thing, image, ids)
        else:
            draw_item(world, thing, image, ids, lamps)
    return tuple(poses), tuple(lit), lamps
