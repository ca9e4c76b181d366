"""Imports go down only. import-linter holds the layers; what it cannot see is checked here."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "src" / "trilitenet"


def test_layers_hold() -> None:
    command = shutil.which("lint-imports", path=str(Path(sys.executable).parent))
    if command is None:
        pytest.skip("import-linter is not installed beside this Python")
    done = subprocess.run([command, "--no-cache"], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


def imported(path: Path) -> set[str]:
    """Return the top-level packages a file imports anywhere, functions included."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module.partition(".")[0])
    return names


def test_no_file_imports_what_is_banned() -> None:
    assert [path for path in PACKAGE.rglob("*.py") if imported(path) & {"torchvision", "ultralytics"}] == []


def test_a_logger_of_a_module_has_one_name_and_is_used() -> None:
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        names = re.findall(r"^(\w+)(?:: Final)? = logging\.getLogger\(", text, re.MULTILINE)
        assert names in ([], ["_LOGGER"]), path
        assert not names or "_LOGGER." in text, path


def test_what_one_module_takes_from_another_is_in_its_all() -> None:
    modules: dict[str, ast.Module] = {}
    for path in PACKAGE.rglob("*.py"):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        modules[".".join(parts).removesuffix(".__init__")] = ast.parse(path.read_text(encoding="utf-8"))
    told: dict[str, set[str]] = {}
    for name, tree in modules.items():
        for node in tree.body:
            if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__all__"]:
                told[name] = set(ast.literal_eval(node.value))
    hidden = {
        f"{node.module}.{alias.name}"
        for tree in modules.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module in modules
        for alias in node.names
        if alias.name not in told.get(node.module, set())
    }
    assert hidden - modules.keys() == set()


def test_no_folder_is_a_drawer_for_anything() -> None:
    names = {path.stem for path in PACKAGE.rglob("*") if path.is_dir() or path.suffix == ".py"}
    assert not names & {"utils", "util", "common", "misc", "helpers"}
    assert not (PACKAGE / "export").exists(), "would collide with the public name trilitenet.export"


def test_test_files_mirror_the_package() -> None:
    """A test of one module lives in that module's layer: tests/<layer>/test_<module>.py."""
    layers = {path.name for path in PACKAGE.iterdir() if path.is_dir() and (path / "__init__.py").exists()}
    folders = {path.name for path in (ROOT / "tests").iterdir() if path.is_dir() and any(path.glob("test_*.py"))}
    assert folders <= layers | {"parity", "benchmarks", "recipes", "ros2"}


def test_every_test_folder_is_a_package() -> None:
    """Two test files of one name, in two layers, clash unless their folders are packages."""
    folders = {path.parent for path in (ROOT / "tests").rglob("test_*.py")}
    assert not {folder for folder in folders if not (folder / "__init__.py").exists()}
