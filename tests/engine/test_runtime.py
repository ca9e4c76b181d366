"""Two processes on the CPU: the first in this one, or in one of its own where it is to be ended."""

from __future__ import annotations

import contextlib
import os
import platform
import signal
import socket
import subprocess
import sys
import threading
import time
import types
import weakref
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch

from trilitenet.engine import runtime
from trilitenet.errors import ConfigError, DataError, TrainingError

pytest.importorskip("lightning_fabric")

SCRIPT = """
import os, pathlib, signal, sys, time, torch
from trilitenet.engine import runtime
from trilitenet.errors import DataError, TriLiteNetError
runtime._GRACE = 1.0
second = "LOCAL_RANK" in os.environ
code = sys.argv[1 + second]
if second:
    runtime.follow()
try:
    command = [sys.executable, __file__, *sys.argv[1:]]
    with runtime.running_fabric("cpu", "32-true", devices=2, command=command) as fabric:
        exec(code)
except TriLiteNetError as error:
    sys.exit(f"error: {error}")
"""
"""Takes the code of the first process and that of the second."""

MEET = "fabric.barrier()"


@pytest.fixture
def script(tmp_path: Path) -> Path:
    path = tmp_path / "script.py"
    path.write_text(SCRIPT)
    return path


def pair(script: Path, second: str) -> Any:
    """Return the context of a run whose second process does as it is told."""
    command = [sys.executable, str(script), "", second]
    return runtime.running_fabric("cpu", "32-true", devices=2, command=command)


def children() -> set[str]:
    """Return the processes that this thread has started."""
    return set(Path(f"/proc/self/task/{threading.get_native_id()}/children").read_text().split())


def ended(pid: int) -> bool:
    """Return whether a process ends within ten seconds."""
    for _ in range(100):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
                time.sleep(0.1)
                continue
        return True
    return False


@pytest.mark.slow
def test_runs_follow_one_another_and_leave_no_trace(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MASTER_ADDR", "192.0.2.1")  # left by something else
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(runtime, "usable_cores", lambda: 6)
    before, threads = dict(os.environ), torch.get_num_threads()
    for _ in range(2):
        with pair(script, "fabric.all_reduce(torch.tensor(3.0))") as fabric:
            assert (fabric.global_rank, fabric.world_size) == (0, 2)
            assert float(fabric.all_reduce(torch.tensor(1.0))) == 2.0
            assert torch.get_num_threads() == 3
    assert not torch.distributed.is_initialized()
    assert (dict(os.environ), torch.get_num_threads()) == (before, threads)


def test_the_first_process_tells_what_the_second_says(script: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with (
        pytest.raises(TrainingError, match=r"^a\.jpg: is broken$"),
        pair(script, "raise DataError('a.jpg: is broken')"),
    ):
        torch.distributed.barrier()
    assert capfd.readouterr().err == ""


def test_a_second_process_that_is_killed_is_told(script: Path) -> None:
    with (
        pytest.raises(TrainingError, match=r"process 1 was killed \(SIGKILL\), .*--resume goes on"),
        pair(script, "os.kill(os.getpid(), signal.SIGKILL)"),
    ):
        torch.distributed.barrier()


def test_the_second_process_is_quiet_when_the_first_fails(script: Path, capfd: pytest.CaptureFixture[str]) -> None:
    others, started = children(), set[str]()

    def fail(fabric: Any) -> None:
        fabric.barrier()
        started.update(children() - others)
        raise DataError("mine")

    with pytest.raises(DataError, match="mine"), pair(script, f"{MEET}; {MEET}") as fabric:
        fail(fabric)
    assert started
    assert all(ended(int(child)) for child in started)
    assert capfd.readouterr().err == ""


def test_a_process_whose_terminal_has_gone_was_killed_too() -> None:
    class Process:
        def poll(self) -> int:
            return -signal.SIGHUP

    others = runtime._Others()
    others._processes = [Process()]  # type: ignore[list-item]
    assert others.reason().startswith("process 1 was killed (SIGHUP)")


@pytest.mark.parametrize(
    ("precision", "device", "cuda", "native", "picked"),
    [
        ("auto", "cuda", True, False, "bf16-mixed"),
        ("auto", "cuda", False, True, "16-mixed"),
        ("auto", "cpu", True, True, "bf16-mixed"),
        ("auto", "cpu", True, False, "32-true"),
        ("auto", "mps", None, True, "32-true"),
        ("16-mixed", "cpu", None, True, "16-mixed"),
    ],
)
def test_the_precision_that_a_device_computes_in(
    precision: str, device: str, cuda: bool | None, native: bool, picked: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A CUDA device that has bf16, or has it not, or none."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda is not None)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda: bool(cuda))
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: native)
    assert runtime.pick_precision(precision, device) == picked


def test_the_first_wish_to_stop_is_noted_and_a_second_ctrl_c_is_one() -> None:
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, signal.default_int_handler) for number in numbers]
    try:
        with runtime.StopRequest() as stop:
            assert not stop
            signal.raise_signal(signal.SIGTERM)
            assert stop
            signal.raise_signal(signal.SIGTERM)  # whoever sends it may repeat it
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert [signal.getsignal(number) for number in numbers] == [signal.default_int_handler] * 2
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def test_a_signal_that_is_put_off_keeps_nothing_of_what_it_came_upon(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[int] = []

    def hear(number: int, frame: FrameType | None) -> None:
        heard.append(number)

    def step() -> weakref.ref[Any]:
        taken = np.zeros(1)
        signal.raise_signal(signal.SIGCHLD)
        return weakref.ref(taken)

    before = signal.signal(signal.SIGCHLD, hear)
    try:
        with runtime.putting_off("SIGCHLD") as heeding:
            kept = [step(), step()]
            assert not heard
            assert [one() for one in kept] == [None, None]
            with heeding():
                assert heard == [signal.SIGCHLD]
                signal.raise_signal(signal.SIGCHLD)
                assert len(heard) == 2
            with heeding():
                assert len(heard) == 2  # each is told once
        assert signal.getsignal(signal.SIGCHLD) is hear
    finally:
        signal.signal(signal.SIGCHLD, before)


def test_a_port_that_is_taken_is_named(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        port = taken.getsockname()[1]
        monkeypatch.setenv("MASTER_PORT", str(port))
        with pytest.raises(ConfigError, match=f"port {port}, .* is taken; set MASTER_PORT"), pair(script, MEET):
            pass
    assert os.environ["MASTER_PORT"] == str(port)
    monkeypatch.delenv("MASTER_PORT")
    with pair(script, MEET) as fabric:  # the next one is as if the first had not been
        fabric.barrier()


def test_processes_that_could_not_meet_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MASTER_PORT", "x")
    with pytest.raises(ConfigError, match="MASTER_PORT must be a number, got 'x'"), pair(Path("none"), ""):
        pass
    monkeypatch.delenv("MASTER_PORT")
    alone = runtime.running_fabric("cpu", num_nodes=2)
    with pytest.raises(ConfigError, match="2 machines: start the command with torchrun"), alone:
        pass


ON_GPUS = """
import types
hosts = runtime.hosts_group(types.SimpleNamespace(world_size=2, device=torch.device("cuda")))
flags = torch.ones(2)
torch.distributed.all_reduce(flags, group=hosts)
"""


def test_processes_with_gpus_talk_from_host_to_host(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pair(script, ON_GPUS) as fabric:
        assert runtime.hosts_group(fabric) is None  # the default one of a CPU does so
        names: dict[str, Any] = {"runtime": runtime, "torch": torch}
        exec(ON_GPUS, names)
        assert torch.distributed.get_backend(names["hosts"]) == "gloo"
        assert names["hosts"] is not torch.distributed.group.WORLD
        assert names["flags"].tolist() == [2.0, 2.0]

    def new_group(**_: object) -> None:
        raise RuntimeError("gloo connectFullMesh failed with ...\n[enforce fail]")

    monkeypatch.setattr(torch.distributed, "new_group", new_group)
    device = torch.device("cuda")
    with pytest.raises(TrainingError, match=r"host to host \(gloo .*\); set GLOO_SOCKET_IFNAME to the network"):
        runtime.hosts_group(types.SimpleNamespace(world_size=2, device=device))
    assert runtime.hosts_group(types.SimpleNamespace(world_size=1, device=device)) is None


@pytest.mark.slow
def test_a_first_process_that_does_not_notice_is_ended(script: Path) -> None:
    words = [sys.executable, str(script), "time.sleep(600)", "raise DataError('a.jpg: is broken')"]
    done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=200)
    assert (done.returncode, done.stderr.splitlines()) == (1, ["a.jpg: is broken"])


@pytest.mark.parametrize("meets", [True, False])
def test_no_process_outlives_the_first(tmp_path: Path, script: Path, *, meets: bool) -> None:
    """Neither one that has met it nor one that waits for it."""
    told = tmp_path / "pid"
    if not meets:
        late = (
            "runtime.follow(); pathlib.Path(sys.argv[0]).with_name('pid').write_text(str(os.getpid())); time.sleep(600)"
        )
        script.write_text(SCRIPT.replace("runtime.follow()", late))
    second = f"pathlib.Path({str(told)!r}).write_text(str(os.getpid())); {MEET}"
    words = [sys.executable, str(script), "time.sleep(600)", second]
    with subprocess.Popen(words) as first:
        for _ in range(1000):
            if told.exists() and told.read_text():
                break
            time.sleep(0.1)
        first.send_signal(signal.SIGKILL)
    assert ended(int(told.read_text()))


@pytest.mark.parametrize(
    ("machine", "native", "kernels", "warned"),
    [
        ("x86_64", True, True, False),
        ("x86_64", False, True, True),  # AVX-512 without bf16, where PyTorch's kernels emulate it
        ("AMD64", False, False, True),
        ("aarch64", False, True, False),
        ("aarch64", False, False, True),
    ],
)
def test_bf16_without_instructions_for_it_is_told(
    machine: str,
    native: bool,
    kernels: bool,
    warned: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: native)
    monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: kernels)
    with runtime.running_fabric("cpu", "bf16-mixed"):
        assert ("--precision 32-true" in caplog.text) == warned
    caplog.clear()
    with runtime.running_fabric("cpu", "auto"), runtime.running_fabric("cpu", "32-true"):
        assert not caplog.text


def test_fp16_on_a_processor_is_refused() -> None:
    told = pytest.raises(ConfigError, match="precision 16-mixed is for GPUs; on a CPU use bf16-mixed or 32-true")
    with told, runtime.running_fabric("cpu", "16-mixed"):
        pass


def test_a_pytorch_that_cannot_tell_of_bf16_computes_in_fp32(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.delattr(torch.cpu, "_is_avx512_bf16_supported")
    assert runtime.pick_precision("auto", "cpu") == "32-true"
    with runtime.running_fabric("cpu", "bf16-mixed"):
        assert "--precision 32-true" in caplog.text
