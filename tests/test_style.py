"""The rules of the source tree: what may import what, how long a module is, what every export says of itself."""

from __future__ import annotations

import ast
import importlib
import json
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from types import GenericAlias

import pytest

import ncs_jax
from tools.rooms import FLOORS, graph, imports, modules, room

ROOT = Path(__file__).parents[1]
MODULES = modules()
EDGES = graph()
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
    "DracoPy",
    "av",
}
NUMERIC = {"geometry", "energies", "scene", "network", "simulation", "metrics", "training"}  # compute, and read nothing
DRAWS = {"view"}

LONG_MODULES: dict[str, str] = {}  # over 450 lines, and why
LONG_FUNCTIONS: dict[str, str] = {}  # over 60 lines, and why
MANY_PARAMETERS: dict[str, str] = {  # over 7, and why
    "runs.train.train": "what users call: a scene and a folder, and options by keyword",
    "io.animation.animation.write_animation": "what users call: a moving mesh, and by keyword what some formats hold",
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


def test_the_rules_see_imports(tmp_path):
    """Of the functions above: a rule that finds nothing would pass everything."""
    source = "import h5py.x\nfrom ncs_jax import io, train\nfrom ncs_jax.geometry.mesh import Mesh\ndef f():\n    import PIL\n"
    loaded = imported(at_load(ast.parse(source)))
    assert loaded == {"h5py.x", "ncs_jax.io", "ncs_jax.train", "ncs_jax.geometry.mesh.Mesh"}
    assert "PIL" in imported(ast.walk(ast.parse(source)))
    (tmp_path / "a.py").write_text(source + "    from ncs_jax.runs.train import train\n")
    assert imports(tmp_path / "a.py", MODULES) == {"io", "", "geometry.mesh", "runs.train"}
    assert "prepare.build" in EDGES["runs.run"] and "export.write" in EDGES["runs.run"]


def test_every_module_is_in_a_room():
    rooms = [name for floor in FLOORS for name in floor]
    assert {room(m) for m in MODULES} - {""} == set(rooms) and len(rooms) == len(set(rooms))


@pytest.mark.parametrize("name", [m for m in MODULES if m])
def test_imports_run_downward_only(name):
    """Those inside functions and those for types too. Rooms on one floor do not know each other."""
    floor = {r: i for i, rooms in enumerate(FLOORS) for r in rooms}
    assert "" not in EDGES[name], "the package's own face is for its users"
    above = {other for other in EDGES[name] if room(other) != room(name) and floor[room(other)] <= floor[room(name)]}
    assert not above


def test_nothing_goes_in_circles():
    """Of any length, lazy imports included. A package's own face sends its readers on: a path in the graph, not a circle."""
    left = {name: {other for other in below if other != name} for name, below in EDGES.items()}
    done: set[str] = set()

    def faces(name):
        return {name.rsplit(".", i)[0] for i in range(1, name.count(".") + 1)} | {""}

    while ready := {n for n, below in left.items() if n not in done and below <= done | faces(n)}:
        done |= ready
    assert not set(left) - done, {n: left[n] - done for n in set(left) - done}


SCENE_FILES = {"scene.spec", "scene.parsing", "scene.motion_names", "scene.motion_lists"}


@pytest.mark.parametrize("name", [m for m in MODULES if room(m) in ("io", "errors") or m in SCENE_FILES])
def test_reading_knows_nothing_of_the_physics(name):
    names = imported(ast.walk(tree(MODULES[name])))
    assert {room(other) for other in EDGES[name] - SCENE_FILES} <= {"io", "errors"}
    assert not {n for n in names if n.split(".")[0] in ("jax", "flax", "optax")}


@pytest.mark.parametrize("name", [m for m in MODULES if room(m) not in DRAWS])
def test_heavy_packages_load_lazily(name):
    heavy = {n.split(".")[0] for n in imported(at_load(tree(MODULES[name])))} & HEAVY
    assert not heavy
    if room(name) in NUMERIC:
        assert not {n.split(".")[0] for n in imported(ast.walk(tree(MODULES[name])))} & HEAVY


@pytest.mark.parametrize("name", MODULES)
def test_a_module_is_one_idea(name):
    lines = len(MODULES[name].read_text(encoding="utf-8").splitlines())
    assert lines <= 450 or name in LONG_MODULES, f"{lines} lines"
    assert not set(name.split(".")) & {"utils", "util", "helpers", "helper", "common", "misc"}


def functions(name):
    """Of a module: where every function is, its lines and how many parameters it takes beside `self`."""
    for node in ast.walk(tree(MODULES[name])):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            a = node.args
            own = [p for p in (*a.posonlyargs, *a.args, *a.kwonlyargs) if p.arg not in ("self", "cls")]
            yield f"{name}.{node.name}", node.end_lineno - node.lineno + 1, len(own)


@pytest.mark.parametrize("name", MODULES)
def test_a_function_is_read_at_one_look(name):
    """At most 60 lines and 7 parameters, but for those that say why."""
    found = list(functions(name))
    assert not [f"{f}: {n} lines" for f, n, _ in found if n > 60 and f not in LONG_FUNCTIONS]
    assert not [f"{f}: {k} parameters" for f, _, k in found if k > 7 and f not in MANY_PARAMETERS]


def test_every_exception_is_needed():
    every = {f: (n, k) for name in MODULES for f, n, k in functions(name)}
    assert all(every[f][0] > 60 and why for f, why in LONG_FUNCTIONS.items())
    assert all(every[f][1] > 7 and why for f, why in MANY_PARAMETERS.items())


def test_no_class_name_occurs_twice():
    names = [n.name for path in MODULES.values() for n in tree(path).body if isinstance(n, ast.ClassDef)]
    assert sorted(names) == sorted(set(names))


@pytest.mark.parametrize("name", [m for m, p in MODULES.items() if p.read_text(encoding="utf-8").strip()])
def test_every_export_exists_once_and_says_what_it_is(name):
    full = f"ncs_jax.{name}".rstrip(".")
    module = importlib.import_module(full)
    assert module.__doc__
    exports = module.__all__
    assert list(exports) == sorted(set(exports), key=exports.index), "named twice"
    source = tree(MODULES[name])
    for export in exports:
        thing = getattr(module, export)
        if isinstance(thing, GenericAlias) or not callable(thing):
            continue  # a constant and an alias have a comment
        text = thing.__doc__ or ""
        assert text.strip() and not text.startswith(f"{export}("), f"{full}.{export} has no docstring"  # that of a dataclass
        home = [n for n in source.body if isinstance(n, ast.FunctionDef | ast.ClassDef) and n.name == export]
        assert home or MODULES[name].name == "__init__.py", f"{full} exports {export} of another module"


@pytest.mark.parametrize("name", [m for m, p in MODULES.items() if p.name == "__init__.py"])
def test_a_package_face_only_passes_on_what_its_modules_export(name):
    """One import path per symbol: the package's, and that of the module where it is defined."""
    face = tree(MODULES[name])
    exports = importlib.import_module(f"ncs_jax.{name}".rstrip(".")).__all__
    seen = [*face.body, *(n for block in face.body if isinstance(block, ast.If) for n in block.body)]  # by type checkers too
    sources = [n for n in seen if isinstance(n, ast.ImportFrom) and n.module.startswith("ncs_jax")]
    brought = [alias.asname or alias.name for n in sources for alias in n.names]
    assert sorted(brought) == sorted(exports) == sorted(set(exports))
    for node in sources:
        home = importlib.import_module(node.module)
        for alias in node.names:
            assert alias.asname is None and alias.name in home.__all__, alias.name
            assert getattr(getattr(home, alias.name), "__module__", node.module) == node.module, alias.name


def test_the_names_of_the_package_are_those_that_type_checkers_see():
    """Each is imported when it is first read, from the module where they see it."""
    face = tree(MODULES[""])
    blocks = [n for block in face.body if isinstance(block, ast.If) for n in block.body]
    seen = {alias.name: n.module for n in blocks if isinstance(n, ast.ImportFrom) for alias in n.names}
    assert seen == ncs_jax._HOME
    for name, module in seen.items():
        assert getattr(ncs_jax, name) is getattr(importlib.import_module(module), name)
    assert ncs_jax.__version__ == metadata.version("ncs-jax")
    assert set(ncs_jax.__all__) <= set(dir(ncs_jax))
    assert not hasattr(ncs_jax, "anything_else")


IMPORT = """
import json, sys
import jax
import flax.linen, optax  # they load what they load
before, others = dict(jax.config.values), set(sys.modules)
import ncs_jax
assert "ncs_jax.runs" not in sys.modules
for name in ncs_jax.__all__:
    getattr(ncs_jax, name)
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
            assert word != "nan_to_num" or room(name) in DRAWS, f"line {node.lineno}: {word} hides a singularity"
    modules = {n.split(".")[0] for n in imported(ast.walk(tree(path)))}
    assert not modules & {"pickle", "cPickle", "dill", "cloudpickle", "joblib"}
    if room(name) != "cli":  # which are a program of its own
        assert not re.search(r"jax\.config\.update|\bprint\(", path.read_text(encoding="utf-8"))


PRODUCTS = re.compile(r"jnp\.(dot|vdot|inner|einsum|matmul|tensordot)$")
LEARNED = {"outward", "_outward_backward"}  # of layers, as fast as the device has them


@pytest.mark.parametrize("name", [name for name in MODULES if room(name) in NUMERIC])
def test_a_product_of_positions_says_its_precision(name):
    """Left to itself, a GPU keeps 10 bits of each factor."""
    source = tree(MODULES[name])
    learned = [n for n in ast.walk(source) if isinstance(n, ast.FunctionDef) and n.name in LEARNED]
    aside = {id(n) for function in learned for n in ast.walk(function)}
    for node in ast.walk(source):
        if isinstance(node, ast.Call) and PRODUCTS.search(ast.unparse(node.func)) and id(node) not in aside:
            assert "precision" in {k.arg for k in node.keywords}, f"line {node.lineno}: {ast.unparse(node)}"


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
