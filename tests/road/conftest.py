"""Short synthetic drives with true masks, for whatever is built on them."""

from __future__ import annotations

import functools
from collections.abc import Callable

import numpy as np
import pytest

from trilitenet.data.synthetic import Scene
from trilitenet.data.synthetic_drive import SyntheticDrive
from trilitenet.structures import Boxes, Perception

SIZE = (360, 640)


def perceive(scene: Scene) -> Perception:
    """Return what a network without fault would see of a scene."""
    sample = scene.sample
    assert sample.boxes is not None
    assert sample.drivable is not None
    assert sample.lane is not None
    count = len(sample.boxes)
    boxes = Boxes(sample.boxes, np.full(count, 0.9, np.float32), np.zeros(count, np.int64))
    return Perception(
        sample.size,
        boxes=boxes,
        drivable=sample.drivable > 0,
        lane=sample.lane > 0,
        image=sample.image,
        timestamp=scene.truth.timestamp,
    )


@functools.cache
def _drive(seed: int) -> tuple[Scene, ...]:
    drive = SyntheticDrive(seed, frames=60, fps=4, size=SIZE, faults=False)
    return tuple(drive[i] for i in range(60))


@pytest.fixture(scope="session")
def drive() -> tuple[Scene, ...]:
    """15 seconds at 4 frames a second with a change of lanes."""
    return _drive(0)


@pytest.fixture(scope="session")
def perceived() -> Callable[[Scene], Perception]:
    """What a network without fault would see."""
    return perceive
