from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from trilitenet.data.sample import Sample
from trilitenet.data.transforms import (
    Affine,
    Augmentation,
    EvalTransform,
    TrainTransform,
    draw_affine,
    hsv,
    kept_boxes,
    mixup,
    mosaic,
    shift_hsv,
    warp,
)
from trilitenet.errors import ConfigError

CANVAS = (384, 640)
SIZES = [(720, 1280), (360, 640), (360, 480), (193, 640), (640, 360), (240, 320)]


def marked(size: tuple[int, int] = (360, 640), at: tuple[float, float] = (0.5, 0.6), *, side: float = 0.04) -> Sample:
    """A black image with one magenta rectangle that is an object, an ignored region, drivable, lane and invalid."""
    height, width = size
    half = max(3, round(side * max(size) / 2))
    cx, cy = round(at[0] * width), round(at[1] * height)
    area = np.s_[cy - half : cy + half, cx - half : cx + half]
    image = np.zeros((height, width, 3), np.uint8)
    image[area] = (255, 0, 255)
    mask = np.zeros(size, np.uint8)
    mask[area] = 1
    box = np.array([[cx - half, cy - half, cx + half, cy + half]], np.float32)
    valid = mask == 0
    masks = (mask, mask.copy(), valid, valid.copy(), valid.copy())
    return Sample("marked", image, box, np.array([0]), box.copy(), *masks, {"a": "b"})


def bounds(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Left, top, right, bottom of what is set."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float64)


def seen(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where an image shows the mark, by its colour: red and blue well above green."""
    wide = image.astype(int)
    return np.asarray((wide[..., 0] - wide[..., 1] > 60) & (wide[..., 2] - wide[..., 1] > 60))


def check_together(sample: Sample, tolerance: float = 2.0) -> bool:
    """Image, box, ignored box and masks say the same of the mark, or all say that it is gone."""
    assert sample.boxes is not None
    assert sample.drivable is not None
    assert sample.lane is not None
    assert sample.valid is not None
    np.testing.assert_array_equal(sample.drivable, sample.lane)
    np.testing.assert_array_equal(sample.valid, sample.drivable_valid)
    np.testing.assert_array_equal(sample.valid, sample.lane_valid)
    assert not (sample.valid & (sample.drivable > 0)).any()
    assert not (~sample.valid & ~cv2.dilate(sample.drivable, np.ones((5, 5))).astype(bool)).any()
    visible = seen(sample.image)
    if not len(sample.boxes):
        return False
    np.testing.assert_allclose(bounds(visible), sample.boxes[0], atol=tolerance)
    np.testing.assert_allclose(bounds(sample.drivable > 0), sample.boxes[0], atol=tolerance)
    np.testing.assert_allclose(sample.ignored[0], sample.boxes[0], atol=1e-4)
    overlap = (visible & (sample.drivable > 0)).sum() / (visible | (sample.drivable > 0)).sum()
    assert overlap > 0.75
    return True


def certainly(name: str, **others: Any) -> Augmentation:
    """One step with probability 1."""
    return Augmentation(**{name: 1.0, **others})


ONLY: dict[str, Augmentation] = {
    "nothing": Augmentation(0, 0, 0, 0, 0, 0, 0),
    "rotation": Augmentation(10, 0, 0, 0, 0, 0, 0),
    "scale": Augmentation(0, 0.25, 0, 0, 0, 0, 0),
    "translation": Augmentation(0, 0, 0.1, 0, 0, 0, 0),
    "flip": Augmentation(0, 0, 0, 0, 0, 0, 1),
    "colour": Augmentation(0, 0, 0, 0.015, 0.3, 0.3, 0),
    "published": Augmentation(hue=0.015, saturation=0.3, value=0.3),
    "half a pixel": Augmentation(mask_above=127, saturation=0.3, value=0.3),
    **{name: certainly(name, saturation=0.1, value=0.1) for name in ("light", "blur", "noise", "rain")},
}


@pytest.mark.parametrize("name", ONLY)
@pytest.mark.parametrize("size", SIZES)
def test_a_marked_place_moves_with_its_box_and_masks(name: str, size: tuple[int, int]) -> None:
    transform = TrainTransform(CANVAS, ONLY[name])
    there = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        sample = marked(size, (rng.uniform(0.2, 0.8), rng.uniform(0.3, 0.8)), side=0.08)
        moved = transform(sample, rng)
        assert moved.size == CANVAS
        there += check_together(moved, tolerance=5.0 if name == "blur" else 2.5)
    assert there >= 10


@pytest.mark.parametrize("name", ["fog", "night"])
def test_weather_that_hides_colours_moves_nothing(name: str) -> None:
    sample = marked()
    plain = TrainTransform(CANVAS, Augmentation())(sample, np.random.default_rng(5))
    weather = TrainTransform(CANVAS, certainly(name))(sample, np.random.default_rng(5))
    assert plain.boxes is not None
    assert weather.boxes is not None
    np.testing.assert_array_equal(plain.boxes, weather.boxes)
    np.testing.assert_array_equal(plain.drivable, weather.drivable)
    assert (plain.image != weather.image).mean() > 0.3
    # The mark still stands out exactly where it was.
    grey = weather.image.astype(int).max(axis=2) - weather.image.astype(int).min(axis=2)
    inside, outside = plain.drivable == 1, plain.drivable == 0
    assert grey[inside].mean() > 3 * grey[outside].mean()


def test_mosaic_moves_each_mark_with_its_labels() -> None:
    transform = TrainTransform(CANVAS, Augmentation(mosaic=1.0, saturation=0.2, value=0.2))
    shown = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        moved = transform(marked(side=0.1), rng, lambda draw: marked(at=(draw.uniform(0.3, 0.7), 0.5), side=0.1))
        assert moved.size == CANVAS
        assert moved.boxes is not None
        assert moved.drivable is not None
        visible = seen(moved.image)
        assert (visible & (moved.drivable > 0)).sum() >= 0.7 * (moved.drivable > 0).sum()
        for box in moved.boxes:
            left, top, right, bottom = np.rint(box).astype(int)
            part = moved.drivable[top:bottom, left:right]
            assert part.mean() > 0.5
            shown += 1
        covered = np.zeros(CANVAS, np.bool_)
        for left, top, right, bottom in np.rint(moved.ignored).astype(int):
            covered[max(top - 2, 0) : bottom + 2, max(left - 2, 0) : right + 2] = True
        assert not (visible & ~covered).any()
    assert shown > 20


def test_mosaic_and_mixup_want_the_same_tasks() -> None:
    """A sample without lane labels never lends its missing lanes as background."""
    transform = TrainTransform(CANVAS, Augmentation(mosaic=1.0, mixup=1.0))
    other = dataclasses.replace(marked(), lane=None)
    moved = transform(marked(), np.random.default_rng(0), lambda _: other)
    alone = TrainTransform(CANVAS, Augmentation())(marked(), np.random.default_rng(1))
    assert moved.boxes is not None
    assert alone.boxes is not None
    assert len(moved.boxes) <= 1


def test_mixup_keeps_boxes_of_both_and_masks_of_the_stronger() -> None:
    one, two = marked(CANVAS, (0.3, 0.5)), marked(CANVAS, (0.7, 0.5))
    mixed = mixup(one, two, np.random.default_rng(0))
    assert mixed.boxes is not None
    assert len(mixed.boxes) == 2
    np.testing.assert_array_equal(mixed.drivable, one.drivable)
    assert mixed.image[one.image > 0].min() >= 127
    assert 0 < mixed.image[two.image > 0].max() <= 128


def test_mosaic_joins_valid_masks_of_some() -> None:
    tiles = [marked(CANVAS), *(dataclasses.replace(marked(CANVAS), valid=None) for _ in range(3))]
    assert mosaic(tiles, np.random.default_rng(0)).valid is not None
    assert mosaic([dataclasses.replace(t, valid=None) for t in tiles], np.random.default_rng(0)).valid is None


@pytest.mark.parametrize("size", SIZES)
def test_evaluation_letterboxes_all_alike(size: tuple[int, int]) -> None:
    sample = marked(size)
    fitted = EvalTransform(CANVAS)(sample)
    assert check_together(fitted, tolerance=1.01)
    assert fitted.attributes == {"a": "b"}


def test_nothing_is_letterbox() -> None:
    """The training path with all steps off and the evaluation path are one."""
    sample = marked((720, 1280))
    train = TrainTransform(CANVAS, ONLY["nothing"])(sample, np.random.default_rng(0))
    fitted = EvalTransform(CANVAS)(sample)
    np.testing.assert_array_equal(train.image, fitted.image)
    np.testing.assert_array_equal(train.drivable, fitted.drivable)
    assert train.boxes is not None
    assert fitted.boxes is not None
    np.testing.assert_allclose(train.boxes, fitted.boxes, atol=1e-4)


def test_unlabelled_stays_unlabelled() -> None:
    bare = Sample("bare", np.zeros((100, 200, 3), np.uint8))
    steps: list[Callable[[Sample], Sample]] = [
        EvalTransform(CANVAS),
        lambda sample: TrainTransform(CANVAS)(sample, np.random.default_rng(0)),
        lambda sample: TrainTransform(CANVAS, Augmentation(mosaic=1, mixup=1))(
            sample, np.random.default_rng(0), lambda _: bare
        ),
    ]
    for step in steps:
        moved = step(bare)
        assert moved.boxes is None
        assert moved.drivable is None
        assert moved.lane is None
        assert moved.valid is None


def test_padding_is_114_for_images_and_background_for_masks() -> None:
    sample = Sample("s", np.zeros((100, 640, 3), np.uint8), drivable=np.ones((100, 640), np.uint8))
    moved = TrainTransform(CANVAS, ONLY["nothing"])(sample, np.random.default_rng(0))
    assert moved.drivable is not None
    assert (moved.image[:140] == 114).all()
    assert not moved.drivable[:140].any()
    assert moved.drivable[150:230].all()


def test_draw_is_the_published_range() -> None:
    rng = np.random.default_rng(0)
    draws = [draw_affine(rng, Augmentation()) for _ in range(2000)]
    for values, low, high in (
        ([d.angle for d in draws], -10, 10),
        ([d.scale for d in draws], 0.75, 1.25),
        ([d.shift[0] for d in draws], -0.1, 0.1),
        ([d.shift[1] for d in draws], -0.1, 0.1),
    ):
        assert low <= min(values) < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < max(values) <= high
    assert 0.46 < np.mean([d.flip for d in draws]) < 0.54


def test_rotation_goes_about_the_middle() -> None:
    sample = marked((384, 640), (0.5, 0.5))
    moved = warp(sample, Affine(angle=90.0), CANVAS)
    assert moved.boxes is not None
    assert sample.boxes is not None
    np.testing.assert_allclose(moved.boxes, sample.boxes, atol=1e-3)


@pytest.mark.parametrize(
    ("moved", "clipped", "kept"),
    [
        ([0, 0, 10, 10], [0, 0, 10, 10], True),
        ([0, 0, 10, 10], [0, 0, 2, 10], False),  # 2 px wide: not more than 2
        ([0, 0, 100, 10], [0, 0, 9, 10], False),  # 9% left
        ([0, 0, 100, 10], [0, 0, 11, 10], True),  # 11% left
        ([0, 0, 100, 5], [0, 0, 100, 5], False),  # 20:1
        ([0, 0, 99, 5], [0, 0, 99, 5], True),
        ([5, 5, 5, 9], [5, 5, 5, 9], False),
    ],
)
def test_published_rule_for_boxes(moved: list[float], clipped: list[float], kept: bool) -> None:
    result = kept_boxes(np.array([moved], np.float32), np.array([clipped], np.float32))
    assert result.tolist() == [kept]


def test_hsv_works_on_rgb() -> None:
    """Red stays red under a small change of hue, and turns to green, not to blue, under a third of the circle."""
    red = np.zeros((4, 4, 3), np.uint8)
    red[..., 0] = 200
    assert shift_hsv(red, (1.0, 1.0, 1.0))[0, 0].tolist() == [200, 0, 0]
    assert shift_hsv(red, (1.0, 1.0, 0.5))[0, 0].tolist() == [100, 0, 0]
    orange = np.broadcast_to(np.array([200, 100, 0], np.uint8), (4, 4, 3)).copy()
    yellowish = shift_hsv(orange, (1.5, 1.0, 1.0))[0, 0]
    assert yellowish[1] > 130
    assert yellowish[2] < 10
    assert shift_hsv(orange, (1.0, 0.0, 1.0))[0, 0].tolist() == [200, 200, 200]


def test_hsv_agrees_with_the_formula() -> None:
    image = np.random.default_rng(0).integers(0, 256, (20, 20, 3)).astype(np.uint8)
    result = hsv(image, np.random.default_rng(7), Augmentation())
    gains = 1 + (2 * np.random.default_rng(7).random(3) - 1) * (0.015, 0.7, 0.4)
    parts = cv2.cvtColor(image, cv2.COLOR_RGB2HSV).astype(np.float64)
    parts[..., 0] = (parts[..., 0] * gains[0]) % 180
    parts[..., 1:] = np.clip(parts[..., 1:] * gains[1:], 0, 255)
    np.testing.assert_array_equal(result, cv2.cvtColor(parts.astype(np.uint8), cv2.COLOR_HSV2RGB))
    assert hsv(image, np.random.default_rng(7), Augmentation(), out=image) is not None
    np.testing.assert_array_equal(image, result)


def test_same_seed_same_sample() -> None:
    every = Augmentation(light=0.5, blur=0.5, noise=0.5, rain=0.5, fog=0.5, night=0.5, mosaic=0.5, mixup=0.5)
    transform = TrainTransform(CANVAS, every)
    for seed in range(4):
        one, two = (transform(marked(), np.random.default_rng(seed), lambda _: marked()) for _ in range(2))
        np.testing.assert_array_equal(one.image, two.image)
        np.testing.assert_array_equal(one.lane, two.lane)


def test_settings_are_checked() -> None:
    with pytest.raises(ConfigError, match="multiples of 32"):
        TrainTransform((380, 640))
    with pytest.raises(ConfigError, match="multiples of 32"):
        EvalTransform((0, 0))
    with pytest.raises(ConfigError, match="flip is a probability"):
        Augmentation(flip=1.5)
    with pytest.raises(ConfigError, match="scale"):
        Augmentation(scale=1.0)
    with pytest.raises(ConfigError, match="rotation"):
        Augmentation(rotation=-1)
    with pytest.raises(ConfigError, match="mask_above"):
        Augmentation(mask_above=255)


def test_the_shifts_of_the_two_axes_are_drawn_apart(rng: np.random.Generator) -> None:
    shifts = np.array([draw_affine(rng, Augmentation()).shift for _ in range(200)])
    assert abs(np.corrcoef(shifts.T)[0, 1]) < 0.3


def test_of_an_ignored_region_what_is_left_stays_ignored_however_little() -> None:
    sample = marked(at=(0.5, 0.5), side=0.2)
    moved = warp(sample, Affine(shift=(0.58, 0.0)), CANVAS)  # a twentieth of it is left
    assert moved.boxes is not None
    assert len(moved.boxes) == 0
    assert len(moved.ignored) == 1


def test_mixup_keeps_the_ignored_regions_of_both(rng: np.random.Generator) -> None:
    one, two = marked(CANVAS, (0.2, 0.5)), marked(CANVAS, (0.8, 0.5))
    np.testing.assert_array_equal(mixup(one, two, rng).ignored, np.concatenate([one.ignored, two.ignored]))
