from __future__ import annotations

from pathlib import Path

import pytest

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
