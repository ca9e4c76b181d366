"""Paths of commands: text stands for one, and one for several, in the Python API; whether one can be written."""

from __future__ import annotations

import functools
import inspect
import os
import re
from collections.abc import Callable
from pathlib import Path, PurePath
from typing import Any, TypeVar, cast

from trilitenet.errors import OutputError, writing

__all__ = ["check_writable", "text_paths"]

_Function = TypeVar("_Function", bound=Callable[..., Any])


def text_paths(function: _Function) -> _Function:
    """Return the function so that arguments annotated as paths, and not as texts too, may be texts.

    Where several texts or paths are taken, one may be given as it is: its letters are not taken for several.

    Args:
        function: Of a module with postponed annotations.
    """
    signature = inspect.signature(function)
    names = {
        name
        for name, parameter in signature.parameters.items()
        if "Path" in str(parameter.annotation) and "str" not in str(parameter.annotation)
    }
    several = {
        name
        for name, parameter in signature.parameters.items()
        if re.search(r"Sequence\[|tuple\[\w+, \.\.\.\]", str(parameter.annotation))
    }

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        bound = signature.bind(*args, **kwargs)
        for name in several & bound.arguments.keys():
            if isinstance(bound.arguments[name], (str, PurePath)):
                bound.arguments[name] = (bound.arguments[name],)
        for name in names & bound.arguments.keys():
            bound.arguments[name] = _as_path(bound.arguments[name])
        return function(*bound.args, **bound.kwargs)

    return cast(_Function, call)


def _as_path(value: Any) -> Any:
    if isinstance(value, str):
        return Path(value)
    return [_as_path(one) for one in value] if isinstance(value, (list, tuple)) else value


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
