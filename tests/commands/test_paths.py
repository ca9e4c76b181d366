"""Texts in place of paths, in every command of the Python API."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import trilitenet
from trilitenet.commands.evaluate import check_output
from trilitenet.commands.paths import check_writable, text_paths
from trilitenet.errors import ConfigError, DataError, OutputError, TriLiteNetError


@text_paths
def example(
    data: Path,
    sources: list[str | Path],
    card: Sequence[Path] = (),
    output: Path | None = None,
) -> tuple[Path, list[str | Path], Sequence[Path], Path | None]:
    return data, sources, card, output


def test_texts_become_paths_where_paths_alone_are_meant() -> None:
    assert example("a", ["0", "b.mp4"], card=["c"], output="d") == (  # type: ignore[arg-type, list-item]
        Path("a"),
        ["0", "b.mp4"],
        [Path("c")],
        Path("d"),
    )
    assert example(Path("a"), []) == (Path("a"), [], (), None)
    with pytest.raises(TypeError, match="data"):
        example(sources=[])  # type: ignore[call-arg]


@text_paths
def several(
    sources: Sequence[str | Path],
    *,
    format: tuple[str, ...] = ("json",),
    card: Sequence[Path] = (),
    size: tuple[int, int] = (1, 2),
) -> tuple[object, ...]:
    return sources, format, card, size


def test_one_text_stands_for_several() -> None:
    assert several("a.jpg", format="coco", card="c.yaml") == (("a.jpg",), ("coco",), [Path("c.yaml")], (1, 2))  # type: ignore[arg-type]
    assert several(Path("a.jpg"), format=("a", "b"))[:2] == ((Path("a.jpg"),), ("a", "b"))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("command", "arguments", "options"),
    [
        ("compare.compare", ("a.json", "b.json"), {"output": "x"}),
        ("data.check", ("nowhere",), {}),
        ("data.convert", ("nowhere", "out"), {"kind": "coco"}),
        ("data.prepare", ("nowhere", "out"), {}),
        ("data.show", ("nowhere", "x.html"), {}),
        ("evaluate.evaluate", ("tiny",), {"data": "nowhere", "output": "x"}),
        ("evaluate_table.evaluate_table", ("tiny",), {"data": "nowhere", "output": "x"}),
        ("predict.predict", ("nowhere.jpg",), {"output": "x", "road": True, "camera": "nowhere.yaml"}),
        ("score.score", ("nowhere",), {"data": "nowhere", "output": "x"}),
        ("train.train", ("nowhere.yaml",), {"data": "nowhere", "output": "x"}),
        ("weights.finish", ("nowhere.safetensors", "x.safetensors"), {"data": "nowhere"}),
    ],
)
def test_every_command_takes_texts(
    command: str, arguments: tuple[str, ...], options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    module, _, name = command.partition(".")
    function = getattr(importlib.import_module(f"trilitenet.commands.{module}"), name)
    with pytest.raises(TriLiteNetError):
        function(*arguments, **options)


def test_export_takes_texts() -> None:
    with pytest.raises((ConfigError, DataError)):
        trilitenet.export("tiny", precision="int8", output="x.onnx", calibration_frames=-1, calibration="nowhere")  # type: ignore[arg-type]


def test_a_report_that_cannot_be_written_is_told_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be written"):
        check_output(tmp_path / "file" / "report", overwrite=True)


def test_what_can_be_written_is_told_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_writable(tmp_path / "folders" / "to be made" / "a.json")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OutputError, match=r"cannot be written \(it is a folder\)"):
        check_writable(tmp_path)
    asked: list[int] = []

    def access(folder: Path, mode: int) -> bool:
        asked.append(mode)
        return False

    monkeypatch.setattr("os.access", access)
    with pytest.raises(OutputError, match=f"no permission to write in {re.escape(str(tmp_path))}"):
        check_writable(tmp_path / "a.json")
    assert asked == [os.W_OK | os.X_OK]
