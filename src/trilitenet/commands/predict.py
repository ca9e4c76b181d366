"""Predict on pictures, folders, videos and streams, and leave overlays and machine-readable files."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import logging
import os
import re
import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path, PurePath
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from trilitenet.commands.load import load
from trilitenet.commands.paths import NameOrPath, StrPath, one_for_several
from trilitenet.commands.progress import show_bars
from trilitenet.errors import (
    LONGEST_NAME,
    BackendError,
    ConfigError,
    FreeNames,
    InputError,
    OutputError,
    ShapeError,
    part_of,
    replacing,
    shown,
    writing,
)
from trilitenet.formats.writers.base import Writer, file_stem, find_writer, open_writer, uninterrupted
from trilitenet.inference.predictor import Predictor
from trilitenet.inference.sources import (
    Clip,
    Failure,
    FrameReader,
    SequenceReader,
    Stills,
    find_sources,
    silent_opencv,
)
from trilitenet.inference.video import PerceptionStream, VideoWriter
from trilitenet.processing.drawing import PARTS, check_parts, draw
from trilitenet.processing.geometry import Camera
from trilitenet.road.camera import read_camera
from trilitenet.road.drawing import ROAD_PARTS, draw_road
from trilitenet.road.monitor import RoadMonitor
from trilitenet.road.structures import Road
from trilitenet.road.tracking import Steady
from trilitenet.structures import Perception

__all__ = ["PredictReport", "RoadOptions", "predict", "predict_with"]

_LOGGER: Final = logging.getLogger(__name__)
_HEAD: Final = 65536
"""Bytes of a JSON file in which its source is named, though the file may be as long as a video."""
_JPEG_QUALITY: Final = 92
"""Of overlays on pictures, of 100."""
_RATE: Final = 30.0
"""Frames a second of numbered pictures, unless others are asked for."""
_MOST_BARS: Final = 10
"""Of more sources than these, only the bar of the one at hand is shown, below that of all."""


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
    rate: float = _RATE,
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
        sources: Pictures, videos, folders, glob patterns, numbered pictures (frames/%06d.jpg), RTSP or HTTP URLs, a
            camera's number (0), - for a video on standard input.
        output: Folder for the results.
        model: Name of shipped weights, a weight file, or an exported artefact of any runtime.
        network: The function that built a weight file's network, where it is one of your own: FILE.py:FUNCTION or
            MODULE:FUNCTION.
        device: auto (the best there is), cpu, cuda, cuda:1, mps.
        backend: auto (what the file is for), or a runtime by name.
        confidence: Keep boxes whose confidence is above this, in [0, 1]; the model's own if left out.
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
    job = _Job(
        [*sources, *(_read_list(from_file) if from_file is not None else ())],
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
        long_side=long_side,
        batch_size=batch_size,
        ego_mask=ego_mask,
    ) as predictor:
        return job.run(predictor, quiet=quiet)


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
    rate: float = _RATE,
    preview: bool = False,
    quiet: bool = True,
    road: RoadOptions | None = None,
) -> PredictReport:
    """Do what `predict` does, with a predictor at hand, which is not closed.

    Arguments are as there; ``clip`` says which frames of videos are wanted, ``road`` what is beyond the single frame.
    """
    job = _Job(
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
    return job.run(predictor, quiet=quiet)


class _Job:
    """Sources and the names of their results; made, and refused, before any work begins."""

    def __init__(
        self,
        sources: Sequence[str | Path],
        output: StrPath,
        clip: Clip,
        formats: Sequence[str],
        *,
        hide: Sequence[str],
        overlay: bool,
        overwrite: bool,
        skip_existing: bool,
        shard: str | None,
        rate: float,
        preview: bool,
        road: RoadOptions,
    ) -> None:
        _check_hide(hide, drawn=overlay or preview, road=road.wanted)
        if overwrite and skip_existing:
            raise ConfigError("--skip-existing and --overwrite exclude each other; choose one")
        if not sources:
            raise InputError("no source was given: name a picture, a folder, a video, a URL or a camera's number")
        self.output = Path(output)
        self.overlay = overlay
        self.hide = hide
        self.preview = preview
        self.road = road
        self.clip = clip
        part = _parse_shard(shard)
        self.sources, self.failures = find_sources(sources, clip, rate=rate, unopened=True)
        if part is None or part[0] == 0:
            self._tell_idle_options(rate)
        self.formats = tuple(dict.fromkeys(formats))
        self.overwrite = overwrite or skip_existing  # then what exists is of a source that is done anew
        self.names = self._left()
        self.stems = _allot_stems(self.names)
        self._leave_out_long_names()
        if part is not None:
            self._keep_shard(*part)
        self.skipped = self._leave_out_done() if skip_existing else 0
        self._check_output()
        self._check_formats()
        self.writers: list[Writer] = []
        self.images = self.videos = self.frames = self.dropped = 0
        self.files: list[Path] = []
        self.unfinished: dict[str, bool] = {}
        self.marked = self.whole = self.endless = False
        self.gathered = [self.output / file for file, holds in self._shared() if holds]

    def _tell_idle_options(self, rate: float) -> None:
        """Warn of options for videos alone where there is none, not even among what cannot be used."""
        if not self.sources or self.failures:
            return
        fields = dataclasses.fields(Clip)
        idle = [field.name for field in fields if getattr(self.clip, field.name) != field.default]
        idle += [name for name in ("track", "smoothing") if getattr(self.road, name)]
        if idle and not any(isinstance(source, FrameReader) for source in self.sources):
            names = " and ".join(f"--{name.replace('_', '-')}" for name in idle)
            _LOGGER.warning("%s without effect: no source is a video", names)
        if rate != _RATE and not any(isinstance(source, SequenceReader) for source in self.sources):
            _LOGGER.warning("--rate without effect: no source is numbered pictures, such as frames/%06d.jpg")

    def _leave_out_long_names(self) -> None:
        """Make a source whose results would have longer names than file systems take a failure of its own."""
        fitting: set[str] = set()
        for source in self.sources:
            patterns = [pattern for name in self.formats for pattern in _patterns(find_writer(name), source)]
            endings = [PurePath(pattern).name.replace("*", "0000000").format("") for pattern in patterns]
            longest = max(map(len, [".jpg", *endings]))
            reason = "its name is too long for the names of its results; rename it"
            for name in _names(source):
                if len(os.fsencode(self.stems[name])) + longest <= LONGEST_NAME:
                    fitting.add(name)
                else:
                    self.failures.append(Failure(name, f"{name}: {reason}"))
        self._keep(fitting)

    def _keep_shard(self, index: int, count: int) -> None:
        """Leave out what other shards do, every so many-th source; what cannot be used is told by the first."""
        self._keep(set(self.names[index::count]))
        if index:
            self.failures.clear()

    def _leave_out_done(self) -> int:
        """Leave out the sources whose results are all there and whole, and return how many.

        Raises:
            ConfigError: If a format gathers several sources in one file.
            OutputError: If results that are there say that they are of another source of the same name.
        """
        for file, _ in self._shared():
            raise ConfigError(
                f"--skip-existing needs formats with a file for each source, and {file} is one for all; choose another "
                "--format, or --overwrite"
            )
        if "json" in self.formats:
            for name in self._left():
                _check_source(self.output / f"{self.stems[name]}.json", name)
        left = {
            name
            for source in self.sources
            for name in _names(source)
            if self._mark(name).exists() or not all(path.exists() for path in self._files(source, name))
        }
        before = len(self._left())
        self._keep(left)
        return before - len(left)

    def _left(self) -> list[str]:
        """Return the names of the sources, and of the pictures among them, that are to be done."""
        return [name for source in self.sources for name in _names(source)]

    def _keep(self, names: Collection[str]) -> None:
        """Leave out the sources, and the pictures among them, of other names."""
        sources: list[Stills | FrameReader] = []
        for source in self.sources:
            if isinstance(source, Stills):
                source = Stills(tuple(path for path in source.paths if str(path) in names))
            if any(name in names for name in _names(source)):
                sources.append(source)
        self.sources = sources

    def _files(self, source: Stills | FrameReader, name: str) -> list[Path]:
        """Return the files that are a source's alone."""
        patterns = [pattern for each in self.formats for pattern in _patterns(find_writer(each), source)]
        if self.overlay:
            patterns.append("{}.jpg" if isinstance(source, Stills) else "{}.mp4")
        return [self.output / pattern.format(self.stems[name]) for pattern in patterns]

    def _mark(self, name: str) -> Path:
        """Return the file that is there while the results of a video are not of all its frames."""
        return part_of(self.output / f"{self.stems[name]}.unfinished")

    def _shared(self) -> Iterator[tuple[str, bool]]:
        """Yield the names of the files that are one for all sources, and whether they hold what is of each."""
        for name in self.formats:
            writer = find_writer(name)
            patterns = {pattern for source in self.sources for pattern in _patterns(writer, source)}
            files = [pattern for pattern in (*writer.FILES, *sorted(patterns)) if "{}" not in pattern]
            yield from ((file, writer.GATHERS) for file in files)

    def _mark_gathered(self) -> None:
        """Leave the marks of the files of all sources, which hold but some of them until the run's end."""
        self.marked = True
        for file in self.gathered:
            with writing(file):
                _mark_of(file).touch()

    def _remove_gathered_marks(self) -> None:
        """Remove the marks of files that hold all sources, and of those that were not written."""
        for file in self.gathered if self.marked else ():
            if self.whole or not file.exists():
                with writing(file):
                    _mark_of(file).unlink(missing_ok=True)

    def _mark_unfinished(self, name: str) -> None:
        """Leave the mark of a video that was not done to its end."""
        if self.unfinished.get(name):
            self._mark(name).touch()

    def _remove_marks(self) -> None:
        """Remove the marks of videos that were done to their end, and of those that have no results."""
        for source in self.sources:
            if isinstance(source, FrameReader) and source.name in self.unfinished:
                mark = self._mark(source.name)
                if not (self.unfinished[source.name] and any(map(Path.exists, self._files(source, source.name)))):
                    with writing(mark):
                        mark.unlink(missing_ok=True)

    def _check_output(self) -> None:
        if self.output.exists() and not self.output.is_dir():
            raise OutputError(f"{self.output}: is a file; give a folder for --output")
        stems = {self.stems[name] for name in self._left()}
        folders = [folder for folder in (self.output, self.output / "labels") if folder.is_dir()]
        alike = [
            path for folder in folders for path in sorted(folder.iterdir()) if path.stem in stems and path.is_file()
        ]
        originals = {Path(name).resolve() for name in self.names if Path(name).exists()} if alike else set()
        for path in alike:
            if path.resolve() in originals:
                raise OutputError(f"{path}: results would lie beside their source; choose another --output")
            if not self.overwrite:
                raise OutputError(f"{path}: exists already; choose another --output or add --overwrite")

    def _check_formats(self) -> None:
        """Refuse formats that do not exist, and files that exist or would be written twice."""
        planned: dict[str, str] = {}
        for file, what in sorted(self._plan(), key=lambda one: "*" not in one[0]):
            for taken in {file, _numbered(file)} & planned.keys():
                raise OutputError(
                    f"{self.output / file} would be written twice, {planned[taken]} and {what}; "
                    "rename a source, or give the formats an --output each"
                )
            planned[file] = what
        if self.overwrite:
            return
        found = [self.output / file for file in planned if (self.output / file).exists()]
        for folder in {(self.output / file).parent for file in planned if "*" in file}:
            for path in folder.iterdir() if folder.is_dir() else ():
                if _numbered(path.relative_to(self.output).as_posix()) in planned:
                    found.append(path)
        if found:
            raise OutputError(f"{found[0]}: exists already; choose another --output or add --overwrite")

    def _plan(self) -> Iterator[tuple[str, str]]:
        """Yield each file that the formats will write, ``*`` for a number a frame, and what it is."""
        for name in self.formats:
            writer = find_writer(name)
            files = dict.fromkeys(writer.FILES, "everything")
            for source in self.sources:
                patterns = _patterns(writer, source)
                files |= {pattern.format(self.stems[each]): each for pattern in patterns for each in _names(source)}
            yield from ((file, f"as {name} of {each}") for file, each in files.items())

    def run(self, predictor: Predictor, *, quiet: bool) -> PredictReport:
        """Do the work."""
        self.window = _Window() if self.preview else None
        began = time.perf_counter()
        interrupted = False
        with contextlib.ExitStack() as stack:
            stack.enter_context(writing(self.output))
            stack.callback(self._remove_marks)  # once all files have their names
            stack.callback(self._remove_gathered_marks)
            if self.sources:
                self.output.mkdir(parents=True, exist_ok=True)
                for name in self.formats:
                    writer = stack.enter_context(open_writer(name, self.output, overwrite=self.overwrite))
                    self.writers.append(writer)
                    for source_name in self.names:  # the same names as the overlays, whichever source fails
                        writer.stem(source_name)
            columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), _Speed())
            progress = stack.enter_context(show_bars(*columns, TimeRemainingColumn(), quiet=quiet))
            if self.window is not None:
                stack.enter_context(contextlib.closing(self.window))
            many = len(self.sources) > _MOST_BARS
            all_of_them = progress.add_task("all sources", total=len(self.sources)) if many else None
            source: Stills | FrameReader | None = None
            try:
                for source in self.sources:
                    self._run_source(source, predictor, progress)
                    if all_of_them is not None:
                        for task in progress.task_ids[1:]:
                            progress.remove_task(task)
                        progress.advance(all_of_them)
                self.whole = True
            except (_WindowClosed, KeyboardInterrupt) as error:
                interrupted = isinstance(error, KeyboardInterrupt)
                # A live source that comes last has no other end, and so there is no rest.
                self.whole = self.endless and source is self.sources[-1]
        return PredictReport(
            images=self.images,
            videos=self.videos,
            frames=self.frames,
            seconds=time.perf_counter() - began,
            failures=tuple(self.failures),
            files=tuple(self.files),
            output=self.output,
            interrupted=interrupted,
            skipped=self.skipped,
            partial=tuple(self.gathered) if self.marked and not self.whole else (),
            dropped=self.dropped,
        )

    def _run_source(self, source: Stills | FrameReader, predictor: Predictor, progress: Progress) -> None:
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
                if self.overlay:
                    rate = None if source.rate is None else source.rate / self.clip.every
                    video = VideoWriter(self.output / f"{self.stems[source.name]}.mp4", rate)
                    stack.enter_context(video)
                stack.callback(self._mark_unfinished, source.name)  # before any of its results has its name
            follow = self.road.open(still=False) if isinstance(source, FrameReader) else None
            stream = stack.enter_context(PerceptionStream(source, predictor))
            try:
                for item in stream:
                    if isinstance(item, Failure):
                        self.failures.append(item)
                    else:
                        if video is not None and isinstance(source, FrameReader) and not video.frames:
                            video.pixel_aspect = source.pixel_aspect
                        try:
                            perception, road = _follow(item, follow or self.road.open(still=True))
                        except ShapeError as error:  # of another shape than the camera's pictures
                            if isinstance(source, FrameReader):
                                raise InputError(f"{source.name}: {error}") from error
                            self.failures.append(Failure(str(item.source), f"{item.source}: {error}"))
                        else:
                            if isinstance(source, FrameReader):
                                self.unfinished[source.name] = True
                            self._take(perception, road, video)
                    progress.advance(task)
                if isinstance(source, FrameReader):
                    # What another run left of other parts of the video stays.
                    for writer in self.writers if self.clip == Clip(every=self.clip.every) else ():
                        writer.remove_remains(source.name)
                    self.unfinished[source.name] = False
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
            if not self.marked:
                self._mark_gathered()
            for writer in self.writers:
                writer.write(perception, None if road is None else road.to_dict())
            if perception.frame is None:
                self.images += 1
            else:
                self.frames += 1
            if not self.overlay and self.window is None:
                return
            assert perception.image is not None
            # The frame is ours alone from here on: drawing on it saves a copy.
            picture = draw(perception, hide=[part for part in self.hide if part in PARTS], out=perception.image)
            if road is not None:
                draw_road(picture, perception, road, hide=[part for part in self.hide if part in ROAD_PARTS])
            cure = "add --no-overlay for the other results alone"
            if video is not None:
                try:
                    video.write(picture, perception.timestamp)
                except ShapeError as error:
                    raise InputError(f"{perception.source}: an overlay cannot be made ({error}); {cure}") from error
            elif self.overlay and perception.frame is None:
                assert perception.source is not None
                path = self.output / f"{self.stems[perception.source]}.jpg"
                if _write_jpeg(path, picture):
                    self.files.append(path)
                else:
                    height, width = picture.shape[:2]
                    reason = f"an overlay cannot be made (JPEG does not take {width} x {height} pixels); {cure}"
                    self.failures.append(Failure(perception.source, f"{perception.source}: {reason}"))
        if self.window is not None:
            self.window.show(picture)


def _follow(perception: Perception, parts: tuple[Steady | None, RoadMonitor | None]) -> tuple[Perception, Road | None]:
    """Return a perception with what its video adds to it, and its road, which smoothed masks would blur in time."""
    steady, monitor = parts
    drivable, lane = perception.drivable, perception.lane
    if steady is not None:
        perception = steady(perception)
    if monitor is None:
        return perception, None
    return perception, monitor(dataclasses.replace(perception, drivable=drivable, lane=lane))


def _check_hide(hide: Sequence[str], *, drawn: bool, road: bool) -> None:
    """Check which parts of the overlay are to be left out.

    Raises:
        ConfigError: If one does not exist, or would not be drawn anyway.
    """
    check_parts(hide, PARTS + ROAD_PARTS)
    if hide and not drawn:
        raise ConfigError("--hide would change nothing: with --no-overlay nothing is drawn")
    idle = [part for part in hide if part in ROAD_PARTS]
    if idle and not road:
        raise ConfigError(f"--hide {' '.join(idle)} would change nothing: that is for --road")


def _read_list(path: StrPath) -> list[str]:
    """Return the lines of a text file that are not empty.

    Raises:
        InputError: If it cannot be read, or names nothing.
    """
    try:
        names = [line for line in map(str.strip, Path(path).read_text(encoding="utf-8-sig").splitlines()) if line]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text ({getattr(error, 'strerror', None) or error})") from error
    if not names:
        raise InputError(f"{path}: names no source; write one a line")
    return names


def _parse_shard(shard: str | None) -> tuple[int, int] | None:
    """Return the number of a shard and how many there are.

    Raises:
        ConfigError: If it is none.
    """
    if shard is None:
        return None
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", shard)
    if found is None or not int(found[1]) < int(found[2]):
        raise ConfigError(f"--shard must be I/N with I from 0 to N - 1, such as 0/16, got {shown(shard)}")
    return int(found[1]), int(found[2])


def _check_source(path: Path, name: str) -> None:
    """Refuse results in JSON of another file than the source called ``name``, where both are there to compare.

    Raises:
        OutputError: If they are.
    """
    if not path.is_file():
        return
    with path.open("rb", buffering=0) as file:
        found = re.match(rb'{"schema": "[^"]*", "source": ("(?:[^"\\]|\\.)*")', file.read(_HEAD))
    told = json.loads(found[1]) if found else name
    if told == name:  # as for nearly all of a million pictures
        return
    other = Path(told)
    if other.exists() and Path(name).exists() and not other.samefile(name):
        raise OutputError(
            f"{path}: is of {other}, not of {name}; name the same sources in the same order as before, "
            "or another --output"
        )


def _mark_of(file: Path) -> Path:
    """Return the file that is there while one of several sources lacks some of them."""
    return part_of(file.with_name(f"{file.name}.unfinished"))


def _names(source: Stills | FrameReader) -> list[str]:
    return [str(path) for path in source.paths] if isinstance(source, Stills) else [source.name]


def _patterns(writer: type[Writer], source: Stills | FrameReader) -> tuple[str, ...]:
    return writer.PICTURE_FILES if isinstance(source, Stills) else writer.VIDEO_FILES


def _numbered(file: str) -> str:
    """Return the name of a frame's file with ``*`` for its number, any other as it is."""
    return re.sub(r"-\d{7,}(\.\w+)$", r"-*\1", file)  # a frame has seven digits at least


def _allot_stems(names: Sequence[str]) -> dict[str, str]:
    """Return a file name without ending for each source; the second ``a`` becomes ``a-2``."""
    free = FreeNames(files=True)
    return {name: free.give(file_stem(name)) for name in dict.fromkeys(names)}


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


class _WindowClosed(Exception):  # noqa: N818 - a request, not an error
    """The user closed the preview."""


class _Window:
    """The live preview; q or Escape ends the run."""

    _TITLE = "trilitenet"

    def __init__(self) -> None:
        try:
            cv2.namedWindow(self._TITLE, cv2.WINDOW_NORMAL)
        except cv2.error as error:
            raise BackendError(
                "this OpenCV has no windows; for --preview: pip uninstall opencv-python-headless, then "
                "pip install opencv-python"
            ) from error

    def show(self, image: NDArray[np.uint8]) -> None:
        cv2.imshow(self._TITLE, cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        if cv2.waitKey(1) & 0xFF in (ord("q"), 27):
            raise _WindowClosed

    def close(self) -> None:
        cv2.destroyWindow(self._TITLE)
