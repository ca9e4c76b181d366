from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import pytest

from trilitenet.errors import BackendError
from trilitenet.processing.cores import ProcessPool

SCRIPT = """
import signal, sys, time
from trilitenet.processing.cores import ProcessPool

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would ignore it
    try:
        with ProcessPool(3) as pool:
            tasks = [pool.submit(time.sleep, seconds) for seconds in (60, 60, 0, 0)]
            if sys.argv[1] == "busy":
                tasks[2].result()
            print("begun", flush=True)
            tasks[0].result()
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""


@pytest.mark.skipif(not hasattr(signal, "pthread_sigmask"), reason="no process groups")
@pytest.mark.parametrize("when", ["starting", "busy"])
def test_ctrl_c_in_the_terminal_ends_all_processes_without_a_word(when: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, when],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        began = time.monotonic()
        os.killpg(process.pid, signal.SIGINT)
        printed, complaints = process.communicate(timeout=55)
    assert (printed, complaints) == ("interrupted\n", "")
    assert time.monotonic() - began < 50


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no such signal")
def test_processes_end_when_the_one_that_started_them_is_killed() -> None:
    with subprocess.Popen([sys.executable, "-c", SCRIPT, "busy"], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        process.kill()
        assert process.communicate(timeout=30)[0] == ""  # which waits for all that hold the pipe


def test_a_pool_works_and_tells_errors() -> None:
    with ProcessPool(2) as pool:
        assert list(pool.map(abs, [-1, 2, -3])) == [1, 2, 3]
        with pytest.raises(ValueError, match="invalid literal"):
            pool.submit(int, "x").result()


def run_script(path: Path, text: str) -> tuple[str, str]:
    """Return what a script prints, and what it complains of."""
    path.write_text(text)
    done = subprocess.run([sys.executable, path], capture_output=True, text=True, check=True, timeout=60)
    return done.stdout, done.stderr


def test_a_plain_script_needs_no_guard(tmp_path: Path) -> None:
    said = run_script(
        tmp_path / "plain.py",
        "from trilitenet.processing.cores import ProcessPool\n"
        "print('once')\n"
        "with ProcessPool(2) as pool:\n"
        "    print(list(pool.map(abs, [-1, 2])), __file__ == __import__('sys').argv[0], __spec__)\n",
    )
    assert said == ("once\n[1, 2] True None\n", "")


def test_a_guarded_script_may_hand_over_what_is_its_own(tmp_path: Path) -> None:
    said = run_script(
        tmp_path / "guarded.py",
        "from trilitenet.processing.cores import ProcessPool\n"
        "def twice(number): return 2 * number\n"
        "if __name__ == '__main__':\n"
        "    with ProcessPool(2) as pool:\n"
        "        print(list(pool.map(twice, [1, 2])))\n",
    )
    assert said == ("[2, 4]\n", "")


def test_a_process_that_is_killed_is_one_line() -> None:
    message = r"was ended, mostly for want of memory; give fewer --workers, such as 1$"
    with pytest.raises(BackendError, match=message), ProcessPool(1) as pool:
        pool.submit(os._exit, 9).result()


def threads() -> int:
    return cv2.getNumThreads()


def test_processes_share_the_cores_whatever_opencv_would_take() -> None:
    with ProcessPool(1) as pool:
        assert pool.submit(threads).result() == 1
