"""Changes of an image that move nothing: light, blur, noise and weather. Boxes and masks stay as they are.

Each function takes an (H, W, 3) uint8 RGB image and a random generator and returns a new image of that form. Drawn for
640-pixel road frames with the horizon near the middle; plain OpenCV, a few milliseconds each.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["blur", "fog", "light", "night", "noise", "rain"]

Image = NDArray[np.uint8]


def light(image: Image, rng: np.random.Generator) -> Image:
    """Change brightness, contrast and gamma: another exposure or another camera."""
    contrast, brightness, gamma = rng.uniform(0.7, 1.3), rng.uniform(-25, 25), rng.uniform(0.7, 1.4)
    levels = np.arange(256) / 255
    table = np.clip(((levels**gamma) * 255 - 128) * contrast + 128 + brightness, 0, 255).astype(np.uint8)
    return cv2.LUT(image, table)  # type: ignore[no-any-return]


def blur(image: Image, rng: np.random.Generator) -> Image:
    """Blur by a Gaussian (out of focus) or along a line (motion), each half of the time."""
    if rng.random() < 0.5:
        return cv2.GaussianBlur(image, (0, 0), rng.uniform(0.6, 1.6))  # type: ignore[no-any-return]
    length = int(rng.integers(3, 10)) | 1
    kernel = np.zeros((length, length), np.float32)
    angle = rng.uniform(0, np.pi)
    offset = np.array([np.cos(angle), np.sin(angle)]) * (length // 2)
    middle = np.array([length // 2, length // 2])
    start, end = np.rint(middle - offset).astype(int), np.rint(middle + offset).astype(int)
    cv2.line(kernel, start.tolist(), end.tolist(), 1.0)
    return cv2.filter2D(image, -1, kernel / kernel.sum())  # type: ignore[no-any-return]


def noise(image: Image, rng: np.random.Generator) -> Image:
    """Add sensor noise, stronger in dark parts, and JPEG blocks half of the time."""
    height, width = image.shape[:2]
    grain = np.empty((height, width, 3), np.int16)
    cv2.setRNGSeed(int(rng.integers(1 << 31)))
    cv2.randn(grain, (0, 0, 0), (rng.uniform(3, 12),) * 3)
    noisy = np.clip(image + grain, 0, 255).astype(np.uint8)
    if rng.random() < 0.5:
        quality = int(rng.integers(25, 70))
        encoded = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        noisy = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    return np.asarray(noisy, np.uint8)


def rain(image: Image, rng: np.random.Generator) -> Image:
    """Draw slanting streaks, darken and wash out the colours, and put drops on the windscreen now and then."""
    height, width = image.shape[:2]
    layer = np.zeros((height, width), np.uint8)
    slant = rng.uniform(-0.35, 0.35)
    count = int(rng.integers(150, 600) * height * width / (384 * 640))
    lengths = rng.uniform(0.02, 0.07, count) * height
    x, y = rng.uniform(0, width, count), rng.uniform(-0.05, 1, count) * height
    ends = np.stack([x + slant * lengths, y + lengths], axis=1)
    lines = np.stack([np.stack([x, y], axis=1), ends], axis=1).astype(np.int32)
    cv2.polylines(layer, list(lines), False, 255, 1, cv2.LINE_AA)
    layer = cv2.GaussianBlur(layer, (3, 3), 0)
    grey = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    dull = cv2.addWeighted(image, 0.6 * rng.uniform(0.75, 1), grey, 0.4 * rng.uniform(0.75, 1), 0)
    for _ in range(int(rng.integers(0, 8))):
        radius = int(rng.uniform(0.01, 0.04) * height) + 2
        cx, cy = int(rng.integers(0, width)), int(rng.integers(0, height))
        area = np.s_[max(cy - radius, 0) : cy + radius, max(cx - radius, 0) : cx + radius]
        dull[area] = cv2.GaussianBlur(dull[area], (0, 0), radius / 2)
    return _screen(dull, layer, rng.uniform(0.25, 0.55))


def fog(image: Image, rng: np.random.Generator) -> Image:
    """Fade to grey with the distance, which is taken from the height in the image: most at the horizon."""
    height, width = image.shape[:2]
    horizon = rng.uniform(0.4, 0.5)
    row = (np.arange(height) + 0.5) / height
    # A flat road's distance is 1 / (row - horizon); above the horizon it is far.
    distance = np.where(row > horizon + 0.02, 0.06 / np.maximum(row - horizon, 0.02), 3.0)
    through = np.exp(-rng.uniform(0.3, 1.2) * distance).astype(np.float32)
    grey = rng.uniform(150, 215)
    alpha = np.repeat(np.repeat(through[:, None], width, axis=1)[..., None], 3, axis=2)
    return (image * alpha + grey * (1 - alpha)).astype(np.uint8)


def night(image: Image, rng: np.random.Generator) -> Image:
    """Darken a day image and tint it blue, but for a cone of light before the car and what shines by itself."""
    height, width = image.shape[:2]
    dark = rng.uniform(0.15, 0.4)
    x = (np.arange(width) + 0.5) / width - rng.uniform(0.42, 0.58)
    y = (np.arange(height)[:, None] + 0.5) / height
    reach = np.clip((y - 0.45) / 0.35, 0, 1)
    cone = reach * np.exp(-((x / (0.12 + 0.35 * np.clip(y - 0.4, 0, 1))) ** 2)) * rng.uniform(0.3, 0.6)
    gain = np.clip(dark + cone, 0, 1).astype(np.float32)[..., None]
    tint = np.array([0.92, 0.96, 1.1], np.float32)
    lit = np.clip(image * gain * tint, 0, 255)
    shining = (image.min(axis=2).astype(np.float32)[..., None] - 235).clip(0, 20) / 20
    glow = image * shining * 0.6
    grain = np.empty((height, width, 1), np.float32)
    cv2.setRNGSeed(int(rng.integers(1 << 31)))
    cv2.randn(grain, 0, rng.uniform(2, 6))
    dark_image: Image = np.clip(np.maximum(lit, glow) + grain.reshape(height, width, 1), 0, 255).astype(np.uint8)
    return dark_image


def _screen(image: Image, layer: Image, strength: float) -> Image:
    """Lighten an image where a grey layer is bright."""
    light_layer = cv2.cvtColor(cv2.convertScaleAbs(layer, alpha=strength), cv2.COLOR_GRAY2RGB)
    return cv2.add(image, light_layer)  # type: ignore[no-any-return]
