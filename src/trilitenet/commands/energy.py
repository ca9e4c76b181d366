"""Energy of what a model runs on, from whatever the machine has to tell it."""

from __future__ import annotations

import functools
import os
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final, TypeAlias

from trilitenet.engine.provenance import gpu_index

__all__ = ["Meter", "energy_meters", "gpu_meter"]

Meter: TypeAlias = Callable[[], float | None]
"""Returns the joules since some time, or None where they cannot be read."""

_RAIL: Final = re.compile(r"\b([A-Z]\w*) (\d+)(?:mW)?/\d+(?:mW)?(?!\S)")
"""A rail of `tegrastats`: its name, its milliwatts and their mean, with units or without."""
_PACKAGE: Final = re.compile(r".*-rapl:\d+")
"""What Linux calls the counter of a processor package; parts of it have another number."""
_INTERVAL: Final = 100
"""Milliseconds between two of its lines."""
_PATIENCE: Final = 3.0
"""Seconds in which the first must come."""


@contextmanager
def energy_meters(backends: Sequence[str]) -> Iterator[list[Meter]]:
    """Read, while inside, the energy of what each backend runs on.

    That is the GPU (by NVML) where the backend's name has it, else all processor packages (by RAPL); where these tell
    nothing, the board of a Jetson (by `tegrastats`).

    Args:
        backends: Their names, such as ``"torch cuda:1"``.

    Yields:
        A meter for each.
    """
    with ExitStack() as stack:
        board = functools.cache(functools.partial(_board, stack))  # one, and only where it is needed
        yield [_own_meter(backend) or board() for backend in backends]


def _own_meter(backend: str) -> Meter | None:
    index = gpu_index(backend)
    return _packages() if index is None else gpu_meter(index)


def _packages() -> Meter | None:
    """Return what reads the joules of all processor packages together; None where one cannot be read."""
    folders = [each for each in Path("/sys/class/powercap").glob("*-rapl:*") if _PACKAGE.fullmatch(each.name)]
    folders = [each for each in folders if _word(each / "name", "package").startswith("package")]  # not the platform
    if not folders or not all(os.access(each / "energy_uj", os.R_OK) for each in folders):
        return None
    counters = [_counter(each) for each in folders]
    return lambda: sum(counter() for counter in counters) / 1e6


def _counter(folder: Path) -> Callable[[], int]:
    """Return what reads a counter of microjoules that goes on where the machine's begins anew."""
    span = int(_word(folder / "max_energy_range_uj", "0"))
    last = before = 0

    def read() -> int:
        nonlocal last, before
        now = int(_word(folder / "energy_uj", "0"))
        before += span if now < last else 0
        last = now
        return before + now

    return read


def _word(file: Path, otherwise: str) -> str:
    return file.read_text(encoding="ascii").strip() if file.is_file() else otherwise


def gpu_meter(index: int) -> Callable[[], float] | None:
    """Return what reads the joules of a GPU since its driver was loaded, by NVML; None where they cannot be read.

    Args:
        index: As CUDA counts those that ``CUDA_VISIBLE_DEVICES`` leaves to it, in the order of the PCI bus.
    """
    shown = os.environ.get("CUDA_VISIBLE_DEVICES")
    try:
        import pynvml

        pynvml.nvmlInit()
        name = str(index) if shown is None else shown.split(",")[index].strip()
        by_number, by_name = pynvml.nvmlDeviceGetHandleByIndex, pynvml.nvmlDeviceGetHandleByUUID
        gpu = by_number(int(name)) if name.isdigit() else by_name(name)
        pynvml.nvmlDeviceGetTotalEnergyConsumption(gpu)  # older GPUs and Jetsons refuse
    except (ImportError, OSError, RuntimeError, IndexError):
        return None
    except Exception as error:  # NVML's own errors derive from Exception alone
        if type(error).__module__ != "pynvml":
            raise
        return None
    return lambda: pynvml.nvmlDeviceGetTotalEnergyConsumption(gpu) / 1e3


def _board(stack: ExitStack) -> Meter:
    program = shutil.which("tegrastats")
    return (lambda: None) if program is None else stack.enter_context(_Board(program)).read


class _Board:
    """The energy of a Jetson: the power that `tegrastats` tells, which holds until it tells another."""

    def __init__(self, program: str) -> None:
        self._lock = threading.Lock()
        self._told = threading.Event()
        self._joules, self._watts, self._since = 0.0, 0.0, 0.0
        self._process = subprocess.Popen(
            [program, "--interval", str(_INTERVAL)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        self._thread = threading.Thread(target=self._follow, daemon=True)

    def __enter__(self) -> _Board:
        self._thread.start()
        self._told.wait(_PATIENCE)
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        self._thread.join()

    def read(self) -> float | None:
        """Return the joules since the first line, or None before it and after the last."""
        with self._lock:
            if not self._told.is_set():
                return None
            return self._joules + self._watts * (time.perf_counter() - self._since)

    def _follow(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                watts = _board_watts(line)
                if watts is None:
                    continue
                with self._lock:
                    now = time.perf_counter()
                    self._joules += self._watts * (now - self._since)
                    self._watts, self._since = watts, now
                    self._told.set()
        with self._lock:
            self._told.clear()  # it has ended, and nobody knows the power from here on


def _board_watts(line: str) -> float | None:
    """Return the power of the whole module that a line of `tegrastats` tells; None without rails.

    It is that of the rail which feeds the others (VDD_IN, POM_5V_IN); on the AGX modules, which have none, the sum,
    less VDDQ, which VIN_SYS_5V0 feeds.
    """
    rails = {name: int(milliwatts) for name, milliwatts in _RAIL.findall(line)}
    if not rails:
        return None
    total = next((power for name, power in rails.items() if name.endswith("_IN")), None)
    if total is None:
        total = sum(power for name, power in rails.items() if not name.startswith("VDDQ_"))
    return total / 1e3
