from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from trilitenet.apps.cli import main


def test_synthesize_writes_the_published_layout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["data", "synthesize", str(tmp_path / "out"), "--count", "2", "--seed", "5", "--split", "val"]
    assert main([*words, "--size", "96", "160"]) == 0
    assert "2 scenes" in capsys.readouterr().out
    for folder, ending in (
        ("images", "jpg"), ("det_annotations", "json"), ("da_seg_annotations", "png"), ("ll_seg_annotations", "png"),
    ):  # fmt: skip
        assert len(list((tmp_path / "out" / folder / "val").glob(f"*.{ending}"))) == 2
    assert main(words) == 1
    assert "not empty" in capsys.readouterr().err
    assert {path.stem for path in (tmp_path / "out/images/val").iterdir()} == {f"synthetic_5_00000{i}" for i in (0, 1)}
    assert "5" not in (tmp_path / "out/dataset.yaml").read_text()  # which other splits, of other seeds, have too


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--seed", "-1"], "seed must not be negative, got -1"),
        (["--size", "0", "0"], "size must be at least 32 pixels each way"),
        (["--count", "0"], "count and workers must be at least 1"),
        (["--split", ""], "split must be the name of one folder"),
        (["--split", "a/b"], "split must be the name of one folder"),
    ],
)
def test_wrong_options_leave_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert main(["data", "synthesize", str(tmp_path / "out"), *words]) == 1
    assert capsys.readouterr().err.startswith(f"error: {message}")
    assert not (tmp_path / "out").exists()


def test_lanes_are_lines_or_paint_as_asked(tmp_path: Path) -> None:
    pixels = {}
    for labels in ("lines", "paint"):
        words = ["data", "synthesize", str(tmp_path / labels), "--count", "1", "--size", "96", "160"]
        assert main([*words, "--labels", labels]) == 0
        (path,) = (tmp_path / labels / "ll_seg_annotations").rglob("*.png")
        pixels[labels] = int((np.asarray(Image.open(path)) > 0).sum())
    assert pixels["paint"] < pixels["lines"]
