from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.artefacts import Artefacts
from trilitenet.apps.cli import main
from trilitenet.commands.compare import compare
from trilitenet.commands.evaluate import _check_artefact, _resized, check_output, evaluate, hash_dataset, hash_model
from trilitenet.commands.load import load
from trilitenet.commands.score import score
from trilitenet.config import ARTEFACT_KEY, ArtefactInfo, ModelCard, Thresholds
from trilitenet.data.reading import DrivingDataset
from trilitenet.data.synthetic_files import write_dataset
from trilitenet.engine.provenance import hash_files
from trilitenet.engine.report import Report
from trilitenet.errors import ConfigError, DataError, OutputError, WeightsError
from trilitenet.models.trilitenet import build_network
from trilitenet.models.weights import save_network


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("data")
    write_dataset(root, "val", 4, 0, size=(96, 160))
    return root


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_network(build_network("tiny"), path, ModelCard("tiny", input_size=(96, 160)))
    return path


@pytest.fixture(scope="module")
def run(data: Path, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Report, Path]:
    folder = tmp_path_factory.mktemp("run")
    report = evaluate(
        weights, data=data, protocol="both", output=folder, save=folder / "predictions", resamples=20, worst=1
    )
    return report, folder


def test_evaluating_writes_the_report_and_the_predictions(run: tuple[Report, Path], weights: Path) -> None:
    report, folder = run
    assert report.provenance.model == str(weights)
    assert report.provenance.images == 4
    assert report.provenance.canvas == ("160x96",)
    assert report.provenance.model_sha256 == hashlib.sha256(weights.read_bytes()).hexdigest()
    assert set(report.provenance.data_sha256) == {"images", "drivable", "lane", "boxes"}
    assert len(set(report.provenance.data_sha256.values())) == 4
    assert json.loads((folder / "report.json").read_text())["schema"] == 1
    assert (folder / "report.html").stat().st_size > 10_000
    assert len(list((folder / "predictions" / "lane").iterdir())) == 4


def test_the_saved_predictions_score_the_same(run: tuple[Report, Path], data: Path) -> None:
    report, folder = run
    again = score(folder / "predictions", data=data, resamples=0, worst=0)
    for key, figure in again.figures.items():
        if "detection" not in key:  # coordinates are rounded to a thousandth of a pixel
            assert figure.value == pytest.approx(report.figures[key].value, nan_ok=True), key
    assert again.figures["fair/detection/ap50"].value == pytest.approx(
        report.figures["fair/detection/ap50"].value, abs=0.01
    )


def test_what_labels_mean_is_part_of_their_hash(data: Path, tmp_path: Path) -> None:
    root = shutil.copytree(data, tmp_path / "data")
    before = hash_dataset(DrivingDataset(root, "val"))
    (root / "dataset.yaml").write_text("classes: {vehicle: [bus]}\nlane: {above: 254}\n")
    after = hash_dataset(DrivingDataset(root, "val"))
    assert [name for name in before if before[name] != after[name]] == ["lane", "boxes"]
    (root / "bonnet.png").write_bytes(b"mask")
    (root / "dataset.yaml").write_text("classes: {vehicle: [bus]}\nlane: {above: 254}\nego_mask: bonnet.png\n")
    own_car = hash_dataset(DrivingDataset(root, "val"))
    (root / "bonnet.png").write_bytes(b"another mask")
    assert all(
        own_car[name] != hash_dataset(DrivingDataset(root, "val"))[name] for name in ("drivable", "lane", "boxes")
    )


def test_the_weights_beside_a_graph_are_part_of_its_hash(tmp_path: Path) -> None:
    for graph in ("a.xml", "a.ncnn.param"):
        path = tmp_path / graph
        path.write_text("graph")
        path.with_suffix(".bin").write_bytes(b"weights")
        before = hash_model(str(path))
        path.with_suffix(".bin").write_bytes(b"others")
        assert hash_model(str(path)) not in (before, None)
    before = hash_model(str(path))
    path.with_suffix(".json").write_text("{}")  # NCNN's card
    assert hash_model(str(path)) not in (before, None)
    (tmp_path / "a.xml").unlink()
    assert hash_model(str(tmp_path / "a.xml")) is None
    before = hash_model(str(tmp_path))
    (tmp_path / "a.ncnn.bin").write_bytes(b"yet others")
    assert hash_model(str(tmp_path)) not in (before, None)
    assert hash_model(str(tmp_path / "none.onnx")) is None


def test_a_confidence_out_of_range_is_refused(data: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--confidence must be in \[0, 1\], got 7"):
        score(tmp_path, data=data, confidence=7)


def test_reports_are_compared(run: tuple[Report, Path], data: Path, tmp_path: Path) -> None:
    _, folder = run
    score(folder / "predictions", data=data, confidence=0.4, resamples=0, worst=0, output=tmp_path / "scored")
    comparison = compare(folder, tmp_path / "scored" / "report.json", published=True, output=tmp_path, resamples=20)
    assert len(comparison.names) == 2
    assert not comparison.unpaired
    assert "detection precision, recall and F1 are stated at other confidences" in comparison.summary()
    assert (tmp_path / "comparison.html").exists()
    with pytest.raises(OutputError, match="--overwrite"):
        compare(folder, output=tmp_path)
    assert compare(folder, output=tmp_path, overwrite=True, resamples=0).resamples == 0
    assert json.loads((tmp_path / "comparison.json").read_text())["names"] == ["tiny.safetensors"]
    with pytest.raises(ConfigError, match="at least one"):
        compare()
    with pytest.raises(ConfigError, match=r"report\.json: given more than once"):
        compare(folder, tmp_path / "scored", folder / "report.json")
    shutil.copyfile(folder / "report.json", tmp_path / "report.json")
    twice = compare(folder, tmp_path / "report.json", resamples=0)
    assert twice.names == ("tiny.safetensors", f"tiny.safetensors ({tmp_path / 'report.json'})")


def test_reports_are_not_overwritten_unasked(run: tuple[Report, Path], data: Path, weights: Path) -> None:
    _, folder = run
    with pytest.raises(OutputError, match="--overwrite"):
        evaluate(str(weights), data=data, output=folder)
    with pytest.raises(OutputError, match="--overwrite"):
        evaluate(str(weights), data=data, save=folder / "predictions")
    with pytest.raises(OutputError, match="--overwrite"):
        score(folder / "predictions", data=data, output=folder)
    check_output(folder, overwrite=True)


def test_each_size_is_measured_at_itself(weights: Path) -> None:
    with load(weights, device="cpu", lane=0.3) as predictor:
        sized = _resized(predictor, (96, 160))
    assert {side: one.long_side for side, one in sized.items()} == {96: 96, 160: 160}  # type: ignore[attr-defined]
    assert sized[96].thresholds.lane == 0.3


def test_sizes_and_corruptions_are_measured_too(data: Path, weights: Path) -> None:
    report = evaluate(
        str(weights), data=data, limit=1, resamples=0, worst=0, corruptions=True, severities=(1,), resolution=(96, 160)
    )
    names = [row.name for row in report.variations if not row.detail]
    assert names[0] == "clean"
    assert "fog" in names
    assert names[-2:] == ["96", "160"]
    assert len([row for row in report.variations if row.detail]) == 15


def test_the_command_line(
    run: tuple[Report, Path], data: Path, weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, folder = run
    assert main(["evaluate", str(weights), "--data", str(data), "--limit", "2", "--resamples", "0"]) == 0
    assert "fair protocol" in capsys.readouterr().out
    assert main(["score", str(folder / "predictions"), "--data", str(data), "--protocol", "paper"]) == 0
    assert "mean over batches" in capsys.readouterr().out
    assert main(["compare", str(folder)]) == 0
    assert "figures" in capsys.readouterr().out
    assert main(["compare", str(folder / "nothing.json")]) == 1
    assert main(["score", str(data), "--data", str(data)]) == 1
    assert "no predictions" in capsys.readouterr().err


def test_a_missing_split_is_told(data: Path, weights: Path) -> None:
    with pytest.raises(DataError, match="images/test"):
        evaluate(str(weights), data=data, split="test")


@pytest.mark.parametrize(("option", "resamples", "worst"), [("resamples", -1, 0), ("worst", 0, -1)])
def test_negative_counts_are_refused_before_the_work(
    option: str, resamples: int, worst: int, run: tuple[Report, Path], data: Path, weights: Path, tmp_path: Path
) -> None:
    message = f"--{option} must not be negative, got -1; 0 is for none"
    with pytest.raises(ConfigError, match=message):
        evaluate(str(weights), data=data, save=tmp_path / "out", resamples=resamples, worst=worst)
    with pytest.raises(ConfigError, match=message):
        score(run[1] / "predictions", data=data, output=tmp_path / "out", resamples=resamples, worst=worst)
    for limit in (0, -1):
        with pytest.raises(ConfigError, match=f"--limit must be at least 1, got {limit}"):
            evaluate(str(weights), data=data, limit=limit)
        with pytest.raises(ConfigError, match=f"--limit must be at least 1, got {limit}"):
            score(run[1] / "predictions", data=data, limit=limit)
    with pytest.raises(ConfigError, match="--resamples must not be negative"):
        compare(run[1], resamples=-1)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"resolution": (96, 0)}, "--resolution must be of 1 to 16384, got 96, 0"),
        ({"resolution": (99999,)}, "--resolution must be of 1 to 16384, got 99999"),
        ({"corruptions": True, "severities": (3, 6)}, "--severities must be of 1 to 5, got 3, 6"),
        ({"corruptions": True, "severities": ()}, "--severities must be of 1 to 5, got none"),
        ({"severities": (1, 3)}, "--severities is for --corruptions; give both"),
        ({"batch_size": 0}, "--batch-size must be at least 1, got 0"),
        ({"paper_batch": 0}, "--paper-batch must be at least 1, got 0"),
    ],
)
def test_what_comes_after_the_first_pass_is_refused_before_it(
    settings: dict[str, Any], message: str, data: Path, weights: Path, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=message):
        evaluate(str(weights), data=data, save=tmp_path / "saved", **settings)
    assert not (tmp_path / "saved").exists()


def test_other_sizes_of_a_fixed_input_are_refused_before_the_work(
    artefacts: Artefacts, data: Path, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match="--resolution needs one that takes any size"):
        evaluate(str(artefacts.folder / "model.onnx"), data=data, save=tmp_path / "saved", resolution=(96,))
    assert not (tmp_path / "saved").exists()


def test_scoring_and_comparing_load_no_torch() -> None:
    code = "import sys, trilitenet.commands.score, trilitenet.commands.compare; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_evaluating_an_artefact_needs_no_torch(artefacts: Artefacts, data: Path) -> None:
    model = artefacts.folder / "model.onnx"
    code = (
        "import sys\n"
        "sys.modules['torch'] = None\n"
        "from pathlib import Path\n"
        "from trilitenet.commands.evaluate import evaluate\n"
        f"evaluate({str(model)!r}, data=Path({str(data)!r}), backend='onnxruntime', limit=1, resamples=0, worst=0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("limit", [None, 2])
def test_predictions_of_other_images_are_refused_at_once(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int | None
) -> None:
    entry = {"image_id": "a.jpg", "category_id": 1, "bbox": [0, 0, 2, 2], "score": 0.5}
    (tmp_path / "detections.json").write_text(json.dumps([entry]))
    monkeypatch.setattr(DrivingDataset, "__getitem__", None)
    with pytest.raises(DataError, match=r"for none of the 4 images \(such as 'a\.jpg'\); image_id must be the name"):
        score(tmp_path, data=data, limit=limit)


def test_boxes_of_names_that_the_split_lacks_are_told(
    run: tuple[Report, Path], data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    saved = tmp_path / "saved"
    saved.mkdir()
    names = DrivingDataset(data, "val").names
    entry = {"category_id": 1, "bbox": [0, 0, 2, 2], "score": 0.2}
    entries = [entry | {"image_id": name} for name in (names[0], f"{names[1]}.jpg")]
    (saved / "detections.json").write_text(json.dumps(entries))
    score(saved, data=data, resamples=0, worst=0)
    assert (
        f"boxes of 1 images are left out, for the split has none of that name (such as '{names[1]}.jpg')" in caplog.text
    )
    assert f"no box for {len(names) - 1} of {len(names)} images, which count as seen empty" in caplog.text
    caplog.clear()
    (saved / "detections.json").write_text(json.dumps([entry | {"image_id": name} for name in names]))
    score(saved, data=data, resamples=0, worst=0)
    assert caplog.text == ""


def test_predictions_that_were_cut_off_are_told(data: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    undefined = ", so precision, recall and F1 at {} are undefined"
    own = " (give the model's own --confidence)"
    for score_of, protocol, confidence, told in (
        (0.2504, "fair", 0.25, None),
        (0.41, "fair", 0.25, undefined.format("0.25") + own),
        (0.41, "both", 0.3, undefined.format("0.25 and 0.3") + own),
        (0.41, "fair", 0.4, undefined.format("0.25")),
        (0.2, "fair", 0.1, undefined.format("0.1") + own),
        (0.2, "paper", 0.1, None),
        (1.0, "paper", 0.25, ""),  # nothing is stated at a confidence
    ):
        entry = {"category_id": 1, "bbox": [0, 0, 2, 2], "score": score_of}
        entries = [entry | {"image_id": name} for name in DrivingDataset(data, "val").names]
        (tmp_path / "detections.json").write_text(json.dumps(entries))
        caplog.clear()
        options: dict[str, Any] = {"protocol": protocol, "confidence": confidence}
        score(tmp_path, data=data, resamples=0, worst=0, **options)
        start = f"detections.json: no box is below confidence {score_of:.2g}"
        end = "; if others were cut off, average precision lacks them too"
        assert caplog.messages == ([] if told is None else [start + told + end])


def test_thresholds_that_decide_nothing_are_told(data: Path, weights: Path, caplog: pytest.LogCaptureFixture) -> None:
    options: dict[str, Any] = {"confidence": 0.9, "lane": 0.95}
    for protocol in ("fair", "both"):
        evaluate(weights, data=data, protocol=protocol, limit=1, resamples=0, worst=0, **options)
    evaluate(weights, data=data, protocol="paper", limit=1, resamples=0)
    assert not caplog.records
    report = evaluate(weights, data=data, protocol="paper", limit=1, resamples=0, **options)
    (record,) = caplog.records
    assert record.message == (
        "no figure of --protocol paper hangs on --confidence, --lane: it goes by confidence 0.001, IoU 0.6 and the "
        "likelier class"
    )
    assert report.provenance.thresholds["lane"] == 0.95  # by which a report is known again
    assert report.provenance.settings["paper_thresholds"]["lane"] == 0.5


def test_tasks_without_a_labelled_image_are_told_once(
    run: tuple[Report, Path], data: Path, weights: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = shutil.copytree(data, tmp_path / "data")
    (root / "ll_seg_annotations").rename(root / "ll_annotations")
    (root / "det_annotations" / "val").rename(root / "det_annotations" / "test")
    message = (
        f"no image of {root} val is labelled for detection, lane: nothing in {root / 'det_annotations' / 'val'}, "
        f"{root / 'll_seg_annotations' / 'val'}"
    )
    evaluate(weights, data=root, resamples=0, worst=0)
    assert [record.message for record in caplog.records] == [message]
    caplog.clear()
    score(run[1] / "predictions", data=root, resamples=0, worst=0)
    assert [record.message for record in caplog.records] == [message]
    caplog.clear()
    (root / "dataset.yaml").write_text("tasks: [drivable]\n")
    evaluate(weights, data=root, resamples=0, worst=0)
    assert not caplog.records


def test_data_of_other_classes_are_told(
    artefacts: Artefacts, data: Path, weights: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model = str(artefacts.folder / "model.onnx")
    evaluate(model, data=data, backend="onnxruntime", limit=1, resamples=0, worst=0)
    assert "is of the class class_0, class_1, and those of bus, car, truck are of none" in caplog.text
    caplog.clear()
    evaluate(str(weights), data=data, limit=1, resamples=0, worst=0)
    assert not caplog.text


def test_an_artefact_that_decides_masks_is_not_measured_by_the_published_protocol(
    artefacts: Artefacts, data: Path
) -> None:
    with pytest.raises(ConfigError, match="--masks probability"):
        evaluate(str(artefacts.folder / "model.onnx"), data=data, protocol="paper")


def test_an_artefact_that_suppresses_boxes_is_not_measured(artefacts: Artefacts, data: Path, tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load(str(artefacts.folder / "model.onnx"))
    for entry in model.metadata_props:
        if entry.key == ARTEFACT_KEY:
            entry.value = json.dumps(json.loads(entry.value) | {"nms": True})
    del model.metadata_props[-1]  # the hash of what it was
    onnx.save(model, str(tmp_path / "nms.onnx"))
    with pytest.raises(ConfigError, match="without --nms"):
        evaluate(str(tmp_path / "nms.onnx"), data=data)


def test_a_file_of_bytes_is_no_report_in_one_short_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "weights.bin").write_bytes(b"\x01\x00\x00\x00\xff\xff\xff\xff" * 10_000)
    assert main(["compare", str(tmp_path / "weights.bin")]) == 1
    message = capsys.readouterr().err
    assert "not a report" in message
    assert "UnicodeDecodeError" in message
    assert len(message) < 400 + len(str(tmp_path))


def test_the_hash_of_files_does_not_hang_on_their_order(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.bin", "b.param")]
    for path in paths:
        path.write_text(path.name)
    assert hash_files(paths) == hash_files(paths[::-1])


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are text elsewhere")
def test_images_of_names_that_are_no_text_are_evaluated(weights: Path, data: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(data, tmp_path / "copy")
    images = sorted((copy / "images/val").iterdir())
    for path in (images[0], *copy.glob(f"*/val/{images[0].stem}.*")):
        if path.exists():
            path.rename(path.with_name(os.fsdecode(b"na\xefve") + path.suffix))
    report = evaluate(weights, data=copy, resamples=0, corruptions=True, severities=(1,), output=tmp_path / "report")
    assert report.provenance.images == len(images)
    assert (tmp_path / "report/report.json").is_file()


def test_what_is_asked_of_the_model_reaches_it(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, object] = {}

    def load(model: str, **options: object) -> None:
        given.update(options, model=model)
        raise WeightsError("far enough")

    monkeypatch.setattr("trilitenet.commands.evaluate.load", load)
    asked: dict[str, Any] = {
        "device": "cpu", "backend": "openvino", "confidence": 0.1, "iou": 0.2, "drivable": 0.3, "lane": 0.4,
        "long_side": 320, "network": "blocks.py:build",
    }  # fmt: skip
    with pytest.raises(WeightsError, match="far enough"):
        evaluate("m.onnx", data=data, **asked)
    assert given == {**asked, "model": "m.onnx"}


def test_the_hash_of_the_data_is_of_the_images_measured_on(data: Path) -> None:
    dataset = DrivingDataset(data, "val")
    few = DrivingDataset(data, "val", names=dataset.names[:2])
    assert hash_dataset(dataset, 2) == hash_dataset(few) != hash_dataset(dataset)


def test_what_is_asked_of_a_measurement_reaches_every_pass(
    run: tuple[Report, Path], data: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[dict[str, Any]] = []

    def note(_predictor: object, _dataset: object, _report: object = None, **options: Any) -> Any:
        given.append(options)
        return run[0] if len(given) == 1 else ()

    for name in ("run_evaluation", "corrupted_figures", "figures_by_size"):
        monkeypatch.setattr(f"trilitenet.commands.evaluate.{name}", note)
    each: dict[str, Any] = {"protocol": "both", "batch_size": 2, "limit": 3, "paper_batch": 5}
    once: dict[str, Any] = {"resamples": 7, "worst": 2, "by": ("scene",)}
    evaluate(weights, data=data, corruptions=True, severities=(2, 1, 2), resolution=(96,), **each, **once)
    assert len(given) == 3
    assert all(options.items() >= each.items() and options["progress"] is not None for options in given)
    assert given[0].items() >= once.items()
    assert given[1]["severities"] == (2, 1)  # each once, or a mean would take one twice


def test_what_is_asked_of_a_score_reaches_it(
    run: tuple[Report, Path], data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[dict[str, Any]] = []

    def note(_saved: object, dataset: DrivingDataset, **options: Any) -> Report:
        given.append({**options, "classes": dataset.class_names})
        return run[0]

    monkeypatch.setattr("trilitenet.commands.score.score_predictions", note)
    asked: dict[str, Any] = {
        "protocol": "both", "confidence": 0.5, "limit": 2, "resamples": 7, "worst": 2, "by": ("scene",),
        "paper_batch": 5, "classes": ("car",),
    }  # fmt: skip
    saved = shutil.copytree(run[1] / "predictions", tmp_path / "predictions")
    hashes = []
    for change in (None, "drivable/{3}.png", "drivable/{1}.png", "lane/{0}.png", "detections.json"):
        if change is not None:
            path = saved / change.format(*DrivingDataset(data, "val").names)
            path.write_bytes(path.read_bytes() + b" ")
        score(saved, data=data, **asked)
        hashes.append(given[-1]["about"]["model_sha256"])
    assert given[0].items() >= asked.items()
    assert hashes[0] == hashes[1]  # of an image that is not scored
    assert len(set(hashes)) == 4


@pytest.mark.parametrize(("drivable", "lane", "fine"), [(0.5, 0.5, True), (0.4, 0.5, False), (0.5, 0.6, False)])
def test_masks_that_an_artefact_decides_by_the_likelier_class_are_those_of_the_published_protocol(
    drivable: float, lane: float, *, fine: bool
) -> None:
    card = ModelCard("tiny", thresholds=Thresholds(drivable=drivable, lane=lane))
    info = ArtefactInfo("onnx", "fp32", (96, 160), "uint8_nhwc", "rgb", "decision")
    predictor: Any = SimpleNamespace(card=card, backend=SimpleNamespace(info=info))
    _check_artefact("m.onnx", predictor, "fair")
    with contextlib.nullcontext() if fine else pytest.raises(ConfigError, match="--masks probability"):
        _check_artefact("m.onnx", predictor, "both")
