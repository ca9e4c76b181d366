"""``trilitenet serve``: the verb lives beside the service, because commands never import applications."""

from __future__ import annotations

import dataclasses
import errno
import gc
import os
import socket
import sys
from pathlib import Path

from trilitenet.commands.paths import NameOrPath, StrPath
from trilitenet.errors import ConfigError, InputError, import_extra
from trilitenet.inference.backend import streams_of

__all__ = ["serve"]


def serve(
    model: NameOrPath = "tiny",
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    network: str | None = None,
    device: str = "auto",
    backend: str = "auto",
    confidence: float | None = None,
    ego_mask: StrPath | None = None,
    streams: int = 1,
    token_file: StrPath | None = None,
    queue: int = 64,
    max_batch: int = 0,
    batch_delay: float = 0.0,
    deadline: float = 10.0,
    max_body: int = 20 * 2**20,
    max_pixels: int = 7680 * 4320,
    memory: int = 2**30,
    max_connections: int = 512,
    upload_timeout: float = 20.0,
    drain: float = 1.0,
    log_level: str = "info",
) -> None:
    """Serve a model over HTTP: a REST interface, the Open Inference Protocol, and a page for people at ``/``.

    The process runs until it is told to stop (Ctrl-C or SIGTERM), and then finishes what it accepted. Logs go to
    standard error, one JSON object a line.

    Args:
        model: A shipped model, a file of weights, or an exported artefact.
        host: Address to listen on; 0.0.0.0 lets other machines in.
        port: Port to listen on.
        network: The function that built a weight file's network, as for predict.
        device: Where the network runs, as for predict.
        backend: The runtime, as for predict.
        confidence: Boxes above this are kept; the model's own threshold if left out.
        ego_mask: Picture of the own car in view, white on black, as for predict; images of another shape get 422.
        streams: Images that OpenVINO computes at once: more frames a second, more latency.
        token_file: File with the bearer token that clients must bring (or set TRILITENET_TOKEN).
        queue: At most so many images are accepted and not yet answered; one more gets 503.
        max_batch: At most so many images go through the network at once; 0 takes as many as the runtime computes at
            once: its streams on OpenVINO, 8 on others.
        batch_delay: Seconds that a batch that is not full waits for company.
        deadline: Seconds after which an accepted image that is not through gets 503.
        max_body: Bytes of one request.
        max_pixels: Pixels of one image.
        memory: Bytes that bodies, images in work and answers of all requests may take together; beyond, 503.
        max_connections: Open connections; one more gets 503.
        upload_timeout: Seconds in which the body of a request must arrive; then it gets 408.
        drain: Seconds that the service still accepts after it was told to stop.
        log_level: What is logged: debug, info, warning or error.

    Raises:
        ConfigError: If a limit is out of range, the token too short, the port taken, or several streams are asked of a
            runtime that has none.
        InputError: If the ego mask cannot be read, or marks nothing, or everything.
        MissingExtraError: If the extra "serve" is not installed.
    """
    for module in ("fastapi", "uvicorn", "httptools", "prometheus_client"):
        import_extra(module, "serve")
    import cv2

    from trilitenet.apps.server.application import create_app
    from trilitenet.apps.server.process import build_server, set_up_logs
    from trilitenet.apps.server.settings import Settings
    from trilitenet.commands.load import load
    from trilitenet.processing.memory import IMAGES, keep_freed_memory

    if log_level not in {"debug", "info", "warning", "error"}:
        raise ConfigError(f"log_level must be debug, info, warning or error, got {log_level!r}")
    if max_batch < 0:
        raise ConfigError(f"max_batch must be at least 0, got {max_batch}")
    settings = Settings(
        queue=queue,
        max_batch=max_batch or Settings.max_batch,
        batch_delay=batch_delay,
        deadline=deadline,
        max_body=max_body,
        max_pixels=max_pixels,
        memory=memory,
        max_connections=max_connections,
        upload_timeout=upload_timeout,
        max_images=min(Settings.max_images, queue),
        drain=drain,
        token=_read_token(token_file),
    )
    listener = _listen(host, port)
    set_up_logs(log_level.upper())
    keep_freed_memory(IMAGES)
    cv2.setNumThreads(1)  # images are the unit of parallel work here
    # The network's thread takes Python's lock often and briefly; with the usual 5 ms each other thread delays it.
    sys.setswitchinterval(0.0005)
    with (
        listener,
        load(
            model,
            network=network,
            device=device,
            backend=backend,
            confidence=confidence,
            streams=streams,
            ego_mask=ego_mask,
        ) as predictor,
    ):
        if streams > 1 and streams_of(predictor.backend) is None:
            raise ConfigError(
                f"{model} runs on {predictor.backend.name}, and --streams is for OpenVINO alone; leave it out, or "
                "serve what trilitenet export --format openvino makes"
            )
        if not max_batch:
            settings = dataclasses.replace(settings, max_batch=streams_of(predictor.backend) or settings.max_batch)
        gc.collect()
        gc.freeze()  # what is there now stays: collections while serving need not go through it again and again
        try:
            build_server(create_app(predictor, Path(model).stem, settings)).run([listener])
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            raise _cannot_listen(host, port, error) from error  # somebody else has begun to listen meanwhile


def _listen(host: str, port: int) -> socket.socket:
    """Return a bound socket: a port that is taken is told before the model is loaded.

    The server listens on it when it is ready; until then connections are refused, not kept waiting.
    """
    if not host:  # the system would take it for every address
        raise ConfigError("host must be an address or a name; 0.0.0.0 lets other machines in")
    if not 0 <= port <= 65535:
        raise ConfigError(f"cannot listen on {host} port {port} (port must be 0 to 65535); choose with --port")
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    try:
        if os.name == "posix":
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if listener.family == socket.AF_INET6:
            listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
        listener.bind((host, port))
    except (OSError, TypeError) as error:  # the latter of a name that cannot be encoded
        listener.close()
        raise _cannot_listen(host, port, error) from error
    return listener


def _cannot_listen(host: str, port: int, error: OSError | TypeError) -> ConfigError:
    reason = getattr(error, "strerror", None) or str(error)
    return ConfigError(f"cannot listen on {host} port {port} ({reason}); choose with --host and --port")


def _read_token(file: StrPath | None) -> str | None:
    """Return the bearer token. It is not taken from the command line, where other users could read it."""
    if file is None:
        return os.environ.get("TRILITENET_TOKEN", "").strip() or None
    try:
        return Path(file).read_text(encoding="utf-8").strip()
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror or error})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: holds no token (it is not text)") from error
