from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

from trilitenet.commands import energy
from trilitenet.commands.energy import energy_meters


def readings(*backends: str) -> list[float | None]:
    with energy_meters(backends) as meters:
        return [meter() for meter in meters]


class NVMLError(Exception):
    """As NVML's."""

    __module__ = "pynvml"


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with three GPUs, the third of which tells nothing, whose folders of counters and programs are empty."""

    def joules(gpu: int) -> int:
        if gpu == 2:
            raise NVMLError("Not Supported")
        return 5000 + gpu

    def by_name(uuid: str) -> int:
        if uuid not in ("GPU-a", "GPU-b"):
            raise NVMLError("Not Found")
        return int(uuid == "GPU-b")

    nvml = SimpleNamespace(
        nvmlInit=lambda: None,
        nvmlDeviceGetHandleByIndex=lambda index: index,
        nvmlDeviceGetHandleByUUID=by_name,
        nvmlDeviceGetTotalEnergyConsumption=joules,
    )
    monkeypatch.setitem(sys.modules, "pynvml", nvml)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(energy, "Path", lambda name: tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    return tmp_path


def test_energy_is_that_of_what_the_model_runs_on(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    counter = machine / "intel-rapl:0" / "energy_uj"
    counter.parent.mkdir()
    counter.write_text("7500000\n")
    backends = ("torch cuda", "torch cuda:1 graph", "torch cuda:2", "openvino cpu fp32")
    assert readings(*backends) == [5.0, 5.001, None, 7.5]
    monkeypatch.setattr("trilitenet.commands.energy.os.access", lambda *_: False)  # as most systems keep it
    assert readings("torch cpu") == [None]


def test_all_packages_count_and_go_on_where_their_counters_begin_anew(machine: Path) -> None:
    def write(folder: str, **values: object) -> None:
        (machine / folder).mkdir(exist_ok=True)
        for file, value in values.items():
            (machine / folder / file).write_text(f"{value}\n")

    for number, microjoules in enumerate((1_000_000, 5_000_000)):
        write(f"intel-rapl:{number}", name=f"package-{number}", energy_uj=microjoules, max_energy_range_uj=9_000_000)
    write("intel-rapl:0:0", name="core", energy_uj=400_000, max_energy_range_uj=9_000_000)
    write("intel-rapl:2", name="psys", energy_uj=70_000_000, max_energy_range_uj=90_000_000)
    with energy_meters(["openvino cpu fp32"]) as (meter,):
        assert meter() == 6.0
        write("intel-rapl:1", energy_uj=500_000)
        assert meter() == 10.5


@pytest.mark.parametrize(
    ("shown", "joules"),
    [("1,0", [5.001, 5.0]), ("GPU-b, GPU-a", [5.001, 5.0]), ("1", [5.001, None]), ("", [None, None])],
)
def test_gpus_are_counted_as_cuda_does(
    machine: Path, monkeypatch: pytest.MonkeyPatch, shown: str, joules: list[float | None]
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", shown)
    assert readings("torch cuda", "torch cuda:1") == joules


def tegrastats(folder: Path, *commands: str) -> None:
    program = folder / "tegrastats"
    program.write_text("\n".join(["#!/bin/sh", f'echo "$@" >> {folder}/started', *commands]) + "\n")
    program.chmod(0o755)


@pytest.mark.skipif(sys.platform == "win32", reason="the program is a shell script")
def test_where_nothing_else_tells_it_is_that_of_the_board(machine: Path) -> None:
    tegrastats(machine, "echo RAM 1/2MB", "echo RAM 1/2MB VDD_IN 4000mW/4000mW", "exec sleep 60")
    with energy_meters(["torch cuda:2", "torch cuda", "torch cpu"]) as (gpu, other, cpu):
        assert other() == 5.0
        before, first = time.perf_counter(), gpu()
        time.sleep(0.02)
        last, after = cpu(), time.perf_counter()
    assert first is not None
    assert last is not None
    assert 4 * 0.02 <= last - first <= 4 * (after - before)
    assert (machine / "started").read_text() == "--interval 100\n"


@pytest.mark.skipif(sys.platform == "win32", reason="the program is a shell script")
@pytest.mark.parametrize("commands", [["echo RAM 1/2MB", "exec sleep 60"], ["exit 1"]], ids=["no rails", "failed"])
def test_a_board_that_tells_nothing(machine: Path, commands: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> None:
    tegrastats(machine, *commands)
    monkeypatch.setattr(energy, "_PATIENCE", 0.05)
    assert readings("torch cpu") == [None]


@pytest.mark.parametrize(
    ("line", "watts"),
    [
        ("RAM 2448/7772MB (lfb 1x4MB) SWAP 0/3886MB CPU [1%@729,0%@729] EMC_FREQ 0% GR3D_FREQ 0% tj@47C", None),
        ("RAM 1/2MB GR3D_FREQ 61%@[305] VDD_IN 4236mW/4200mW VDD_CPU_GPU_CV 1084mW/900mW VDD_SOC 1084mW/900mW", 4.236),
        ("RAM 1/3964MB IRAM 0/252kB(lfb 252kB) APE 25 POM_5V_IN 3101/3000 POM_5V_GPU 80/80 POM_5V_CPU 484/500", 3.101),
        ("RAM 1/2MB thermal@33.55C GPU 155/155 CPU 310/310 SOC 1555/1555 CV 0/0 VDDRQ 310/310 SYS5V 1917/1917", 4.247),
        (
            "tj@45C VDD_GPU_SOC 3205mW/3200mW VDD_CPU_CV 801mW/800mW VIN_SYS_5V0 4245mW/4200mW NC 0mW/0mW "
            "VDDQ_VDD2_1V8AO 606mW/600mW NC 0mW/0mW",
            8.251,
        ),
    ],
    ids=["no rails", "Orin NX and Nano", "Nano", "AGX Xavier", "AGX Orin"],
)  # fmt: skip
def test_the_power_of_a_board(line: str, watts: float | None) -> None:
    assert energy._board_watts(line) == (None if watts is None else pytest.approx(watts))
