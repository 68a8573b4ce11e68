"""Hosts in other languages give what the stepper gives, and engines list the operators that a step uses."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax.export.facts import FileFormat
from ncs_jax.export.write import export
from tools.engine_operators import ENGINES, main, unlisted

from .test_export import METHODS, garment, long, streamed

ROOT = Path(__file__).parents[1]
COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
LIBRARIES = sorted((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.*[0-9]*"))
# The real headers where this names them, else as much of them as is used.
HEADERS = os.environ.get("ONNXRUNTIME_INCLUDE") or str(ROOT / "tests" / "onnxruntime_v1")


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


@pytest.fixture(scope="module")
def host(tmp_path_factory):
    """The program, compiled against the library of the Python wheel."""
    if COMPILER is None:
        pytest.skip("no C++ compiler is installed")
    if not LIBRARIES or sys.platform == "win32":
        pytest.skip("the wheel of onnxruntime has no shared library to link to")
    folder = tmp_path_factory.mktemp("host")
    suffix = "1.dylib" if sys.platform == "darwin" else "so.1"
    link = folder / f"libonnxruntime.{suffix}"
    link.symlink_to(LIBRARIES[0])
    source, program = ROOT / "hosts" / "cpp" / "host.cpp", folder / "host"
    assert len(source.read_text().splitlines()) <= 100
    warnings = ["-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror"]
    command = [COMPILER, *warnings, str(source), "-I", HEADERS, str(link), f"-Wl,-rpath,{folder}", "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    return program


def play(program, folder, *words):
    command = [str(program), "step.onnx", "motion.f32", "out.f32", *words]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False, timeout=120)


def frames(motion):
    """As the host reads a motion, from matrices that SciPy makes."""
    rotations = Rotation.from_rotvec(motion.poses.reshape(-1, 3)).as_matrix().reshape(len(motion.poses), -1)
    return np.concatenate([rotations, motion.translation], axis=1).astype(np.float32)


@pytest.mark.parametrize("kind", ["gated", "swing", "pbns"])
def test_a_host_in_cpp_gives_what_the_stepper_gives(host, tmp_path, kind):
    assembly, params, _ = garment(kind)
    motion = long()
    export(assembly, params, tmp_path / "step.onnx")
    frames(motion).tofile(tmp_path / "motion.f32")
    for words, alpha in (((), 1.0), (("1.5",), 1.5)):
        done = play(host, tmp_path, *words)
        assert done.returncode == 0 and done.stdout.startswith("240 frames of 30 vertices, "), done.stderr
        got = np.fromfile(tmp_path / "out.f32", np.float32).reshape(240, 30, 3)
        want = streamed(assembly, assembly.network, params, motion, alpha)
        assert np.ptp(want - want.mean(axis=1, keepdims=True), axis=0).max() > 0.005  # it moves
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-5)


def test_a_host_in_cpp_says_what_is_wrong(host, tmp_path):
    assembly, params, _ = garment("gated")
    export(assembly, params, tmp_path / "step.onnx")
    facts, motion = tmp_path / "step.onnx.json", tmp_path / "motion.f32"
    assert "motion.f32: cannot be read" in play(host, tmp_path).stderr
    whole = frames(long(4))
    whole.tofile(motion)
    assert "half: a number expected for ALPHA" in play(host, tmp_path, "half").stderr
    for wrong in (whole.ravel()[:-3], whole[:0]):  # a frame without its translation, and no frame
        wrong.tofile(motion)
        done = play(host, tmp_path)
        assert done.returncode == 1 and "motion.f32: frames of 84 bytes expected" in done.stderr
    whole.tofile(motion)
    text = facts.read_text()
    facts.write_text(text.replace('"interface": 1', '"interface": 2'))
    assert "step.onnx.json: interface 1 expected" in play(host, tmp_path).stderr
    facts.write_text(text)
    (tmp_path / "step.onnx").write_bytes(b"not a graph")
    assert play(host, tmp_path).stderr.strip() and play(host, tmp_path).returncode == 1
    facts.unlink()
    assert "step.onnx.json: cannot be read" in play(host, tmp_path).stderr
    assert "usage: host MODEL.onnx" in play(host, tmp_path, "1", "2").stderr


@pytest.mark.parametrize("kind", METHODS)
def test_engines_list_the_operators_of_a_step(tmp_path, capsys, kind):
    assembly, params, _ = garment(kind)
    file = tmp_path / "step.onnx"
    for format in (FileFormat(), FileFormat(float16=True)):
        export(assembly, params, file, format)
        assert unlisted(file) == {engine: [] for engine in ENGINES}
        assert main([str(file)]) == 0 and "NOT LISTED" not in capsys.readouterr().out
    inferred = onnx.shape_inference.infer_shapes(onnx.load(file)).graph
    ranks = [len(x.type.tensor_type.shape.dim) for x in (*inferred.value_info, *inferred.input, *inferred.output)]
    assert max(ranks) <= 4, max(ranks)  # Unity takes no more than 8


def test_an_operator_that_an_engine_lacks_is_told(tmp_path, capsys):
    x = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [2, 2])
    y = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Det", ["x"], ["y"])], "one", [x], [y])
    onnx.save(onnx.helper.make_model(graph), tmp_path / "one.onnx")
    assert main([str(tmp_path / "one.onnx")]) == 1
    assert capsys.readouterr().out.splitlines()[1].split() == ["Det", "1", "NOT", "LISTED", "NOT", "LISTED"]
