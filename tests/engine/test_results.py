from __future__ import annotations

import math
from pathlib import Path
from typing import Any

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
        learned = {"train/weight_lane": 90.0}
        logger.log({"train/total": 1 / step, "lr": 0.1, "val/lane/iou": step / 10, **learned}, step)
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
    for name in ("losses.png", "balance.png", "metrics.png", "learning-rate.png", "labels-0.jpg", "prediction-0.jpg"):
        assert name in text
        assert (page.parent / name).stat().st_size > 300
    shades = [np.asarray(Image.open(page.parent / f"{what}-0.jpg")).mean() for what in ("labels", "prediction")]
    assert shades == pytest.approx([40, 200], abs=3)


@pytest.mark.parametrize(
    ("lane", "scale", "shown"),
    [
        ((0.5, 0.5), "log", 2),
        ((0.0, 0.0), "log", 1),
        ((0.5, 0.0), "log", 2),
        ((math.nan, 0.5), "log", 2),
        ((math.nan, 0.0), "log", 1),
        ((0.5, -0.5), "linear", 2),
    ],
)
def test_losses_have_a_logarithmic_axis_unless_one_is_negative(
    lane: tuple[float, float], scale: str, shown: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figure = pytest.importorskip("matplotlib.figure")
    plots: list[tuple[str, int]] = []
    limits: list[tuple[float, float]] = []

    def savefig(self: Any, file: object, dpi: int) -> None:
        (axes,) = self.axes
        plots.append((axes.get_yscale(), len(axes.lines)))
        limits.append(axes.get_ylim())

    monkeypatch.setattr(figure.Figure, "savefig", savefig)
    logger = CsvLogger(tmp_path / "metrics.csv")
    for step in (1, 2):
        loss = lane[step - 1]
        total = math.nan if math.isnan(loss) else step  # where every step was left out, as are all terms
        logger.log({"train/total": total, "train/lane": loss, "val/lane/iou": 0.0}, step)
    logger.close()
    write_results(tmp_path / "results", tmp_path / "metrics.csv", title="run", facts={})
    assert plots == [(scale, shown), ("linear", 1)]
    assert scale == "linear" or limits[0][0] > 0.1  # a point without a logarithm widens no axis


def test_losses_that_are_nothing_throughout_leave_an_empty_picture(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    logger = CsvLogger(tmp_path / "metrics.csv")
    logger.log({"train/total": math.nan, "train/lane": 0.0}, 1)
    logger.close()
    page = write_results(tmp_path / "results", tmp_path / "metrics.csv", title="run", facts={})
    assert (page.parent / "losses.png").is_file()


def test_a_page_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    CsvLogger(tmp_path / "metrics.csv").close()
    (tmp_path / "results").touch()
    with pytest.raises(OutputError, match=r"results: cannot be written \(File exists\)"):
        write_results(tmp_path / "results", tmp_path / "metrics.csv", title="", facts={})
