"""CVAT's XML, version 1.1: upload it to a task and correct there what the network drew.

Formats: https://docs.cvat.ai/docs/dataset_management/formats/format-cvat/. Still images become one file of the kind
*CVAT for images*, with masks as masks; each video becomes one of the kind *CVAT for video*, where CVAT knows no masks
and the areas are polygons. Lines of lanes are polylines. A task needs the labels listed under ``meta``.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any
from xml.sax import saxutils

import numpy as np
from numpy.typing import NDArray

from trilitenet.errors import part_of
from trilitenet.formats.writers.base import Writer, objects, polylines
from trilitenet.processing.polygons import mask_to_polygons
from trilitenet.structures import Perception

__all__ = ["CvatWriter", "cvat_mask"]

_HEAD = '<?xml version="1.0" encoding="utf-8"?>\n<annotations>\n  <version>1.1</version>\n'

_ILLEGAL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
"""Characters that XML 1.0 has no way to hold."""
_LINE = "lane line"
_TOLERANCE = 1.0
"""A polygon of a video leaves the mask's outline by at most so many pixels."""


class CvatWriter(Writer):
    """Writes ``cvat-images.xml`` for the still images and ``NAME.cvat-video.xml`` for each video.

    CVAT lists a video by track, not by frame, so the shapes of one video are held until it ends: about 4 KB a frame,
    and 300 bytes a box without a track.
    """

    PICTURE_FILES = ("cvat-images.xml",)
    VIDEO_FILES = ("{}.cvat-video.xml",)

    def __init__(self, output: Path, *, overwrite: bool = False) -> None:
        super().__init__(output, overwrite=overwrite)
        self._images: _ImagesFile | None = None
        self._video: _VideoFile | None = None

    def _write(self, perception: Perception, road: Mapping[str, Any] | None = None) -> None:
        """Write one image, or keep one frame of a video."""
        if perception.frame is None:
            self._close_video()
            if self._images is None:
                self._images = _ImagesFile(self.create("cvat-images.xml"), perception)
            self._images.add(perception, self.image_name(perception), road)
            return
        if self._video is None or self._video.source != perception.source:
            self._close_video()
            self._video = _VideoFile(self.create(f"{self.stem(perception.source)}.cvat-video.xml"), perception)
        self._video.add(perception, road)

    def _close(self) -> None:
        """Finish the files."""
        self._close_video()
        if self._images is not None:
            self._images.close()
            self.finish(self._images.path)
            self._images = None

    def _close_video(self) -> None:
        if self._video is not None:
            with part_of(self._video.path).open("w", encoding="utf-8") as handle:
                self._video.dump(handle)
            self.finish(self._video.path)
            self._video = None


def cvat_mask(mask: NDArray[np.bool_]) -> tuple[str, int, int, int, int] | None:
    """Encode a mask as CVAT does.

    Args:
        mask: (H, W) bool.

    Returns:
        Run lengths within the bounding box (row by row, the first run is background), and its left, top, width and
        height in pixels; None for an empty mask.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    top, left = int(rows[0]), int(columns[0])
    inside = mask[top : rows[-1] + 1, left : columns[-1] + 1]
    flat = inside.reshape(-1)
    edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    runs = np.diff(np.concatenate([[0], edges, [len(flat)]]))
    text = ", ".join(str(run) for run in ([0, *runs] if flat[0] else runs))
    return text, left, top, inside.shape[1], inside.shape[0]


def _held(text: str) -> str:
    """Return a text with what XML cannot hold as Python writes it, so that one name does not spoil a whole file."""
    return _ILLEGAL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def _quoted(text: str) -> str:
    return saxutils.quoteattr(_held(text))


def _labels(perception: Perception) -> str:
    """Return the labels that results like this one need, as CVAT's ``meta`` lists them."""
    names = [] if perception.boxes is None else [*perception.class_names]
    names += [] if perception.drivable is None else ["drivable"]
    names += [] if perception.lane is None else ["lane", _LINE]
    label = (
        "        <label><name>{}</name><type>any</type><attributes><attribute><name>confidence</name>"
        "<mutable>True</mutable><input_type>text</input_type><default_value></default_value><values></values>"
        "</attribute></attributes></label>\n"
    )
    return (
        "      <labels>\n" + "".join(label.format(saxutils.escape(_held(name))) for name in names) + "      </labels>\n"
    )


def _points(points: list[list[float]]) -> str:
    return ";".join(f"{x:.2f},{y:.2f}" for x, y in points)


def _corners(box: NDArray[np.float32]) -> str:
    return 'xtl="{:.2f}" ytl="{:.2f}" xbr="{:.2f}" ybr="{:.2f}"'.format(*box.tolist())


def _confidence(score: float) -> str:
    return f'<attribute name="confidence">{score:.3f}</attribute>'


class _ImagesFile:
    """A file of the kind *CVAT for images*, written as it comes."""

    def __init__(self, path: Path, first: Perception) -> None:
        self.path = path
        self.count = 0
        self._handle: IO[str] = part_of(path).open("w", encoding="utf-8")
        self._handle.write(f"{_HEAD}  <meta>\n    <task>\n{_labels(first)}    </task>\n  </meta>\n")

    def add(self, perception: Perception, name: str, road: Mapping[str, Any] | None) -> None:
        height, width = perception.size
        write = self._handle.write
        write(f'  <image id="{self.count}" name={_quoted(name)} width="{width}" height="{height}">\n')
        for label, mask in (("drivable", perception.drivable), ("lane", perception.lane)):
            encoded = None if mask is None else cvat_mask(mask)
            if encoded is not None:
                runs, left, top, mask_width, mask_height = encoded
                write(
                    f'    <mask label="{label}" source="auto" occluded="0" rle="{runs}" left="{left}" top="{top}" '
                    f'width="{mask_width}" height="{mask_height}" z_order="0"></mask>\n'
                )
        for found in objects(perception):
            write(
                f'    <box label={_quoted(found.name)} source="auto" occluded="0" '
                f'{_corners(found.corners)} z_order="1">{_confidence(found.confidence)}</box>\n'
            )
        for _, points in polylines(road):
            write(
                f'    <polyline label="{_LINE}" source="auto" occluded="0" points="{_points(points)}" '
                'z_order="1"></polyline>\n'
            )
        write("  </image>\n")
        self.count += 1

    def close(self) -> None:
        with self._handle as handle:
            handle.write("</annotations>\n")


@dataclasses.dataclass(slots=True)
class _Track:
    """One ``<track>``: what is inside each shape, by frame."""

    label: str
    shape: str
    shapes: dict[int, tuple[str, str]] = dataclasses.field(default_factory=dict)

    def lines(self, following: Mapping[int, int]) -> Iterator[str]:
        """Yield the shapes; in the frame where the track is gone, one marked ``outside`` hides it."""
        for frame, (attributes, inside) in self.shapes.items():
            yield self._line(frame, attributes, inside, outside=0)
            after = following.get(frame)
            if after is not None and after not in self.shapes:
                yield self._line(after, attributes, inside, outside=1)

    def _line(self, frame: int, attributes: str, inside: str, outside: int) -> str:
        return (
            f'    <{self.shape} frame="{frame}" keyframe="1" outside="{outside}" occluded="0" {attributes} '
            f'z_order="{int(self.shape != "polygon")}">{inside}</{self.shape}>\n'
        )


class _VideoFile:
    """A file of the kind *CVAT for video*: shapes are gathered by track, and written at the end.

    The n-th largest region of each frame makes the n-th track of its label; a box without identity is a track of one
    frame.
    """

    def __init__(self, path: Path, first: Perception) -> None:
        self.path = path
        self.source = first.source
        self._first = first
        self._frames: list[int] = []
        self._tracks: dict[object, _Track] = {}

    def add(self, perception: Perception, road: Mapping[str, Any] | None) -> None:
        frame = perception.frame or 0
        self._frames.append(frame)
        for label, mask in (("drivable", perception.drivable), ("lane", perception.lane)):
            polygons = [] if mask is None else mask_to_polygons(mask, tolerance=_TOLERANCE)
            for rank, polygon in enumerate(polygons):
                track = self._tracks.setdefault((label, rank), _Track(label, "polygon"))
                track.shapes[frame] = (f'points="{_points((polygon + 0.5).tolist())}"', "")
        for identity, points in polylines(road):
            track = self._tracks.setdefault((_LINE, identity), _Track(_LINE, "polyline"))
            track.shapes[frame] = (f'points="{_points(points)}"', "")
        for index, found in enumerate(objects(perception)):
            key = ("box", found.name, found.track_id) if found.track_id >= 0 else ("box", frame, index)
            track = self._tracks.setdefault(key, _Track(found.name, "box"))
            track.shapes[frame] = (_corners(found.corners), _confidence(found.confidence))

    def dump(self, handle: IO[str]) -> None:
        height, width = self._first.size
        last = self._frames[-1]
        following = dict(zip(self._frames, self._frames[1:], strict=False))
        handle.write(f"{_HEAD}  <meta>\n    <task>\n      <size>{last + 1}</size>\n")
        handle.write("      <mode>interpolation</mode>\n      <start_frame>0</start_frame>\n")
        handle.write(f"      <stop_frame>{last}</stop_frame>\n{_labels(self._first)}")
        handle.write(f"      <original_size><width>{width}</width><height>{height}</height></original_size>\n")
        handle.write("    </task>\n  </meta>\n")
        for number, track in enumerate(self._tracks.values()):
            handle.write(f'  <track id="{number}" label={_quoted(track.label)} source="auto">\n')
            handle.writelines(track.lines(following))
            handle.write("  </track>\n")
        handle.write("</annotations>\n")
