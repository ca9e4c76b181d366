from __future__ import annotations

import errno
import gc
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.apps.server.conftest import TOKEN, FakeBackend
from trilitenet.apps import cli
from trilitenet.apps.server import command
from trilitenet.apps.server.process import GuardedServer
from trilitenet.apps.server.settings import Settings
from trilitenet.errors import ConfigError
from trilitenet.inference.predictor import Predictor


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch, backend: FakeBackend) -> Iterator[list[Any]]:
    """Stop short of serving; the list takes the servers that would have run."""
    servers: list[Any] = []

    def run(self: GuardedServer, sockets: list[socket.socket]) -> None:
        servers.append(self)
        for one in sockets:
            one.close()

    monkeypatch.setattr("trilitenet.commands.load.load", lambda model, **options: Predictor(backend))
    monkeypatch.setattr("trilitenet.apps.server.process.set_up_logs", lambda level: None)
    monkeypatch.setattr(GuardedServer, "run", run)
    monkeypatch.delenv("TRILITENET_TOKEN", raising=False)
    interval = sys.getswitchinterval()
    yield servers
    sys.setswitchinterval(interval)
    gc.unfreeze()


def _settings(server: Any) -> Settings:
    settings: Settings = server.config.app.service.settings
    return settings


def test_flags_become_settings(started: list[Any], backend: FakeBackend) -> None:
    words = ["--model", "runs/my.onnx", "--port", "0", "--queue", "5", "--deadline", "2", "--upload-timeout", "90"]
    assert cli.main(["serve", *words]) == 0
    (server,) = started
    assert _settings(server).upload_timeout == 90.0
    assert (_settings(server).queue, _settings(server).max_images, _settings(server).deadline) == (5, 5, 2.0)
    assert server.config.app.service.name == "my"
    assert backend.closed
    assert gc.get_freeze_count() > 0


def test_the_token_comes_from_a_file_or_the_environment(
    started: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    command.serve(port=0, token_file=str(file))
    monkeypatch.setenv("TRILITENET_TOKEN", f"{TOKEN[::-1]}\n")
    command.serve(port=0)
    assert [_settings(server).token for server in started] == [TOKEN, TOKEN[::-1]]
    assert TOKEN not in repr(_settings(started[0]))


def test_mistakes_are_told_in_one_line(started: list[Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = tmp_path / "short"
    short.write_text("secret")
    binary = tmp_path / "binary"
    binary.write_bytes(bytes(range(128, 256)))
    foreign = tmp_path / "foreign"
    foreign.write_text("schlüssel" * 4, encoding="utf-8")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        for words, message in (
            (["--log-level", "loud"], "log_level must be debug"),
            (["--token-file", str(tmp_path / "none")], "cannot be read"),
            (["--token-file", str(short)], "at least 16 characters"),
            (["--token-file", str(binary)], "holds no token (it is not text)"),
            (["--token-file", str(foreign)], "must be plain ASCII"),
            (["--queue", "0"], "queue must be at least 1"),
            (["--deadline", "-1"], "deadline must be positive and finite"),
            (["--upload-timeout", "0"], "upload_timeout must be positive and finite"),
            (["--drain", "-1"], "drain must be at least 0 and finite"),
            (["--max-batch", "-1"], "max_batch must be at least 0"),
            (["--port", port], f"cannot listen on 127.0.0.1 port {port} (Address already in use); choose"),
            (["--port", "99999"], "cannot listen"),
            (["--host", ""], "0.0.0.0 lets other machines in"),
            (["--host", "ü..x"], "cannot listen on ü..x port 8000 (encoding of hostname failed)"),
        ):
            assert cli.main(["serve", *words]) == 1
            error = capsys.readouterr().err
            assert error.startswith("error: ")
            assert error.count("\n") == 1
            assert message in error
            assert "secret" not in error
    assert started == []


def test_settings_must_fit_each_other() -> None:
    with pytest.raises(ConfigError, match="max_images"):
        Settings(queue=4, max_images=5)
    with pytest.raises(ConfigError, match="memory"):
        Settings(max_pixels=200_000_000)
    least = 2 * 1000 + 13 * 500  # the body twice, as it is and in parts, the picture, and an overlay
    assert Settings(max_body=1000, max_pixels=500, memory=least).memory == least
    with pytest.raises(ConfigError, match=f"memory .* must be at least {least}"):
        Settings(max_body=1000, max_pixels=500, memory=least - 1)


def test_a_token_is_long_enough_and_one_word() -> None:
    assert Settings(token="a" * 16).token == "a" * 16
    with pytest.raises(ConfigError, match="at least 16"):
        Settings(token="a" * 15)
    with pytest.raises(ConfigError, match="without spaces"):
        Settings(token="two words of a token")


@pytest.mark.parametrize(("cores", "threads"), [(1, 1), (6, 6), (64, 8)])
def test_threads_follow_the_cores_up_to_eight(monkeypatch: pytest.MonkeyPatch, cores: int, threads: int) -> None:
    monkeypatch.setattr("trilitenet.apps.server.settings.usable_cores", lambda: cores)
    assert Settings().thread_count == threads
    assert Settings(threads=3).thread_count == 3


def test_batches_are_as_large_as_there_are_streams(started: list[Any], backend: FakeBackend) -> None:
    command.serve(port=0)
    backend.streams = 3  # type: ignore[attr-defined]
    command.serve(port=0)
    command.serve(port=0, max_batch=5)
    assert [_settings(server).max_batch for server in started] == [8, 3, 5]


def test_what_is_asked_of_the_model_reaches_it(
    started: list[Any], backend: FakeBackend, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[str, Any] = {}

    def load(model: str, **options: Any) -> Predictor:
        given.update(options, model=model)
        return Predictor(backend)

    monkeypatch.setattr("trilitenet.commands.load.load", load)
    asked = {"model": "m.onnx", "device": "cpu", "backend": "onnxruntime", "confidence": 0.4, "ego_mask": "bonnet.png"}
    words = [word for name, value in asked.items() for word in (f"--{name.replace('_', '-')}", str(value))]
    assert cli.main(["serve", "--port", "0", *words]) == 0
    assert {**given, "ego_mask": str(given["ego_mask"])} == {**asked, "network": None, "streams": 1}
    assert len(started) == 1


def test_streams_of_a_runtime_without_any_are_refused(started: list[Any]) -> None:
    with pytest.raises(ConfigError, match=r"^tiny runs on .*, and --streams is for OpenVINO alone"):
        command.serve(port=0, streams=2)
    assert started == []


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere these options mean other things")
def test_a_port_can_be_taken_again_at_once_and_v6_leaves_v4_alone() -> None:
    with command._listen("127.0.0.1", 0) as listener:
        assert listener.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR) == 1
    if socket.has_ipv6:
        try:
            listener = command._listen("::1", 0)
        except ConfigError:
            return  # compiled in, but switched off
        with listener:
            assert listener.getsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY) == 1


@pytest.mark.parametrize("name", ["deadline", "drain", "batch_delay", "upload_timeout"])
@pytest.mark.parametrize("value", [float("inf"), float("nan")])
def test_every_limit_is_finite(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"{name} must be (positive|at least 0) and finite"):
        Settings(**{name: value})  # type: ignore[arg-type]


def test_the_model_needs_no_option_name(started: list[Any]) -> None:
    assert cli.main(["serve", "runs/my.onnx", "--port", "0", "--memory", "2000000000", "--max-connections", "7"]) == 0
    (server,) = started
    assert server.config.app.service.name == "my"
    assert (_settings(server).memory, _settings(server).max_connections) == (2_000_000_000, 7)


def test_a_network_of_ones_own_is_handed_on(started: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[dict[str, Any]] = []

    def load(model: str, **options: Any) -> Predictor:
        told.append(options)
        return Predictor(FakeBackend())

    monkeypatch.setattr("trilitenet.commands.load.load", load)
    assert cli.main(["serve", "own.safetensors", "--port", "0", "--network", "blocks.py:build"]) == 0
    assert [options["network"] for options in told] == ["blocks.py:build"]


def test_connections_are_refused_until_the_service_is_ready(
    started: list[Any], monkeypatch: pytest.MonkeyPatch, backend: FakeBackend
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    outcomes: list[type[BaseException]] = []

    def load(model: str, **options: Any) -> Predictor:
        with pytest.raises(ConnectionRefusedError) as caught:
            socket.create_connection(("127.0.0.1", port), timeout=10)
        outcomes.append(caught.type)
        return Predictor(backend)

    monkeypatch.setattr("trilitenet.commands.load.load", load)
    command.serve(port=port)
    assert outcomes == [ConnectionRefusedError]


def test_a_port_that_is_taken_while_the_model_loads_is_told(
    started: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(self: GuardedServer, sockets: list[socket.socket]) -> None:
        raise OSError(errno.EADDRINUSE, "Address already in use")

    monkeypatch.setattr(GuardedServer, "run", run)
    with pytest.raises(ConfigError, match="cannot listen"):
        command.serve(port=0)
