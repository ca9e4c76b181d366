"""Where and how a run computes: Lightning Fabric for device, precision and processes; signals."""

from __future__ import annotations

import contextlib
import datetime
import logging
import os
import platform
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from types import FrameType, TracebackType
from typing import Any, Final

import torch

from trilitenet.errors import BackendError, ConfigError, TrainingError, TriLiteNetError, gist, import_extra
from trilitenet.processing.cores import usable_cores
from trilitenet.processing.memory import STEPS, keep_freed_memory

__all__ = ["StopRequest", "follow", "hosts_group", "pick_precision", "putting_off", "running_fabric"]

_LOGGER: Final = logging.getLogger(__name__)

_PATIENCE: Final = datetime.timedelta(days=1)
"""Processes wait so long for each other."""

_GRACE: Final = 10.0
"""Seconds in which the first process is to notice by itself that another has ended."""

_ERROR_KEY: Final = "trilitenet/error"
"""Where, in the store that the processes share, one says why it ends."""

_GO_ON: Final = "--resume goes on from the last checkpoint"


def pick_precision(precision: str, device: str) -> str:
    """Return a precision of Lightning Fabric: for ``"auto"`` bf16-mixed where the device computes it natively."""
    if precision != "auto":
        return precision
    if device == "cuda":
        return "bf16-mixed" if torch.cuda.is_bf16_supported() else "16-mixed"
    return "bf16-mixed" if device == "cpu" and _has_bf16() else "32-true"


def _has_bf16() -> bool:
    """Return whether an x86 has instructions for bf16; where PyTorch, by a private function, cannot tell, no."""
    return bool(getattr(torch.cpu, "_is_avx512_bf16_supported", bool)())


def _emulates(precision: str, device: str) -> bool:
    """Return whether the processor has no instructions for a precision (docs/training.md says what that costs)."""
    if precision != "bf16-mixed" or device != "cpu":
        return False
    # Of an x86 with AVX-512, PyTorch says that it computes bf16 whether or not the processor has instructions for it.
    x86 = platform.machine().lower() in {"x86_64", "amd64"}
    return not (_has_bf16() if x86 else torch.ops.mkldnn._is_mkldnn_bf16_supported())


@contextlib.contextmanager
def running_fabric(
    device: str = "auto", precision: str = "auto", *, devices: int = 1, num_nodes: int = 1, command: Sequence[str] = ()
) -> Iterator[Any]:
    """Yield a launched ``lightning_fabric.Fabric``; with several processes, an error of any ends all, told once.

    The first process raises it. The others raise SystemExit, for what they say would be said twice.

    Args:
        device: ``"auto"``, ``"cpu"``, ``"cuda"`` or ``"mps"``.
        precision: See `pick_precision`.
        devices: Processes on this machine.
        num_nodes: Machines.
        command: Starts a further process of this machine, unless torchrun or SLURM has started them: it is to call
            `follow`, and then to come here with the same arguments.

    Raises:
        BackendError: If the device is missing.
        ConfigError: If Fabric refuses the combination, or the port at which the processes are to meet is taken.
        MissingExtraError: Without the ``train`` extra.
        TrainingError: If another process has failed.
    """
    fabric = _build_fabric(device, precision, devices, num_nodes)
    if devices == num_nodes == 1:
        fabric.launch()
        yield fabric
        return
    first = fabric.global_rank == 0
    own = not fabric.strategy.cluster_environment.creates_processes_externally
    threads = torch.get_num_threads()
    environment = {name: os.environ.get(name) for name in ("MASTER_ADDR", "MASTER_PORT")}
    others = _Others()
    try:
        if "OMP_NUM_THREADS" not in os.environ:
            torch.set_num_threads(max(1, usable_cores() // devices))
        if own:
            others.start(fabric, command, devices, num_nodes)
        _connect(fabric, devices, num_nodes)
        yield fabric
        if own:
            others.join()
    except TriLiteNetError as error:
        if first or not _tell(str(error)):
            raise
        raise SystemExit(1) from error
    except KeyboardInterrupt:
        if first:
            raise
        raise SystemExit(130) from None
    except RuntimeError as error:
        if not (isinstance(error, torch.distributed.DistError) or "gloo" in str(error)):
            raise
        if first:
            raise TrainingError(others.reason()) from error
        raise SystemExit(1) from error
    finally:
        others.end()
        if own and torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()  # so that another run may follow
        elif own:
            torch.distributed.distributed_c10d._world.group_count = 0  # likewise: a group that failed is counted
        torch.set_num_threads(threads)
        if first:
            for name, value in environment.items():
                os.environ.pop(name, None)
                if value is not None:
                    os.environ[name] = value


def _build_fabric(device: str, precision: str, devices: int, num_nodes: int) -> Any:
    lightning = import_extra("lightning_fabric", "train")
    if device == "cuda" and not torch.cuda.is_available():
        raise BackendError("no CUDA device is available; use --device cpu or auto")
    if device == "mps" and not torch.backends.mps.is_available():
        raise BackendError("no MPS device is available; use --device cpu or auto")
    accelerator = device
    if device == "auto":
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    if accelerator == "cpu":
        keep_freed_memory(STEPS)
        if precision == "16-mixed":  # Lightning would compute in bf16, and say so in words of its own
            raise ConfigError("precision 16-mixed is for GPUs; on a CPU use bf16-mixed or 32-true")
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    settings: dict[str, Any] = {"devices": devices, "num_nodes": num_nodes}
    if devices != 1 or num_nodes != 1:
        # The other processes wait while the first validates, which on a CPU takes longer than the default half an hour.
        strategy = import_extra("lightning_fabric.strategies", "train").DDPStrategy(timeout=_PATIENCE)
        strategy._configure_launcher = lambda: None  # Fabric's would run the calling script again, which may be a REPL
        settings["strategy"] = strategy
    picked = pick_precision(precision, accelerator)
    try:
        fabric = lightning.Fabric(accelerator=accelerator, precision=picked, **settings)
    except (ValueError, TypeError) as error:
        raise ConfigError(f"device {device!r} with precision {precision!r}: {error}") from error
    if _emulates(picked, accelerator) and fabric.global_rank == 0:
        _LOGGER.warning("this processor has no instructions for bf16: --precision 32-true is faster")
    return fabric


def _connect(fabric: Any, devices: int, num_nodes: int) -> None:
    """Let the processes meet."""
    try:
        fabric.strategy.cluster_environment.validate_settings(num_devices=devices, num_nodes=num_nodes)
    except ValueError as error:
        raise ConfigError(gist(error)) from error
    try:
        fabric.launch()
    except RuntimeError as error:
        taken = "EADDRINUSE" in str(error)  # no DistError in PyTorch 2.6
        if not taken and not isinstance(error, torch.distributed.DistError):
            raise
        port = os.environ["MASTER_PORT"]
        if taken:
            raise ConfigError(
                f"port {port}, at which the processes are to meet, is taken; set MASTER_PORT to a free one, or unset it"
            ) from error
        raise TrainingError(
            f"the processes cannot meet at {os.environ['MASTER_ADDR']}:{port} ({str(error).splitlines()[0]}); "
            "see that the first one runs, and that MASTER_ADDR and MASTER_PORT name its machine and a free port"
        ) from error


class _Others:
    """The further processes of this machine that this one has started; none if something else starts them."""

    def __init__(self) -> None:
        self._processes: list[subprocess.Popen[bytes]] = []
        self._over = threading.Event()
        self._first_rank = 0

    def start(self, fabric: Any, command: Sequence[str], devices: int, num_nodes: int) -> None:
        """Start them, and watch them.

        Raises:
            ConfigError: If they could not meet each other, or those of other machines.
        """
        if num_nodes > 1 and not {"MASTER_ADDR", "MASTER_PORT", "NODE_RANK"} <= os.environ.keys():
            raise ConfigError(
                f"{num_nodes} machines: start the command with torchrun or SLURM, "
                "or on each with MASTER_ADDR, MASTER_PORT and NODE_RANK set"
            )
        if num_nodes == 1:
            os.environ["MASTER_ADDR"] = "127.0.0.1"
        place = fabric.strategy.cluster_environment
        try:
            meeting = {"MASTER_ADDR": place.main_address, "MASTER_PORT": str(place.main_port)}
        except ValueError as error:
            raise ConfigError(f"MASTER_PORT must be a number, got {os.environ['MASTER_PORT']!r}") from error
        self._first_rank = fabric.global_rank
        for rank in range(1, devices):
            more = {**os.environ, **meeting, "LOCAL_RANK": str(rank)}
            self._processes.append(subprocess.Popen(command, env=more, stdin=subprocess.PIPE))
        threading.Thread(target=self._watch, daemon=True).start()

    def _watch(self) -> None:
        """End this process if another has failed and this one waits for it and does not notice, as on a GPU."""
        while not self._over.wait(1.0):
            if any(process.poll() for process in self._processes) and not self._over.wait(_GRACE):
                _LOGGER.error("%s", self.reason())
                self.end()
                os._exit(1)

    def reason(self) -> str:
        """Return why a run cannot go on: what another process said, or how it ended."""
        with contextlib.suppress(RuntimeError, ValueError):
            store = torch.distributed.distributed_c10d._get_default_store()
            if store.check([_ERROR_KEY]):
                return str(store.get(_ERROR_KEY).decode())
        for _ in range(50):  # its connections close before it has quite ended
            for rank, process in enumerate(self._processes, self._first_rank + 1):
                code = process.poll() or 0
                if code < 0:
                    return (
                        f"process {rank} was killed ({signal.Signals(-code).name}), mostly for want of memory; {_GO_ON}"
                    )
                if code:
                    return f"process {rank} ended with exit code {code}, see what it said above; {_GO_ON}"
            time.sleep(0.1 if self._processes else 0.0)
        return f"another process of the run has gone, perhaps one of another machine; {_GO_ON}"

    def join(self) -> None:
        """Wait for their end."""
        for process in self._processes:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(60.0)

    def end(self) -> None:
        """Kill those that are left."""
        self._over.set()
        for process in self._processes:
            process.kill()
            process.wait()
            assert process.stdin is not None
            process.stdin.close()


def _tell(message: str) -> bool:
    """Say to the first process why this one ends; return whether that could be said."""
    try:
        torch.distributed.distributed_c10d._get_default_store().set(_ERROR_KEY, message)
    except (RuntimeError, ValueError):
        return False
    return True


def hosts_group(fabric: Any) -> Any:
    """Return the group by which the processes' hosts exchange what no device has to wait for.

    All processes call it together. None is the default group: of a single process, or on a CPU.

    Raises:
        TrainingError: If they cannot reach each other.
    """
    if fabric.world_size == 1 or fabric.device.type == "cpu":
        return None
    try:
        return torch.distributed.new_group(backend="gloo", timeout=_PATIENCE)
    except RuntimeError as error:
        if isinstance(error, torch.distributed.DistError):  # the first process, where they meet, has gone
            raise
        raise TrainingError(
            f"the processes cannot reach each other from host to host ({gist(error)}); "
            "set GLOO_SOCKET_IFNAME to the network interface that their machines share"
        ) from error


def follow() -> None:
    """Make this process end with the one that started it: its standard input is a pipe that then ends."""

    def wait() -> None:
        while os.read(0, 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


class StopRequest:
    """Turns SIGINT and SIGTERM into a wish to stop after the step at hand; a second SIGINT interrupts at once.

    A context manager; outside the main thread it watches nothing.

    Attributes:
        signal: The signal that came; None so far.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._before: dict[int, Any] = {}

    def __bool__(self) -> bool:
        return self.signal is not None

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal = number
        _LOGGER.warning("%s: stopping after this step, with a checkpoint", signal.Signals(number).name)


@contextlib.contextmanager
def putting_off(name: str) -> Iterator[Callable[[], contextlib.AbstractContextManager[None]]]:
    """Let Python's handler of a signal, if the system has it, wait for the blocks of what is yielded.

    In the main thread; elsewhere Python calls none.
    """
    number = getattr(signal, name, None)
    if number is None or threading.current_thread() is not threading.main_thread():
        yield contextlib.nullcontext
        return
    came = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal came
        came = True  # alone: the frame would keep the memory of a training step

    handler = signal.signal(number, note)

    @contextlib.contextmanager
    def heeding() -> Iterator[None]:
        nonlocal handler, came
        signal.signal(number, handler)
        try:
            if came and callable(handler):
                came = False
                handler(number, None)
            yield
        finally:
            handler = signal.signal(number, note)  # which may be another by now

    try:
        yield heeding
    finally:
        signal.signal(number, handler)
