"""Load the HTTP service from a second process on loopback, and compare with the predictor called in-process.

    python benchmarks/serve.py throughput --model tiny
    python benchmarks/serve.py overload --model tiny --seconds 300

``throughput`` alternates, several times, the predictor in-process at its best batch size and the service with 1, 8 and
32 clients that wait for each answer. ``overload`` sends at twice the capacity whether answers come or not, and
watches statuses and memory. Pictures are synthetic road scenes of 1280x720 as JPEG. Both say how much processor time
the clients took from the service.
"""

from __future__ import annotations

import argparse
import asyncio
import dataclasses
import io
import itertools
import os
import signal
import socket
import statistics
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

import trilitenet
from trilitenet.data.synthetic import SyntheticScenes
from trilitenet.inference.predictor import ImageLike, Predictor
from trilitenet.processing.images import read_image


@dataclasses.dataclass
class Load:
    """What a load brought."""

    seconds: float
    statuses: Counter[str]
    latencies: list[float]
    cpu: float = 0.0
    """Seconds of processor time that the clients took."""

    @property
    def rate(self) -> float:
        return self.statuses["200"] / self.seconds

    def percentiles(self) -> str:
        p50, p95, p99 = np.percentile(self.latencies, [50, 95, 99]) * 1e3
        return f"p50 {p50:.0f} ms, p95 {p95:.0f} ms, p99 {p99:.0f} ms"


class Client:
    """One HTTP/1.1 connection that is kept open: as little work as can be, because it shares the machine."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def post(self, body: bytes) -> int:
        if self._streams is None:
            self._streams = await asyncio.open_connection("127.0.0.1", self._port)
        reader, writer = self._streams
        writer.write(
            b"POST /v1/predict HTTP/1.1\r\nhost: localhost\r\ncontent-type: image/jpeg\r\n"
            b"content-length: %d\r\n\r\n" % len(body)
        )
        writer.write(body)
        await writer.drain()
        head = (await reader.readuntil(b"\r\n\r\n")).lower()
        await reader.readexactly(int(head.split(b"content-length: ")[1].split(b"\r\n")[0]))
        if b"connection: close" in head:
            self.close()
        return int(head[9:12])

    def close(self) -> None:
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


async def closed_loop(port: int, bodies: list[bytes], clients: int, seconds: float) -> Load:
    """Each client sends its next picture when it has the answer to the last."""
    statuses: Counter[str] = Counter()
    latencies: list[float] = []
    begin, cpu = time.perf_counter(), time.process_time()

    async def one(number: int) -> None:
        client = Client(port)
        index = number
        while (start := time.perf_counter()) - begin < seconds:
            statuses[str(await client.post(bodies[index % len(bodies)]))] += 1
            latencies.append(time.perf_counter() - start)
            index += 1
        client.close()

    await asyncio.gather(*(one(number) for number in range(clients)))
    return Load(time.perf_counter() - begin, statuses, latencies, time.process_time() - cpu)


async def open_loop(
    port: int, bodies: list[bytes], rate: float, seconds: float, watch: Callable[[float], object]
) -> Load:
    """Send ``rate`` pictures a second, whether answers come or not; fresh idle connections are used again.

    ``watch`` is told the time about every second.
    """
    statuses: Counter[str] = Counter()
    latencies: list[float] = []
    idle: list[tuple[float, Client]] = []
    tasks: set[asyncio.Task[None]] = set()

    async def one(body: bytes) -> None:
        start = time.perf_counter()
        while idle and start - idle[0][0] > 5.0:  # the service closes those that idle
            idle.pop(0)[1].close()
        client = idle.pop()[1] if idle else Client(port)
        try:
            status = await client.post(body)
        except (OSError, asyncio.IncompleteReadError) as error:
            statuses[type(error).__name__] += 1
            client.close()
            return
        statuses[str(status)] += 1
        if status == 200:
            latencies.append(time.perf_counter() - start)
        idle.append((time.perf_counter(), client))

    begin, cpu = time.perf_counter(), time.process_time()
    count = watched = 0
    while (now := time.perf_counter() - begin) < seconds:
        if now >= watched:
            watch(now)
            watched = int(now) + 1
        while count < now * rate:
            task = asyncio.ensure_future(one(bodies[count % len(bodies)]))
            tasks.add(task)
            task.add_done_callback(tasks.discard)
            count += 1
        await asyncio.sleep(0.002)
    await asyncio.gather(*tasks)
    for _, client in idle:
        client.close()
    return Load(time.perf_counter() - begin, statuses, latencies, time.process_time() - cpu)


class Server:
    """``trilitenet serve`` in a process of its own."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port: int = probe.getsockname()[1]
        command = [str(Path(sys.executable).with_name("trilitenet")), "serve", "--model", arguments.model]
        command += ["--port", str(self.port), "--backend", arguments.backend, "--log-level", "warning"]
        command += ["--max-batch", str(arguments.max_batch), "--streams", str(arguments.streams)]
        self.process = subprocess.Popen(command)
        until = time.monotonic() + 120
        while True:
            try:
                urllib.request.urlopen(f"http://127.0.0.1:{self.port}/readyz").close()
                return
            except (urllib.error.URLError, ConnectionError):
                if time.monotonic() > until or self.process.poll() is not None:
                    raise
                time.sleep(0.2)

    @property
    def memory(self) -> float:
        """Resident MiB."""
        status = Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii")
        return int(status.split("VmRSS:")[1].split()[0]) / 1024

    @property
    def cpu(self) -> float:
        """Seconds of processor time so far."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def stop(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        self.process.wait(60)


def in_process(predictor: Predictor, images: Sequence[ImageLike], batch: int, seconds: float) -> float:
    """Pictures a second of the predictor called with lists of ``batch`` images."""
    predictor.batch_size = batch
    count = 0
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        predictor([images[(count + offset) % len(images)] for offset in range(batch)])
        count += batch
    return count / (time.perf_counter() - start)


def pictures(count: int) -> list[bytes]:
    scenes = SyntheticScenes(seed=0, size=(720, 1280))
    bodies = []
    for index in range(count):
        buffer = io.BytesIO()
        Image.fromarray(scenes[index].image).save(buffer, "JPEG", quality=90)
        bodies.append(buffer.getvalue())
    return bodies


def throughput(arguments: argparse.Namespace) -> None:
    bodies = pictures(8)
    print(f"pictures: {len(bodies)} of 1280x720, {statistics.mean(map(len, bodies)) / 1024:.0f} KiB each")
    with trilitenet.load(arguments.model, backend=arguments.backend, streams=arguments.streams) as predictor:
        pixels = [read_image(body) for body in bodies]
        predictor(bodies)
        trial = {batch: in_process(predictor, bodies, batch, 2.0) for batch in (1, 2, 4, 8)}
        best = max(trial, key=lambda batch: trial[batch])
        print("in-process, pictures/s by batch:", {b: round(r, 1) for b, r in trial.items()}, flush=True)
        server = Server(arguments)
        asyncio.run(closed_loop(server.port, bodies, 4, 2.0))
        loads: dict[int, list[Load]] = {clients: [] for clients in arguments.clients}
        ratios: dict[int, list[tuple[float, float]]] = {clients: [] for clients in arguments.clients}
        service_cpu = dict.fromkeys(arguments.clients, 0.0)
        for _ in range(arguments.rounds):
            for clients in arguments.clients:
                files = in_process(predictor, bodies, best, arguments.seconds)
                before = server.cpu
                load = asyncio.run(closed_loop(server.port, bodies, clients, arguments.seconds))
                service_cpu[clients] += server.cpu - before
                arrays = in_process(predictor, pixels, best, arguments.seconds)
                loads[clients].append(load)
                ratios[clients].append((load.rate / files, load.rate / arrays))
        server.stop()
    for clients, several in loads.items():
        rate = statistics.median(load.rate for load in several)
        files, arrays = (statistics.median(values) for values in zip(*ratios[clients], strict=True))
        together = Load(1.0, Counter(), [latency for load in several for latency in load.latencies])
        statuses = dict(sum((load.statuses for load in several), Counter()))
        wall = sum(load.seconds for load in several)
        client_cpu = sum(load.cpu for load in several)
        print(
            f"{clients:3d} clients: {rate:6.1f} pictures/s, {together.percentiles()}; ratio to in-process "
            f"(batch {best}): {files:.2f} given the same files, {arrays:.2f} given decoded arrays; answers {statuses}; "
            f"cores: service {service_cpu[clients] / wall:.2f}, clients {client_cpu / wall:.2f}"
        )


def overload(arguments: argparse.Namespace) -> None:
    bodies = pictures(8)
    server = Server(arguments)
    try:
        capacity = asyncio.run(closed_loop(server.port, bodies, 16, 10.0)).rate
        print(f"capacity with 16 clients: {capacity:.1f} pictures/s; now {2 * capacity:.1f} a second")
        resident = [(0.0, server.memory)]
        service_cpu = server.cpu
        load = asyncio.run(
            open_loop(
                server.port,
                bodies,
                2 * capacity,
                arguments.seconds,
                lambda now: resident.append((now, server.memory)),
            )
        )
        service_cpu = server.cpu - service_cpu
        print(f"resident before: {resident.pop(0)[1]:.0f} MiB; then, each second:")
        for _, group in itertools.groupby(resident, key=lambda pair: int(10 * pair[0] / arguments.seconds)):
            times, sizes = zip(*group, strict=True)
            middle = statistics.median(sizes)
            print(f"  from {times[0]:3.0f} s: {min(sizes):.0f} to {max(sizes):.0f} MiB, median {middle:.0f}")
        print(
            f"answers {dict(load.statuses)}; {load.percentiles()} of those seen; {load.rate:.1f} seen a second; "
            f"cores: service {service_cpu / load.seconds:.2f}, clients {load.cpu / load.seconds:.2f}"
        )
    finally:
        server.stop()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["throughput", "overload"])
    parser.add_argument("--model", default="tiny")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--streams", type=int, default=1)
    parser.add_argument("--max-batch", type=int, default=0)
    parser.add_argument("--clients", type=int, nargs="+", default=[1, 8, 32])
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    {"throughput": throughput, "overload": overload}[arguments.what](arguments)


if __name__ == "__main__":
    main()
