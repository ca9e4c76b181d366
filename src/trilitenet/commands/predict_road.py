"""What `predict` adds to the single frame: identities, masks without flicker, and the road in metres."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

from trilitenet.commands.paths import StrPath
from trilitenet.errors import ConfigError
from trilitenet.processing.geometry import Camera
from trilitenet.road.camera import read_camera
from trilitenet.road.monitor import RoadMonitor
from trilitenet.road.structures import Road
from trilitenet.road.tracking import Steady
from trilitenet.structures import Perception

__all__ = ["RoadOptions", "follow"]


@dataclasses.dataclass(frozen=True)
class RoadOptions:
    """What is wanted beyond the single frame.

    Attributes:
        measure: Lanes as curves, and, with a camera, metres; done with a camera file in any case.
        camera: A camera file (see `trilitenet.road.camera.read_camera`); estimated from the lanes if None.
        track: Give vehicles identities.
        smoothing: How much masks are averaged over time, in [0, 1).
        field_of_view: Horizontal field of view in degrees that is assumed without a camera file; 60 if None.
        lane_width: Metres between the lines of a lane, likewise; 3.5 if None.
    """

    measure: bool = False
    camera: StrPath | None = None
    track: bool = False
    smoothing: float = 0.0
    field_of_view: float | None = None
    lane_width: float | None = None

    def open(self, *, still: bool) -> tuple[Steady | None, RoadMonitor | None]:
        """Return what follows one video, or what looks at one picture.

        Raises:
            ConfigError: If the camera file is wrong, a number out of range, or an assumption without effect.
            MissingExtraError: If vehicles shall be tracked and the extra ``track`` is not installed.
        """
        assumed: dict[str, Any] = {
            name: value
            for name, value in (("field_of_view", self.field_of_view), ("lane_width", self.lane_width))
            if value is not None
        }
        if assumed and (self.camera is not None or not self.measure):
            names = " and ".join(f"--{name.replace('_', '-')}" for name in assumed)
            why = "with --camera nothing is assumed" if self.camera is not None else "that is for --road"
            raise ConfigError(f"{names} would change nothing: {why}")
        steady = None
        if not still and (self.track or self.smoothing):
            steady = Steady(track=self.track, smoothing=self.smoothing)
        if not self.wanted:
            return steady, None
        return steady, RoadMonitor(self._mounted, still=still, **assumed)

    @property
    def wanted(self) -> bool:
        """Whether the road is looked at."""
        return self.measure or self.camera is not None

    @functools.cached_property
    def _mounted(self) -> Camera | None:
        """The camera that the file describes."""
        return None if self.camera is None else read_camera(self.camera)


def follow(perception: Perception, parts: tuple[Steady | None, RoadMonitor | None]) -> tuple[Perception, Road | None]:
    """Return a perception with what its video adds to it, and its road, which smoothed masks would blur in time."""
    steady, monitor = parts
    drivable, lane = perception.drivable, perception.lane
    if steady is not None:
        perception = steady(perception)
    if monitor is None:
        return perception, None
    return perception, monitor(dataclasses.replace(perception, drivable=drivable, lane=lane))
