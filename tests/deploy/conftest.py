from __future__ import annotations

import errno
import os
import re
import tempfile
from pathlib import Path

import pytest


@pytest.fixture
def no_room(monkeypatch: pytest.MonkeyPatch) -> str:
    """Let no file be written; return what is told of the folder of temporary ones, as a pattern."""

    def fill(path: Path, data: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", fill)
    return rf"^{re.escape(tempfile.gettempdir())}: cannot be written \(No space left on device\)$"
