"""How JAX is started; in processes of their own, because a backend starts only once."""

import os

from contact_reach_command import python

SCRIPT = """
import os, sys
from pathlib import Path
import jax, jax.numpy as jnp
from contact_reach_ros.planning.runtime import configure_jax
events = []
jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
configure_jax(Path(sys.argv[1]))
jax.jit(lambda x: jnp.sin(x) @ jnp.cos(x))(jnp.ones((300, 300))).block_until_ready()
names = [open(f"/proc/self/task/{task}/comm").read() for task in os.listdir("/proc/self/task")]
missed = "/jax/compilation_cache/cache_misses" in events
print(sum("XLAEigen" in name for name in names), os.environ.get("NPROC"), missed)
"""


def start(cache) -> list[str]:
    """Number of worker threads, what children inherit, and whether a program was compiled."""
    environment = {key: value for key, value in os.environ.items() if key not in ("NPROC", "XLA_FLAGS")}
    return python(SCRIPT, str(cache), env=environment).split()


def test_one_worker_thread_computes_and_the_next_process_finds_the_programs(tmp_path):
    assert start(tmp_path) == ["1", "None", "True"]
    assert start(tmp_path) == ["1", "None", "False"]
