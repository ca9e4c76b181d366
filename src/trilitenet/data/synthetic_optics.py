"""What a synthetic scene's pixels look at, and the noise that surfaces are made of."""

from __future__ import annotations

import dataclasses
import functools
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.data.synthetic_world import FAR
from trilitenet.processing.geometry import Camera

__all__ = ["TILE", "Plane", "Sight", "ground_tile", "look_up", "noise", "rays", "sight_of"]

Plane = NDArray[np.float32]

TILE: Final = 512
"""Side of a tile of noise."""


@functools.lru_cache(maxsize=32)
def noise(slope: float, seed: int) -> Plane:
    """Return a seamless (512, 512) tile of noise with a power-law spectrum: mean 0, deviation 1."""
    rng = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(TILE)[:, None], np.fft.rfftfreq(TILE)[None]
    radius = np.hypot(fy, fx)
    radius[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.normal(size=(TILE, TILE))) * radius ** (-slope / 2)
    spectrum[0, 0] = 0.0
    tile = np.fft.irfft2(spectrum, s=(TILE, TILE))
    return np.ascontiguousarray(tile / tile.std(), np.float32)


def look_up(tile: Plane, x: Plane, y: Plane, *, smooth: bool = True) -> Plane:
    """Return the tile's values at (x, y) in texels, repeated endlessly."""
    period = np.float32(TILE)
    x, y = x - period * np.floor(x / period), y - period * np.floor(y / period)
    how = cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST
    return np.asarray(cv2.remap(tile, x, y, how, borderMode=cv2.BORDER_WRAP), np.float32)


@functools.lru_cache(maxsize=1)
def ground_tile() -> Plane:
    """Return a (512, 512, 4) tile: blotches of asphalt, grass, wear of paint, cracks."""
    return np.ascontiguousarray(np.stack([noise(2.4, 12), noise(1.5, 13), noise(1.8, 15), noise(2.6, 14)], axis=2))


@functools.lru_cache(maxsize=4)
def rays(camera: Camera) -> tuple[Plane, Plane, Plane]:
    """Return each pixel's direction as three (H, W) planes: forward, left, up."""
    height, width = camera.size
    columns = camera.rotation @ np.linalg.inv(camera.matrix)
    u, v = np.arange(width)[None], np.arange(height)[:, None]
    forward, left, up = (
        (columns[i, 0] * u + columns[i, 2]).astype(np.float32) + (columns[i, 1] * v).astype(np.float32)
        for i in range(3)
    )
    return forward, left, up


@dataclasses.dataclass(frozen=True, eq=False)
class Sight:
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
def sight_of(camera: Camera) -> Sight:
    """Return where the camera's pixels meet the ground."""
    forward, left, up = rays(camera)
    below = up < -1e-5
    rows = np.flatnonzero(below.any(axis=1))
    top = int(rows[0]) if len(rows) else camera.size[0] - 1
    down = np.minimum(up[top:], -1e-5)
    scale = np.float32(camera.height) / -down
    x = forward[top:] * scale
    seen = below[top:] & (x < FAR) & (x > 0)
    x = np.clip(x, 0, FAR)
    y = np.clip(left[top:] * scale, -400, 400)
    return Sight(top, seen, x, y, (x * 4).astype(np.int32))
