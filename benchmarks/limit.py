"""A solver step beside the least time that its arithmetic takes on this CPU.

The least time counts the operations that candidates need, after the compiler has removed what is known or unused: one
instruction each, none for a product that one sum alone takes, at the rate at which one core multiplies and adds in
registers. Functions such as sine count as one too, and drawing candidates and ranking them as none, so no program
reaches it. Both times are the least CPU time of several, in turns.
"""

from __future__ import annotations

import ctypes
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import llvmlite.binding as llvm
import numpy as np

from benchmarks.output import Report, command_line, given, machine, run_command, table, write_report
from benchmarks.scaling import TimedSolver, make_timed
from contact_reach_ros.arms import load_arm
from contact_reach_ros.planning.lanes.compiled import Compiled, Function
from contact_reach_ros.planning.lanes.graph import Number
from contact_reach_ros.planning.lanes.trace import Trace
from contact_reach_ros.planning.settings import PlanningSettings
from contact_reach_ros.planning.solver.hybrid import slopes
from contact_reach_ros.planning.transfer.arithmetic import single

_ROUNDS, _EVALUATIONS, _REPEATS = 10_000_000, 20, 10
_SUMS = ("add", "subtract")
_FREE = ("given", "lane", "read", "negative")
"""Loads that come with an instruction, and signs."""


def bench_limit(scenes: Sequence[str] = ("free", "ball", "wall"), file: Path | None = None) -> Report:
    """Time everything; print a table in Markdown and write JSON to `file`."""
    lanes = 16 if llvm.get_host_cpu_features().get("avx512f") else 8
    run = _multiply_and_add(lanes)
    rows = []
    for scene in scenes:
        planner, request, solver = make_timed(scene, load_arm(), PlanningSettings())
        planner.plan(request)
        operations, evaluate = _operations(solver, lanes), _evaluations(solver)
        rate, step_s, candidates_s = 0.0, math.inf, math.inf
        for _ in range(_REPEATS):
            planner.plan(request)
            step_s, candidates_s = min(step_s, solver.step_s), min(candidates_s, evaluate())
            rate = max(rate, run())
        times = {"least_ms": 1e3 * operations / rate, "candidates_ms": 1e3 * candidates_s, "step_ms": 1e3 * step_s}
        rows.append({"scene": scene, "operations": operations, "rate": rate, **times})
    names = ["scene", "vector operations", "a ns", "least, ms", "candidates, ms", "ratio", "whole step, ms"]
    print(table(names, map(_cells, rows)))
    report: Report = {"bench": "limit", "machine": machine(), "lanes": lanes, "rows": rows}
    write_report(report, file)
    return report


def _cells(row: Report) -> list[str]:
    least, own, step = (row[f"{name}_ms"] for name in ("least", "candidates", "step"))
    counts = [f"{row['operations']:,.0f}", f"{1e-9 * row['rate']:.2f}"]
    return [row["scene"], *counts, f"{least:.2f}", f"{own:.2f}", f"{own / least:.1f}", f"{step:.2f}"]


def _functions(solver: TimedSolver) -> list[tuple[Function, Any, jax.Array, int]]:
    """What a step evaluates: function, what is given, candidates, and how often."""
    size, problem = solver.size, solver.problem
    points = single(np.random.default_rng(0).uniform(-0.3, 0.3, (size, solver.population)))
    slope = partial(slopes, solver.cost)
    return [(solver.cost, problem, points, 2), (slope, (problem, points[:, :1]), single(np.eye(size)), 1)]


def _operations(solver: TimedSolver, lanes: int) -> float:
    """Vector operations of one solver step: the costs of two populations, and one derivative for each variable."""
    total = 0.0
    for function, problem, candidates, times in _functions(solver):
        shaped = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), np.float32), (problem, candidates[:, :1])
        )
        own = live_operations(Trace(jax.make_jaxpr(function)(*shaped)), lanes)
        total += times * math.ceil(candidates.shape[1] / lanes) * own
    return total


def _evaluations(solver: TimedSolver) -> Callable[[], float]:
    """A function that measures the CPU time, s, of one step's evaluations."""
    runs = [
        (partial(jax.jit(Compiled(function)), problem, candidates), times)
        for function, problem, candidates, times in _functions(solver)
    ]

    def measure() -> float:
        total = 0.0
        for run, times in runs:
            spent = []
            for _ in range(_EVALUATIONS):
                began = time.process_time()
                jax.block_until_ready(run())
                spent.append(time.process_time() - began)
            total += times * min(spent)
        return total

    return measure


def live_operations(trace: Trace, lanes: int) -> float:
    """Operations on vectors of candidates that the results of a function need; of a number for all of them, a lane."""
    uses: Counter[Number] = Counter()
    pending: list[Any] = [*trace.results]
    while pending:
        symbol = pending.pop()
        if not isinstance(symbol, Number):
            continue
        uses[symbol] += 1
        if uses[symbol] == 1:
            memory = symbol.extra[0] if symbol.op == "read" else None
            pending += [*memory.before, memory.end] if memory else symbol.args
    total = 0.0
    for number in uses:
        count = number.scope.rounds / (lanes if number.is_uniform else 1)
        total += count * (number.op not in _FREE)
        total -= count * (number.op in _SUMS and any(_is_fused(each, uses) for each in number.args))
    return total


def _is_fused(symbol: Any, uses: Counter[Number]) -> bool:
    return isinstance(symbol, Number) and symbol.op == "multiply" and uses[symbol] == 1


_KERNEL = """
declare {kind} @llvm.fma.v{lanes}f32({kind}, {kind}, {kind})
define float @run(i64 %n) {{
entry:
  br label %loop
loop:
  %i = phi i64 [0, %entry], [%j, %loop]
{phis}
{bodies}
  %j = add i64 %i, 1
  %again = icmp ult i64 %j, %n
  br i1 %again, label %loop, label %done
done:
{sums}
  %r = extractelement {kind} %s{last}, i32 0
  ret float %r
}}
"""
_CHAINS = 12
"""Independent sums: as many as hide the latency of one."""


def _multiply_and_add(lanes: int) -> Callable[[], float]:
    """A function that measures how many vectors a second one core multiplies and adds."""
    kind, own = f"<{lanes} x float>", range(_CHAINS)
    half = f"{kind} splat (float 5.0e-01)"
    code = _KERNEL.format(
        kind=kind,
        lanes=lanes,
        last=_CHAINS - 1,
        phis="\n".join(f"  %a{k} = phi {kind} [splat (float {k + 1}.0), %entry], [%b{k}, %loop]" for k in own),
        bodies="\n".join(f"  %b{k} = call {kind} @llvm.fma.v{lanes}f32({kind} %a{k}, {half}, {half})" for k in own),
        sums="\n".join(f"  %s{k} = fadd {kind} %b{k}, {f'%s{k - 1}' if k else '%b0'}" for k in own),
    )
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    features = llvm.get_host_cpu_features()
    # LLVM would halve vectors of 16 lanes on some CPUs.
    text = features.flatten() + ",-prefer-256-bit" * (lanes == 16)
    target = llvm.Target.from_default_triple()
    host = target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=text, opt=2, jit=True)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(code), host)
    engine.finalize_object()
    function = ctypes.CFUNCTYPE(ctypes.c_float, ctypes.c_int64)(engine.get_function_address("run"))

    def run(_engine: object = engine) -> float:
        began = time.process_time()
        function(_ROUNDS)
        return _CHAINS * _ROUNDS / (time.process_time() - began)

    return run


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = command_line(__doc__)
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help="names or YAML files (default: free ball wall)")
    bench_limit(**given(parser, arguments))


if __name__ == "__main__":
    run_command(main)
