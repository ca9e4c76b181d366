"""The command line, generated from the typed, documented functions in `trilitenet.commands`.

A command is one line of `COMMANDS`. Its flags are the function's parameters and its help is the docstring, so the
Python API and the command line agree by construction. The function's module is imported only when its command is
called: ``trilitenet --help`` reads the summaries from the sources and loads neither PyTorch nor any other runtime.

What a command returns is shown by its ``summary()`` (or as it is, if it is text), followed by its ``errors``, and ends
with ``exit_code`` where it has one. Exit codes: 0 done; 1 an error, told in one line; 2 a wrong command line; 130
interrupted, by Ctrl-C or SIGTERM, of which the process then ignores further ones.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import io
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Final, NamedTuple, get_args

import cyclopts
from cyclopts.exceptions import CycloptsError, UnknownOptionError, UnusedCliTokensError

import trilitenet
from trilitenet.errors import ConfigError, OutputError, TriLiteNetError, did_you_mean, needing_torch

__all__ = ["COMMANDS", "GROUPS", "Command", "build_app", "main"]


class Command(NamedTuple):
    """One command.

    Attributes:
        words: What the user types after ``trilitenet``.
        module: The module that has the function.
        function: The function's name.
        package: The package of the module, below `trilitenet`; not ``commands`` only for a verb that is an application.
    """

    words: str
    module: str
    function: str
    package: str = "commands"

    def load(self) -> Callable[..., Any]:
        """Import the function."""
        function: Callable[..., Any] = getattr(
            importlib.import_module(f"trilitenet.{self.package}.{self.module}"), self.function
        )
        return function

    def read_summary(self) -> str:
        """Return the first line of the function's docstring, read from its source without importing it."""
        source = Path(trilitenet.__file__).parent.joinpath(*self.package.split("."), f"{self.module}.py")
        for node in ast.parse(source.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and node.name == self.function:
                return (ast.get_docstring(node) or "").partition("\n")[0]
        raise LookupError(f"{source} has no function {self.function}")


COMMANDS: Final[tuple[Command, ...]] = (
    Command("benchmark", "benchmark", "benchmark"),
    Command("compare", "compare", "compare"),
    Command("data check", "data", "check"),
    Command("data convert", "data", "convert"),
    Command("data prepare", "data", "prepare"),
    Command("data show", "data", "show"),
    Command("data synthesize", "synthesize", "synthesize"),
    Command("evaluate", "evaluate", "evaluate"),
    Command("evaluate-table", "evaluate_table", "evaluate_table"),
    Command("export", "export", "export"),
    Command("predict", "predict", "predict"),
    Command("score", "score", "score"),
    Command("serve", "command", "serve", package="apps.server"),
    Command("train", "train", "train"),
    Command("train-table", "train_table", "train_table"),
    Command("weights average", "weights", "average"),
    Command("weights finish", "weights", "finish"),
    Command("weights import", "weights", "import_weights"),
    Command("weights info", "weights", "info"),
)

GROUPS: Final = {
    "data": "Make, read, check and convert data sets.",
    "weights": "Import published weights, average and finish trained ones, and see what a file says of itself.",
}
"""Words that gather commands, with their help."""

_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")
"""Characters that end a line or control a terminal."""
_HYPHEN: Final = "\0"
"""Stands for a lone hyphen, which the parser takes for an option without a name; no word that is typed holds it."""
_HELP: Final = ("--help", "-h")
_ROOT_OPTIONS: Final = (*_HELP, "--version")
_SPARING: Final = {"evaluate", "evaluate-table", "predict", "serve"}
"""Commands that run a network, neither to train it nor to measure how fast it is."""
_SPINS: Final = "10000"
"""Turns for which a thread of PyTorch's spins while it waits for another, by default 300,000. Where other processes
want the cores, the other waits for its own meanwhile; a training, which has them to itself, is 7% slower with fewer."""


def build_app(words: Sequence[str] = ()) -> cyclopts.App:
    """Build the command line.

    Args:
        words: What the user typed: only the command that they name is imported.
    """
    helps = not words or any(word in _HELP for word in words)
    while words and words[0] in _HELP:  # before the command as well as behind it
        words = words[1:]
    app = cyclopts.App(
        name="trilitenet",
        help="Light driving perception: vehicles, drivable area and lane lines from one tiny network.",
        version=f"trilitenet {trilitenet.__version__}",
        help_format="markdown",
        default_parameter=cyclopts.Parameter(negative_iterable=(), converter=_converted),
        help_on_error=False,
        suppress_keyboard_interrupt=False,
        console=_help_console() if helps else None,
    )
    groups = {name: cyclopts.App(name=name, help=text) for name, text in GROUPS.items()}
    called = next((c for c in COMMANDS if list(words[: len(c.words.split())]) == c.words.split()), None)
    for command in COMMANDS:
        parts = command.words.split()
        parent = groups[parts[0]] if len(parts) == 2 else app
        if command is called:
            parent.command(command.load(), name=parts[-1])
        elif called is None:
            parent.command(_placeholder, name=parts[-1], help=command.read_summary())
    for group in groups.values():
        if any(not name.startswith("-") for name in group):
            app.command(group)
    return app


def _help_console() -> Any:
    """Return the console that help is written to."""
    from rich.console import Console

    class HelpConsole(Console):
        def on_broken_pipe(self) -> None:
            raise BrokenPipeError  # not SystemExit(1): `main` tells nothing of a reader that has gone

    return HelpConsole()


def _converted(type_: Any, tokens: Sequence[cyclopts.Token]) -> Any:
    """Convert words as the parser does, with a lone hyphen among them, but round no fraction to a whole number."""
    hyphen = next((token for token in tokens if token.value == _HYPHEN and token.keyword is not None), None)
    if hyphen is not None:
        raise cyclopts.CoercionError(token=hyphen, msg="- is standard input, which only a source can be; give a name")
    kinds = (type_, *get_args(type_))
    empty = next((token for token in tokens if not token.value and (token.keyword is None or Path in kinds)), None)
    if empty is not None:  # a path of it would be the current folder
        raise cyclopts.CoercionError(token=empty, msg="an empty word names nothing; is a variable of the shell unset?")
    tokens = [token.evolve(value="-") if token.value == _HYPHEN else token for token in tokens]
    if int in kinds:
        fraction = next((token for token in tokens if "." in token.value), None)
        if fraction is not None:
            raise cyclopts.CoercionError(token=fraction, target_type=int)
        large = next((t for t in tokens if t.keyword != "--seed" and len(t.value.lstrip("+-0")) > 18), None)
        if large is not None:
            raise cyclopts.CoercionError(token=large, msg=f"{large.value[:20]}... is larger than any number here")
    return cyclopts.convert(type_, tokens)


_SPLIT: Final = r"(train|val|valid|validation|test)([-_.]\w+)?"
_LISTS: Final = {
    "--backend": "auto|torch|onnxruntime|openvino|ncnn|executorch|tensorrt",
    "--batch": r"\d+",
    "--by": r"(?!(tiny|small|base)$)[^-./\\][^./\\]*",
    "--card": r".+\.ya?ml",
    "--classes": r"[^-./\\][^./\\]*",
    "--format": "json|jsonl|scalabel|openlabel|coco|yolo|cvat|parquet|csv",
    "--freeze": r"(encoder|spp|litepan|detection|pcaa|reduce|drivable|lane)(\.\w+)*",
    "--hide": "drivable|lane|boxes|labels|lines|distances|above|status",
    "--lane-width": r"([\w*.-]+=)?\d+(\.\d+)?",
    "--loggers": "csv|tensorboard|mlflow|wandb",
    "--precisions": "fp32|fp16|bf16|int8",
    "--resolution": r"\d+",
    "--severities": r"\d+",
    "--splits": rf"{_SPLIT}|(?!(bdd100k|coco|yolo|cvat|masks)$)[^-./\\][^./\\]*",
    "--tasks": "detection|drivable|lane",
    "--where": r"[\w.-]+=.+",
}
"""Options that take several values, and what a value looks like, so that no file or model is taken for one."""
_ANY_WORD: Final = {"--by": "", "--classes": "", "--splits": _SPLIT}
"""Those of which any word may be a value, unless there is a file of that name; and the words that are one even then."""


def _repeated(words: Sequence[str]) -> list[str]:
    """Return ``--batch 1 8`` as ``--batch 1 --batch 8``, the form that the parser takes."""
    spread: list[str] = []
    option = ""
    for word in words:
        further = bool(option) and re.fullmatch(_LISTS[option], word) is not None
        if option in _ANY_WORD and os.access(word, os.F_OK) and re.fullmatch(_ANY_WORD[option], word) is None:
            further = False
        if further and spread[-1] != option:
            spread.append(option)
        elif not further:
            option = word if word in _LISTS else ""
        spread.append(word)
    return spread


_SIZES: Final = ("--input-size", "--size", "--source")
"""Options that take a height and a width: as one word where a command knows other sizes too, else as two."""
_SIZES_OF_ONE_WORD: Final = ("evaluate-table", "export")


def _sized(words: Sequence[str]) -> list[str]:
    """Return ``384x640`` and ``384 640`` behind an option of a size, which mean the same, in the form that it takes."""
    joined = bool(words) and words[0] in _SIZES_OF_ONE_WORD
    line: list[str] = []
    for word in words:
        option, equals, value = word.partition("=")
        size = re.fullmatch(r"(\d+)[xX](\d+)", value if equals else word)
        if size is not None and not joined and (option in _SIZES if equals else line[-1:] and line[-1] in _SIZES):
            line += [option, *size.groups()] if equals else size.groups()
        elif joined and word.isdecimal() and len(line) > 1 and line[-1].isdecimal() and line[-2] in _SIZES:
            line[-1] += f"x{word}"
        else:
            line.append(word)
    return line


def main(words: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        words: The arguments; those of the process if left out.

    Returns:
        The exit code.
    """
    _open_closed_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal or a pipe of another encoding lacks the rules of tables
    ends = words is None  # with this function, the process
    words = sys.argv[1:] if words is None else words
    if ends and _SPARING.intersection(words[:1]) and "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _SPINS)  # read when PyTorch is imported
    level = os.environ.get("TRILITENET_LOG", "WARNING").upper()
    known = isinstance(logging.getLevelName(level), int)  # of a name it gives the number
    logging.basicConfig(level=level if known else "WARNING", format="%(levelname)s %(name)s: %(message)s")
    result: Any = None
    try:
        if not known:
            raise ConfigError(f"TRILITENET_LOG={level} is no level of a log; take DEBUG, INFO, WARNING or ERROR")
        _check_command(words)
        words = [_HYPHEN if word == "-" else word for word in _repeated(_sized(words))]
        with needing_torch():
            app = build_app(words)
            with _interruptible(ends):
                result = app(words, print_error=False, exit_on_error=False, verbose=False, result_action="return_value")
        _show(result)
    except _MisuseError as error:
        return _fail(str(error), code=2)
    except CycloptsError as error:
        return _fail(_one_line(error), code=2)
    except TriLiteNetError as error:
        return _fail(str(error), code=1)
    except KeyboardInterrupt:
        return _fail("interrupted", code=130)
    except MemoryError as error:
        return _fail(f"memory ran out{f' ({error})' if str(error) else ''}; ask for less at once, or make room", code=1)
    except BrokenPipeError:  # the reader, such as `head`, has gone
        _discard_output()
    except OSError as error:
        if error.filename is not None:
            return _fail(f"{error.filename}: {error.strerror}", code=1)  # such as a name that is too long
        if words and words[0] != "weights" and not set(_ROOT_OPTIONS) & set(words):
            raise
        return _fail(_output_failed(error), code=1)  # of what writes by itself
    return int(getattr(result, "exit_code", 0))


@contextlib.contextmanager
def _interruptible(ends: bool) -> Iterator[None]:
    """Let SIGTERM interrupt as Ctrl-C does: what is half done is finished or taken back before the process ends.

    After the first of them both are ignored, or a second one would cut that short; to the end of the process if it
    ``ends`` with the command.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    process = os.getpid()
    before = {signal.SIGTERM: signal.getsignal(signal.SIGTERM)}
    if callable(signal.getsignal(signal.SIGINT)):  # a shell's background job ignores it
        before[signal.SIGINT] = signal.getsignal(signal.SIGINT)
    interrupted = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        if os.getpid() == process:
            interrupted = True
            for each in before:
                signal.signal(each, signal.SIG_IGN)
        elif number == signal.SIGTERM:  # a fork: whoever started it ends it so
            os._exit(128 + number)
        raise KeyboardInterrupt

    for each in before:
        signal.signal(each, interrupt)
    try:
        yield
    finally:
        if not (interrupted and ends):
            for each, handler in before.items():
                signal.signal(each, handler)


class _MisuseError(Exception):
    """A first word that is no command and no option."""


def _placeholder() -> None:
    """Stand in for a command that the command line does not name."""


def _check_command(words: Sequence[str]) -> None:
    """Refuse a word that is no command, naming the nearest one, without importing any."""
    paths = [command.words.split() for command in COMMANDS]
    if not words:
        return
    if words[0].startswith("-"):
        if words[0] not in _ROOT_OPTIONS:
            raise _MisuseError(f"unknown option {words[0]}{did_you_mean(words[0], _ROOT_OPTIONS)}")
        return
    known = {path[0] for path in paths}
    if words[0] not in known:
        raise _MisuseError(f"unknown command {words[0]!r}{did_you_mean(words[0], known)}")
    below = {path[1] for path in paths if path[0] == words[0] and len(path) == 2}
    if below and len(words) > 1 and not words[1].startswith("-") and words[1] not in below:
        raise _MisuseError(f"unknown command '{words[0]} {words[1]}'{did_you_mean(words[1], below)}")


def _one_line(error: CycloptsError) -> str:
    """Return the message as one line, and how to get help."""
    if isinstance(error, UnknownOptionError):
        option = (error.token.keyword or error.token.value).partition("=")[0]
        known = [name for argument in error.argument_collection for name in argument.names]
        near = did_you_mean(option, known)
        text = f"unknown option {option}" + (near if near.endswith("?") else "")
    elif isinstance(error, UnusedCliTokensError):
        text = f"unexpected {' '.join(error.unused_tokens or ())}"
    else:
        text = " ".join(str(error).split()).replace("positional arguments. Only got", "values, got")
    chain = " ".join(["trilitenet", *(error.command_chain or ())])
    return f"{text.rstrip('.')} (see: {chain} --help)".replace(_HYPHEN, "-")


def _open_closed_streams() -> None:
    """Put the null device where a standard stream is closed, or the next file that is opened would take its number.

    Only what is written to it is lost in silence: standard input stays None.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    if sys.stdout is None:
        sys.stdout = open(1, "w", encoding="utf-8")  # noqa: SIM115 - a number; it stays open
    if sys.stderr is None:
        sys.stderr = open(2, "w", encoding="utf-8")  # noqa: SIM115


def _show(result: object) -> None:
    """Write what a command returned, and its errors.

    Raises:
        OutputError: If standard output takes no more.
    """
    text = result.summary() if hasattr(result, "summary") else result
    try:
        sys.stdout.write(f"{text}\n" if isinstance(text, str) and text else "")
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(_output_failed(error)) from error
    finally:
        for line in getattr(result, "errors", ()):
            _tell(line)


def _output_failed(error: OSError) -> str:
    """Discard what standard output takes no more, and return why in words."""
    _discard_output()
    return f"standard output: cannot be written ({error.strerror or error})"


def _discard_output() -> None:
    """Let what standard output still holds go nowhere, or the end of the process would fail at it again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message: str, code: int) -> int:
    _tell(message)
    return code


def _tell(message: str) -> None:
    """Write an error as one line that does nothing to the terminal, whatever the names of files in it hold."""
    shown = _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), message)
    sys.stderr.write(f"error: {shown}\n")
