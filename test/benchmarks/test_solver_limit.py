"""What is counted as the arithmetic of a solver step."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from contact_reach_ros.cli import main
from contact_reach_ros.experiments.solver_limit import CHAINS, count_operations, make_chain

X = np.ones((3, 50), np.float32)


def test_operations_are_counted_by_kind_and_as_often_as_loops_run():
    def function(x: jax.Array) -> jax.Array:
        x, _ = jax.lax.scan(lambda x, _: (jnp.sin(x) * x + 1.0, None), x, length=4)
        return jnp.sqrt(x @ x.T / 2.0)

    found = +count_operations(function, X)
    assert found == {"sine": 600, "multiply-add": 600 + 450, "scale": 9, "root": 9}


def test_a_product_is_one_operation_with_a_sum_only_if_nothing_else_needs_it():
    def function(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        used_twice = x * x
        return used_twice + 1.0, used_twice - x * 2.0

    assert count_operations(function, X) == {"multiply": 150, "add": 150, "multiply-add": 150}


def test_count_is_that_of_xla_where_there_is_no_loop():
    def function(x: jax.Array) -> jax.Array:
        return jnp.maximum(x * x - 2.0, x) / (x + 3.0)

    found = count_operations(jax.jit(function), X)
    counted = sum(found.values()) + found["multiply-add"]
    assert counted == jax.jit(function).lower(X).cost_analysis()["flops"]


@pytest.mark.parametrize("kind", CHAINS)
def test_the_measured_programs_do_what_they_are_named_after(kind):
    def added(length: int) -> Counter[str]:
        """What `length` more operations add; the shortest chain has one."""
        return count_operations(make_chain(kind, 1 + length), *inputs) - count_operations(make_chain(kind, 1), *inputs)

    inputs = np.ones(16, np.float32), np.ones(8, np.float32)
    expected = Counter({kind: 2 * 8 * 16})
    assert added(2) == expected + Counter({"add": 2 * 8 * 16} if kind == "divide" else {})


@pytest.mark.slow
def test_a_step_takes_longer_than_its_limit(tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        main(["bench", "planner", "--limit", "--quick", "--scene", "free", "--json", str(tmp_path / "report.json")])
    assert end.value.code == 0
    rows = [line.split("|") for line in capsys.readouterr().out.splitlines() if line.startswith("| free |")]
    whole = rows[-1]
    assert "whole step" in whole[2] and float(whole[6]) > 1.0 and len(rows) == 8
