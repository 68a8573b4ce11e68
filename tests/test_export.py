"""What a host gets: a step with its state in one vector that gives what the stepper gives, in files that need no package."""

import json
import re
import subprocess
import sys
from datetime import date
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from scipy.spatial.transform import Rotation

from ncs_jax import io
from ncs_jax.errors import InputError
from ncs_jax.export.facts import FORMATS, FileFormat
from ncs_jax.export.stablehlo import RELEASED, expiry
from ncs_jax.export.step import flat_step
from ncs_jax.export.write import export
from ncs_jax.network.methods.method import for_inference, initial_parameters
from ncs_jax.network.rollout import stepper
from ncs_jax.runs.run import Run, assemble
from ncs_jax.scene.model import local_rotations
from ncs_jax.scene.spec import load_scene, scene_from

from .ready import ready, shaken
from .scenes import post, swing, write_scene

ROOT = Path(__file__).parents[1]
METHODS = ["gated", "linear", "swing", "pbns", "snug"]

# Those that the runtimes of Unity (Sentis) and Unreal (NNE) list, of what a step needs.
ENGINES = {
    "Add", "Cast", "Concat", "Div", "Exp", "Expand", "Gather", "Greater", "Identity", "MatMul", "Max", "Min", "Mul", "Neg",
    "ReduceSum", "Relu", "Reshape", "Sigmoid", "Slice", "Sqrt", "Sub", "Tanh", "Transpose", "Where",
}  # fmt: skip


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


def garment(kind):
    method, cell = (kind, "gated") if kind in ("swing", "pbns", "snug") else ("ncs", kind)
    return ready(jnp.float32, method, cell)


def long(frames=240):
    """Nods at two rates, a root that walks in a curve and turns, and a stop in the last quarter."""
    t = np.minimum(np.arange(frames), 3 * frames // 4) / 30
    poses, place = np.zeros((frames, 2, 3), np.float32), np.zeros((frames, 3), np.float32)
    poses[:, 1, 0], poses[:, 1, 2], poses[:, 0, 1] = 0.6 * np.sin(5 * t), 0.3 * np.sin(11 * t), 0.8 * t
    place[:, 0], place[:, 2] = 0.5 * np.sin(t), 0.7 * t
    return io.MotionRecord(poses, place, 30.0, ())


def streamed(assembly, network, params, motion, alpha=1.0):
    init, step = stepper(assembly.model, network, params)
    step, state, frames = jax.jit(step), init(), []
    rotations = local_rotations(assembly.model, jnp.asarray(motion.poses))
    for r, t in zip(rotations, jnp.asarray(motion.translation), strict=True):
        state, x = step(state, r, t, alpha)
        frames.append(np.asarray(x))
    return np.stack(frames)


def played(file, motion, alpha=1.0):
    """By onnxruntime, from matrices that SciPy makes."""
    session = onnxruntime.InferenceSession(str(file))
    facts = json.loads(session.get_modelmeta().custom_metadata_map["ncs_jax"])
    numbers = [joint["number"] for joint in facts["joints"]]
    state, frames = np.zeros(facts["inputs"]["state"]["shape"], np.float32), []
    for pose, place in zip(motion.poses[:, numbers], motion.translation, strict=True):
        rotations = Rotation.from_rotvec(pose).as_matrix().astype(np.float32)
        inputs = {"state": state, "rotations": rotations, "translation": place, "alpha": np.array([alpha], np.float32)}
        state, x = session.run(["next_state", "vertices"], inputs)
        frames.append(x)
    return np.stack(frames)


@pytest.mark.parametrize("kind", METHODS)
def test_onnx_gives_what_the_stepper_gives(tmp_path, kind):
    assembly, params, _ = garment(kind)
    motion, file = long(), tmp_path / "out" / "step.onnx"
    made = export(assembly, params, file, motion=motion)
    assert made.check.max_difference < 1e-5 and made.check.frames == 240 and made.check.error is None
    for alpha in (1.0, 1.5):
        want = streamed(assembly, assembly.network, params, motion, alpha)
        assert np.ptp(want - want.mean(axis=1, keepdims=True), axis=0).max() > 0.005  # it moves
        np.testing.assert_allclose(played(file, motion, alpha), want, rtol=0, atol=1e-5)
    model = onnx.load(file)
    onnx.checker.check_model(model, full_check=True)
    assert model.opset_import[0].version == 15 and {node.op_type for node in model.graph.node} <= ENGINES
    assert [x.name for x in model.graph.input] == ["state", "rotations", "translation", "alpha"]
    assert [x.name for x in model.graph.output] == ["next_state", "vertices"]


def test_whole_numbers_are_only_shapes_axes_and_indices(tmp_path):
    assembly, params, _ = garment("swing")
    export(assembly, params, tmp_path / "step.onnx")
    graph = onnx.shape_inference.infer_shapes(onnx.load(tmp_path / "step.onnx")).graph
    whole = {x.name for x in graph.initializer if x.data_type == onnx.TensorProto.INT64}
    assert all(i > 0 for node in graph.node for i, name in enumerate(node.input) if name in whole)
    kinds = {value.type.tensor_type.elem_type for value in graph.value_info}
    assert kinds == {onnx.TensorProto.FLOAT, onnx.TensorProto.BOOL}
    shapes = [value.type.tensor_type.shape for value in (*graph.value_info, *graph.input, *graph.output)]
    assert all(d.HasField("dim_value") and d.dim_value > 0 for shape in shapes for d in shape.dim)


JOINTS = [2 * 9, 2 * 9, 2 * 3, 2 * 3]  # local and world rotations and positions a frame ago, positions two frames ago


@pytest.mark.parametrize(
    ("kind", "parts"), [("gated", [16, *JOINTS, 1]), ("linear", [16, *JOINTS, 1]), ("swing", [90, 90, 3, 3, 1]), ("pbns", [1])]
)
def test_the_state_holds_what_later_frames_need(kind, parts):
    """Each part but the last, which is whether there was a frame, changes the vertices of this frame or of the next."""
    assembly, params, _ = garment(kind)
    network, params = for_inference(assembly.network, params, assembly.model)
    call, arguments = flat_step(assembly.model, network, params)
    assert arguments == {"state": (sum(parts),), "rotations": (2, 3, 3), "translation": (3,), "alpha": (1,)}
    call, motion = jax.jit(call), long(8)
    rotations, places = local_rotations(assembly.model, jnp.asarray(motion.poses)), jnp.asarray(motion.translation)

    def frames(state):
        state, x = call(state, rotations[1], places[1], jnp.ones(1))
        return np.stack([x, call(state, rotations[2], places[2], jnp.ones(1))[1]])

    state, _ = call(jnp.zeros(sum(parts)), rotations[0], places[0], jnp.ones(1))
    assert state[-1] == (kind != "pbns")
    for begin, count in zip(np.cumsum([0, *parts]), parts[:-1], strict=False):
        assert not np.array_equal(frames(state.at[begin : begin + count].add(0.3)), frames(state)), begin


def test_the_first_frame_is_that_of_a_character_at_rest(tmp_path):
    assembly, params, _ = garment("gated")
    export(assembly, params, tmp_path / "step.onnx")
    motion = long()
    there = io.MotionRecord(motion.poses[100:102], motion.translation[100:102], 30.0, ())
    still, moved = played(tmp_path / "step.onnx", there, 0.0), played(tmp_path / "step.onnx", there, 1.0)
    assert np.array_equal(still[0], moved[0]) and not np.array_equal(still[1], moved[1])


def turned_rest(folder, tables):
    """A body whose joints rest turned."""
    turns = Rotation.from_rotvec([[0.2, -0.4, 0.1], [0.7, 0.3, -0.5]]).as_matrix()
    np.savez(folder / "body.npz", **post(), rest_rotations=turns, joint_names=np.array(["hips", "chest"]))


def learned_weights(folder, tables):
    tables["garment"]["learn_weights"] = True


def published_descriptor(folder, tables):
    tables["network"]["descriptor"] = "six"


def one_pose(folder, tables):
    """A character that never moves: nothing dynamic."""
    np.savez(folder / "swing.npz", **(still := swing()) | {"poses": 0 * still["poses"], "trans": 0 * still["trans"]})


@pytest.mark.parametrize("change", [turned_rest, learned_weights, published_descriptor, one_pose])
def test_other_scenes(tmp_path, change):
    tables = load_scene(write_scene(tmp_path)).to_dict()
    change(tmp_path, tables)
    assembly = assemble(scene_from(tables))
    params = shaken(initial_parameters(assembly.network, jax.random.PRNGKey(0), assembly.model))
    motion = long(30)
    made = export(assembly, params, tmp_path / "step.onnx", motion=motion)
    assert made.check.max_difference < 1e-5
    want = streamed(assembly, assembly.network, params, motion)
    np.testing.assert_allclose(played(tmp_path / "step.onnx", motion), want, rtol=0, atol=1e-5)
    assert [joint["name"] for joint in made.facts["joints"]] == (["hips", "chest"] if change is turned_rest else ["0", "1"])


def test_a_garment_without_a_body(tmp_path):
    tables = load_scene(write_scene(tmp_path)).to_dict()
    tables["body"]["file"], tables["garment"]["pins"] = "none", "pins"
    np.savez(tmp_path / "swing.npz", **swing(joints=1))
    assembly = assemble(scene_from(tables))
    params = shaken(initial_parameters(assembly.network, jax.random.PRNGKey(0), assembly.model))
    motion = long(30)
    alone = io.MotionRecord(motion.poses[:, :1], motion.translation, 30.0, ())
    made = export(assembly, params, tmp_path / "step.onnx", motion=alone)
    assert made.check.max_difference < 1e-5 and made.facts["inputs"]["rotations"]["shape"] == [1, 3, 3]


def test_a_descriptor_without_rules_is_refused(tmp_path):
    tables = load_scene(write_scene(tmp_path)).to_dict()
    tables["network"]["descriptor"] = "quaternion"
    assembly = assemble(scene_from(tables))
    params = initial_parameters(assembly.network, jax.random.PRNGKey(0), assembly.model)
    with pytest.raises(InputError, match=r"argmax.*network.descriptor = heading_free"):
        export(assembly, params, tmp_path / "step.onnx")
    assert not (tmp_path / "step.onnx").exists()
    assert export(assembly, params, tmp_path / "step", FileFormat("stablehlo"), motion=long(9)).check.max_difference < 1e-5


@pytest.mark.parametrize("options", [{"rank": 3}, {"float16": True}, {"rank": 3, "float16": True}])
def test_smaller_files_tell_their_error(tmp_path, options):
    assembly, params, motion = garment("gated")
    run, name = Run(assembly, params), next(iter(assembly.motions))
    whole = run.export(tmp_path / "whole.onnx")
    made = run.export(tmp_path / "smaller.onnx", **options)
    assert made.file.stat().st_size < whole.file.stat().st_size and whole.check.error is None
    assert made.check.max_difference < 1e-5 < 1e-3 * made.check.error[1]
    far = 1000 * np.linalg.norm(played(made.file, motion) - run.animate(name), axis=-1)
    np.testing.assert_allclose(made.check.error, (far.mean(), far.max()), rtol=0.02)
    kinds = {x.data_type for x in onnx.load(made.file).graph.initializer if len(x.dims) == 2}
    assert (onnx.TensorProto.FLOAT16 in kinds) == ("float16" in options)
    assert made.facts["weights"] == ("float16, computed in float32" if "float16" in options else "float32")


def test_what_cannot_be_written(tmp_path):
    assembly, params, _ = garment("pbns")
    run = Run(assembly, params)
    for options, words in (
        ({"format": "tflite"}, "^format: one of onnx, stablehlo expected .found 'tflite'."),
        ({"rank": 1000}, "^rank: rank is 1000; from 24 frames"),
        ({"opset": 9}, "^opset: 13 to 21 expected"),
        ({"motion": "nowhere.npz"}, "nowhere.npz"),
    ):
        with pytest.raises(InputError, match=words):
            run.export(tmp_path / "step.onnx", **options)
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="cannot be written"):
        run.export(tmp_path / "file" / "step.onnx")
    short = run.compressed(next(iter(assembly.motions)), bfloat16=True)
    with pytest.raises(InputError, match=r"float32 to bfloat16.*float16=True"):
        short.export(tmp_path / "step.onnx")


def test_without_a_runtime_nothing_is_checked(tmp_path, monkeypatch):
    assembly, params, _ = garment("pbns")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    made = Run(assembly, params).export(tmp_path / "step.onnx")
    assert made.check is None and "not checked" in str(made) and made.file.exists()
    monkeypatch.setattr("ncs_jax.export.stablehlo.find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip install flatbuffers"):
        Run(assembly, params).export(tmp_path / "step", format="stablehlo")


ALONE = """
import sys
sys.modules["ncs_jax"] = None
import jax, numpy as np
exported = jax.export.deserialize(bytearray(open(sys.argv[1], "rb").read()))
step, motion = jax.jit(exported.call), np.load(sys.argv[2])
state, frames = np.zeros(exported.in_avals[0].shape, np.float32), []
for rotations, place in zip(motion["rotations"], motion["places"]):
    state, x = step(state, rotations, place, np.ones(1, np.float32))
    frames.append(np.asarray(x))
np.save(sys.argv[3], frames)
print(sorted(exported.platforms), exported.mlir_module().count("stablehlo.custom_call"))
"""


@pytest.mark.parametrize("float16", [False, True])
def test_stablehlo_runs_with_jax_alone(tmp_path, float16):
    assembly, params, _ = garment("gated")
    motion, run = long(40), Run(assembly, params)
    made = run.export(tmp_path / "step", format="stablehlo", float16=float16)
    assert made.check.max_difference < 1e-5 and (made.check.error is not None) == float16
    rotations = np.asarray(local_rotations(assembly.model, jnp.asarray(motion.poses)))
    np.savez(tmp_path / "given.npz", rotations=rotations, places=motion.translation)
    command = [sys.executable, "-c", ALONE, *(str(tmp_path / name) for name in ("step", "given.npz", "out.npy"))]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path, timeout=120)
    assert done.stdout.strip() == "['cpu', 'cuda', 'rocm', 'tpu'] 0"
    want = streamed(assembly, assembly.network, params, motion)
    np.testing.assert_allclose(np.load(tmp_path / "out.npy"), want, rtol=0, atol=2e-3 if float16 else 1e-5)


def test_the_facts_say_what_a_host_has_to_know(tmp_path):
    assembly, params, _ = garment("gated")
    for format in FORMATS:
        made = export(assembly, params, tmp_path / f"step.{format}", FileFormat(format))
        facts = json.loads((tmp_path / f"step.{format}.json").read_text())
        assert facts == made.facts and facts["format"].startswith(format) and facts["file"] == f"step.{format}"
        assert ("usable_until" in facts) == (format == "stablehlo") == ("usable until" in str(made))
    assert (facts["fps"], facts["vertices"], facts["interface"], facts["gravity"]) == (30.0, 30, 1, [0, -9.81, 0])
    assert facts["alpha"] == {"from": 0.0, "trained": 1.0} and facts["outputs"]["vertices"]["shape"] == [30, 3]
    assert [(joint["number"], joint["parent"]) for joint in facts["joints"]] == [(0, -1), (1, 0)]
    np.testing.assert_allclose([joint["rest"] for joint in facts["joints"]], post()["joints"], atol=1e-6)
    pose = garment("pbns")
    assert export(pose[0], pose[1], tmp_path / "step.onnx").facts["alpha"] is None


@pytest.mark.parametrize(
    ("version", "until", "counted"),
    [
        ("0.10.1", "2026-11-18", "six months, counted from the release of jax 0.10.1 on 2026-05-18"),
        ("0.13.0.dev20260831+ab1f", "2027-02-28", "the release of jax 0.13.0.dev20260831+ab1f on 2026-08-31"),
        ("0.99.0", "2028-02-29", "counted from today, 2027-08-31, as the release date of jax 0.99.0 is not known here"),
    ],
)
def test_an_artifact_says_until_when_it_loads(version, until, counted):
    facts = expiry(version, date(2027, 8, 31))
    assert facts["usable_until"] == until and counted in facts["usable_until_means"]


def test_an_artifact_counts_from_the_jax_that_writes_it(tmp_path):
    """Every JAX that `constraints/` pins has its release date, so that this never depends on the day."""
    pins = [re.findall(r"^jax==(.+)$", file.read_text(), re.M) for file in (ROOT / "constraints").glob("*.txt")]
    assert pins and {version for found in pins for version in found} <= set(RELEASED)
    assembly, params, _ = garment("pbns")
    made = export(assembly, params, tmp_path / "step", FileFormat("stablehlo"))
    assert made.facts | expiry(jax.__version__, date.today()) == made.facts
    assert f"usable until {made.facts['usable_until']}: a JAX released later may refuse the file" in str(made)


HOST = """
import runpy, sys
sys.modules["ncs_jax"] = sys.modules["jax"] = None
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def host(folder, *arguments):
    command = [sys.executable, "-c", HOST, str(ROOT / "docs" / "host_loop.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=120)


def test_a_host_without_jax_plays_what_the_run_animates(tmp_path):
    assembly, params, _ = garment("gated")
    run = Run(assembly, params)
    run.export(tmp_path / "step.onnx")
    np.savez(tmp_path / "swing.npz", **swing())
    done = host(tmp_path, "step.onnx", "swing.npz", "out.npy", "1.5")
    assert done.stdout == "out.npy: 24 frames of 30 vertices\n", done.stderr
    want = run.animate(next(iter(assembly.motions)), 1.5)
    np.testing.assert_allclose(np.load(tmp_path / "out.npy"), want, rtol=0, atol=1e-5)
    ours = swing()
    joints = [joint["name"] for joint in json.loads((tmp_path / "step.onnx.json").read_text())["joints"]]
    turned = dict(ours, poses=ours["poses"][:, ::-1], joint_names=np.array(joints[::-1]))
    np.savez(tmp_path / "turned.npz", **turned)  # a file may have the joints in another order than the body
    assert host(tmp_path, "step.onnx", "turned.npz", "out.npy", "1.5").returncode == 0
    np.testing.assert_allclose(np.load(tmp_path / "out.npy"), want, rtol=0, atol=1e-5)
    np.savez(tmp_path / "other.npz", **dict(ours, joint_names=np.array(["a", *joints[1:]])))
    assert f"it has no {joints[0]}" in host(tmp_path, "step.onnx", "other.npz", "out.npy").stderr
    np.savez(tmp_path / "slow.npz", **swing(fps=24.0))
    assert "trained at 30.0" in host(tmp_path, "step.onnx", "slow.npz", "out.npy").stderr
    assert "vertices.npy" in host(tmp_path).stderr  # without arguments it says how it is used
