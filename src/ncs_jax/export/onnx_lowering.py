"""A traced function as an ONNX graph: one rule a primitive, in operators that game engines run.

What depends on no input is computed here: sines of constants, indices, whole branches. What is left has static shapes, no
control flow, and no integers but shapes, axes and constant indices. An axis along which a value only repeats stays of length 1
as long as the operators accept that: most of what a trace broadcasts is never made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from ncs_jax.errors import InputError

__all__ = ["OPSETS", "onnx_model"]

OPSETS = (13, 21)  # whose operators all mean the same here
MEND = "export it as stablehlo"


class Tensor(NamedTuple):
    """Name a value of the graph; an axis may be of length 1 where the trace has it repeated."""

    name: str
    shape: tuple[int, ...]


Value = Tensor | np.ndarray  # an array does not depend on the inputs


def onnx_model(
    function: Callable, arguments: dict[str, tuple[int, ...]], results: Sequence[str], *, opset: int = 15, facts: str = ""
) -> Any:
    """Return the `onnx.ModelProto` of a function of float32 arrays.

    Args:
        function: of as many arrays as there are arguments; it returns as many as there are results.
        arguments: their names and shapes. opset: in `OPSETS`. facts: a text kept in the model's metadata, under `ncs_jax`.

    float16 constants are stored so, and widened by a Cast before they are used.

    Raises:
        InputError: onnx is not installed, the opset is another, or the function does what no rule covers.
    """
    onnx = _onnx()
    if not OPSETS[0] <= opset <= OPSETS[1]:
        raise InputError(f"{OPSETS[0]} to {OPSETS[1]} expected", field="--opset", value=opset, mend="15 is what engines read")
    closed = jax.make_jaxpr(function)(*(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in arguments.values()))
    graph = _Graph(onnx)
    inputs = [Tensor(name, shape) for name, shape in arguments.items()]
    outputs = _read(graph, closed.jaxpr, [np.asarray(c) for c in closed.consts], inputs)
    nodes, weights = graph.finished(
        [graph.whole(x, v.aval.shape) for x, v in zip(outputs, closed.jaxpr.outvars, strict=True)], results
    )

    def described(name, shape):
        return onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape)

    shapes = [v.aval.shape for v in closed.jaxpr.outvars]
    made = onnx.helper.make_graph(
        nodes, "step", [described(*x) for x in inputs], [described(*x) for x in zip(results, shapes, strict=True)], weights
    )
    sets = [onnx.helper.make_opsetid("", opset)]
    least = onnx.helper.find_min_ir_version_for(sets)
    model = onnx.helper.make_model(made, opset_imports=sets, ir_version=least, producer_name="ncs-jax")
    if facts:
        onnx.helper.set_model_props(model, {"ncs_jax": facts})
    onnx.checker.check_model(model, full_check=True)
    return model


def _onnx():
    try:
        import onnx
    except ImportError:
        raise InputError("the package onnx is needed", field="--format", value="onnx", mend="pip install onnx") from None
    return onnx


class _Graph:
    """Collect nodes in order, each only once; reshapes of reshapes are one; what nothing reads is left out at the end."""

    def __init__(self, onnx):
        self._onnx = onnx
        self._nodes: list[tuple] = []
        self._known: dict[tuple, Tensor] = {}
        self._weights: dict[tuple, tuple[str, np.ndarray]] = {}
        self._source: dict[str, Tensor] = {}  # what a reshaped tensor was before
        self._products: dict[str, tuple[Value, Value]] = {}
        self._narrow: dict[str, np.ndarray] = {}  # constants of which half the bits are stored

    def add(self, operator: str, *inputs: Value, shape: Sequence[int], **attributes) -> Tensor:
        """Add one node, and return its result."""
        names = tuple(self._name(x) for x in inputs)
        key = (operator, names, tuple(sorted((k, str(v)) for k, v in attributes.items())))
        if key not in self._known:
            out = Tensor(f"{operator.lower()}_{len(self._nodes)}", tuple(int(n) for n in shape))
            self._nodes.append((operator, names, out.name, attributes))
            self._known[key] = out
            if operator == "Mul":
                self._products[out.name] = inputs[0], inputs[1]
        return self._known[key]

    def _name(self, x: Value) -> str:
        if isinstance(x, Tensor):
            return x.name
        key = (x.dtype.str, x.shape, x.tobytes())
        return self._weights.setdefault(key, (f"constant_{len(self._weights)}", x))[0]

    def widened(self, x: np.ndarray) -> Tensor:
        """Store a float16 constant as it is, and return it cast to float32."""
        out = self.add("Cast", x, shape=x.shape, to=self._onnx.TensorProto.FLOAT)
        self._narrow[out.name] = x
        return out

    def fixed(self, x: Value) -> bool:
        """Tell whether a value is the same whatever the inputs are."""
        return not isinstance(x, Tensor) or x.name in self._narrow

    def factors(self, x: Tensor) -> tuple[Value, Value] | None:
        """Return the two factors of a product; None for another value."""
        return self._products.get(x.name)

    def reshape(self, x: Value, shape: Sequence[int]) -> Value:
        """Return the same numbers in another shape."""
        shape = tuple(int(n) for n in shape)
        if isinstance(x, Tensor) and x.name in self._narrow:
            return self.widened(self._narrow[x.name].reshape(shape))
        if not isinstance(x, Tensor):
            return x.reshape(shape)
        x = self._source.get(x.name, x) if x.shape != shape else x
        if x.shape == shape:
            return x
        out = self.add("Reshape", x, np.asarray(shape, np.int64), shape=shape)
        self._source[out.name] = x
        return out

    def whole(self, x: Value, shape: Sequence[int]) -> Value:
        """Return the value with every axis as long as the trace has it."""
        shape = tuple(shape)
        if x.shape == shape:
            return x
        if not isinstance(x, Tensor):
            return np.ascontiguousarray(np.broadcast_to(x, shape))
        return self.add("Expand", x, np.asarray(shape, np.int64), shape=shape)

    def transpose(self, x: Value, order: Sequence[int]) -> Value:
        """Return the axes in another order; one that only moves axes of length 1 is a reshape."""
        shape = [x.shape[i] for i in order]
        if isinstance(x, Tensor) and x.name in self._narrow:
            return self.widened(np.ascontiguousarray(self._narrow[x.name].transpose(order)))
        if not isinstance(x, Tensor):
            return np.ascontiguousarray(x.transpose(order))
        moved = [i for i in order if x.shape[i] != 1]
        if moved == sorted(moved):
            return self.reshape(x, shape)
        return self.add("Transpose", x, shape=shape, perm=[int(i) for i in order])

    def slice(self, x: Value, begin: Sequence[int], end: Sequence[int], stride: Sequence[int] | None = None) -> Value:
        """Return a part of every axis."""
        stride = [1] * len(x.shape) if stride is None else stride
        if not isinstance(x, Tensor):
            return x[tuple(slice(*each) for each in zip(begin, end, stride, strict=True))]
        axes = [i for i, n in enumerate(x.shape) if (begin[i], end[i], stride[i]) != (0, n, 1)]
        if not axes:
            return x
        shape = [-(-(e - b) // s) for b, e, s in zip(begin, end, stride, strict=True)]
        parts = [np.asarray([int(each[i]) for i in axes], np.int64) for each in (begin, end, range(len(x.shape)), stride)]
        return self.add("Slice", x, *parts, shape=shape)

    def pick(self, x: Value, places: np.ndarray) -> Value:
        """Return elements of x by their places in memory: gathered in the longest rows that run on, or as one slice."""
        flat, size = places.reshape(-1), math.prod(x.shape)
        if np.any((flat < 0) | (flat >= size)):
            raise InputError("indices inside an array expected", field="--format", value="onnx", mend=MEND)
        most = math.gcd(flat.size, size)
        for width in (most // k for k in range(1, most + 1) if most % k == 0):
            rows = flat.reshape(-1, width)
            if np.all(rows[:, 0] % width == 0) and np.array_equal(rows, rows[:, :1] + np.arange(width)):
                break
        index, table = rows[:, 0] // width, self.reshape(x, (size // width, width))
        if np.array_equal(index, index[0] + np.arange(len(index))):
            found = self.slice(table, (int(index[0]), 0), (int(index[0]) + len(index), width))
        else:
            found = self.add("Gather", table, index.astype(np.int64), shape=rows.shape, axis=0)
        return self.reshape(found, places.shape)

    def finished(self, outputs: Sequence[Value], names: Sequence[str]) -> tuple[list, list]:
        """Return the nodes and constants that the outputs need; the outputs get the given names."""
        ends: list[tuple] = [("Identity", (self._name(x),), name, {}) for x, name in zip(outputs, names, strict=True)]
        wanted, kept = {name for end in ends for name in end[1]}, []
        for node in reversed(self._nodes):
            if node[2] in wanted:
                kept.append(node)
                wanted |= set(node[1])
        helper = self._onnx.helper
        nodes = [helper.make_node(kind, inputs, [out], name=out, **more) for kind, inputs, out, more in [*kept[::-1], *ends]]
        stored = [self._onnx.numpy_helper.from_array(x, name) for name, x in self._weights.values() if name in wanted]
        return nodes, stored


def _read(graph: _Graph, jaxpr: core.Jaxpr, constants: Sequence[Value], inputs: Sequence[Value]) -> list[Value]:
    """Go through a trace: compute what is constant, put the rest into the graph, and return the results."""
    env = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*constants, *inputs), strict=True))

    def value(v):
        return np.asarray(v.val, v.aval.dtype) if isinstance(v, core.Literal) else env[v]

    for eqn in jaxpr.eqns:
        env.update(zip(eqn.outvars, _lower(graph, eqn, [value(v) for v in eqn.invars]), strict=True))
    return [value(v) for v in jaxpr.outvars]


def _lower(graph: _Graph, eqn, inputs: list[Value]) -> Sequence[Value]:
    name = eqn.primitive.name
    if name in CALLS:
        inner = eqn.params[CALLS[name]]
        return _read(graph, inner.jaxpr, [np.asarray(c) for c in inner.consts], inputs)
    if name == "scan" and eqn.params["length"] == 1:  # `lax.map` over one block
        inner, count = eqn.params["jaxpr"], eqn.params["num_consts"] + eqn.params["num_carry"]
        whole = [graph.whole(x, v.aval.shape) for x, v in zip(inputs, eqn.invars, strict=True)]
        rows = [graph.reshape(x, x.shape[1:]) for x in whole[count:]]
        found = _read(graph, inner.jaxpr, [np.asarray(c) for c in inner.consts], [*whole[:count], *rows])
        carried = eqn.params["num_carry"]
        return [x if i < carried else graph.reshape(x, (1, *x.shape)) for i, x in enumerate(found)]
    constants = [x for x in inputs if not isinstance(x, Tensor)]
    narrow = any(x.dtype == np.float16 for x in constants)
    if len(constants) == len(inputs) and not narrow and name not in LAZY:
        return _evaluate(eqn, constants)
    if name not in RULES:
        mend = f"{MEND}, or with network.descriptor = heading_free" if name in ("argmax", "atan2") else MEND
        raise InputError("operations expected that engines run", field="--format onnx", value=name, mend=mend)
    found = RULES[name](graph, eqn, *inputs)
    return found if isinstance(found, list) else [found]


def _evaluate(eqn, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    whole = [np.broadcast_to(x, v.aval.shape) for x, v in zip(inputs, eqn.invars, strict=True)]
    found = eqn.primitive.bind(*map(jnp.asarray, whole), **eqn.params)
    return [np.asarray(x) for x in (found if eqn.primitive.multiple_results else [found])]


def _elementwise(operator: str) -> Callable:
    """Return the rule of an operator that takes its operands as they are, axes of length 1 repeated."""

    def rule(graph, eqn, *inputs):
        shape = np.broadcast_shapes(*(x.shape for x in inputs))
        if operator == "Mul":
            for one, x in (inputs, inputs[::-1]):
                if not isinstance(one, Tensor) and x.shape == shape and np.all(one == 1):
                    return x
        if operator == "Max" and not isinstance(inputs[1], Tensor) and inputs[1].shape == () and inputs[1] == 0:
            return graph.add("Relu", inputs[0], shape=shape)
        return graph.add(operator, *inputs, shape=shape)

    return rule


def _select(graph, eqn, which, *cases):
    if len(cases) != 2 or eqn.invars[0].aval.dtype != bool:
        raise InputError("a choice of two expected", field="--format onnx", value="select_n", mend=MEND)
    no, yes = cases
    return graph.add("Where", which, yes, no, shape=np.broadcast_shapes(which.shape, no.shape, yes.shape))


def _convert(graph, eqn, x):
    new, old = np.dtype(eqn.params["new_dtype"]), eqn.invars[0].aval.dtype
    if new == old:
        return x
    if new != np.float32 or old != np.float16 or isinstance(x, Tensor):
        raise InputError("float32 expected", field="--format onnx", value=f"{old} to {new}", mend="export it with --float16")
    return graph.widened(x)


def _broadcast(graph, eqn, x):
    shape = [1] * len(eqn.params["shape"])
    for axis, n in zip(eqn.params["broadcast_dimensions"], x.shape, strict=True):
        shape[axis] = n
    return graph.reshape(x, shape)


def _reshape(graph, eqn, x):
    return graph.reshape(graph.whole(x, eqn.invars[0].aval.shape), eqn.outvars[0].aval.shape)


def _squeeze(graph, eqn, x):
    return graph.reshape(x, [n for i, n in enumerate(x.shape) if i not in eqn.params["dimensions"]])


def _transpose(graph, eqn, x):
    return graph.transpose(x, eqn.params["permutation"])


def _slice(graph, eqn, x):
    x = graph.whole(x, eqn.invars[0].aval.shape)
    return graph.slice(x, eqn.params["start_indices"], eqn.params["limit_indices"], eqn.params["strides"])


def _split(graph, eqn, x):
    x, axis = graph.whole(x, eqn.invars[0].aval.shape), eqn.params["axis"]
    ends = np.cumsum(eqn.params["sizes"]).tolist()
    begin, end = [0] * len(x.shape), list(x.shape)
    return [
        graph.slice(x, [*begin[:axis], b, *begin[axis + 1 :]], [*end[:axis], e, *end[axis + 1 :]])
        for b, e in zip([0, *ends], ends, strict=False)
    ]


def _concatenate(graph, eqn, *parts):
    whole = [graph.whole(x, v.aval.shape) for x, v in zip(parts, eqn.invars, strict=True)]
    return graph.add("Concat", *whole, shape=eqn.outvars[0].aval.shape, axis=int(eqn.params["dimension"]))


def _stack(graph, eqn, *parts):
    axis = int(eqn.params["axis"])
    whole = [graph.whole(x, v.aval.shape) for x, v in zip(parts, eqn.invars, strict=True)]
    rows = [graph.reshape(x, (*x.shape[:axis], 1, *x.shape[axis:])) for x in whole]
    return graph.add("Concat", *rows, shape=eqn.outvars[0].aval.shape, axis=axis)


def _sum(graph, eqn, x):
    axes = [int(a) for a in eqn.params["axes"]]
    if (found := _contracted(graph, x, axes, eqn.invars[0].aval.shape)) is not None:
        return found
    lengths = [eqn.invars[0].aval.shape[i] if i in axes else n for i, n in enumerate(x.shape)]
    shape = [n for i, n in enumerate(x.shape) if i not in axes]
    return graph.add("ReduceSum", graph.whole(x, lengths), np.asarray(axes, np.int64), shape=shape, keepdims=0)


def _contracted(graph, x: Tensor, axes: list[int], shape) -> Value | None:
    """Return a sum of a product over axes of both factors as one matrix product; None where another axis is long in both."""
    factors = graph.factors(x)
    if factors is None or any(
        len(f.shape) != len(shape) or [f.shape[i] for i in axes] != [shape[i] for i in axes] for f in factors
    ):
        return None
    ways = []
    for a, b in (factors, factors[::-1]):
        first, second = ([i for i, n in enumerate(f.shape) if n > 1 and i not in axes] for f in (a, b))
        left, right = [*first, *axes], [*axes, *second]
        if first + second == sorted({*first, *second}):
            ways.append(((left != sorted(left)) + (right != sorted(right)), a, b, left, right))
    if not ways:
        return None
    _, a, b, left, right = min(ways, key=lambda way: way[0])  # that which turns the fewest matrices
    depth = math.prod(shape[i] for i in axes)
    ends = [
        graph.transpose(f, [*order, *(i for i in range(len(shape)) if i not in order)]) for f, order in ((a, left), (b, right))
    ]
    rows, columns = (math.prod(f.shape) // depth for f in (a, b))
    found = graph.add(
        "MatMul", graph.reshape(ends[0], (rows, depth)), graph.reshape(ends[1], (depth, columns)), shape=(rows, columns)
    )
    return graph.reshape(found, [n for i, n in enumerate(x.shape) if i not in axes])


def _product(graph, eqn, *inputs):
    """Return a matrix product, in a batch where there is one; a constant matrix times a column is turned round."""
    contracted, batched = eqn.params["dimension_numbers"]
    sides, free = [], []
    for x, v, inner, outer in zip(inputs, eqn.invars, contracted, batched, strict=True):
        shape = v.aval.shape
        rest = [i for i in range(len(shape)) if i not in (*inner, *outer)]
        numbers = [math.prod(shape[i] for i in axes) for axes in (outer, rest, inner)]
        free.append([shape[i] for i in rest])
        sides.append((graph.whole(x, shape), (outer, rest, inner), numbers))
    (x, (outer, rest, inner), (batch, rows, depth)), (y, (outer_y, rest_y, inner_y), (_, columns, _)) = sides
    lead = [batch] if outer else []
    turned = not outer and columns == 1 and graph.fixed(x)
    if turned:
        (x, rest, inner, rows), (y, rest_y, inner_y, columns) = (y, rest_y, inner_y, columns), (x, rest, inner, rows)
    a = graph.reshape(graph.transpose(x, (*outer, *rest, *inner)), (*lead, rows, depth))
    b = graph.reshape(graph.transpose(y, (*outer_y, *inner_y, *rest_y)), (*lead, depth, columns))
    found = graph.add("MatMul", a, b, shape=(*lead, rows, columns))
    return graph.reshape(found, eqn.outvars[0].aval.shape)


def _gather(graph, eqn, x, index):
    """Gather with constant indices: gathering the places tells where each element comes from."""
    x, index = graph.whole(x, eqn.invars[0].aval.shape), _constant(eqn, index, eqn.invars[1].aval.shape)
    places = jnp.arange(math.prod(x.shape), dtype=jnp.int32).reshape(x.shape)
    return graph.pick(x, np.asarray(eqn.primitive.bind(places, jnp.asarray(index), **eqn.params)))


def _scatter(graph, eqn, x, index, new):
    """Write or add one row at a constant index, by a constant mask."""
    x, new = (graph.whole(a, v.aval.shape) for a, v in ((x, eqn.invars[0]), (new, eqn.invars[2])))
    index, how = _constant(eqn, index, eqn.invars[1].aval.shape), {k: eqn.params[k] for k in ("dimension_numbers", "mode")}
    mask = np.asarray(lax.scatter(jnp.zeros(x.shape, bool), jnp.asarray(index), jnp.ones(new.shape, bool), **how))
    shape = [1 if i in how["dimension_numbers"].inserted_window_dims else n for i, n in enumerate(x.shape)]
    if not math.prod(shape) == math.prod(new.shape) == np.count_nonzero(mask):
        raise InputError("one whole row expected", field="--format onnx", value=eqn.primitive.name, mend=MEND)
    new, adds = graph.reshape(new, shape), eqn.primitive.name == "scatter-add"
    found = graph.add("Where", mask, new, np.zeros((), np.float32) if adds else x, shape=x.shape)
    return graph.add("Add", x, found, shape=x.shape) if adds else found


def _constant(eqn, index: Value, shape) -> np.ndarray:
    if isinstance(index, Tensor):
        raise InputError("constant indices expected", field="--format onnx", value=eqn.primitive.name, mend=MEND)
    return np.broadcast_to(index, shape)


CALLS = {"jit": "jaxpr", "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr"}
LAZY = {"broadcast_in_dim"}  # worked out without being made
RULES: dict[str, Callable] = {
    "add": _elementwise("Add"),
    "broadcast_in_dim": _broadcast,
    "concatenate": _concatenate,
    "convert_element_type": _convert,
    "div": _elementwise("Div"),
    "dot_general": _product,
    "exp": _elementwise("Exp"),
    "gather": _gather,
    "gt": _elementwise("Greater"),
    "logistic": _elementwise("Sigmoid"),
    "max": _elementwise("Max"),
    "min": _elementwise("Min"),
    "mul": _elementwise("Mul"),
    "neg": _elementwise("Neg"),
    "reduce_sum": _sum,
    "reshape": _reshape,
    "scatter": _scatter,
    "scatter-add": _scatter,
    "select_n": _select,
    "slice": _slice,
    "split": _split,
    "sqrt": _elementwise("Sqrt"),
    "squeeze": _squeeze,
    "stack": _stack,
    "sub": _elementwise("Sub"),
    "tanh": _elementwise("Tanh"),
    "transpose": _transpose,
}
