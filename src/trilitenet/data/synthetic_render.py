"""Draws a synthetic world: ground by tracing every pixel to the flat road, sky and skyline by direction, everything else
far to near; then light, weather and the faults of a cheap camera. Exact masks come with the picture."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.data.synthetic_vehicles import Lamp, VehiclePose, draw_shadow, draw_vehicle
from trilitenet.data.synthetic_world import FAR, Barrier, Colour, Item, World
from trilitenet.processing.geometry import Camera

__all__ = ["FIRST_VEHICLE", "SCENERY", "Rendering", "render"]

Plane = NDArray[np.float32]

SCENERY: Final = 1
"""Mark of scenery in the map of objects; 0 is ground or sky."""
FIRST_VEHICLE: Final = 2
"""Mark of the first vehicle."""
LINE_PIXELS: Final = 4.0
"""Width of a labelled line at 640 pixels of image width: the published masks' 8 pixels at 1280."""
LINE_REACH: Final = 120.0
"""Metres ahead that lines and drivable area are labelled to in clear air."""
_TILE: Final = 512


@dataclasses.dataclass(frozen=True, eq=False)
class Rendering:
    """A drawn world.

    Attributes:
        image: (H, W, 3) uint8 RGB.
        drivable: (H, W) uint8 {0, 1}: own carriageway that nothing hides.
        lines: (H, W) uint8 {0, 1}: lane lines as annotators draw them (see `LINE_PIXELS`), through gaps of dashes, and
            kerbs.
        paint: (H, W) uint8 {0, 1}: pixels mostly covered by paint.
        ids: (H, W) uint8: 0 ground or sky, `SCENERY`, or `FIRST_VEHICLE` + index into ``poses``.
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


@functools.lru_cache(maxsize=32)
def _noise(slope: float, seed: int) -> Plane:
    """Return a seamless (512, 512) tile of noise with a power-law spectrum: mean 0, deviation 1."""
    rng = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(_TILE)[:, None], np.fft.rfftfreq(_TILE)[None]
    radius = np.hypot(fy, fx)
    radius[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.normal(size=(_TILE, _TILE))) * radius ** (-slope / 2)
    spectrum[0, 0] = 0.0
    tile = np.fft.irfft2(spectrum, s=(_TILE, _TILE))
    return np.ascontiguousarray(tile / tile.std(), np.float32)


def _look_up(tile: Plane, x: Plane, y: Plane, *, smooth: bool = True) -> Plane:
    """Return the tile's values at (x, y) in texels, repeated endlessly."""
    period = np.float32(_TILE)
    x, y = x - period * np.floor(x / period), y - period * np.floor(y / period)
    how = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
    return np.asarray(cv2.remap(tile, x, y, how, borderMode=cv2.BORDER_WRAP), np.float32)


@functools.lru_cache(maxsize=1)
def _ground_tile() -> Plane:
    """Return a (512, 512, 4) tile: blotches of asphalt, grass, wear of paint, cracks."""
    return np.ascontiguousarray(np.stack([_noise(2.4, 12), _noise(1.5, 13), _noise(1.8, 15), _noise(2.6, 14)], axis=2))


@functools.lru_cache(maxsize=4)
def _rays(camera: Camera) -> tuple[Plane, Plane, Plane]:
    """Return each pixel's direction as three (H, W) planes: forward, left, up."""
    height, width = camera.size
    columns = camera.rotation @ np.linalg.inv(camera.matrix)
    u, v = np.arange(width, dtype=np.float64)[None], np.arange(height, dtype=np.float64)[:, None]
    forward, left, up = (columns[i, 0] * u + columns[i, 1] * v + columns[i, 2] for i in range(3))
    return forward.astype(np.float32), left.astype(np.float32), up.astype(np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class _Sight:
    """Where each pixel of the lower image rows meets the ground.

    Attributes:
        top: First image row.
        seen: (h, W) bool: below the horizon and nearer than `FAR`.
        x: Metres forward, at most `FAR`.
        y: Metres left.
        row: (h, W) int32 index into the course's grid.
    """

    top: int
    seen: NDArray[np.bool_]
    x: Plane
    y: Plane
    row: NDArray[np.int32]


@functools.lru_cache(maxsize=2)
def _sight(camera: Camera) -> _Sight:
    forward, left, up = _rays(camera)
    below = up < -1e-5
    rows = np.flatnonzero(below.any(axis=1))
    top = int(rows[0]) if len(rows) else camera.size[0] - 1
    down = np.minimum(up[top:], -1e-5)
    scale = np.float32(camera.height) / -down
    x = forward[top:] * scale
    seen = below[top:] & (x < FAR) & (x > 0)
    x = np.clip(x, 0, FAR)
    y = np.clip(left[top:] * scale, -400, 400)
    return _Sight(top, seen, x, y, (x * 4).astype(np.int32))


class _Lighting:
    """Light and haze at any place."""

    def __init__(self, world: World) -> None:
        self.light = world.light
        self.ambient = np.array(self.light.ambient, np.float32)
        self.haze_colour = np.array(self.light.horizon, np.float32)

    def tone(self, colour: Colour, x: float, y: float) -> tuple[float, float, float]:
        """Return the colour that a surface at (x, y) metres shows."""
        light = self.light
        beam = 0.0
        if light.headlights:
            spread = y / (1.6 + 0.22 * max(x, 0.0))
            beam = light.headlights * math.exp(-spread * spread) * math.exp(-max(x, 0.0) / 38.0) * 0.8
        clear = math.exp(-light.haze * max(x, 0.0))
        red, green, blue = (
            min(255.0, c * (a + beam)) * clear + h * (1 - clear)
            for c, a, h in zip(colour, light.ambient, light.horizon, strict=True)
        )
        return red, green, blue

    def lamp_tone(self, colour: Colour, x: float, y: float) -> tuple[float, float, float]:
        """As `tone`, for what shines by itself."""
        del y
        clear = math.exp(-self.light.haze * 0.5 * max(x, 0.0))
        red, green, blue = (c * clear + h * (1 - clear) for c, h in zip(colour, self.light.horizon, strict=True))
        return red, green, blue


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
    lighting = _Lighting(world)
    image = _draw_sky(world)
    ids = np.zeros((height, width), np.uint8)
    drivable, lines, paint = _draw_ground(world, image)
    poses, lit, lamps = _draw_objects(world, image, ids, lighting)
    if world.light.wet:
        _draw_reflections(world, image, ids)
    if lamps:
        _draw_glare(image, lamps, world.light.time == "night", world.light.haze)
    if world.bonnet:
        _draw_bonnet(world, image, ids)
    clear = (ids == 0).astype(np.uint8)
    for mask in (drivable, lines, paint):
        mask *= clear
    if world.light.weather == "rain":
        _draw_rain(image, moment or rng)
    if faults:
        image = _camera_faults(image, world, rng, moment)
    return Rendering(image, drivable, lines, paint, ids, poses, lit)


def _draw_sky(world: World) -> NDArray[np.uint8]:
    light, camera = world.light, world.camera
    height, width = camera.size
    forward, left, up = _rays(camera)
    limit = int(np.clip(np.nanmax(camera.horizon([0, width - 1])) + 3, 1, height))
    f, l, u = forward[:limit], left[:limit], up[:limit]
    elevation = np.maximum(u / f, 0.0)
    share = np.minimum(1.0, elevation * 2.4) ** 0.7
    planes = [np.float32(h) + share * np.float32(z - h) for z, h in zip(light.zenith, light.horizon, strict=True)]
    if light.clouds > 0 and light.time != "night":
        depth = 60.0 / (elevation + 0.06)
        cos, sin = math.cos(world.bearing), math.sin(world.bearing)
        cx = depth * (cos - sin * l / f) + world.texture % 997
        cy = depth * (sin + cos * l / f) + world.texture % 877
        cloud = _look_up(_noise(2.6, 1), cx * 0.7, cy * 0.7)
        cover = np.clip(cloud * 0.55 + (light.clouds - 0.45) * 1.8, 0, 1) * np.minimum(1.0, elevation * 7 + 0.15)
        if light.clouds >= 1.0:
            cover = np.clip(cloud * 0.3 + 0.35, 0, 0.7) * np.minimum(1.0, elevation * 5)
        bright = (235.0, 238.0, 242.0) if light.weather == "clear" else (205.0, 207.0, 210.0)
        level = 1.0 if light.time == "day" else 0.55
        planes = [p + cover * (np.float32(b * level) - p) for p, b in zip(planes, bright, strict=True)]
    if light.sun and abs(light.azimuth) < 0.9:
        glow = np.exp(-((l / f - math.tan(light.azimuth)) ** 2 + (elevation - 0.38) ** 2) * 18)
        planes = [p + glow * (255 - p) for p in planes]
    azimuth = (np.arctan2(l[-1], f[-1]) + world.bearing + world.texture % 100).astype(np.float32)
    lighting = _Lighting(world)
    for layer, (tall, far) in enumerate(zip(world.skyline, (900.0, 230.0), strict=True)):
        if tall <= 0.004:
            continue
        houses = world.urban and layer == 1
        if houses:
            block = (azimuth * 17).astype(np.int32)
            line = tall * (0.45 + 0.55 * np.abs(np.sin(block * 12.9898 + world.texture % 17)))
            colour: Colour = (120.0, 114.0, 108.0)
        else:
            slope, scale = (3.2, 60.0) if layer == 0 else (1.9, 230.0 if world.texture % 2 else 110.0)
            wave = _look_up(_noise(slope, 2 + layer), azimuth[None] * scale, azimuth[None] * 3 + layer * 99)[0]
            line = tall * (0.62 + 0.22 * wave)
            colour = (84.0, 98.0, 92.0) if layer == 0 else (52.0, 64.0, 38.0)
        shade = lighting.tone(colour, far if light.weather != "fog" else far * 0.6, 200.0)
        cover = np.clip((line.astype(np.float32)[None] - u / f) * np.float32(camera.fy) + 0.5, 0, 1)
        if layer == 1:
            grain = _look_up(_noise(1.0, 5), np.broadcast_to(azimuth[None] * 350, u.shape), u / f * 350)
            depth = np.float32((0.12 if houses else 0.28) * math.exp(-light.haze * 230))
            bumps = depth * np.clip(grain, -1.5, 1.5)
            planes = [
                p + cover * (np.float32(c) + bumps * np.float32(b * a) - p)
                for p, c, b, a in zip(planes, shade, colour, light.ambient, strict=True)
            ]
        else:
            planes = [p + cover * (np.float32(c) - p) for p, c in zip(planes, shade, strict=True)]
    image = np.empty((height, width, 3), np.uint8)
    image[:] = np.clip(lighting.tone(world.layout.terrain, FAR, 50.0), 0, 255)
    image[:limit] = np.clip(cv2.merge(planes), 0, 255)
    return image


def _draw_ground(
    world: World, image: NDArray[np.uint8]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]:
    """Draw the ground into the image; return the masks drivable, lines and paint."""
    camera, course, layout, light = world.camera, world.course, world.layout, world.light
    sight = _sight(camera)
    x, y, row = sight.x, sight.y, sight.row
    tan = np.tan(course.grid_angle).astype(np.float32)
    cos = np.cos(course.grid_angle).astype(np.float32)
    sin = np.sin(course.grid_angle).astype(np.float32)
    aside = y - course.grid_y.astype(np.float32)[row]
    d = aside * cos[row]
    s = course.grid_s.astype(np.float32)[row] + aside * sin[row]
    # Metres of d that a pixel covers: the gradient of d over the image (level camera).
    slant = (x * tan[row] - aside - course.grid_y.astype(np.float32)[row]) / np.float32(camera.height)
    foot = cos[row] * x / np.float32(camera.fx) * np.sqrt(1 + slant * slant) + np.float32(1e-3)
    inverse = 1 / foot
    length = x * x / np.float32(camera.fx * camera.height) + np.float32(1e-3)
    along = s + np.float32(world.travelled)

    def above(limit: float) -> Plane:
        return np.clip((d - np.float32(limit)) * inverse + np.float32(0.5), 0, 1)

    def band(low: float, high: float) -> Plane:
        return np.clip(above(low) - above(high), 0, 1)

    shift = float(world.texture % 499)
    fine = _look_up(_noise(0.7, 11), along * 40 + shift, d * 40, smooth=False)
    coarse, grass, worn, crack = cv2.split(_look_up(_ground_tile(), along * 7 + shift, d * 14 + shift))
    fade = np.clip(np.float32(0.05) * inverse, 0, 1)
    planes = [np.float32(c) * (1 + np.float32(0.11) * grass + np.float32(0.12) * fine * fade) for c in layout.terrain]

    def blend(alpha: Plane, colour: Colour, gain: Plane | None = None) -> None:
        for plane, value in zip(planes, colour, strict=True):
            plane += alpha * ((np.float32(value) if gain is None else np.float32(value) * gain) - plane)

    rough = np.float32(layout.rough)
    right, left = layout.paved
    wide = layout.pavement or 1.6
    blend(band(right - wide, left + wide), layout.verge, 1 + np.float32(0.07) * grass + np.float32(0.08) * fine * fade)
    # Asphalt: grain, patches, tracks polished by tyres, oil in between.
    lane = np.float32(layout.lane_width)
    track = np.cos((d / lane) * np.float32(4 * math.pi) + np.float32(math.pi))
    grain = 1 + rough * (np.float32(0.045) * coarse + np.float32(0.06) * fine * fade + np.float32(0.02) * track)
    surface = tuple(c * (1 - 0.35 * light.wet) for c in layout.asphalt)
    asphalt: Colour = (surface[0], surface[1], surface[2])
    if layout.opposite is not None:
        blend(band(*layout.opposite), asphalt, grain)
    blend(band(right, left), asphalt, grain)
    for edge in (right, left):
        # Dirt gathers where the asphalt ends.
        blend(np.exp(-np.abs(d - np.float32(edge)) * 3) * np.float32(0.3), (78.0, 72.0, 62.0))
    seam = np.float32(layout.drivable[0] - 0.35)
    blend(band(seam - 0.03, seam + 0.03) * np.float32(0.5), (38.0, 38.0, 40.0))
    if world.texture % 3 == 0:
        blend((np.abs(crack) < np.float32(0.018)) * fade * np.float32(0.4), (34.0, 33.0, 33.0))
    if world.texture % 5 == 0:
        period = np.abs(along % np.float32(17.0) - 8)
        patch = (period < 2.2) & (np.abs(d - np.float32((world.texture % 7) - 3)) < 0.9)
        blend(patch.astype(np.float32) * np.float32(0.6), (52.0, 52.0, 54.0), grain)
    for kerb in layout.kerbs:
        blend(band(kerb - 0.09, kerb + 0.09), (168.0, 165.0, 158.0))
        gutter = kerb - 0.2 if kerb > 0 else kerb + 0.2
        blend(band(gutter - 0.1, gutter + 0.1) * np.float32(0.35), (60.0, 59.0, 58.0))

    reach = x < np.float32(min(LINE_REACH, 2.2 / light.haze))
    lines = np.zeros(x.shape, bool)
    paint = np.zeros(x.shape, np.float32)
    half_line = foot * np.float32(LINE_PIXELS / 2 * camera.size[1] / 640)
    for kerb in layout.kerbs:
        lines |= np.abs(d - np.float32(kerb)) < half_line
    worn = np.clip(worn * np.float32(0.5) + np.float32(0.5), 0, 1)
    for mark in layout.markings:
        cover = np.minimum(band(mark.d - mark.width / 2, mark.d + mark.width / 2), 1)
        if mark.dash:
            period = mark.dash + mark.gap
            phase = np.remainder(along, np.float32(period))
            soft = np.maximum(length, np.float32(0.03))
            begins = np.clip(phase / soft + np.float32(0.5), 0, 1)
            ends = np.clip((np.float32(mark.dash) - phase) / soft + np.float32(0.5), 0, 1)
            dashes = np.maximum(np.minimum(begins, ends), np.clip((phase - np.float32(period)) / soft + 0.5, 0, 1))
            blur = np.clip(soft / np.float32(period) - np.float32(0.3), 0, 1)
            cover = cover * (dashes + blur * (np.float32(mark.dash / period) - dashes))
        strength = 1 - np.float32(mark.wear) * np.clip(worn * np.float32(1.6) - np.float32(0.2), 0, 1)
        colour: Colour = (232.0, 232.0, 228.0) if mark.colour == "white" else (226.0, 176.0, 52.0)
        blend(cover * strength * np.float32(0.95), colour)
        paint = np.maximum(paint, cover)
        lines |= np.abs(d - np.float32(mark.d)) < half_line
    if world.texture % 4 == 0 and layout.markings:
        _draw_arrow(world, along, d, foot, blend)

    _light_ground(world, planes, x, y, along, d)
    clear = np.exp(-np.float32(light.haze) * x)
    block = image[sight.top :]
    merged = cv2.merge([
        np.float32(h) + (np.minimum(p, 255) - np.float32(h)) * clear for p, h in zip(planes, light.horizon, strict=True)
    ])  # fmt: skip
    np.copyto(block, np.clip(merged, 0, 255).astype(np.uint8), where=sight.seen[..., None])
    masks = []
    inside = (d > np.float32(layout.drivable[0])) & (d < np.float32(layout.drivable[1]))
    for mask in (inside & reach & sight.seen, lines & reach & sight.seen, (paint > 0.5) & sight.seen):
        full = np.zeros(camera.size, np.uint8)
        full[sight.top :] = mask
        masks.append(full)
    return masks[0], masks[1], masks[2]


def _draw_arrow(world: World, along: Plane, d: Plane, foot: Plane, blend: object) -> None:
    """Paint an arrow in a lane: paint that is no line."""
    assert callable(blend)
    lane = world.layout.lanes[world.texture % len(world.layout.lanes)]
    where = np.remainder(along, np.float32(60.0)) - np.float32(20.0)
    aside = np.abs(d - np.float32(lane))
    shaft = (where > 0) & (where < 3) & (aside < 0.09)
    head = (where >= 3) & (where < 4.6) & (aside < (np.float32(4.6) - where) * np.float32(0.28))
    blend((shaft | head).astype(np.float32) * np.clip(np.float32(0.2) / foot, 0, 0.85), (225.0, 225.0, 220.0))


def _light_ground(world: World, planes: list[Plane], x: Plane, y: Plane, along: Plane, d: Plane) -> None:
    light = world.light
    gain = np.ones(x.shape, np.float32)
    if light.sun:
        # Shadows of trees and houses reach onto the road from the sun's side, in clumps.
        seed = world.texture
        side = math.copysign(1.0, math.sin(light.azimuth))
        reach = np.float32(((seed >> 3) % 9) - 3.0)
        clump = np.float32(1.4) * _look_up(_noise(1.9, 16), along * 2.6 + seed % 333, d * 1.9)
        depth = (np.float32(side) * d - reach) * np.float32(0.25)
        shadow = np.clip((clump + np.clip(depth, -3, 1.0)) * np.float32(2.5), 0, 1)
        if seed % 7 < 4:
            gain -= shadow * np.float32(light.sun * 0.95)
        gain += np.float32(light.sun * 0.25)
    beam = np.float32(0.0)
    lamps = np.float32(0.0)
    if light.headlights:
        spread = y / (np.float32(1.6) + np.float32(0.2) * x)
        pool = np.exp(-spread * spread - x / np.float32(17.0)) * np.clip(x / np.float32(5.0), 0.25, 1)
        beam = pool * np.float32(light.headlights)
    if light.time == "night" and world.layout.pavement:
        lamps = np.float32(0.16) * np.exp(-((np.remainder(along, np.float32(30.0)) - 15) ** 2) / np.float32(60.0))
    warm = (1.05, 1.0, 0.86)
    for plane, ambient, tint in zip(planes, light.ambient, warm, strict=True):
        plane *= np.float32(ambient) * gain + np.float32(tint) * beam + np.float32(tint) * lamps


def _draw_objects(
    world: World, image: NDArray[np.uint8], ids: NDArray[np.uint8], lighting: _Lighting
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
        if 2.0 < x < FAR * 0.9:
            things.append((zone(vehicle.d), x, VehiclePose(vehicle, x, y, angle + vehicle.yaw)))
    for item in world.items:
        x, y, _ = course.at(item.s, item.d)
        if 2.5 < x < FAR * 0.9:
            things.append((zone(item.d), x, item))
    for barrier in fences:
        things.append((zone(barrier.d) + 1, -1.0, barrier))
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
                image, ids, number, world.camera, thing, lighting.tone, sun=sun, lamps=light.lamps, sky=sky
            )
            poses.append(thing)
            bright = min(1.0, (lighting.tone((255.0, 255.0, 255.0), x, thing.y)[0] + 60 * light.lamps) / 90.0)
            lit.append(math.exp(-light.haze * x) * bright)
        elif isinstance(thing, Barrier):
            _draw_barrier(world, thing, image, ids, lighting)
        else:
            _draw_item(world, thing, image, ids, lighting, lamps)
    return tuple(poses), tuple(lit), lamps


_SHIFT: Final = 4


def _fixed(points: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.round(np.clip(points, -30000, 30000) * (1 << _SHIFT)).astype(np.int32)


def _fill(image: NDArray[np.uint8], ids: NDArray[np.uint8], pixels: NDArray[np.float64], colour: Colour) -> None:
    if np.isnan(pixels).any():
        return
    fixed = _fixed(pixels)
    cv2.fillPoly(image, [fixed], colour, cv2.LINE_AA, _SHIFT)
    cv2.fillPoly(ids, [fixed], SCENERY, cv2.LINE_8, _SHIFT)


def _draw_barrier(
    world: World, barrier: Barrier, image: NDArray[np.uint8], ids: NDArray[np.uint8], lighting: _Lighting
) -> None:
    course = world.course
    s = np.concatenate([np.arange(2.0, 40, 2.0), np.arange(40.0, FAR * 0.8, 8.0)]) - world.travelled % 8
    s = s[(s >= barrier.start) & (s <= barrier.end)]
    if len(s) < 2:
        return
    angle = np.interp(s, course.s, course.angle)
    x = np.interp(s, course.s, course.x) - barrier.d * np.sin(angle)
    y = np.interp(s, course.s, course.y) + barrier.d * np.cos(angle)
    keep = x > 1.2
    x, y, s = x[keep], y[keep], s[keep]
    if len(x) < 2:
        return
    if barrier.kind == "rail":
        post = np.arange(math.ceil((s[0] + world.travelled) / 4) * 4 - world.travelled, min(s[-1], 80.0), 4.0)
        for at in post[::-1]:
            px, py, _ = course.at(float(at), barrier.d)
            if px > 2:
                ends = np.array([[px, py, 0.0], [px, py, barrier.height]])
                (u0, v0), (u1, v1) = world.camera.to_pixels(ends)
                half = max(0.3, world.camera.fx * 0.05 / px)
                box = np.array([[u0 - half, v0], [u0 + half, v0], [u1 + half, v1], [u1 - half, v1]])
                _fill(image, ids, box, lighting.tone((96.0, 98.0, 100.0), px, py))
        strips = ((0.42, 0.75, 1.0), (0.54, 0.60, 0.62))
    elif barrier.kind == "concrete":
        strips = ((0.0, 1.0, 0.85), (0.0, 0.3, 0.7))
    else:
        strips = ((0.0, 1.0, 0.9),)
    height = barrier.height
    step = 3
    for i in range(len(x) - 1 - (len(x) - 2) % step, -1, -step):
        j = min(i + step, len(x) - 1)
        if j == i:
            continue
        span = slice(i, j + 1)
        grain = 1 + (0.08 if barrier.kind == "hedge" else 0.03) * math.sin((s[i] + world.travelled) * 1.7)
        for low, high, gain in strips:
            base = low * height if barrier.kind != "rail" else low
            peak = high * height if barrier.kind != "rail" else high
            lower = np.stack([x[span], y[span], np.full(j + 1 - i, base)], axis=1)
            upper = np.stack([x[span], y[span], np.full(j + 1 - i, peak)], axis=1)
            pixels = world.camera.to_pixels(np.concatenate([lower, upper[::-1]]))
            red, green, blue = barrier.colour
            shade = lighting.tone(
                (red * gain * grain, green * gain * grain, blue * gain * grain), float(x[i]), float(y[i])
            )
            _fill(image, ids, pixels, shade)


def _draw_item(
    world: World, item: Item, image: NDArray[np.uint8], ids: NDArray[np.uint8], lighting: _Lighting, lamps: list[Lamp]
) -> None:
    camera = world.camera
    x, y, angle = world.course.at(item.s, item.d)
    scale = camera.fx / x
    if item.kind in ("tree", "bush"):
        foot = camera.to_pixels(np.array([[x, y, 0.0], [x, y, item.height]]))
        sprite = _tree(item.style % 20) if item.kind == "tree" else _bush(item.style % 8)
        _paste(image, ids, sprite, foot, item.width * scale, lighting, x, y)
    elif item.kind == "building":
        _draw_building(world, item, image, ids, lighting)
    elif item.kind == "lamp":
        tone = lighting.tone((88.0, 90.0, 92.0), x, y)
        half = 0.07
        ends = np.array(
            [[x, y - half, 0], [x, y + half, 0], [x, y + half * 0.7, item.height], [x, y - half * 0.7, item.height]]
        )
        _fill(image, ids, camera.to_pixels(ends), tone)
        arm = np.array([[x, y, item.height], [x, y + item.width, item.height + 0.2],
                        [x, y + item.width, item.height + 0.08], [x, y, item.height - 0.1]])  # fmt: skip
        pixels = camera.to_pixels(arm)
        _fill(image, ids, pixels, tone)
        if world.light.time != "day":
            u, v = pixels[1:3].mean(axis=0)
            lamps.append(Lamp(float(u), float(v), max(0.6, scale * 0.15), (255.0, 214.0, 150.0), 0.8))
    elif item.kind == "post":
        box = np.array([[x, y - 0.06, 0], [x, y + 0.06, 0], [x, y + 0.06, item.height], [x, y - 0.06, item.height]])
        _fill(image, ids, camera.to_pixels(box), lighting.tone((225.0, 225.0, 222.0), x, y))
        box[:, 2] = (item.height * 0.7, item.height * 0.7, item.height * 0.85, item.height * 0.85)
        _fill(image, ids, camera.to_pixels(box), lighting.tone((40.0, 40.0, 42.0), x, y))
    elif item.kind == "sign":
        _draw_sign(camera, item, x, y, image, ids, lighting)
    elif item.kind == "gantry":
        right, left = world.layout.paved
        grey = lighting.tone((120.0, 122.0, 125.0), x, y)
        for edge in (right - 0.8, left + 0.8):
            px, py, _ = world.course.at(item.s, edge)
            pole = np.array([[px, py - 0.2, 0], [px, py + 0.2, 0], [px, py + 0.2, 6.6], [px, py - 0.2, 6.6]])
            _fill(image, ids, camera.to_pixels(pole), grey)
        beam = np.array(
            [
                (*world.course.at(item.s, e)[:2], z)
                for e, z in ((right - 1, 6.4), (left + 1, 6.4), (left + 1, 6.8), (right - 1, 6.8))
            ]
        )
        _fill(image, ids, camera.to_pixels(beam), grey)
        for lane in world.layout.lanes[:3]:
            board = np.array(
                [
                    (*world.course.at(item.s, lane + e)[:2], z)
                    for e, z in ((-1.5, 5.5), (1.5, 5.5), (1.5, 7.4), (-1.5, 7.4))
                ]
            )
            blue: Colour = (18.0, 62.0, 140.0) if item.style % 2 else (12.0, 96.0, 62.0)
            _fill(
                image,
                ids,
                camera.to_pixels(board),
                lighting.lamp_tone(tuple(c * max(0.35, world.light.ambient[1]) for c in blue), x, y),
            )  # type: ignore[arg-type]
    elif item.kind == "pedestrian":
        rng = np.random.default_rng(item.style)
        coat, legs = rng.uniform(20, 190, 3), rng.uniform(20, 90, 3)
        tall = item.height
        for low, high, wide, colour in (
            (0.0, 0.5, 0.15, legs),
            (0.45, 0.84, 0.23, coat),
            (0.85, 1.0, 0.1, (190, 150, 125)),
        ):
            turn = np.linspace(0, 2 * math.pi, 10, endpoint=False)
            ring = np.stack([np.full(10, x), y + wide * np.cos(turn),
                             tall * ((low + high) / 2 + (high - low) / 2 * np.sin(turn))], axis=1)  # fmt: skip
            red, green, blue = (float(c) for c in colour)
            _fill(image, ids, camera.to_pixels(ring), lighting.tone((red, green, blue), x, y))
    del angle


def _draw_sign(
    camera: Camera,
    item: Item,
    x: float,
    y: float,
    image: NDArray[np.uint8],
    ids: NDArray[np.uint8],
    lighting: _Lighting,
) -> None:
    pole = np.array([[x, y - 0.04, 0], [x, y + 0.04, 0], [x, y + 0.04, item.height], [x, y - 0.04, item.height]])
    _fill(image, ids, camera.to_pixels(pole), lighting.tone((130.0, 132.0, 134.0), x, y))
    half, centre = item.width / 2, item.height
    style = item.style % 4
    if item.width > 1.2:
        board = np.array([[x, y - half, centre - half * 0.6], [x, y + half, centre - half * 0.6],
                          [x, y + half, centre + half * 0.6], [x, y - half, centre + half * 0.6]])  # fmt: skip
        tint: Colour = ((22, 66, 146), (14, 98, 62), (228, 228, 226), (225, 178, 40))[style]
        _fill(image, ids, camera.to_pixels(board), lighting.tone(tint, x, y))
        return
    corners = (20, 20, 3, 4)[style]
    turn = np.linspace(0, 2 * math.pi, corners, endpoint=False) + (math.pi / 2)
    for share, tint in ((1.0, (196.0, 28.0, 34.0)), (0.74, (236.0, 236.0, 234.0))):
        if style == 1 and share == 1.0:
            tint = (30.0, 80.0, 170.0)
        ring = np.stack(
            [np.full(corners, x), y + half * share * np.cos(turn), centre + half * share * np.sin(turn)], axis=1
        )
        _fill(image, ids, camera.to_pixels(ring), lighting.tone(tint, x, y))


@functools.lru_cache(maxsize=16)
def _facade(style: int) -> NDArray[np.uint8]:
    """Return an (160, 256, 3) uint8 picture of a house front."""
    rng = np.random.default_rng(900 + style)
    base = np.array(
        [(168, 150, 132), (188, 180, 168), (140, 92, 74), (120, 118, 116), (196, 186, 150), (96, 84, 78)][style % 6]
    )
    wall = np.clip(base + 6 * _noise(1.2, 18)[:160, :256, None], 0, 255).astype(np.uint8)
    floors, columns = int(rng.integers(3, 6)), int(rng.integers(5, 11))
    fh, fw = 160 / floors, 256 / columns
    for i in range(floors):
        for j in range(columns):
            wide, tall = fw * 0.5, fh * 0.55
            if i == floors - 1 and style % 3 == 0:
                wide, tall = fw * 0.86, fh * 0.7
            x0, y0 = int(j * fw + (fw - wide) / 2), int(i * fh + (fh - tall) / 2)
            x1, y1 = int(x0 + wide), int(y0 + tall)
            dark = int(rng.integers(30, 90))
            wall[max(0, y0 - 1) : y1 + 2, max(0, x0 - 1) : x1 + 1] = np.clip(base * 1.2, 0, 255)
            wall[y0:y1, x0:x1] = (dark, dark * 1.06, dark * 1.14)
    return wall


def _draw_building(
    world: World, item: Item, image: NDArray[np.uint8], ids: NDArray[np.uint8], lighting: _Lighting
) -> None:
    course, camera = world.course, world.camera
    side = math.copysign(1.0, item.d)
    start, end = max(item.s, 2.5), item.s + item.width
    if end - start < 2:
        return
    x0, y0, _ = course.at(start, item.d)
    x1, y1, _ = course.at(end, item.d)
    x2, y2, _ = course.at(start, item.d + side * 9)
    if min(x0, x1, x2) < 2.0:
        return
    height, width = image.shape[:2]
    for (ax, ay), (bx, by), gain in (((x0, y0), (x2, y2), 0.72), ((x0, y0), (x1, y1), 1.0)):
        corners = np.array([[ax, ay, item.height], [bx, by, item.height], [bx, by, 0.0], [ax, ay, 0.0]])
        pixels = camera.to_pixels(corners)
        left, right = max(0, int(pixels[:, 0].min()) - 1), min(width, int(pixels[:, 0].max()) + 2)
        top, bottom = max(0, int(pixels[:, 1].min()) - 1), min(height, int(pixels[:, 1].max()) + 2)
        if right - left < 2 or bottom - top < 2:
            continue
        texture = _facade(item.style % 16)
        th, tw = texture.shape[:2]
        matrix = cv2.getPerspectiveTransform(
            np.array([[0, 0], [tw, 0], [tw, th], [0, th]], np.float32), (pixels - (left, top)).astype(np.float32)
        )
        shade = [lighting.tone((255.0 * gain, 255.0 * gain, 255.0 * gain), px, py) for px, py in ((ax, ay), (bx, by))]
        level = np.mean(shade, axis=0) / 255
        warped = cv2.warpPerspective(texture, matrix, (right - left, bottom - top), flags=cv2.INTER_LINEAR)
        haze = 1 - math.exp(-world.light.haze * (ax + bx) / 2)
        fog = np.array(world.light.horizon) * haze
        lit = cv2.transform(warped, np.concatenate([np.diag((level * 255 - fog) / 255), fog[:, None]], axis=1))
        mask = np.zeros(warped.shape[:2], np.uint8)
        cv2.fillConvexPoly(mask, _fixed(pixels - (left, top)), 255, cv2.LINE_8, _SHIFT)
        cv2.copyTo(lit, mask, image[top:bottom, left:right])
        ids[top:bottom, left:right][mask > 0] = SCENERY


@functools.lru_cache(maxsize=32)
def _tree(style: int) -> NDArray[np.uint8]:
    """Return a (192, 144, 4) uint8 picture of a tree with transparency."""
    rng = np.random.default_rng(300 + style)
    sprite = np.zeros((192, 144, 4), np.uint8)
    bark = int(rng.integers(40, 75))
    cv2.rectangle(sprite, (68, 100), (76, 191), (bark, int(bark * 0.85), int(bark * 0.7), 255), -1)
    bare, conifer = style % 5 == 0, style % 5 == 1
    autumn = style % 7 == 3
    if bare:
        for _ in range(70):
            angle, long = rng.uniform(-1.2, 1.2), rng.uniform(30, 110)
            base = 130 - rng.uniform(0, 60)
            tip = (int(72 + long * math.sin(angle) * 0.6), int(base - long * math.cos(angle) * 0.8))
            cv2.line(
                sprite, (72, int(base)), tip, (bark, int(bark * 0.87), int(bark * 0.78), 255), int(rng.integers(1, 3))
            )
        return np.asarray(cv2.GaussianBlur(sprite, (3, 3), 0), np.uint8)
    count = 520
    # A crown is a handful of clumps; each clump is lit from above.
    clumps = [
        (72 + rng.normal(0, 24), rng.uniform(30, 112), rng.uniform(16, 34)) for _ in range(int(rng.integers(6, 12)))
    ]
    clumps.sort(key=lambda clump: -clump[1])
    leaf = (142, 96, 46) if autumn else (66 + 12 * (style % 3), 84, 44)
    for i in range(count):
        if conifer:
            v = 172 * (1 - i / count) ** 0.8 + 6
            u = 72 + rng.normal(0, 0.36) * (v - 2) * 0.34
            size, bright = int(rng.integers(3, 7)), rng.uniform(0.45, 0.95)
        else:
            cu, cv, radius = clumps[i * len(clumps) // count]
            angle, share = rng.uniform(0, 2 * math.pi), math.sqrt(rng.uniform(0, 1))
            u, v = cu + radius * share * math.cos(angle), cv + radius * 0.8 * share * math.sin(angle)
            size, bright = int(rng.integers(2, 6)), 0.72 - 0.42 * share * math.sin(angle) + rng.normal(0, 0.12)
        colour = tuple(int(np.clip(c * bright, 6, 255)) for c in leaf)
        cv2.circle(sprite, (int(u), int(v)), size, (*colour, 255), -1)
    return np.asarray(cv2.GaussianBlur(sprite, (3, 3), 0), np.uint8)


@functools.lru_cache(maxsize=8)
def _bush(style: int) -> NDArray[np.uint8]:
    rng = np.random.default_rng(500 + style)
    sprite = np.zeros((96, 144, 4), np.uint8)
    for i in range(260):
        u = rng.uniform(10, 134)
        top = 90 - 78 * math.sqrt(max(0.0, 1 - ((u - 72) / 66) ** 2)) * rng.uniform(0.75, 1)
        v = rng.uniform(top, 94)
        bright = (0.4 + 0.5 * i / 260) * rng.uniform(0.75, 1.1) * (1.15 - 0.5 * v / 96)
        colour = (int(66 * bright), int(86 * bright), int(42 * bright))
        cv2.circle(sprite, (int(u), int(v)), int(rng.integers(3, 8)), (*colour, 255), -1)
    return np.asarray(cv2.GaussianBlur(sprite, (3, 3), 0), np.uint8)


def _paste(
    image: NDArray[np.uint8],
    ids: NDArray[np.uint8],
    sprite: NDArray[np.uint8],
    foot: NDArray[np.float64],
    wide: float,
    lighting: _Lighting,
    x: float,
    y: float,
) -> None:
    """Blend a picture with transparency over the image; ``foot`` is (2, 2): pixels of its foot and of its top."""
    tall = foot[0, 1] - foot[1, 1]
    left, top = foot[0, 0] - wide / 2, foot[1, 1]
    height, width = image.shape[:2]
    x0, x1 = max(0, round(left)), min(width, round(left + wide))
    y0, y1 = max(0, round(top)), min(height, round(foot[0, 1]))
    if x1 - x0 < 1 or y1 - y0 < 1 or tall < 2:
        return
    sh, sw = sprite.shape[:2]
    # Cut the part of the picture that is in view before it is scaled.
    cx0, cx1 = int((x0 - left) / wide * sw), max(int(math.ceil((x1 - left) / wide * sw)), 1)
    cy0, cy1 = int((y0 - top) / tall * sh), max(int(math.ceil((y1 - top) / tall * sh)), 1)
    part = sprite[max(cy0, 0) : min(cy1, sh), max(cx0, 0) : min(cx1, sw)]
    if part.size == 0:
        return
    shrink = part.shape[1] > x1 - x0
    part = cv2.resize(part, (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA if shrink else cv2.INTER_LINEAR)
    white, black = lighting.tone((255.0, 255.0, 255.0), x, y), lighting.tone((0.0, 0.0, 0.0), x, y)
    colours = cv2.transform(
        part,
        np.array(
            [
                [(white[0] - black[0]) / 255, 0, 0, 0, black[0]],
                [0, (white[1] - black[1]) / 255, 0, 0, black[1]],
                [0, 0, (white[2] - black[2]) / 255, 0, black[2]],
            ]
        ),  # fmt: skip
    )
    alpha = part[..., 3]
    region = image[y0:y1, x0:x1]
    weight = alpha.astype(np.float32) / 255
    region[:] = np.asarray(
        cv2.blendLinear(np.ascontiguousarray(colours), np.ascontiguousarray(region), weight, 1 - weight)
    )
    ids[y0:y1, x0:x1][alpha > 127] = SCENERY


def _draw_reflections(world: World, image: NDArray[np.uint8], ids: NDArray[np.uint8]) -> None:
    """Mirror what is above the horizon in the wet road, smeared downwards."""
    camera = world.camera
    height, width = camera.size
    row = int(np.clip(camera.horizon([camera.cx])[0], 4, height - 5))
    rows = height - row
    mirrored = cv2.flip(image[:row], 0)
    small = cv2.resize(mirrored, (width // 2, max(2, row // 8)), interpolation=cv2.INTER_AREA)
    smeared = np.asarray(cv2.resize(small, (width, rows), interpolation=cv2.INTER_LINEAR), np.uint8)
    fade = np.linspace(0.55, 0.12, rows, dtype=np.float32)[:, None] * np.float32(world.light.wet)
    weight = np.ascontiguousarray(fade * (ids[row:] == 0))
    image[row:] = np.asarray(cv2.blendLinear(smeared, np.ascontiguousarray(image[row:]), weight, 1 - weight))


def _draw_glare(image: NDArray[np.uint8], lamps: list[Lamp], night: bool, haze: float) -> None:
    """Add the glow around lights."""
    height, width = image.shape[:2]
    shape = (height // 2, width // 2)
    glow = np.zeros((*shape, 3), np.float32)
    strong = 1.0 if night else 0.35
    for lamp in lamps:
        reach = min(width * 0.12, (lamp.radius * 5 + width * 0.008) * (0.6 + lamp.strength) * (1 + haze * 20)) / 2
        u, v = lamp.u / 2, lamp.v / 2
        x0, x1 = max(0, int(u - reach)), min(shape[1], int(u + reach) + 1)
        y0, y1 = max(0, int(v - reach)), min(shape[0], int(v + reach) + 1)
        if x1 <= x0 or y1 <= y0:
            continue
        dx = (np.arange(x0, x1, dtype=np.float32) - u) / reach
        dy = (np.arange(y0, y1, dtype=np.float32) - v) / reach
        radius = np.sqrt(dx[None] ** 2 + dy[:, None] ** 2)
        fall = np.clip(1 - radius, 0, 1) ** 3 * np.float32(strong * lamp.strength)
        core = np.clip(1.3 - radius * reach * 2 / max(lamp.radius, 0.7), 0, 1) * np.float32(0.9 * strong)
        patch = glow[y0:y1, x0:x1]
        for c in range(3):
            patch[..., c] += fall * np.float32(lamp.colour[c]) + core * np.float32(0.5 * lamp.colour[c] + 127)
    full = cv2.resize(glow, (width, height), interpolation=cv2.INTER_LINEAR)
    cv2.add(image, np.clip(full, 0, 255).astype(np.uint8), dst=image)


def _draw_bonnet(world: World, image: NDArray[np.uint8], ids: NDArray[np.uint8]) -> None:
    height, width = image.shape[:2]
    rng = np.random.default_rng(world.texture)
    u = np.linspace(-0.05, 1.05, 24)
    crest = height * (1 - world.bonnet * (1 - 0.55 * (2 * u - 1) ** 2))
    outline = np.concatenate(
        [np.stack([u * width, crest], axis=1), [[width * 1.05, height + 9], [-width * 0.05, height + 9]]]
    )
    paint = rng.uniform(12, 110)
    colour = tuple(float(paint * a * (1 + rng.normal(0, 0.05))) for a in world.light.ambient)
    _fill(image, ids, outline, (colour[0], colour[1], colour[2]))
    shine = outline[:24] + (0.0, height * 0.012)
    cv2.polylines(image, [_fixed(shine)], False, tuple(min(255.0, c * 1.5 + 12) for c in colour), max(1, height // 190),
                  cv2.LINE_AA, _SHIFT)  # fmt: skip


@functools.lru_cache(maxsize=2)
def _streaks() -> Plane:
    white = np.random.default_rng(77).random((_TILE, _TILE)).astype(np.float32)
    drops = (white > 0.9985).astype(np.float32)
    kernel = np.zeros((25, 25), np.float32)
    cv2.line(kernel, (9, 0), (15, 24), 1.0, 1)
    return np.asarray(cv2.filter2D(drops, -1, kernel / 9), np.float32)


def _draw_rain(image: NDArray[np.uint8], rng: np.random.Generator) -> None:
    """Add streaks of falling rain and drops on the windscreen."""
    height, width = image.shape[:2]
    streaks = np.roll(_streaks(), tuple(int(v) for v in rng.integers(0, _TILE, 2)), (0, 1))
    scale = max(1.0, width / 640)
    need = (math.ceil(height / scale / _TILE), math.ceil(width / scale / _TILE))
    tiled = np.tile(streaks, need)[: math.ceil(height / scale), : math.ceil(width / scale)]
    tiled = np.asarray(cv2.resize(tiled, (width, height)), np.float32)
    strength = (tiled * rng.uniform(25, 80)).astype(np.uint8)
    cv2.add(image, cv2.merge([strength] * 3), dst=image)
    for _ in range(int(rng.integers(0, 26))):
        u, v, r = int(rng.integers(width)), int(rng.integers(height)), max(2, int(rng.gamma(2.0, 2.0) * scale))
        x0, x1, y0, y1 = max(0, u - r), min(width, u + r + 1), max(0, v - r), min(height, v + r + 1)
        region = image[y0:y1, x0:x1]
        # A drop is a small lens: it shows the surroundings upside down and blurred.
        lens = cv2.blur(cv2.flip(region, 0), (5, 5))
        mask = np.zeros(region.shape[:2], np.uint8)
        cv2.circle(mask, (u - x0, v - y0), r, 255, -1, cv2.LINE_AA)
        weight = mask.astype(np.float32) / 255 * np.float32(0.75)
        region[:] = np.asarray(
            cv2.blendLinear(np.asarray(lens, np.uint8), np.ascontiguousarray(region), weight, 1 - weight)
        )


@functools.lru_cache(maxsize=1)
def _grain() -> NDArray[np.int8]:
    noise = np.random.default_rng(55).normal(0, 32, (1024, 1024, 3))
    noise = 0.7 * noise + 0.5 * noise.mean(axis=2, keepdims=True)
    return np.clip(noise, -127, 127).astype(np.int8)


def _camera_faults(
    image: NDArray[np.uint8], world: World, rng: np.random.Generator, moment: np.random.Generator | None
) -> NDArray[np.uint8]:
    """Blur, vignette, exposure, white balance, sensor noise and compression."""
    height, width = image.shape[:2]
    if rng.random() < 0.5:
        sigma = float(rng.uniform(0.3, 0.95)) * width / 640
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)
    elif rng.random() < 0.3:
        image = np.asarray(cv2.addWeighted(image, 1.5, cv2.blur(image, (3, 3)), -0.5, 0), np.uint8)
    night = world.light.time == "night"
    gamma = float(np.exp(rng.normal(-0.25 if night else 0.0, 0.16)))
    gain = np.exp(rng.normal(0.0, 0.1)) * np.exp(rng.normal(0.0, 0.035, 3))
    lift = float(rng.uniform(0, 12))
    ramp = np.arange(256) / 255
    table = np.clip(255 * gain[None] * ramp[:, None] ** gamma + lift * (1 - ramp[:, None]), 0, 255).astype(np.uint8)
    planes = [cv2.LUT(plane, np.ascontiguousarray(table[:, c])) for c, plane in enumerate(cv2.split(image))]
    image = np.asarray(cv2.merge(planes), np.uint8)
    if rng.random() < 0.4:
        u = np.linspace(-1, 1, width, dtype=np.float32)[None] ** 2
        v = np.linspace(-1, 1, height, dtype=np.float32)[:, None] ** 2
        fall = np.clip(255 * (1 - np.float32(rng.uniform(0.1, 0.4)) * (u + v) / 2), 0, 255).astype(np.uint8)
        image = np.asarray(cv2.multiply(image, cv2.merge([fall] * 3), scale=1 / 255), np.uint8)
    level = float(rng.gamma(2.0, 1.3)) * (2.2 if night else 1.0)
    grain = _grain()
    y, x = (int(v) for v in (moment or rng).integers(0, 1024, 2))
    rows = np.arange(y, y + height) & 1023
    picked = (
        grain[rows][:, np.arange(x, x + width) & 1023]
        if x + width > 1024 or width > 1024
        else grain[rows, x : x + width]
    )
    image = _add_noise(image, picked, level / 32)
    if moment is None and rng.random() < 0.6:
        quality = int(rng.integers(35, 92))
        _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
        image = np.asarray(cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB), np.uint8)
    return image


def _add_noise(image: NDArray[np.uint8], noise: NDArray[np.int8], gain: float) -> NDArray[np.uint8]:
    scaled = cv2.multiply(noise, (gain, gain, gain, gain), dtype=cv2.CV_16S)
    return np.asarray(cv2.add(image, scaled, dtype=cv2.CV_8U), np.uint8)
