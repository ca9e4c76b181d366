"""Predict on pictures, folders, videos and streams, and leave overlays and machine-readable files."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from trilitenet.commands.load import load
from trilitenet.commands.paths import NameOrPath, StrPath, one_for_several
from trilitenet.commands.predict_marks import Marks
from trilitenet.commands.predict_plan import RATE, Plan, read_list
from trilitenet.commands.predict_road import RoadOptions, follow
from trilitenet.commands.preview import Window, WindowClosed
from trilitenet.commands.progress import show_bars
from trilitenet.errors import InputError, ShapeError, replacing, writing
from trilitenet.formats.writers.base import Writer, open_writer, uninterrupted
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.sources import Clip, Failure, FrameReader, Stills, silent_opencv
from trilitenet.inference.video import PerceptionStream, VideoWriter
from trilitenet.processing.drawing import PARTS, draw
from trilitenet.road.drawing import ROAD_PARTS, draw_road
from trilitenet.road.structures import Road
from trilitenet.structures import Perception

__all__ = ["PredictReport", "RoadOptions", "predict", "predict_with"]

_JPEG_QUALITY: Final = 92
"""Of overlays on pictures, of 100."""
_MOST_BARS: Final = 10
"""Of more sources than these, only the bar of the one at hand is shown, below that of all."""


@dataclasses.dataclass(frozen=True)
class PredictReport:
    """What `predict` did.

    Attributes:
        images: Pictures seen.
        videos: Videos and streams seen.
        frames: Frames of videos seen.
        seconds: Wall time, the loading of the model left out.
        failures: What could not be used, and why.
        files: The overlays written.
        output: The folder of all results.
        interrupted: Whether it was stopped by Ctrl-C; what was written until then is whole.
        skipped: Sources that were left out because their results exist.
        partial: Files of all sources together that hold some of them alone, for it was interrupted.
        dropped: Frames of live sources that were left out, as there was no time for them.
    """

    images: int
    videos: int
    frames: int
    seconds: float
    failures: tuple[Failure, ...]
    files: tuple[Path, ...]
    output: Path
    interrupted: bool = False
    skipped: int = 0
    partial: tuple[Path, ...] = ()
    dropped: int = 0

    @property
    def exit_code(self) -> int:
        """0 if all went well, 1 if anything failed, 130 if interrupted."""
        return 130 if self.interrupted else int(bool(self.failures))

    @property
    def errors(self) -> tuple[str, ...]:
        """One line for each source that could not be used."""
        return tuple(failure.reason for failure in self.failures)

    def summary(self) -> str:
        """Return one line for people."""
        done = []
        if self.images:
            done.append(f"{self.images} image{'s' * (self.images != 1)}")
        if self.videos:
            done.append(
                f"{self.videos} video{'s' * (self.videos != 1)} of {self.frames} frame{'s' * (self.frames != 1)}"
            )
        speed = (self.images + self.frames) / max(self.seconds, 1e-9)
        dropped = f", {self.dropped} frame{'s' * (self.dropped != 1)} left out," if self.dropped else ""
        what = (
            f"{', '.join(done)}{dropped} at {speed:.1f} a second -> {self.output}" if done else "nothing was predicted"
        )
        skipped = f"; {self.skipped} skipped, done already" if self.skipped else ""
        failed = f"; {len(self.failures)} failed" if self.failures else ""
        names = " and ".join(path.name for path in self.partial)
        partial = f"; {names} without the rest: make anew with --overwrite" if names else ""
        return f"{'interrupted: ' if self.interrupted else ''}{what}{skipped}{failed}{partial}"


@one_for_several
def predict(
    *sources: NameOrPath,
    output: StrPath = Path("predictions"),
    model: NameOrPath = "tiny",
    network: str | None = None,
    device: str = "auto",
    backend: str = "auto",
    confidence: float | None = None,
    iou: float | None = None,
    drivable: float | None = None,
    lane: float | None = None,
    format: Sequence[str] = ("json",),
    overlay: bool = True,
    hide: Sequence[str] = (),
    overwrite: bool = False,
    skip_existing: bool = False,
    from_file: StrPath | None = None,
    shard: str | None = None,
    every: int = 1,
    start: float = 0.0,
    end: float | None = None,
    max_frames: int | None = None,
    rate: float = RATE,
    long_side: int | None = None,
    batch_size: int = 4,
    preview: bool = False,
    quiet: bool = False,
    road: bool = False,
    camera: StrPath | None = None,
    track: bool = False,
    smoothing: float = 0.0,
    field_of_view: float | None = None,
    lane_width: float | None = None,
    ego_mask: StrPath | None = None,
) -> PredictReport:
    """Find vehicles, drivable area and lane lines in pictures, folders, videos and streams.

    A source that cannot be read is named at the end, and the others are done all the same. Ctrl-C ends a video or a
    stream cleanly: what was written until then is whole and can be played.

    Args:
        sources: Pictures, videos, folders (the files directly in them), glob patterns, numbered pictures
            (frames/%06d.jpg), RTSP or HTTP URLs, a camera's number (0), - for a video on standard input.
        output: Folder for the results.
        model: Name of shipped weights, a weight file, or an exported artefact of any runtime.
        network: The function that built a weight file's network, where it is one of your own: FILE.py:FUNCTION or
            MODULE:FUNCTION.
        device: auto (the best there is), cpu, cuda, cuda:1, mps.
        backend: auto (what the file is for), or a runtime by name.
        confidence: Keep boxes whose confidence is above this, in [0, 1]; the model's own if left out.
        iou: A box goes when it overlaps a better one by more, in [0, 1]; the model's own if left out.
        drivable: A pixel is drivable above this probability, in [0, 1]; the model's own if left out.
        lane: A pixel is lane marking above this probability, in [0, 1]; the model's own if left out.
        format: Machine-readable results, one or more: json, jsonl, scalabel, openlabel, coco, yolo, cvat, parquet, csv.
        overlay: Write overlays: NAME.jpg for pictures, NAME.mp4 for videos.
        hide: Parts of the overlay to leave out: drivable, lane, boxes, labels; with --road also lines, distances, above
            (the picture from above), status.
        overwrite: Replace results that exist.
        skip_existing: Leave out sources whose results all exist, and do the others anew, as after an interruption; for
            overlays and formats with a file for each source.
        from_file: Text file that names further sources, one a line.
        shard: Do one part of all sources alone, as one of several processes or machines: 0/16 to 15/16. Results are
            called as if one did them all.
        every: Of a video, take every so many frames.
        start: Of a video, begin at so many seconds.
        end: Of a video, stop at so many seconds.
        max_frames: Of a video, take at most so many frames.
        rate: Frames a second of numbered pictures.
        long_side: The longer side of an image is resized to so many pixels.
        batch_size: At most so many images go through the network at once; live sources go one by one.
        preview: Show the overlay in a window while it runs.
        quiet: Show no progress.
        road: Make curves of the lane lines and measure the road in metres: offset, heading, curvature, the vehicle
            ahead, lane departure and collision warnings (advisory only).
        camera: Camera file (YAML) for --road, which it turns on; without it, the camera is estimated from the lanes of
            a video.
        track: Give vehicles an identity over the frames of a video.
        smoothing: Average a video's masks over time so that they flicker less, from 0 (not at all) to below 1; what
            moves lags by 1 frame up to 0.4, 2 frames at 0.5, 4 at 0.7, 13 at 0.9.
        field_of_view: For --road without a camera file: the lens's horizontal field of view in degrees; 60 if left out.
            Many dash-cams have 100 to 140; that lenses bend the edges of pictures takes a camera file.
        lane_width: For --road without a camera file: metres between the lines of a lane; 3.5 if left out.
        ego_mask: Picture of the own car in view (bonnet, dashboard, pillar), white on black, of the shape of the
            camera's pictures: nothing is found there, and the network is shown mirrored road in its place.

    Returns:
        What was done.

    Raises:
        ConfigError: If an option is out of range, or not possible beside another.
        OutputError: If results exist and may not be replaced (told before the work begins), or cannot be written.
    """
    options = RoadOptions(road, camera, track, smoothing, field_of_view, lane_width)
    options.open(still=False)  # what is wrong with them is told before any work
    clip = Clip(every=every, start=start, end=end, max_frames=max_frames)
    plan = Plan(
        [*sources, *(read_list(from_file) if from_file is not None else ())],
        output,
        clip,
        format,
        hide=hide,
        overlay=overlay,
        overwrite=overwrite,
        skip_existing=skip_existing,
        shard=shard,
        rate=rate,
        preview=preview,
        road=options,
    )
    with load(
        model,
        network=network,
        device=device,
        backend=backend,
        confidence=confidence,
        iou=iou,
        drivable=drivable,
        lane=lane,
        long_side=long_side,
        batch_size=batch_size,
        ego_mask=ego_mask,
    ) as predictor:
        return _Run(plan, predictor).run(quiet=quiet)


@one_for_several
def predict_with(
    predictor: Predictor,
    sources: Sequence[str | Path],
    output: StrPath,
    *,
    clip: Clip | None = None,
    format: Sequence[str] = ("json",),
    overlay: bool = True,
    hide: Sequence[str] = (),
    overwrite: bool = False,
    skip_existing: bool = False,
    shard: str | None = None,
    rate: float = RATE,
    preview: bool = False,
    quiet: bool = True,
    road: RoadOptions | None = None,
) -> PredictReport:
    """Do what `predict` does, with a predictor at hand, which is not closed.

    Arguments are as there; ``clip`` says which frames of videos are wanted, ``road`` what is beyond the single frame.
    """
    plan = Plan(
        sources,
        output,
        clip or Clip(),
        format,
        hide=hide,
        overlay=overlay,
        overwrite=overwrite,
        skip_existing=skip_existing,
        shard=shard,
        rate=rate,
        preview=preview,
        road=road or RoadOptions(),
    )
    return _Run(plan, predictor).run(quiet=quiet)


class _Run:
    """What is done of a plan, and what is left of it to report."""

    def __init__(self, plan: Plan, predictor: Predictor) -> None:
        self.plan = plan
        self.predictor = predictor
        self.marks = Marks(plan)
        self.failures = list(plan.failures)
        self.files: list[Path] = []
        self.images = self.videos = self.frames = self.dropped = 0
        self.endless = False
        self.writers: list[Writer] = []
        self.window: Window | None = None

    def run(self, *, quiet: bool) -> PredictReport:
        """Do the work."""
        plan = self.plan
        self.window = Window() if plan.preview else None
        began = time.perf_counter()
        interrupted = False
        with contextlib.ExitStack() as stack:
            stack.enter_context(writing(plan.output))
            stack.callback(self.marks.remove_unfinished)  # once all files have their names
            stack.callback(self.marks.remove_gathered)
            if plan.sources:
                plan.output.mkdir(parents=True, exist_ok=True)
                for name in plan.formats:
                    writer = stack.enter_context(open_writer(name, plan.output, overwrite=plan.overwrite))
                    self.writers.append(writer)
                    for source_name in plan.names:  # the same names as the overlays, whichever source fails
                        writer.stem(source_name)
            columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), _Speed())
            progress = stack.enter_context(show_bars(*columns, TimeRemainingColumn(), quiet=quiet))
            if self.window is not None:
                stack.enter_context(contextlib.closing(self.window))
            many = len(plan.sources) > _MOST_BARS
            all_of_them = progress.add_task("all sources", total=len(plan.sources)) if many else None
            source: Stills | FrameReader | None = None
            try:
                for source in plan.sources:
                    self._run_source(source, progress)
                    if all_of_them is not None:
                        for task in progress.task_ids[1:]:
                            progress.remove_task(task)
                        progress.advance(all_of_them)
                self.marks.whole = True
            except (WindowClosed, KeyboardInterrupt) as error:
                interrupted = isinstance(error, KeyboardInterrupt)
                # A live source that comes last has no other end, and so there is no rest.
                self.marks.whole = self.endless and source is plan.sources[-1]
        return PredictReport(
            images=self.images,
            videos=self.videos,
            frames=self.frames,
            seconds=time.perf_counter() - began,
            failures=tuple(self.failures),
            files=tuple(self.files),
            output=plan.output,
            interrupted=interrupted,
            skipped=plan.skipped,
            partial=self.marks.partial,
            dropped=self.dropped,
        )

    def _run_source(self, source: Stills | FrameReader, progress: Progress) -> None:
        self.endless = False
        if isinstance(source, FrameReader):
            try:
                source.look()
            except InputError as error:
                self.failures.append(Failure(source.name, str(error)))
                return
        self.endless = isinstance(source, FrameReader) and source.live
        name = "images" if isinstance(source, Stills) else PurePath(source.name).name
        total = len(source.paths) if isinstance(source, Stills) else source.expected
        task = progress.add_task(name, total=total)
        video: VideoWriter | None = None
        before = self.frames
        with contextlib.ExitStack() as stack:
            if isinstance(source, FrameReader):
                self.videos += 1
                if self.plan.overlay:
                    rate = None if source.rate is None else source.rate / self.plan.clip.every
                    video = VideoWriter(self.plan.output / f"{self.plan.stems[source.name]}.mp4", rate)
                    stack.enter_context(video)
                stack.callback(self.marks.mark_unfinished, source.name)  # before any of its results has its name
            watching = self.plan.road.open(still=False) if isinstance(source, FrameReader) else None
            stream = stack.enter_context(PerceptionStream(source, self.predictor))
            try:
                for item in stream:
                    if isinstance(item, Failure):
                        self.failures.append(item)
                    else:
                        if video is not None and isinstance(source, FrameReader) and not video.frames:
                            video.pixel_aspect = source.pixel_aspect
                        try:
                            perception, road = follow(item, watching or self.plan.road.open(still=True))
                        except ShapeError as error:  # of another shape than the camera's pictures
                            if isinstance(source, FrameReader):
                                raise InputError(f"{source.name}: {error}") from error
                            self.failures.append(Failure(str(item.source), f"{item.source}: {error}"))
                        else:
                            if isinstance(source, FrameReader):
                                self.marks.begin(source.name)
                            self._take(perception, road, video)
                    progress.advance(task)
                if isinstance(source, FrameReader):
                    # What another run left of other parts of the video stays.
                    for writer in self.writers if self.plan.clip == Clip(every=self.plan.clip.every) else ():
                        writer.remove_remains(source.name)
                    self.marks.finish(source.name)
            except InputError as error:
                assert isinstance(source, FrameReader)
                self.failures.append(Failure(source.name, str(error)))
                self.videos -= self.frames == before
            finally:
                self.dropped += stream.dropped
        if video is not None and video.frames:
            self.files.append(video.path)
        progress.update(task, total=next(bar.completed for bar in progress.tasks if bar.id == task))

    def _take(self, perception: Perception, road: Road | None, video: VideoWriter | None) -> None:
        """Write and draw one perception; an interruption waits, so that no result is a frame ahead of another.

        Raises:
            InputError: If the frames of a video are too large for an overlay; a picture that is becomes a failure.
        """
        with uninterrupted():
            self.marks.mark_gathered()
            for writer in self.writers:
                writer.write(perception, None if road is None else road.to_dict())
            if perception.frame is None:
                self.images += 1
            else:
                self.frames += 1
            if not self.plan.overlay and self.window is None:
                return
            assert perception.image is not None
            # The frame is ours alone from here on: drawing on it saves a copy.
            picture = draw(perception, hide=[part for part in self.plan.hide if part in PARTS], out=perception.image)
            if road is not None:
                draw_road(picture, perception, road, hide=[part for part in self.plan.hide if part in ROAD_PARTS])
            cure = "add --no-overlay for the other results alone"
            if video is not None:
                try:
                    video.write(picture, perception.timestamp)
                except ShapeError as error:
                    raise InputError(f"{perception.source}: an overlay cannot be made ({error}); {cure}") from error
            elif self.plan.overlay and perception.frame is None:
                assert perception.source is not None
                path = self.plan.output / f"{self.plan.stems[perception.source]}.jpg"
                if _write_jpeg(path, picture):
                    self.files.append(path)
                else:
                    height, width = picture.shape[:2]
                    reason = f"an overlay cannot be made (JPEG does not take {width} x {height} pixels); {cure}"
                    self.failures.append(Failure(perception.source, f"{perception.source}: {reason}"))
        if self.window is not None:
            self.window.show(picture)


def _write_jpeg(path: Path, image: NDArray[np.uint8]) -> bool:
    """Write (height, width, 3) uint8 RGB so that the file is whole or not there; False if JPEG cannot hold it."""
    bgr = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    with silent_opencv():
        done, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if done:
        with replacing(path) as part:
            part.write_bytes(data.tobytes())
    return done


class _Speed(ProgressColumn):
    """Frames a second, over the last seconds."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else f"{speed:.1f}/s")
