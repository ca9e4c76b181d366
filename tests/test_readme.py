"""What the README and the documentation tell people to type works."""

from __future__ import annotations

import ast
import os
import pkgutil
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from trilitenet.apps.cli import COMMANDS, _repeated, build_app

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def lines(page: Path) -> list[str]:
    """Return the commands of a page, continued lines joined and comments gone."""
    text = "\n".join(block.replace("\\\n", " ") for block in blocks(page, "bash"))
    commands = (shlex.join(shlex.split(line, comments=True)) for line in text.splitlines())
    return [command for command in commands if command]


def commands_of(tool: str) -> list[object]:
    return [
        pytest.param(line, id=f"{page.relative_to(ROOT)}: {line}")
        for page in PAGES
        for line in lines(page)
        if line.split()[0] == tool
    ]


@pytest.mark.parametrize("line", commands_of("trilitenet"))
def test_commands_parse(line: str) -> None:
    words = shlex.split(line)[1:]
    if "--help" in words or "COMMAND" in words:
        return
    build_app(words).parse_args(_repeated(words), print_error=False, exit_on_error=False)


@pytest.mark.parametrize("line", commands_of("make"))
def test_make_targets_exist(line: str) -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    asked = {word for word in line.split()[1:] if "=" not in word and not word.startswith(("-", "apt", "<"))}
    assert asked <= targets


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
@pytest.mark.parametrize(("words", "extras"), [([], "all,executorch,dev"), (["TORCH=torch==2.6.0"], "all,dev")])
def test_another_pytorch_is_not_replaced_for_executorch(words: list[str], extras: str, tmp_path: Path) -> None:
    command = ["make", "--dry-run", "test", f"VENV={tmp_path}", *words]
    alone = {"PATH": os.environ["PATH"]}  # without what a make that runs the tests was told
    done = subprocess.run(command, cwd=ROOT, env=alone, capture_output=True, text=True, check=True)
    assert f'install --quiet --no-compile --editable ".[{extras}]"' in done.stdout


@pytest.mark.parametrize("line", commands_of("pip"))
def test_extras_exist(line: str) -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    section = text.partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    known = set(re.findall(r"^([a-z]+) = \[", section, re.MULTILINE))
    for extras in re.findall(r"\[([a-z,]+)\]", line):
        assert set(extras.split(",")) <= known, line


@pytest.mark.parametrize("number", range(len(blocks(README, "python"))))
def test_python_of_the_readme_runs(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (360, 640, 3), np.uint8)
    Image.fromarray(picture).save(tmp_path / "photo.jpg")
    monkeypatch.chdir(tmp_path)
    code = blocks(README, "python")[number]
    exec(compile(code, f"README.md, Python block {number + 1}", "exec"), {})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_python_of_every_page_compiles_and_imports_what_exists(page: Path) -> None:
    for block in blocks(page, "python"):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("trilitenet"):
                module = __import__(str(node.module), fromlist=[alias.name for alias in node.names])
                missing = [alias.name for alias in node.names if not hasattr(module, alias.name)]
                assert not missing, f"{page.name}: {node.module} has no {missing}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_pictures_exist(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        if "://" not in target and not target.startswith("mailto:"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_every_path_of_the_map_exists() -> None:
    paths = re.findall(r"^\| `([a-z_./]*/[a-z_./]*)` \|", README.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(paths) > 10
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_the_map_is_complete() -> None:
    text = README.read_text(encoding="utf-8")
    package = ROOT / "src" / "trilitenet"
    parts = [path for path in package.iterdir() if (path / "__init__.py").exists() or path.suffix == ".py"]
    names = [f"`src/trilitenet/{path.name}{'/' if path.is_dir() else ''}`" for path in parts]
    assert [name for name in names if name not in text and "__" not in name] == []


def test_every_command_has_a_place_in_the_documentation() -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert [command.words for command in COMMANDS if f"trilitenet {command.words}" not in text] == []


def test_every_function_of_a_command_is_in_the_reference() -> None:
    shown = set(re.findall(r"^::: (\S+)$", (ROOT / "docs" / "reference.md").read_text(encoding="utf-8"), re.MULTILINE))
    functions = {f"trilitenet.{command.package}.{command.module}.{command.function}" for command in COMMANDS}
    network = {f"trilitenet.models.trilitenet.{name}" for name in ("TriLiteNet", "NetworkOutputs", "normalise_images")}
    assert (functions | network) - shown == set()


def test_what_the_reference_shows_exists() -> None:
    for name in re.findall(r"^::: (\S+)$", (ROOT / "docs" / "reference.md").read_text(encoding="utf-8"), re.MULTILINE):
        pkgutil.resolve_name(name)


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", ".pre-commit-config.yaml"])
def test_what_no_extra_installs_is_told_how_to_install(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    assert "`pre-commit install`" in text
    assert "`pip install pre-commit`" in text


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_name_no_place_of_one_machine(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"(?<![\w.])/(work|tmp/v0|root|home)/", text)
