"""Numbers of a traced function as symbols: a jaxpr evaluated number by number, with everything simplified on the way.

An array of the jaxpr is an array of numpy of dtype object, with a float for each number that is known and a `Number`
for each other. Reshaping and indexing only move them. Loops (`scan`) stay loops, in scopes of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

Symbol = Any
"""A `Number`, or a float or bool that is known."""


class UnknownPrimitiveError(Exception):
    """The function has an operation that this compiler does not know."""


@dataclass(eq=False)
class Scope:
    """The function's body, or a loop's."""

    index: int
    parent: Scope | None = None
    length: int = 1
    """Rounds of the loop."""
    carry: list[Number] = field(default_factory=list)
    """What each round begins with."""
    start: list[Symbol] = field(default_factory=list)
    """Of the carry."""
    end: list[Symbol] = field(default_factory=list)
    """Of the carry in each round."""
    items: list[list[Symbol]] = field(default_factory=list)
    """Numbers of which each round has its own."""
    stacked: list[Number] = field(default_factory=list)
    """Numbers of which each round's value is kept."""

    def __post_init__(self) -> None:
        self.depth: int = 0 if self.parent is None else self.parent.depth + 1
        self.rounds: int = self.length * (1 if self.parent is None else self.parent.rounds)


@dataclass(eq=False, slots=True)
class Number:
    """A number that is not known before the function is called."""

    op: str
    args: tuple[Symbol, ...]
    scope: Scope
    """The innermost loop in which it changes."""
    is_uniform: bool
    """Whether it is the same in all lanes."""
    index: int
    """In the order of their making."""
    extra: Any
    """What distinguishes it besides its arguments: an index, or the loop that it comes from."""

    @property
    def is_mask(self) -> bool:
        """Whether it is true or false."""
        return self.op in _MASKS


_FOLD: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "neg": np.negative,
    "max": np.maximum,
    "min": np.minimum,
    "gt": np.greater,
    "lt": np.less,
    "ge": np.greater_equal,
    "le": np.less_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "and": np.logical_and,
    "or": np.logical_or,
    "not": np.logical_not,
    "reciprocal": lambda a: np.divide(1.0, a),
    "sqrt": np.sqrt,
    "floor": np.floor,
    "ceil": np.ceil,
    "roundeven": np.round,
    "abs": np.abs,
    "exp": np.exp,
    "expm1": np.expm1,
    "log": np.log,
    "log1p": np.log1p,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "atan": np.arctan,
    "atan2": np.arctan2,
    "sinh": np.sinh,
    "cosh": np.cosh,
    "tanh": np.tanh,
    "pow": np.power,
}
_MASKS = {"gt", "lt", "ge", "le", "eq", "ne", "and", "or", "not"}


class Graph:
    """The numbers of a function, each of which is there once."""

    def __init__(self) -> None:
        self.root = Scope(0)
        self.scopes = [self.root]
        self.scope = self.root
        self._numbers: dict[tuple, Number] = {}

    def number(self, op: str, *args: Symbol, extra: Any = None, scope: Scope | None = None, uniform: bool = True) -> Any:
        """The number that an operation makes of its arguments; a float if they are known."""
        unknown = [each for each in args if isinstance(each, Number)]
        if args and not unknown:
            value = _FOLD[op](*args)
            return bool(value) if op in _MASKS else float(value)
        if scope is None:
            scope = max((each.scope for each in unknown), key=lambda own: own.depth)
        key = (op, *((id(each) if isinstance(each, Number) else (each,)) for each in args), extra, id(scope))
        found = self._numbers.get(key)
        if found is None:
            found = Number(op, args, scope, uniform and all(each.is_uniform for each in unknown), len(self._numbers), extra)
            self._numbers[key] = found
        return found

    def add(self, a: Symbol, b: Symbol) -> Symbol:
        if _is(b, 0.0) or _is(a, 0.0):
            return a if _is(b, 0.0) else b
        for one, other in ((a, b), (b, a)):
            if isinstance(other, Number) and other.op == "neg":
                return self.sub(one, other.args[0])
        return self.number("add", *_sorted(a, b))

    def sub(self, a: Symbol, b: Symbol) -> Symbol:
        if _is(b, 0.0):
            return a
        if _is(a, 0.0):
            return self.neg(b)
        if isinstance(b, Number) and b.op == "neg":
            return self.add(a, b.args[0])
        return self.number("sub", a, b)

    def neg(self, a: Symbol) -> Symbol:
        return a.args[0] if isinstance(a, Number) and a.op == "neg" else self.number("neg", a)

    def mul(self, a: Symbol, b: Symbol) -> Symbol:
        a, b = _sorted(a, b)
        if not isinstance(b, Number) and isinstance(a, Number) and abs(b) in (0.0, 1.0):
            # A number without effect on the result may as well be infinite.
            return 0.0 if b == 0.0 else a if b == 1.0 else self.neg(a)
        for one, other in ((a, b), (b, a)):
            if isinstance(one, Number) and one.op == "neg":
                return self.neg(self.mul(one.args[0], other))
        return self.number("mul", a, b)

    def div(self, a: Symbol, b: Symbol) -> Symbol:
        return self.mul(a, self.number("reciprocal", b))

    def power(self, a: Symbol, exponent: int) -> Symbol:
        if exponent < 0:
            return self.div(1.0, self.power(a, -exponent))
        result: Symbol = 1.0
        for bit in f"{exponent:b}":
            result = self.mul(result, result)
            result = self.mul(result, a) if bit == "1" else result
        return result

    def select(self, mask: Symbol, no: Symbol, yes: Symbol) -> Symbol:
        if not isinstance(mask, Number):
            return yes if mask else no
        if yes is no or (not isinstance(yes, Number) and not isinstance(no, Number) and yes == no):
            return yes
        return self.number("select", mask, no, yes)


def _is(a: Symbol, value: float) -> bool:
    return not isinstance(a, Number) and a == value


def _sorted(a: Symbol, b: Symbol) -> tuple[Symbol, Symbol]:
    """The arguments of a commutative operation in one order, a known one last."""
    if isinstance(a, Number) and isinstance(b, Number):
        return (a, b) if a.index <= b.index else (b, a)
    return (a, b) if isinstance(a, Number) else (b, a)
