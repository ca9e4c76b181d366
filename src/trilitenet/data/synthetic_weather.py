"""What lies over a synthetic picture: reflections, glare, the own bonnet, rain, and the faults of a cheap camera."""

from __future__ import annotations

import functools
import math

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.data.synthetic_optics import TILE, Plane
from trilitenet.data.synthetic_scenery import fill
from trilitenet.data.synthetic_vehicles import SHIFT, Lamp, fixed
from trilitenet.data.synthetic_world import World

__all__ = ["add_camera_faults", "draw_bonnet", "draw_glare", "draw_rain", "draw_reflections"]


def draw_reflections(world: World, image: NDArray[np.uint8], ids: NDArray[np.uint8]) -> None:
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


def draw_glare(image: NDArray[np.uint8], ids: NDArray[np.uint8], lamps: list[Lamp], night: bool, haze: float) -> None:
    """Add the glow around lights."""
    height, width = image.shape[:2]
    shape = (height // 2, width // 2)
    glow = np.zeros((*shape, 3), np.float32)
    strong = 1.0 if night else 0.35
    for lamp in lamps:
        row, column = round(lamp.v), round(lamp.u)
        if 0 <= row < height and 0 <= column < width and ids[row, column] not in (0, lamp.owner):
            continue
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


def draw_bonnet(world: World, image: NDArray[np.uint8], ids: NDArray[np.uint8]) -> None:
    """Draw the own bonnet along the lower edge."""
    height, width = image.shape[:2]
    rng = np.random.default_rng(world.texture)
    u = np.linspace(-0.05, 1.05, 24)
    crest = height * (1 - world.bonnet * (1 - 0.55 * (2 * u - 1) ** 2))
    outline = np.concatenate(
        [np.stack([u * width, crest], axis=1), [[width * 1.05, height + 9], [-width * 0.05, height + 9]]]
    )
    paint = rng.uniform(12, 110)
    colour = tuple(float(paint * a * (1 + rng.normal(0, 0.05))) for a in world.light.ambient)
    fill(image, ids, outline, (colour[0], colour[1], colour[2]))
    shine = outline[:24] + np.array([0.0, height * 0.012])
    cv2.polylines(image, [fixed(shine)], False, tuple(min(255.0, c * 1.5 + 12) for c in colour), max(1, height // 190),
                  cv2.LINE_AA, SHIFT)  # fmt: skip


@functools.lru_cache(maxsize=2)
def _streaks() -> Plane:
    white = np.random.default_rng(77).random((TILE, TILE)).astype(np.float32)
    drops = (white > 0.9985).astype(np.float32)
    kernel = np.zeros((25, 25), np.float32)
    cv2.line(kernel, (9, 0), (15, 24), 1.0, 1)
    return np.asarray(cv2.filter2D(drops, -1, kernel / 9), np.float32)


def draw_rain(image: NDArray[np.uint8], rng: np.random.Generator) -> None:
    """Add streaks of falling rain and drops on the windscreen."""
    height, width = image.shape[:2]
    streaks = np.roll(_streaks(), tuple(int(v) for v in rng.integers(0, TILE, 2)), (0, 1))
    scale = max(1.0, width / 640)
    need = (math.ceil(height / scale / TILE), math.ceil(width / scale / TILE))
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
    return np.asarray(np.clip(noise, -127, 127), np.int8)


def add_camera_faults(
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
