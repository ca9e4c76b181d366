from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from trilitenet.engine.loggers import CsvLogger
from trilitenet.engine.results import write_results
from trilitenet.errors import OutputError


def test_page_shows_curves_facts_and_pictures(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    logger = CsvLogger(tmp_path / "metrics.csv")
    for step in (1, 2, 3):
        logger.log({"train/total": 1 / step, "lr": 0.1, "val/lane/iou": step / 10}, step)
    logger.close()
    image = np.zeros((20, 30, 3), np.uint8)
    page = write_results(
        tmp_path / "results",
        tmp_path / "metrics.csv",
        title="A <run>",
        facts={"seed": "0"},
        pictures=[("road & sky", image, image)],
    )
    text = page.read_text()
    assert "A &lt;run&gt;" in text
    assert "road &amp; sky" in text
    for name in ("losses.png", "metrics.png", "learning-rate.png", "labels-0.jpg", "prediction-0.jpg"):
        assert name in text
        assert (page.parent / name).stat().st_size > 300


def test_a_page_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    CsvLogger(tmp_path / "metrics.csv").close()
    (tmp_path / "results").touch()
    with pytest.raises(OutputError, match=r"results: cannot be written \(File exists\)"):
        write_results(tmp_path / "results", tmp_path / "metrics.csv", title="", facts={})
