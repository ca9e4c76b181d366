"""``trilitenet predict --road``: a drive whose frames are painted with their own labels goes through end to end."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.fakes import ColourBackend
from trilitenet.apps import cli
from trilitenet.commands.predict import RoadOptions, predict_with
from trilitenet.data.synthetic import Scene
from trilitenet.data.synthetic_drive import SyntheticDrive
from trilitenet.errors import ConfigError
from trilitenet.inference.predictor import Predictor
from trilitenet.road.camera import write_camera
from trilitenet.structures import Perception

FRAMES = 8


def _painted(scene: Scene) -> np.ndarray:
    """Return a picture of the labels in the colours that the fake backend reads."""
    sample = scene.sample
    assert sample.drivable is not None
    assert sample.lane is not None
    image = np.full((*sample.size, 3), 60, np.uint8)
    image[sample.drivable > 0] = (20, 200, 20)
    image[sample.lane > 0] = (20, 20, 220)
    lead = scene.truth.lead
    assert lead is not None
    left, top, right, bottom = (round(float(v)) for v in lead.box)
    image[top:bottom, left:right] = (220, 20, 20)
    return image


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    drive = SyntheticDrive(0, frames=FRAMES * 40, fps=10, size=(360, 640), faults=False)
    return [drive[40 + i] for i in range(FRAMES)]


@pytest.fixture
def frames(tmp_path: Path, scenes: list[Scene]) -> Path:
    folder = tmp_path / "frames"
    folder.mkdir()
    for index, scene in enumerate(scenes):
        Image.fromarray(_painted(scene)).save(folder / f"{index:03d}.png")
    write_camera(scenes[0].truth.camera, tmp_path / "camera.yaml")
    return folder


def test_a_video_with_the_road(frames: Path, tmp_path: Path, scenes: list[Scene]) -> None:
    pytest.importorskip("edgefirst.tracker")
    report = predict_with(
        Predictor(ColourBackend()),
        [str(frames / "%03d.png")],
        tmp_path / "out",
        format=("jsonl", "csv"),
        rate=10.0,
        road=RoadOptions(camera=tmp_path / "camera.yaml", track=True),
    )
    assert report.errors == ()
    assert report.frames == FRAMES
    (path,) = (tmp_path / "out").glob("*.jsonl")
    documents = [json.loads(line) for line in path.read_text().splitlines()]
    for document, scene in zip(documents, scenes, strict=True):
        perception = Perception.from_dict(document)
        assert perception.boxes is not None
        road, lead = document["road"], scene.truth.lead
        assert lead is not None
        assert road["camera"]["calibrated"] == "file"
        assert road["ego_lane"]["offset"]["value"] == pytest.approx(scene.truth.offset, abs=0.1)
        assert road["lead"]["distance"]["value"] == pytest.approx(lead.distance, rel=0.08)
    assert documents[-1]["boxes"][0]["track_id"] == documents[-2]["boxes"][0]["track_id"] >= 1


def test_smoothed_masks_leave_the_road_as_it_is(frames: Path, tmp_path: Path) -> None:
    results = {}
    for smoothing in (0.0, 0.9):
        options = RoadOptions(camera=tmp_path / "camera.yaml", smoothing=smoothing)
        folder = tmp_path / str(smoothing)
        predict_with(
            Predictor(ColourBackend()), [str(frames / "%03d.png")], folder, format="jsonl", rate=10.0, road=options
        )
        (path,) = folder.glob("*.jsonl")
        results[smoothing] = [json.loads(line) for line in path.read_text().splitlines()]
    masks, roads = ([[each[key] for each in run] for run in results.values()] for key in ("lane", "road"))
    assert masks[0] != masks[1]
    assert roads[0] == roads[1]


def test_a_picture_with_the_road_and_without(frames: Path, tmp_path: Path, scenes: list[Scene]) -> None:
    picture = frames / "000.png"
    overlays = []
    for name, road in (("with", RoadOptions(measure=True)), ("without", None)):
        predict_with(Predictor(ColourBackend()), [picture], tmp_path / name, road=road)
        document = json.loads((tmp_path / name / "000.json").read_text())
        assert ("road" in document) == (road is not None)
        with Image.open(tmp_path / name / "000.jpg") as opened:
            overlays.append(np.asarray(opened.convert("RGB")))
    assert (np.abs(overlays[0].astype(int) - overlays[1]) > 40).any(axis=2).mean() > 0.005
    hidden = tmp_path / "hidden"
    hide = ("lines", "distances", "above", "status")
    predict_with(Predictor(ColourBackend()), [picture], hidden, road=RoadOptions(measure=True), hide=hide)
    with Image.open(hidden / "000.jpg") as opened:
        assert np.array_equal(np.asarray(opened.convert("RGB")), overlays[1])


def test_mistakes_are_told_before_the_work(frames: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.yaml").write_text("height: 1.4\n")
    words = ["predict", str(frames / "000.png"), "--output", str(tmp_path / "out")]
    assert cli.main([*words, "--camera", str(tmp_path / "bad.yaml")]) == 1
    assert "bad.yaml" in capsys.readouterr().err
    assert cli.main([*words, "--smoothing", "1.5"]) == 1
    assert "below 1" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(ConfigError, match="did you mean 'status'"):
        predict_with(Predictor(ColourBackend()), [frames / "000.png"], tmp_path / "out", hide=["statsu"])
