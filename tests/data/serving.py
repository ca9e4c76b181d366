"""A folder at an address on this machine."""

from __future__ import annotations

import contextlib
import functools
import http.server
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any


class Site:
    """What is served, and what was asked for.

    Attributes:
        address: Of the folder.
        asked: Names of files, in order.
        fails: Name -> how often it breaks off before it comes whole.
        busy: Names that are answered with 503.
    """

    def __init__(self) -> None:
        self.address = ""
        self.asked: list[str] = []
        self.fails: dict[str, int] = {}
        self.busy: set[str] = set()


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[Site]:
    """Serve the files of a folder over HTTP."""
    site = Site()

    class Handler(http.server.SimpleHTTPRequestHandler):
        def do_GET(self) -> None:
            name = self.path.rpartition("/")[2]
            site.asked.append(name)
            if name in site.busy:
                self.send_error(503)
            elif site.fails.get(name, 0):
                site.fails[name] -= 1
                self.send_response(200)
                self.send_header("Content-Length", "1000000")
                self.end_headers()
                self.wfile.write(b"half of it")
            else:
                super().do_GET()

        def log_message(self, *_: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(folder)))
    site.address = f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield site
    finally:
        server.shutdown()
        server.server_close()
