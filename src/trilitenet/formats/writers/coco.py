"""COCO's annotation file: pictures, boxes and run-length masks in one JSON.

Format: https://cocodataset.org/#format-data, with ``score`` as in its results format.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trilitenet.formats.writers.base import JsonStream, Writer, dumps, objects, rounded
from trilitenet.processing.serialise import encode_mask
from trilitenet.structures import Perception

__all__ = ["CocoWriter"]


class CocoWriter(Writer):
    """Writes ``coco.json``.

    The classes have the category ids 1, 2, ...; after them come ``drivable`` and ``lane``, whose annotations are one
    run-length mask an image. A task that no perception has, has no categories: it was not looked for. Tracks are
    numbered over all videos of the file, those of the first as they are. The list of images is held until the end:
    about 400 bytes a frame, 300 a picture.
    """

    FILES = ("coco.json",)

    def __init__(self, output: Path, *, overwrite: bool = False) -> None:
        super().__init__(output, overwrite=overwrite)
        head = f'{{"info": {dumps({"description": "Written by trilitenet", "version": "1.0"})},\n"annotations": ['
        self._stream: JsonStream | None = JsonStream(self.create("coco.json"), head)
        self._images: list[dict[str, Any]] = []
        self._videos: dict[str | None, tuple[int, str]] = {}
        self._tracks: dict[tuple[int, int], int] = {}
        self._track_ids: set[int] = set()
        self._highest = 0
        self._class_names: tuple[str, ...] = ()
        self._tasks: set[str] = set()
        self._annotations = 0

    def _write(self, perception: Perception, road: Mapping[str, Any] | None = None) -> None:
        """Write the annotations of one image."""
        height, width = perception.size
        self._class_names = perception.class_names
        image_id = len(self._images) + 1
        file_name = self.image_name(perception)
        image: dict[str, Any] = {"id": image_id, "file_name": file_name, "width": width, "height": height}
        video = 0
        if perception.frame is not None:
            named = len(self._videos) + 1, self.stem(perception.source)
            video, _ = self._videos.setdefault(perception.source, named)
            image |= {"video_id": video, "frame_id": perception.frame}
        self._images.append(image)
        masks = {"drivable": perception.drivable, "lane": perception.lane}
        results = {"detection": perception.boxes, **masks}
        self._tasks |= {task for task, result in results.items() if result is not None}
        for found in objects(perception):
            left, top, right, bottom = rounded(found.corners)
            sides = [round(right - left, 2), round(bottom - top, 2)]
            annotation: dict[str, Any] = {
                "category_id": found.class_id + 1,
                "bbox": [left, top, *sides],
                "area": round(sides[0] * sides[1], 2),
                "segmentation": [],
                "score": round(found.confidence, 4),
            }
            if found.track_id >= 0:
                annotation["track_id"] = self._track(video, found.track_id)
            self._add(image_id, annotation)
        for place, mask in enumerate(masks.values(), start=1):
            if mask is None or not mask.any():
                continue
            rows, columns = mask.any(axis=1).nonzero()[0], mask.any(axis=0).nonzero()[0]
            left, top = int(columns[0]), int(rows[0])
            self._add(
                image_id,
                {
                    "category_id": len(self._class_names) + place,
                    "bbox": [left, top, int(columns[-1]) + 1 - left, int(rows[-1]) + 1 - top],
                    "area": int(mask.sum()),
                    "segmentation": encode_mask(mask),
                },
            )

    def _close(self) -> None:
        """Write the images and categories, and finish the file."""
        if self._stream is None:
            return
        categories = [("detection", name, "object", 1) for name in self._class_names]
        categories += [(task, task, "road", 0) for task in ("drivable", "lane")]
        numbered = [
            {"id": number, "name": name, "supercategory": above, "isthing": thing}
            for number, (task, name, above, thing) in enumerate(categories, start=1)
            if task in self._tasks
        ]
        images = ",\n".join(dumps(image) for image in self._images)
        videos = [{"id": number, "name": name} for number, name in self._videos.values()]
        listed = f'"videos": {dumps(videos)},\n' if videos else ""
        self._stream.close(f'],\n{listed}"images": [\n{images}\n],\n"categories": {dumps(numbered)}}}')
        self.finish(self._stream.path)
        self._stream = None

    def _track(self, video: int, track_id: int) -> int:
        """Return a number that no other video's track has, its own if that is free; all pictures are the video 0."""
        if (video, track_id) not in self._tracks:
            number = self._highest + 1 if track_id in self._track_ids else track_id
            self._tracks[video, track_id] = number
            self._track_ids.add(number)
            self._highest = max(self._highest, number)
        return self._tracks[video, track_id]

    def _add(self, image_id: int, annotation: dict[str, Any]) -> None:
        assert self._stream is not None
        self._annotations += 1
        self._stream.add({"id": self._annotations, "image_id": image_id, "iscrowd": 0, **annotation})
