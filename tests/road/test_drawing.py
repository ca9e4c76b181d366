from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from trilitenet.data.synthetic import Scene
from trilitenet.errors import ConfigError, ShapeError
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
