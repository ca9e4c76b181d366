from __future__ import annotations

import dataclasses
import math
import re
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.artefacts import Artefacts
from trilitenet.commands import evaluate_table as command
from trilitenet.commands.evaluate import evaluate
from trilitenet.commands.evaluate_table import PrecisionRow, PrecisionTable, evaluate_table
from trilitenet.data.synthetic_files import write_dataset
from trilitenet.engine.report import read_report
from trilitenet.errors import ConfigError, OutputError
from trilitenet.models.trilitenet import build_network
from trilitenet.models.weights import save_network


def test_differences_are_to_the_first_row_of_the_model() -> None:
    key, other = "fair/detection/ap50", "paper/lane/iou"
    table = PrecisionTable(
        (
            PrecisionRow("a", "fp32", "x", {key: 0.5, other: 0.25}),
            PrecisionRow("a", "int8", "y", {key: 0.48, other: 0.26}),
            PrecisionRow("b", "fp32", "x", {key: 0.9}),
        )
    )
    lost, figure = table.drop(table.rows[1])
    assert (round(lost, 9), figure) == (2.0, key)
    lines = table.summary().splitlines()
    assert "| a | int8 | y | 48.00 (-2.00) |" in lines
    assert "| a | int8 | y | 26.00 (+1.00) |" in lines
    assert "| b | fp32 | x | - |" in lines
    assert lines[-1] == f"a int8: loses at most 2.00 points ({key})"


def test_options_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="leave bf16 out"):
        evaluate_table("tiny", data=tmp_path, output=tmp_path, format="onnx", precisions=("fp32", "bf16"))
    with pytest.raises(ConfigError, match="at least one"):
        evaluate_table("tiny", data=tmp_path, output=tmp_path, precisions=())
    with pytest.raises(ConfigError, match="--calibration-frames must be at least 1, got 0"):
        evaluate_table("tiny", data=tmp_path, output=tmp_path, calibration_frames=0)
    with pytest.raises(ConfigError, match=r"--max-drop must be points, not negative and finite, got -1"):
        evaluate_table("tiny", data=tmp_path, output=tmp_path, precisions=("fp32", "int8"), max_drop=-1.0)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"file/precisions\.md: cannot be written \(.*file is no folder\)$"):
        evaluate_table("tiny", data=tmp_path, output=tmp_path / "file")


def test_what_int8_needs_is_told_before_the_work(tmp_path: Path) -> None:
    for precisions in (None, ("fp32", "int8")):
        with pytest.raises(ConfigError, match="int8 needs a fixed --size"):
            evaluate_table(data=tmp_path, output=tmp_path, format="onnx", size="dynamic", precisions=precisions)


def test_int8_is_named_by_what_calibrates_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No export and no measuring: the names under which a second run would look for its artefacts."""
    data = tmp_path / "data"
    write_dataset(data, "val", 1, 0, size=(64, 128))
    write_dataset(data, "train", 3, 1, size=(64, 128))
    for name in ("other", "copy"):
        shutil.copytree(data, tmp_path / name)
    picture = next((tmp_path / "other" / "images" / "train").iterdir())
    picture.write_bytes(picture.read_bytes() + b"another")
    exported: list[str] = []

    def names(**options: Any) -> list[str]:
        exported.clear()
        evaluate_table("tiny", data=data, output=tmp_path, precisions=("fp32", "int8"), **options)
        return exported.copy()

    report = SimpleNamespace(values=lambda: {"fair/lane/iou": 0.5}, provenance=SimpleNamespace(runtime="x"))
    monkeypatch.setattr(command, "export", lambda *_, output, **__: exported.append(output.name))
    monkeypatch.setattr(command, "evaluate", lambda *_, **__: report)
    first, other = names(), names(calibration=tmp_path / "other")
    assert first[0] == other[0]
    assert first[0].endswith("-384x640-fp32.xml")
    assert re.fullmatch(r"tiny-[0-9a-f]{12}-384x640-int8-500-[0-9a-f]{12}\.xml", first[1])
    assert first[1] != other[1]
    assert names(calibration=tmp_path / "copy") == first
    # The val split decides with --max-drop, and only then.
    dropped = names(max_drop=1.0)
    assert dropped[1].endswith("-drop1.xml")
    next((tmp_path / "copy" / "det_annotations" / "val").iterdir()).unlink()
    assert names(calibration=tmp_path / "copy") == first
    assert names(calibration=tmp_path / "copy", max_drop=1.0)[1] != dropped[1]


def test_each_model_is_exported_at_the_size_it_was_trained_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_dataset(tmp_path / "data", "val", 1, 0, size=(64, 128))
    network = build_network("tiny")
    save_network(network, tmp_path / "own.safetensors", dataclasses.replace(network.card, input_size=(64, 96)))
    exported: list[str] = []
    report = SimpleNamespace(values=lambda: {"fair/lane/iou": 0.5}, provenance=SimpleNamespace(runtime="x"))
    monkeypatch.setattr(command, "export", lambda *_, output, size, **__: exported.extend((output.name, size)))
    monkeypatch.setattr(command, "evaluate", lambda *_, **__: report)
    options: dict[str, Any] = {"data": tmp_path / "data", "output": tmp_path, "precisions": ("fp32",)}
    evaluate_table(tmp_path / "own.safetensors", "tiny", **options)
    names, sizes = exported[::2], exported[1::2]
    assert sizes == ["64x96", "384x640"]
    assert [name.split("-", 2)[2] for name in names] == ["64x96-fp32.xml", "384x640-fp32.xml"]


@pytest.mark.slow
def test_a_table_is_filled_and_what_is_done_is_kept(artefacts: Artefacts, tmp_path: Path) -> None:
    data, output = tmp_path / "data", tmp_path / "out"
    write_dataset(data, "val", 4, 0, size=(64, 128))
    weights = str(artefacts.folder / "weights.safetensors")
    settings = {"data": data, "output": output, "size": "64x128", "format": "onnx"}
    table = evaluate_table(weights, precisions=("fp32", "fp16"), **settings)  # type: ignore[arg-type]
    assert [row.precision for row in table.rows] == ["fp32", "fp16"]
    assert {"paper/lane/acc", "paper/detection/map50", "fair/lane/f1_2px"} <= set(table.rows[0].figures)
    assert table.rows[1].figures == pytest.approx(table.rows[0].figures, abs=0.05, nan_ok=True)
    assert (output / "precisions.md").read_text() == table.summary() + "\n"
    before = {path: path.stat().st_mtime_ns for path in output.rglob("*.*") if path.name != "precisions.md"}
    assert len(before) == 6
    again = evaluate_table(weights, precisions=("fp32", "fp16"), **settings)  # type: ignore[arg-type]
    assert again.summary() == table.summary()
    assert {path: path.stat().st_mtime_ns for path in before} == before
    # Other labels, and the report is made anew from the artefact that is there.
    next((data / "det_annotations" / "val").iterdir()).unlink()
    evaluate_table(weights, precisions=("fp32",), **settings)  # type: ignore[arg-type]
    changed = {path.name for path in before if path.stat().st_mtime_ns != before[path]}
    assert changed == {"report.json", "report.html"}
    # One that was measured otherwise is no row of the table.
    artefact = next(path for path in before if path.name.endswith("fp32.onnx"))
    folder = next(path.parent for path in before if path.name == "report.json" and "fp32" in path.parent.name)
    wanted = evaluate_table(weights, precisions=("fp32",), **settings).summary()  # type: ignore[arg-type]
    others: list[dict[str, Any]] = [{"protocol": "fair"}, {"paper_batch": 1}, {"lane": 0.9}, {"backend": "openvino"}]
    for other in others:
        options = {"protocol": "both", "backend": "onnxruntime", **other}
        evaluate(str(artefact), data=data, output=folder, overwrite=True, resamples=0, worst=0, **options)
        told = evaluate_table(weights, precisions=("fp32",), **settings)  # type: ignore[arg-type]
        assert told.summary() == wanted, other
        report = read_report(folder / "report.json")
        assert (report.protocols, report.provenance.runtime) == (("fair", "paper"), "onnxruntime cpu fp32")


def test_figures_without_a_value_are_dashes_and_hide_no_loss() -> None:
    key, other = "fair/detection/ap50", "paper/lane/iou"
    rows = [
        PrecisionRow("a", precision, "x", {key: math.nan, other: value})
        for precision, value in (("fp32", 0.3), ("int8", 0.2))
    ]
    table = PrecisionTable(tuple(rows))
    lost, figure = table.drop(rows[1])
    assert (round(lost, 9), figure) == (10.0, other)
    assert "| a | int8 | x | - |" in table.summary().splitlines()
