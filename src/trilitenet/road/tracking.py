"""Things over time: identities of vehicles (ByteTrack), identities of lines, and masks that do not flicker."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import ConfigError, import_extra
from trilitenet.road.structures import LATE, LaneLine
from trilitenet.structures import Boxes, Perception

__all__ = ["LineTracker", "MaskSmoother", "Steady", "VehicleTracker", "flicker"]


class VehicleTracker:
    """Gives boxes an identity that lasts over the frames of a video.

    ByteTrack (Zhang et al., 2022) as kept in ``edgefirst-tracker``: boxes above ``sure`` are matched first, the others
    afterwards, so that a vehicle that fades for a moment keeps its identity.

    Args:
        sure: Confidence in [0, 1] above which a box may begin a track.
        overlap: Least intersection over union of a box with where its track is expected.
        memory: Seconds that a track lives on without a box, or without a frame.

    Raises:
        ConfigError: If ``memory`` is negative or not finite.
        MissingExtraError: If the extra ``track`` is not installed.
    """

    def __init__(self, *, sure: float = 0.4, overlap: float = 0.2, memory: float = 1.0) -> None:
        if not 0.0 <= memory < math.inf:
            raise ConfigError(f"memory must be at least 0 seconds, got {memory}")
        module: Any = import_extra("edgefirst.tracker", "track")
        self._new = functools.partial(module.ByteTrack, sure, overlap, 0.5, int(memory * 1e9))
        self._tracker = self._new()
        self._numbers: dict[str, tuple[int, float]] = {}
        self._next = 1
        self._memory = memory
        self._last: float | None = None

    def update(self, boxes: Boxes, timestamp: float) -> Boxes:
        """Return the boxes of the next frame with ``track_id`` (-1 = none yet).

        Args:
            boxes: Boxes of one frame.
            timestamp: Seconds. Where they fall by more than `LATE`, or leap by more than ``memory``, all tracks end; no
                identity is given twice. The boxes of a frame that is late by less have no identity.

        Raises:
            ConfigError: If the time stamp is negative or not finite.
        """
        if not 0.0 <= timestamp < math.inf:
            raise ConfigError(f"a time stamp must be at least 0 seconds, got {timestamp}")
        if self._last is not None and -LATE <= timestamp - self._last < 0:
            return dataclasses.replace(boxes, track_id=np.full(len(boxes), -1, np.int64))
        if self._last is not None and not 0 <= timestamp - self._last <= self._memory + 1e-6:
            self._tracker, self._numbers = self._new(), {}
        self._last = timestamp
        tracks = self._tracker.update(
            np.ascontiguousarray(boxes.xyxy, np.float32),
            np.ascontiguousarray(boxes.confidence, np.float32),
            np.ascontiguousarray(boxes.class_id, np.uintp),
            int(timestamp * 1e9),
        )
        numbers = np.full(len(boxes), -1, np.int64)
        for index, track in enumerate(tracks):
            if track is not None:
                number, _ = self._numbers.get(track.uuid, (0, 0.0))
                if not number:
                    number, self._next = self._next, self._next + 1
                self._numbers[track.uuid] = (number, timestamp)
                numbers[index] = number
        if len(self._numbers) > 512:
            limit = timestamp - 10 * self._memory
            self._numbers = {uuid: seen for uuid, seen in self._numbers.items() if seen[1] >= limit}
        return dataclasses.replace(boxes, track_id=numbers)


class LineTracker:
    """Gives lines an identity that lasts over frames: a line is the one nearest to where it was.

    Args:
        size: (height, width) of the pictures in pixels.
        memory: Frames that a line is remembered for.
    """

    REACH: Final = 0.05
    """Share of the picture's width that a line may move by between two frames, at the row it is compared at."""

    def __init__(self, size: tuple[int, int], memory: int = 10) -> None:
        self._row, self._reach, self._memory = 0.72 * size[0], self.REACH * size[1], memory
        self._known: dict[int, tuple[float, int]] = {}
        self._next = 0
        self._frame = 0

    def update(self, lines: Sequence[LaneLine]) -> list[LaneLine]:
        """Return the lines of the next frame, in their order, with identities."""
        self._frame += 1
        places = [float(line.column(self._row)) for line in lines]
        pairs = sorted(
            (abs(place - known), index, identity)
            for index, place in enumerate(places)
            for identity, (known, _) in self._known.items()
            if abs(place - known) <= self._reach
        )
        given: dict[int, int] = {}
        for _, index, identity in pairs:
            if index not in given and identity not in given.values():
                given[index] = identity
        for index, place in enumerate(places):
            if index not in given:
                given[index], self._next = self._next, self._next + 1
            self._known[given[index]] = (place, self._frame)
        self._known = {i: seen for i, seen in self._known.items() if self._frame - seen[1] <= self._memory}
        return [dataclasses.replace(line, id=given[index]) for index, line in enumerate(lines)]


class MaskSmoother:
    """Averages a mask over time, so that its edges flicker less.

    The past weighs ``w = 0.5 + 0.5 * strength``: with half or less, the frame at hand would always win. A lasting
    change shows in the n-th frame, n being the least with ``w ** n < 0.5``, so that a moving edge lags by n - 1 frames:
    1 up to a strength of 0.4, 2 at 0.5, 4 at 0.7, 13 at 0.9.

    Args:
        strength: From 0 (changes nothing) to below 1.

    Raises:
        ConfigError: If it is out of range.
    """

    def __init__(self, strength: float = 0.5) -> None:
        if not 0.0 <= strength < 1.0:
            raise ConfigError(f"smoothing must be at least 0 and below 1, got {strength}")
        self.strength = strength
        self._mean: NDArray[np.float32] | None = None

    def update(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the smoothed mask of the next frame.

        Args:
            mask: (H, W) bool; a change of size starts anew.
        """
        current = mask.view(np.uint8)
        if self.strength == 0.0:
            return mask
        if self._mean is None or self._mean.shape != mask.shape:
            self._mean = current.astype(np.float32, order="C")  # rows first, for OpenCV
            return mask
        cv2.accumulateWeighted(current, self._mean, 0.5 - 0.5 * self.strength)
        return np.asarray(self._mean > 0.5)


class Steady:
    """Makes the perceptions of a video hang together: identities for vehicles, masks without flicker.

    Args:
        track: Give vehicles identities (needs the extra ``track``).
        smoothing: How much masks are averaged over time (see `MaskSmoother`), in [0, 1): 0 leaves them alone.

    Raises:
        ConfigError: If ``smoothing`` is out of range.
        MissingExtraError: If the extra ``track`` is needed and not installed.
    """

    def __init__(self, *, track: bool = False, smoothing: float = 0.0) -> None:
        self._tracker = VehicleTracker() if track else None
        self._drivable, self._lane = MaskSmoother(smoothing), MaskSmoother(smoothing)
        self._clock = 0.0

    def __call__(self, perception: Perception) -> Perception:
        """Return the next frame, steadied. Frames without a timestamp are taken to be 1/30 s apart."""
        timestamp = self._clock if perception.timestamp is None else perception.timestamp
        self._clock = timestamp + 1 / 30
        drivable, lane, boxes = perception.drivable, perception.lane, perception.boxes
        return dataclasses.replace(
            perception,
            drivable=None if drivable is None else self._drivable.update(drivable),
            lane=None if lane is None else self._lane.update(lane),
            boxes=boxes if boxes is None or self._tracker is None else self._tracker.update(boxes, timestamp),
        )


def flicker(masks: Iterable[NDArray[np.bool_]]) -> float:
    """Return how restless a sequence of masks is: pixels that differ from the frame before, as a share of the mask.

    Part of it is the motion of the scene; compare sequences of the same video.
    """
    changed = total = 0
    before: NDArray[np.bool_] | None = None
    for mask in masks:
        if before is not None:
            changed += int(np.count_nonzero(mask != before))
            total += int(np.count_nonzero(before))
        before = mask
    return changed / max(total, 1)
