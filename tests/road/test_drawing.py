from __future__ import annotations

import dataclasses
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from trilitenet.data.synthetic import Scene
from trilitenet.errors import ConfigError, ShapeError
from trilitenet.processing.geometry import Camera
from trilitenet.road.drawing import ROAD_PARTS, draw_road
from trilitenet.road.monitor import RoadMonitor
from trilitenet.road.structures import Road
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
