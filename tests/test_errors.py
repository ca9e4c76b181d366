from __future__ import annotations

import errno
import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from trilitenet.errors import (
    Claim,
    FreeNames,
    MissingExtraError,
    OutputError,
    did_you_mean,
    few,
    gist,
    import_extra,
    needing_torch,
    part_of,
    replacing,
    write_file,
    writing,
)


def interrupt(path: Path, error: BaseException) -> None:
    with replacing(path) as part:
        part.write_text("ne")
        raise error


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with replacing(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    for error in (KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device")):
        with pytest.raises(type(error)):
            interrupt(path, error)
        assert path.read_text() == "new"
        assert list(tmp_path.iterdir()) == [path]


def test_a_long_error_of_another_library_keeps_its_beginning_and_its_end_on_one_line() -> None:
    assert gist(RuntimeError("no\n  room")) == "no room"
    told = gist(RuntimeError("Exception from " + "src/a.cpp:1:\n" * 99 + "the device is lost"))
    assert told.startswith("Exception from src/a.cpp:1:")
    assert told.endswith("the device is lost")
    assert len(told) == len(gist(RuntimeError("x" * 200))) == 200


def test_writing_tells_the_cause_in_one_line(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputError, match=r"absent/\.a\.txt.*: cannot be written \(No such file"),
        writing("x"),
        replacing(tmp_path / "absent" / "a.txt"),
    ):
        pass


def test_a_file_that_cannot_be_replaced_is_told_by_its_own_name(tmp_path: Path) -> None:
    (tmp_path / "a.txt").mkdir()
    with (
        pytest.raises(OutputError, match=r"[/\\]a\.txt: cannot be written \(Is a directory\)"),
        writing("x"),
        replacing(tmp_path / "a.txt") as part,
    ):
        part.write_text("new")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("name", ["n" * 251 + ".jpg", "\u8def" * 80 + ".openlabel.json", "a.txt"])
def test_a_temporary_name_is_no_longer_than_the_system_takes(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    with replacing(path) as part:
        part.write_text("new")
    part_of(path).write_text("newer")
    assert part_of(path) != part_of(path.with_name(f"m{name[1:]}"))
    part_of(path).replace(path)
    assert path.read_text() == "newer"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(sys.platform == "win32", reason="files are not locked there")
def test_a_claim_goes_with_what_has_no_name_yet(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    claim = Claim(path)
    assert part_of(path).exists()
    claim.close()
    assert not list(tmp_path.iterdir())
    claim = Claim(path)
    part_of(path).replace(path)
    part_of(path).write_text("of another process by now")
    claim.close()
    assert part_of(path).exists()
    Claim(tmp_path / "nowhere" / "a.txt").close()


@pytest.mark.skipif(sys.platform == "win32", reason="files are not locked there")
def test_a_claim_holds_within_the_process_and_when_others_close_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    claim = Claim(path)
    part_of(path).write_text("half")  # closes the file
    with pytest.raises(OutputError, match=r"a\.txt: it is being written already; wait for its end"):
        Claim(path)
    script = "import sys, pathlib, trilitenet.errors as e; e.Claim(pathlib.Path(sys.argv[1]))"
    other = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True, check=False)
    assert "it is being written already" in other.stderr
    assert part_of(path).read_text() == "half"
    claim.close()
    Claim(path).close()


def test_who_may_read_a_file_is_as_before_and_as_the_process_makes_files(tmp_path: Path) -> None:
    old = tmp_path / "old"
    old.touch()
    old.chmod(0o640)
    before = os.umask(0o077)
    try:
        for path in (old, tmp_path / "new"):
            write_file(path, "text")
    finally:
        os.umask(before)
    assert [stat.S_IMODE(path.stat().st_mode) for path in (old, tmp_path / "new")] == [0o640, 0o600]


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "file")
    write_file(tmp_path / "link", b"content")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file").read_bytes() == b"content"


def test_names_that_are_taken_get_a_number() -> None:
    free = FreeNames()
    assert [free.give(name) for name in ("a", "a-2", "a", "b", "a", "a-2")] == ["a", "a-2", "a-3", "b", "a-4", "a-2-2"]
    files = FreeNames(files=True)
    assert [files.give(name) for name in ("A", "a", "B", "A-2", "a", "A")] == ["A", "a-2", "B", "A-2-2", "a-3", "A-4"]


def test_a_hundred_thousand_things_of_one_name_are_named_at_once() -> None:
    free = FreeNames()
    names = [free.give("frame") for _ in range(100_000)]  # half an hour, were each name looked for from 2 on
    assert names[-1] == "frame-100000"


def test_text_with_the_name_of_a_file_that_is_no_text_is_written(tmp_path: Path) -> None:
    name = os.fsdecode(b"a\xff")
    write_file(tmp_path / "report.json", json.dumps({"file": name}, ensure_ascii=False))
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8")) == {"file": name}


def test_a_link_to_nowhere_is_followed(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "later")
    write_file(tmp_path / "link", "content")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "later").read_text() == "content"


def test_what_is_told_already_is_not_told_again(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"^a: is full$"), writing(tmp_path / "b"):
        raise OutputError("a: is full")


def test_of_many_names_the_first_are_told() -> None:
    assert [few(list(names)) for names in ("", "abc", "abcde")] == ["", "a, b, c", "a, b, c and 2 more"]
    assert few(list("abcde"), most=5) == "a, b, c, d, e"


def test_dashes_make_no_two_options_alike() -> None:
    assert did_you_mean("--bgr", []) == ""
    assert did_you_mean("--bgr", ["--nms", "--lane", "--mask-scale"]).startswith("; known: ")
    assert did_you_mean("--lanes", ["--nms", "--lane"]) == "; did you mean '--lane'?"
    assert did_you_mean("--io", ["--iou", "--lane"]) == "; did you mean '--iou'?"


@pytest.mark.parametrize(("name", "told"), [("torch", True), ("torch.nn", True), ("torchaudio", False)])
def test_only_pytorch_itself_is_told_to_be_missing(name: str, told: bool) -> None:
    with pytest.raises(MissingExtraError if told else ModuleNotFoundError) as caught, needing_torch():
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    assert isinstance(caught.value, MissingExtraError) == told


def test_the_pytorch_that_is_asked_for_is_the_one_that_is_required() -> None:
    with pytest.raises(MissingExtraError) as caught, needing_torch():
        raise ModuleNotFoundError("No module named 'torch'", name="torch")
    asked = str(caught.value).split("'")[1]
    assert f'"{asked}",' in (Path(__file__).parents[1] / "pyproject.toml").read_text()


def test_an_import_that_is_interrupted_is_not_taken_for_a_missing_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    stopped = "raise ImportError('initialization failed') from KeyboardInterrupt()"  # as by pybind11
    (tmp_path / "stopped_runtime.py").write_text(stopped)
    with pytest.raises(KeyboardInterrupt):
        import_extra("stopped_runtime", "runtime")
    with pytest.raises(MissingExtraError, match=r"pip install 'trilitenet\[runtime\]'"):
        import_extra("no_such_runtime", "runtime")


def test_openvino_is_imported_without_what_reports_its_use(tmp_path: Path) -> None:
    pytest.importorskip("openvino")
    program = "from trilitenet.errors import import_extra; import_extra('openvino', 'openvino'); import sys; "
    program += "assert 'openvino_telemetry' not in sys.modules; import openvino_telemetry"
    environment = {**{name: value for name, value in os.environ.items() if name != "CI"}, "HOME": str(tmp_path)}
    subprocess.run([sys.executable, "-c", program], env=environment, check=True)
    assert not list(tmp_path.iterdir())  # where the reports keep who they are of


@pytest.mark.parametrize("place", ["s3://bucket/results", Path("s3://bucket/results"), Path("https://host/a/b.json")])
def test_nothing_is_written_to_an_address(place: str | Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OutputError, match="is an address; results are written into folders"), writing(place):
        Path(place).mkdir(parents=True)
    assert not list(tmp_path.iterdir())
    Path(Path(place).parts[0]).mkdir()  # a folder that is really called so
    with writing(place):
        Path(place).mkdir(parents=True)
