from __future__ import annotations

from pathlib import Path

import pytest

from tests.artefacts import Artefacts
from trilitenet.commands.evaluate_table import PrecisionRow, PrecisionTable, evaluate_table
from trilitenet.data.synthetic_files import write_dataset
from trilitenet.errors import ConfigError


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
        evaluate_table("tiny", data=tmp_path, output=tmp_path, format="onnx")
    with pytest.raises(ConfigError, match="at least one"):
        evaluate_table("tiny", data=tmp_path, output=tmp_path, precisions=())


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
