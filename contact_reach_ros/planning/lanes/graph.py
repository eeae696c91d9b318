"""Numbers that a function computes with, known or not, simplified as they are made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Symbol = Any
"""A `Number`, or a float or bool that is known."""

COMPARISONS = {"greater": "ogt", "less": "olt", "greater_equal": "oge", "less_equal": "ole", "equal": "oeq"}
COMPARISONS |= {"not_equal": "une"}
"""Names in numpy and in LLVM."""
LOGIC = {"logical_and": "and", "logical_or": "or", "logical_not": "xor"}


@dataclass(eq=False)
class Scope:
    """The whole function, or a loop in it."""

    index: int
    parent: Scope | None = None
    length: int = 1
    """Rounds of the loop."""
    depth: int = field(init=False)
    rounds: int = field(init=False)
    """In all, with those of the loops around it."""

    def __post_init__(self) -> None:
        self.depth = self.parent.depth + 1 if self.parent else 0
        self.rounds = self.parent.rounds * self.length if self.parent else 1


@dataclass(eq=False)
class Memory:
    """Numbers that enter a loop, leave it or are handed on from round to round."""

    loop: Scope
    is_uniform: bool
    size: int
    before: list[Symbol] = field(default_factory=list)
    """What is written into the first places before the loop."""
    end: Symbol | None = None
    """What each round writes at its end, into the place of the round or the only one."""


@dataclass(eq=False, slots=True)
class Number:
    """A number that is not known before the function is called.

    `op` is a function of numpy, or "given" (one of the arguments that are the same in all lanes), "lane" (one of a
    candidate), "read" (from a `Memory`), "select".
    """

    op: str
    args: tuple[Symbol, ...]
    scope: Scope
    """The innermost loop in which it changes."""
    is_uniform: bool
    """Whether it is the same in all lanes."""
    extra: Any
    """The place of one that comes from an argument or a memory."""
    index: int
    """In the order in which they were made."""

    @property
    def is_mask(self) -> bool:
        """Whether it is true or false."""
        return is_mask(self.args[1]) if self.op == "select" else self.op in COMPARISONS or self.op in LOGIC


def is_mask(symbol: Symbol) -> bool:
    """Whether a symbol is true or false."""
    return symbol.is_mask if isinstance(symbol, Number) else isinstance(symbol, bool)


class Graph:
    """The numbers of a function, each of which is there once."""

    def __init__(self) -> None:
        self.root = Scope(0)
        self._numbers: dict[tuple, Number] = {}

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self._numbers)

    def source(self, op: str, scope: Scope, is_uniform: bool, *extra: Any) -> Number:
        """A number from outside of the graph."""
        return self._numbers.setdefault(
            (op, scope, *extra), Number(op, (), scope, is_uniform, extra, len(self._numbers))
        )

    def apply(self, op: str, *args: Symbol) -> Symbol:
        """What an operation makes of its arguments."""
        unknown = [each for each in args if isinstance(each, Number)]
        if not unknown:
            return getattr(np, op)(*args).item()
        key = (op, *(id(each) if isinstance(each, Number) else (type(each), each) for each in args))
        if key not in self._numbers:
            scope = max((each.scope for each in unknown), key=lambda own: own.depth)
            is_uniform = all(each.is_uniform for each in unknown)
            self._numbers[key] = Number(op, args, scope, is_uniform, None, len(self._numbers))
        return self._numbers[key]

    def operation(self, op: str) -> Callable[..., Symbol]:
        """A function of symbols by its name in numpy."""
        return getattr(self, op, None) or (lambda *args: self.apply(op, *args))

    def add(self, a: Symbol, b: Symbol) -> Symbol:
        """The sum."""
        a, b = _sorted(a, b)
        if _is(b, 0.0):
            return a
        for one, other in ((a, b), (b, a)):
            if isinstance(other, Number) and other.op == "negative":
                return self.subtract(one, other.args[0])
        return self.apply("add", a, b)

    def subtract(self, a: Symbol, b: Symbol) -> Symbol:
        """The difference."""
        if _is(b, 0.0):
            return a
        if isinstance(b, Number) and b.op == "negative":
            return self.add(a, b.args[0])
        return self.negative(b) if _is(a, 0.0) else self.apply("subtract", a, b)

    def negative(self, a: Symbol) -> Symbol:
        """With the other sign."""
        return a.args[0] if isinstance(a, Number) and a.op == "negative" else self.apply("negative", a)

    def multiply(self, a: Symbol, b: Symbol) -> Symbol:
        """The product; that with a known zero is zero, even if the other should turn out infinite."""
        a, b = _sorted(a, b)
        if isinstance(a, Number) and any(_is(b, value) for value in (0.0, 1.0, -1.0)):
            return 0.0 if b == 0.0 else a if b == 1.0 else self.negative(a)
        for one, other in ((a, b), (b, a)):
            if isinstance(one, Number) and one.op == "negative":
                return self.negative(self.multiply(one.args[0], other))
        return self.apply("multiply", a, b)

    def divide(self, a: Symbol, b: Symbol) -> Symbol:
        """The quotient, by a reciprocal that others may share."""
        return self.multiply(a, self.apply("reciprocal", b))

    def power(self, a: Symbol, exponent: int) -> Symbol:
        """A power with a known exponent."""
        result: Symbol = 1.0
        for bit in f"{abs(exponent):b}":
            result = self.multiply(result, result)
            result = self.multiply(result, a) if bit == "1" else result
        return self.divide(1.0, result) if exponent < 0 else result

    def select(self, mask: Symbol, no: Symbol, yes: Symbol) -> Symbol:
        """One of two, by a mask."""
        if not isinstance(mask, Number):
            return yes if mask else no
        same = yes is no or (not isinstance(yes, Number) and not isinstance(no, Number) and yes == no)
        return yes if same else self.apply("select", mask, no, yes)


def _is(a: Symbol, value: float) -> bool:
    return not isinstance(a, Number) and a == value


def _sorted(a: Symbol, b: Symbol) -> tuple[Symbol, Symbol]:
    """The arguments of a commutative operation in one order, a known one last."""
    if isinstance(b, Number) and not (isinstance(a, Number) and a.index <= b.index):
        return b, a
    return a, b
