"""ExecuTorch on exported artefacts: parity, one file that tells all, refusals, and silence."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock
from PIL import Image

import trilitenet
from tests.artefacts import SIZE, Artefacts, check_backend
from tests.deploy.networks import lively_network
from trilitenet.commands.export import export
from trilitenet.config import GRAPH_HASH_KEY, ArtefactInfo
from trilitenet.data.synthetic import SyntheticScenes
from trilitenet.deploy.executorch import _folded, _quantised, build_executorch
from trilitenet.deploy.graph import DeployGraph, Traceable
from trilitenet.deploy.layouts import LAYOUTS
from trilitenet.deploy.quiet import quiet
from trilitenet.errors import BackendError, ConfigError, MissingExtraError, ShapeError, WeightsError
from trilitenet.inference.executorch_backend import ExecuTorchBackend, _unsaid
from trilitenet.models.trilitenet import build_network
from trilitenet.models.weights import load_network, save_network

pytest.importorskip("executorch.exir")  # whose parts cannot be imported before it
pytestmark = pytest.mark.slow  # whichever comes first waits for a program


@pytest.fixture(scope="session")
def program(artefacts: Artefacts) -> Path:
    """Lowering takes long: once for all processes."""
    path = artefacts.folder / "model.pte"
    with FileLock(path.with_suffix(".lock")):
        if not path.exists():
            network = load_network(artefacts.folder / "weights.safetensors").eval()
            info = ArtefactInfo("executorch", size=SIZE, input="float_nchw", masks="logit", trilitenet="0")
            graph = DeployGraph(network, LAYOUTS["planar"], masks="logit")
            path.write_bytes(build_executorch(graph, network.card, info))
    return path


def test_equals_the_network(artefacts: Artefacts, program: Path) -> None:
    backend = ExecuTorchBackend(program)
    assert backend.name == "executorch cpu fp32"
    check_backend(backend, artefacts)


def test_load_finds_it_and_another_process_may_have_it(program: Path) -> None:
    predictor = trilitenet.load(program, threads=1)
    assert predictor.backend.name == "executorch cpu fp32"
    copy = pickle.loads(pickle.dumps(predictor))  # noqa: S301 - its own
    frame = np.random.default_rng(1).integers(0, 256, (90, 160, 3), np.uint8)
    np.testing.assert_array_equal(copy(frame).lane, predictor(frame).lane)
    with pytest.raises(ConfigError, match="runs on executorch, not on openvino"):
        trilitenet.load(program, backend="openvino")


def test_it_stays_the_same_where_the_process_changes_its_folder(
    program: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(program.parent)
    backend = ExecuTorchBackend(program.name)
    monkeypatch.chdir(tmp_path)
    assert pickle.loads(pickle.dumps(backend)).canvas == SIZE  # noqa: S301 - its own


def test_a_fork_is_told_to_load_it_itself(program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    backend = ExecuTorchBackend(program)
    process = os.getpid()
    monkeypatch.setattr(os, "getpid", lambda: process + 1)
    with pytest.raises(BackendError, match="before this process was forked"):
        backend.run(np.zeros((1, *SIZE, 3), np.uint8))


def test_refusals(program: Path, tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="128x64"):
        ExecuTorchBackend(program).run(np.zeros((1, 96, 128, 3), np.uint8))
    with pytest.raises(BackendError, match="runs on the CPU"):
        ExecuTorchBackend(program, "cuda")
    with pytest.raises(WeightsError, match="no such file"):
        ExecuTorchBackend(tmp_path / "no.pte")


@pytest.mark.parametrize("keep", [0, 10, 1000, 0.5, -100])
def test_a_file_that_is_cut_short_is_one_line(program: Path, tmp_path: Path, keep: float) -> None:
    content = program.read_bytes()
    broken = tmp_path / "broken.pte"
    broken.write_bytes(content[: int(keep * len(content)) if 0 < keep < 1 else int(keep)])
    with pytest.raises(WeightsError, match=r"broken\.pte: not a usable ExecuTorch program") as caught:
        ExecuTorchBackend(broken)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("start", "end"), [(0.3, 0.31), (0.3, 0.5), (0.8, 1.0)])
def test_a_program_with_a_hole_is_one_line(program: Path, tmp_path: Path, start: float, end: float) -> None:
    content = bytearray(program.read_bytes())
    hole = slice(int(start * len(content)), int(end * len(content)))
    content[hole] = bytes(len(content[hole]))
    (tmp_path / "broken.pte").write_bytes(content)
    with pytest.raises(WeightsError, match=r"broken\.pte: not a usable ExecuTorch program \(damaged"):
        ExecuTorchBackend(tmp_path / "broken.pte")


def test_a_program_without_a_hash_is_an_older_one(artefacts: Artefacts, program: Path, tmp_path: Path) -> None:
    key = GRAPH_HASH_KEY.encode()
    content, _, _ = program.read_bytes().rpartition(b"\n" + key)
    (tmp_path / "cut.pte").write_bytes(content)
    with pytest.raises(WeightsError, match=r"cut\.pte: not a usable ExecuTorch program"):
        ExecuTorchBackend(tmp_path / "cut.pte")
    (tmp_path / "older.pte").write_bytes(content.replace(key, b"x" * len(key)))  # the method that says there is one
    check_backend(ExecuTorchBackend(tmp_path / "older.pte"), artefacts)


def test_a_damaged_card_is_one_line(program: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.pte"
    damaged.write_bytes(program.read_bytes().replace(b'"licence": "MIT"', b'"licence": "\xff\xff\xff"', 1))
    with pytest.raises(WeightsError, match="not a usable ExecuTorch program"):
        ExecuTorchBackend(damaged)


def test_it_loads_in_silence(program: Path, tmp_path: Path) -> None:
    shutil.copy(program, tmp_path / "a.pte")
    code = "import sys, trilitenet; trilitenet.load(sys.argv[1]); print('said', file=sys.stderr)"
    done = subprocess.run(
        [sys.executable, "-c", code, "a.pte"], cwd=tmp_path, capture_output=True, text=True, check=True, timeout=240
    )
    assert (done.stdout, done.stderr) == ("", "said\n")


def test_it_runs_where_the_standard_streams_are_closed(program: Path, tmp_path: Path) -> None:
    code = (
        "import sys, numpy, trilitenet\n"
        "found = trilitenet.load(sys.argv[1])(numpy.zeros((64, 128, 3), numpy.uint8))\n"
        "open('done', 'w').write(str(found.lane.shape))\n"
    )
    words = ["sh", "-c", 'exec "$0" -c "$1" "$2" <&- >&- 2>&-', sys.executable, code, str(program)]
    subprocess.run(words, cwd=tmp_path, check=True, timeout=240)
    assert (tmp_path / "done").read_text() == "(64, 128)"


def test_standard_error_is_there_after_programs_that_threads_load_at_once() -> None:
    before = os.fstat(2)
    entered, leave = threading.Event(), threading.Event()

    def load() -> None:
        with _unsaid():
            entered.set()
            leave.wait()

    other = threading.Thread(target=load)
    with _unsaid():
        other.start()
        entered.wait(0.2)
    leave.set()
    other.join()
    assert os.path.samestat(before, os.fstat(2))


def test_the_extra_is_named(program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "executorch.extension.pybindings._portable_lib", None)
    with pytest.raises(MissingExtraError, match=r"trilitenet\[executorch\]"):
        ExecuTorchBackend(program)


def test_int8_leaves_whole_parts_and_depthwise_convolutions_in_floating_point() -> None:
    network = lively_network()
    info = ArtefactInfo("executorch", "int8", SIZE, input="float_nchw", masks="logit", trilitenet="0")
    traceable = Traceable(DeployGraph(network, LAYOUTS["planar"], masks="logit"), network.card, info)
    image = np.random.default_rng(0).uniform(0, 255, (1, 3, *SIZE)).astype(np.float32)
    with torch.no_grad(), quiet():
        program = torch.export.export(traceable, (traceable.image,))
        made = _quantised(program, [image], ("detection",))
        lowered = _folded(torch.export.export(made, (traceable.image,)).run_decompositions({}))
    weights = [node for node in lowered.graph.nodes if "dequantize_per_channel" in str(node.target)]
    assert len(weights) > 20
    convolutions = [node for node in made.graph.nodes if str(node.target) == "aten.conv2d.default"]
    depthwise = [node for node in convolutions if len(node.args) > 6 and node.args[6] > 1]
    assert len(depthwise) > 10
    assert not any("dequantize" in str(node.args[1].target) for node in depthwise)
    found: dict[bool, set[str]] = {True: set(), False: set()}
    for node in made.graph.nodes:
        modules = ".".join(path for path, _ in node.meta.get("nn_module_stack", {}).values())
        if any("quantize_per_tensor" in str(user.target) for user in node.users):
            found["detection" in modules.split(".")].add(str(node.target))
    assert {"aten.conv2d.default", "aten.cat.default"} <= found[False]
    assert found[True] == set()  # its concatenations neither: boxes would take the scale of scores


def test_export_of_one_task_in_int8(tmp_path: Path) -> None:
    network = build_network("tiny", tasks=("lane",))
    whole = load_network("tiny").state_dict()
    network.load_state_dict({name: whole[name] for name in network.state_dict()})
    save_network(network.eval(), tmp_path / "weights.safetensors", network.card)
    scenes = SyntheticScenes(seed=0, size=(96, 160))
    (tmp_path / "frames").mkdir()
    for index in range(2):
        Image.fromarray(scenes[index].image).save(tmp_path / "frames" / f"{index}.png")
    path = tmp_path / "made" / "a.pte"
    done = export(
        tmp_path / "weights.safetensors",
        format="executorch",
        precision="int8",
        calibration=tmp_path / "frames",
        bgr=True,
        size="96x160",
        output=path,
    )
    assert done.parity is not None
    assert done.parity.failures == []
    assert done.notes == ("in floating point: difference, detection, c5",)
    assert [file.name for file in path.parent.iterdir()] == ["a.pte"]
    with trilitenet.load(path) as predictor:
        assert predictor.backend.name == "executorch cpu int8"
        assert predictor.backend.card.tasks == ("lane",)
        perception = predictor(np.zeros((90, 160, 3), np.uint8))
        assert perception.lane is not None
        assert perception.drivable is None
