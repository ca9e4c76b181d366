"""The common corruptions of Hendrycks and Dietterich (ICLR 2019, "ImageNet-C"), at five severities, on OpenCV.

The strengths are theirs, in pixels of the image as stored, as usual for larger images (Michaelis et al., 2019). The
packages that offer them depend on the windowed build of OpenCV, hence this implementation. Three differences: the
frost is a procedural texture instead of photographs; glass blur displaces all pixels at once, to all sides alike,
instead of swapping them one after the other; and the elastic transform has no affine part, because boxes and masks
stay where they are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import ConfigError, did_you_mean

__all__ = ["CORRUPTIONS", "SEVERITIES", "corrupt"]

FloatImage = NDArray[np.float32]
Rng = np.random.Generator

SEVERITIES: Final = (1, 2, 3, 4, 5)


def corrupt(image: NDArray[np.uint8], name: str, severity: int, rng: Rng) -> NDArray[np.uint8]:
    """Return a corrupted copy of an image.

    Args:
        image: (H, W, 3) uint8 RGB.
        name: A key of `CORRUPTIONS`.
        severity: 1 to 5.
        rng: What is random is drawn from it.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        ConfigError: If there is no such corruption or severity.
    """
    if name not in CORRUPTIONS:
        raise ConfigError(f"unknown corruption {name!r}{did_you_mean(name, CORRUPTIONS)}")
    if severity not in SEVERITIES:
        raise ConfigError(f"severity must be 1 to 5, got {severity}")
    result = CORRUPTIONS[name](np.asarray(image, np.float32) / np.float32(255), severity - 1, rng)
    return np.asarray(np.clip(result * 255, 0, 255).round(), np.uint8)


def _gaussian_noise(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    strength = np.float32((0.08, 0.12, 0.18, 0.26, 0.38)[level])
    return np.asarray(image + rng.standard_normal(image.shape, np.float32) * strength, np.float32)


def _shot_noise(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    photons = (60, 25, 12, 5, 3)[level]
    return np.asarray(rng.poisson(image * photons) / photons, np.float32)


def _impulse_noise(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    draw = rng.random(image.shape, np.float32)
    amount = (0.03, 0.06, 0.09, 0.17, 0.27)[level]
    return np.where(draw < amount / 2, np.float32(0), np.where(draw < amount, np.float32(1), image))


def _defocus_blur(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    radius, alias = ((3, 0.1), (4, 0.5), (6, 0.5), (8, 0.5), (10, 0.5))[level]
    side = np.arange(-max(8, radius), max(8, radius) + 1)
    disc = (side[:, None] ** 2 + side[None, :] ** 2 <= radius**2).astype(np.float32)
    size = 3 if radius <= 8 else 5
    kernel = cv2.GaussianBlur(disc / disc.sum(), (size, size), alias)
    return _filter(image, kernel)


def _glass_blur(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    sigma, reach, rounds = ((0.7, 1, 2), (0.9, 2, 1), (1.0, 2, 3), (1.1, 3, 2), (1.5, 4, 2))[level]
    result = cv2.GaussianBlur(image, (0, 0), sigma)
    height, width = image.shape[:2]
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    for _ in range(rounds):
        shift = rng.integers(-reach, reach, (2, height, width), endpoint=True).astype(np.float32)
        result = cv2.remap(result, columns + shift[0], rows + shift[1], cv2.INTER_NEAREST, None, cv2.BORDER_REFLECT)
    return np.asarray(cv2.GaussianBlur(result, (0, 0), sigma), np.float32)


def _motion_blur(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    radius, sigma = ((10, 3), (15, 5), (15, 8), (15, 12), (20, 15))[level]
    return _filter(image, _streak(radius, sigma, float(rng.uniform(-45, 45))))


def _zoom_blur(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    end, step = ((1.11, 0.01), (1.16, 0.01), (1.21, 0.02), (1.26, 0.02), (1.31, 0.03))[level]
    zooms = np.arange(1, end, step)
    height, width = image.shape[:2]
    total = image.copy()
    for zoom in zooms:
        total += _zoom(image, float(zoom))[:height, :width]
    return np.asarray(total / (len(zooms) + 1), np.float32)


def _snow(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    mean, spread, zoom, floor, radius, sigma, keep = (
        (0.1, 0.3, 3.0, 0.5, 10, 4, 0.8),
        (0.2, 0.3, 2.0, 0.5, 12, 4, 0.7),
        (0.55, 0.3, 4.0, 0.9, 12, 8, 0.7),
        (0.55, 0.3, 4.5, 0.85, 12, 8, 0.65),
        (0.55, 0.3, 2.5, 0.85, 12, 12, 0.55),
    )[level]
    height, width = image.shape[:2]
    layer = (rng.standard_normal((height, width), np.float32) * spread + mean).astype(np.float32)
    layer = _zoom(layer, zoom)[:height, :width]
    layer = np.clip(np.where(layer < floor, 0, layer), 0, 1).astype(np.float32)
    layer = _filter(layer, _streak(radius, sigma, float(rng.uniform(-135, -45))))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None]
    pale = keep * image + (1 - keep) * np.maximum(image, grey * 1.5 + 0.5)
    return np.asarray(pale + layer[..., None] + np.rot90(layer, 2)[..., None], np.float32)


def _frost(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    keep, add = ((1.0, 0.4), (0.8, 0.6), (0.7, 0.7), (0.65, 0.7), (0.6, 0.75))[level]
    # Ridges of fractal noise look like ice crystals; they grow from the edges of the pane.
    ridges = 1 - np.abs(2 * _fractal(image.shape[:2], 1.6, rng) - 1)
    cover = np.clip(0.4 + 0.9 * _fractal(image.shape[:2], 2.5, rng), 0, 1)
    ice = (ridges**3 * cover)[..., None] * np.array([0.85, 0.95, 1.0], np.float32)
    return np.asarray(keep * image + add * ice, np.float32)


def _fog(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    thickness, decay = ((1.5, 2.0), (2.0, 2.0), (2.5, 1.7), (2.5, 1.5), (3.0, 1.4))[level]
    brightest = float(image.max())
    foggy = image + thickness * _fractal(image.shape[:2], decay, rng)[..., None]
    return np.asarray(foggy * brightest / (brightest + thickness), np.float32)


def _brightness(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    hsv[..., 2] = np.clip(hsv[..., 2] + (0.1, 0.2, 0.3, 0.4, 0.5)[level], 0, 1)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), np.float32)


def _contrast(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    mean = image.mean(axis=(0, 1), keepdims=True)
    return np.asarray((image - mean) * (0.4, 0.3, 0.2, 0.1, 0.05)[level] + mean, np.float32)


def _elastic_transform(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    alpha, sigma = ((488.0, 170.8), (488.0, 19.52), (12.2, 2.44), (17.08, 2.44), (29.28, 2.44))[level]
    height, width = image.shape[:2]
    shift = [_smooth(rng.uniform(-1, 1, (height, width)).astype(np.float32), sigma) * alpha for _ in range(2)]
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    bent = cv2.remap(image, columns + shift[0], rows + shift[1], cv2.INTER_LINEAR, None, cv2.BORDER_REFLECT_101)
    return np.asarray(bent, np.float32)


def _pixelate(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    share = (0.6, 0.5, 0.4, 0.3, 0.25)[level]
    height, width = image.shape[:2]
    small = cv2.resize(image, (max(1, int(width * share)), max(1, int(height * share))), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)


def _jpeg_compression(image: FloatImage, level: int, rng: Rng) -> FloatImage:
    pixels = cv2.cvtColor((image * 255).round().astype(np.uint8), cv2.COLOR_RGB2BGR)
    quality = (25, 18, 15, 10, 7)[level]
    encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    decoded = cv2.cvtColor(cv2.imdecode(encoded, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    return np.asarray(np.asarray(decoded, np.float32) / 255, np.float32)


CORRUPTIONS: Final[dict[str, Callable[[FloatImage, int, Rng], FloatImage]]] = {
    "gaussian_noise": _gaussian_noise,
    "shot_noise": _shot_noise,
    "impulse_noise": _impulse_noise,
    "defocus_blur": _defocus_blur,
    "glass_blur": _glass_blur,
    "motion_blur": _motion_blur,
    "zoom_blur": _zoom_blur,
    "snow": _snow,
    "frost": _frost,
    "fog": _fog,
    "brightness": _brightness,
    "contrast": _contrast,
    "elastic_transform": _elastic_transform,
    "pixelate": _pixelate,
    "jpeg_compression": _jpeg_compression,
}
"""The fifteen standard corruptions: given an image in [0, 1], severity less 1 and a generator, the corrupted image."""


def _filter(image: FloatImage, kernel: NDArray[Any]) -> FloatImage:
    return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REFLECT_101), np.float32)


def _smooth(noise: FloatImage, sigma: float) -> FloatImage:
    """Blur; a wide blur is done on a reduced image."""
    scale = max(1, int(sigma / 4))
    if scale == 1:
        return np.asarray(cv2.GaussianBlur(noise, (0, 0), sigma), np.float32)
    height, width = noise.shape
    size = (max(1, width // scale), max(1, height // scale))
    small = cv2.GaussianBlur(cv2.resize(noise, size, interpolation=cv2.INTER_AREA), (0, 0), sigma / scale)
    return np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC), np.float32)


def _streak(radius: int, sigma: float, angle: float) -> FloatImage:
    """Return the published motion-blur kernel: 2 radius + 1 weights that fall from the middle on, to one side."""
    length = 2 * radius
    side = 2 * length + 1
    line = np.zeros((side, side), np.float32)
    line[length, length:] = np.exp(-0.5 * (np.arange(length + 1) / sigma) ** 2)
    turn = cv2.getRotationMatrix2D((length, length), angle, 1)
    kernel = cv2.warpAffine(line, turn, (side, side), flags=cv2.INTER_LINEAR)
    return np.asarray(kernel / kernel.sum(), np.float32)


def _zoom(image: FloatImage, factor: float) -> FloatImage:
    """Enlarge the middle of an image back to its size."""
    height, width = image.shape[:2]
    turn = np.array([[factor, 0, (1 - factor) * width / 2], [0, factor, (1 - factor) * height / 2]], np.float32)
    return np.asarray(cv2.warpAffine(image, turn, (width, height), flags=cv2.INTER_LINEAR, borderMode=4), np.float32)


def _fractal(size: tuple[int, int], decay: float, rng: Rng) -> FloatImage:
    """Return noise of all scales in [0, 1]; each halving of the scale divides the height by ``decay``."""
    height, width = size
    total = np.zeros(size, np.float32)
    strength, cells = 1.0, 2
    while cells <= max(size):
        grid = rng.random((cells + 1, cells + 1), np.float32)
        total += np.float32(strength) * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        strength, cells = strength / decay, cells * 2
    total -= total.min()
    return np.asarray(total / max(float(total.max()), 1e-6), np.float32)
