"""What `predict` is to do: its sources, the names of their results, and what is refused before any work begins."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path, PurePath
from typing import Final

from trilitenet.commands.paths import StrPath
from trilitenet.commands.predict_road import RoadOptions
from trilitenet.errors import LONGEST_NAME, ConfigError, FreeNames, InputError, OutputError, part_of, shown
from trilitenet.formats.writers.base import Writer, file_stem, find_writer
from trilitenet.inference.sources import Clip, Failure, FrameReader, SequenceReader, Stills, find_sources
from trilitenet.processing.drawing import PARTS, check_parts
from trilitenet.road.drawing import ROAD_PARTS

__all__ = ["RATE", "Plan", "mark_of", "read_list", "read_mark"]

_LOGGER: Final = logging.getLogger(__name__)

RATE: Final = 30.0
"""Frames a second of numbered pictures, unless others are asked for."""
_HEAD: Final = 65536
"""Bytes of a JSON file in which its source is named, though the file may be as long as a video."""


class Plan:
    """Sources and the names of their results; made, and refused, before any work begins.

    What is given is as in `predict`.

    Attributes:
        sources: What is left to do of what was given.
        failures: What cannot be used, and why.
        names: The names of all sources, and of the pictures among them, whether they are left to do or not.
        stems: The file name without ending of the results of each.
        formats: The names of the formats, each once.
        overwrite: Whether results that exist are replaced.
        skipped: How many sources were left out because their results exist.
        gathered: The files that hold what is of all sources.

    Raises:
        ConfigError: If an option is out of range, or not possible beside another.
        InputError: If no source is given.
        OutputError: If results exist and may not be replaced, or two would have one name.
        MissingExtraError: If a format needs a package that is not installed.
    """

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
        self._check_files()
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
        if rate != RATE and not any(isinstance(source, SequenceReader) for source in self.sources):
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
            if self._is_unfinished(source, name) or not all(path.exists() for path in self.files(source, name))
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

    def files(self, source: Stills | FrameReader, name: str) -> list[Path]:
        """Return the files that are a source's alone."""
        patterns = [pattern for each in self.formats for pattern in _patterns(find_writer(each), source)]
        if self.overlay:
            patterns.append(_overlay(source))
        return [self.output / pattern.format(self.stems[name]) for pattern in patterns]

    def _is_unfinished(self, source: Stills | FrameReader, name: str) -> bool:
        """Return whether a mark says that files of a source, of those that this run would write, lack some frames."""
        marked = read_mark(self.mark(name))
        return marked is not None and (not marked or not marked.isdisjoint(self.files(source, name)))

    def mark(self, name: str) -> Path:
        """Return the file that is there while the results of a video are not of all its frames."""
        return mark_of(self.output / self.stems[name])

    def _shared(self) -> Iterator[tuple[str, bool]]:
        """Yield the names of the files that are one for all sources, and whether they hold what is of each."""
        for name in self.formats:
            writer = find_writer(name)
            patterns = {pattern for source in self.sources for pattern in _patterns(writer, source)}
            files = [pattern for pattern in (*writer.FILES, *sorted(patterns)) if "{}" not in pattern]
            yield from ((file, writer.GATHERS) for file in files)

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

    def _check_files(self) -> None:
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
        overlays = [
            _overlay(source).format(self.stems[name])
            for source in (self.sources if self.overlay else ())
            for name in _names(source)
        ]
        found = [self.output / file for file in (*overlays, *planned) if (self.output / file).exists()]
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


def read_list(path: StrPath) -> list[str]:
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


def mark_of(file: Path) -> Path:
    """Return the file that is there while another lacks some of what it should hold."""
    return part_of(file.with_name(f"{file.name}.unfinished"))


def read_mark(mark: Path) -> frozenset[Path] | None:
    """Return the files that a mark names; none if it names none, and may be of any; None if it is not there."""
    if not mark.exists():
        return None
    try:
        return frozenset(mark.parent / name for name in json.loads(mark.read_text(encoding="utf-8")))
    except (OSError, TypeError, ValueError):
        return frozenset()


def _names(source: Stills | FrameReader) -> list[str]:
    return [str(path) for path in source.paths] if isinstance(source, Stills) else [source.name]


def _patterns(writer: type[Writer], source: Stills | FrameReader) -> tuple[str, ...]:
    return writer.PICTURE_FILES if isinstance(source, Stills) else writer.VIDEO_FILES


def _overlay(source: Stills | FrameReader) -> str:
    return "{}.jpg" if isinstance(source, Stills) else "{}.mp4"


def _numbered(file: str) -> str:
    """Return the name of a frame's file with ``*`` for its number, any other as it is."""
    return re.sub(r"-\d{7,}(\.\w+)$", r"-*\1", file)  # a frame has seven digits at least


def _allot_stems(names: Sequence[str]) -> dict[str, str]:
    """Return a file name without ending for each source; the second ``a`` becomes ``a-2``."""
    free = FreeNames(files=True)
    return {name: free.give(file_stem(name)) for name in dict.fromkeys(names)}
