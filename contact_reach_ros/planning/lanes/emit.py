"""LLVM code of a function's numbers: what is the same in all lanes first, once, then a vector of lanes at a time."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from contact_reach_ros.planning.lanes.symbols import Number, Scope, Symbol

_FLAGS = "nsz arcp contract"
"""Rounding may differ by how multiplications and additions are fused; NaN and infinity are as in IEEE 754."""

_ARITHMETIC = {"add": "fadd", "sub": "fsub", "mul": "fmul"}
_COMPARISON = {"gt": "ogt", "lt": "olt", "ge": "oge", "le": "ole", "eq": "oeq", "ne": "une"}
_INTRINSICS = {"sqrt": "sqrt", "floor": "floor", "ceil": "ceil", "roundeven": "roundeven", "abs": "fabs"}
_LIBM = {*"exp expm1 log log1p sin cos tan asin acos atan atan2 sinh cosh tanh pow".split()}
_MOVES = ("carry", "final", "item", "stacked", "given", "lane")

Item = Number | Scope


class Part:
    """The code of one of the two functions: that of uniform numbers, or that of the others."""

    def __init__(self, result: Symbol, lanes: int, stored: dict[Scope, dict[Number, int]] | None = None) -> None:
        """With the numbers that the other part needs `stored`, this is the part of uniform numbers.

        They are vectors too, of equal lanes: scalars take as long, and to select one of two takes a jump.
        """
        self.lanes = lanes
        self.is_uniform = stored is not None
        self.stored: dict[Scope, dict[Number, int]] = {} if stored is None else stored
        self.type = f"<{lanes} x float>"
        self.mask = f"<{lanes} x i1>"
        self.lines: list[str] = []
        self.slots: list[str] = []
        self._names: dict[Number, str] = {}
        self._count = 0
        self._label = "entry"
        self._live: dict[Scope, dict[str, list[int]]] = {}
        self._needed: dict[Number, None] = {}
        self._find_live([] if self.is_uniform else [result])
        self._orders: dict[Scope, tuple[list[Item], list[Number]]] = {}

    def _own(self, symbol: Symbol) -> bool:
        return isinstance(symbol, Number) and symbol.is_uniform == self.is_uniform

    def _find_live(self, results: list[Symbol]) -> None:
        """Which numbers of this part are needed, and which carried, listed and stacked numbers of loops."""
        pending = [*results, *(number for numbers in self.stored.values() for number in numbers)]
        while pending:
            number = pending.pop()
            if not isinstance(number, Number) or number in self._needed:
                continue
            if number.is_uniform != self.is_uniform:
                numbers = self.stored.setdefault(number.scope, {})
                numbers.setdefault(number, len(numbers))
                continue
            self._needed[number] = None
            pending += number.args
            if number.op in ("carry", "item"):
                loop, place = number.scope, number.extra
                pending += [loop.start[place], loop.end[place]] if number.op == "carry" else loop.items[place]
            elif number.op == "final":
                loop, place = number.extra
                pending += [loop.carry[place]]
            elif number.op == "stacked":
                loop, place, _ = number.extra
                pending += [loop.stacked[place]]
        for number in self._needed:
            self._enter(number.scope)
            if number.op in ("carry", "item"):
                self._of(number.scope)[number.op].append(number.extra)
            if number.op == "stacked":
                places = self._of(number.extra[0])["stacked"]
                if number.extra[1] not in places:
                    places.append(number.extra[1])
        for parts in self._live.values():
            for places in parts.values():
                places.sort()
        if self.is_uniform:
            for scope in self.stored:
                self._enter(scope)

    def _enter(self, scope: Scope) -> None:
        """A loop with something that is needed is needed itself, and so are those around it."""
        while scope.parent is not None:
            self._of(scope)
            scope = scope.parent

    def _of(self, loop: Scope) -> dict[str, list[int]]:
        return self._live.setdefault(loop, {"carry": [], "item": [], "stacked": []})

    def _roots(self, scope: Scope) -> list[Any]:
        """What a round of a loop is for."""
        if scope.parent is None:
            return []
        live = self._of(scope)
        roots: list[Any] = [scope.end[place] for place in live["carry"]]
        return roots + [scope.stacked[place] for place in live["stacked"]]

    def order(self, scope: Scope, extra: Iterable[Any] = ()) -> tuple[list[Item], list[Number]]:
        """What a scope computes in order, depth first, and the numbers of outer scopes that it needs."""
        if scope in self._orders:
            return self._orders[scope]
        loops = [loop for loop in self._live if loop.parent is scope]
        roots = [*extra, *self._roots(scope), *loops]
        if self.is_uniform:
            roots += self.stored.get(scope, ())
        done: set[Any] = set()
        ordered: list[Item] = []
        outer: dict[Number, None] = {}
        stack: list[tuple[Any, bool]] = [(root, False) for root in reversed(roots)]
        while stack:
            item, is_ready = stack.pop()
            if is_ready:
                ordered.append(item)
                continue
            if isinstance(item, Number):
                if item in done or not self._own(item):
                    continue
                if item.scope is not scope:
                    outer[item] = None
                    continue
            elif not isinstance(item, Scope) or item in done:
                continue
            done.add(item)
            stack.append((item, True))
            stack += [(need, False) for need in reversed(self._needs(item))]
        self._orders[scope] = ordered, list(outer)
        return self._orders[scope]

    def _needs(self, item: Item) -> list[Any]:
        if isinstance(item, Number):
            return [item.extra[0]] if item.op in ("final", "stacked") else list(item.args)
        live = self._of(item)
        needs = [item.start[place] for place in live["carry"]]
        needs += [own for place in live["item"] for own in item.items[place]]
        return needs + self.order(item)[1]

    # Text

    def write(self, code: str) -> str:
        """A line that makes a new value, whose name is returned."""
        self._count += 1
        self.lines.append(f"  %v{self._count} = {code}")
        return f"%v{self._count}"

    def constant(self, value: Symbol) -> str:
        if isinstance(value, bool):
            return f"splat (i1 {str(value).lower()})"
        with np.errstate(over="ignore"):
            bits = int(np.float64(np.float32(value)).view(np.uint64))
        return f"splat (float 0x{bits:016X})"

    def name(self, symbol: Symbol) -> str:
        """How code refers to a number."""
        if not isinstance(symbol, Number):
            return self.constant(symbol)
        if symbol.is_uniform == self.is_uniform:
            return self._names[symbol]
        value = self.spread(self.write(f"load float, ptr {self.slot(symbol)}"))
        return self.write(f"fcmp une {self.type} {value}, zeroinitializer") if symbol.is_mask else value

    def spread(self, scalar: str) -> str:
        """A vector of equal lanes."""
        first = self.write(f"insertelement {self.type} poison, float {scalar}, i32 0")
        return self.write(f"shufflevector {self.type} {first}, {self.type} poison, <{self.lanes} x i32> zeroinitializer")

    def slot(self, number: Number) -> str:
        """Address of a stored number of this round."""
        place = self.stored[number.scope][number]
        return self.write(f"getelementptr float, ptr %store{_id(number.scope)}, i64 {place}")

    def kind(self, symbol: Symbol) -> str:
        is_mask = symbol.is_mask if isinstance(symbol, Number) else isinstance(symbol, bool)
        return self.mask if is_mask else self.type

    def reserve(self, name: str, count: int) -> str:
        size = f"[{count} x {self.type}]"
        self.slots.append(f"  {name} = alloca {size}, align 64")
        return name

    def block(self, scope: Scope) -> None:
        """The code of a scope."""
        for item in self.order(scope)[0]:
            if isinstance(item, Scope):
                self.loop(item)
            else:
                self._names[item] = self.operation(item)
            if self.is_uniform and isinstance(item, Number) and item in self.stored.get(scope, ()):
                value = self._names[item]
                if item.is_mask:
                    value = self.write(f"select {self.mask} {value}, {self.type} {self.constant(1.0)}, {self.type} {self.constant(0.0)}")
                first = self.write(f"extractelement {self.type} {value}, i32 0")
                self.lines.append(f"  store float {first}, ptr {self.slot(item)}")

    def loop(self, loop: Scope) -> None:
        own, live = _id(loop), self._of(loop)
        for place in live["carry"]:
            slot = self.reserve(f"%c{own}_{place}", 1)
            self.put(loop.start[place], slot)
        for place in live["item"]:
            slot = self.reserve(f"%i{own}_{place}", loop.length)
            for index, value in enumerate(loop.items[place]):
                self.put(value, self.write(f"getelementptr {self.type}, ptr {slot}, i64 {index}"))
        for place in live["stacked"]:
            self.reserve(f"%s{own}_{place}", loop.length)
        # A pointer that each round moves on: LLVM takes minutes over addresses that are computed from the round's number.
        size, outer = len(self.stored.get(loop, ())), loop.parent
        first = self.write(f"mul i64 %round{_id(outer)}, {loop.length * size}") if outer and outer.parent else "0"
        self.lines += [f"  %first{own} = getelementptr float, ptr %base{own}, i64 {first}"] if size else []
        self.lines += [f"  br label %before{own}", f"before{own}:", f"  br label %loop{own}", f"loop{own}:"]
        self.lines.append(f"  %n{own} = phi i64 [0, %before{own}], [%m{own}, %end{own}]")
        if size:
            self.lines.append(f"  %store{own} = phi ptr [%first{own}, %before{own}], [%next{own}, %end{own}]")
        above = self.write(f"mul i64 %round{_id(outer)}, {loop.length}") if outer and outer.parent else "0"
        self.lines.append(f"  %round{own} = add i64 {above}, %n{own}")
        self.block(loop)
        ends = [self.name(loop.end[place]) for place in live["carry"]]
        for place, end in zip(live["carry"], ends, strict=True):
            self.lines.append(f"  store {self.type} {end}, ptr %c{own}_{place}, align 4")
        for place in live["stacked"]:
            slot = self.write(f"getelementptr {self.type}, ptr %s{own}_{place}, i64 %n{own}")
            self.put(loop.stacked[place], slot)
        self.lines += [f"  br label %end{own}", f"end{own}:", f"  %m{own} = add i64 %n{own}, 1"]
        self.lines += [f"  %next{own} = getelementptr float, ptr %store{own}, i64 {size}"] if size else []
        self.lines += [f"  %again{own} = icmp ult i64 %m{own}, {loop.length}"]
        self.lines += [f"  br i1 %again{own}, label %loop{own}, label %after{own}", f"after{own}:"]

    def put(self, symbol: Symbol, slot: str) -> None:
        self.lines.append(f"  store {self.type} {self.name(symbol)}, ptr {slot}, align 4")

    def get(self, slot: str) -> str:
        return self.write(f"load {self.type}, ptr {slot}, align 4")

    def operation(self, number: Number) -> str:
        """The code of a number, and its name."""
        op, extra, own = number.op, number.extra, self.type
        match op:
            case "carry":
                return self.get(f"%c{_id(number.scope)}_{extra}")
            case "final":
                return self.get(f"%c{_id(extra[0])}_{extra[1]}")
            case "item":
                slot = f"%i{_id(number.scope)}_{extra}"
                return self.get(self.write(f"getelementptr {own}, ptr {slot}, i64 %n{_id(number.scope)}"))
            case "stacked":
                loop, place, index = extra
                return self.get(self.write(f"getelementptr {own}, ptr %s{_id(loop)}_{place}, i64 {index}"))
            case "given":
                array = self.write(f"load ptr, ptr {self.write(f'getelementptr ptr, ptr %given, i64 {extra[0]}')}")
                return self.spread(self.write(f"load float, ptr {self.write(f'getelementptr float, ptr {array}, i64 {extra[1]}')}"))
            case "lane":
                place = self.write(f"mul i64 %stride, {extra}")
                return self.get(self.write(f"getelementptr float, ptr %x, i64 {place}"))
        args = [self.name(each) for each in number.args]
        if op in _ARITHMETIC:
            return self.write(f"{_ARITHMETIC[op]} {_FLAGS} {own} {args[0]}, {args[1]}")
        if op in _COMPARISON:
            return self.write(f"fcmp {_COMPARISON[op]} {own} {args[0]}, {args[1]}")
        if op in ("max", "min"):
            return self.extreme(number, args)
        if op in _INTRINSICS:
            return self.write(f"call {_FLAGS} {own} @llvm.{_INTRINSICS[op]}.v{self.lanes}f32({own} {args[0]})")
        match op:
            case "neg":
                return self.write(f"fneg {_FLAGS} {own} {args[0]}")
            case "reciprocal":
                return self.write(f"fdiv {_FLAGS} {own} {self.constant(1.0)}, {args[0]}")
            case "select":
                kind = self.kind(number)
                return self.write(f"select {self.mask} {args[0]}, {kind} {args[2]}, {kind} {args[1]}")
            case "and" | "or":
                return self.write(f"{op} {self.mask} {args[0]}, {args[1]}")
            case "not":
                return self.write(f"xor {self.mask} {args[0]}, {self.constant(True)}")
        return self.library(op, args)

    def extreme(self, number: Number, args: list[str]) -> str:
        """The larger or smaller of two; NaN if one of them is."""
        order = "ogt" if number.op == "max" else "olt"
        if not isinstance(number.args[1], Number):
            args = args[::-1]
        chosen = self.write(f"fcmp {order} {self.type} {args[0]}, {args[1]}")
        value = self.write(f"select {self.mask} {chosen}, {self.type} {args[0]}, {self.type} {args[1]}")
        if not all(isinstance(each, Number) for each in number.args):
            return value
        unknown = self.write(f"fcmp uno {self.type} {args[0]}, {args[0]}")
        return self.write(f"select {self.mask} {unknown}, {self.type} {args[0]}, {self.type} {value}")

    def library(self, op: str, args: list[str]) -> str:
        """A function of the C library, lane by lane."""
        value = "poison"
        for lane in range(1 if self.is_uniform else self.lanes):
            scalars = [f"float {self.write(f'extractelement {self.type} {each}, i32 {lane}')}" for each in args]
            called = self.write(f"call float @{op}f({', '.join(scalars)})")
            value = self.write(f"insertelement {self.type} {value}, float {called}, i32 {lane}")
        return self.spread(called) if self.is_uniform else value


def _id(scope: Scope) -> int:
    return scope.index


def module(result: Symbol, root: Scope, lanes: int, arguments: int, version: tuple[int, int]) -> str:
    """LLVM code of a handler for XLA's foreign function interface.

    Its arguments are `arguments` arrays that are the same in all lanes, and one (n, B) with B a multiple of `lanes`; its
    result has (B,).
    """
    vectors = Part(result, lanes)
    uniform = Part(result, lanes, vectors.stored)
    vectors.order(root, [result])
    uniform.block(root)
    vectors.block(root)
    vectors.put(result, "%y")
    bases, place = [], 0
    for scope, numbers in vectors.stored.items():
        name = "store" if scope.parent is None else "base"
        bases.append(f"  %{name}{_id(scope)} = getelementptr float, ptr %memory, i64 {place}")
        place += len(numbers) * scope.rounds
    lines = ["define internal void @uniform(ptr %given, ptr noalias %memory) noinline {", "entry:"]
    lines += [*bases, *uniform.slots, *uniform.lines, "  ret void", "}"]
    lines += ["define internal void @vectors(ptr %memory, ptr noalias %x, ptr noalias %y, i64 %stride) noinline {", "entry:"]
    lines += [*bases, *vectors.slots, *vectors.lines, "  ret void", "}"]
    lines += [_HANDLER.format(size=max(place, 1), arguments=arguments, pointers=arguments + 1, major=version[0], minor=version[1], lanes=lanes)]
    kind = f"<{lanes} x float>"
    lines += [f"declare {kind} @llvm.{name}.v{lanes}f32({kind})" for name in _INTRINSICS.values()]
    lines += [f"declare float @{name}f({'float, float' if name in ('atan2', 'pow') else 'float'})" for name in sorted(_LIBM)]
    return "\n".join(lines)


_HANDLER = """
define ptr @handler(ptr %frame) {{
entry:
  %memory = alloca [{size} x float], align 64
  %p.extension = getelementptr i8, ptr %frame, i64 8
  %extension = load ptr, ptr %p.extension
  %is.call = icmp eq ptr %extension, null
  br i1 %is.call, label %call, label %describe
describe:
  %p.metadata = getelementptr i8, ptr %extension, i64 24
  %metadata = load ptr, ptr %p.metadata
  %p.major = getelementptr i8, ptr %metadata, i64 24
  store i32 {major}, ptr %p.major
  %p.minor = getelementptr i8, ptr %metadata, i64 28
  store i32 {minor}, ptr %p.minor
  %p.traits = getelementptr i8, ptr %metadata, i64 32
  store i32 0, ptr %p.traits
  ret ptr null
call:
  %p.args = getelementptr i8, ptr %frame, i64 72
  %args = load ptr, ptr %p.args
  %p.rets = getelementptr i8, ptr %frame, i64 112
  %rets = load ptr, ptr %p.rets
  %given = alloca [{pointers} x ptr], align 8
  br label %collect
collect:
  %n = phi i64 [0, %call], [%m, %collect]
  %p.buffer = getelementptr ptr, ptr %args, i64 %n
  %buffer = load ptr, ptr %p.buffer
  %p.data = getelementptr i8, ptr %buffer, i64 24
  %data = load ptr, ptr %p.data
  %p.given = getelementptr ptr, ptr %given, i64 %n
  store ptr %data, ptr %p.given
  %m = add i64 %n, 1
  %again = icmp ule i64 %m, {arguments}
  br i1 %again, label %collect, label %run
run:
  %p.dims = getelementptr i8, ptr %buffer, i64 40
  %dims = load ptr, ptr %p.dims
  %p.width = getelementptr i64, ptr %dims, i64 1
  %width = load i64, ptr %p.width
  %result = load ptr, ptr %rets
  %p.result = getelementptr i8, ptr %result, i64 24
  %out = load ptr, ptr %p.result
  call void @uniform(ptr %given, ptr %memory)
  br label %block
block:
  %k = phi i64 [0, %run], [%l, %block]
  %x = getelementptr float, ptr %data, i64 %k
  %y = getelementptr float, ptr %out, i64 %k
  call void @vectors(ptr %memory, ptr %x, ptr %y, i64 %width)
  %l = add i64 %k, {lanes}
  %more = icmp ult i64 %l, %width
  br i1 %more, label %block, label %done
done:
  ret ptr null
}}
"""
