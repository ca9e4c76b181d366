"""Offset, heading, curvature and lead distance on a synthetic drive against exact truth.

python benchmarks/road.py                          # true masks and boxes: the geometry alone
python benchmarks/road.py --model tiny             # the network's masks and boxes
python benchmarks/road.py --calibrate              # no camera file: the camera is estimated from the lanes
python benchmarks/road.py --clip docs/images/drive.webp   # a short animated overlay
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from trilitenet.data.synthetic import Scene
from trilitenet.data.synthetic_drive import SyntheticDrive
from trilitenet.processing.drawing import draw
from trilitenet.road.drawing import draw_road
from trilitenet.road.monitor import RoadMonitor
from trilitenet.road.structures import Road
from trilitenet.road.tracking import Steady
from trilitenet.structures import Boxes, Perception


def true_perception(scene: Scene) -> Perception:
    """Return what a network without fault would see."""
    sample = scene.sample
    assert sample.boxes is not None
    assert sample.drivable is not None
    assert sample.lane is not None
    count = len(sample.boxes)
    return Perception(
        sample.size,
        boxes=Boxes(sample.boxes, np.full(count, 0.9, np.float32), np.zeros(count, np.int64)),
        drivable=sample.drivable > 0,
        lane=sample.lane > 0,
        image=sample.image,
        timestamp=scene.truth.timestamp,
    )


class Errors:
    """Absolute errors by name."""

    def __init__(self) -> None:
        self.values: dict[str, list[float]] = {}
        self.frames = self.led = self.found = 0

    def add(self, scene: Scene, road: Road) -> None:
        """Compare one frame with its truth."""
        self.frames += 1
        truth, lane = scene.truth, road.ego_lane
        if lane is not None:
            for name in ("offset", "heading", "curvature"):
                estimate = getattr(lane, name)
                if estimate is None:
                    continue
                apart = abs(estimate.value - getattr(truth, name))
                if name == "offset" and truth.lane_width / 2 - abs(truth.offset) < 0.1:
                    apart = min(apart, abs(apart - truth.lane_width))  # on the line between two lanes
                self.values.setdefault(name, []).append(apart)
        lead = truth.lead
        if lead is not None and lead.distance <= 40:
            self.led += 1
            if road.lead is not None:
                self.found += 1
                self.values.setdefault("lead", []).append(abs(road.lead.distance.value / lead.distance - 1))

    def show(self) -> None:
        """Print a table."""
        units = {"offset": ("m", 1), "heading": ("rad", 1), "curvature": ("1/m", 1), "lead": ("%", 100)}
        print(f"{'':10} {'frames':>7} {'mean':>9} {'95%':>9} {'max':>9}")
        for name, (unit, gain) in units.items():
            values = np.array(self.values.get(name, [np.nan])) * gain
            figures = " ".join(f"{v:9.4f}" for v in (values.mean(), np.quantile(values, 0.95), values.max()))
            print(f"{name:10} {len(values):7d} {figures} {unit}")
        print(f"lead found in {self.found} of {self.led} frames with one up to 40 m; {self.frames} frames")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--fps", type=float, default=25.0)
    parser.add_argument("--stride", type=int, default=1, help="use every so many frames")
    parser.add_argument("--model", help="weights; true masks and boxes if left out")
    parser.add_argument("--calibrate", action="store_true")
    parser.add_argument("--time", default="day", choices=("day", "dusk", "night"))
    parser.add_argument("--weather", default="clear", choices=("clear", "overcast", "rain", "fog"))
    parser.add_argument("--clip", type=Path, help="write an animated WebP of 5 seconds instead of figures")
    options = parser.parse_args()
    frames = round(options.seconds * options.fps)
    drive = SyntheticDrive(options.seed, frames, options.fps, time=options.time, weather=options.weather)
    predictor = None
    if options.model:
        import trilitenet

        predictor = trilitenet.load(options.model)
    steady = Steady(track=True)
    monitor = RoadMonitor(None if options.calibrate else drive.camera)
    errors, spent = Errors(), 0.0
    pictures: list[Image.Image] = []
    indices = range(0, frames, options.stride)
    if options.clip:
        first = round(0.405 * frames)
        indices = range(first - 30, first + round(6 * options.fps), 2)
    for index in indices:
        scene = drive[index]
        perception = true_perception(scene)
        if predictor is not None:
            import dataclasses

            seen = predictor(scene.sample.image)
            assert isinstance(seen, Perception)
            perception = dataclasses.replace(seen, timestamp=scene.truth.timestamp, image=scene.sample.image)
        begin = time.perf_counter()
        perception = steady(perception)
        road = monitor(perception)
        spent += time.perf_counter() - begin
        errors.add(scene, road)
        if options.clip and index >= indices.start + 30:
            canvas = draw_road(draw(perception), perception, road)
            pictures.append(Image.fromarray(cv2.resize(canvas, (640, 360), interpolation=cv2.INTER_AREA)))
    if options.clip:
        milliseconds = round(2000 / options.fps)
        pictures[0].save(
            options.clip, save_all=True, append_images=pictures[1:], duration=milliseconds, loop=0, quality=42, method=6
        )
        print(f"{options.clip}: {options.clip.stat().st_size / 2**20:.2f} MiB, {len(pictures)} pictures")
        return
    errors.show()
    print(f"tracking and road: {spent / errors.frames * 1e3:.2f} ms a frame")


if __name__ == "__main__":
    main()
