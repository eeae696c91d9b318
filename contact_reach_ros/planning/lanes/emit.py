"""LLVM code of a function's numbers: first of those that are the same in all lanes, then of the others, block by block.

A block has a vector register's lanes. Both parts are straight-line code in loops, depth first, so that few numbers are
alive at a time. The first part stores what the second one needs, for each round of the loops that it is in.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from contact_reach_ros.planning.lanes.graph import COMPARISONS, LOGIC, Memory, Number, Scope, Symbol, is_mask
from contact_reach_ros.planning.lanes.trace import LIBRARY, Trace

_FLAGS = "nsz arcp contract"
"""Products may be fused with sums. NaN and infinity stay what they are, and sums keep their order, on which the
reduction of angles relies."""

_ARITHMETIC = {"add": "fadd", "subtract": "fsub", "multiply": "fmul"}
_INTRINSICS = ("sqrt", "floor", "ceil", "rint", "fabs")
_TWO = ("atan2", "pow")

Stored = dict[Scope, dict[Number, int]]
"""Places of the uniform numbers that the other part needs, by the scope that they are in."""


class Part:
    """One of the two parts, in `lines`; `slots` reserves its memory.

    Parameters
    ----------
    trace
        The function's numbers.
    lanes
        Of a vector. Uniform numbers are vectors too: single ones take as long, and to choose one of two takes a jump.
    stored
        What the other part needs, for that of the uniform numbers.
    """

    def __init__(self, trace: Trace, lanes: int, stored: Stored | None = None) -> None:
        self._lanes, self._type, self._mask = lanes, f"<{lanes} x float>", f"<{lanes} x i1>"
        self._is_uniform = stored is not None
        self.stored: Stored = {} if stored is None else stored
        self.lines: list[str] = []
        self.slots: list[str] = []
        self._names: dict[Any, str] = {}
        self._live: dict[Scope, dict[Memory, None]] = {}
        self._orders: dict[Scope, tuple[list[Any], list[Number]]] = {}
        self._results = [] if self._is_uniform else trace.results
        self._loops = trace.loops
        self._find_live()
        self._block(trace.root)
        for row, result in enumerate(self._results):
            self._put(result, self._write(f"getelementptr float, ptr %y, i64 {self._write(f'mul i64 %stride, {row}')}"))

    def _find_live(self) -> None:
        """What is needed: memories of loops, and numbers of the other part, which it has to store."""
        pending = [*self._results, *(number for numbers in self.stored.values() for number in numbers)]
        done: set[Number] = set()
        while pending:
            number = pending.pop()
            if not isinstance(number, Number) or number in done:
                continue
            done.add(number)
            scope = number.scope
            if number.is_uniform != self._is_uniform:
                numbers = self.stored.setdefault(scope, {})
                numbers[number] = len(numbers)
                continue
            pending += number.args
            if number.op == "read":
                memory = number.extra[0]
                self._live.setdefault(memory.loop, {})[memory] = None
                pending += [*memory.before, memory.end]
            while scope.parent is not None:
                self._live.setdefault(scope, {})
                scope = scope.parent

    def _order(self, scope: Scope) -> tuple[list[Any], list[Number]]:
        """Numbers and loops of a scope in order, and what they need from outside of it."""
        if scope in self._orders:
            return self._orders[scope]
        roots = [] if scope.parent else [*self._results]
        roots += [memory.end for memory in self._live.get(scope, ())]
        roots += [loop for loop in self._loops if loop in self._live and loop.parent is scope]
        roots += self.stored.get(scope, ()) if self._is_uniform else ()
        done: dict[Any, None] = {}
        outer: dict[Number, None] = {}
        ordered: list[Any] = []
        stack: list[tuple[Any, bool]] = [(root, False) for root in reversed(roots)]
        while stack:
            item, is_ready = stack.pop()
            if is_ready:
                ordered.append(item)
            elif isinstance(item, Number) and item.is_uniform == self._is_uniform and item.scope is not scope:
                if item.scope.depth < scope.depth:
                    outer[item] = None
            elif item not in done and (isinstance(item, Scope) or self._is_own(item)):
                done[item] = None
                stack.append((item, True))
                stack += [(need, False) for need in reversed(self._needs(item))]
        self._orders[scope] = ordered, list(outer)
        return self._orders[scope]

    def _is_own(self, symbol: Symbol) -> bool:
        return isinstance(symbol, Number) and symbol.is_uniform == self._is_uniform

    def _needs(self, item: Number | Scope) -> list[Any]:
        """What comes before a number or a loop."""
        if isinstance(item, Scope):
            return [own for memory in self._live[item] for own in memory.before] + self._order(item)[1]
        is_after = item.op == "read" and item.extra[0].loop is not item.scope
        return [item.extra[0].loop] if is_after else list(item.args)

    def _write(self, code: str) -> str:
        """A line that makes a value, whose name is returned."""
        self.lines.append(f"  %v{len(self.lines)} = {code}")
        return f"%v{len(self.lines) - 1}"

    def _block(self, scope: Scope) -> None:
        """The code of a scope."""
        stored = self.stored.get(scope, {}) if self._is_uniform else {}
        for item in self._order(scope)[0]:
            if isinstance(item, Scope):
                self._loop(item)
                continue
            value = self._names[item] = self._operation(item)
            if item in stored:
                if item.is_mask:
                    value = self._choice(value, self._constant(1.0), self._constant(0.0))
                first = self._write(f"extractelement {self._type} {value}, i32 0")
                self.lines.append(f"  store float {first}, ptr {self._slot(item)}")

    def _loop(self, loop: Scope) -> None:
        own, outer, lines = loop.index, loop.parent, self.lines
        for memory in self._live[loop]:
            name = self._names[memory] = f"%m{len(self.slots)}"
            self.slots.append(f"  {name} = alloca [{memory.size} x {self._type}], align 64")
            for index, symbol in enumerate(memory.before):
                self._put(symbol, self._place(memory, str(index)))
        # A pointer that each round moves on: LLVM takes a minute over addresses that depend on the number of the round.
        size, before = len(self.stored.get(loop, ())), "0"
        if outer is not None and outer.parent is not None:
            before = self._write(f"mul i64 %round{outer.index}, {loop.length}")
        first = self._write(f"getelementptr [{size} x float], ptr %base{own}, i64 {before}")
        lines += [f"  br label %before{own}", f"before{own}:", f"  br label %loop{own}", f"loop{own}:"]
        lines.append(f"  %n{own} = phi i64 [0, %before{own}], [%next{own}, %end{own}]")
        lines.append(f"  %store{own} = phi ptr [{first}, %before{own}], [%after{own}, %end{own}]")
        lines.append(f"  %round{own} = add i64 {before}, %n{own}")
        self._block(loop)
        ends = [(self._name(memory.end), memory) for memory in self._live[loop] if memory.end is not None]
        for end, memory in ends:
            place = self._place(memory, "0" if memory.before else f"%n{own}")
            lines.append(f"  store {self._type} {end}, ptr {place}, align 4")
        lines += [f"  br label %end{own}", f"end{own}:", f"  %next{own} = add i64 %n{own}, 1"]
        lines.append(f"  %after{own} = getelementptr float, ptr %store{own}, i64 {size}")
        lines.append(f"  %again{own} = icmp ult i64 %next{own}, {loop.length}")
        lines += [f"  br i1 %again{own}, label %loop{own}, label %done{own}", f"done{own}:"]

    def _constant(self, value: Symbol) -> str:
        if isinstance(value, bool):
            return f"splat (i1 {str(value).lower()})"
        with np.errstate(over="ignore"):
            return f"splat (float 0x{int(np.float64(np.float32(value)).view(np.uint64)):016X})"

    def _name(self, symbol: Symbol) -> str:
        """The value of a symbol."""
        if not isinstance(symbol, Number):
            return self._constant(symbol)
        if self._is_own(symbol):
            return self._names[symbol]
        value = self._spread(self._write(f"load float, ptr {self._slot(symbol)}"))
        return self._write(f"fcmp une {self._type} {value}, zeroinitializer") if symbol.is_mask else value

    def _spread(self, number: str) -> str:
        """A vector of equal lanes."""
        first = self._write(f"insertelement {self._type} poison, float {number}, i32 0")
        return self._write(
            f"shufflevector {self._type} {first}, {self._type} poison, <{self._lanes} x i32> zeroinitializer"
        )

    def _slot(self, number: Number) -> str:
        """Where a uniform number is stored in this round."""
        place = self.stored[number.scope][number]
        return self._write(f"getelementptr float, ptr %store{number.scope.index}, i64 {place}")

    def _place(self, memory: Memory, index: str) -> str:
        return self._write(f"getelementptr {self._type}, ptr {self._names[memory]}, i64 {index}")

    def _put(self, symbol: Symbol, place: str) -> None:
        self.lines.append(f"  store {self._type} {self._name(symbol)}, ptr {place}, align 4")

    def _choice(self, mask: str, yes: str, no: str, kind: str | None = None) -> str:
        kind = kind or self._type
        return self._write(f"select {self._mask} {mask}, {kind} {yes}, {kind} {no}")

    def _operation(self, number: Number) -> str:
        """The code of a number, and its name."""
        op, extra, own = number.op, number.extra, self._type
        match op:
            case "read":
                memory, place = extra
                where = self._place(memory, f"%n{memory.loop.index}" if place is None else str(place))
                return self._write(f"load {own}, ptr {where}, align 4")
            case "given":
                array = self._write(f"load ptr, ptr {self._write(f'getelementptr ptr, ptr %given, i64 {extra[0]}')}")
                place = self._write(f"getelementptr float, ptr {array}, i64 {extra[1]}")
                return self._spread(self._write(f"load float, ptr {place}"))
            case "lane":
                row = self._write(f"mul i64 %stride, {extra[0]}")
                return self._write(f"load {own}, ptr {self._write(f'getelementptr float, ptr %x, i64 {row}')}, align 4")
        args = [self._name(each) for each in number.args]
        if op in _ARITHMETIC:
            return self._write(f"{_ARITHMETIC[op]} {_FLAGS} {own} {', '.join(args)}")
        if op in COMPARISONS:
            return self._write(f"fcmp {COMPARISONS[op]} {own} {', '.join(args)}")
        if op in _INTRINSICS:
            return self._write(f"call {_FLAGS} {own} @llvm.{op}.v{self._lanes}f32({own} {args[0]})")
        if op in LOGIC:
            return self._write(f"{LOGIC[op]} {self._mask} {args[0]}, {(*args, self._constant(True))[1]}")
        match op:
            case "negative":
                return self._write(f"fneg {_FLAGS} {own} {args[0]}")
            case "reciprocal":
                return self._write(f"fdiv {_FLAGS} {own} {self._constant(1.0)}, {args[0]}")
            case "select":
                return self._choice(args[0], args[2], args[1], self._mask if is_mask(number) else own)
            case "maximum" | "minimum":
                return self._extreme(number, *args)
        return self._called(op, args)

    def _extreme(self, number: Number, a: str, b: str) -> str:
        """The larger or the smaller of two; NaN if one of them is: the CPU's instruction returns the second then."""
        if not isinstance(number.args[1], Number):
            a, b = b, a
        order = "ogt" if number.op == "maximum" else "olt"
        value = self._choice(self._write(f"fcmp {order} {self._type} {a}, {b}"), a, b)
        if not all(isinstance(each, Number) for each in number.args):
            return value
        return self._choice(self._write(f"fcmp uno {self._type} {a}, {a}"), a, value)

    def _called(self, op: str, args: list[str]) -> str:
        """A function of the C library, lane by lane."""
        value = "poison"
        for lane in range(1 if self._is_uniform else self._lanes):
            numbers = [self._write(f"extractelement {self._type} {each}, i32 {lane}") for each in args]
            result = self._write(f"call float @{op}f({', '.join(f'float {each}' for each in numbers)})")
            value = self._write(f"insertelement {self._type} {value}, float {result}, i32 {lane}")
        return self._spread(result) if self._is_uniform else value


def module(trace: Trace, lanes: int, arguments: int, version: tuple[int, int]) -> str:
    """LLVM code of a handler of XLA's foreign function interface of that version, for 64 bits.

    It takes `arguments` arrays that are the same in all lanes, and one (n, B) with B a multiple of `lanes`, and returns
    all results (rows, B).
    """
    vectors = Part(trace, lanes)
    uniform = Part(trace, lanes, vectors.stored)
    bases, size = [], 0
    for scope in (trace.root, *trace.loops):
        name = "base" if scope.parent else "store"
        bases.append(f"  %{name}{scope.index} = getelementptr float, ptr %memory, i64 {size}")
        size += len(vectors.stored.get(scope, ())) * scope.rounds
    kind = f"<{lanes} x float>"
    return "\n".join(
        [
            "define internal void @uniform(ptr %given, ptr noalias %memory) noinline {",
            *(*bases, *uniform.slots, *uniform.lines, "  ret void", "}"),
            "define internal void @vectors(ptr %memory, ptr noalias %x, ptr noalias %y, i64 %stride) noinline {",
            *(*bases, *vectors.slots, *vectors.lines, "  ret void", "}"),
            *(f"declare {kind} @llvm.{name}.v{lanes}f32({kind})" for name in _INTRINSICS),
            *(f"declare float @{name}f({'float, ' * (name in _TWO)}float)" for name in (*LIBRARY, "pow")),
            _HANDLER.format(
                size=size + 1, last=arguments, count=arguments + 1, major=version[0], minor=version[1], lanes=lanes
            ),
        ]
    )


_HANDLER = """
%Frame = type {{ i64, ptr, ptr, ptr, i32, {{ i64, ptr, i64, ptr, ptr }}, {{ i64, ptr, i64, ptr, ptr }} }}
%Buffer = type {{ i64, ptr, i32, ptr, i64, ptr }}
%Extension = type {{ i64, i32, ptr, ptr }}
%Metadata = type {{ i64, {{ i64, ptr, i32, i32 }}, i32, i64 }}
define ptr @handler(ptr %frame) {{
  %given = alloca [{count} x ptr]
  %memory = alloca [{size} x float], align 64
  %p.extension = getelementptr %Frame, ptr %frame, i64 0, i32 1
  %extension = load ptr, ptr %p.extension
  %is.call = icmp eq ptr %extension, null
  br i1 %is.call, label %call, label %describe
describe:
  %p.metadata = getelementptr %Extension, ptr %extension, i64 0, i32 3
  %metadata = load ptr, ptr %p.metadata
  %p.major = getelementptr %Metadata, ptr %metadata, i64 0, i32 1, i32 2
  store i32 {major}, ptr %p.major
  %p.minor = getelementptr %Metadata, ptr %metadata, i64 0, i32 1, i32 3
  store i32 {minor}, ptr %p.minor
  ret ptr null
call:
  %p.args = getelementptr %Frame, ptr %frame, i64 0, i32 5, i32 4
  %args = load ptr, ptr %p.args
  %p.rets = getelementptr %Frame, ptr %frame, i64 0, i32 6, i32 4
  %rets = load ptr, ptr %p.rets
  br label %collect
collect:
  %n = phi i64 [0, %call], [%m, %collect]
  %p.buffer = getelementptr ptr, ptr %args, i64 %n
  %buffer = load ptr, ptr %p.buffer
  %p.data = getelementptr %Buffer, ptr %buffer, i64 0, i32 3
  %data = load ptr, ptr %p.data
  %p.given = getelementptr ptr, ptr %given, i64 %n
  store ptr %data, ptr %p.given
  %m = add i64 %n, 1
  %again = icmp ule i64 %m, {last}
  br i1 %again, label %collect, label %run
run:
  %p.dims = getelementptr %Buffer, ptr %buffer, i64 0, i32 5
  %dims = load ptr, ptr %p.dims
  %p.width = getelementptr i64, ptr %dims, i64 1
  %width = load i64, ptr %p.width
  %result = load ptr, ptr %rets
  %p.result = getelementptr %Buffer, ptr %result, i64 0, i32 3
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
