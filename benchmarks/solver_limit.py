"""How near a solver step comes to what one core can do: its arithmetic, counted, at speeds that are measured beside it.

The arithmetic is counted in the traced programs, operation by operation and as often as loops run, by kinds that
processors treat alike; a product that only one addition uses is one operation with it. The speed of each kind is that
of XLA programs that do nothing else, several independent chains of them side by side, on arrays that stay in the first
cache: what a longer one takes more than a shorter one, so that starting them does not count. The limit is the time that
the counted operations would take at these speeds: no memory is read, nothing is computed twice, and nothing waits.
"""

from __future__ import annotations

import functools
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from contact_reach_ros.arrays import Array
from contact_reach_ros.experiments.output import Report, table
from contact_reach_ros.planning.solver.hybrid import HybridSolver

_SUMS = ("add", "sub", "add_any")
_KINDS = {
    "add": (*_SUMS, "neg", "reduce_sum", "cumsum"),
    "multiply": ("mul", "square", "integer_pow"),
    "compare": ("max", "min", "abs", "select_n", "clamp", "lt", "le", "gt", "ge", "eq", "ne", "reduce_max", "sign"),
    "divide": ("div", "rem"),
    "root": ("sqrt", "rsqrt"),
    "sine": ("sin", "cos"),
    "exponential": ("exp", "expm1", "log", "log1p", "erf_inv", "pow", "logistic"),
}
"""Operations of JAX by kind; others move data, or are too few to matter."""

_SIZE, _SHORT, _LONG, _SLOW = 4096, 4, 36, 4
"""Numbers in an array of the measured programs, and operations of a chain in two of them, whose difference is taken.

Slow kinds have fewer, by this factor.
"""

_ABREAST = 8
"""So many hide how long each operation takes to be done, and still leave registers free."""


def count_operations(function: Callable[..., Any], *arguments: Any) -> Counter[str]:
    """Operations on single numbers by kind, also those of matrix products."""
    return _count(jax.make_jaxpr(function)(*arguments).jaxpr)


def _count(jaxpr: Any) -> Counter[str]:
    total: Counter[str] = Counter()
    single: set[Any] = set()
    uses = Counter(variable for equation in jaxpr.eqns for variable in equation.invars if not _is_literal(variable))
    uses.update(variable for variable in jaxpr.outvars if not _is_literal(variable))
    products: set[Any] = set()
    for equation in jaxpr.eqns:
        name, parameters = equation.primitive.name, equation.params
        times = parameters["length"] if name == "scan" else 1
        if name == "dot_general":
            axes, shape = parameters["dimension_numbers"][0][0], equation.invars[0].aval.shape
            size = int(np.prod([shape[axis] for axis in axes]) * equation.outvars[0].aval.size)
            total["multiply-add"] += size
        if name == "broadcast_in_dim" and equation.invars[0].aval.size == 1:
            single.update(equation.outvars)
        kind = next((kind for kind, names in _KINDS.items() if name in names), None)
        if kind == "divide" and (equation.invars[1].aval.size == 1 or equation.invars[1] in single):
            kind = "scale"
        if kind is not None:
            # Sums count their terms.
            source = equation.invars[0] if name.startswith(("reduce", "cumsum")) else equation.outvars[0]
            size = int(source.aval.size * (abs(parameters["y"]) - 1 if name == "integer_pow" else 1))
            if name == "mul" and uses[equation.outvars[0]] == 1:
                products.add(equation.outvars[0])
            if name in _SUMS and (fused := next((term for term in equation.invars if _in(term, products)), None)):
                products.discard(fused)
                total["multiply"] -= size
                kind = "multiply-add"
            total[kind] += size
        for value in parameters.values():
            for inner in value if isinstance(value, list | tuple) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    total.update({kind: times * count for kind, count in _count(inner).items()})
    return total


def _is_literal(variable: Any) -> bool:
    """Whether an operand of a traced program is a constant in its text."""
    return hasattr(variable, "val")


def _in(variable: Any, variables: set[Any]) -> bool:
    return not _is_literal(variable) and variable in variables


CHAINS: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
    "add": lambda x, one: x + one,
    "multiply": lambda x, one: x * one,
    "multiply-add": lambda x, one: x * one + one,
    "compare": lambda x, one: jnp.maximum(x, one),
    # By one number, as in `lanes.make_keep`: compilers multiply by its inverse.
    "scale": lambda x, one: x / one,
    # With an addition, or XLA would make multiplications of a chain of divisions.
    "divide": lambda x, one: one / (x + one),
    "root": lambda x, one: jnp.sqrt(x),
    "sine": lambda x, one: jnp.sin(x),
    "exponential": lambda x, one: jnp.exp(x),
}
"""One operation of each kind, on numbers and on a number near one."""


class OperationClock:
    """Measures the time of one operation of each kind on this core, better with each call of `measure`."""

    def __init__(self) -> None:
        self._least: dict[tuple[str, int], float] = {}

    def measure(self, repetitions: int) -> None:
        """Run every program that often; there are no loops in them, which options of XLA would change."""
        one = np.linspace(1.0, 1.0 + 1e-6, 8).astype(np.float32)
        for kind in CHAINS:
            for length in _lengths(kind):
                program = make_chain(kind, length)
                fastest = min(_seconds(program, np.full(_SIZE, 0.7, np.float32), one) for _ in range(repetitions))
                self._least[kind, length] = min(fastest, self._least.get((kind, length), np.inf))

    @property
    def times(self) -> dict[str, float]:
        """Least time of one operation by kind, s."""
        times = {}
        for kind in CHAINS:
            short, long = _lengths(kind)
            count = _SIZE * _ABREAST * (long - short)
            times[kind] = (self._least[kind, long] - self._least[kind, short]) / count
        return {**times, "divide": times["divide"] - times["add"]}


def _lengths(kind: str) -> tuple[int, int]:
    factor = _SLOW if kind in ("sine", "exponential") else 1
    return _SHORT // factor, _LONG // factor


@functools.cache
def make_chain(kind: str, length: int) -> Callable[[Array, Array], jax.Array]:
    """Compile a program of so many operations of a kind in each chain, for numbers (n,) and eight near one (8,)."""

    def run(x: jax.Array, one: jax.Array) -> jax.Array:
        # Different numbers, or XLA would join the operations, or the chains.
        values = [x * one[first] for first in range(_ABREAST)]
        for index in range(length):
            values = [CHAINS[kind](value, one[(first + index) % len(one)]) for first, value in enumerate(values)]
        return functools.reduce(jnp.add, values)

    program = jax.jit(run)
    jax.block_until_ready(program(np.zeros(_SIZE, np.float32), np.ones(8, np.float32)))
    return program


def _seconds(program: Callable[..., Any], *arguments: Any) -> float:
    begin = time.perf_counter()
    jax.block_until_ready(program(*arguments))
    return time.perf_counter() - begin


def measure_limit(solver: HybridSolver[Any], problem: Any, state: Any, rounds: int = 40) -> Report:
    """A step of Algorithm 1 against its limit, and where the rest goes, by parts; times are the least of all rounds.

    The speeds of the core, the parts and whole steps are measured in turns, and the least times are those of a core
    that nobody else used.
    """
    calls = solver.parts(problem, state)
    programs = {name: jax.jit(function) for name, (function, _) in calls.items()}
    empty = jax.jit(lambda *arguments: jnp.zeros(()))
    clock = OperationClock()
    times: dict[str, list[float]] = {name: [] for name in (*calls, "dispatch", "step")}
    for number in range(rounds):
        if number % 4 == 0:
            clock.measure(20)
        for name, (_, arguments) in calls.items():
            times[name] += [_seconds(programs[name], *arguments) for _ in range(3)]
        times["dispatch"] += [_seconds(empty, problem, state) for _ in range(3)]
        times["step"].append(solver.warm_up(problem, state))
    speed = clock.times
    counts = {name: count_operations(function, *arguments) for name, (function, arguments) in calls.items()}
    limits = {name: sum(count * speed[kind] for kind, count in counts[name].items()) for name in calls}
    least = {name: min(values) for name, values in times.items()}
    return {
        "ns_per_operation": {kind: 1e9 * value for kind, value in speed.items()},
        "parts": {
            name: {"operations": dict(counts[name]), "limit_ms": 1e3 * limits[name], "ms": 1e3 * least[name]}
            for name in calls
        },
        "limit_ms": 1e3 * sum(limits.values()),
        "step_ms": 1e3 * least["step"],
        "ratio": least["step"] / sum(limits.values()),
        "dispatch_ms": 1e3 * least["dispatch"],
        "between_ms": 1e3 * (least["step"] - sum(least[name] for name in calls)),
    }


def limit_table(report: Report, scenes: Sequence[str]) -> str:
    """A table in Markdown: one row for each part of a step."""
    rows = []
    for name in scenes:
        found = report[name]["limit"]
        for part, row in found["parts"].items():
            operations = sum(row["operations"].values()) / 1e6
            ratio = row["ms"] / row["limit_ms"]
            rows.append([name, part, f"{operations:.2f}", f"{row['limit_ms']:.2f}", f"{row['ms']:.2f}", f"{ratio:.1f}"])
        rows.append(
            [name, "call of the program, and copies between its parts", "", "", f"{found['between_ms']:.2f}", ""]
        )
        total = f"{found['limit_ms']:.2f}", f"{found['step_ms']:.2f}", f"{found['ratio']:.1f}"
        rows.append([name, f"whole step; an empty program: {found['dispatch_ms']:.2f} ms", "", *total])
    return table(["scene", "part", "million operations", "limit, ms", "least, ms", "ratio"], rows)
