from __future__ import annotations

import errno
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from trilitenet.engine.checkpoint import (
    CHECKPOINT_SCHEMA,
    random_state,
    read_checkpoint,
    set_random_state,
    write_checkpoint,
)
from trilitenet.errors import OutputError, WeightsError


def whole(**fields: Any) -> dict[str, Any]:
    """Return all that a checkpoint must hold."""
    names = ("config", "network", "optimiser", "loss", "scaler", "best", "metrics", "random")
    numbers = dict.fromkeys(("classes", "step", "stale", "ended"), 0)
    return {**numbers, "data": None, "ema": None, **{name: {} for name in names}, **fields}


def test_state_goes_round(tmp_path: Path) -> None:
    path = tmp_path / "run" / "last.ckpt"
    write_checkpoint(path, whole(step=3, network={"w": torch.arange(3)}))
    state = read_checkpoint(path)
    assert state["step"] == 3
    assert state["network"]["w"].tolist() == [0, 1, 2]
    assert [file.name for file in path.parent.iterdir()] == ["last.ckpt"]


def test_random_states_go_round(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "c", whole(random=random_state()))

    def draw() -> list[float]:
        return [float(torch.rand(())), float(np.random.rand()), random.random()]  # noqa: NPY002

    first = draw()
    set_random_state(read_checkpoint(tmp_path / "c")["random"])
    assert draw() == first


def test_the_second_of_two_normal_numbers_comes_after_the_first(tmp_path: Path) -> None:
    np.random.seed(0)  # noqa: NPY002
    np.random.standard_normal()  # noqa: NPY002 - they are drawn in pairs, and the other one is kept
    write_checkpoint(tmp_path / "c", whole(random=random_state()))
    second = np.random.standard_normal()  # noqa: NPY002
    np.random.standard_normal()  # noqa: NPY002
    set_random_state(read_checkpoint(tmp_path / "c")["random"])
    assert np.random.standard_normal() == second  # noqa: NPY002


def test_a_checkpoint_is_on_the_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "last.ckpt"
    named: list[bool] = []
    monkeypatch.setattr("os.fsync", lambda number: named.append(path.exists()))
    write_checkpoint(path, whole())
    assert named == [False]


def test_killed_in_the_middle_of_writing_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    write_checkpoint(path, whole(step=1))
    script = f"""
import os, signal, torch
from trilitenet.engine import checkpoint
def half(state, file):
    file.write(b"PK half a file"); file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
torch.save = half
checkpoint.write_checkpoint({str(path)!r}, {{"step": 2}})
"""
    done = subprocess.run([sys.executable, "-c", script], check=False, timeout=120)
    assert done.returncode == -9
    assert read_checkpoint(path)["step"] == 1
    write_checkpoint(path, whole(step=3))
    assert read_checkpoint(path)["step"] == 3


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 cut", b"\x80\x02."])
def test_a_damaged_file_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.ckpt"
    path.write_bytes(content)
    with pytest.raises(WeightsError, match=r"bad\.ckpt: is not a checkpoint"):
        read_checkpoint(path)


def test_a_missing_file_and_a_newer_layout_are_refused(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="no such checkpoint"):
        read_checkpoint(tmp_path / "none.ckpt")
    torch.save({"schema": CHECKPOINT_SCHEMA + 1}, tmp_path / "new.ckpt")
    with pytest.raises(WeightsError, match="newer than this version"):
        read_checkpoint(tmp_path / "new.ckpt")


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"schema": 1}, r"damaged \('config' is missing\); start anew"),
        ({"schema": "x"}, "is not a checkpoint"),
        ({"schema": 1} | whole(step="3"), "'step' is of the wrong type"),
        ({"schema": 1} | whole(ema=[]), "'ema' is of the wrong type"),
        (whole(), "is not a checkpoint"),
        ([1], "is not a checkpoint"),
    ],
)
def test_what_a_checkpoint_lacks_is_named(tmp_path: Path, state: object, message: str) -> None:
    torch.save(state, tmp_path / "bad.ckpt")
    with pytest.raises(WeightsError, match=message):
        read_checkpoint(tmp_path / "bad.ckpt")


def test_code_in_a_file_is_not_run(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (Path.touch, (str(tmp_path / "ran"),))

    torch.save({"schema": 1, "x": Evil()}, tmp_path / "evil.ckpt")
    with pytest.raises(WeightsError, match="is not a checkpoint"):
        read_checkpoint(tmp_path / "evil.ckpt")
    assert not (tmp_path / "ran").exists()


def test_a_place_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write the checkpoint"):
        write_checkpoint(tmp_path / "file" / "last.ckpt", {})


def test_a_full_disk_is_told_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def save(*arguments: object) -> None:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError:
            raise RuntimeError("unexpected pos 64 vs 0")  # noqa: B904 - as PyTorch does

    monkeypatch.setattr("torch.save", save)
    with pytest.raises(OutputError, match="No space left on device"):
        write_checkpoint(tmp_path / "last.ckpt", whole())
    assert list(tmp_path.iterdir()) == []
