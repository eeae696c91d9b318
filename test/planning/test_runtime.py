"""How JAX is started; in processes of their own, because a backend starts only once."""

import os
import subprocess
import sys

SCRIPT = """
import os
from pathlib import Path
from contact_reach_ros.planning.runtime import configure_jax
configure_jax(Path(os.environ["CACHE"]))
import jax, jax.numpy as jnp
jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x))(jnp.ones((300, 300))).block_until_ready()
names = [open(f"/proc/self/task/{task}/comm").read().strip() for task in os.listdir("/proc/self/task")]
loop = jax.jit(lambda x: jax.lax.fori_loop(0, 9, lambda _, x: jnp.sin(x) + jnp.cos(x)[::-1], x))
whole = "xla_cpu_small_call" in loop.lower(jnp.ones((300, 300))).compile().as_text()
print(whole, sum("XLAEigen" in name for name in names), os.environ.get("NPROC"), os.environ.get("XLA_FLAGS"), sep="|")
"""


def start(tmp_path, script: str = SCRIPT, **environment: str) -> list[str]:
    inherited = {key: value for key, value in os.environ.items() if key not in ("NPROC", "XLA_FLAGS")}
    result = subprocess.run(
        [sys.executable, "-c", script],
        env=inherited | {"CACHE": str(tmp_path)} | environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    assert result.stdout.count("\n") == 1
    return result.stdout.strip().split("|")


def test_one_worker_thread_computes_and_children_do_not_inherit_that(tmp_path):
    _, workers, inherited, _ = start(tmp_path)
    assert workers == "1"
    assert inherited == "None"


def test_compiled_programs_are_kept_and_found_by_the_next_process(tmp_path):
    events = SCRIPT.replace(
        "configure_jax(",
        "import jax\nevents = []\n"
        "jax.monitoring.register_event_listener(lambda event, **_: events.append(event))\nconfigure_jax(",
        1,
    ).replace('os.environ.get("XLA_FLAGS")', '"/jax/compilation_cache/cache_misses" in events')
    assert start(tmp_path, events)[-1] == "True"
    assert start(tmp_path, events)[-1] == "False"
