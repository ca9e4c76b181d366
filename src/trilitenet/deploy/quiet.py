"""Exporters and quantisers kept from talking: what they have to say is raised."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Final

__all__ = ["quiet"]

_ONE_AT_A_TIME: Final = threading.RLock()
"""Two that turn things of the process off and on at once would leave them off."""


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Let no warnings, no logs of this thread below errors and no standard output through, a thread at a time.

    Warnings and standard output are off for other threads too, for they cannot be told apart: a warning is filed under
    whichever module called, be it the standard library's, and NNCF draws its bars from threads of its own.
    """
    thread = threading.get_ident()
    with (
        _ONE_AT_A_TIME,
        warnings.catch_warnings(),
        Path(os.devnull).open("w", encoding="utf-8") as sink,
        contextlib.redirect_stdout(sink),
    ):
        handle = logging.Logger.handle

        def handle_others(logger: logging.Logger, record: logging.LogRecord) -> None:
            if record.levelno >= logging.ERROR or threading.get_ident() != thread:
                handle(logger, record)

        warnings.simplefilter("ignore")
        # Not filters: exporters use the root logger too, and what they import brings loggers and handlers of its own.
        logging.Logger.handle = handle_others  # type: ignore[method-assign, assignment]
        try:
            yield
        finally:
            logging.Logger.handle = handle  # type: ignore[method-assign]
