from __future__ import annotations

import errno
import inspect
import io
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import cyclopts
import pytest
from PIL import Image

from trilitenet.apps import cli
from trilitenet.config import shipped_weights
from trilitenet.errors import OutputError


@pytest.fixture
def greet(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Put a single command `greet` in place of the real ones; the list takes what it was called with."""
    calls: list[object] = []

    class Done:
        exit_code = 1
        errors = ("the other one: has gone",)

        def summary(self) -> str:
            return "1 of 2 greeted"

    def greeting(name: str, *, loudness: int = 1) -> object:
        """Greet somebody.

        Args:
            name: Whom.
            loudness: How loud.
        """
        calls.append((name, loudness))
        if name == "too long":
            Path("x" * 300).stat()
        if name.startswith("nobody"):
            raise OutputError(f"{name}: cannot be greeted")
        if name == "somebody":
            raise OSError("as nobody foresaw")
        if name in {"ctrl-c", "sigterm"}:
            signal.raise_signal(signal.SIGTERM if name == "sigterm" else signal.SIGINT)
            calls.append("not reached")
        return Done() if name == "two" else f"hello {name}"

    monkeypatch.setattr(cli, "COMMANDS", (cli.Command("greet", "greet", "greeting"),))
    monkeypatch.setattr(cli.Command, "load", lambda self: greeting)
    monkeypatch.setattr(cli.Command, "read_summary", lambda self: "Greet somebody.")
    return calls


def test_a_command_is_its_function(greet: list[object], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["greet", "Ada", "--loudness", "3"]) == 0
    assert greet == [("Ada", 3)]
    assert capsys.readouterr().out == "hello Ada\n"


def test_a_lone_hyphen_is_a_word_but_no_value_of_an_option(
    greet: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["greet", "-"]) == 0
    assert greet == [("-", 1)]
    assert cli.main(["greet", "--name", "-"]) == 2
    assert capsys.readouterr().err == (
        "error: Invalid value for --name: - is standard input, which only a source can be; give a name "
        "(see: trilitenet greet --help)\n"
    )
    assert cli.main(["greet", "Ada", "-"]) == 2
    assert capsys.readouterr().err == "error: unexpected - (see: trilitenet greet --help)\n"


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["predict", ""], ""),
        (["predict", "a.jpg", "--output", ""], "Invalid value for --output: "),
        (["evaluate", "tiny", "--data="], "Invalid value for --data: "),
        (["train", ""], ""),
    ],
)
def test_an_empty_word_is_not_the_current_folder(
    words: list[str], option: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(words) == 2
    message = "an empty word names nothing; is a variable of the shell unset?"
    assert capsys.readouterr().err == f"error: {option}{message} (see: trilitenet {words[0]} --help)\n"


def test_a_result_is_shown_and_decides_the_exit_code(greet: list[object], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["greet", "two"]) == 1
    assert capsys.readouterr() == ("1 of 2 greeted\n", "error: the other one: has gone\n")


def test_an_error_is_one_line(greet: list[object], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["greet", "nobody"]) == 1
    captured = capsys.readouterr()
    assert captured.err == "error: nobody: cannot be greeted\n"
    assert captured.out == ""


def test_what_nobody_foresaw_is_not_taken_for_a_full_output(greet: list[object]) -> None:
    with pytest.raises(OSError, match="as nobody foresaw"):
        cli.main(["greet", "somebody"])


def test_a_path_that_the_system_refuses_is_no_traceback(
    greet: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["greet", "too long"]) == 1
    assert capsys.readouterr().err == f"error: {'x' * 300}: File name too long\n"


def test_a_name_in_an_error_breaks_no_line_and_controls_no_terminal(
    greet: list[object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["greet", "nobody é\n\x1b[31m\u2028"]) == 1
    assert capsys.readouterr().err == "error: nobody é\\n\\x1b[31m\\u2028: cannot be greeted\n"


def test_what_standard_output_cannot_encode_is_no_traceback(
    greet: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(stream, encoding="latin-1"))
    assert cli.main(["greet", "─ é \udc80"]) == 0
    assert stream.getvalue() == b"hello ? \xe9 ?\n"


@pytest.fixture
def handlers() -> Iterator[dict[signal.Signals, Any]]:
    """Python's own handlers of what interrupts, put back at the end."""
    plain: dict[signal.Signals, Any] = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in plain.items()}
    yield plain
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("name", ["ctrl-c", "sigterm"])
def test_an_interruption_is_130_and_a_second_one_is_ignored(
    greet: list[object],
    name: str,
    capsys: pytest.CaptureFixture[str],
    handlers: dict[signal.Signals, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["trilitenet", "greet", name])
    assert cli.main() == 130
    assert capsys.readouterr().err == "error: interrupted\n"
    assert greet == [(name, 1)]
    assert {number: signal.getsignal(number) for number in handlers} == dict.fromkeys(handlers, signal.SIG_IGN)


@pytest.mark.parametrize(("name", "code"), [("Ada", 0), ("ctrl-c", 130)])
def test_a_program_that_goes_on_handles_signals_as_before(
    greet: list[object], name: str, code: int, handlers: dict[signal.Signals, Any]
) -> None:
    assert cli.main(["greet", name]) == code
    assert {number: signal.getsignal(number) for number in handlers} == handlers


def test_a_job_in_the_background_goes_on_at_ctrl_c(
    greet: list[object], capsys: pytest.CaptureFixture[str], handlers: dict[signal.Signals, Any]
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell starts it
    assert cli.main(["greet", "ctrl-c"]) == 0
    assert capsys.readouterr().out == "hello ctrl-c\n"
    assert greet == [("ctrl-c", 1), "not reached"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="there are no forks")
def test_a_fork_ends_at_once_at_sigterm() -> None:
    code = (
        "import os, signal\n"
        "from trilitenet.apps import cli\n"
        "with cli._interruptible(ends=True):\n"
        "    child = os.fork()\n"
        "    if not child:\n"
        "        try:\n"
        "            signal.raise_signal(signal.SIGTERM)\n"
        "        finally:\n"
        "            os._exit(1)\n"
        "    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "143\n"


_NO_INT = 'error: Invalid value for --loudness: unable to convert "{}" into int (see: trilitenet greet --help)\n'


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["gret"], "error: unknown command 'gret'; did you mean 'greet'?\n"),
        (["--versoin"], "error: unknown option --versoin; did you mean '--version'?\n"),
        (
            ["greet", "Ada", "--loudnes", "3"],
            "error: unknown option --loudnes; did you mean '--loudness'? (see: trilitenet greet --help)\n",
        ),
        (["greet"], 'error: Command "greet" parameter --name requires an argument (see: trilitenet greet --help)\n'),
        (["greet", "a", "--nonsense"], "error: unknown option --nonsense (see: trilitenet greet --help)\n"),
        (["greet", "a", "--louder=3"], None),
        (["greet", "a", "1", "2"], None),
        (["greet", "a", "--loudness", "much"], _NO_INT.format("much")),
        (["greet", "a", "--loudness", "2.5"], _NO_INT.format("2.5")),
    ],
)
def test_misuse_is_one_line_and_exit_code_2(
    greet: list[object], words: list[str], message: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    error = re.sub(r'"(--\w+)"', r"\1", capsys.readouterr().err)  # as earlier versions of the parser write it
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert message is None or error == message


def test_help_and_version(greet: list[object], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["greet", "--help"]) == 0
    assert "How loud." in capsys.readouterr().out
    for words in ([], ["--help"]):
        assert cli.main(words) == 0
        assert "Greet somebody." in capsys.readouterr().out
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("trilitenet 0.")


def test_the_nearest_option_is_found_by_what_every_version_of_the_parser_has() -> None:
    token = cyclopts.Token(keyword="--loudnes")
    arguments: Any = [SimpleNamespace(names=("--name",)), SimpleNamespace(names=("--loudness",))]
    error = cyclopts.UnknownOptionError(token=token, argument_collection=arguments)
    assert cli._one_line(error).startswith("unknown option --loudnes; did you mean '--loudness'?")


@pytest.mark.parametrize("command", cli.COMMANDS, ids=lambda command: command.words)
def test_every_command_is_documented(command: cli.Command) -> None:
    function = command.load()
    documentation = inspect.getdoc(function) or ""
    assert command.read_summary() == documentation.partition("\n")[0] != ""
    for name, parameter in inspect.signature(function).parameters.items():
        own_help = any(getattr(note, "help", None) for note in getattr(parameter.annotation, "__metadata__", ()))
        assert own_help or f"    {name}: " in documentation, f"{command.words}: {name} is not documented"


@pytest.mark.parametrize("command", cli.COMMANDS, ids=lambda command: command.words)
def test_every_command_has_help(command: cli.Command, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*command.words.split(), "--help"]) == 0
    told = capsys.readouterr().out
    assert f"trilitenet {command.words}" in told
    assert "--empty-" not in told


def test_a_group_has_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["weights", "--help"]) == 0
    assert cli.GROUPS["weights"] in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("words", [["--help"], ["--version"], ["weights", "--help"], ["wieghts"]])
def test_help_loads_no_runtime(words: list[str]) -> None:
    script = (
        "import sys; from trilitenet.apps.cli import main; main(sys.argv[1:]);"
        "assert not {'torch', 'av', 'cv2', 'openvino', 'onnxruntime'} & set(sys.modules), sorted(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script, *words], check=True, timeout=60, capture_output=True)


@pytest.mark.parametrize(
    ("command", "given", "spins"),
    [
        ("predict", {}, "10000"),
        ("evaluate", {}, "10000"),
        ("serve", {}, "10000"),
        ("predict", {"GOMP_SPINCOUNT": "7"}, "7"),
        ("predict", {"OMP_WAIT_POLICY": "ACTIVE"}, None),
        ("train", {}, None),
    ],
)
def test_threads_wait_less_at_full_load_where_a_network_is_only_run(
    command: str, given: dict[str, str], spins: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["trilitenet", command])
    monkeypatch.setattr(os, "environ", dict(given))
    monkeypatch.setattr(cli, "build_app", lambda words: lambda *_, **__: None)
    assert cli.main() == 0
    assert os.environ.get("GOMP_SPINCOUNT") == spins


def test_half_a_size_is_told_to_have_two_values(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["benchmark", "--size", "384"]) == 2
    assert "--size requires 2 values, got 1 (see: trilitenet benchmark --help)" in capsys.readouterr().err.replace(
        '"', ""
    )


def test_python_m_is_the_command() -> None:
    done = subprocess.run([sys.executable, "-m", "trilitenet", "--version"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0
    assert done.stdout.startswith("trilitenet ")


@pytest.mark.parametrize(
    "words", ["predict photo.jpg", "export tiny", "weights info tiny", "train recipe.yaml"], ids=lambda words: words
)
def test_without_pytorch_is_one_line(words: str, tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_bytes(b"x")
    code = (
        "import sys\n"
        "sys.modules['torch'] = None\n"
        "from trilitenet.apps.cli import main\n"
        f"sys.exit(main({words.split()!r}))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("error: this needs PyTorch")
    assert done.stderr.count("\n") == 1


def test_without_pytorch_python_says_so_too() -> None:
    code = (
        "import sys\n"
        "sys.modules['torch'] = None\n"
        "import trilitenet\n"
        "from trilitenet.errors import MissingExtraError\n"
        "for use in (lambda: trilitenet.load('tiny'), lambda: trilitenet.build_network):\n"
        "    try:\n"
        "        use()\n"
        "    except MissingExtraError as error:\n"
        "        assert str(error).startswith('this needs PyTorch'), error\n"
        "    else:\n"
        "        raise AssertionError\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_several_values_may_follow_one_option() -> None:
    words = [
        "benchmark",
        "--batch",
        "1",
        "8",
        "tiny",
        "8.onnx",
        "--backend",
        "torch",
        "onnxruntime",
        "--rounds",
        "2",
        "3",
    ]
    assert cli._repeated(words) == [
        *["benchmark", "--batch", "1", "--batch", "8", "tiny", "8.onnx"],
        *["--backend", "torch", "--backend", "onnxruntime", "--rounds", "2", "3"],
    ]
    assert cli._repeated(["evaluate-table", "--precisions", "fp32", "int8", "tiny"])[-3:] == [
        "--precisions",
        "int8",
        "tiny",
    ]


@pytest.mark.parametrize(
    ("words", "spread"),
    [
        ("data prepare DIR --splits train val", "data prepare DIR --splits train --splits val"),
        ("data prepare --splits train val-2024 DIR OUT", "data prepare --splits train --splits val-2024 DIR OUT"),
        ("data prepare DIR --splits train night", "data prepare DIR --splits train --splits night"),
        ("data prepare --splits night val DIR OUT", "data prepare --splits night --splits val DIR OUT"),
        ("data convert --splits val coco DIR OUT", "data convert --splits val coco DIR OUT"),
        ("data prepare DIR --splits test night test", "data prepare DIR --splits test --splits night --splits test"),
        ("predict --format json csv a.jpg", "predict --format json --format csv a.jpg"),
        ("predict --hide boxes labels a.jpg", "predict --hide boxes --hide labels a.jpg"),
        ("data show --where a=b c=d DIR", "data show --where a=b --where c=d DIR"),
        ("data convert --lane-width train=8 4 A B", "data convert --lane-width train=8 --lane-width 4 A B"),
        ("evaluate --by scene weather tiny", "evaluate --by scene --by weather tiny"),
        ("evaluate --by camera town small --limit 1", "evaluate --by camera --by town small --limit 1"),
        ("score --by camera town DIR", "score --by camera --by town DIR"),
        ("export --format onnx tiny", "export --format onnx tiny"),
        ("train --tasks detection lane r.yaml", "train --tasks detection --tasks lane r.yaml"),
        ("train --freeze encoder spp.reduce r.yaml", "train --freeze encoder --freeze spp.reduce r.yaml"),
        ("weights finish A B --card a.yaml b.yml", "weights finish A B --card a.yaml --card b.yml"),
        ("train --classes car truck r.yaml", "train --classes car --classes truck r.yaml"),
        ("data prepare DIR --classes car truck -h", "data prepare DIR --classes car --classes truck -h"),
        ("score --classes car truck DIR --limit 1", "score --classes car --classes truck DIR --limit 1"),
        ("data convert --classes FILE.yaml coco DIR OUT", "data convert --classes FILE.yaml coco DIR OUT"),
    ],
)
def test_no_second_value_is_taken_for_a_file(
    words: str, spread: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "DIR").mkdir()
    monkeypatch.chdir(tmp_path)
    assert cli._repeated(words.split()) == spread.split()


@pytest.mark.parametrize(
    ("words", "taken"),
    [
        ("benchmark tiny --size 384x640 --rounds 2", "benchmark tiny --size 384 640 --rounds 2"),
        ("benchmark tiny --size=384x640 --source 720X1280", "benchmark tiny --size 384 640 --source 720 1280"),
        ("benchmark --size 384 640 tiny", "benchmark --size 384 640 tiny"),
        ("train r.yaml --input-size 384x640", "train r.yaml --input-size 384 640"),
        ("predict 384x640 --output 640x360", "predict 384x640 --output 640x360"),
        ("export tiny --size 384 640 --format onnx", "export tiny --size 384x640 --format onnx"),
        ("export tiny --size 384x640 640", "export tiny --size 384x640 640"),
        ("export tiny --size=384x640", "export tiny --size=384x640"),
        ("evaluate-table tiny --size 384 640", "evaluate-table tiny --size 384x640"),
    ],
)
def test_a_size_is_one_word_or_two(words: str, taken: str) -> None:
    assert cli._sized(words.split()) == taken.split()


def test_a_size_of_one_word_reaches_a_command_that_takes_two(tmp_path: Path) -> None:
    assert cli.main(["data", "synthesize", str(tmp_path / "s"), "--count", "1", "--size", "96x160"]) == 0
    (picture,) = (tmp_path / "s" / "images" / "train").iterdir()
    with Image.open(picture) as image:
        assert image.size == (160, 96)


def test_the_values_that_may_follow_are_those_that_there_are() -> None:
    from trilitenet.commands.load import BACKENDS
    from trilitenet.config import Precision
    from trilitenet.formats.writers.base import WRITERS
    from trilitenet.models.trilitenet import build_network
    from trilitenet.processing.drawing import PARTS
    from trilitenet.road.drawing import ROAD_PARTS

    assert set(cli._LISTS["--backend"].split("|")) == set(BACKENDS)
    assert set(cli._LISTS["--precisions"].split("|")) == set(get_args(Precision))
    assert not any(re.fullmatch(cli._LISTS["--by"], name) for name in shipped_weights())
    assert cli._LISTS["--format"].split("|") == list(WRITERS)
    assert cli._LISTS["--hide"].split("|") == [*PARTS, *ROAD_PARTS]
    parts = [name for name, _ in build_network("tiny").named_modules() if name]
    assert [name for name in parts if not re.fullmatch(cli._LISTS["--freeze"], name)] == []


def test_an_unknown_level_of_the_log_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TRILITENET_LOG", "loud")
    assert cli.main(["--version"]) == 1
    assert capsys.readouterr().err == (
        "error: TRILITENET_LOG=LOUD is no level of a log; take DEBUG, INFO, WARNING or ERROR\n"
    )


def test_a_reader_that_has_gone_does_not_change_the_exit_code(tmp_path: Path) -> None:
    (tmp_path / "images" / "train").mkdir(parents=True)
    (tmp_path / "det_annotations" / "train").mkdir(parents=True)
    words = [sys.executable, "-m", "trilitenet", "data", "check", str(tmp_path), "--workers", "1"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        told = process.stderr.read()
    assert process.returncode == 1
    assert "Traceback" not in told


@pytest.mark.skipif(sys.platform != "linux", reason="/dev/full is not everywhere")
@pytest.mark.parametrize(
    ("words", "streams", "code", "told"),
    [
        ("data check .", ">&-", 1, None),
        ("data check .", ">&- 2>&-", 1, ""),
        ("data check .", ">/dev/full", 1, "error: standard output: cannot be written (No space left on device)\n"),
        ("--help", ">/dev/full", 1, "error: standard output: cannot be written (No space left on device)\n"),
        ("weights info tiny", ">/dev/full", 1, "error: standard output: cannot be written (No space left on device)\n"),
        ("predict -", "<&-", 1, "error: stdin: is closed\n"),
        ("nonsense", "2>&-", 2, ""),
    ],
)
def test_standard_streams_that_are_closed_or_full_are_no_tracebacks(
    words: str, streams: str, code: int, told: str | None, tmp_path: Path
) -> None:
    (tmp_path / "images" / "train").mkdir(parents=True)
    (tmp_path / "det_annotations" / "train").mkdir(parents=True)
    command = f'exec "{sys.executable}" -m trilitenet {words} {streams}'
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.returncode == code
    assert "Traceback" not in done.stderr
    assert told is None or done.stderr.endswith(told)


@pytest.mark.parametrize("command", ["import", "finish", "info"])
def test_what_commands_write_by_themselves_on_a_full_disk_is_told(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def write(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(cli, "build_app", lambda words: write)
    monkeypatch.setattr(cli, "_discard_output", lambda: None)
    assert cli.main(["weights", command]) == 1
    assert capsys.readouterr().err == "error: standard output: cannot be written (No space left on device)\n"


@pytest.mark.parametrize(
    ("words", "told"), [((), ""), (("Unable to allocate 7.28 TiB",), " (Unable to allocate 7.28 TiB)")]
)
def test_memory_that_runs_out_is_one_line(
    words: tuple[str, ...], told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*_: object, **__: object) -> None:
        raise MemoryError(*words)

    monkeypatch.setattr(cli, "build_app", lambda _: run)
    assert cli.main(["train"]) == 1
    assert capsys.readouterr().err == f"error: memory ran out{told}; ask for less at once, or make room\n"


def test_an_interruption_before_the_command_line_is_there_is_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "cyclopts.py").write_text("raise KeyboardInterrupt\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    done = subprocess.run([sys.executable, "-m", "trilitenet"], capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "error: interrupted\n")


@pytest.mark.parametrize("words", [["--help", "predict"], ["-h", "weights", "info"]])
def test_help_before_a_command_is_the_command_s(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 0
    before = capsys.readouterr().out
    assert cli.main([*words[1:], words[0]]) == 0
    assert before == capsys.readouterr().out
    assert "--json-output" in before or "--overwrite" in before


def test_help_into_a_closed_pipe_is_no_error() -> None:
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "wb") as pipe:
        done = subprocess.run(
            [sys.executable, "-m", "trilitenet", "predict", "--help"], stdout=pipe, stderr=subprocess.PIPE, timeout=60
        )
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_number_that_no_machine_has_is_told_in_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["predict", "a.jpg", "--batch-size", "1" + 20 * "0"]) == 2
    error = capsys.readouterr().err
    assert "is larger than any number here" in error
    assert error.count("\n") == 1
