"""The rules of the source tree: what may import what, how long a module is, what every export says of itself."""

from __future__ import annotations

import ast
import importlib
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "ncs_jax"
MODULES = {
    ".".join(p.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__"): p for p in sorted(SOURCE.rglob("*.py"))
}
MODULES["ncs_jax"] = MODULES.pop("__init__")
TESTS = sorted((ROOT / "tests").rglob("test_*.py"))
HEAVY = {
    "trimesh",
    "h5py",
    "matplotlib",
    "PIL",
    "rich",
    "orbax",
    "pxr",
    "tensorboardX",
    "onnx",
    "onnxruntime",
    "flatbuffers",
    "viser",
}
PICTURES = {"pictures", "rasteriser", "preview", "viewer", "live"}  # these exist to draw
OUTSIDE = {
    "io",
    "scene",
    "assembly",
    "checkpoint",
    "export",
    "runs",
    "simulation",
    "reports",
    "cli",
} | PICTURES  # read files, print or draw

# What each part of the numeric core may import of the package: itself, and what stands below it.
BELOW: dict[str, set[str]] = {
    "numerics": set(),
    "modes": set(),
    "networks": set(),
    "kinematics": set(),
    "joint_names": set(),
    "rotations": {"numerics"},
    "vectors": {"numerics"},
    "mesh": {"numerics", "vectors"},
    "energies": {"numerics", "mesh", "vectors"},
    "descriptors": {"numerics", "rotations"},
    "objective": {"energies", "kinematics", "mesh", "vectors"},
    "solver": {"energies", "mesh", "model", "numerics", "objective"},
    "simulator": {"energies", "kinematics", "model", "motion", "objective", "solver"},
    "vibration": {"kinematics", "model", "modes", "motion", "solver"},
    "model": {"energies", "kinematics", "objective", "rotations"},
    "motion": {"descriptors", "kinematics", "model"},
    "methods": {"descriptors", "kinematics", "model", "motion", "networks", "objective"},
    "rollout": {"descriptors", "kinematics", "methods", "model", "motion"},
    "compression": {"methods", "model", "motion", "networks", "rollout"},
    "training": {"kinematics", "methods", "model", "motion", "numerics", "objective", "scene"},  # of `scene` the numbers alone
}


def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def at_load(node: ast.AST):
    """The statements that run when a module is imported: all but the bodies of functions and of `if TYPE_CHECKING`."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        yield child
        yield from at_load(child)


def imported(nodes) -> set[str]:
    """Full names of the modules and names that import statements bring in, relative ones refused."""
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"relative import in line {node.lineno}"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def own(names: set[str]) -> set[str]:
    """First parts below the package: `ncs_jax.energies.stvk.stvk` is `energies`; the package itself is `ncs_jax`."""
    inside = [n.split(".") for n in names if n.split(".")[0] == "ncs_jax"]
    return {n[1] if len(n) > 1 and (n[1] in MODULES or (SOURCE / n[1]).is_dir()) else "ncs_jax" for n in inside}


def test_the_rules_see_imports():
    """Of the functions above: a rule that finds nothing would pass everything."""
    source = "import h5py.x\nfrom ncs_jax import io, train\nfrom ncs_jax.mesh import Mesh\ndef f():\n    import PIL\n"
    loaded = imported(at_load(ast.parse(source)))
    assert loaded == {"h5py.x", "ncs_jax.io", "ncs_jax.train", "ncs_jax.mesh.Mesh"}
    assert own(loaded) == {"io", "mesh", "ncs_jax"}
    assert "PIL" in imported(ast.walk(ast.parse(source)))
    assert set(BELOW) <= {name.split(".")[0] for name in MODULES}


@pytest.mark.parametrize("name", [m for m in MODULES if m.split(".")[0] in BELOW])
def test_the_core_imports_downward_only(name):
    """Lazy imports too: a law that reads a file is no law."""
    part = name.split(".")[0]
    assert own(imported(ast.walk(tree(MODULES[name])))) <= BELOW[part] | {part}
    assert not BELOW[part] & OUTSIDE - {"scene"}


def test_training_takes_the_numbers_of_a_scene_and_no_reader():
    names = {n for n in imported(ast.walk(tree(MODULES["training"]))) if n.startswith("ncs_jax.scene")}
    assert names <= {"ncs_jax.scene.TrainingSpec"}


def test_reading_knows_nothing_of_the_physics():
    for name in [m for m in MODULES if m.split(".")[0] in ("io", "errors", "scene")]:
        names = imported(ast.walk(tree(MODULES[name])))
        assert own(names) <= {"io", "errors", "scene"}, name
        assert not {n for n in names if n.split(".")[0] in ("jax", "flax", "optax")}, name


def test_nothing_in_the_package_imports_the_command_line_and_nothing_goes_in_circles():
    # A package's own face sends its readers on to its modules: that is a path in the graph, not a circle.
    above = {name: imported(at_load(tree(path))) for name, path in MODULES.items()}
    short = {
        name: {m for m in MODULES if m != name and any(n == f"ncs_jax.{m}" or n.startswith(f"ncs_jax.{m}.") for n in names)}
        for name, names in above.items()
    }
    assert not [name for name, names in short.items() if "cli" in names]
    done: set[str] = set()
    while ready := {n for n, below in short.items() if n not in done and below <= done | {n.split(".")[0]}}:
        done |= ready
    assert not set(short) - done, {n: short[n] - done for n in set(short) - done}


@pytest.mark.parametrize("name", [m for m in MODULES if m.split(".")[0] not in PICTURES])
def test_heavy_packages_load_lazily(name):
    heavy = {n.split(".")[0] for n in imported(at_load(tree(MODULES[name])))} & HEAVY
    assert not heavy
    if name.split(".")[0] in BELOW:
        assert not {n.split(".")[0] for n in imported(ast.walk(tree(MODULES[name])))} & HEAVY


@pytest.mark.parametrize("name", MODULES)
def test_a_module_is_one_idea(name):
    lines = len(MODULES[name].read_text(encoding="utf-8").splitlines())
    assert lines < 500, f"{lines} lines"
    assert not set(name.split(".")) & {"utils", "util", "helpers", "helper", "common", "misc"}


@pytest.mark.parametrize("name", [m for m, p in MODULES.items() if p.read_text(encoding="utf-8").strip()])
def test_every_export_exists_once_and_says_what_it_is(name):
    full = name if name == "ncs_jax" else f"ncs_jax.{name}"
    module = importlib.import_module(full)
    assert module.__doc__
    exports = module.__all__
    assert list(exports) == sorted(set(exports), key=exports.index), "named twice"
    source = tree(MODULES[name])
    for export in exports:
        thing = getattr(module, export)
        if not (isinstance(thing, type) or callable(thing)):
            continue  # a constant has a comment
        text = thing.__doc__ or ""
        assert text.strip() and not text.startswith(f"{export}("), f"{full}.{export} has no docstring"  # that of a dataclass
        home = [n for n in source.body if isinstance(n, ast.FunctionDef | ast.ClassDef) and n.name == export]
        assert home or name in ("ncs_jax", "io"), f"{full} exports {export} of another module"


@pytest.mark.parametrize("name", ["ncs_jax", "io"])
def test_a_package_face_only_passes_on_what_its_modules_export(name):
    """One import path per symbol: the package's, and that of the module where it is defined."""
    face = tree(MODULES[name])
    exports = importlib.import_module(name if name == "ncs_jax" else f"ncs_jax.{name}").__all__
    sources = [n for n in face.body if isinstance(n, ast.ImportFrom)]
    brought = [alias.asname or alias.name for n in sources for alias in n.names]
    assert sorted(brought) == sorted(exports) == sorted(set(exports))
    for node in sources:
        home = importlib.import_module(node.module)
        for alias in node.names:
            assert alias.asname is None and alias.name in home.__all__, alias.name
            assert getattr(getattr(home, alias.name), "__module__", node.module) == node.module, alias.name


IMPORT = """
import json, sys
import jax
import flax.linen, optax  # they load what they load
before, others = dict(jax.config.values), set(sys.modules)
import ncs_jax
print(json.dumps([sorted({m.split(".")[0] for m in set(sys.modules) - others}), before == dict(jax.config.values)]))
"""


def test_importing_the_package_is_quiet_light_and_changes_nothing(tmp_path):
    command = [sys.executable, "-W", "error::UserWarning", "-c", IMPORT]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True, timeout=120)
    assert done.stderr == ""
    assert len(done.stdout.splitlines()) == 1  # the one line that this test prints
    loaded, same = json.loads(done.stdout)
    assert same and "ncs_jax" in loaded
    assert not set(loaded) & HEAVY
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("name", MODULES)
def test_what_is_forbidden(name):
    """No swallowed exception, no pickle, no arc cosine, no hidden NaN, no global setting."""
    path = MODULES[name]
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.ExceptHandler) and (
            node.type is None or ast.unparse(node.type) in ("Exception", "BaseException")
        ):
            nothing = [isinstance(s, ast.Pass | ast.Continue) or ast.unparse(s) == "..." for s in node.body]
            assert not all(nothing), f"line {node.lineno}: a swallowed exception"
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("suppress"):
            assert not {ast.unparse(a) for a in node.args} & {"Exception", "BaseException"}, f"line {node.lineno}"
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            assert ast.unparse(node.value) == "False", "arrays are read without pickle"
        if isinstance(node, ast.Attribute | ast.Name):
            word = node.attr if isinstance(node, ast.Attribute) else node.id
            assert word not in ("arccos", "acos"), f"line {node.lineno}: {word}"
            assert word != "nan_to_num" or name in PICTURES, f"line {node.lineno}: {word} hides a singularity"
    modules = {n.split(".")[0] for n in imported(ast.walk(tree(path)))}
    assert not modules & {"pickle", "cPickle", "dill", "cloudpickle", "joblib"}
    if name not in ("cli", "reports"):  # which are a program of its own
        assert not re.search(r"jax\.config\.update|\bprint\(", path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", TESTS, ids=lambda p: p.stem)
def test_a_test_file_can_fail(path):
    """It has tests, and they assert, compare by numpy.testing or expect an exception; no assertion is a constant."""
    source = tree(path)
    tests = [n for n in ast.walk(source) if isinstance(n, ast.FunctionDef) and n.name.startswith("test_")]
    assertions = [n for n in ast.walk(source) if isinstance(n, ast.Assert)]
    calls = {ast.unparse(n.func) for n in ast.walk(source) if isinstance(n, ast.Call)}
    checks = [c for c in calls if re.search(r"\.assert_\w+$|^pytest\.(raises|warns)$", c)]
    empty = [
        n.name
        for n in tests
        if all(isinstance(s, ast.Pass) or isinstance(getattr(s, "value", 0), ast.Constant) for s in n.body)
    ]
    assert tests and (assertions or checks) and not empty
    assert not [n.lineno for n in assertions if isinstance(n.test, ast.Constant | ast.Tuple)]
    names = [n.name for n in source.body if isinstance(n, ast.FunctionDef)]
    assert len(names) == len(set(names)), "a test of the same name replaces an earlier one"
