"""Traced functions as ONNX graphs: rule by rule, run by onnxruntime, against JAX."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from jax import lax

from ncs_jax.errors import InputError
from ncs_jax.export.onnx_lowering import RULES, onnx_model

HALF = np.linspace(-1, 1, 12, dtype=np.float16).reshape(4, 3)
TABLE = np.linspace(-2, 3, 24, dtype=np.float32).reshape(2, 3, 4)
SQUARE = np.linspace(-1, 2, 9, dtype=np.float32).reshape(3, 3)

# What a rule does: a function of x (4, 3) and y (3,), and the operators that its graph is to have, Reshape left out.
FUNCTIONS = {
    "arithmetic": (lambda x, y: -(x * y - x / (2 + y * y)) + jnp.sqrt(1 + y * y), "Add Div Mul Neg Sqrt Sub"),
    "activations": (
        lambda x, y: jax.nn.sigmoid(x) + jnp.tanh(y) + jax.nn.relu(x) + jnp.maximum(x, y) + jnp.exp(jnp.minimum(x, y)),
        "Add Exp Max Min Relu Sigmoid Tanh",
    ),
    "a choice": (lambda x, y: jnp.where(x > y, x, y[0]), "Greater Slice Where"),
    "repeated axes that are never made": (lambda x, y: (x[:, None] + y[:, None][None]) * TABLE[:1, :, :3], "Add Mul"),
    "repeated axes that have to be": (lambda x, y: jnp.broadcast_to(y, (2, 3)).reshape(6), "Expand"),
    "reshapes of reshapes": (lambda x, y: x.reshape(2, 6).reshape(3, 4)[None][:, :, None], ""),
    "axes of length 1 that move": (lambda x, y: jnp.moveaxis(x[None], 0, -1) + 1, "Add"),
    "a turned matrix": (lambda x, y: x.T, "Transpose"),
    "parts": (lambda x, y: x[1:3, ::2], "Slice"),
    "a split": (lambda x, y: jnp.split(x, [1, 2], axis=1)[1], "Slice"),
    "parts together": (lambda x, y: jnp.concatenate([x, y[None], SQUARE[:1]]), "Concat"),
    "a stack": (lambda x, y: jnp.stack([x, x + 1], axis=1), "Add Concat"),
    "rows picked": (lambda x, y: x[np.array([3, 0, 0])], "Gather"),
    "rows that run on": (lambda x, y: x[np.array([1, 2])], "Slice"),
    "columns picked": (lambda x, y: x[:, np.array([2, 0])], "Gather"),
    "single elements": (lambda x, y: x[np.array([3, 1]), np.array([0, 2])], "Gather"),
    "a row replaced": (lambda x, y: x.at[2].set(y), "Where"),
    "a row of zeros": (lambda x, y: x.at[0].set(0), "Where"),
    "a column added to": (lambda x, y: x.at[:, 1].add(-x[:, 0]), "Add Neg Slice Where"),
    "products": (lambda x, y: (x @ SQUARE) @ y, "MatMul"),
    "a constant and a column": (lambda x, y: TABLE[0].T @ y, "MatMul"),
    "a batch of products": (
        lambda x, y: jnp.einsum("bij,bjk->bik", TABLE[:, :, :3], jnp.stack([SQUARE, SQUARE]) * y),
        "MatMul Mul",
    ),
    "products over several axes": (lambda x, y: jnp.einsum("aij,ji->a", TABLE, x), "MatMul Transpose"),
    "a sum": (lambda x, y: jnp.sum(x + y, axis=0), "Add ReduceSum"),
    "a sum of products": (lambda x, y: jnp.sum(x[:, :, None] * x[:, None], axis=0), "MatMul Transpose"),
    "a sum of products, turned": (lambda x, y: jnp.sum(x.T[None] * TABLE[0][:, None], axis=-1), "MatMul Transpose"),
    "a sum of products of what is as long in both": (lambda x, y: jnp.sum(x * (x + 1), axis=0), "Add Mul ReduceSum"),
    "a map of one round": (lambda x, y: lax.map(lambda r: r * y[0], x[None])[0], "Mul Slice"),
    "what depends on nothing": (lambda x, y: x * jnp.exp(jnp.cos(jnp.arange(3.0))) + jnp.eye(4, 3), "Add Mul"),
    "half the bits": (lambda x, y: x @ jnp.asarray(HALF).T.astype(jnp.float32), "Cast MatMul"),
    "functions in functions": (lambda x, y: jax.jit(jax.nn.relu)(x) @ jax.jit(lambda a: a + 1)(y), "Add MatMul Relu"),
}


@pytest.fixture(autouse=True)
def _plain(plain_jax):
    yield


def made(function, **options):
    return onnx_model(lambda x, y: (function(x, y),), {"x": (4, 3), "y": (3,)}, ["out"], **options)


def primitives(jaxpr):
    for eqn in jaxpr.eqns:
        yield eqn.primitive.name
        for inner in jax.extend.core.jaxprs_in_params(eqn.params):
            yield from primitives(inner)


@pytest.mark.parametrize("opset", [13, 15, 21])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_rule_gives_what_jax_gives(name, opset, rng):
    function, operators = FUNCTIONS[name]
    model = made(function, opset=opset)
    kinds = {node.op_type for node in model.graph.node} - {"Identity", "Reshape"}
    assert kinds == set(operators.split())
    x, y = (rng.normal(size=shape).astype(np.float32) for shape in ((4, 3), (3,)))
    (found,) = onnxruntime.InferenceSession(model.SerializeToString()).run(None, {"x": x, "y": y})
    np.testing.assert_allclose(found, jax.jit(function)(x, y), rtol=2e-6, atol=2e-6)


def test_no_rule_is_without_a_case():
    x, y = jnp.ones((4, 3)), jnp.ones(3)
    seen = {name for function, _ in FUNCTIONS.values() for name in primitives(jax.make_jaxpr(function)(x, y).jaxpr)}
    assert set(RULES) <= seen


def test_what_is_asked_for_twice_is_there_once():
    model = made(lambda x, y: (x * y).sum() + (x * y)[0, 0] + 0 * (y + y)[0])
    assert [node.op_type for node in model.graph.node].count("Mul") == 2
    once = made(FUNCTIONS["reshapes of reshapes"][0])
    assert [node.op_type for node in once.graph.node] == ["Reshape", "Identity"]
    unread = made(lambda x, y: (x @ SQUARE, x + 1)[1])
    assert [node.op_type for node in unread.graph.node] == ["Add", "Identity"] and len(unread.graph.initializer) == 1


@pytest.mark.parametrize(
    ("function", "word"),
    [
        (lambda x, y: jnp.sort(x), "sort"),
        (lambda x, y: x[jnp.argmax(y)], "argmax"),
        (lambda x, y: x[(y[0] > 0).astype(int)], "bool to int32"),
        (lambda x, y: lax.dynamic_update_slice(x, x[:2, :2], (0, 0)), "dynamic_update_slice"),
        (lambda x, y: x.at[0, :2].set(y[:2]), "scatter"),
        (lambda x, y: lax.map(lambda r: r * 2, x), "scan"),
        (lambda x, y: x.astype(jnp.bfloat16).astype(jnp.float32), "float32 to bfloat16"),
    ],
)
def test_what_has_no_rule_is_named(function, word):
    with pytest.raises(InputError, match=rf"{word}.*stablehlo|{word}.*float16"):
        made(function)


def test_the_opset_and_the_package(monkeypatch):
    for opset in (12, 22):
        with pytest.raises(InputError, match=rf"^opset: 13 to 21 expected \(found {opset}\)"):
            made(FUNCTIONS["a sum"][0], opset=opset)
    assert made(FUNCTIONS["a sum"][0], opset=13).opset_import[0].version == 13
    assert made(FUNCTIONS["a sum"][0], facts="told").metadata_props[0].value == "told"
    assert onnx.helper.find_min_ir_version_for([onnx.helper.make_opsetid("", 15)]) == made(FUNCTIONS["a sum"][0]).ir_version
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(InputError, match="pip install onnx"):
        made(FUNCTIONS["a sum"][0])
