from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from trilitenet.engine.loggers import CsvLogger
from trilitenet.engine.results import write_results
from trilitenet.errors import OutputError


def test_page_shows_curves_facts_and_pictures(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    logger = CsvLogger(tmp_path / "metrics.csv")
    for step in (1, 2, 3):
        logger.log({"train/total": 1 / step, "lr": 0.1, "val/lane/iou": step / 10}, step)
    logger.close()
    image = np.full((20, 30, 3), 40, np.uint8)
    page = write_results(
        tmp_path / "results",
        tmp_path / "metrics.csv",
        title="A <run>",
        facts={"seed": "0"},
        pictures=[("road & sky", image, image + 160)],
    )
    text = page.read_text()
    assert "A &lt;run&gt;" in text
    assert '<meta name="viewport"' in text  # else a phone shows it as small as a desktop's
    assert "road &amp; sky" in text
    for name in ("losses.png", "metrics.png", "learning-rate.png", "labels-0.jpg", "prediction-0.jpg"):
        assert name in text
        assert (page.parent / name).stat().st_size > 300
    shades = [np.asarray(Image.open(page.parent / f"{what}-0.jpg")).mean() for what in ("labels", "prediction")]
    assert shades == pytest.approx([40, 200], abs=3)


@pytest.mark.parametrize(("lowest", "scale"), [(0.5, "log"), (0.0, "linear")])
def test_losses_have_a_logarithmic_axis_where_all_have_a_logarithm(
    lowest: float, scale: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figure = pytest.importorskip("matplotlib.figure")
    scales: list[str] = []
    monkeypatch.setattr(figure.Figure, "savefig", lambda self, file, dpi: scales.append(self.axes[0].get_yscale()))
    logger = CsvLogger(tmp_path / "metrics.csv")
    for step in (1, 2):
        logger.log({"train/total": step, "train/lane": lowest, "val/lane/iou": step / 10}, step)
    logger.close()
    write_results(tmp_path / "results", tmp_path / "metrics.csv", title="run", facts={})
    assert scales == [scale, "linear"]


def test_a_page_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    CsvLogger(tmp_path / "metrics.csv").close()
    (tmp_path / "results").touch()
    with pytest.raises(OutputError, match=r"results: cannot be written \(File exists\)"):
        write_results(tmp_path / "results", tmp_path / "metrics.csv", title="", facts={})
