"""A jaxpr evaluated on symbols."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from jax.extend.core import Literal
import numpy as np

from contact_reach_ros.planning.lanes.symbols import Graph, Number, Scope, Symbol, UnknownPrimitiveError

_UNARY = {"round": "roundeven", "is_finite": ""} | {
    name: name
    for name in "sqrt floor ceil abs exp expm1 log log1p sin cos tan asin acos atan sinh cosh tanh not".split()
}
_BINARY = {name: name for name in "max min gt lt ge le eq ne and or pow atan2".split()}


class Evaluation:
    def __init__(self, jaxpr: Any, uniform: Sequence[Any], lanes: Any) -> None:
        """Of a closed jaxpr whose last argument, (n, 1), differs from lane to lane."""
        self.graph = graph = Graph()
        arguments = [
            _array([graph.number("given", extra=(index, place), scope=graph.root) for place in range(each.size)], each.shape)
            for index, each in enumerate(uniform)
        ]
        rows = [graph.number("lane", extra=row, scope=graph.root, uniform=False) for row in range(lanes.size)]
        (self.result,) = self._run(jaxpr, [*arguments, _array(rows, lanes.shape)])[0].ravel()

    def _run(self, closed: Any, arguments: Sequence[np.ndarray]) -> list[np.ndarray]:
        jaxpr = closed.jaxpr
        values = dict(zip(jaxpr.constvars, map(_known, closed.consts), strict=True))
        values.update(zip(jaxpr.invars, arguments, strict=True))

        def read(variable: Any) -> np.ndarray:
            return _known(variable.val) if isinstance(variable, Literal) else values[variable]

        for equation in jaxpr.eqns:
            results = self._apply(equation, [read(variable) for variable in equation.invars])
            values.update(zip(equation.outvars, results, strict=True))
        return [read(variable) for variable in jaxpr.outvars]

    def _apply(self, equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
        name, parameters = equation.primitive.name, equation.params
        if name == "scan":
            return self._loop(parameters, inputs)
        for key in ("jaxpr", "call_jaxpr"):
            if name in ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint") and key in parameters:
                return self._run(parameters[key], inputs)
        if name in _STRUCTURE:
            results = _STRUCTURE[name](parameters, *inputs)
            return results if isinstance(results, list) else [results]
        operation = self._operation(equation, name, parameters)
        if operation is not None:
            return [_each(operation, *inputs)]
        if name in ("reduce_sum", "reduce_max", "reduce_min"):
            return [self._reduce(name[7:], inputs[0], parameters["axes"])]
        if name in ("cumsum",):
            return [self._accumulate(inputs[0], parameters)]
        if name == "dot_general":
            return [self._contract(*inputs, parameters["dimension_numbers"])]
        raise UnknownPrimitiveError(f"{name}")

    def _operation(self, equation: Any, name: str, parameters: dict[str, Any]) -> Callable[..., Symbol] | None:
        """What an equation does to each number."""
        graph = self.graph
        number = graph.number
        match name:
            case "add" | "add_any":
                return graph.add
            case "sub" | "mul" | "div" | "neg":
                return getattr(graph, name)
            case "square":
                return lambda a: graph.mul(a, a)
            case "integer_pow":
                return lambda a: graph.power(a, parameters["y"])
            case "rsqrt":
                return lambda a: number("reciprocal", number("sqrt", a))
            case "select_n" if equation.invars[0].aval.dtype == bool:
                return graph.select
            case "clamp":
                return lambda low, a, high: number("min", number("max", a, low), high)
            case "is_finite":
                return lambda a: number("lt", number("abs", a), np.inf)
            case "sign":
                return lambda a: graph.select(number("gt", a, 0.0), graph.select(number("lt", a, 0.0), a, -1.0), 1.0)
            case "convert_element_type":
                return self._conversion(equation)
        if name in _UNARY or name in _BINARY:
            return lambda *args: number((_UNARY | _BINARY)[name], *args)
        return None

    def _conversion(self, equation: Any) -> Callable[[Symbol], Symbol]:
        before, after = equation.invars[0].aval.dtype, equation.params["new_dtype"]

        def convert(a: Symbol) -> Symbol:
            if not isinstance(a, Number):
                return np.dtype(after).type(a).item()
            if after == np.float32 and before == bool:
                return self.graph.select(a, 0.0, 1.0)
            if after == before:
                return a
            raise UnknownPrimitiveError(f"convert_element_type from {before} to {after}")

        return convert

    def _reduce(self, name: str, array: np.ndarray, axes: Sequence[int]) -> np.ndarray:
        combine = self.graph.add if name == "sum" else lambda a, b: self.graph.number(name, a, b)
        rows = np.moveaxis(array, axes, range(len(axes))).reshape(-1, *np.delete(array.shape, axes))
        total = rows[0]
        for row in rows[1:]:
            total = _each(combine, total, row)
        return total

    def _accumulate(self, array: np.ndarray, parameters: dict[str, Any]) -> np.ndarray:
        rows = list(np.moveaxis(array, parameters["axis"], 0))[:: -1 if parameters["reverse"] else 1]
        for index in range(1, len(rows)):
            rows[index] = _each(self.graph.add, rows[index - 1], rows[index])
        return np.moveaxis(np.stack(rows[:: -1 if parameters["reverse"] else 1]), 0, parameters["axis"])

    def _contract(self, a: np.ndarray, b: np.ndarray, dimensions: Any) -> np.ndarray:
        (over_a, over_b), (batch_a, batch_b) = dimensions
        if batch_a:
            raise UnknownPrimitiveError("dot_general with batch dimensions")
        left, right = np.moveaxis(a, over_a, range(len(over_a))), np.moveaxis(b, over_b, range(len(over_b)))
        shape = left.shape[len(over_a) :] + right.shape[len(over_b) :]
        terms = int(np.prod(left.shape[: len(over_a)]))
        left, right = left.reshape(terms, -1, 1), right.reshape(terms, 1, -1)
        total = np.full(shape, 0.0, object).reshape(left.shape[1], right.shape[2])
        for one, other in zip(left, right, strict=True):
            total = _each(self.graph.add, total, _each(self.graph.mul, one, other))
        return total.reshape(shape)

    def _loop(self, parameters: dict[str, Any], inputs: list[np.ndarray]) -> list[np.ndarray]:
        constants, carried = parameters["num_consts"], parameters["num_carry"]
        body, length = parameters["jaxpr"], parameters["length"]
        varied = [any(isinstance(own, Number) and not own.is_uniform for own in array.ravel()) for array in inputs]
        _spread(body.jaxpr, varied, constants, carried)
        graph, outer = self.graph, self.graph.scope
        graph.scope = loop = Scope(len(graph.scopes), outer, length)
        graph.scopes.append(loop)

        def begin(array: np.ndarray, is_varied: bool) -> np.ndarray:
            first = len(loop.carry)
            for place, own in enumerate(array.ravel()):
                loop.start.append(own)
                loop.carry.append(graph.number("carry", extra=first + place, scope=loop, uniform=not is_varied))
            return _array(loop.carry[first:], array.shape)

        def item(*rounds: Symbol) -> Symbol:
            if all(own is rounds[0] or not isinstance(own, Number) and own == rounds[0] for own in rounds):
                return rounds[0]
            loop.items.append(list(rounds[:: -1 if parameters["reverse"] else 1]))
            is_uniform = all(not isinstance(own, Number) or own.is_uniform for own in rounds)
            return graph.number("item", extra=len(loop.items) - 1, scope=loop, uniform=is_uniform)

        carry = [begin(array, flag) for array, flag in zip(inputs[constants:], varied[constants:], strict=False)][:carried]
        items = [_each(item, *array) for array in inputs[constants + carried :]]
        results = self._run(body, [*inputs[:constants], *carry, *items])
        loop.end = [own for array in results[:carried] for own in array.ravel()]
        graph.scope = outer

        def final(place: int, array: np.ndarray) -> np.ndarray:
            return _array([
                graph.number("final", extra=(loop, place + index), scope=outer, uniform=loop.carry[place + index].is_uniform)
                for index in range(array.size)
            ], array.shape)

        def stack(own: Symbol) -> list[Symbol]:
            if not isinstance(own, Number) or own.scope is not loop:
                return [own] * length
            loop.stacked.append(own)
            place = len(loop.stacked) - 1
            rounds = range(length)[:: -1 if parameters["reverse"] else 1]
            return [graph.number("stacked", extra=(loop, place, index), scope=outer, uniform=own.is_uniform) for index in rounds]

        places = np.cumsum([0, *(array.size for array in carry)])
        finals = [final(int(place), array) for place, array in zip(places, carry, strict=False)]
        stacks = []
        for array in results[carried:]:
            columns = [stack(own) for own in array.ravel()]
            stacks.append(np.stack([_array([column[index] for column in columns], array.shape) for index in range(length)]))
        return finals + stacks


def _spread(jaxpr: Any, varied: list[bool], constants: int, carried: int) -> list[bool]:
    """Marks in place, of a loop's inputs, the carried ones that differ between lanes in some round; returns those of its results."""
    while True:
        results = _varied(jaxpr, varied)
        wider = [before or after for before, after in zip(varied[constants : constants + carried], results, strict=False)]
        if wider == varied[constants : constants + carried]:
            return results
        varied[constants : constants + carried] = wider


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
        elif inner is not None and len(inner.jaxpr.invars) == len(own):
            results = _varied(inner.jaxpr, own)
        else:
            results = [any(own)] * len(equation.outvars)
        known.update(zip(equation.outvars, results, strict=True))
    return [read(variable) for variable in jaxpr.outvars]


def _array(values: Sequence[Symbol], shape: Sequence[int]) -> np.ndarray:
    array = np.empty(len(values), object)
    array[:] = values
    return array.reshape(shape)


def _known(values: Any) -> np.ndarray:
    array = np.asarray(values)
    return _array(array.ravel().tolist(), array.shape)


def _each(operation: Callable[..., Symbol], *arrays: np.ndarray) -> np.ndarray:
    result = np.frompyfunc(operation, len(arrays), 1)(*arrays)
    return result if isinstance(result, np.ndarray) else _array([result], ())


def _broadcast(parameters: dict[str, Any], array: np.ndarray) -> np.ndarray:
    shape, places = parameters["shape"], parameters["broadcast_dimensions"]
    kept = [1] * len(shape)
    for place, size in zip(places, array.shape, strict=True):
        kept[place] = size
    return np.broadcast_to(array.reshape(kept), shape)


def _pad(parameters: dict[str, Any], array: np.ndarray, value: np.ndarray) -> np.ndarray:
    widths = parameters["padding_config"]
    if any(inner or low < 0 or high < 0 for low, high, inner in widths):
        raise UnknownPrimitiveError(f"pad with {widths}")
    padded = np.full([low + size + high for size, (low, high, _) in zip(array.shape, widths, strict=True)], value.item(), object)
    padded[tuple(slice(low, low + size) for size, (low, _, _) in zip(array.shape, widths, strict=True))] = array
    return padded


def _slice(parameters: dict[str, Any], array: np.ndarray) -> np.ndarray:
    strides = parameters["strides"] or [1] * array.ndim
    bounds = zip(parameters["start_indices"], parameters["limit_indices"], strides, strict=True)
    return array[tuple(slice(*own) for own in bounds)]


def _dynamic_slice(parameters: dict[str, Any], array: np.ndarray, *starts: np.ndarray) -> np.ndarray:
    if any(isinstance(start.item(), Number) for start in starts):
        raise UnknownPrimitiveError("dynamic_slice from where only the call knows")
    sizes = parameters["slice_sizes"]
    first = [min(max(start.item(), 0), n - size) for start, n, size in zip(starts, array.shape, sizes, strict=True)]
    return array[tuple(slice(start, start + size) for start, size in zip(first, sizes, strict=True))]


def _iota(parameters: dict[str, Any]) -> np.ndarray:
    shape, axis = parameters["shape"], parameters["dimension"]
    return _known(np.moveaxis(np.broadcast_to(np.arange(shape[axis]), (*np.delete(shape, axis), shape[axis])), -1, axis))


_STRUCTURE: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda parameters, *arrays: np.concatenate(arrays, axis=parameters["dimension"]),
    "copy": lambda parameters, array: array,
    "copy_p": lambda parameters, array: array,
    "dynamic_slice": _dynamic_slice,
    "expand_dims": lambda parameters, array: np.expand_dims(array, parameters["dimensions"]),
    "iota": _iota,
    "optimization_barrier": lambda parameters, *arrays: list(arrays),
    "pad": _pad,
    "reshape": lambda parameters, array: array.reshape(parameters["new_sizes"]),
    "rev": lambda parameters, array: np.flip(array, parameters["dimensions"]),
    "slice": _slice,
    "split": lambda parameters, array: np.split(array, np.cumsum(parameters["sizes"])[:-1], axis=parameters["axis"]),
    "squeeze": lambda parameters, array: np.squeeze(array, axis=tuple(parameters["dimensions"])),
    "stack": lambda parameters, *arrays: np.stack(arrays, axis=parameters["axis"]),
    "stop_gradient": lambda parameters, array: array,
    "transpose": lambda parameters, array: np.transpose(array, parameters["permutation"]),
    "unstack": lambda parameters, array: list(np.moveaxis(array, parameters["axis"], 0)),
}
