"""Training end to end on a few small synthetic scenes."""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import errno
import io
import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
import yaml

import trilitenet
from tests.data.serving import serving
from trilitenet.commands.train import _display, _nested, build_loss, train, training_data, validation_figures
from trilitenet.commands.train_table import TableResult, TableRow, train_table
from trilitenet.config import DEFAULT_ANCHORS, TASKS, Task
from trilitenet.data.description import read_description, write_description
from trilitenet.data.loader import epoch_order
from trilitenet.data.prepared import PreparedDataset, prepare
from trilitenet.data.reading import DrivingDataset, MixedDataset
from trilitenet.data.synthetic_files import write_dataset
from trilitenet.engine import train as engine
from trilitenet.engine.checkpoint import read_checkpoint, write_checkpoint
from trilitenet.engine.ema import MovingAverage
from trilitenet.engine.loggers import CsvLogger, read_csv
from trilitenet.engine.predictions import PredictionWriter
from trilitenet.engine.recipe import TrainConfig, read_recipe
from trilitenet.engine.results import write_results
from trilitenet.engine.train import Trainer, TrainResult
from trilitenet.errors import ConfigError, DataError, MissingExtraError, OutputError, TrainingError, WeightsError
from trilitenet.losses.distillation import DistillationLoss
from trilitenet.models.encoder import Encoder
from trilitenet.models.trilitenet import TriLiteNet, build_network
from trilitenet.models.weights import load_network, read_card, save_network
from trilitenet.structures import Boxes, Perception

pytest.importorskip("lightning_fabric")

RECIPES = sorted(
    path for path in (Path(__file__).resolve().parents[2] / "recipes").rglob("*.yaml") if path.parent.name != "tables"
)
TABLES = sorted((Path(__file__).resolve().parents[2] / "recipes" / "tables").glob("*.yaml"))


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("scenes")
    write_dataset(root, "train", 10, 0, size=(96, 160))
    write_dataset(root, "val", 3, 1, size=(96, 160))
    return root


@pytest.fixture(scope="module", autouse=True)
def _no_page() -> Iterator[None]:
    """Draw no page of results, which takes longer than two steps: one test looks at it, and draws it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("trilitenet.commands.train.write_results", lambda *_, **__: None)
        yield


VALIDATED: dict[str, Any] = {"val_split": "val", "max_steps": 4, "pictures": 0}
"""Two epochs of two steps, each measured."""


@pytest.fixture(scope="module")
def straight(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> TrainResult:
    """Return what a run comes to that is measured after both epochs, and that nothing stops."""
    random.seed(0)  # as each test is, which begins after its module's fixtures
    np.random.seed(0)  # noqa: NPY002
    return train(**logged(scenes, tmp_path_factory.mktemp("straight"), **VALIDATED))


@pytest.fixture(scope="module")
def _one_step(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("one")
    train(**settings(scenes, folder, max_steps=1))
    return folder


@pytest.fixture
def begun(_one_step: Path, tmp_path: Path) -> Path:
    """Return the folder of a run of one step."""
    return shutil.copytree(_one_step, tmp_path / "begun")


def settings(scenes: Path, output: Path, **more: Any) -> dict[str, Any]:
    return {
        "data": str(scenes),
        "output": str(output),
        "input_size": (64, 128),
        "batch_size": 4,
        "epochs": 10,
        "warmup_steps": 4,
        "workers": 0,
        "val_split": "",
        "device": "cpu",
        "precision": "32-true",
        "loggers": (),
        "log_every": 1,
        "auto_anchor": False,
        **more,
    }


def logged(scenes: Path, output: Path, **more: Any) -> dict[str, Any]:
    return settings(scenes, output, **{"loggers": ("csv",), **more})


def state(folder: Path) -> dict[str, Any]:
    whole = read_checkpoint(folder / "last.ckpt")
    return {key: value for key, value in whole.items() if key not in {"config", "metrics"}}


def same(first: Any, second: Any, path: str = "") -> None:
    """Compare nested states bit for bit."""
    if isinstance(first, dict):
        assert first.keys() == second.keys(), path
        for key in first:
            same(first[key], second[key], f"{path}/{key}")
    elif isinstance(first, (list, tuple)):
        assert len(first) == len(second), path
        for index, (a, b) in enumerate(zip(first, second, strict=True)):
            same(a, b, f"{path}/{index}")
    elif isinstance(first, torch.Tensor):
        assert torch.equal(first, second), path
    else:
        assert first == second, path


def curves(folder: Path) -> list[tuple[int, str, float]]:
    """Return a run's figures but its speed."""
    return [row for row in read_csv(folder / "metrics.csv") if row[1] != "images_per_second"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:This DataLoader will create")  # two workers on a machine of one core
def test_resume_is_bit_for_bit(scenes: Path, tmp_path: Path) -> None:
    options: dict[str, Any] = {"workers": 2, "multi_scale": (0.8, 1.6), "precision": "auto"}
    options |= {"balancing": "uncertainty", "batch_size": 3}
    train(**logged(scenes, tmp_path / "straight", max_steps=20, **options))
    for steps in (10, 20):  # three steps an epoch: step 10 is in the middle of one
        result = train(resume=steps > 10, **logged(scenes, tmp_path / "parts", max_steps=steps, **options))
        assert result.steps == steps
    same(state(tmp_path / "straight"), state(tmp_path / "parts"))
    assert curves(tmp_path / "straight") == curves(tmp_path / "parts")


def test_resume_is_bit_for_bit_with_validation_between(scenes: Path, tmp_path: Path, straight: TrainResult) -> None:
    for steps in (3, 4):
        train(resume=steps > 3, **settings(scenes, tmp_path, **VALIDATED | {"max_steps": steps}))
    same(state(straight.folder), state(tmp_path))


KILLED = """
import io, json, os, random, signal, sys
import numpy, torch
from trilitenet.commands.train import train
threads, settings = json.loads(sys.argv[1])
torch.set_num_threads(threads)
random.seed(0)
numpy.random.seed(0)
plain, written = torch.save, []
def save(state, file):
    whole = io.BytesIO()
    plain(state, whole)
    content = whole.getvalue()
    if written:
        file.write(content[: len(content) // 2])
        file.flush()
        os.kill(os.getpid(), signal.SIGKILL)
    written.append(file.write(content))
torch.save = save
train(**settings)
"""
"""A run that is killed when its second checkpoint is half written."""


def test_a_run_killed_while_it_writes_a_checkpoint_goes_on_bit_for_bit(scenes: Path, tmp_path: Path) -> None:
    straight, run = (logged(scenes, tmp_path / name, epochs=2) for name in ("straight", "run"))
    train(**straight)
    words = [sys.executable, "-c", KILLED, json.dumps([torch.get_num_threads(), run])]
    assert subprocess.run(words, check=False, timeout=280).returncode == -signal.SIGKILL
    assert len(list((tmp_path / "run").glob(".last.ckpt.*.part"))) == 1
    assert state(tmp_path / "run")["step"] == 2  # of four
    assert train(resume=True, **run).finished
    same(state(tmp_path / "straight"), state(tmp_path / "run"))
    assert curves(tmp_path / "straight") == curves(tmp_path / "run")
    weights = [(tmp_path / name / "final.safetensors").read_bytes() for name in ("straight", "run")]
    assert weights[0] == weights[1]
    assert not list((tmp_path / "run").glob(".*.part"))


def test_a_setting_may_be_a_path_one_for_several_or_none(tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("samples_per_epoch: 2\nteacher: tiny\nepochs: 7\n")
    given = {
        "data": tmp_path,
        "extra_data": {tmp_path / "more": 1.0},
        "tasks": "lane",
        "loggers": "csv",
        "freeze": "encoder",
        "samples_per_epoch": None,
        "teacher": None,
        "epochs": None,
        "augmentation__flip": None,
    }
    config = read_recipe(recipe, _nested(given))
    assert (config.data, config.extra_data) == (str(tmp_path), {str(tmp_path / "more"): 1.0})
    assert (config.tasks, config.loggers, config.freeze) == (("lane",), ("csv",), ("encoder",))
    assert (config.samples_per_epoch, config.teacher, config.epochs) == (None, None, 7)


def test_initial_weights_keep_their_anchors(scenes: Path, tmp_path: Path) -> None:
    train(**settings(scenes, tmp_path, init="tiny", max_steps=1, auto_anchor=True, anchor_recall=0.0))
    assert load_network(tmp_path / "final.safetensors").card.anchors == load_network("tiny").card.anchors


def test_an_epoch_without_a_step_is_refused(scenes: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="an epoch of 1 batches has no step of 4"):
        train(**settings(scenes, tmp_path, samples_per_epoch=1, accumulate=4))


def test_resuming_takes_the_new_weight_decay(scenes: Path, begun: Path) -> None:
    train(resume=True, **settings(scenes, begun, max_steps=2, weight_decay=0.3, betas=(0.5, 0.6)))
    groups = read_checkpoint(begun / "last.ckpt")["optimiser"]["param_groups"]
    assert max(group["weight_decay"] for group in groups) == 0.3
    assert {tuple(group["betas"]) for group in groups} == {(0.5, 0.6)}


def test_settings_that_are_others_on_resuming_are_told(
    scenes: Path, begun: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(resume=True, **settings(scenes, begun, max_steps=1))
    assert "other settings" not in capsys.readouterr().err
    train(resume=True, **settings(scenes, begun, max_steps=1, lr=0.5, augmentation__flip=0.0))
    told = "goes on with other settings than it had: augmentation.flip 0.0 (was 0.5), lr 0.5 (was 0.001)\n"
    assert told in capsys.readouterr().err


def test_a_run_that_goes_on_without_validation_claims_no_figures(
    scenes: Path, tmp_path: Path, straight: TrainResult
) -> None:
    run = shutil.copytree(straight.folder, tmp_path / "run")
    result = train(resume=True, **settings(scenes, run, max_steps=5))
    assert (result.steps, result.metrics, read_card(result.weights).metrics) == (5, {}, {})


def test_other_validation_data_are_told_on_resuming(
    scenes: Path, tmp_path: Path, straight: TrainResult, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(straight.folder, tmp_path / "run")
    train(resume=True, **settings(scenes, run, **VALIDATED))
    other = VALIDATED | {"val_split": "train"}
    assert train(resume=True, **settings(scenes, run, **other)).best == straight.best  # it is at its end
    assert "was validated on" not in capsys.readouterr().err
    train(resume=True, **settings(scenes, run, **other | {"max_steps": 5}))
    assert "was validated on 3 images, not 10: what is best is found anew" in capsys.readouterr().err


def test_what_has_no_effect_is_told(scenes: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    data = shutil.copytree(scenes, tmp_path / "data")
    shutil.rmtree(data / "ll_seg_annotations" / "train")
    more: dict[str, Any] = {"classes": ("vehicel",), "sampling": {"timeofdy": {"night": 2.0}}}
    train(**settings(data, tmp_path / "run", max_steps=1, swapped_anchors=True, patience=2, warmup_epochs=0.0, **more))
    assert "warmup_steps changes nothing where warmup_epochs is 0" in caplog.text
    assert "swapped_anchors changes nothing without auto_anchor" in caplog.text
    assert "patience stops nothing without val_split" in caplog.text
    assert "no image of train is labelled for lane" in caplog.text
    assert "no box of" in caplog.text
    assert "no image has the attribute 'timeofdy' to sample by; did you mean 'timeofday'?" in caplog.text
    with pytest.raises(DataError, match="no image of train is labelled for lane"):
        train(**settings(data, tmp_path / "lane", tasks=("lane",)))


def test_a_warm_up_of_the_whole_run_is_told(scenes: Path, begun: Path, caplog: pytest.LogCaptureFixture) -> None:
    def told(**more: Any) -> str:
        caplog.clear()
        train(resume=True, **settings(scenes, begun, max_steps=1, **more))  # which is at its end; two steps an epoch
        return caplog.text

    assert "warm-up" not in told(warmup_steps=19)
    assert "warm-up takes the whole run (20 steps); lower --warmup-steps\n" in told(warmup_steps=20)
    assert "(6 steps); lower --warmup-epochs\n" in told(epochs=3)
    assert "(4 steps); lower --warmup-epochs and --warmup-steps\n" in told(epochs=2)


def test_classes_that_the_first_data_lacks_are_told(
    scenes: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    extra = shutil.copytree(scenes, tmp_path / "extra")
    (extra / "dataset.yaml").write_text("classes: {automobile: [car], person: [pedestrian], cycle: [bike]}\n")
    more: dict[str, Any] = {"extra_data": {str(extra): 1.0}, "max_steps": 1, "val_split": ""}
    train(**settings(scenes, tmp_path / "run", **more))
    assert f"{extra}: boxes of person, cycle are background, as {scenes} has no such class; --classes" in caplog.text
    caplog.clear()
    train(**settings(scenes, tmp_path / "other", classes=("vehicle",), **more))
    assert "are background" not in caplog.text


def test_a_run_that_cannot_start_leaves_the_earlier_one(
    scenes: Path, begun: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = sorted(path.name for path in begun.iterdir())
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(MissingExtraError, match="wandb"):
        train(**settings(scenes, begun, loggers=("csv", "wandb")), overwrite=True)
    assert sorted(path.name for path in begun.iterdir()) == before
    wandb = SimpleNamespace(init=Mock(side_effect=Exception("No API key configured")))
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    with pytest.raises(TrainingError, match=r"^wandb: cannot log \(No API key configured\); see `wandb login`"):
        train(**settings(scenes, begun, loggers=("csv", "wandb")), overwrite=True)
    assert sorted(path.name for path in begun.iterdir()) == before


def test_a_tracking_server_that_fails_ends_no_run_and_goes_on_with_it_later(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mlflow = Mock()
    mlflow.start_run.return_value.info.run_id = "m1"
    mlflow.log_metrics.side_effect = OSError("no connection")
    monkeypatch.setitem(sys.modules, "mlflow", mlflow)
    options = logged(scenes, tmp_path, loggers=("mlflow", "csv"))
    assert train(**options, max_steps=2).finished
    assert len([row for row in curves(tmp_path) if row[1] == "train/total"]) == 2
    train(**options, max_steps=3, resume=True)
    assert [told.kwargs["run_id"] for told in mlflow.start_run.mock_calls] == [None, "m1"]
    train(**options, max_steps=1, overwrite=True)
    assert mlflow.start_run.mock_calls[-1].kwargs["run_id"] is None


def test_going_on_with_other_frozen_parts_is_refused(scenes: Path, tmp_path: Path) -> None:
    train(**settings(scenes, tmp_path, max_steps=1, init="tiny", freeze=("drivable",)))
    with pytest.raises(WeightsError, match=r"was trained with freeze \['drivable'\], this run has \['lane'\]"):
        train(**settings(scenes, tmp_path, max_steps=2, freeze=("lane",)), resume=True)


def test_the_losses_of_every_step_are_logged(scenes: Path, tmp_path: Path) -> None:
    train(**logged(scenes, tmp_path, max_steps=5, log_every=3))  # two steps an epoch
    assert [step for step, name, _ in read_csv(tmp_path / "metrics.csv") if name == "lr"] == [2, 3, 4, 5]


def test_a_teacher_gets_pixels_normalised_as_its_card_says(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network = build_network("tiny")
    card = dataclasses.replace(network.card, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0))
    save_network(network, tmp_path / "teacher.safetensors", card)
    pixels: list[torch.Tensor] = []

    def look(_network: TriLiteNet, inputs: tuple[torch.Tensor]) -> None:
        pixels.extend(inputs)

    def watched(path: str, network: str | None) -> TriLiteNet:
        teacher = load_network(path, network)
        teacher.register_forward_pre_hook(look)
        return teacher

    monkeypatch.setattr("trilitenet.commands.train.load_network", watched)
    train(**settings(scenes, tmp_path / "run", max_steps=1, teacher=str(tmp_path / "teacher.safetensors")))
    assert 0 <= float(pixels[0].min()) < float(pixels[0].max()) <= 1


def test_a_teacher_of_other_classes_is_refused_before_anything_is_made(scenes: Path, tmp_path: Path) -> None:
    data = shutil.copytree(scenes, tmp_path / "data")
    classes: dict[str, tuple[str, ...]] = {"car": ("car",), "lorry": ("truck",)}
    write_description(data, dataclasses.replace(read_description(data), classes=classes))
    with pytest.raises(ConfigError, match="the teacher tells the classes vehicle, the data set has car, lorry"):
        train(**settings(data, tmp_path / "run", teacher="tiny"))
    assert not (tmp_path / "run").exists()
    masks_alone = {"teacher": "tiny", "distillation": (0.0, 1.0, 1.0), "max_steps": 1}
    assert train(**settings(data, tmp_path / "run", **masks_alone)).finished


def test_pixels_reach_the_network_unrounded_in_bf16(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, plain = [], Encoder.forward

    def forward(self: Encoder, image: torch.Tensor) -> Any:
        seen.append(image)
        return plain(self, image)

    monkeypatch.setattr(Encoder, "forward", forward)
    train(**settings(scenes, tmp_path, max_steps=1, precision="bf16-mixed"))
    (image,) = seen
    assert image.dtype is torch.float32
    assert not torch.equal(image, image.bfloat16().float())


def test_accumulation_sees_the_same_images(scenes: Path, tmp_path: Path) -> None:
    for passes in (1, 2):
        train(**logged(scenes, tmp_path / str(passes), max_steps=1, accumulate=passes))
    losses = [{row[1]: row[2] for row in read_csv(tmp_path / str(n) / "metrics.csv")} for n in (1, 2)]
    assert losses[0]["train/objectness"] == pytest.approx(losses[1]["train/objectness"], rel=0.05)


def test_a_step_takes_one_exchange_between_processes(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, plain = [], Trainer._any

    def count(self: Trainer, *here: bool) -> tuple[bool, ...]:
        asked.append(self.step)
        return plain(self, *here)

    monkeypatch.setattr(Trainer, "_any", count)
    train(**settings(scenes, tmp_path, max_steps=4, samples_per_epoch=40))
    assert [asked.count(step) for step in (1, 2, 3)] == [1, 1, 1]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_saves_and_ends_cleanly(
    scenes: Path, tmp_path: Path, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, others = signal.getsignal(number), set(multiprocessing.active_children())
    plain = CsvLogger.log

    def log(self: CsvLogger, values: Any, step: int) -> None:
        plain(self, values, step)
        if step == 3:
            helpers = set(multiprocessing.active_children()) - others
            assert len(helpers) == 1
            processes = [str(process) for process in (os.getpid(), *(helper.pid for helper in helpers))]
            subprocess.run(["kill", f"-{number.value}", *processes], check=True)  # as a terminal or scheduler does

    monkeypatch.setattr(CsvLogger, "log", log)
    result = train(**logged(scenes, tmp_path, max_steps=4, workers=1))
    assert (result.finished, result.steps, result.exit_code) == (False, 3, 130)
    assert "--resume" in result.summary()
    assert state(tmp_path)["step"] == 3
    assert not result.weights.exists()
    assert signal.getsignal(number) == before
    monkeypatch.setattr(CsvLogger, "log", plain)
    assert train(resume=True, **logged(scenes, tmp_path, max_steps=4, workers=1)).finished


def test_every_checkpoint_is_written_once_and_a_log_that_cannot_be_is_told(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = []

    def write(path: Path, state: dict[str, Any]) -> None:
        written.append(state["step"])
        write_checkpoint(path, state)

    monkeypatch.setattr(engine, "write_checkpoint", write)
    assert train(**settings(scenes, tmp_path, max_steps=4)).finished
    assert written[-1] == 4
    assert len(set(written)) == len(written) > 1
    (tmp_path / "metrics.csv").mkdir()
    with pytest.raises(OutputError, match=r"metrics\.csv: cannot be written \(Is a directory\)"):
        train(resume=True, **logged(scenes, tmp_path, max_steps=5))


@pytest.mark.parametrize("last", [2, 4])
def test_a_stop_in_the_last_step_of_an_epoch_loses_no_validation(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, straight: TrainResult, last: int
) -> None:
    plain, stops = CsvLogger.log, [last]

    def log(self: CsvLogger, values: Any, step: int) -> None:
        plain(self, values, step)
        if stops == [step]:
            stops.clear()
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(CsvLogger, "log", log)
    assert not train(**logged(scenes, tmp_path, **VALIDATED)).finished
    parts = train(resume=True, **logged(scenes, tmp_path, **VALIDATED))
    assert parts.finished
    assert parts.metrics == straight.metrics
    assert read_card(parts.weights).metrics == read_card(straight.weights).metrics
    same(state(straight.folder), state(tmp_path))
    assert curves(straight.folder) == curves(tmp_path)


def test_a_stop_while_the_network_is_measured_waits_for_no_more_images(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, straight: TrainResult
) -> None:
    def stopped(network: TriLiteNet, dataset: DrivingDataset, device: str, progress: Any) -> dict[str, float]:
        os.kill(os.getpid(), signal.SIGTERM)
        return validation_figures(network, dataset, device, progress)

    with monkeypatch.context() as patch:
        patch.setattr("trilitenet.commands.train.validation_figures", stopped)
        result = train(**logged(scenes, tmp_path, **VALIDATED))
    assert (result.finished, result.steps, result.metrics) == (False, 2, {})
    parts = train(resume=True, **logged(scenes, tmp_path, **VALIDATED))
    assert parts.metrics == straight.metrics
    same(state(straight.folder), state(tmp_path))
    assert curves(straight.folder) == curves(tmp_path)


@pytest.mark.parametrize("what", ["commands.train.validation_figures", "engine.train.save_network"])
def test_an_end_while_the_network_is_measured_costs_that_alone(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, straight: TrainResult, what: str
) -> None:
    def end(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(f"trilitenet.{what}", end)
        with pytest.raises(KeyboardInterrupt):
            train(**logged(scenes, tmp_path, **VALIDATED))
    assert (state(tmp_path)["step"], state(tmp_path)["ended"]) == (2, 0)
    train(resume=True, **logged(scenes, tmp_path, **VALIDATED))
    same(state(straight.folder), state(tmp_path))
    assert curves(straight.folder) == curves(tmp_path)


@pytest.mark.parametrize("what", ["validation", "anchors"])
def test_a_terminal_shows_how_far_the_images_are(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("TERM", "xterm")
    shown = []
    for images in (30, 2):
        monkeypatch.setattr("sys.stderr", Terminal())
        with _display(quiet=False) as display:
            display.step(5, 6, "epoch 1/1 step 5/6: total 1.0")
            getattr(display, what)(images, 30)
        assert isinstance(sys.stderr, Terminal)
        shown.append(re.search(rf"{what}.*\b2/30", sys.stderr.getvalue()) is not None)
    assert shown == [False, True]  # gone at the end


@pytest.mark.parametrize(
    ("values", "killed", "options", "best"),
    [
        # A kill between the best and the checkpoint is no step back ...
        ([0.1, 0.2, 0.2, 0.3], 4, {"max_steps": 6}, (6, 0.3)),
        # ... and best weights newer than the checkpoint stop no run early: the third epoch is run again.
        ([0.1, 0.2, 0.3, 0.3, 0.4], 6, {"max_steps": 8, "checkpoint_every": 2}, (8, 0.4)),
    ],
)
def test_a_kill_before_the_checkpoint_changes_no_end(
    scenes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    values: list[float],
    killed: int,
    options: dict[str, int],
    best: tuple[int, float],
) -> None:
    figures = iter(values)
    monkeypatch.setattr("trilitenet.commands.train.validation_figures", lambda *_: {"drivable/miou": next(figures)})
    keep = Trainer._keep_best

    def die(self: Trainer) -> None:
        keep(self)
        if self.step == killed:
            raise KeyboardInterrupt

    run = settings(scenes, tmp_path, val_split="val", tasks=("drivable",), pictures=0, patience=1, **options)
    monkeypatch.setattr(Trainer, "_keep_best", die)
    with pytest.raises(KeyboardInterrupt):
        train(**run)
    monkeypatch.setattr(Trainer, "_keep_best", keep)
    result = train(resume=True, **run)
    assert (result.steps, result.best["drivable"]) == best


def test_an_average_that_comes_later_begins_at_the_weights(scenes: Path, tmp_path: Path) -> None:
    options = settings(scenes, tmp_path, max_steps=2)
    weights = load_network(train(**options, ema_decay=0.0).weights).state_dict()
    averaged = load_network(train(resume=True, **options, ema_decay=0.999).weights).state_dict()
    same(dict(weights), dict(averaged))


def test_files_of_ones_own_are_left_alone(scenes: Path, tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "paper.csv").write_text("precious")
    with pytest.raises(OutputError, match="files that a run would replace"):
        train(**settings(scenes, tmp_path, max_steps=1))
    assert (tmp_path / "results" / "paper.csv").read_text() == "precious"


def test_validation_keeps_the_best_and_the_page(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("trilitenet.commands.train.write_results", write_results)
    options = logged(scenes, tmp_path, val_split="val", epochs=1, max_steps=2, auto_anchor=True, pictures=1)
    result = trilitenet.train(**options)
    assert set(result.best) <= {"detection", "drivable", "lane", "overall"}
    assert {"detection/ap50", "detection/recall", "drivable/miou", "lane/accuracy", "lane/iou"} <= set(result.metrics)
    card = read_card(result.weights)
    assert card.metrics["val drivable/miou"] == result.metrics["drivable/miou"]
    assert card.input_size == (64, 128)
    for name in result.best:
        assert read_card(tmp_path / f"best-{name}.safetensors").metrics[f"best {name}"] == result.best[name]
    assert (tmp_path / "results" / "index.html").exists()
    assert read_recipe(tmp_path / "config.yaml").input_size == (64, 128)
    anchors = load_network(result.weights).anchors
    torch.testing.assert_close(anchors, read_checkpoint(tmp_path / "last.ckpt")["network"]["anchors"])


def test_the_best_is_never_replaced_by_a_worse_one(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = iter([0.5, 0.7, 0.6, 0.8])

    monkeypatch.setattr("trilitenet.commands.train.validation_figures", lambda *_: {"drivable/miou": next(values)})
    options = settings(scenes, tmp_path, val_split="val", tasks=("drivable",), pictures=0)
    train(**options, max_steps=4)
    (tmp_path / "last.ckpt").rename(tmp_path / "kept")
    train(overwrite=True, **options | {"epochs": 10}, max_steps=2)
    assert read_card(tmp_path / "best-drivable.safetensors").metrics["best drivable"] == 0.6
    train(resume=True, **options, max_steps=4)
    assert read_card(tmp_path / "best-drivable.safetensors").metrics["best drivable"] == 0.8


def test_overwriting_leaves_nothing_of_the_earlier_run(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = iter([0.9, 0.1, 0.2])
    monkeypatch.setattr("trilitenet.commands.train.validation_figures", lambda *_: {"drivable/miou": next(values)})
    output = tmp_path / "run"
    options = logged(scenes, output, val_split="val", tasks=("drivable",), pictures=0)
    train(**options, max_steps=2)
    assert (output / "best-drivable.safetensors").exists()
    (output / "results").mkdir()
    (output / "results" / "old.jpg").write_bytes(b"x")
    (output / "notes.txt").write_text("mine")
    (output / "last.ckpt").unlink()
    with pytest.raises(OutputError, match="holds a run already"):
        train(**options, max_steps=1)
    train(overwrite=True, **options | {"val_split": ""}, max_steps=1)
    assert not list(output.glob("best-*"))
    assert not (output / "results" / "old.jpg").exists()
    assert (output / "notes.txt").read_text() == "mine"
    (output / ".last.ckpt.0123abcd.part").write_bytes(b"cut short")
    train(resume=True, **options, max_steps=4)
    assert not list(output.glob(".*"))
    assert read_card(output / "best-drivable.safetensors").metrics["best drivable"] < 0.5


def test_stops_early(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trilitenet.commands.train.validation_figures", lambda *_: {"drivable/miou": 0.5})
    options = settings(scenes, tmp_path, val_split="val", tasks=("drivable",), patience=2, pictures=0)
    result = train(**options)
    assert result.finished
    assert result.steps == 6  # one good validation and two no better, two steps an epoch


def test_a_validation_without_labels_is_told_and_stops_nothing(
    scenes: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = shutil.copytree(scenes, tmp_path / "data")
    shutil.rmtree(data / "ll_seg_annotations" / "val")
    options = settings(data, tmp_path / "run", val_split="val", tasks=("lane",), patience=1, max_steps=4, pictures=0)
    assert train(**options).steps == 4  # two steps an epoch
    assert "no image of val is labelled for lane" in caplog.text


def test_the_optimiser_goes_on_as_this_device_computes(scenes: Path, tmp_path: Path) -> None:
    train(**settings(scenes, tmp_path / "run", max_steps=1))
    path = tmp_path / "run/last.ckpt"
    state = torch.load(path, weights_only=True)
    for group in state["optimiser"]["param_groups"]:
        group.update(fused=False, foreach=True)  # as on Apple's GPUs
    torch.save(state, path)
    seen: list[Any] = []
    plain = torch.optim.AdamW.step

    def step(self: torch.optim.AdamW, *rest: Any, **more: Any) -> Any:
        seen.extend((group["fused"], group["foreach"]) for group in self.param_groups)
        return plain(self, *rest, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.optim.AdamW, "step", step)
        train(**settings(scenes, tmp_path / "run", max_steps=2), resume=True)
    assert set(seen) == {(True, None)}


def test_tasks_are_in_one_order_however_they_are_given(scenes: Path, tmp_path: Path) -> None:
    assert TrainConfig(tasks=("lane", "drivable")).tasks == ("drivable", "lane")
    train(**settings(scenes, tmp_path / "run", max_steps=1, tasks=("lane", "drivable")))
    result = train(**settings(scenes, tmp_path / "run", max_steps=2, tasks=("drivable", "lane")), resume=True)
    assert result.steps == 2


def test_transfer_freeze_and_distil(scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = train(**settings(scenes, tmp_path / "teacher", max_steps=1))
    options = {"init": str(first.weights), "teacher": str(first.weights), "freeze": ("encoder",)}
    second = train(**settings(scenes, tmp_path / "student", max_steps=2, tasks=("drivable",), **options))
    assert "surplus: " in capsys.readouterr().err
    ours, theirs = load_network(second.weights), load_network(first.weights)
    assert ours.tasks == ("drivable",)
    for name, tensor in ours.encoder.state_dict().items():
        torch.testing.assert_close(tensor, theirs.encoder.state_dict()[name], rtol=0, atol=1e-6)
    assert read_card(second.weights).provenance["teacher"] == "final.safetensors"


def test_what_begins_at_random_is_not_frozen(scenes: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("freeze: [encoder]\n")
    with pytest.raises(ConfigError, match=r"--freeze encoder: .* give weights that have them with --init"):
        train(recipe, **settings(scenes, tmp_path / "run"))
    frozen = settings(scenes, tmp_path / "run", init="tiny", max_steps=1)
    assert train(recipe, **frozen).finished
    frozen |= {"init": None, "max_steps": 2}
    assert train(recipe, **frozen, resume=True).steps == 2


def test_freezing_draws_no_random_numbers(scenes: Path, made: Callable[..., dict[str, Any]], tmp_path: Path) -> None:
    made(**settings(scenes, tmp_path, init="tiny"))
    after = torch.rand(1)
    made(**settings(scenes, tmp_path, init="tiny", freeze=("encoder",)))
    assert torch.equal(torch.rand(1), after)


def save_labels(folder: Path, dataset: DrivingDataset, tasks: Sequence[Task] = TASKS) -> Path:
    """Save labels as a teacher's outputs, so that what is taught can be compared with them."""
    with PredictionWriter(folder, tasks) as writer:
        for sample in dataset:
            assert sample.boxes is not None
            assert sample.class_id is not None
            assert sample.drivable is not None
            assert sample.lane is not None
            said = Boxes(sample.boxes, np.full(len(sample.boxes), 0.9, np.float32), sample.class_id)
            drivable, lane = sample.drivable.astype(bool), sample.lane.astype(bool)
            writer.write(
                sample.name,
                Perception(size=sample.size, class_names=("vehicle",), boxes=said, drivable=drivable, lane=lane),
            )
    return folder


def test_a_task_that_is_neither_labelled_nor_taught_is_told(
    scenes: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    images = tmp_path / "images-alone"
    shutil.copytree(scenes / "images", images / "images")
    boxes = save_labels(tmp_path / "boxes", DrivingDataset(scenes, "train"), ("detection",))
    taught = settings(images, tmp_path / "run", max_steps=1, teacher=str(boxes))
    train(**{**taught, "auto_anchor": True})
    assert "no image of train is labelled for drivable, lane" in caplog.text
    assert "anchors: kept as they are, for there is no labelled box" in capsys.readouterr().err
    for none in ({"distillation": (0.0, 1.0, 1.0)}, {"teacher": "tiny", "distillation": (0.0, 0.0, 0.0)}):
        with pytest.raises(DataError, match="no image of train is labelled for detection, drivable, lane"):
            train(**{**taught, **none}, overwrite=True)
    caplog.clear()
    train(**{**taught, "teacher": "tiny"}, overwrite=True)
    assert "labelled" not in caplog.text


def test_boxes_alone_teach_a_data_set_that_has_a_prepared_copy(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = shutil.copytree(scenes, tmp_path / "data")
    prepare(data, canvas=(64, 128), splits=["train"])
    options = settings(data, tmp_path / "run", max_steps=1)
    assert isinstance(training_data(TrainConfig(**{**options, "tasks": ("detection",)})), PreparedDataset)
    boxes = save_labels(tmp_path / "boxes", DrivingDataset(scenes, "train"), ("detection",))
    train(**options, teacher=str(boxes))
    assert "taught detection on 8 of 10 images" in capsys.readouterr().err  # of two there is no box
    with pytest.raises(ConfigError, match="boxes without masks do not tell the size"):
        train(**{**options, "data": str(data / ".prepared")}, teacher=str(boxes), overwrite=True)


def test_outputs_that_fit_no_one_image_are_refused(scenes: Path, tmp_path: Path) -> None:
    teacher = save_labels(tmp_path / "outputs", DrivingDataset(scenes, "train"))
    options = settings(scenes, tmp_path / "run", max_steps=1, teacher=str(teacher))
    other = shutil.copytree(scenes, tmp_path / "other")
    name = next(
        sample.name for sample in DrivingDataset(scenes, "train") if sample.boxes is not None and len(sample.boxes)
    )
    with pytest.raises(ConfigError, match="several images of the training data are called "):
        train(**options, extra_data={str(other): 1.0})
    for task in ("drivable", "lane"):
        (teacher / task / f"{name}.png").unlink()
    with pytest.raises(DataError, match=f"has boxes of {name} but no mask of the image; every image needs a mask"):
        train(**options)


def test_distils_from_saved_outputs(scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = tmp_path / "images-alone"
    shutil.copytree(scenes / "images", images / "images")
    dataset = DrivingDataset(scenes, "train")
    assert len(dataset) == 10
    teacher = save_labels(tmp_path / "outputs", dataset)
    plain = logged(scenes, tmp_path / "labels", max_steps=2)
    train(**plain)
    taught = {**plain, "data": str(images), "output": str(tmp_path / "taught"), "teacher": str(teacher)}
    result = train(**taught)
    assert "taught detection, drivable, lane on 10 of 10 images" in capsys.readouterr().err
    assert read_card(result.weights).provenance["teacher"] == "outputs"
    curves = [
        [row[2] for row in read_csv(tmp_path / name / "metrics.csv") if re.search("box|drivable|lane", row[1])]
        for name in ("labels", "taught")  # whose ignored boxes differ, and objectness with them
    ]
    assert len(curves[0]) == 10
    assert curves[0] == pytest.approx(curves[1], rel=1e-3)
    shutil.rmtree(teacher / "lane")
    with pytest.raises(ConfigError, match="the teacher has none of the tasks lane"):
        train(overwrite=True, **taught, tasks=("lane",))
    (teacher / "detections.json").unlink()
    for path in (teacher / "drivable").iterdir():
        path.rename(path.with_name(f"other-{path.name}"))
    with pytest.raises(ConfigError, match="none of the 10 training images"):
        train(overwrite=True, **taught)
    with pytest.raises(ConfigError, match="the lower first"):
        train(overwrite=True, **taught, teacher_confidence=(0.6, 0.5))


def test_not_finite_steps_are_left_out_and_end_the_run(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    plain, calls = TriLiteNet.forward, iter(range(100))
    poisoned = {1}

    def forward(self: TriLiteNet, image: torch.Tensor) -> Any:
        return plain(self, image * float("nan") if next(calls) in poisoned else image)

    monkeypatch.setattr(TriLiteNet, "forward", forward)
    result = train(**logged(scenes, tmp_path / "one", max_steps=3))
    assert result.finished
    assert "step 1 skipped" in caplog.text
    assert all(bool(value.isfinite().all()) for value in load_network(result.weights).state_dict().values())
    poisoned.update(range(100))
    with pytest.raises(TrainingError, match="10 steps in a row"):
        train(**logged(scenes, tmp_path / "all"))


@pytest.mark.parametrize(
    "error",
    [
        torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
        RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: ..."),
    ],
)
def test_a_step_without_memory_is_told_in_one_line(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: RuntimeError
) -> None:
    def forward(self: TriLiteNet, image: torch.Tensor) -> Any:
        raise error

    monkeypatch.setattr(TriLiteNet, "forward", forward)
    told = r"cpu is out of memory in step 0 \(a batch of 4 images of 128x64, --accumulate 1\); raise --accumulate"
    with pytest.raises(TrainingError, match=told):
        train(**settings(scenes, tmp_path, max_steps=1))


def test_refusals(scenes: Path, tmp_path: Path, begun: Path) -> None:
    with pytest.raises(ConfigError, match="no data"):
        train()
    with pytest.raises(ConfigError, match=r"default_tiny: no such recipe; give the path of .* --help` lists every key"):
        train("default_tiny")
    with pytest.raises(ConfigError, match="did you mean 'epochs'"):
        train(epoch=3)
    with pytest.raises(ConfigError, match="--sampling: not YAML"):
        train(sampling="{a: [")
    wrong: dict[str, Any] = {"betas": (1.5, 0.9), "seed": -1, "pictures": -1, "anchors": [[[-1, 2]] * 3] * 3}
    for name, value in wrong.items():
        with pytest.raises(ConfigError, match=name):
            train(data="x", **{name: value})
    with pytest.raises(ConfigError, match="3 levels of 3 sizes"):
        train(data="x", anchors=[[[1, 2]] * 3] * 2)
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match=r"file.*cannot be written"):
        train(**settings(scenes, tmp_path / "file" / "run", max_steps=1))
    with pytest.raises(ConfigError, match="without data and output"):
        train_table(TABLES[0], data=scenes, output=tmp_path, settings="{data: x}")
    with pytest.raises(ConfigError, match="settings: not YAML"):
        train_table(TABLES[0], data=scenes, output=tmp_path, settings="{a: [")
    with pytest.raises(ConfigError, match="settings must be YAML"):
        train_table(TABLES[0], data=scenes, output=tmp_path, settings="{multi_scale: null}")
    for unknown in ("resume", "1"):
        with pytest.raises(ConfigError, match=f"unknown key '{unknown}'"):
            train_table(TABLES[0], data=scenes, output=tmp_path, settings=f"{{{unknown}: 2}}")
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "x.yaml").write_text("variant: tiny\n")
    (tmp_path / "t.yaml").write_text("title: Parts\nrows: {A: a/x.yaml, B: b/x.yaml}\n")
    with pytest.raises(ConfigError, match="two recipes are called 'x'"):
        train_table(tmp_path / "t.yaml", data=scenes, output=tmp_path)
    with pytest.raises(WeightsError, match="no such checkpoint"):
        train(resume=True, **settings(scenes, tmp_path / "none"))
    with pytest.raises(OutputError, match="holds a run already"):
        train(**settings(scenes, begun, max_steps=1))
    with pytest.raises(WeightsError, match="variant 'tiny', this run has 'small'"):
        train(resume=True, **settings(scenes, begun, max_steps=2, variant="small"))
    with pytest.raises(WeightsError, match="class count 1, this run has 2"):
        train(resume=True, **settings(scenes, begun, max_steps=2, classes=("vehicle", "person")))


def test_a_prepared_data_set_is_trained_on_without_validation(scenes: Path, tmp_path: Path) -> None:
    prepare(scenes, tmp_path / "prepared", canvas=(64, 128), mask_above=64)
    options = settings(tmp_path / "prepared", tmp_path / "run", max_steps=1)
    with pytest.raises(DataError, match="--val-split '' to go without"):
        train(**options | {"val_split": "val"})
    with pytest.raises(DataError, match="prepared with --mask-above 64, 1 is wanted"):
        train(**options)
    assert train(augmentation__mask_above=64, **options).steps == 1


def test_a_prepared_data_set_is_trained_on_from_an_address(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from trilitenet.apps.cli import main

    def run(*words: str) -> tuple[int, str]:
        code = main(["train", str(recipe), *words])
        return code, capsys.readouterr().err

    prepare(scenes, tmp_path / "here", canvas=(64, 128), shard_size=1)
    options = settings(tmp_path / "here", tmp_path / "run", cache=str(tmp_path / "copies"), log_every=9)
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(json.dumps(options))
    with serving(tmp_path) as site:
        address = f"{site.address}/here"
        code, told = run("--data", address, "--val-split", "val")
        assert (code, told.count("\n")) == (1, 1)
        assert told.startswith(f"error: {address}: what is at an address is prepared")
        assert "--val-split '' to train without" in told
        assert run("--data", address, "--max-steps", "1", "--extra-data", f"{{{address}: 2}}")[0] == 0
        shards = [f"train-{number:06}.tar" for number in range(10)]
        assert [name for name in site.asked if name.endswith(".tar")] == shards  # all before the step that needs four
        assert read_recipe(tmp_path / "run/config.yaml").data == address
        assert read_card(tmp_path / "run/final.safetensors").training_data == ("here, here (train): 20 images",)
        assert run("--data", address, "--output", str(tmp_path / "one"), "--max-steps", "2")[0] == 0
    train(**options | {"output": str(tmp_path / "two"), "max_steps": 2})
    same(state(tmp_path / "one"), state(tmp_path / "two"))
    output = ("--output", str(tmp_path / "one"), "--resume", "--max-steps", "3", "--cache")
    moved = (tmp_path / "copies").rename(tmp_path / "moved")
    code, told = run("--data", address, *output, str(moved))  # of the copies: nobody answers
    assert (code, "cache" in told.partition("other settings")[2]) == (0, False)
    code, told = run("--data", address, *output, str(tmp_path / "none"))
    refused = f"[Errno {errno.ECONNREFUSED}] {os.strerror(errno.ECONNREFUSED)}"
    assert (code, told) == (1, f"error: {address}/prepared.json: cannot be fetched ({refused})\n")


def test_a_run_goes_on_with_its_own_data_alone(scenes: Path, tmp_path: Path) -> None:
    data = shutil.copytree(scenes, tmp_path / "data")
    options = settings(data, tmp_path / "run", classes=("vehicle", "person"))
    train(**options, max_steps=1)
    go_on = {"resume": True, "max_steps": 2}
    with pytest.raises(WeightsError, match="trained on the classes vehicle, person, not person, vehicle;"):
        train(**options | go_on | {"classes": ("person", "vehicle")})
    write_dataset(tmp_path / "fewer", "train", 9, 0, size=(96, 160))
    with pytest.raises(WeightsError, match="trained on 10 images, not 9;"):
        train(**options | go_on | {"data": str(tmp_path / "fewer")})
    other = shutil.copytree(data, tmp_path / "other")
    images = sorted((other / "images" / "train").iterdir())
    for image, next_one in zip(images, images[1:] + images[:1], strict=True):
        image.write_bytes((data / "images" / "train" / next_one.name).read_bytes())
    with pytest.raises(WeightsError, match="other images or labels of the same names;") as caught:
        train(**options | go_on | {"data": str(other)})
    assert "\n" not in str(caught.value)
    images[0].rename(images[0].with_stem("unknown"))
    with pytest.raises(WeightsError, match="trained on images of other names;"):
        train(**options | go_on | {"data": str(other)})
    moved = data.rename(tmp_path / "moved")
    next((moved / "ll_seg_annotations" / "train").iterdir()).unlink()  # a label may be mended
    assert train(**options | go_on | {"data": str(moved)}).steps == 2


def test_a_checkpoint_that_does_not_name_its_data_is_taken(scenes: Path, begun: Path) -> None:
    whole = torch.load(begun / "last.ckpt", weights_only=True)
    whole["data"] = None
    torch.save(whole, begun / "last.ckpt")
    assert train(resume=True, **settings(scenes, begun, max_steps=2)).steps == 2


@pytest.mark.parametrize("workers", [0, 1])
@pytest.mark.parametrize("gone", [True, False])
def test_an_image_that_vanishes_or_breaks_is_named_and_the_run_can_go_on(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: int, *, gone: bool
) -> None:
    data = shutil.copytree(scenes, tmp_path / "data")
    images = {path: path.read_bytes() for path in (data / "images" / "train").iterdir()}
    plain = CsvLogger.log

    def log(self: CsvLogger, values: Any, step: int) -> None:
        plain(self, values, step)
        for path in images if step == 2 else ():
            path.unlink()
            if not gone:
                path.write_bytes(b"broken")

    monkeypatch.setattr(CsvLogger, "log", log)
    options = logged(data, tmp_path / "run", workers=workers, max_steps=30, samples_per_epoch=400)
    with pytest.raises(DataError, match=r"train/synthetic_\w+\.jpg: .*; once that is mended, --resume") as caught:
        train(**options)
    assert "\n" not in str(caught.value)
    monkeypatch.setattr(CsvLogger, "log", plain)
    for path, content in images.items():
        path.write_bytes(content)
    steps = state(tmp_path / "run")["step"]
    assert 2 <= steps < 30
    assert train(resume=True, **options | {"max_steps": steps + 1}).steps == steps + 1


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # PyTorch's, which the news interrupts at times
def test_a_reading_process_that_is_killed_in_the_middle_of_a_step_costs_none(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = {"workers": 1, "max_steps": 4, "samples_per_epoch": 40}
    others, plain = set(multiprocessing.active_children()), MovingAverage.update

    def update(self: MovingAverage, network: TriLiteNet) -> None:
        if self.updates == 1:  # the optimiser has stepped, the average has not
            (worker,) = set(multiprocessing.active_children()) - others
            worker.kill()
            os.waitid(os.P_PID, int(worker.pid or 0), os.WEXITED | os.WNOWAIT)
        plain(self, network)

    with monkeypatch.context() as patch:
        patch.setattr(MovingAverage, "update", update)
        with pytest.raises(
            TrainingError, match=r"reads images was ended .*--workers; --resume goes on after step 2"
        ) as e:
            train(**logged(scenes, tmp_path / "parts", **options))
    assert "\n" not in str(e.value)
    assert train(resume=True, **logged(scenes, tmp_path / "parts", **options)).finished
    train(**logged(scenes, tmp_path / "straight", **options))
    same(state(tmp_path / "straight"), state(tmp_path / "parts"))
    assert curves(tmp_path / "straight") == curves(tmp_path / "parts")


@pytest.mark.parametrize(("writable", "kept"), [(False, 2), (True, 4)])
def test_best_weights_that_cannot_be_written_cost_no_more_than_the_checkpoint(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, writable: bool, kept: int
) -> None:
    """A disk that is full from the end of the second epoch on, at last for weights alone."""
    figures = iter([0.1, *[0.2] * (1 + writable), 0.1, 0.3])
    monkeypatch.setattr("trilitenet.commands.train.validation_figures", lambda *_: {"drivable/miou": next(figures)})
    run = settings(scenes, tmp_path, val_split="val", tasks=("drivable",), max_steps=8, patience=2)

    def full(path: Path, *_: Any) -> None:
        raise OutputError(f"{path.name}: No space left on device")

    def weights(network: TriLiteNet, path: Path, card: Any) -> None:
        full(path) if card.provenance["steps"] == "4" else save_network(network, path, card)

    def checkpoint(path: Path, state: dict[str, Any]) -> None:
        full(path) if state["step"] == 4 and not writable else write_checkpoint(path, state)

    with monkeypatch.context() as patch:
        patch.setattr(engine, "save_network", weights)
        patch.setattr(engine, "write_checkpoint", checkpoint)
        first = "best-drivable" if writable else "last"
        told = rf"^{first}\..* mended, --resume goes on after step {kept} of 8 \(epoch {kept // 2} of 10\)$"
        with pytest.raises(OutputError, match=told):
            train(**run)
    assert state(tmp_path)["step"] == kept
    result = train(resume=True, **run)
    assert (result.steps, result.best["drivable"]) == (8, 0.3)
    assert read_card(tmp_path / "best-drivable.safetensors").metrics["best drivable"] == 0.3


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is full")
def test_a_log_that_cannot_be_written_is_told_once(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = CsvLogger.log

    def log(self: CsvLogger, values: Any, step: int) -> None:
        if step == 3:
            self._file.close()
            self._file = Path("/dev/full").open("w")  # noqa: SIM115 - closing it fails, too
            self._writer = csv.writer(self._file)
        plain(self, values, step)

    monkeypatch.setattr(CsvLogger, "log", log)
    with pytest.raises(
        OutputError,
        match=r"cannot be written \(No space .* mended, --resume goes on after step 3 of 6 \(epoch 2 of 10\)$",
    ):
        train(**logged(scenes, tmp_path, max_steps=6))


def test_a_disk_that_is_full_from_the_start_is_told_as_such(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, _: Any) -> None:
        raise OutputError(f"{path}: cannot write the checkpoint (No space left on device)")

    monkeypatch.setattr(engine, "write_checkpoint", full)
    with pytest.raises(
        OutputError, match=r"once that is mended, start anew with --overwrite, for nothing is saved yet"
    ):
        train(**settings(scenes, tmp_path, max_steps=1))


def test_resuming_takes_the_anchors_for_distillation_too(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a GPU the losses have copies of the anchors; on a CPU they share them, which would hide the mistake."""
    made = []

    def build(student: torch.Tensor, *more: Any) -> DistillationLoss:
        made.append(DistillationLoss(student.clone(), *more))
        return made[-1]

    monkeypatch.setattr("trilitenet.commands.train.DistillationLoss", build)
    own = (np.array(DEFAULT_ANCHORS) * 1.5).tolist()
    train(**settings(scenes, tmp_path, max_steps=1, teacher="tiny", anchors=own))
    train(**settings(scenes, tmp_path, max_steps=2, teacher="tiny"), resume=True)
    for loss in made:
        torch.testing.assert_close(loss.get_buffer("student_anchors"), torch.tensor(own))
    with pytest.raises(WeightsError, match="was trained with other anchors than are given now"):
        train(**settings(scenes, tmp_path, max_steps=2, anchors=DEFAULT_ANCHORS), resume=True)
    assert train(**settings(scenes, tmp_path, max_steps=2, anchors=own), resume=True).finished


@pytest.mark.parametrize("part", ["network", "optimiser", "random"])
def test_a_checkpoint_with_the_wrong_content_is_told_in_one_line(scenes: Path, begun: Path, part: str) -> None:
    path = begun / "last.ckpt"
    whole = torch.load(path, weights_only=True)
    torch.save({**whole, part: {}}, path)
    with pytest.raises(WeightsError, match=r"last\.ckpt: does not fit this run") as caught:
        train(resume=True, **settings(scenes, begun, max_steps=2))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda path: path.stem)
def test_every_recipe_runs_three_steps(recipe: Path, scenes: Path, tmp_path: Path) -> None:
    given = settings(scenes, tmp_path, max_steps=3, batch_size=2)
    for name in ("epochs", "warmup_steps", "auto_anchor"):  # cheap as the recipe has them
        del given[name]
    assert train(recipe, **given).steps == 3
    own, run = read_recipe(recipe), read_recipe(tmp_path / "config.yaml")
    assert run == dataclasses.replace(own, **given)
    assert recipe.read_text().startswith("# ")
    assert "Measured result" in recipe.read_text()


@pytest.mark.parametrize("table", TABLES, ids=lambda path: path.stem)
def test_every_table_names_recipes_that_exist(table: Path) -> None:
    content = yaml.safe_load(table.read_text())
    for recipe in content["rows"].values():
        read_recipe(table.parent / recipe)
    own = {"components": ("Baseline", False), "left_out": ("Complete", False), "tasks": (None, True)}
    assert (content.get("compare"), content.get("tick_tasks", False)) == own[table.stem]


def test_a_table_shows_rises_and_ticks_as_the_paper_does() -> None:
    name = "paper/detection/recall"
    rows = (
        TableRow("Baseline", TASKS, {name: 0.784}, 450_000, 1_770_000_000),
        TableRow("+ EMA", ("detection", "lane"), {name: 0.816, "paper/lane/iou": 0.276}, 590_000, 1_690_000_000),
    )
    head, _, first, second = TableResult("Parts", rows, True, compare="Baseline").summary().splitlines()[4:]
    assert head.startswith("| Method | Recall (%) | ")
    assert first == "| Baseline | 78.4 | - | - | - | - | 0.45 | 1.77 |"
    assert second == "| + EMA | 81.6 (+3.2) | - | - | - | 27.6 | 0.59 (+0.14) | 1.69 (-0.08) |"
    head, _, first, second = TableResult("Parts", rows, True, tick_tasks=True).summary().splitlines()[4:]
    assert head.startswith("| Det | DA | LL | Recall (%) | ")
    assert first == "| ✓ | ✓ | ✓ | 78.4 | - | - | - | - | 0.45 | 1.77 |"
    assert second.startswith("| ✓ |  | ✓ | 81.6 | - | - | - | 27.6 | 0.59 |")


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ("compare: Al", "compare names no row; did you mean 'All'"),
        ("compares: All", "unknown key 'compares'; did you mean 'compare'"),
        ("tick_tasks: 2", "tick_tasks must be true or false, got 2"),
    ],
)
def test_a_table_that_says_what_is_not_known_is_refused(tmp_path: Path, more: str, told: str) -> None:
    (tmp_path / "t.yaml").write_text(f"title: Parts\nrows: {{All: a.yaml}}\n{more}\n")
    with pytest.raises(ConfigError, match=rf"t\.yaml: {told}"):
        train_table(tmp_path / "t.yaml", data=tmp_path, output=tmp_path / "runs")


def test_a_table_is_trained_once_and_printed(scenes: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    (tmp_path / "a.yaml").write_text("tasks: [drivable]\nvariant: tiny\n")
    (tmp_path / "b.yaml").write_text("base: a.yaml\npcaa: false\n")
    table = tmp_path / "t.yaml"
    table.write_text("title: Parts\ncompare: With\nrows: {With: a.yaml, Without: b.yaml}\n")
    more = settings(scenes, tmp_path, max_steps=1, val_split="val", epochs=1, pictures=0)
    more = {key: list(value) if isinstance(value, tuple) else value for key, value in more.items()}
    more.pop("data"), more.pop("output")
    for _ in range(2):
        result = train_table(table, data=scenes, output=tmp_path / "runs", settings=yaml.safe_dump(more))
    text = result.summary()
    assert re.search(r"\| With \| - \| - \| \d+\.\d \| - \| - \| 0\.0\d \| 0\.0\d \|", text)
    assert re.search(r"\| Without \| - \| - \| \d+\.\d \([+-]\d+\.\d\) \| - \| - \| 0\.0\d \(-0\.0\d\) \|", text)
    assert (tmp_path / "runs" / "t.md").read_text(encoding="utf-8") == text + "\n"
    assert result.rows[1].parameters < result.rows[0].parameters
    assert result.exit_code == 0
    again: dict[str, Any] = {"data": scenes, "output": tmp_path / "runs"}
    with pytest.raises(OutputError, match=r"runs/a: was trained with epochs 1, now 2 is asked for; give another"):
        train_table(table, **again, settings=yaml.safe_dump(more | {"epochs": 2}))
    (tmp_path / "b.yaml").write_text("base: a.yaml\npcaa: false\naugmentation: {flip: 0.1}\n")
    with pytest.raises(OutputError, match=r"runs/b: was trained with augmentation\.flip 0\.5, now 0\.1 is asked"):
        train_table(table, **again, settings=yaml.safe_dump(more))
    (tmp_path / "b.yaml").write_text("base: a.yaml\npcaa: false\n")
    data = shutil.copytree(scenes, tmp_path / "data")
    moved: dict[str, Any] = again | {"data": data, "settings": yaml.safe_dump(more | {"workers": 1})}
    assert train_table(table, **moved).summary() == text
    next((data / "da_seg_annotations" / "train").iterdir()).unlink()
    with pytest.raises(OutputError, match="runs/a: was trained on other images or labels of the same names;"):
        train_table(table, **moved)
    (tmp_path / "runs" / "a" / "config.yaml").unlink()
    with pytest.raises(OutputError, match="what it was trained with cannot be told"):
        train_table(table, **moved)


@pytest.fixture
def table(scenes: Path, tmp_path: Path) -> Callable[..., TableResult]:
    """Return what trains a table of one row, of at most six steps, two an epoch."""
    pytest.importorskip("matplotlib")
    (tmp_path / "a.yaml").write_text("tasks: [drivable]\n")
    (tmp_path / "t.yaml").write_text("title: Parts\nrows: {All: a.yaml}\n")

    def run(*, resume: bool = False, **more: Any) -> TableResult:
        plain = settings(scenes, tmp_path, **{"epochs": 3, **more})
        plain = {key: list(value) if isinstance(value, tuple) else value for key, value in plain.items()}
        del plain["data"], plain["output"]
        text = yaml.safe_dump(plain)
        return train_table(tmp_path / "t.yaml", data=scenes, output=tmp_path / "runs", resume=resume, settings=text)

    return run


@pytest.fixture
def stopped(table: Callable[..., TableResult], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of the table's row, stopped after three steps."""
    with stopping_at(3, monkeypatch):
        assert not table().finished
    return tmp_path / "runs" / "a"


@contextlib.contextmanager
def stopping_at(step: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Ask runs to stop in one of their steps, counted from 1."""
    plain = Trainer._train_step

    def train_step(self: Trainer, batches: Any) -> Any:
        if self.step == step - 1:
            os.kill(os.getpid(), signal.SIGINT)
        return plain(self, batches)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_train_step", train_step)
        yield


def test_a_row_that_was_stopped_is_never_trained_anew_unasked(
    table: Callable[..., TableResult], stopped: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[int] = []
    plain = Trainer._train_step

    def train_step(self: Trainer, batches: Any) -> Any:
        steps.append(self.step)
        return plain(self, batches)

    monkeypatch.setattr(Trainer, "_train_step", train_step)
    before = (stopped / "last.ckpt").read_bytes()
    with pytest.raises(OutputError, match=r"runs/a: holds a run that was stopped; --resume goes on with it, or remove"):
        table()
    assert (stopped / "last.ckpt").read_bytes() == before
    assert table(resume=True).finished
    assert steps == [3, 4, 5]
    assert read_card(stopped / "final.safetensors").provenance["steps"] == "6"
    (stopped / "final.safetensors").unlink()
    (stopped / "last.ckpt").unlink()  # as of one that was killed before it
    with pytest.raises(OutputError, match="holds a run that was stopped"):
        table()
    assert table(resume=True).finished
    assert state(stopped)["step"] == 6


def test_a_row_goes_on_with_its_own_settings_alone(table: Callable[..., TableResult], stopped: Path) -> None:
    with pytest.raises(OutputError, match=r"runs/a: was trained with lr 0\.001, now 0\.01 is asked for; give another"):
        table(resume=True, lr=0.01)
    assert state(stopped)["step"] == 3
    told = yaml.safe_load((stopped / "config.yaml").read_text())
    (stopped / "config.yaml").write_text(yaml.safe_dump(told | {"lr": 0.01}))  # a run that went on, and did no step
    with pytest.raises(OutputError, match=r"was trained with lr 0\.001, now 0\.01"):
        table(resume=True, lr=0.01)
    (stopped / "config.yaml").write_text(yaml.safe_dump(told))
    assert table(resume=True, checkpoint_every=2).finished


def test_a_row_is_done_by_the_weights_of_its_last_step_alone(
    scenes: Path, tmp_path: Path, table: Callable[..., TableResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert table(epochs=1).finished
    folder = tmp_path / "runs" / "a"
    with stopping_at(3, monkeypatch):
        assert not train(tmp_path / "a.yaml", resume=True, **settings(scenes, folder, epochs=3)).finished
    assert read_card(folder / "final.safetensors").provenance["steps"] == "2"
    with pytest.raises(OutputError, match="holds a run that was stopped"):
        table()
    assert table(resume=True).finished
    assert read_card(folder / "final.safetensors").provenance["steps"] == "6"


def test_a_table_leaves_out_a_task_without_labels(scenes: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    data = shutil.copytree(scenes, tmp_path / "data")
    shutil.rmtree(data / "da_seg_annotations" / "val")
    (tmp_path / "a.yaml").write_text("tasks: [drivable, lane]\nvariant: tiny\ninput_size: [64, 128]\nbatch_size: 4\n")
    (tmp_path / "t.yaml").write_text("title: Parts\nrows: {All: a.yaml}\n")
    more = "{epochs: 1, max_steps: 1, workers: 0, device: cpu, precision: 32-true, pictures: 0, loggers: []}"
    result = train_table(tmp_path / "t.yaml", data=data, output=tmp_path / "runs", settings=more)
    assert re.search(r"\| All \| - \| - \| - \| \d+\.\d \| \d+\.\d \|", result.summary())


def test_the_command_line_takes_every_field(scenes: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "r.yaml"
    recipe.write_text(yaml.safe_dump({"data": str(scenes), "input_size": [64, 128], "device": "cpu", "val_split": ""}))
    words = ["train", str(recipe), "--output", str(tmp_path / "run"), "--max-steps", "1", "--batch-size", "2"]
    words += ["--workers", "0", "--augmentation.flip", "0", "--no-spp", "--betas", "0.8", "0.9", "--loggers", "csv"]
    words += ["--sampling", "{timeofday: {night: 2}}", "--precision", "32-true"]
    from trilitenet.apps.cli import main

    assert main(words) == 0
    config = read_recipe(tmp_path / "run" / "config.yaml")
    assert (config.augmentation.flip, config.spp, config.betas) == (0.0, False, (0.8, 0.9))
    assert config.sampling == {"timeofday": {"night": 2.0}}
    assert read_card(tmp_path / "run" / "final.safetensors").blocks == ("pcaa", "litepan")


@pytest.mark.slow
def test_two_processes_follow_one(scenes: Path, tmp_path: Path) -> None:
    """Same batches of four, whole or two and two; batch statistics and the region of Tversky are a process's own."""
    curves = {}
    for devices in (1, 2):
        config = logged(scenes, tmp_path / str(devices), max_steps=6, devices=devices, lr=1e-3)
        if devices == 1:
            assert train(**config).finished
        else:  # by code that is no script that could be run again by a second process
            done = subprocess.run(
                [sys.executable, "-"],
                input=f"import trilitenet; print(trilitenet.train(**{config!r}).summary())",
                check=False,
                capture_output=True,
                text=True,
                timeout=280,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )
            assert done.returncode == 0, done.stderr
            assert done.stdout.count("finished after 6 steps") == 1
        rows = read_csv(tmp_path / str(devices) / "metrics.csv")
        curves[devices] = [value for _, name, value in rows if name == "train/total"]
        parts = [value for step, name, value in rows if step == 1 and "train/" in name and name != "train/total"]
        assert sum(parts) == pytest.approx(curves[devices][0])  # of one process alone it is not
    assert len(curves[1]) == len(curves[2]) == 6
    assert curves[2] == pytest.approx(curves[1], rel=0.1)


@pytest.mark.slow
def test_an_image_that_the_second_process_cannot_read_costs_no_step(scenes: Path, tmp_path: Path) -> None:
    data = shutil.copytree(scenes, tmp_path / "data")
    third = epoch_order(10, seed=0, epoch=0)[6]  # of the second batch: the second process has it
    broken = sorted((data / "images" / "train").iterdir())[third]
    broken.write_bytes(b"broken")
    with pytest.raises(DataError, match=rf"{broken.name}: .*; once that is mended, --resume"):
        train(**settings(data, tmp_path / "run", max_steps=2, devices=2))
    assert state(tmp_path / "run")["step"] == 1


def test_the_first_process_alone_tells_the_result(tmp_path: Path) -> None:
    result = engine.TrainResult(tmp_path, tmp_path / "w", 3, True, {}, {}, 1.0)
    assert result.summary().startswith("finished after 3 steps")
    assert dataclasses.replace(result, first=False).summary() == ""


class _Made(Exception):  # noqa: N818 - no error, but far enough
    """What a run is made of."""


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, Any]]:
    """Return what makes a run but does not train it, and returns what it would be of."""
    found: dict[str, Any] = {}

    def loader(dataset: Any, transform: Any, **options: Any) -> list[None]:
        found.update(options, dataset=dataset, transform=transform)
        return [None]

    def trainer(config: Any, network: Any, loss: Any, loader: Any, fabric: Any, card: Any, **more: Any) -> None:
        found.update(more, config=config, network=network, loss=loss, fabric=fabric, card=card)
        raise _Made

    monkeypatch.setattr("trilitenet.commands.train.build_loader", loader)
    monkeypatch.setattr("trilitenet.commands.train.Trainer", trainer)

    def make(recipe: Path | None = None, **fields: Any) -> dict[str, Any]:
        found.clear()
        with pytest.raises(_Made):
            train(recipe, **fields)
        return dict(found)

    return make


def test_what_a_recipe_says_reaches_the_parts_of_a_run(
    scenes: Path, tmp_path: Path, made: Callable[..., dict[str, Any]]
) -> None:
    (tmp_path / "own.yaml").write_text("{}")
    own = (np.array(DEFAULT_ANCHORS) * 1.5).round(3).tolist()
    more: dict[str, Any] = {
        "accumulate": 2, "seed": 7, "samples_per_epoch": 9, "workers": 3, "anchors": own, "pcaa": False,
        "freeze": ("lane",), "classes": ("car", "bus"), "sampling": {"timeofday": {"night": 2.0, "daytime": 0.5}},
        "val_split": "val", "init": "tiny",
    }  # fmt: skip
    parts = made(tmp_path / "own.yaml", **settings(scenes, tmp_path / "run", **more))
    given = {
        name: parts[name] for name in ("batch_size", "seed", "samples_per_epoch", "workers", "pin_memory", "share")
    }
    assert given == {
        "batch_size": 2, "seed": 7, "samples_per_epoch": 9, "workers": 3, "pin_memory": False, "share": (0, 1)
    }  # fmt: skip
    assert set(parts["weights"]) <= {0.5, 1.0, 2.0}
    network, card = parts["network"], parts["card"]
    assert (card.blocks, card.class_names, card.input_size) == (("litepan", "spp"), ("car", "bus"), (64, 128))
    torch.testing.assert_close(network.anchors, torch.tensor(own))
    assert card.provenance == {"recipe": "own.yaml", "seed": "7", "initial weights": "tiny"}
    assert card.training_data == (f"{scenes.name} (train): 10 images",)
    assert {parameter.requires_grad for parameter in network.lane.parameters()} == {False}
    assert all(parameter.requires_grad for parameter in network.encoder.parameters())
    assert [part["images"] for part in parts["identity"]["parts"]] == [10]
    assert parts["teacher"] is None
    other, plain = (
        made(**settings(scenes, tmp_path / "run", **options))
        for options in ({"seed": 8, "litepan": False}, {"spp": False})
    )
    assert (other["card"].blocks, plain["card"].blocks) == (("pcaa", "spp"), ("pcaa", "litepan"))
    assert (plain["weights"], plain["validate"], plain["card"].provenance["recipe"]) == (None, None, "defaults")


def test_the_seed_decides_the_first_weights(scenes: Path, tmp_path: Path, made: Callable[..., dict[str, Any]]) -> None:
    first, again, other = (
        made(**settings(scenes, tmp_path, seed=seed))["network"].encoder.level1.conv.weight for seed in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize(
    ("tasks", "cure"), [(TASKS, "; --tasks lane leaves detection out"), (("detection", "drivable"), "")]
)
def test_where_there_is_no_box_what_can_be_trained_instead_is_told(
    scenes: Path, tmp_path: Path, tasks: tuple[Task, ...], cure: str
) -> None:
    data = shutil.copytree(scenes, tmp_path / "data", ignore=shutil.ignore_patterns("da_seg_annotations"))
    for file in (data / "det_annotations/train").iterdir():
        file.write_text('{"frames": [{"objects": []}]}')
    options = settings(data, tmp_path / "run", auto_anchor=True, tasks=tasks)
    with pytest.raises(DataError, match=f"data: no image of train has a box{cure}$"):
        train(**options)
    box = '{"category": "%s", "box2d": {"x1": 1, "y1": 2, "x2": 30, "y2": 40}}'
    file.write_text(f'{{"frames": [{{"objects": [{box % "bicycle"}]}}]}}')
    classes = "; --classes says what is learnt" + cure.replace(";", ",")
    with pytest.raises(DataError, match=f"data: no box of train is of truck or bus, but of bicycle{classes}$"):
        train(**options, classes=("truck", "bus"))
    file.write_text(f'{{"frames": [{{"objects": [{box % "bus"}]}}]}}')
    with pytest.raises(DataError, match="1 boxes of 1 sizes are too few to fit 9 anchors; train with --no-auto-anchor"):
        train(**options, classes=("truck", "bus"))
    ignored = box.replace("{", '{"attributes": {"crowd": true}, ', 1) % "bus"
    file.write_text(f'{{"frames": [{{"objects": [{ignored}]}}]}}')
    with pytest.raises(DataError, match="0 boxes of 0 sizes are too few"):
        train(**options, classes=("truck", "bus"))


def test_anchors_are_fitted_to_the_boxes_unless_others_are_known(
    scenes: Path, tmp_path: Path, made: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    default = build_network("tiny").anchors
    options = settings(scenes, tmp_path, auto_anchor=True, anchor_recall=1.1)
    fitted = made(**options)["network"].anchors
    assert not torch.allclose(fitted, default)
    capsys.readouterr()
    own = (np.array(DEFAULT_ANCHORS) * 1.5).tolist()
    for more in ({"anchors": own}, {"tasks": ("lane",)}, {"auto_anchor": False}):
        made(**options | more)
        assert "anchors" not in capsys.readouterr().err
    # Those of weights that are taken over give way to ones that fit better.
    initial = load_network("tiny").anchors
    assert not torch.allclose(made(**options, init="tiny")["network"].anchors, initial, rtol=0.1)
    masks = build_network("tiny", 1, ("lane",))
    save_network(masks, tmp_path / "lane.safetensors", masks.card)
    fits = options | {"anchor_recall": 0.0, "init": str(tmp_path / "lane.safetensors")}
    torch.testing.assert_close(made(**fits)["network"].anchors, default)
    assert made(**fits)["card"].provenance["initial weights"] == "lane.safetensors"


def test_a_head_of_initial_weights_goes_by_the_names_of_its_classes(
    scenes: Path, tmp_path: Path, made: Callable[..., dict[str, Any]], caplog: pytest.LogCaptureFixture
) -> None:
    network = build_network("tiny", 2)
    path = tmp_path / "two.safetensors"
    save_network(network, path, dataclasses.replace(network.card, class_names=("person", "car")))
    rows = network.state_dict()["detection.convs.0.weight"].view(3, 7, -1)

    def taken(*classes: str, **more: Any) -> torch.Tensor:
        run = made(**settings(scenes, tmp_path / "run", init=str(path), classes=classes, **more))
        weight: torch.Tensor = run["network"].state_dict()["detection.convs.0.weight"]
        return weight.view(3, 7, -1)

    for classes, order in ((("person", "car"), [5, 6]), (("car", "person"), [6, 5])):
        caplog.clear()
        assert torch.equal(taken(*classes, freeze=("detection",)), rows[:, [0, 1, 2, 3, 4, *order]])
        assert "its classes are" not in caplog.text
    assert torch.equal(taken("person", "truck"), rows)
    told = "its classes are person, car, the data set's person, truck"
    assert f"{path}: {told}: the detection head is taken over by place" in caplog.text
    with pytest.raises(ConfigError, match=f"{told}; a frozen detection head cannot learn them"):
        train(**settings(scenes, tmp_path, init=str(path), classes=("person", "truck"), freeze=("detection.convs",)))
    with pytest.raises(
        ConfigError, match="its head tells 2 classes, the data set has 3: a frozen detection head would"
    ):
        train(**settings(scenes, tmp_path, init=str(path), classes=("a", "b", "c"), freeze=("detection",)))
    made(**settings(scenes, tmp_path / "run", init="tiny", classes=("car",), freeze=("detection",)))
    assert "tiny: its classes are vehicle, the data set's car: the detection head is taken" in caplog.text
    caplog.clear()
    for more in ({"classes": ("a", "b"), "tasks": ("lane",)}, {"classes": ("a", "b", "c")}):
        made(**settings(scenes, tmp_path / "run", init=str(path), **more))
    assert "its classes are" not in caplog.text


def test_further_data_are_drawn_by_their_weight(scenes: Path, tmp_path: Path) -> None:
    write_dataset(tmp_path / "own", "val", 2, 5, size=(96, 160))
    config = TrainConfig(data=str(scenes), extra_data={str(tmp_path / "own"): 3.0}, train_split="val")
    mixed = training_data(config)
    assert isinstance(mixed, MixedDataset)
    assert mixed.weights.tolist() == [1, 1, 1, 3, 3]
    named = training_data(dataclasses.replace(config, classes=("bus", "person")))
    assert named.class_names == ("bus", "person")
    data = shutil.copytree(scenes, tmp_path / "data")
    classes: dict[str, tuple[str, ...]] = {"car": ("car",), "lorry": ("truck",)}
    write_description(data, dataclasses.replace(read_description(data), classes=classes))
    assert training_data(dataclasses.replace(config, data=str(data))).class_names == ("car", "lorry")  # of the first


def test_the_cards_of_mixed_data_name_all(
    scenes: Path,
    tmp_path: Path,
    made: Callable[..., dict[str, Any]],
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    more = shutil.copytree(scenes, tmp_path / "more")
    shutil.rmtree(more / "ll_seg_annotations" / "train")
    monkeypatch.chdir(more)
    parts = made(**settings(Path(), tmp_path / "run", extra_data={str(scenes): 1.0}))
    assert parts["card"].training_data == (f"more, {scenes.name} (train): 20 images",)
    assert "no image" not in caplog.text  # one of the two is labelled for lanes


def test_the_loss_is_what_the_recipe_says() -> None:
    config = TrainConfig(
        task_weights=(1.0, 2.0, 3.0),
        balancing="uncertainty",
        box_gains=(0.1, 0.2, 0.3),
        single_class_loss=False,
        label_smoothing=0.4,
        drivable_tversky=(0.6, 0.4),
        lane_tversky=(0.8, 0.2),
        focal=(0.5, 1.5),
    )
    network = build_network("tiny")
    loss = build_loss(config, network)
    assert loss.detection is not None
    boxes, drivable, lane = loss.detection, loss.drivable, loss.lane
    assert torch.equal(boxes.anchors, network.anchors)
    assert (boxes.gains, boxes.single_class_loss, boxes.label_smoothing) == ((0.1, 0.2, 0.3), False, 0.4)
    assert (drivable.alpha, drivable.beta, lane.alpha, lane.beta) == (0.6, 0.4, 0.8, 0.2)
    assert {(part.focal_alpha, part.focal_gamma) for part in (drivable, lane)} == {(0.5, 1.5)}
    assert loss.weights == (1.0, 2.0, 3.0)
    assert loss.log_variance is not None
    assert build_loss(config, build_network("tiny", 1, ("lane",))).detection is None


def test_what_a_run_needs_is_asked_for_before_it_begins(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, Any] = {}

    def fabric(*machine: Any, **more: Any) -> None:
        given.update(more, machine=machine)
        raise _Made

    monkeypatch.setattr("trilitenet.commands.train.running_fabric", fabric)
    with pytest.raises(_Made):
        train(overwrite=True, **logged(scenes, tmp_path, devices=3, num_nodes=2, seed=5))
    assert (given["machine"], given["devices"], given["num_nodes"]) == (("cpu", "32-true"), 3, 2)
    told = json.loads(given["command"][-1])
    assert (told["seed"], told["resume"], told["overwrite"]) == (5, False, True)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match="matplotlib"):
        train(**logged(scenes, tmp_path))
    with pytest.raises(_Made):  # whose page of results has no curves
        train(**settings(scenes, tmp_path))
