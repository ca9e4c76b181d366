from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import ImageFont

from trilitenet.data.synthetic import Scene
from trilitenet.errors import ConfigError, ShapeError
from trilitenet.processing.drawing import draw_label, label_font
from trilitenet.processing.geometry import Camera
from trilitenet.road.camera import View
from trilitenet.road.drawing import ROAD_PARTS, _above_maps, draw_road, from_above
from trilitenet.road.monitor import RoadMonitor
from trilitenet.road.structures import EgoLane, Estimate, EventKind, LeadVehicle, Road
from trilitenet.structures import Perception

Perceive = Callable[[Scene], Perception]


def test_each_part_draws_something_of_its_own(drive: tuple[Scene, ...], perceived: Perceive) -> None:
    monitor = RoadMonitor(drive[0].truth.camera)
    for scene in drive[10:16]:
        perception = perceived(scene)
        road = monitor(perception)
    assert road.lead is not None
    image = drive[15].sample.image
    changed = {}
    for part in ROAD_PARTS:
        canvas = draw_road(image.copy(), perception, road, hide=[p for p in ROAD_PARTS if p != part])
        changed[part] = (canvas != image).any(axis=2)
        assert changed[part].sum() > 300
    assert changed["status"][-16:].mean() > 0.9
    assert changed["above"][:120, -100:].mean() > 0.3
    np.testing.assert_array_equal(draw_road(image.copy(), perception, road, hide=ROAD_PARTS), image)


def test_from_above_vehicles_are_where_they_are_wherever_the_bumper_is(
    drive: tuple[Scene, ...], perceived: Perceive
) -> None:
    image, hide = drive[0].sample.image, [part for part in ROAD_PARTS if part != "above"]
    drawn = []
    for front, left in ((0.0, 0.0), (1.5, 0.0), (1.5, 1.0)):  # without a bumper, 1.5 m is drawn
        camera = dataclasses.replace(drive[0].truth.camera, front=front, left=left)
        road = RoadMonitor(camera, still=True)(perceived(drive[0]))
        assert any(road.distances)
        drawn.append(draw_road(image.copy(), perceived(drive[0]), road, hide=hide))
    np.testing.assert_array_equal(drawn[0], drawn[1])
    rows = np.flatnonzero((drawn[1] != drawn[2]).any(axis=(1, 2)))
    assert len(rows)
    assert rows.min() > 140, "the own car alone is elsewhere"  # of a panel that ends 150 rows down


def test_the_view_from_above_is_free_of_the_lens() -> None:
    ideal = Camera.from_field_of_view((360, 640), 100.0, 1.4, pitch=0.1)
    bent = dataclasses.replace(ideal, distortion=(-0.3, 0.06, 0.0, 0.0))
    x, y = np.linspace(5, 30, 200), np.linspace(-3.6, 3.6, 9)
    panels = []
    for camera in (ideal, bent):
        image = np.zeros((360, 640, 3), np.uint8)
        for side in y:
            line = np.round(camera.to_pixels(np.stack([x, np.full_like(x, side)], axis=1)) * 16).astype(np.int32)
            cv2.polylines(image, [line], False, (255, 255, 255), 1, cv2.LINE_AA, 4)
        hide = [part for part in ROAD_PARTS if part != "above"]
        canvas = draw_road(image, Perception((360, 640)), Road(camera=camera), hide=hide)
        panels.append(canvas[56:131, -64:-14, 0])  # 6 to 31 m ahead
    assert panels[0].max() > 60
    assert np.corrcoef(panels[0].ravel(), panels[1].ravel())[0, 1] > 0.99


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.03, 0.0, 0.0)])
def test_lines_of_the_road_are_upright_from_above(distortion: tuple[float, ...]) -> None:
    ideal = Camera.from_field_of_view((720, 1280), 90.0, 1.4, pitch=0.06, yaw=0.05, roll=0.02)
    camera = dataclasses.replace(ideal, distortion=distortion)
    view = View(near=6, far=26, half_width=5, scale=10)
    x = np.linspace(4, 30, 300)
    for y in (-1.8, 0.4, 1.8):
        image = np.zeros((720, 1280, 3), np.uint8)
        sides = [np.stack([x, np.full_like(x, side)], axis=1) for side in (y - 0.2, y + 0.2)]
        line = np.round(camera.to_pixels(np.concatenate([sides[0], sides[1][::-1]])) * 16).astype(np.int32)
        cv2.fillPoly(image, [line], (255, 255, 255), cv2.LINE_AA, 4)
        picture = from_above(image, camera, view)
        assert picture.shape == (200, 100, 3)
        light = np.maximum(picture[..., 0].astype(np.float64) - 30, 0)  # what is not seen is not quite black
        columns = light @ np.arange(100) / light.sum(axis=1)
        np.testing.assert_allclose(columns, (5 - y) * 10 - 0.5, atol=0.3)


def test_marks_across_the_road_are_in_their_rows_from_above() -> None:
    camera = Camera.from_field_of_view((720, 1280), 90.0, 1.4, pitch=0.06)
    view = View(near=6, far=26, half_width=5, scale=10)
    image = np.zeros((720, 1280, 3), np.uint8)
    ends = camera.to_pixels(np.array([[10.0, 1.0], [10.0, -1.0]]))
    left, right = np.round(ends).astype(int).tolist()
    cv2.line(image, left, right, (255, 255, 255), 1)
    light = from_above(image, camera, view)[:, 45:55, 0].astype(np.float64)
    assert light.mean(axis=1) @ np.arange(200) / light.mean(axis=1).sum() == pytest.approx(159.5, abs=1.0)


@pytest.mark.parametrize("yaw", [0.0, 0.3])
def test_nothing_is_seen_behind_the_camera(yaw: float) -> None:
    camera = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.1, yaw=yaw)
    sky = np.full((360, 640, 3), 255, np.uint8)
    picture = from_above(sky, camera, View(near=-20, far=20))
    assert (picture[:100] == 255).any()
    assert (picture[160:] < 50).all()


def test_no_maps_are_made_for_a_camera_without_distortion() -> None:
    made = _above_maps.cache_info().misses
    for yaw in (0.011, 0.012, 0.3):  # a video that calibrates itself has another camera again and again
        camera = Camera.from_field_of_view((360, 640), 60.0, 1.4, pitch=0.03, yaw=yaw)
        from_above(np.zeros((360, 640, 3), np.uint8), camera, View(near=0.0, far=48.0, half_width=11.0))
    assert _above_maps.cache_info().misses == made


def test_from_above_refuses_other_sizes_and_empty_views() -> None:
    camera = Camera.from_field_of_view((90, 160), 60.0, 1.4)
    with pytest.raises(ShapeError, match="to another resolution"):
        from_above(np.zeros((180, 320, 3), np.uint8), camera)
    with pytest.raises(ConfigError, match="far above near"):
        from_above(np.zeros((90, 160, 3), np.uint8), camera, View(near=10, far=10))


@pytest.mark.parametrize("size", [(90, 160), (192, 320), (720, 1280), (1280, 720)])
def test_warnings_are_whole_and_beside_the_picture_from_above(size: tuple[int, int]) -> None:
    camera = Camera.from_field_of_view(size, 60.0, 1.4)
    warnings: tuple[EventKind, ...] = ("forward_collision", "lane_departure_right")
    canvases = [np.zeros((*size, 3), np.uint8) for _ in range(2)]
    for canvas, hide in zip(canvases, (["status"], []), strict=True):
        draw_road(canvas, Perception(size), Road(camera=camera, warnings=warnings), hide=hide)
    room = int(canvases[0].any(axis=(0, 2)).argmax())  # where the picture from above begins
    written = (canvases[0] != canvases[1]).any(axis=2)[: -2 * max(9, round(size[1] / 72))]
    assert not written[:, room:].any()
    rows = np.flatnonzero(np.diff(written.any(axis=1).astype(int), prepend=0, append=0)).reshape(-1, 2)
    assert len(rows) == 2
    for first, last in rows.tolist():
        columns = np.flatnonzero(written[first:last].any(axis=0))
        left, right = int(columns[0]), room - 1 - int(columns[-1])
        assert left > 0
        assert abs(left - right) <= 2 + max(4, size[1] // 100)
    widest = max(np.ptp(np.flatnonzero(written[first:last].any(axis=0))) for first, last in rows.tolist())
    assert widest > 0.3 * room


@pytest.fixture
def labels(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int]]:
    """Texts that are drawn, and the height of their letters."""
    drawn: list[tuple[str, int]] = []

    def note(canvas: NDArray[np.uint8], text: str, corner: tuple[int, int], colour: object, *, size: int) -> None:
        drawn.append((text, size))

    monkeypatch.setattr("trilitenet.road.drawing.draw_label", note)
    return drawn


def test_the_status_has_no_negative_zero_and_fits(labels: list[tuple[str, int]]) -> None:
    sure = Estimate(0.5, 0.01)
    lane = EgoLane(sure, sure, Estimate(-0.0002, 0.01), Estimate(-0.0031, 0.0001))
    lead = LeadVehicle(0, -1, Estimate(116.4, 0.5), closing_speed=Estimate(-0.1, 0.1))
    draw_road(np.zeros((180, 320, 3), np.uint8), Perception((180, 320)), Road(ego_lane=lane, lead=lead))
    ((text, size),) = labels
    assert "heading +0.0°" in text
    assert "closing +0 km/h" in text
    wide = np.zeros((40, 2000, 3), np.uint8)
    draw_label(wide, text, (0, 30), (255, 0, 0), size=size)
    assert np.flatnonzero(wide.any(axis=(0, 2)))[-1] < 316


def test_a_font_is_made_once_for_all_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[float] = []
    load = ImageFont.load_default

    def note(size: float) -> object:
        made.append(size)
        return load(size)

    monkeypatch.setattr(ImageFont, "load_default", note)
    label_font.cache_clear()
    warnings: tuple[EventKind, ...] = ("forward_collision", "lane_departure_right")
    for _ in range(2):
        draw_road(np.zeros((180, 320, 3), np.uint8), Perception((180, 320)), Road(warnings=warnings))
    assert made
    assert len(made) == len(set(made))


def test_a_photo_is_not_calibrating(labels: list[tuple[str, int]]) -> None:
    canvas = np.zeros((90, 160, 3), np.uint8)
    draw_road(canvas, Perception((90, 160)), Road())
    draw_road(canvas, Perception((90, 160), frame=0, timestamp=0.0), Road())
    assert [text for text, _ in labels] == ["no camera", "calibrating"]


def test_draws_what_little_there_is() -> None:
    canvas = np.zeros((90, 160, 3), np.uint8)
    draw_road(canvas, Perception((90, 160)), Road())
    assert canvas.any()


def test_refuses_other_sizes_and_unknown_parts() -> None:
    perception = Perception((90, 160))
    with pytest.raises(ShapeError, match="canvas"):
        draw_road(np.zeros((80, 160, 3), np.uint8), perception, Road())
    with pytest.raises(ConfigError, match="did you mean 'status'"):
        draw_road(np.zeros((90, 160, 3), np.uint8), perception, Road(), hide=["statis"])
