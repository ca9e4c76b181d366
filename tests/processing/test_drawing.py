from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from trilitenet.errors import ConfigError, ShapeError
from trilitenet.processing import drawing
from trilitenet.processing.drawing import BOX_COLOURS, DRIVABLE_COLOUR, LANE_COLOUR, draw, draw_label
from trilitenet.structures import Boxes, Perception


def scene(height: int = 120, width: int = 200) -> Perception:
    drivable, lane = np.zeros((height, width), bool), np.zeros((height, width), bool)
    drivable[height // 2 :] = True
    lane[height // 2 :, width // 2 : width // 2 + width // 20] = True
    box = np.array([[width * 0.1, height * 0.3, width * 0.3, height * 0.45]], np.float32)
    return Perception(
        size=(height, width),
        boxes=Boxes(box, np.array([0.9], np.float32), np.zeros(1, np.int64)),
        drivable=drivable,
        lane=lane,
        image=np.full((height, width, 3), 100, np.uint8),
    )


@pytest.mark.parametrize("size", [(120, 200), (721, 1281), (1080, 1920)])
def test_each_task_is_where_it_should_be_in_its_colour(size: tuple[int, int]) -> None:
    perception = scene(*size)
    picture = draw(perception).astype(int)
    height, width = size
    untouched = picture[height // 6 : height // 5, width // 2 :]
    assert (untouched == 100).all()
    tinted = picture[int(height * 0.8), int(width * 0.8)]
    np.testing.assert_allclose(tinted, 100 * 0.58 + np.array(DRIVABLE_COLOUR) * 0.42, atol=2)
    line = picture[int(height * 0.8), width // 2 + width // 40]
    np.testing.assert_allclose(line, tinted * 0.15 + np.array(LANE_COLOUR) * 0.85, atol=2)
    left, top = round(width * 0.1), round(height * 0.3)
    np.testing.assert_allclose(picture[top + (round(height * 0.45) - top) // 2, left], BOX_COLOURS[0], atol=2)


def test_edges_are_soft() -> None:
    column = draw(scene(720, 1280), hide=("boxes", "lane"))[:, 1000, 0].astype(int)
    steps = np.abs(np.diff(column[340:380]))
    assert 0 < steps.max() < 0.6 * np.ptp(column)


def test_the_source_is_not_changed_unless_asked() -> None:
    perception = scene()
    assert perception.image is not None
    before = perception.image.copy()
    picture = perception.draw()
    np.testing.assert_array_equal(perception.image, before)
    assert draw(perception, before, out=before) is before
    np.testing.assert_array_equal(before, picture)


def test_parts_can_be_hidden() -> None:
    perception = scene()
    assert (draw(perception, hide=("drivable", "lane", "boxes")) == 100).all()
    changed = {part: (draw(perception, hide=(part,)) != draw(perception)).any() for part in ("lane", "labels", "boxes")}
    assert all(changed.values())
    with pytest.raises(ConfigError, match="did you mean 'boxes'"):
        draw(perception, hide=("boxs",))


@pytest.mark.parametrize(("size", "labelled"), [((120, 160), False), ((160, 90), False), ((144, 256), True)])
def test_labels_cover_no_objects_of_the_smallest_pictures(size: tuple[int, int], labelled: bool) -> None:
    perception = scene(*size)
    assert (draw(perception) != draw(perception, hide=("labels",))).any() == labelled


def test_tracks_have_colours_of_their_own() -> None:
    boxes = Boxes(
        np.array([[20, 30, 60, 60]], np.float32), np.ones(1, np.float32), np.zeros(1, np.int64), np.array([3])
    )
    perception = Perception(size=(100, 100), boxes=boxes, image=np.zeros((100, 100, 3), np.uint8))
    np.testing.assert_array_equal(draw(perception)[50, 20], BOX_COLOURS[3])


def test_nothing_seen_is_the_image() -> None:
    image = np.full((40, 50, 3), 9, np.uint8)
    empty = np.zeros((40, 50), bool)
    perception = Perception(size=(40, 50), boxes=Boxes.empty(), drivable=empty, lane=empty)
    np.testing.assert_array_equal(perception.draw(image), image)
    np.testing.assert_array_equal(Perception(size=(40, 50)).draw(image), image)
    np.testing.assert_array_equal(perception.draw(Image.fromarray(image)), image)


def test_a_box_of_any_size_is_drawn() -> None:
    def picture(far: float) -> NDArray[np.uint8]:
        xyxy = np.array([[-far, 10.0, 20.0, far]], np.float32)
        boxes = Boxes(xyxy, np.array([0.9], np.float32), np.array([0]))
        return Perception(size=(40, 50), boxes=boxes, class_names=("car",)).draw(np.zeros((40, 50, 3), np.uint8))

    assert picture(100.0).any()
    np.testing.assert_array_equal(picture(1e30), picture(100.0))


@pytest.mark.parametrize("corner", [(-50, -50), (0, 0), (95, 3), (500, 500), (50, 99)])
def test_labels_stay_inside(corner: tuple[int, int]) -> None:
    canvas = np.zeros((100, 100, 3), np.uint8)
    draw_label(canvas, "a label longer than the canvas is wide", corner, (255, 0, 0), size=12)
    draw_label(canvas, "x", corner, (255, 0, 0), size=12)
    assert canvas.any()


def test_texts_that_change_from_frame_to_frame_are_not_kept() -> None:
    canvas = np.zeros((60, 400, 3), np.uint8)
    drawing.draw_label(canvas, "vehicle 0.87", (5, 30), (0, 0, 0))
    before = drawing._kept_plate.cache_info()
    for number in range(3):
        drawing.draw_label(canvas, "vehicle 0.87", (5, 30), (0, 0, 0))
        drawing.draw_label(canvas, f"offset {number / 100:.2f} m, heading 0.01 rad, 12.3 m/s", (5, 30), (0, 0, 0))
    after = drawing._kept_plate.cache_info()
    assert (after.currsize, after.hits - before.hits) == (before.currsize, 3)
    most = 512 * drawing._plate("m" * drawing._SHORT, 24, (0, 0, 0)).nbytes  # the letters of a 1080p frame
    assert (after.maxsize, most < 2**26) == (512, True)


def test_a_tiny_image_can_be_drawn_on() -> None:
    assert draw(scene(2, 3)).shape == (2, 3, 3)


def test_no_image_or_another_size_is_refused() -> None:
    with pytest.raises(ShapeError, match="pass one"):
        Perception(size=(4, 4)).draw()
    with pytest.raises(ShapeError, match="4, 4, 3"):
        Perception(size=(4, 4)).draw(np.zeros((5, 4, 3), np.uint8))
