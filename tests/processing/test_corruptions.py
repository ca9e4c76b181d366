from __future__ import annotations

import numpy as np
import pytest

from trilitenet.errors import ConfigError
from trilitenet.processing.corruptions import CORRUPTIONS, corrupt


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    rows, columns = np.mgrid[:72, :96]
    picture = np.stack([rows * 3, columns * 2, (rows // 7 + columns // 5) % 2 * 200], axis=2).astype(np.uint8)
    picture[20:30, 20:60] = (250, 250, 250)
    return picture


@pytest.mark.parametrize("name", list(CORRUPTIONS))
def test_each_corruption_changes_the_image_and_repeats_itself(name: str, image: np.ndarray) -> None:
    for severity in (1, 5):
        first = corrupt(image, name, severity, np.random.default_rng(1))
        assert first.shape == image.shape
        assert first.dtype == np.uint8
        assert (first != image).mean() > 0.01
        np.testing.assert_array_equal(first, corrupt(image, name, severity, np.random.default_rng(1)))


@pytest.mark.parametrize("name", sorted(set(CORRUPTIONS) - {"elastic_transform"}))
def test_a_higher_severity_is_further_from_the_image(name: str, image: np.ndarray) -> None:
    # The published strengths of the elastic transform do not rise with the severity.
    distance = [
        np.abs(corrupt(image, name, severity, np.random.default_rng(1)).astype(float) - image).mean()
        for severity in (1, 5)
    ]
    assert distance[1] > distance[0]


def test_known_cases(image: np.ndarray) -> None:
    grey = np.full((40, 40, 3), 100, np.uint8)
    draw = np.random.default_rng(0)
    assert corrupt(grey, "brightness", 1, draw)[0, 0].tolist() == pytest.approx([126] * 3, abs=1)  # + 0.1
    assert (corrupt(grey, "contrast", 5, draw) == 100).all()  # about the mean
    assert (corrupt(grey, "pixelate", 5, draw) == 100).all()
    assert (corrupt(grey, "motion_blur", 5, draw) == 100).all()  # kernels keep the sum
    assert (corrupt(grey, "defocus_blur", 3, draw) == 100).all()
    noisy = corrupt(grey, "gaussian_noise", 1, draw).astype(float)
    assert noisy.std() == pytest.approx(0.08 * 255, rel=0.1)
    salted = corrupt(grey, "impulse_noise", 5, draw)
    assert (salted != 100).mean() == pytest.approx(0.27, abs=0.03)
    assert corrupt(image, "fog", 3, draw).std() < image.std()


def test_a_streak_is_as_long_and_falls_as_the_published_one() -> None:
    spot = np.zeros((121, 121, 3), np.uint8)
    spot[59:62, 59:62] = 255
    for severity, (radius, sigma) in enumerate(((10, 3), (15, 5), (15, 8), (15, 12), (20, 15)), start=1):
        blurred = corrupt(spot, "motion_blur", severity, np.random.default_rng(3)).astype(float)[..., 0]
        taps = np.exp(-0.5 * (np.arange(2 * radius + 1) / sigma) ** 2)
        wanted = (np.arange(2 * radius + 1) * taps).sum() / taps.sum()
        middle = [(axis * blurred).sum() / blurred.sum() for axis in np.mgrid[:121, :121] - 60]
        assert np.hypot(*middle) == pytest.approx(wanted, abs=0.4)


@pytest.mark.parametrize("severity", [1, 3, 5])
def test_glass_leaves_things_where_they_are(severity: int) -> None:
    square = np.zeros((200, 200, 3), np.uint8)
    square[80:120, 80:120] = 200
    rows, columns = np.mgrid[:200, :200]
    blurred = corrupt(square, "glass_blur", severity, np.random.default_rng(0)).astype(float)[..., 0]
    for axis in (rows, columns):
        assert (axis * blurred).sum() / blurred.sum() == pytest.approx(99.5, abs=0.35)


def test_unknown_ones_are_refused(image: np.ndarray) -> None:
    with pytest.raises(ConfigError, match="did you mean 'snow'"):
        corrupt(image, "snoww", 1, np.random.default_rng(0))
    with pytest.raises(ConfigError, match="severity"):
        corrupt(image, "snow", 6, np.random.default_rng(0))
