"""The ground of a synthetic scene, traced pixel by pixel: terrain, asphalt, paint and the light on them, with masks."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.data.synthetic_optics import Plane, Sight, ground_tile, look_up, noise, sight_of
from trilitenet.data.synthetic_world import Colour, Marking, World

__all__ = ["LINE_PIXELS", "LINE_REACH", "draw_ground"]

LINE_PIXELS: Final = 4.0
"""Width of a labelled line at 640 pixels of image width: the published masks' 8 pixels at 1280."""
LINE_REACH: Final = 120.0
"""Metres ahead that lines and drivable area are labelled to in clear air."""
ROWS_AT_ONCE: Final = 40
"""At 640 pixels of image width."""


def draw_ground(
    world: World, image: NDArray[np.uint8]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]:
    """Draw the ground into the image; return the masks drivable, lines and paint."""
    sight = sight_of(world.camera)
    drivable, lines, paint = (np.zeros(world.camera.size, np.uint8) for _ in range(3))
    height, width = world.camera.size
    # A few rows at a time: their planes stay in the processor's cache.
    step = max(8, ROWS_AT_ONCE * 640 // width)
    for start in range(0, height - sight.top, step):
        rows = slice(start, start + step)
        whole = slice(sight.top + start, sight.top + start + step)
        strip = _Strip(world, sight, rows)
        strip.draw(image[whole])
        drivable[whole], lines[whole], paint[whole] = strip.drivable, strip.lines, strip.painted
    return drivable, lines, paint


class _Strip:
    """A few rows of the ground.

    Args:
        world: What there is.
        sight: Where the picture's lower rows meet the ground.
        rows: Which of these rows.
    """

    def __init__(self, world: World, sight: Sight, rows: slice) -> None:
        self.world = world
        camera, course = world.camera, world.course
        self.seen, self.x, self.y, grid = sight.seen[rows], sight.x[rows], sight.y[rows], sight.row[rows]
        angle = course.grid_angle
        tables = (np.tan(angle), np.cos(angle), np.sin(angle), course.grid_y, course.grid_s)
        tan, cos, sin, grid_y, grid_s = (table.astype(np.float32)[grid] for table in tables)
        aside = self.y - grid_y
        self.d = aside * cos
        self.along = grid_s + aside * sin + np.float32(world.travelled)
        # Metres of d that a pixel covers: the gradient of d over the image (level camera).
        slant = (self.x * tan - self.y) / np.float32(camera.height)
        self.foot = cos * self.x / np.float32(camera.fx) * np.sqrt(1 + slant * slant) + np.float32(1e-3)
        self.inverse = 1 / self.foot
        self.length = self.x * self.x / np.float32(camera.fx * camera.height) + np.float32(1e-3)
        shape = self.x.shape
        self.lines = np.zeros(shape, np.uint8)
        self.painted = np.zeros(shape, np.uint8)
        self.drivable = np.zeros(shape, np.uint8)
        self.planes: list[Plane] = []

    def draw(self, region: NDArray[np.uint8]) -> None:
        """Draw into these rows of the image, and fill the masks."""
        light, layout = self.world.light, self.world.layout
        reach = self.seen & (self.x < np.float32(min(LINE_REACH, 2.2 / light.haze)))
        self.drivable[:] = reach & (self.d > np.float32(layout.drivable[0])) & (self.d < np.float32(layout.drivable[1]))
        worn = self._draw_surfaces()
        self._draw_markings(worn, reach)
        self._draw_light()
        clear = np.exp(-np.float32(light.haze) * self.x)
        merged = cv2.merge(
            [
                np.float32(h) + (np.minimum(p, 255) - np.float32(h)) * clear
                for p, h in zip(self.planes, light.horizon, strict=True)
            ]
        )
        np.copyto(region, np.clip(merged, 0, 255).astype(np.uint8), where=self.seen[..., None])

    def _above(self, limit: float, part: slice = slice(None)) -> Plane:
        """Return the share of each pixel that lies left of d = limit."""
        share: Plane = self.d[:, part] - np.float32(limit)
        share *= self.inverse[:, part]
        share += np.float32(0.5)
        np.clip(share, 0, 1, out=share)
        return share

    def _band(self, low: float, high: float, part: slice = slice(None)) -> Plane:
        return self._above(low, part) - self._above(high, part)

    def _blend(self, alpha: Plane, colour: Colour, gain: Plane | None = None, part: slice = slice(None)) -> None:
        for whole, value in zip(self.planes, colour, strict=True):
            plane = whole[:, part]
            plane += alpha * ((np.float32(value) if gain is None else np.float32(value) * gain) - plane)

    def _columns(self, centre: float, half: Plane | np.float32) -> slice | None:
        """Return the columns with pixels nearer than ``half`` metres to d = centre."""
        near = np.flatnonzero((np.abs(self.d - np.float32(centre)) < half).any(axis=0))
        return slice(int(near[0]), int(near[-1]) + 1) if len(near) else None

    def _draw_surfaces(self) -> Plane:
        """Draw terrain, asphalt and kerbs; return how worn paint is."""
        world, layout, d, along = self.world, self.world.layout, self.d, self.along
        shift = float(world.texture % 499)
        fine = look_up(noise(0.7, 11), along * 40 + shift, d * 40, smooth=False)
        # These vary slowly: every second column is enough.
        soft = look_up(ground_tile(), along[:, ::2] * 7 + shift, d[:, ::2] * 14 + shift)
        coarse, grass, worn, crack = cv2.split(cv2.resize(soft, d.shape[::-1], interpolation=cv2.INTER_LINEAR))
        fade = np.clip(np.float32(0.05) * self.inverse, 0, 1)
        fine *= fade
        earth = 1 + np.float32(0.11) * grass + np.float32(0.12) * fine
        self.planes = [np.float32(c) * earth for c in layout.terrain]
        rough = np.float32(layout.rough)
        right, left = layout.paved
        wide = layout.pavement or 1.6
        self._blend(self._band(right - wide, left + wide), layout.verge, 1 + np.float32(0.6) * (earth - 1))
        # Asphalt: grain, tracks polished by tyres.
        track = np.cos((d / np.float32(layout.lane_width)) * np.float32(4 * math.pi) + np.float32(math.pi))
        grain = 1 + rough * (np.float32(0.045) * coarse + np.float32(0.06) * fine + np.float32(0.02) * track)
        red, green, blue = (c * (1 - 0.35 * world.light.wet) for c in layout.asphalt)
        asphalt: Colour = (red, green, blue)
        if layout.opposite is not None and (part := self._within(*layout.opposite)) is not None:
            self._blend(self._band(*layout.opposite, part), asphalt, grain[:, part], part)
        self._blend(self._band(right, left), asphalt, grain)
        for edge in (right, left):
            # Dirt gathers where the asphalt ends.
            if (part := self._columns(edge, np.float32(1.6))) is not None:
                dirt = np.exp(-np.abs(d[:, part] - np.float32(edge)) * 3) * np.float32(0.3)
                self._blend(dirt, (78.0, 72.0, 62.0), part=part)
        self._stripe(layout.drivable[0] - 0.35, 0.03, (38.0, 38.0, 40.0), 0.5)
        if world.texture % 3 == 0:
            self._blend((np.abs(crack) < np.float32(0.018)) * fade * np.float32(0.4), (34.0, 33.0, 33.0))
        if world.texture % 5 == 0:
            period = np.abs(along % np.float32(17.0) - 8)
            patch = (period < 2.2) & (np.abs(d - np.float32((world.texture % 7) - 3)) < 0.9)
            self._blend(patch.astype(np.float32) * np.float32(0.6), (52.0, 52.0, 54.0), grain)
        for kerb in layout.kerbs:
            self._stripe(kerb, 0.09, (168.0, 165.0, 158.0))
            self._stripe(kerb - 0.2 if kerb > 0 else kerb + 0.2, 0.1, (60.0, 59.0, 58.0), 0.35)
        return np.asarray(np.clip(worn * np.float32(0.5) + np.float32(0.5), 0, 1), np.float32)

    def _within(self, low: float, high: float) -> slice | None:
        return self._columns((low + high) / 2, self.foot + np.float32((high - low) / 2))

    def _stripe(self, d: float, half: float, colour: Colour, strength: float = 1.0) -> None:
        part = self._within(d - half, d + half)
        if part is not None:
            self._blend(self._band(d - half, d + half, part) * np.float32(strength), colour, part=part)

    def _draw_markings(self, worn: Plane, reach: NDArray[np.bool_]) -> None:
        """Draw paint, and mark paint and lines."""
        layout = self.world.layout
        half_line = self.foot * np.float32(LINE_PIXELS / 2 * self.world.camera.size[1] / 640)
        for d in (*layout.kerbs, *(mark.d for mark in layout.markings)):
            if (part := self._columns(d, half_line)) is not None:
                near = np.abs(self.d[:, part] - np.float32(d)) < half_line[:, part]
                self.lines[:, part] |= near & reach[:, part]
        for mark in layout.markings:
            part = self._within(mark.d - mark.width / 2, mark.d + mark.width / 2)
            if part is None:
                continue
            cover = self._band(mark.d - mark.width / 2, mark.d + mark.width / 2, part)
            if mark.dash:
                cover *= _dashes(mark, self.along[:, part], self.length[:, part])
            strength = 1 - np.float32(mark.wear) * np.clip(worn[:, part] * np.float32(1.6) - np.float32(0.2), 0, 1)
            colour: Colour = (232.0, 232.0, 228.0) if mark.colour == "white" else (226.0, 176.0, 52.0)
            self._blend(cover * strength * np.float32(0.95), colour, part=part)
            self.painted[:, part] |= (cover > 0.5) & self.seen[:, part]
        if self.world.texture % 4 == 0 and layout.markings:
            self._draw_arrow()

    def _draw_arrow(self) -> None:
        """Paint an arrow in a lane: paint that is no line."""
        lane = self.world.layout.lanes[self.world.texture % len(self.world.layout.lanes)]
        where = np.remainder(self.along, np.float32(60.0)) - np.float32(20.0)
        aside = np.abs(self.d - np.float32(lane))
        shaft = (where > 0) & (where < 3) & (aside < 0.09)
        head = (where >= 3) & (where < 4.6) & (aside < (np.float32(4.6) - where) * np.float32(0.28))
        self._blend(
            (shaft | head).astype(np.float32) * np.clip(np.float32(0.2) / self.foot, 0, 0.85), (225.0, 225.0, 220.0)
        )

    def _draw_light(self) -> None:
        world, light, x, y, along, d = self.world, self.world.light, self.x, self.y, self.along, self.d
        gain = np.ones(x.shape, np.float32)
        if light.sun:
            # Shadows of trees and houses reach onto the road from the sun's side, in clumps.
            seed = world.texture
            side = math.copysign(1.0, math.sin(light.azimuth))
            reach = np.float32(((seed >> 3) % 9) - 3.0)
            clump = np.float32(1.4) * look_up(noise(1.9, 16), along * 2.6 + seed % 333, d * 1.9)
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
        for plane, ambient, tint in zip(self.planes, light.ambient, warm, strict=True):
            plane *= np.float32(ambient) * gain + np.float32(tint) * beam + np.float32(tint) * lamps


def _dashes(mark: Marking, along: Plane, length: Plane) -> Plane:
    """Return the share of each pixel that a dash covers lengthwise; far away, where dashes blur, their mean."""
    period = np.float32(mark.dash + mark.gap)
    phase = np.remainder(along, period)
    soft = np.maximum(length, np.float32(0.03))
    begins = np.clip(phase / soft + np.float32(0.5), 0, 1)
    ends = np.clip((np.float32(mark.dash) - phase) / soft + np.float32(0.5), 0, 1)
    sharp = np.maximum(np.minimum(begins, ends), np.clip((phase - period) / soft + np.float32(0.5), 0, 1))
    blur = np.clip(soft / period - np.float32(0.3), 0, 1)
    return np.asarray(sharp + blur * (np.float32(mark.dash) / period - sharp), np.float32)
