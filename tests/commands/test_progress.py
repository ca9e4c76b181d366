from __future__ import annotations

import io
import logging
import re
import sys

import pytest

from trilitenet.commands.progress import show_progress
from trilitenet.commands.train import _display

LOSSES = "epoch 1/200 step 12/500: total 0.9643 box 0.1138 objectness 0.3662 classification 0.0003 lane_focal 0.0947"


def open_terminal(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    for name, value in (("FORCE_COLOR", "1"), ("TERM", "xterm"), ("COLUMNS", "80")):
        monkeypatch.setenv(name, value)
    return stream


def lines(terminal: io.StringIO) -> list[str]:
    """Return what a terminal has shown, a line each time that it was drawn."""
    return re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue()))


def test_messages_of_the_log_have_lines_of_their_own_beside_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    handler = logging.StreamHandler(terminal)
    logging.getLogger().addHandler(handler)
    try:
        with show_progress("images") as shown:
            shown(3, 6)
            logging.getLogger("trilitenet.somewhere").warning("look at this")
        assert "look at this" in lines(terminal)
        assert handler.stream is terminal
    finally:
        logging.getLogger().removeHandler(handler)


def test_a_training_shows_its_step_in_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    with _display(quiet=False) as display:
        display.line("anchors kept")
        display.step(12, 500, LOSSES)
    shown = lines(terminal)
    assert "anchors kept" in shown
    last = [line for line in shown if line.strip()][-1]
    assert re.match(r"step +12/500 .*0:00:0\d .*total 0\.9643", last)
    assert len(last) <= 80


def test_a_training_tells_its_steps_in_lines_where_there_is_no_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    with _display(quiet=False) as display:
        display.step(12, 500, LOSSES)
    with _display(quiet=True) as display:
        display.step(13, 500, LOSSES)
        display.line("anchors kept")
    assert capsys.readouterr().err == LOSSES + "\n"
