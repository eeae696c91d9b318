"""The numbers of a jaxpr: an array of them for each of its arrays, which reshaping and indexing only move.

Loops (`scan`) stay loops; everything else is taken apart. What is known is computed here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.extend.core import Literal
from jax.lax import RoundingMethod

from contact_reach_ros.planning.lanes.graph import Graph, Memory, Number, Scope, Symbol

LIBRARY = ("exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh")
"""Functions of the C library, which numpy and JAX call the same."""
_OPERATIONS = {name: name for name in (*LIBRARY, "pow", "sqrt", "floor", "ceil", "add")} | {
    **{"add_any": "add", "sub": "subtract", "mul": "multiply", "div": "divide", "neg": "negative", "abs": "fabs"},
    **{"max": "maximum", "min": "minimum", "select_n": "select", "round": "rint"},
    **{"gt": "greater", "lt": "less", "ge": "greater_equal", "le": "less_equal", "eq": "equal", "ne": "not_equal"},
    **{"and": "logical_and", "or": "logical_or", "not": "logical_not"},
}
"""Names in numpy, or of a method of `Graph`, of operations on single numbers."""
_REDUCTIONS = {"reduce_sum": "add", "reduce_max": "maximum", "reduce_min": "minimum"}
_REDUCTIONS |= {"reduce_and": "logical_and", "reduce_or": "logical_or", "reduce_prod": "multiply"}


class UnknownOperationError(Exception):
    """The function has an operation that this compiler does not know, or is too large for it."""


MAX_NUMBERS = 150_000
"""Of more, as with 40 spheres, each of which depends on all others, LLVM makes no code within minutes."""


class Trace:
    """The numbers that a closed jaxpr computes for one candidate, its last argument (n, 1).

    Attributes
    ----------
    results
        All numbers of its results, one array after the other.
    loops
        In the order in which they begin.
    """

    def __init__(self, jaxpr: Any) -> None:
        self._graph = graph = Graph()
        self.root = self._scope = graph.root
        self.loops: list[Scope] = []
        *given, candidate = (variable.aval for variable in jaxpr.jaxpr.invars)
        arguments = [
            _array([graph.source("given", self.root, True, index, place) for place in range(each.size)], each.shape)
            for index, each in enumerate(given)
        ]
        rows = [graph.source("lane", self.root, False, row) for row in range(candidate.size)]
        with np.errstate(all="ignore"):
            results = self._run(jaxpr, [*arguments, _array(rows, candidate.shape)])
        self.results: list[Symbol] = [number for array in results for number in array.ravel()]

    def _run(self, closed: Any, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
        jaxpr = closed.jaxpr
        values = dict(zip(jaxpr.constvars, map(_known, closed.consts), strict=True))
        values.update(zip(jaxpr.invars, arguments, strict=True))

        def read(variable: Any) -> np.ndarray:
            return _known(variable.val) if isinstance(variable, Literal) else values[variable]

        for equation in jaxpr.eqns:
            results = self._apply(equation, [read(variable) for variable in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
            if self._graph.count > MAX_NUMBERS:
                raise UnknownOperationError(f"the lanes' compiler takes {MAX_NUMBERS:,} numbers, and this has more")
        return [read(variable) for variable in jaxpr.outvars]

    def _apply(self, equation: Any, inputs: list[np.ndarray]) -> Sequence[np.ndarray]:
        """What an equation makes of its inputs."""
        name, options, operation = equation.primitive.name, equation.params, self._graph.operation
        if name == "scan":
            return self._loop(options, inputs)
        if name in ("jit", "closed_call", "custom_jvp_call", "custom_vjp_call"):
            return self._run(options["jaxpr"] if "jaxpr" in options else options["call_jaxpr"], inputs)
        if name in _STRUCTURE:
            results = _STRUCTURE[name](options, *inputs)
            return results if isinstance(results, list) else [results]
        if name in _REDUCTIONS:
            return [_reduce(operation(_REDUCTIONS[name]), inputs[0], options["axes"])]
        if name == "cumsum" and not options["reverse"]:
            return [np.frompyfunc(operation("add"), 2, 1).accumulate(inputs[0], options["axis"], dtype=object)]
        if name == "dot_general" and not options["dimension_numbers"][1][0]:
            over_a, over_b = options["dimension_numbers"][0]
            products = _each(operation("multiply"), *_aligned(inputs[0], inputs[1], over_a, over_b))
            return [_reduce(operation("add"), products, [products.ndim - 1])]
        return [_each(self._on_numbers(equation), *inputs)]

    def _on_numbers(self, equation: Any) -> Callable[..., Symbol]:
        """What an equation does to single numbers."""
        graph, options = self._graph, equation.params
        name, dtype = equation.primitive.name, np.dtype(equation.invars[0].aval.dtype)
        match name:
            case "square":
                return lambda a: graph.multiply(a, a)
            case "integer_pow":
                return lambda a: graph.power(a, options["y"])
            case "rsqrt":
                return lambda a: graph.divide(1.0, graph.apply("sqrt", a))
            case "clamp":
                return lambda low, a, high: graph.apply("minimum", graph.apply("maximum", a, low), high)
            case "is_finite":
                return lambda a: graph.apply("less", graph.apply("fabs", a), np.inf)
            case "sign":
                below = graph.operation("less")
                return lambda a: graph.select(below(a, 0.0), graph.select(below(0.0, a), a, 1.0), -1.0)
            case "convert_element_type":
                return lambda a: self._converted(a, dtype, options["new_dtype"])
        is_odd = dtype == np.bool_ and _OPERATIONS.get(name, "select")[:7] not in ("select", "logical")
        if name not in _OPERATIONS or is_odd or options.get("rounding_method") is RoundingMethod.AWAY_FROM_ZERO:
            raise UnknownOperationError(f"the lanes' compiler knows no operation '{name}' of {dtype}")
        return graph.operation(_OPERATIONS[name])

    def _converted(self, a: Symbol, before: Any, after: Any) -> Symbol:
        if not isinstance(a, Number):
            return np.dtype(after).type(a).item()
        if before == np.bool_ and after == np.float32:
            return self._graph.select(a, 0.0, 1.0)
        if before != after:
            raise UnknownOperationError(f"the lanes' compiler knows no conversion from {before} to {after}")
        return a

    def _loop(self, options: dict[str, Any], inputs: list[np.ndarray]) -> list[np.ndarray]:
        constants, carried, length = options["num_consts"], options["num_carry"], options["length"]
        body, places = options["jaxpr"], range(length)[:: -1 if options["reverse"] else 1]
        if any(each.dtype != np.float32 for each in (*body.in_avals, *body.out_avals)):
            raise UnknownOperationError("the lanes' compiler knows no loop over numbers that are not float32")
        varied = [not all(map(_is_uniform, array.ravel())) for array in inputs]
        _spread(body.jaxpr, varied, constants, carried)
        outer, source = self._scope, self._graph.source
        loop = self._scope = Scope(len(self.loops) + 1, outer, length)
        self.loops.append(loop)

        def carry(array: np.ndarray, is_varied: bool) -> np.ndarray:
            return _each(lambda start: Memory(loop, not is_varied, 1, [start]), array)

        def item(*rounds: Symbol) -> Symbol:
            if all(own is rounds[0] or (not isinstance(own, Number) and own == rounds[0]) for own in rounds):
                return rounds[0]
            memory = Memory(loop, all(map(_is_uniform, rounds)), length, [rounds[place] for place in places])
            return source("read", loop, memory.is_uniform, memory, None)

        def stacked(own: Symbol) -> list[Symbol]:
            if not isinstance(own, Number) or own.scope is not loop:
                return [own] * length
            memory = Memory(loop, own.is_uniform, length, end=own)
            return [source("read", outer, own.is_uniform, memory, place) for place in places]

        def read(memory: Memory, scope: Scope) -> Number:
            return source("read", scope, memory.is_uniform, memory, 0)

        memories = [carry(*each) for each in zip(inputs[constants:], varied[constants:], strict=True)][:carried]
        states = [_each(lambda memory: read(memory, loop), array) for array in memories]
        items = [_each(item, *array) for array in inputs[constants + carried :]]
        results = self._run(body, [*inputs[:constants], *states, *items])
        for array, ends in zip(memories, results, strict=False):
            for memory, end in zip(array.ravel(), ends.ravel(), strict=True):
                memory.end = end
        self._scope = outer
        finals = [_each(lambda memory: read(memory, outer), array) for array in memories]
        stacks = [np.array([stacked(own) for own in array.ravel()], object) for array in results[carried:]]
        return finals + [
            np.moveaxis(stack.reshape(*array.shape, length), -1, 0)
            for stack, array in zip(stacks, results[carried:], strict=True)
        ]


def _is_uniform(symbol: Symbol) -> bool:
    return not isinstance(symbol, Number) or symbol.is_uniform


def _spread(jaxpr: Any, varied: list[bool], constants: int, carried: int) -> list[bool]:
    """Which results of a loop differ between lanes; of its inputs, `varied` gets those that do in a later round."""
    while True:
        results = _varied(jaxpr, varied)
        before = varied[constants : constants + carried]
        varied[constants : constants + carried] = map(max, before, results)
        if before == varied[constants : constants + carried]:
            return results


def _varied(jaxpr: Any, inputs: Sequence[bool]) -> list[bool]:
    """Which results of a jaxpr differ between lanes, if these inputs do."""
    known = dict(zip(jaxpr.invars, inputs, strict=True))

    def read(variable: Any) -> bool:
        return not isinstance(variable, Literal) and known.get(variable, False)

    for equation in jaxpr.eqns:
        own = [read(variable) for variable in equation.invars]
        inner = equation.params.get("jaxpr", equation.params.get("call_jaxpr"))
        if equation.primitive.name == "scan":
            results = _spread(inner.jaxpr, own, equation.params["num_consts"], equation.params["num_carry"])
        else:
            results = _varied(inner.jaxpr, own) if inner is not None else [any(own)] * len(equation.outvars)
        known.update(zip(equation.outvars, results, strict=True))
    return [read(variable) for variable in jaxpr.outvars]


def _array(values: Sequence[Symbol], shape: Sequence[int]) -> np.ndarray:
    array = np.empty(len(values), object)
    array[:] = values
    return array.reshape(shape)


def _known(values: Any) -> np.ndarray:
    return _array(np.asarray(values).ravel().tolist(), np.shape(values))


def _each(operation: Callable[..., Any], *arrays: np.ndarray) -> np.ndarray:
    return np.asarray(np.frompyfunc(operation, len(arrays), 1)(*arrays), object)


def _reduce(operation: Callable[..., Symbol], array: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    rows = np.moveaxis(array, axes, range(len(axes))).reshape(-1, *np.delete(array.shape, axes))
    return np.asarray(np.frompyfunc(operation, 2, 1).reduce(rows, dtype=object), object)


def _aligned(
    a: np.ndarray, b: np.ndarray, over_a: Sequence[int], over_b: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """The factors of a contraction, with what is summed over on the last axis of both."""
    rows_a, rows_b = (np.moveaxis(own, over, range(-len(over), 0)) for own, over in ((a, over_a), (b, over_b)))
    free_a, free_b = rows_a.shape[: a.ndim - len(over_a)], rows_b.shape[: b.ndim - len(over_b)]
    return rows_a.reshape(*free_a, *[1] * len(free_b), -1), rows_b.reshape(*free_b, -1)


def _broadcast(options: dict[str, Any], array: np.ndarray) -> np.ndarray:
    kept = [1] * len(options["shape"])
    for place, size in zip(options["broadcast_dimensions"], array.shape, strict=True):
        kept[place] = size
    return np.broadcast_to(array.reshape(kept), options["shape"])


def _slice(options: dict[str, Any], array: np.ndarray) -> np.ndarray:
    strides = options["strides"] or [1] * array.ndim
    return array[tuple(map(slice, options["start_indices"], options["limit_indices"], strides))]


_STRUCTURE: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda options, *arrays: np.concatenate(arrays, axis=options["dimension"]),
    "copy": lambda options, array: array,
    "expand_dims": lambda options, array: np.expand_dims(array, options["dimensions"]),
    "iota": lambda options: _known(np.indices(options["shape"])[options["dimension"]]),
    "reshape": lambda options, array: array.reshape(options["new_sizes"]),
    "rev": lambda options, array: np.flip(array, options["dimensions"]),
    "slice": _slice,
    "split": lambda options, array: np.split(array, np.cumsum(options["sizes"])[:-1], axis=options["axis"]),
    "squeeze": lambda options, array: np.squeeze(array, axis=tuple(options["dimensions"])),
    "stack": lambda options, *arrays: np.stack(arrays, axis=options["axis"]),
    "stop_gradient": lambda options, array: array,
    "transpose": lambda options, array: np.transpose(array, options["permutation"]),
    "unstack": lambda options, array: list(np.moveaxis(array, options["axis"], 0)),
}
