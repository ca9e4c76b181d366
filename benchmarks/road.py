"""Offset, heading, curvature and lead distance on a synthetic drive against exact truth.

python benchmarks/road.py                          # true masks and boxes: the geometry alone
python benchmarks/road.py --model tiny             # the network's masks and boxes
python benchmarks/road.py --calibrate              # no camera file: the camera is estimated from the lanes
python benchmarks/road.py --clip docs/images/drive.webp   # a short animated overlay
python benchmarks/road.py --render drive           # drive/drive.mp4, camera.yaml and truth.json, and the figures
python benchmarks/road.py --results results/drive.json --truth drive/truth.json   # what `trilitenet predict` made of it
python benchmarks/road.py --lanes 100              # time of lanes as curves at 640x384; with --model its masks too
python benchmarks/road.py --feet DATA --stride 2   # how far the lower edges of the network's boxes are from the labels'
python benchmarks/road.py --flicker 200 --model tiny   # what --smoothing does to flicker and IoU of the network's masks
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from trilitenet.data.contact_sheet import as_perception
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.synthetic import Scene, SceneTruth, SyntheticScenes
from trilitenet.data.synthetic_drive import SyntheticDrive
from trilitenet.inference.video import VideoWriter
from trilitenet.processing.boxes import box_iou
from trilitenet.processing.drawing import draw
from trilitenet.road.camera import write_camera
from trilitenet.road.drawing import draw_road
from trilitenet.road.lanes import find_lines
from trilitenet.road.monitor import RoadMonitor
from trilitenet.road.tracking import MaskSmoother, Steady, flicker
from trilitenet.structures import Perception


def true_figures(truth: SceneTruth) -> dict[str, Any]:
    """Return what is compared, as JSON: metres, radians, 1/m, seconds."""
    return {
        "timestamp": truth.timestamp,
        "lane_width": truth.lane_width,
        "offset": truth.offset,
        "heading": truth.heading,
        "curvature": truth.curvature,
        "lead": None if truth.lead is None else truth.lead.distance,
    }


def true_perception(scene: Scene) -> Perception:
    """Return what a network without fault would see."""
    return dataclasses.replace(as_perception(scene.sample, ("vehicle",)), timestamp=scene.truth.timestamp)


class Errors:
    """Absolute errors by name."""

    def __init__(self) -> None:
        self.values: dict[str, list[float]] = {}
        self.frames = self.led = self.found = 0

    def add(self, truth: dict[str, Any], road: dict[str, Any]) -> None:
        """Compare the JSON form of one frame's road with its truth."""
        self.frames += 1
        lane = road["ego_lane"]
        if lane is not None:
            for name in ("offset", "heading", "curvature"):
                if lane[name] is None:
                    continue
                apart = abs(lane[name]["value"] - truth[name])
                if name == "offset" and truth["lane_width"] / 2 - abs(truth["offset"]) < 0.1:
                    apart = min(apart, abs(apart - truth["lane_width"]))  # on the line between two lanes
                self.values.setdefault(name, []).append(apart)
        lead = truth["lead"]
        if lead is not None and lead <= 40:
            self.led += 1
            if road["lead"] is not None:
                self.found += 1
                self.values.setdefault("lead", []).append(abs(road["lead"]["distance"]["value"] / lead - 1))

    def show(self) -> None:
        """Print a table."""
        units = {"offset": ("m", 1), "heading": ("rad", 1), "curvature": ("1/m", 1), "lead": ("%", 100)}
        aims = {"offset": 0.1, "heading": 0.01, "lead": 0.05}
        print(f"{'':10} {'frames':>7} {'share':>6} {'mean':>9} {'median':>9} {'95%':>9} {'max':>9}")
        for name, (unit, gain) in units.items():
            values = np.array(self.values.get(name, [np.nan])) * gain
            figures = " ".join(
                f"{v:9.4f}" for v in (values.mean(), np.median(values), np.quantile(values, 0.95), values.max())
            )
            count = len(self.values.get(name, []))
            share = count / max(1, self.led if name == "lead" else self.frames)
            met = np.mean(np.array(self.values[name]) < aims[name]) if name in aims and count else None
            aim = "" if met is None else f"; {met:.1%} below {aims[name] * gain:g} {unit}"
            print(f"{name:10} {count:7d} {share:6.1%} {figures} {unit}{aim}")
        print(f"lead found in {self.found} of {self.led} frames with one up to 40 m; {self.frames} frames")


def compare(results: Path, truth: Path) -> None:
    """Print the errors of a file that `trilitenet predict --road` wrote."""
    truths = json.loads(truth.read_text(encoding="utf-8"))
    errors = Errors()
    for frame in json.loads(results.read_text(encoding="utf-8"))["frames"]:
        errors.add(truths[frame["frame"]], frame["road"])
    errors.show()


def time_lanes(scenes: int, model: str | None) -> None:
    """Print how long the curves of a 640x384 lane mask take, on one thread, each mask once."""
    drawn = [SyntheticScenes(21, (384, 640))[index] for index in range(scenes)]
    masks = {"true": [scene.lane > 0 for scene in drawn if scene.lane is not None]}
    if model:
        import trilitenet

        predictor = trilitenet.load(model)
        seen = [predictor(scene.image) for scene in drawn]
        masks[model] = [one.lane for one in seen if isinstance(one, Perception) and one.lane is not None]
    cv2.setNumThreads(1)
    for name, kept in masks.items():
        find_lines(kept[0])
        wall, busy, lines = [], [], 0
        for mask in kept:
            begin, worked = time.perf_counter(), time.thread_time()
            lines += len(find_lines(mask))
            busy.append((time.thread_time() - worked) * 1e3)
            wall.append((time.perf_counter() - begin) * 1e3)
        print(f"{name} masks: {len(kept)} at 640x384, {lines / len(kept):.1f} lines each")
        for what, spent in (("wall", wall), ("processor", busy)):
            p50, p99 = np.quantile(spent, (0.5, 0.99))
            print(f"  {what:9} time: p50 {p50:.2f}, p99 {p99:.2f}, max {max(spent):.2f} ms")


def miss_feet(data: Path, model: str, stride: int) -> None:
    """Print how far the lower edges of boxes are from those of the labels, on validation frames in the usual layout."""
    import trilitenet

    predictor = trilitenet.load(model)
    missed, heights = [], []
    dataset = DrivingDataset(data, "val")
    for number in range(0, len(dataset), stride):
        labels = dataset[number].boxes
        if labels is None or not len(labels):
            continue
        seen = predictor(dataset.image_path(number))
        assert isinstance(seen, Perception)
        if seen.boxes is None or not len(seen.boxes):
            continue
        overlap = box_iou(seen.boxes.xyxy, labels)
        for index, best in enumerate(overlap.argmax(axis=1)):
            feet = float(seen.boxes.xyxy[index, 3]), float(labels[best, 3])
            if overlap[index, best] > 0.5 and max(feet) < seen.size[0] - 3:
                missed.append((feet[0] - feet[1]) * 640 / seen.size[1])
                heights.append((labels[best, 3] - labels[best, 1]) * 640 / seen.size[1])
    error, tall = np.array(missed), np.array(heights)
    for least, most in ((0, 20), (20, 40), (40, 80), (80, 640)):
        part = (tall >= least) & (tall < most)
        pixels, share = error[part], (error / tall)[part]
        print(
            f"{part.sum():5d} boxes {least} to {most} pixels high, of 640 across: mean {pixels.mean():+.2f}, root mean "
            f"square {np.sqrt((pixels**2).mean()):.2f} pixels, or {np.sqrt((share**2).mean()):.3f} of the height"
        )


def show_flicker(drive: SyntheticDrive, model: str, indices: range) -> None:
    """Print flicker of the model's masks, and their IoU with the true ones, at several strengths of smoothing."""
    import trilitenet

    predictor = trilitenet.load(model)
    kept: dict[str, list[NDArray[np.uint8]]] = {"drivable": [], "lane": []}  # (2, ...): true and seen, packed to bits
    for index in indices:
        scene = drive[index]
        truth, seen = true_perception(scene), predictor(scene.sample.image)
        for task, pairs in kept.items():
            pairs.append(np.packbits(np.stack([getattr(truth, task), getattr(seen, task)])))
    shape = (2, *drive.camera.size)
    for task, pairs in kept.items():
        restless = flicker(np.unpackbits(pair).reshape(shape)[0] > 0 for pair in pairs)
        print(f"{task}: flicker of {len(pairs)} true masks {restless:.2%}")
        for smoothing in (0.0, 0.1, 0.3, 0.5, 0.7, 0.9):
            smoother, calm = MaskSmoother(smoothing), []
            both = either = 0
            for pair in pairs:
                true, found = np.unpackbits(pair).reshape(shape) > 0
                found = smoother.update(found)
                both += np.count_nonzero(true & found)
                either += np.count_nonzero(true | found)
                calm.append(found)
            print(f"  smoothing {smoothing}: flicker {flicker(calm):.2%}, IoU {both / max(either, 1):.4f}")


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
    parser.add_argument("--render", type=Path, help="write the drive to this folder: video, camera file, truth")
    parser.add_argument("--results", type=Path, help="compare JSON of `trilitenet predict --road` with --truth")
    parser.add_argument("--truth", type=Path, help="truth.json of --render")
    parser.add_argument("--lanes", type=int, metavar="SCENES", help="only time lanes as curves, on so many scenes")
    parser.add_argument("--feet", type=Path, metavar="DATA", help="only compare the model's boxes with labelled ones")
    parser.add_argument(
        "--flicker",
        type=int,
        metavar="FRAMES",
        help="only smooth the model's masks, in so many frames of the lane change",
    )
    options = parser.parse_args()
    if options.feet:
        miss_feet(options.feet, options.model or "tiny", options.stride)
        return
    if options.lanes:
        time_lanes(options.lanes, options.model)
        return
    if options.results:
        if options.truth is None:
            parser.error("--results needs --truth")
        compare(options.results, options.truth)
        return
    frames = round(options.seconds * options.fps)
    drive = SyntheticDrive(options.seed, frames, options.fps, time=options.time, weather=options.weather)
    if options.flicker:
        first = round(0.4 * frames)
        show_flicker(drive, options.model or "tiny", range(first, first + options.flicker))
        return
    predictor = None
    if options.model:
        import trilitenet

        predictor = trilitenet.load(options.model)
    steady = Steady(track=True)
    monitor = RoadMonitor(None if options.calibrate else drive.camera)
    errors, spent = Errors(), 0.0
    pictures: list[Image.Image] = []
    truths: list[dict[str, Any]] = []
    writer = None
    if options.render:
        options.render.mkdir(parents=True, exist_ok=True)
        write_camera(drive.camera, options.render / "camera.yaml")
        writer = VideoWriter(options.render / "drive.mp4", options.fps / options.stride, quality=25)
    indices = range(0, frames, options.stride)
    if options.clip:
        first = round(0.405 * frames)
        indices = range(first - 30, first + round(6 * options.fps), 2)
    for index in indices:
        scene = drive[index]
        truths.append(true_figures(scene.truth))
        if writer is not None:
            writer.write(scene.sample.image, scene.truth.timestamp)
        perception = true_perception(scene)
        if predictor is not None:
            seen = predictor(scene.sample.image)
            assert isinstance(seen, Perception)
            perception = dataclasses.replace(seen, timestamp=scene.truth.timestamp, image=scene.sample.image)
        begin = time.perf_counter()
        perception = steady(perception)
        road = monitor(perception)
        spent += time.perf_counter() - begin
        errors.add(truths[-1], road.to_dict())
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
    if writer is not None:
        writer.close()
        (options.render / "truth.json").write_text(json.dumps(truths), encoding="utf-8")
    errors.show()
    print(f"tracking and road: {spent / errors.frames * 1e3:.2f} ms a frame")


if __name__ == "__main__":
    main()
