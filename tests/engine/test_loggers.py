from __future__ import annotations

import errno
import json
import re
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from trilitenet.engine import loggers
from trilitenet.engine.loggers import CsvLogger, RunEnd, build_loggers, read_csv
from trilitenet.errors import MissingExtraError, TrainingError


class Server:
    """Stands for the packages of MLflow and W&B: notes what it is told, and refuses some of it."""

    def __init__(self) -> None:
        self.told: list[tuple[object, ...]] = []
        self.refuses: set[str] = set()

    def _take(self, call: str, *what: object) -> None:
        self.told.append((call, *what))
        if call in self.refuses:
            raise Exception(f"no connection\nat {call}")

    def start_run(self, *, run_id: str | None, run_name: str) -> SimpleNamespace:
        self._take("start_run", run_name, run_id)
        return SimpleNamespace(info=SimpleNamespace(run_id=run_id or "m1"))

    def log_params(self, values: Mapping[str, str]) -> None:
        self._take("log_params", values)

    def log_metrics(self, values: Mapping[str, float], *, step: int) -> None:
        self._take("log_metrics", values, step)

    def end_run(self, status: str) -> None:
        self._take("end_run", status)

    def init(self, *, name: str, config: Any, id: str | None, resume: str | None, **_: str) -> SimpleNamespace:
        self._take("init", name, config, id, resume)
        return SimpleNamespace(
            id=id or "w1",
            define_metric=lambda name, step_metric: self._take("define_metric", name, step_metric),
            log=lambda values: self._take("log", values),
            finish=lambda exit_code: self._take("finish", exit_code),
        )


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Server:
    server = Server()
    for name in ("mlflow", "wandb"):
        monkeypatch.setitem(sys.modules, name, server)
    return server


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


@pytest.mark.parametrize(
    ("end", "status", "code"), [("finished", "FINISHED", 0), ("stopped", "KILLED", 130), ("failed", "FAILED", 1)]
)
def test_mlflow_and_wandb_are_told_everything(
    server: Server, tmp_path: Path, end: RunEnd, status: str, code: int
) -> None:
    config = {"lr": 1, "classes": "x" * 300}
    for logger in build_loggers(["mlflow", "wandb"], tmp_path / "run", config):
        logger.log({"loss": 2.0}, 5)
        logger.close(end)
    assert server.told == [
        ("start_run", "run", None),
        ("log_params", {"lr": "1", "classes": "x" * 250}),  # MLflow takes no more of each
        ("init", "run", config, None, None),
        ("define_metric", "*", "step"),
        ("log_metrics", {"loss": 2.0}, 5),
        ("end_run", status),
        ("log", {"loss": 2.0, "step": 5}),
        ("finish", code),
    ]


def test_servers_go_on_with_the_run_they_know(server: Server, tmp_path: Path) -> None:
    build_loggers(["mlflow", "wandb"], tmp_path, {})
    server.told.clear()
    build_loggers(["mlflow"], tmp_path, {"lr": 2}, step=7)
    assert server.told == [("start_run", tmp_path.name, "m1")]  # MLflow lets no parameter be changed
    build_loggers(["wandb"], tmp_path, {"lr": 2}, step=7)  # of which the run in between has told nothing
    assert server.told[1] == ("init", tmp_path.name, {"lr": 2}, "w1", "allow")
    assert json.loads((tmp_path / "loggers.json").read_text()) == {"mlflow": "m1", "wandb": "w1"}
    server.refuses = {"start_run"}  # as one that has no such run
    with pytest.raises(TrainingError, match=r"remove .*loggers\.json to begin another run there, or leave it out of"):
        build_loggers(["mlflow"], tmp_path, {}, step=7)


@pytest.mark.parametrize(("content", "step"), [('{"mlflow": "m', 7), ("[]", 7), ('{"mlflow": "m9"}', 0)])
def test_servers_begin_a_run_where_none_is_known(server: Server, tmp_path: Path, content: str, step: int) -> None:
    (tmp_path / "loggers.json").write_text(content)
    build_loggers(["mlflow"], tmp_path, {}, step)
    assert server.told[0] == ("start_run", tmp_path.name, None)
    assert json.loads((tmp_path / "loggers.json").read_text()) == {"mlflow": "m1"}


@pytest.mark.parametrize(
    ("refused", "names", "see", "ended"),
    [
        ("start_run", ["csv", "mlflow"], "MLFLOW_TRACKING_URI", []),
        ("init", ["csv", "mlflow", "wandb"], "`wandb login` and WANDB_MODE", [("end_run", "FAILED")]),
    ],
)
def test_a_server_that_refuses_a_run_is_told_before_anything_is_made(
    server: Server, tmp_path: Path, refused: str, names: list[str], see: str, ended: list[tuple[str, str]]
) -> None:
    server.refuses = {refused}
    told = f"{names[-1]}: cannot log (no connection at {refused}); see {see}, or leave it out of --loggers"
    with pytest.raises(TrainingError, match=f"^{re.escape(told)}$"):
        build_loggers(names, tmp_path, {}, begin=lambda: pytest.fail("the earlier run would be gone"))
    assert not list(tmp_path.iterdir())
    assert [call for call in server.told if call[0] in ("end_run", "finish")] == ended


def test_a_run_that_cannot_begin_in_its_folder_is_ended_at_its_server(server: Server, tmp_path: Path) -> None:
    def begin() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        build_loggers(["mlflow"], tmp_path, {}, begin=begin)
    assert server.told[-1] == ("end_run", "FAILED")


def test_a_server_that_fails_is_told_once_and_ends_nothing(
    server: Server, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loggers, "time", SimpleNamespace(monotonic=lambda: 0.0))  # it fails at once
    server.refuses = {"log_params", "log_metrics", "end_run", "log", "finish"}
    both = build_loggers(["mlflow", "wandb", "csv"], tmp_path, {"lr": 1})
    for step in (1, 2):
        for logger in both:
            logger.log({"loss": 2.0}, step)
    for logger in both:
        logger.close()
    reasons = {"mlflow": "log_params", "wandb": "log"}
    assert caplog.messages == [
        f"{name}: cannot log (no connection at {call}); the run goes on, and may miss figures there"
        for name, call in reasons.items()
    ]
    assert read_csv(tmp_path / "metrics.csv") == [(1, "loss", 2.0), (2, "loss", 2.0)]
    assert sum(call[0] == "log_metrics" for call in server.told) == 2  # it may be back


def test_a_server_that_is_long_in_failing_is_left_alone_for_a_while(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    (logger,) = build_loggers(["mlflow"], tmp_path, {})

    def log_metrics(values: Mapping[str, float], *, step: int) -> None:
        nonlocal now
        tried.append(step)
        now += 4.0
        if step == 1:
            raise TimeoutError

    tried: list[int] = []
    monkeypatch.setattr(server, "log_metrics", log_metrics)
    monkeypatch.setattr(loggers, "time", SimpleNamespace(monotonic=lambda: now))
    for step, pause in enumerate((0.0, 39.0, 1.0, 0.0), 1):
        now += pause
        logger.log({"loss": 2.0}, step)
    assert tried == [1, 3, 4]


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
