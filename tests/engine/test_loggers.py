from __future__ import annotations

import errno
import sys
import threading
from pathlib import Path

import pytest

from trilitenet.engine.loggers import CsvLogger, build_loggers, read_csv
from trilitenet.errors import MissingExtraError


def test_csv_goes_on_without_what_came_after(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    logger = CsvLogger(path)
    for step in range(1, 5):
        logger.log({"loss": step / 3}, step)
    assert read_csv(path)[-1] == (4, "loss", 4 / 3)  # at once: a run that is killed keeps it
    logger.close()
    logger = CsvLogger(path, step=2)
    logger.log({"loss": 9.0}, 3)
    logger.close()
    assert read_csv(path) == [(1, "loss", 1 / 3), (2, "loss", 2 / 3), (3, "loss", 9.0)]


def test_csv_goes_on_without_a_validation_that_is_done_anew(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    figures = {"train/total": 0.5, "val/lane/iou": 0.1}
    logger = CsvLogger(path)
    logger.log(figures, 2)
    logger.log(figures, 4)
    logger.close()
    CsvLogger(path, step=4, validated=2).close()
    assert read_csv(path) == [(2, "train/total", 0.5), (2, "val/lane/iou", 0.1), (4, "train/total", 0.5)]


def test_a_line_that_was_cut_off_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    for end in (b"8,val/lan", b"8", b"8,val/lane,0.", b"8,val/lane,x\n", b"8,val/lan\xff"):
        path.write_bytes(b"step,name,value\n4,loss,2.0\n" + end)
        logger = CsvLogger(path, 7)
        logger.log({"loss": 1.0}, 8)
        logger.close()
        assert read_csv(path) == [(4, "loss", 2.0), (8, "loss", 1.0)]


def test_zero_bytes_that_a_machine_left_as_it_went_down_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(b"step,name,value\n4,loss,2.0\n" + bytes(64) + b"8,loss,1.0\n" + bytes(64))
    assert read_csv(path) == [(4, "loss", 2.0), (8, "loss", 1.0)]


def test_a_new_run_starts_the_file_anew(tmp_path: Path) -> None:
    for _ in range(2):
        logger = CsvLogger(tmp_path / "m.csv")
        logger.log({"a": 1}, 1)
        logger.close()
    assert len(read_csv(tmp_path / "m.csv")) == 1


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_tensorboard_writes_events(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    (logger,) = build_loggers(["tensorboard", "tensorboard"], tmp_path, {})
    logger.log({"train/total": 1.0}, 1)
    logger.close()
    assert list((tmp_path / "tensorboard").glob("events.*"))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_disk_that_tensorboard_finds_full_is_told_by_the_next_call_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    record_writer = pytest.importorskip("tensorboard.summary.writer.record_writer")
    hook = threading.excepthook
    (logger,) = build_loggers(["tensorboard"], tmp_path, {})

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(record_writer.RecordWriter, "write", full)
    logger.log({"train/total": 1.0}, 1)
    for thread in threading.enumerate():
        if type(thread).__module__.startswith("tensorboard."):
            thread.join()
    with pytest.raises(OSError, match="No space left"):
        logger.log({"train/total": 1.0}, 2)
    with pytest.raises(OSError, match="No space left"):
        logger.close()
    assert capsys.readouterr().err == ""
    assert threading.excepthook is hook


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_tensorboard_takes_back_its_own_hook_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tensorboard")

    def other(_: object) -> None:
        """Stand for what a tool that collects errors sets while a run is under way."""

    monkeypatch.setattr(threading, "excepthook", threading.excepthook)  # put back at the end
    (logger,) = build_loggers(["tensorboard"], tmp_path, {})
    threading.excepthook = other
    logger.close()
    assert threading.excepthook is other


@pytest.mark.parametrize("name", ["mlflow", "wandb"])
def test_a_missing_package_names_its_extra(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=rf"trilitenet\[{name}\]"):
        build_loggers([name], tmp_path, {})


def test_mlflow_and_wandb_are_told_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[object] = []

    class Fake:
        def init(self, **settings: object) -> Fake:
            told.append(settings["config"])
            return self

        def start_run(self, run_name: str) -> None:
            told.append(run_name)

        def log_params(self, values: object) -> None:
            told.append(values)

        def log(self, values: object, step: int) -> None:
            told.append((values, step))

        log_metrics = log

        def finish(self) -> None:
            told.append("end")

        end_run = finish

    monkeypatch.setitem(sys.modules, "mlflow", Fake())
    monkeypatch.setitem(sys.modules, "wandb", Fake())
    for logger in build_loggers(["mlflow", "wandb"], tmp_path / "run", {"lr": 1, "classes": "x" * 300}):
        logger.log({"loss": 2.0}, 5)
        logger.close()
    shown = {"lr": "1", "classes": "x" * 250}  # MLflow takes no more of each
    ends = [({"loss": 2.0}, 5), "end"]
    assert told == ["run", shown, {"lr": 1, "classes": "x" * 300}, *ends, *ends]


@pytest.mark.parametrize(("step", "purged"), [(0, None), (7, 8)])
def test_tensorboard_forgets_what_came_after(
    step: int, purged: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[object] = []

    class Fake:
        @staticmethod
        def SummaryWriter(folder: str, *, purge_step: int | None) -> None:  # noqa: N802
            told.append(purge_step)

    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", Fake())
    build_loggers(["tensorboard"], tmp_path, {}, step)
    assert told == [purged]
