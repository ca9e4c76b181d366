"""The weights commands as a user meets them."""

from __future__ import annotations

import dataclasses
import io
import json
import math
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file

from tests.models.conftest import golden as golden
from tests.models.conftest import published_state
from trilitenet.apps.cli import main
from trilitenet.commands.evaluate import evaluate
from trilitenet.commands.synthesize import synthesize
from trilitenet.commands.weights import average, finish, import_weights, info
from trilitenet.config import shipped_weights
from trilitenet.errors import ConfigError, DataError, OutputError, WeightsError
from trilitenet.models.trilitenet import build_network
from trilitenet.models.weights import load_network, read_card, save_network


@pytest.fixture
def published(golden: dict[str, NDArray[Any]], tmp_path: Path) -> Path:
    torch.save(published_state("tiny", golden), tmp_path / "published.pth")
    return tmp_path / "published.pth"


def test_import_then_info(published: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "ours.safetensors"
    card = import_weights(published, out)
    assert card.variant == "tiny"
    assert "tiny, 1 class(es), from published.pth" in capsys.readouterr().out

    assert info(str(out)).anchors[2][2] == (124.0, 412.0)
    text = capsys.readouterr().out
    for part in ("variant", "tiny", "124x412", "640x384", "published.pth"):
        assert part in text
    info(str(out), json_output=True)
    assert json.loads(capsys.readouterr().out)["class_names"] == ["vehicle"]
    with pytest.raises(WeightsError):
        import_weights(published, tmp_path / "small.safetensors", variant="small")


def test_an_existing_file_is_kept(published: Path, tmp_path: Path) -> None:
    out = tmp_path / "ours.safetensors"
    out.write_text("precious")
    with pytest.raises(OutputError, match="--overwrite"):
        import_weights(published, out)
    assert out.read_text() == "precious"
    import_weights(published, out, overwrite=True)
    assert info(str(out)).variant == "tiny"


def test_no_checkpoint_is_lost_and_none_is_called_otherwise_than_weights(published: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"out\.onnx: weights end with \.safetensors"):
        import_weights(published, tmp_path / "out.onnx")
    only = published.rename(tmp_path / "only.safetensors")
    before = only.read_bytes()
    with pytest.raises(OutputError, match=r"only\.safetensors: is the checkpoint itself, which would be lost"):
        import_weights(only, tmp_path / "." / "only.safetensors", overwrite=True)
    assert only.read_bytes() == before


@pytest.mark.parametrize("verb", ["import", "info", "info --json-output", "finish"])
def test_what_standard_output_cannot_encode_is_no_traceback(
    verb: str, published: Path, scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    foreign = tmp_path / "車.safetensors"
    network = build_network("tiny")
    save_network(network, foreign, dataclasses.replace(network.card, class_names=("車",)))
    out = str(tmp_path / "ü.safetensors")
    words = {
        "import": [str(published), out],
        "info": [str(foreign)],
        "info --json-output": [str(foreign)],
        "finish": ["tiny", out, "--data", str(scenes), "--split", "test", "--input-size", "96", "160"],
    }
    stream = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(stream, encoding="ascii"))
    assert main(["weights", *verb.split(), *words[verb]]) == 0
    sys.stdout.flush()
    told = stream.getvalue().decode("ascii")
    if verb == "info --json-output":
        assert json.loads(told)["class_names"] == ["車"]
    else:
        assert "?" in told


def test_info_of_what_is_not_there() -> None:
    with pytest.raises(WeightsError, match="does not exist"):
        info("nowhere.safetensors")


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("scenes")
    synthesize(root, count=3, seed=5, size=(192, 320), split="test")
    return root


def test_finished_weights_hold_thresholds_figures_and_what_people_say(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    first.write_text(
        "licence: research only\ntraining_data: [ours]\nprovenance: {labels: exact}\nnotes: [far vehicles are missed]\n"
    )
    second.write_text("provenance: {hours: '2'}\nnotes: [night is worse]\n")
    out = tmp_path / f"{'o' * 240}.safetensors"  # nearly as long as file systems take names
    card = finish("tiny", out, data=scenes, split="test", card=(first, second), input_size=(192, 320), iou=0.5)
    told = capsys.readouterr().out
    words = "".join(told.split())  # long paths are broken into lines
    assert words.startswith(f"model{out}(")
    assert f"data{scenes}test,3images" in words
    assert told.endswith(f"\nwritten to {out}\n")
    assert read_card(out) == card
    assert (card.licence, card.training_data) == ("research only", ("ours",))
    assert {"labels": "exact", "hours": "2"}.items() <= card.provenance.items()
    assert card.notes[-2:] == ("far vehicles are missed", "night is worse")
    assert (card.input_size, card.thresholds.iou) == ((192, 320), 0.5)
    assert 0 < card.metrics["test fair/drivable/iou"] <= 1
    info(out)
    shown = re.sub(" {2,}", "  ", capsys.readouterr().out)
    limits = card.thresholds
    assert limits.drivable != limits.lane
    iou, low, high = (card.metrics[f"test fair/drivable/iou{end}"] for end in ("", ", 95% from", ", 95% to"))
    for part in (
        f"box {limits.confidence:g} (NMS 0.5), drivable {limits.drivable:g}, lane {limits.lane:g}\n",
        "trained on  ours\n",
        "research only\n",
        "night is worse\n",
        "exact\n",
        f"test fair/drivable/iou  {iou:g} (95%: {low:g} to {high:g})\n",
    ):
        assert part in shown
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    shipped = load_network("tiny").state_dict()
    assert all(torch.equal(tensor, shipped[name]) for name, tensor in load_network(out).state_dict().items())
    with pytest.raises(OutputError, match="--overwrite"):
        finish("tiny", out, data=scenes)


def test_what_no_label_fixes_is_told(scenes: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    data, out = tmp_path / "data", tmp_path / "out.safetensors"
    shutil.copytree(scenes / "images", data / "images")
    options: dict[str, Any] = {"data": data, "split": "test", "input_size": (96, 160)}
    with pytest.raises(DataError, match=r"data: nothing in test is labelled for detection, drivable, lane; take"):
        finish("tiny", out, **options)
    assert not out.exists()
    shutil.copytree(scenes / "da_seg_annotations", data / "da_seg_annotations")
    boxes = shutil.copytree(scenes / "det_annotations", data / "det_annotations") / "test"
    box = '{"category": "boat", "box2d": {"x1": 1, "y1": 1, "x2": 9, "y2": 9}}'
    for file in boxes.iterdir():
        file.write_text(f'{{"frames": [{{"objects": [{box}]}}]}}')
    caplog.clear()
    thresholds = finish("tiny", out, **options).thresholds
    before = read_card("tiny").thresholds
    assert (thresholds.confidence, thresholds.lane) == (before.confidence, before.lane)
    first, second = (record.getMessage() for record in caplog.records)
    assert first.startswith(f"no box of {data} is of the class vehicle, and those of boat are of none")
    assert second == f"{data}: nothing in test is labelled for detection, lane, whose threshold stays as it is"


def test_a_card_text_with_an_unknown_key_is_refused_before_the_work(scenes: Path, tmp_path: Path) -> None:
    (tmp_path / "card.yaml").write_text("license: MIT\n")
    with pytest.raises(ConfigError, match="licence"):
        finish("tiny", tmp_path / "out.safetensors", data=scenes, card=(tmp_path / "card.yaml",))
    assert not (tmp_path / "out.safetensors").exists()


def test_finished_weights_are_called_what_is_loaded_as_weights(scenes: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"out\.txt: weights end with \.safetensors"):
        finish("tiny", tmp_path / "out.txt", data=scenes)


@pytest.mark.parametrize("size", [(100, 160), (0, 160), (-32, 64)])
def test_an_input_size_that_the_network_cannot_take_is_refused(
    scenes: Path, tmp_path: Path, size: tuple[int, int]
) -> None:
    with pytest.raises(ConfigError, match=f"--input-size must be multiples of 32, got {size[0]}x{size[1]}"):
        finish("tiny", tmp_path / "out.safetensors", data=scenes, input_size=size)
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_finished_is_told_before_the_work(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("trilitenet.commands.weights.load_network", lambda _: pytest.fail("it has begun"))
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot be written"):
        finish("tiny", tmp_path / "file" / "out.safetensors", data=scenes)
    with pytest.raises(ConfigError, match="--batch-size must be at least 1, got 0"):
        finish("tiny", tmp_path / "out.safetensors", data=scenes, batch_size=0)


def test_a_training_state_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    state = tmp_path / "last.ckpt"
    torch.save({"schema": 1, "config": {}, "network": {}, "optimiser": {}}, state)
    for words in (["info", str(state)], ["import", str(state), str(tmp_path / "out.safetensors")]):
        assert main(["weights", *words]) == 1
        error = capsys.readouterr().err
        assert error.startswith(f"error: {state}: is a training state")
        assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]


def test_every_shipped_file_says_what_it_is() -> None:
    for name in shipped_weights():
        card = read_card(name)
        assert card.variant == name
        assert card.training_data
        assert card.notes
        assert "non-commercial" in card.licence
        assert (Path(__file__).resolve().parents[2] / "LICENSE-WEIGHTS").read_text().startswith(f"{card.licence}\n")
        assert {"recipe", "seed", "hours", "hardware", "labels"} <= card.provenance.keys()
        assert 0 < card.metrics["val fair/drivable/iou"] < 1


def test_the_figures_are_those_of_the_file_which_is_fp16_unless_asked_otherwise(scenes: Path, tmp_path: Path) -> None:
    for full, dtype in ((False, torch.float16), (True, torch.float32)):
        out = tmp_path / f"{full}.safetensors"
        card = finish("tiny", out, data=scenes, split="test", input_size=(192, 320), full=full)
        assert {tensor.dtype for tensor in load_file(out).values() if tensor.is_floating_point()} == {dtype}
        report = evaluate(str(out), data=scenes, split="test", worst=0)
        figures = {f"test {name}": round(figure.value, 4) for name, figure in report.figures.items()}
        known = {name: value for name, value in figures.items() if not math.isnan(value)}  # a card has numbers alone
        told = {name: value for name, value in card.metrics.items() if "," not in name}
        assert told == pytest.approx(known | {"test images": 3})
        for name, figure in report.figures.items():
            if f"test {name}, 95% from" in card.metrics:
                assert figure.low == pytest.approx(card.metrics[f"test {name}, 95% from"], abs=1e-4)
                assert figure.high == pytest.approx(card.metrics[f"test {name}, 95% to"], abs=1e-4)
        assert "test fair/drivable/iou, 95% from" in card.metrics
        conditions = {f"{each.attribute} {each.value}": each for each in report.conditions}
        assert {attribute.split()[0] for attribute in conditions} >= {"weather", "timeofday"}
        for name, condition in conditions.items():
            assert card.metrics[f"test images, {name}"] == condition.images
            miou = card.metrics[f"test fair/drivable/miou, {name}"]
            assert miou == pytest.approx(condition.figures["fair/drivable/miou"], abs=1e-4)


def test_the_mean_of_two_lies_between_them_and_has_no_figures(tmp_path: Path) -> None:
    before = load_network("tiny")
    torch.manual_seed(1)
    after = build_network("tiny", anchors=before.card.anchors)
    save_network(after, tmp_path / "after.safetensors", dataclasses.replace(before.card, provenance={"seed": "1"}))
    card = average("tiny", tmp_path / "after.safetensors", tmp_path / "mean.safetensors", share=0.25)
    assert card == read_card(tmp_path / "mean.safetensors")
    assert card.metrics == {}
    assert card.provenance == {"seed": "1", "mean of": "0.75 of tiny.safetensors, 0.25 of after.safetensors"}
    old, new = before.state_dict(), load_network(tmp_path / "after.safetensors").state_dict()
    for name, value in load_network(tmp_path / "mean.safetensors").state_dict().items():
        torch.testing.assert_close(value, 0.75 * old[name] + 0.25 * new[name] if value.is_floating_point() else value)
    for share, same in ((0, old), (1, new)):
        average("tiny", tmp_path / "after.safetensors", tmp_path / "mean.safetensors", share=share, overwrite=True)
        mean = load_network(tmp_path / "mean.safetensors").state_dict()
        assert all(torch.equal(mean[name], value) for name, value in same.items() if value.is_floating_point())


def test_runs_at_two_sizes_have_a_mean_which_names_their_folders(tmp_path: Path) -> None:
    network = load_network("tiny")
    for name, size in (("coarse", (256, 448)), ("fine", (512, 896))):
        (tmp_path / name).mkdir()
        card = dataclasses.replace(network.card, input_size=size)
        save_network(network, tmp_path / name / "final.safetensors", card)
    coarse, fine = (tmp_path / name / "final.safetensors" for name in ("coarse", "fine"))
    card = average(coarse, fine, tmp_path / "mean.safetensors")
    assert card.input_size == (512, 896)
    assert card.provenance["mean of"] == "0.5 of coarse/final.safetensors, 0.5 of fine/final.safetensors"


def test_what_has_no_mean_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "mean.safetensors"
    for words, message in (
        (["tiny", "small"], "no mean of two networks that differ in variant: tiny and small"),
        (["tiny", "tiny", "--share", "1.5"], "share must be 0 to 1, got 1.5"),
        (["tiny", "tiny", "--share", "nan"], "share must be 0 to 1, got nan"),
    ):
        assert main(["weights", "average", *words[:2], str(out), *words[2:]]) == 1
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
    assert not out.exists()
    average("tiny", "tiny", out)
    with pytest.raises(OutputError, match="exists already"):
        average("tiny", "tiny", out)
