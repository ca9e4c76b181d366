from __future__ import annotations

import numpy as np
import pytest

from trilitenet.errors import ConfigError, ShapeError
from trilitenet.processing.letterbox import PAD_VALUE, Letterbox

SIZES = [(720, 1280), (360, 640), (193, 640), (360, 480), (1, 1), (1080, 1920), (1920, 1080), (7, 3000), (375, 1242)]


def test_the_published_size_becomes_640x384_with_12_rows_of_padding() -> None:
    letterbox = Letterbox.fit((720, 1280))
    assert letterbox == Letterbox((720, 1280), (384, 640), (360, 640), top=12, left=0)


@pytest.mark.parametrize("size", SIZES)
def test_canvas_is_a_multiple_of_32_and_holds_the_image_in_its_middle(size: tuple[int, int]) -> None:
    letterbox = Letterbox.fit(size)
    assert letterbox.canvas[0] % 32 == letterbox.canvas[1] % 32 == 0
    assert max(letterbox.resized) == 640
    for axis, start in enumerate((letterbox.top, letterbox.left)):
        after = letterbox.canvas[axis] - letterbox.resized[axis] - start
        assert 0 <= after - start <= 1
        assert letterbox.canvas[axis] - letterbox.resized[axis] < 32


@pytest.mark.parametrize("size", SIZES)
def test_a_fixed_canvas_is_kept(size: tuple[int, int]) -> None:
    letterbox = Letterbox.fit(size, canvas=(384, 640))
    assert letterbox.canvas == (384, 640)
    assert letterbox.resized[0] == 384 or letterbox.resized[1] == 640
    assert letterbox.image(np.zeros((*size, 3), np.uint8)).shape == (384, 640, 3)


@pytest.mark.parametrize("canvas", [None, (384, 640), (640, 384)])
@pytest.mark.parametrize("size", SIZES)
def test_boxes_come_back_exactly(size: tuple[int, int], canvas: tuple[int, int] | None) -> None:
    letterbox = Letterbox.fit(size, canvas=canvas)
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 1, (200, 2, 2)) * np.array(size[::-1])
    boxes = np.concatenate([corners.min(1), corners.max(1)], axis=1).astype(np.float32)
    back = letterbox.boxes_to_source(letterbox.boxes(boxes))
    np.testing.assert_allclose(back, boxes, atol=max(size) * 1e-6, rtol=0)


def test_the_whole_image_maps_to_the_inside_and_back() -> None:
    letterbox = Letterbox.fit((193, 641))
    rows, columns = letterbox.inside
    whole = np.array([[0, 0, 641, 193]], np.float32)
    np.testing.assert_allclose(
        letterbox.boxes(whole), [[columns.start, rows.start, columns.stop, rows.stop]], atol=1e-4
    )


def test_boxes_outside_the_image_are_clipped() -> None:
    letterbox = Letterbox.fit((720, 1280))
    canvas = np.array([[-50, -50, 1000, 1000]], np.float32)
    np.testing.assert_array_equal(letterbox.boxes_to_source(canvas), [[0, 0, 1280, 720]])


def test_image_is_padded_with_grey_and_not_moved() -> None:
    image = np.random.default_rng(0).integers(0, 256, (360, 640, 3), dtype=np.uint8)
    letterbox = Letterbox.fit((360, 640))
    out = letterbox.image(image)
    np.testing.assert_array_equal(out[12:372], image)
    assert (out[:12] == PAD_VALUE).all()
    assert (out[372:] == PAD_VALUE).all()


def test_image_writes_into_a_used_buffer() -> None:
    buffer = np.full((384, 640, 3), 7, np.uint8)
    letterbox = Letterbox.fit((480, 640), canvas=(384, 640))
    image = np.full((480, 640, 3), 200, np.uint8)
    assert letterbox.image(image, out=buffer) is buffer
    np.testing.assert_array_equal(buffer, letterbox.image(image))


def test_shrinking_averages_over_the_area() -> None:
    image = np.zeros((720, 1280, 3), np.uint8)
    image[::2] = 200
    assert (Letterbox.fit((720, 1280)).image(image)[12:372] == 100).all()


def test_masks_come_back_exactly_at_scale_one_and_closely_otherwise() -> None:
    mask = np.zeros((360, 640), np.uint8)
    mask[100:200, 50:300] = 1
    same = Letterbox.fit((360, 640))
    np.testing.assert_array_equal(same.mask_to_source(same.mask(mask * np.uint8(255)) * np.uint8(255)) > 127, mask)

    big = np.kron(mask, np.ones((3, 3), np.uint8))
    half = Letterbox.fit(big.shape)
    back = half.mask_to_source(half.mask(big.astype(bool)) * np.uint8(255)) > 127
    assert (back != big).mean() < 0.002


def test_the_published_threshold_keeps_a_thin_line() -> None:
    mask = np.zeros((720, 1280), np.uint8)
    mask[:, 600] = 255
    out = Letterbox.fit((720, 1280)).mask(mask)
    assert out[12:372].sum() == 360
    assert out.sum() == 360
    assert set(np.unique(out)) == {0, 1}


def test_wrong_sizes_are_refused() -> None:
    letterbox = Letterbox.fit((720, 1280))
    with pytest.raises(ShapeError, match="720, 1280"):
        letterbox.image(np.zeros((10, 10, 3), np.uint8))
    with pytest.raises(ShapeError, match="out must be"):
        letterbox.image(np.zeros((720, 1280, 3), np.uint8), out=np.zeros((1, 1, 3), np.uint8))
    with pytest.raises(ShapeError, match="384, 640"):
        letterbox.mask_to_source(np.zeros((720, 1280), np.uint8))
    with pytest.raises(ShapeError, match="uint8 or bool"):
        letterbox.mask(np.zeros((720, 1280), np.float32))
    with pytest.raises(ConfigError, match="positive"):
        Letterbox.fit((0, 640))


def test_an_image_that_grows_has_no_steps() -> None:
    image = np.zeros((180, 320, 3), np.uint8)
    image[:, 160:] = 200
    letterbox = Letterbox.fit((180, 320))
    assert letterbox.resized == (360, 640)
    assert len(np.unique(letterbox.image(image)[letterbox.inside])) > 2
