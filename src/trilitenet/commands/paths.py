"""Arguments in the Python API: texts for paths and sizes, and one for several; whether a path can be written."""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, cast

from trilitenet.errors import OutputError, writing

__all__ = ["NameOrPath", "SizeText", "StrPath", "check_writable", "one_for_several", "optional_path"]

if TYPE_CHECKING:
    StrPath: TypeAlias = str | Path
    NameOrPath: TypeAlias = str | Path
    SizeText: TypeAlias = str | tuple[int, int]
else:  # what the command line makes of words, and calls them in its help
    StrPath = Path
    NameOrPath = str
    SizeText = str

_Function = TypeVar("_Function", bound=Callable[..., Any])


def one_for_several(function: _Function) -> _Function:
    """Return the function so that one text or path may be given as it is where several are taken.

    Its letters are not taken for several.

    Args:
        function: Of a module with postponed annotations.
    """
    signature = inspect.signature(function)
    several = {name for name, parameter in signature.parameters.items() if "Sequence[" in str(parameter.annotation)}

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        bound = signature.bind(*args, **kwargs)
        for name in several & bound.arguments.keys():
            if isinstance(bound.arguments[name], (str, PurePath)):
                bound.arguments[name] = (bound.arguments[name],)
        return function(*bound.args, **bound.kwargs)

    return cast(_Function, call)


def optional_path(path: StrPath | None) -> Path | None:
    """Return the path that a text says, if there is one."""
    return None if path is None else Path(path)


def check_writable(path: Path) -> None:
    """Refuse, before any work, a file whose place is taken by a folder, or that no folder can be made for.

    Raises:
        OutputError: If it is so.
    """
    with writing(path):
        folder = next((parent for parent in path.parents if parent.exists()), Path())
        reason = ""
        if not folder.is_dir():
            reason = f"{folder} is no folder"
        elif path.is_dir():
            reason = "it is a folder"
        elif not os.access(folder, os.W_OK | os.X_OK):
            reason = f"no permission to write in {folder}"
    if reason:
        raise OutputError(f"{path}: cannot be written ({reason})")
