from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from trilitenet.errors import ConfigError, OutputError
from trilitenet.formats.writers.base import WRITERS, JsonStream, open_writer, part_of
from trilitenet.structures import Boxes, Perception

TASKS_GONE = Perception(size=(120, 200), class_names=("vehicle",), source="tasks.jpg")


@pytest.fixture(params=sorted(WRITERS))
def format_name(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    if name == "parquet":
        pytest.importorskip("pyarrow")
    return name


def test_every_writer_takes_everything(
    format_name: str, tmp_path: Path, pictures: list[Perception], video: list[Perception]
) -> None:
    unnamed = dataclasses.replace(pictures[0], source=None)
    with open_writer(format_name, tmp_path) as writer:
        for perception in [*pictures, TASKS_GONE, unnamed, *video]:
            writer.write(perception)
    writer.close()
    assert writer.files
    assert len(set(writer.files)) == len(writer.files)
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == set(writer.files), "and nothing else is left"


def test_no_writer_replaces_a_file_unasked(format_name: str, tmp_path: Path, pictures: list[Perception]) -> None:
    def write(overwrite: bool) -> None:
        with open_writer(format_name, tmp_path, overwrite=overwrite) as writer:
            writer.write(pictures[0])

    write(overwrite=False)
    with pytest.raises(OutputError, match="--overwrite"):
        write(overwrite=False)
    write(overwrite=True)


def test_all_frames_of_a_video_go_into_the_same_files(format_name: str, tmp_path: Path) -> None:
    frame = Perception((4, 6), boxes=Boxes.empty(), drivable=np.ones((4, 6), np.bool_), source="a.mp4", frame=0)
    with open_writer(format_name, tmp_path) as writer:
        for index in range(300):
            writer.write(dataclasses.replace(frame, frame=index, timestamp=index / 30))
    assert len(writer.files) in {1, 2, 301}


def test_unknown_format_names_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'openlabel'"):
        open_writer("openlable", tmp_path)


def test_a_file_gets_its_name_when_it_is_whole(tmp_path: Path) -> None:
    stream = JsonStream(tmp_path / "a.json", "[")
    stream.add({"a": 1})
    assert not (tmp_path / "a.json").exists()
    stream.close("]")
    assert json.loads(part_of(tmp_path / "a.json").read_text()) == [{"a": 1}]


def test_output_that_is_a_file_is_an_error(tmp_path: Path, pictures: list[Perception]) -> None:
    (tmp_path / "taken").write_text("x")
    with pytest.raises(OutputError, match="taken"), open_writer("jsonl", tmp_path / "taken") as writer:
        writer.write(pictures[0])
