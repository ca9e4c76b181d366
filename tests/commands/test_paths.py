"""Texts in place of paths, and paths in place of names, in every command of the Python API."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

import trilitenet
from trilitenet.commands.compare import compare
from trilitenet.commands.data import check, convert, prepare, show
from trilitenet.commands.evaluate import check_output, evaluate
from trilitenet.commands.evaluate_table import evaluate_table
from trilitenet.commands.paths import StrPath, check_writable, one_for_several
from trilitenet.commands.predict import predict
from trilitenet.commands.score import score
from trilitenet.commands.synthesize import synthesize
from trilitenet.commands.train_table import train_table
from trilitenet.commands.weights import finish, import_weights
from trilitenet.errors import OutputError, TriLiteNetError


@one_for_several
def several(
    sources: Sequence[str | Path], *, card: Sequence[StrPath] = (), size: tuple[int, int] = (1, 2)
) -> tuple[object, ...]:
    return sources, card, size


def test_one_text_stands_for_several() -> None:
    assert several("a.jpg", card="c.yaml") == (("a.jpg",), ("c.yaml",), (1, 2))
    assert several(Path("a.jpg"), card=["a", "b"])[:2] == ((Path("a.jpg"),), ["a", "b"])  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="sources"):
        several(size=(1, 2))  # type: ignore[call-arg]


@pytest.mark.parametrize(
    "call",
    [
        lambda: trilitenet.benchmark("nowhere", output="x.json", plot="x.svg"),
        lambda: trilitenet.export(precision="int8", output="x.onnx", calibration="nowhere", frames="nowhere"),
        lambda: trilitenet.train("nowhere.yaml", data="nowhere", output="x"),
        lambda: check("nowhere", json_file="x.json", html="x.html"),
        lambda: compare("a.json", "b.json", output="x"),
        lambda: convert("nowhere", "x", kind="coco", classes="nowhere.yaml", splits="val", lane_width=["4"]),
        lambda: evaluate("nowhere", data="nowhere", output="x", save="y", by=["weather"]),
        lambda: evaluate_table(data="nowhere", output="x", precisions=["int8"], calibration="nowhere"),
        lambda: finish("nowhere", "x.safetensors", data="nowhere", card=["a.yaml"]),
        lambda: import_weights("nowhere.pth", "x.safetensors"),
        lambda: predict("nowhere.jpg", output="x", format=["json"], hide="lane", camera="nowhere.yaml"),
        lambda: prepare("nowhere", "x", splits=["val"]),
        lambda: score("nowhere", data="nowhere", output="x", classes="vehicle"),
        lambda: show("nowhere", "x.html", where="weather=rainy"),
        lambda: synthesize("x", size=(1, 1)),
        lambda: train_table("nowhere.yaml", data="nowhere", output="x"),
        lambda: trilitenet.benchmark(Path("nowhere.onnx")),
        lambda: trilitenet.export(Path("nowhere.safetensors")),
        lambda: evaluate(Path("nowhere.onnx"), data="nowhere"),
        lambda: predict(Path("nowhere.jpg"), model=Path("nowhere.onnx")),
    ],
)
def test_every_command_takes_texts(
    call: Callable[[], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # and mypy looks at the calls, as at a user's
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TriLiteNetError):
        call()


@pytest.mark.parametrize(
    "call",
    [
        lambda network: trilitenet.load(network),
        lambda network: trilitenet.load_network(network),
        lambda network: trilitenet.benchmark(network),
        lambda network: trilitenet.export(network),
        lambda network: evaluate(network, data="nowhere"),
        lambda network: evaluate_table(network, data="nowhere", output="x", precisions=["fp32"]),
    ],
)
def test_a_network_in_place_of_its_file_is_told_by_its_type(call: Callable[[Any], object]) -> None:
    with pytest.raises(TypeError, match=r"expected str, bytes or os\.PathLike object, not TriLiteNet"):
        call(trilitenet.build_network("tiny"))


def test_a_list_in_place_of_sources_is_told_by_its_type(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"expected str, bytes or os\.PathLike object, not list"):
        predict(["a.jpg"], output=tmp_path)  # type: ignore[arg-type]


def test_a_report_that_cannot_be_written_is_told_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be written"):
        check_output(tmp_path / "file" / "report", overwrite=True)
    (tmp_path / "report.html").mkdir()
    with pytest.raises(OutputError, match=r"report\.html: cannot be written \(it is a folder\)"):
        check_output(tmp_path, overwrite=True)
    with pytest.raises(OutputError, match=r"holds report\.html already"):
        check_output(tmp_path, overwrite=False)


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
