"""The package's own JSON, versioned, described by the JSON Schema shipped as ``schema/perception-1.0.json``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from trilitenet.formats.writers.base import GrowingFile, JsonStream, Writer, dumps
from trilitenet.processing.serialise import perception_to_dict
from trilitenet.structures import SCHEMA_VERSION, Perception

__all__ = ["JsonLinesWriter", "JsonWriter", "read_schema", "to_document"]


def read_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of what this module writes.

    Its root accepts a perception or a whole video; ``#/$defs/perception`` is one line of the JSON lines.
    """
    file = resources.files("trilitenet.formats").joinpath("schema").joinpath(f"perception-{SCHEMA_VERSION}.json")
    schema: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return schema


def to_document(perception: Perception, road: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the JSON form of a perception, with what follows from it for the road under ``road``."""
    document = perception_to_dict(perception)
    return document if road is None else {**document, "road": dict(road)}


class JsonWriter(Writer):
    """Writes ``NAME.json`` for each picture, and for each video one with all of its frames."""

    PICTURE_FILES = VIDEO_FILES = ("{}.json",)

    def __init__(self, output: Path, *, overwrite: bool = False) -> None:
        super().__init__(output, overwrite=overwrite)
        self._video: JsonStream | None = None
        self._source: str | None = None

    def _write(self, perception: Perception, road: Mapping[str, Any] | None = None) -> None:
        """Write one picture or frame."""
        document = to_document(perception, road)
        if perception.frame is None:
            self._close()
            path = self.create(f"{self.stem(perception.source)}.json")
            self.write_whole(path, f"{dumps(document)}\n")
            return
        if self._video is None or self._source != perception.source:
            self._close()
            path = self.create(f"{self.stem(perception.source)}.json")
            head = f'{{"schema": "{SCHEMA_VERSION}", "source": {dumps(perception.source)}, "frames": ['
            self._video, self._source = JsonStream(path, head), perception.source
        self._video.add(document)

    def _close(self) -> None:
        """Finish the file of the last video."""
        if self._video is not None:
            self._video.close("]}")
            self.finish(self._video.path)
            self._video = None


class JsonLinesWriter(Writer):
    """Writes ``perceptions.jsonl``: a line an image or frame, readable while it grows."""

    FILES = ("perceptions.jsonl",)

    def __init__(self, output: Path, *, overwrite: bool = False) -> None:
        super().__init__(output, overwrite=overwrite)
        self._file = GrowingFile(self.create("perceptions.jsonl"), self.files)

    def _write(self, perception: Perception, road: Mapping[str, Any] | None = None) -> None:
        """Write one line."""
        self._file.add(f"{dumps(to_document(perception, road))}\n")
        self._file.keep()

    def _close(self) -> None:
        """Close the file."""
        self._file.close()
