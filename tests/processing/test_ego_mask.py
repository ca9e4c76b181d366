from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from trilitenet.errors import InputError, ShapeError
from trilitenet.processing.ego_mask import EgoMask
from trilitenet.processing.letterbox import Letterbox
from trilitenet.structures import Boxes, Perception


def bonnet(size: tuple[int, int] = (360, 640), top: float = 0.75) -> NDArray[np.bool_]:
    """Return a mask of the lower rows in all columns but the first tenth, and of a caption above."""
    height, width = size
    mask = np.zeros(size, np.bool_)
    mask[int(top * height) :, width // 10 :] = True
    mask[: height // 20, : width // 2] = True
    return mask


def hidden(
    mask: EgoMask, image: NDArray[np.uint8], canvas_size: tuple[int, int] | None = None
) -> tuple[NDArray[np.uint8], Letterbox]:
    letterbox = Letterbox.fit((image.shape[0], image.shape[1]), canvas=canvas_size)
    canvas = letterbox.image(image)
    mask.hide(canvas, letterbox)
    return canvas, letterbox


def picture(size: tuple[int, int] = (360, 640)) -> NDArray[np.uint8]:
    return np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)


@pytest.mark.parametrize("canvas_size", [None, (384, 640)])
@pytest.mark.parametrize("size", [(360, 640), (720, 1280), (1080, 1920), (480, 640), (375, 1242), (640, 480)])
def test_the_network_sees_nothing_of_the_bonnet_and_all_of_the_rest(
    size: tuple[int, int], canvas_size: tuple[int, int] | None
) -> None:
    own = bonnet(size)
    image = picture(size)
    other = image.copy()
    other[int(0.75 * size[0]) :, size[1] // 10 :] = (255, 0, 0)
    canvas, letterbox = hidden(EgoMask(own), image, canvas_size)
    np.testing.assert_array_equal(canvas, hidden(EgoMask(own), other, canvas_size)[0])
    plain = letterbox.image(image)
    changed = (canvas != plain).any(axis=2)
    below = np.zeros(letterbox.canvas, np.bool_)
    below[letterbox.inside] = letterbox.mask(own, threshold=0)[letterbox.inside] > 0
    below[: letterbox.canvas[0] // 2] = False  # a caption that does not reach the lower edge stays as it is
    assert not changed[~below].any()
    assert changed[below].mean() > 0.9


def test_below_the_bonnets_edge_lies_the_road_above_mirrored() -> None:
    image = np.zeros((360, 640, 3), np.uint8)
    image[:] = np.linspace(0, 255, 360)[:, None, None].astype(np.uint8)  # brighter and brighter to the lower edge
    image[:, 320:, 0] = 0
    mask = np.zeros((360, 640), np.bool_)
    mask[240:] = True
    canvas, letterbox = hidden(EgoMask(mask), image)
    seen = canvas[letterbox.inside]
    for below in (30, 60, 90):  # away from the edge, where the blur rounds the ramp
        np.testing.assert_allclose(seen[240 + below, [100, 540]], image[239 - below, [100, 540]], atol=2)
    assert seen[300, 250, 0] > 5 * seen[300, 390, 0]


def test_a_mask_that_does_not_reach_the_lower_edge_changes_nothing_that_the_network_sees() -> None:
    mask = np.zeros((360, 640), np.bool_)
    mask[:20] = True
    canvas, letterbox = hidden(EgoMask(mask), picture())
    np.testing.assert_array_equal(canvas, letterbox.image(picture()))


def test_a_pillar_from_top_to_bottom_leaves_the_rest_as_it_is() -> None:
    mask = np.zeros((360, 640), np.bool_)
    mask[:, :40] = True
    canvas, letterbox = hidden(EgoMask(mask), picture())
    np.testing.assert_array_equal(canvas[:, 40:], letterbox.image(picture())[:, 40:])


def test_what_lies_on_the_own_car_is_dropped() -> None:
    mask = np.zeros((40, 60), np.bool_)
    mask[30:] = True
    boxes = Boxes(
        np.array([[0, 0, 10, 10], [0, 24, 10, 36], [0, 28, 10, 40]]), np.array([0.9, 0.8, 0.7]), np.array([0, 0, 0])
    )
    drivable, lane = np.ones((40, 60), np.bool_), np.zeros((40, 60), np.bool_)
    lane[:, 30] = True
    perception = Perception((40, 60), boxes=boxes, drivable=drivable, lane=lane, source="a", frame=3, timestamp=0.1)
    left = EgoMask(mask).drop(perception)
    assert left.boxes is not None
    assert left.boxes.xyxy[:, 1].tolist() == [0, 24]  # by 6 of 12 rows, which is no more than half; the third by 10
    np.testing.assert_array_equal(left.drivable, ~mask)
    np.testing.assert_array_equal(left.lane, lane & ~mask)
    assert (left.source, left.frame, left.timestamp) == ("a", 3, 0.1)
    assert drivable.all()  # the perception that was given is as it was
    alone = EgoMask(mask).drop(Perception((40, 60), lane=lane))
    assert alone.boxes is None
    assert alone.drivable is None


@pytest.mark.parametrize("kind", ["png of 0 and 255", "png of 0 and 1", "jpeg", "larger", "grey", "array"])
def test_a_mask_may_be_any_picture(kind: str, tmp_path: Path) -> None:
    own = np.zeros((120, 160), np.bool_)
    own[80:, 16:] = True
    grey = own.astype(np.uint8) * np.uint8(1 if kind == "png of 0 and 1" else 255)
    path = tmp_path / ("mask.jpg" if kind == "jpeg" else "mask.png")
    if kind == "larger":
        grey = np.repeat(np.repeat(grey, 3, axis=0), 3, axis=1)
    Image.fromarray(grey if kind == "grey" else np.dstack([grey] * 3)).save(path)
    mask = EgoMask(own if kind == "array" else path)
    found = mask.of((120, 160))
    assert found.dtype == np.bool_
    assert not found.flags.writeable
    if kind == "jpeg":
        assert (found != own).mean() < 0.01
    else:
        np.testing.assert_array_equal(found, own)


def test_a_mask_of_another_shape_is_refused() -> None:
    mask = EgoMask(bonnet((360, 640)))
    mask.of((720, 1280))
    mask.of((1080, 1918))  # a few columns were cut off
    with pytest.raises(ShapeError, match=r"of 640x360 pixels, the picture of 640x480, which is another shape"):
        mask.of((480, 640))


@pytest.mark.parametrize(("value", "message"), [(0, "marks nothing"), (255, "marks all of the picture")])
def test_a_mask_of_one_colour_is_refused_by_its_name(value: int, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bonnet.png"
    Image.fromarray(np.full((20, 30), value, np.uint8)).save(path)
    with pytest.raises(InputError, match=rf"bonnet\.png: the ego mask {message}"):
        EgoMask(path)
    buffer = io.BytesIO()
    Image.open(path).save(buffer, "PNG")
    with pytest.raises(InputError, match=f"^the ego mask {message}"):
        EgoMask(buffer.getvalue())
