"""Every exception the package raises on purpose, and what raises most of them: messages, extras, files made whole.

    TriLiteNetError
    ├── ConfigError (ValueError)          an unknown key, option, variant, task or value out of range
    ├── ShapeError (ValueError)           an array or tensor of the wrong shape, type or range
    ├── InputError (ValueError)           an image, video or stream that cannot be read
    ├── DataError (ValueError)            a data set or a label file that cannot be used
    ├── WeightsError (ValueError)         weights, a checkpoint or an exported artefact that is broken or foreign
    ├── OutputError (OSError)             a result that cannot be written, or would overwrite another
    ├── MissingExtraError (ImportError)   an optional dependency that is not installed; names the extra
    ├── BackendError (RuntimeError)       a runtime or device that is missing or fails
    └── TrainingError (RuntimeError)      a training run that cannot go on

Each also derives from the built-in a caller would expect. Messages are one line that names the cause and the cure;
the command line prints them as they are and exits 1. Files are written whole or not at all by `write_file`, `replacing`
and `folder_beside`, optional packages imported by `import_extra`.
"""

from __future__ import annotations

import contextlib
import difflib
import importlib
import os
import re
import secrets
import stat
import sys
import tempfile
import weakref
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Final

try:
    import fcntl
except ModuleNotFoundError:  # on Windows
    fcntl = None  # type: ignore[assignment]

__all__ = [
    "LONGEST_NAME",
    "BackendError",
    "Claim",
    "ConfigError",
    "DataError",
    "FreeNames",
    "InputError",
    "MissingExtraError",
    "OutputError",
    "ShapeError",
    "TrainingError",
    "TriLiteNetError",
    "WeightsError",
    "brief",
    "did_you_mean",
    "few",
    "folder_beside",
    "gist",
    "import_extra",
    "needing_torch",
    "part_of",
    "replacing",
    "scratch_folder",
    "shown",
    "write_file",
    "writing",
]

_REPORTER: Final = "openvino_telemetry"
"""The package that tells the makers of OpenVINO and NNCF of each use."""
LONGEST_NAME: Final = 255
"""Bytes of a file name that every file system takes."""
_BEGINNING: Final = 40
"""Characters of a long file name, of up to four bytes each, that its temporary name keeps."""
_ADDRESS: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:[/\\]")
"""How an address (``s3://...``) begins, also as a path of it; not ``C:/``, which has one letter."""
_MOST_SHOWN: Final = 200
"""Characters of a value, or of another library's error, that a message shows."""
_END: Final = 115
"""Characters of a long error's end that are among them."""


class TriLiteNetError(Exception):
    """Base of every exception raised on purpose."""


class ConfigError(TriLiteNetError, ValueError):
    """An unknown key, option, variant or task, or a value out of range."""


class ShapeError(TriLiteNetError, ValueError):
    """An array or tensor of the wrong shape, type or range."""


class InputError(TriLiteNetError, ValueError):
    """An image, video or stream that cannot be read."""


class DataError(TriLiteNetError, ValueError):
    """A data set or a label file that cannot be used."""


class WeightsError(TriLiteNetError, ValueError):
    """Weights, a checkpoint or an exported artefact that is broken, foreign or from a newer version."""


class OutputError(TriLiteNetError, OSError):
    """A result that cannot be written, or that would overwrite another."""


class MissingExtraError(TriLiteNetError, ImportError):
    """An optional dependency that is not installed."""


class BackendError(TriLiteNetError, RuntimeError):
    """A runtime or a device that is missing or fails."""


class TrainingError(TriLiteNetError, RuntimeError):
    """A training run that cannot go on."""


def brief(error: BaseException) -> str:
    """Return an error's kind and words for a message: its ``repr``, which of a decoding error is the whole file.

    Of a key that is not there it says so.
    """
    if isinstance(error, KeyError):
        return f"{error} is missing"
    return f"{type(error).__name__}: {error}" if isinstance(error, UnicodeError) else repr(error)


def gist(said: object) -> str:
    """Return on one line what another library says (an error, a text); of a long one both ends, where causes stand."""
    text = " ".join(str(said).split())
    if len(text) <= _MOST_SHOWN:
        return text
    return f"{text[: _MOST_SHOWN - _END - 5]} ... {text[-_END:]}"


def shown(value: object) -> str:
    """Return the ``repr`` of a value for a message, which of a whole list or text would not be one line to read."""
    try:
        text = " ".join(line.strip() for line in repr(value).splitlines())  # an array's has several
    except ValueError:  # a whole number that Python does not write
        return "a number of thousands of digits"
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]} ..."


def few(names: Sequence[str], most: int = 3) -> str:
    """Return the first names for a message, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ``"; did you mean 'x'?"`` for the nearest known word, or the list of what is known, if anything is."""
    # Compared without an option's dashes, which would make any two options alike.
    names = {name.lstrip("-"): name for name in sorted(known)}
    near = difflib.get_close_matches(word.lstrip("-"), names, n=1)
    if near:
        return f"; did you mean {names[near[0]]!r}?"
    return f"; known: {', '.join(names.values())}" if names else ""


def import_extra(module: str, extra: str) -> ModuleType:
    """Import an optional dependency, without what reports each use of it to its maker.

    Args:
        module: The module to import, for example ``"av"``.
        extra: The extra of this package that installs it, for example ``"video"``.

    Raises:
        MissingExtraError: If it is not installed; the message names the extra.
    """
    try:
        with _unreported() if module in {"openvino", "nncf"} else contextlib.nullcontext():
            return importlib.import_module(module)
    except ImportError as error:
        if isinstance(error.__cause__, KeyboardInterrupt):  # pybind11's modules make an ImportError of it
            raise error.__cause__ from None
        raise MissingExtraError(
            f"this needs {module!r} ({error}); install it with: pip install 'trilitenet[{extra}]'"
        ) from error


@contextlib.contextmanager
def _unreported() -> Iterator[None]:
    """Inside, OpenVINO and NNCF are imported as where the package that reports their use is not installed."""
    if _REPORTER in sys.modules:  # somebody else has imported them
        yield
        return
    sys.modules[_REPORTER] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.modules.pop(_REPORTER, None)


@contextlib.contextmanager
def needing_torch() -> Iterator[None]:
    """Say what to do where PyTorch is not installed.

    Raises:
        MissingExtraError: If a module of PyTorch is not found.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "torch":
            raise
        raise MissingExtraError(
            "this needs PyTorch, which is not installed: pip install 'torch>=2.6,<2.14'; "
            "without it, exported files run on ONNX Runtime, OpenVINO and NCNN"
        ) from error


@contextlib.contextmanager
def writing(output: str | Path) -> Iterator[None]:
    """Tell what the system says on writing, such as that the disk is full, in one line.

    Raises:
        OutputError: For any error of the system, and for an address, of which a folder ``s3:`` would be made.
    """
    if _ADDRESS.match(str(output)) and not Path(Path(output).parts[0]).exists():
        raise OutputError(f"{output}: is an address; results are written into folders: give one, and copy it there")
    try:
        yield
    except OSError as error:
        if isinstance(error, TriLiteNetError):
            raise
        path = error.filename2 or error.filename or output  # the former is what a temporary file was to replace
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from error


@contextlib.contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield a folder for temporary files, which goes with the block.

    Raises:
        OutputError: If there is no room in it; the error names the folder of all temporary files.
    """
    with writing(tempfile.gettempdir()), tempfile.TemporaryDirectory(prefix="trilitenet-") as folder:
        yield Path(folder)


def part_of(path: Path) -> Path:
    """Return where a file is written until it is whole: beside it, with ``.part`` at the end.

    A name of its own where that is longer than the 255 bytes that file systems take.
    """
    name = f"{path.name}.part"
    if len(os.fsencode(name)) > LONGEST_NAME:
        name = f"{path.name[:_BEGINNING]}.{zlib.crc32(os.fsencode(path.name)):08x}.part"
    return path.with_name(name)


class Claim:
    """Keeps others, in this process and elsewhere, from writing a file, while it is written as `part_of` names it.

    So too where that has been given the file's own name and is added to.

    Where the system or the file system knows no locks, it keeps off nobody.

    Args:
        path: The file; its folder exists.

    Raises:
        OutputError: If somebody else writes it.
    """

    def __init__(self, path: Path) -> None:
        part, number = part_of(path), None
        taken = OutputError(f"{path}: it is being written already; wait for its end, or choose another output")
        while fcntl is not None and number is None:
            try:
                number = os.open(part, os.O_RDWR | os.O_CREAT, 0o666)
                # Not lockf, which lets go where any other file object of the process for it is closed.
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if number is not None:
                    os.close(number)
                    number = None
                    if isinstance(error, BlockingIOError):
                        raise taken from None
                break  # what is wrong with its place is told by whoever writes it
            if not _is_named(number, part):  # the other has just given it its name
                os.close(number)
                number = None
        self._let_go = weakref.finalize(self, _let_go, number, part)
        self._let_go.atexit = False
        if _is_claimed(path):
            self.close()
            raise taken

    def close(self) -> None:
        """Let the file go; what has not got its name by then is removed."""
        self._let_go()


def _let_go(number: int | None, part: Path) -> None:
    if number is None or _is_named(number, part):
        with contextlib.suppress(OSError):
            part.unlink()
    if number is not None:
        os.close(number)


def _is_claimed(path: Path) -> bool:
    """Return whether somebody has claimed the file that has this name now."""
    with contextlib.suppress(OSError):
        number = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))  # a pipe would wait for a writer
        try:
            if fcntl is not None:
                fcntl.flock(number, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(number)
    return False


def _is_named(number: int, path: Path) -> bool:
    """Return whether a path is the open file of this number."""
    with contextlib.suppress(FileNotFoundError):
        return os.path.samestat(os.fstat(number), path.stat())
    return False


class FreeNames:
    """Gives names of which no two are the same: the second ``a`` becomes ``a-2``.

    Args:
        files: Names of files, which Windows and macOS do not tell apart by their case: an ``A`` becomes ``A-2`` too.
    """

    def __init__(self, *, files: bool = False) -> None:
        self._key: Callable[[str], str] = str.casefold if files else str
        self._last: dict[str, int] = {}  # given name -> the last number that was put at its end

    def give(self, name: str) -> str:
        """Return the name, or one with ``-2``, ``-3`` ... at the end if it was given before."""
        free, key = name, self._key(name)
        while self._key(free) in self._last:
            self._last[key] += 1
            free = f"{name}-{self._last[key]}"
        self._last[self._key(free)] = 1
        return free


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a name beside ``path``; the file written there takes its place in one step once the block is through.

    At any time ``path`` is either the old file or the new one, whole; if the block raises, nothing of it stays. Who may
    read it is as before, of a new file as the process makes files.

    Args:
        path: The file to write; its folder exists.
    """
    part = path.with_name(f".{path.name[:_BEGINNING]}.{secrets.token_hex(4)}.part")
    os.close(os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    mode = stat.S_IMODE((path if path.is_file() else part).stat().st_mode)
    try:
        yield part
        part.chmod(mode)  # safetensors makes its files readable to their owner alone
        part.replace(path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def folder_beside(path: Path) -> Iterator[Path]:
    """Yield a hidden folder beside ``path``, which goes with the block, to make in it what takes its place."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name[:_BEGINNING]}.") as folder:
        yield Path(folder)


def write_file(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all, in a folder made for it; a device or a link, such as /dev/stdout, stays so.

    Text is written in UTF-8, with escapes for what has no place in that, such as bytes of a file's name.

    Raises:
        OutputError: If it cannot be written.
    """
    data = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_symlink() or (path.exists() and not path.is_file()):
            path.write_bytes(data)
            return
        with replacing(path) as part:
            part.write_bytes(data)
