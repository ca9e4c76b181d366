"""Prove on the real process and model what the tests prove on a stand-in: hostile uploads, a stop, Triton's client.

    python benchmarks/serve_safety.py hostile --model tiny
    python benchmarks/serve_safety.py stop --model tiny --rounds 5
    python benchmarks/serve_safety.py triton --model tiny

``hostile`` sends the 500 uploads of ``tests/apps/server/test_hostile.py`` while honest clients go on asking. ``stop``
sends SIGTERM while clients ask. ``triton`` compares the answers of tritonclient's HTTP client with the predictor's own.
"""

from __future__ import annotations

import argparse
import http.client
import itertools
import json
import signal
import socket
import sys
import threading
import time
from collections import Counter, defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

import trilitenet
from serve import Server, pictures
from trilitenet.processing.images import read_image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from tests.apps.server import test_hostile as harm

SLOW = 20


class Honest:
    """Clients in threads that each ask again when they have an answer, until they are told to stop."""

    def __init__(self, port: int, bodies: list[bytes], clients: int) -> None:
        self.outcomes: Counter[str] = Counter()
        self.seconds: list[float] = []
        self._port = port
        self._bodies = bodies
        self._over = threading.Event()
        self._threads = [threading.Thread(target=self._ask, args=(number,)) for number in range(clients)]
        for thread in self._threads:
            thread.start()

    def _ask(self, number: int) -> None:
        client = http.client.HTTPConnection("127.0.0.1", self._port, timeout=60)
        for index in itertools.count(number):
            if self._over.is_set():
                break
            try:
                if client.sock is None:
                    client.connect()
            except OSError:
                self.outcomes["refused to connect"] += 1  # never accepted: the listener is closed
                break
            start = time.perf_counter()
            try:
                client.request("POST", "/v1/predict", body=self._bodies[index % len(self._bodies)])
                answer = client.getresponse()
                json.load(answer)
                self.outcomes[str(answer.status)] += 1
                self.seconds.append(time.perf_counter() - start)
                if answer.will_close:
                    client.close()
            except (OSError, http.client.HTTPException) as error:
                self.outcomes[f"lost: {type(error).__name__}"] += 1
                client.close()
        client.close()

    def stop(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join(60)


def slow_headers(port: int) -> tuple[int, float]:
    """Send the headers a byte now and then."""
    start = time.monotonic()
    with socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
        connection.settimeout(0.1)
        for byte in itertools.chain(b"POST /v1/predict HTTP/1.1\r\nx: ", itertools.repeat(ord("y"))):
            try:
                connection.sendall(bytes([byte]))
                answer = connection.recv(1000)
                return (int(answer.split()[1]) if answer else 0), time.monotonic() - start
            except TimeoutError:
                continue
    raise AssertionError


def hostile(arguments: argparse.Namespace) -> None:
    server = Server(arguments)
    try:
        honest = Honest(server.port, pictures(8), 4)
        time.sleep(2)
        before = len(honest.seconds)
        uploads = [upload for _, upload in zip(range(470), harm._uploads(np.random.default_rng(0)), strict=False)]
        begin = time.monotonic()
        with ThreadPoolExecutor(2 * SLOW) as many, ThreadPoolExecutor(4) as few:
            bodies = [many.submit(harm._loris, server) for _ in range(SLOW)]
            headers = [many.submit(slow_headers, server.port) for _ in range(SLOW)]
            huge = [few.submit(harm._declared, server) for _ in range(10)]
            jobs = [few.submit(harm._post, server, data) for _, data in uploads]
            results = [(name, *job.result()) for (name, _), job in zip(uploads, jobs, strict=True)]
            results += [("4 GB declared", *job.result()) for job in huge]
            taken = time.monotonic() - begin
            results += [("slow body", *job.result()) for job in bodies]
            results += [("slow headers", *job.result()) for job in headers]
        after = len(honest.seconds)
        honest.stop()
        groups: dict[str, list[tuple[int, float]]] = defaultdict(list)
        for name, status, seconds in results:
            groups[name].append((status, seconds))
        for name, group in groups.items():
            answers = dict(Counter(status for status, _ in group))
            times = [seconds for _, seconds in group]
            print(f"{name:16s} {len(group):4d}: {answers}, {min(times):.3f} to {max(times):.3f} s")
        quick = sorted(seconds for name, _, seconds in results if not name.startswith("slow"))
        p50, p95, p99 = np.percentile(quick, [50, 95, 99])
        print(
            f"{len(results)} uploads, {sum(400 <= status < 500 for _, status, _ in results)} answered 4xx; "
            f"the {len(quick)} quick ones in {taken:.1f} s: p50 {p50:.3f} s, p95 {p95:.3f} s, p99 {p99:.3f} s, "
            f"longest {quick[-1]:.3f} s"
        )
        print(
            f"honest clients meanwhile: {after - before} answers, in all {dict(honest.outcomes)}; "
            f"longest {max(honest.seconds):.2f} s; resident {server.memory:.0f} MiB"
        )
    finally:
        server.stop()


def stop(arguments: argparse.Namespace) -> None:
    bodies = pictures(8)
    for number in range(arguments.rounds):
        server = Server(arguments)
        clients = Honest(server.port, bodies, 12)
        time.sleep(3)
        before = dict(clients.outcomes)
        begin = time.monotonic()
        server.process.send_signal(signal.SIGTERM)
        server.process.wait(60)
        taken = time.monotonic() - begin
        clients.stop()
        print(
            f"stop {number + 1}: {before} before SIGTERM, {dict(clients.outcomes)} in all; "
            f"ended after {taken:.1f} s with {server.process.returncode}"
        )


def triton(arguments: argparse.Namespace) -> None:
    import tritonclient.http as client_of_triton

    server = Server(arguments)
    try:
        name = Path(arguments.model).stem
        files = pictures(8)
        pixels = [read_image(file) for file in files]
        client = client_of_triton.InferenceServerClient(f"127.0.0.1:{server.port}", concurrency=8)
        with trilitenet.load(arguments.model, backend=arguments.backend, streams=arguments.streams) as predictor:
            expected = [predictor(image) for image in pixels]

        def tensor(index: int, encoded: bool) -> client_of_triton.InferInput:
            if encoded:
                made = client_of_triton.InferInput("image", [1], "BYTES")
                made.set_data_from_numpy(np.array([files[index]], dtype=np.object_))
            else:
                made = client_of_triton.InferInput("image", [1, *pixels[index].shape], "UINT8")
                made.set_data_from_numpy(pixels[index][None])
            return made

        for encoded in (False, True):
            right = 0
            for index, seen in enumerate(expected):
                result = client.infer(name, [tensor(index, encoded)])
                boxes = result.as_numpy("boxes")[0]
                assert seen.boxes is not None
                right += (
                    np.array_equal(boxes[boxes[:, 5] >= 0, :4], seen.boxes.xyxy)
                    and np.array_equal(result.as_numpy("drivable")[0], seen.drivable)
                    and np.array_equal(result.as_numpy("lane")[0], seen.lane)
                )
            with ThreadPoolExecutor(8) as pool:
                count = arguments.requests
                # One client of gevent's kind must stay in its thread, so each thread has its own.
                local = threading.local()

                def ask(index: int, encoded: bool = encoded, local: threading.local = local) -> None:
                    if not hasattr(local, "client"):
                        local.client = client_of_triton.InferenceServerClient(f"127.0.0.1:{server.port}")
                    local.client.infer(name, [tensor(index % 8, encoded)])

                begin = time.perf_counter()
                list(pool.map(ask, range(count)))
                rate = count / (time.perf_counter() - begin)
            what = "BYTES (JPEG)" if encoded else "UINT8 [1, 720, 1280, 3]"
            print(f"{what}: {right} of {len(expected)} answers equal the predictor's; 8 clients {rate:.1f} pictures/s")
        client.close()
    finally:
        server.stop()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["hostile", "stop", "triton"])
    parser.add_argument("--model", default="tiny")
    parser.add_argument("--backend", default="auto")
    parser.add_argument("--streams", type=int, default=1)
    parser.add_argument("--max-batch", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--requests", type=int, default=200)
    arguments = parser.parse_args()
    {"hostile": hostile, "stop": stop, "triton": triton}[arguments.what](arguments)


if __name__ == "__main__":
    main()
