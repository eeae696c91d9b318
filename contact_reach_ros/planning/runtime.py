"""Configuration of JAX: a thread for each CPU core it may use, or a GPU; compiled programs are kept for later."""

from __future__ import annotations

import os
from pathlib import Path

_OPTIONS = (
    # A loop, however large, becomes one function. By default each of its hundreds of operations is started on its own
    # in each round, which takes longer than many of them.
    "xla_cpu_small_while_loop_byte_threshold=1000000000",
    # Both take a third of the time to compile, and programs are not slower without them, some are faster.
    "xla_cpu_disable_slp_vectorizer=true",
    "xla_cpu_disable_loop_unrolling=true",
)
"""Of XLA's compiler for CPUs, which ignores those that it does not know."""

_FLAGS = {
    # XLA's default of one worker per core costs more than it gains for arrays of this size: idle workers spin on the
    # very cores that run the 1 kHz loops.
    "xla_cpu_multi_thread_eigen": "--xla_cpu_multi_thread_eigen=false",
    "xla_backend_extra_options": f"--xla_backend_extra_options={','.join(_OPTIONS)}",
}
"""By name."""


def configure_jax(cache: Path | None = None) -> None:
    """Start JAX's backend on one thread a core; call it before the first computation.

    Whatever the user has set in XLA_FLAGS or NPROC stays as it is. A backend that is already running
    keeps its threads and flags.

    Parameters
    ----------
    cache
        Folder for compiled programs; None leaves JAX's own setting.
    """
    import jax

    if not _is_running():
        # Not of a backend that is running: it would not have them, but its programs would be kept as if it had.
        flags = os.environ.get("XLA_FLAGS", "")
        missing = (flag for name, flag in _FLAGS.items() if name not in flags)
        os.environ["XLA_FLAGS"] = " ".join((flags, *missing)).strip()
    if cache is not None:
        jax.config.update("jax_compilation_cache_dir", str(cache))
        # The programs are few, and even the quick ones are worth keeping.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # The CPU client reads NPROC once at its start; child processes must not inherit it.
    is_given = "NPROC" in os.environ
    os.environ.setdefault("NPROC", "1")
    try:
        jax.devices()
    finally:
        if not is_given:
            del os.environ["NPROC"]


def _is_running() -> bool:
    """Whether the backend is running already: JAX then refuses another number of devices."""
    import jax

    devices: int = jax.config.jax_num_cpu_devices  # type: ignore[attr-defined]
    try:
        jax.config.update("jax_num_cpu_devices", devices + 2)
    except RuntimeError:
        return True
    jax.config.update("jax_num_cpu_devices", devices)
    return False
