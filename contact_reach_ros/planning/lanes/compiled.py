"""Functions of candidates compiled for this CPU, as operations of XLA's programs."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import logging
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import llvmlite
import llvmlite.binding as llvm
import numpy as np
from jax.extend.core import Literal

from contact_reach_ros.errors import ContactReachError
from contact_reach_ros.planning.lanes.emit import module
from contact_reach_ros.planning.lanes.trace import Trace, UnknownOperationError
from contact_reach_ros.planning.settings import XLA
from contact_reach_ros.resources import cache_directory

_log = logging.getLogger(__name__)

Function = Callable[[Any, jax.Array], jax.Array]
"""(B,) of what is the same for all candidates, any tree of arrays, and of candidates (n, B)."""


def by_lanes(function: Function, backend: str) -> Function:
    """The function, compiled for the CPU that it runs on; programs of JAX may call it, but not differentiate it.

    It stays what it is, for XLA to compile, on another device, with the backend "xla", and, with a warning, where it
    has an operation that the compiler does not know or is too large for it.
    """

    @functools.cache
    def target(tree: Any, shapes: tuple[tuple[int, ...], ...], size: int) -> str | None:
        def of_one(leaves: list[jax.Array], candidate: jax.Array) -> jax.Array:
            return function(jax.tree.unflatten(tree, leaves), candidate)

        given = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
        try:
            return _target(jax.make_jaxpr(of_one)(given, jax.ShapeDtypeStruct((size, 1), jnp.float32)))
        except UnknownOperationError as error:
            _log.warning("%s: XLA compiles it, and plans take two to three times as long", error)
            return None

    def call(given: Any, candidates: jax.Array) -> jax.Array:
        if backend == XLA or jax.default_backend() != "cpu":
            return function(given, candidates)
        leaves, tree = jax.tree.flatten(given)
        leaves = [jnp.asarray(leaf, jnp.float32) for leaf in leaves]
        name = target(tree, tuple(leaf.shape for leaf in leaves), len(candidates))
        if name is None:
            return function(given, candidates)
        count = candidates.shape[1]
        filled = jnp.pad(candidates, ((0, 0), (0, -count % _lanes())))
        values: jax.Array = jax.ffi.ffi_call(name, jax.ShapeDtypeStruct(filled.shape[1:], jnp.float32))(*leaves, filled)
        return values[:count]

    return call


_engines: dict[str, llvm.ExecutionEngine] = {}
"""Hold the code that XLA may call until the process ends, by its name."""


def _target(jaxpr: Any) -> str:
    """The name under which XLA finds the compiled function of a closed jaxpr; its last argument is one candidate."""
    key = hashlib.sha256(f"{_compiler()} {llvmlite.__version__} {jax.__version__} {_cpu()}".encode())
    _digest(jaxpr, key)
    name = f"contact_reach_{key.hexdigest()[:32]}"
    if name not in _engines:
        code = _kept(name, lambda: _machine().emit_object(llvm.parse_assembly(_module(jaxpr))))
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        address = ctypes.c_void_p(engine.get_function_address("handler"))
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")
        _engines[name] = engine
    return name


def _module(jaxpr: Any) -> str:
    """LLVM code of a closed jaxpr, for the version of the interface that the installed JAX has."""
    header = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text(encoding="utf-8")
    major, minor = re.findall(r"#define XLA_FFI_API_(?:MAJOR|MINOR) (\d+)", header)
    return module(Trace(jaxpr), _lanes(), len(jaxpr.jaxpr.invars) - 1, (int(major), int(minor)))


def _digest(closed: Any, key: Any) -> None:
    """All that a closed jaxpr computes, into a hash, in a tenth of the time that its text takes."""
    names: dict[Any, int] = {}

    def name(variable: Any) -> object:
        if isinstance(variable, Literal):
            return np.asarray(variable.val).tolist()
        return names.setdefault(variable, len(names)), variable.aval.shape, variable.aval.dtype.name

    def add(*parts: Any) -> None:
        key.update(repr(parts).encode())

    jaxpr = closed.jaxpr
    add(
        [name(each) for each in (*jaxpr.constvars, *jaxpr.invars)],
        [np.asarray(each).tolist() for each in closed.consts],
    )
    for equation in jaxpr.eqns:
        add(equation.primitive.name, [name(each) for each in (*equation.invars, *equation.outvars)])
        for option, value in equation.params.items():
            if hasattr(value, "jaxpr"):
                _digest(value, key)
            elif not callable(value):
                add(option, value)
    add([name(each) for each in jaxpr.outvars])


def _kept(name: str, make: Callable[[], bytes]) -> bytes:
    """Code out of the user's cache; it is made, and kept there, if it is not there or damaged."""
    try:
        file = cache_directory() / name
    except ContactReachError:
        return make()
    with contextlib.suppress(OSError):
        content = file.read_bytes()
        if content[:32] == hashlib.sha256(name.encode() + content[32:]).digest():
            return content[32:]
    code = make()
    with contextlib.suppress(OSError):
        new = file.with_suffix(f".{os.getpid()}")
        new.write_bytes(hashlib.sha256(name.encode() + code).digest() + code)
        new.replace(file)
    return code


@functools.cache
def _compiler() -> str:
    """Hash of this compiler's source: what an earlier one made is made anew."""
    return hashlib.sha256(
        b"".join(file.read_bytes() for file in sorted(Path(__file__).parent.glob("*.py")))
    ).hexdigest()


@functools.cache
def _cpu() -> tuple[str, str]:
    """Name and features of this CPU, as LLVM has them."""
    features = llvm.get_host_cpu_features()
    # LLVM would halve vectors of 16 lanes on some CPUs.
    return llvm.get_host_cpu_name(), features.flatten() + ",-prefer-256-bit" * features.get("avx512f", False)


@functools.cache
def _lanes() -> int:
    """Single-precision numbers in a vector register of this CPU."""
    features = llvm.get_host_cpu_features()
    return 16 if features.get("avx512f") else 8 if features.get("avx") else 4


@functools.cache
def _machine() -> llvm.TargetMachine:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    name, features = _cpu()
    return llvm.Target.from_default_triple().create_target_machine(cpu=name, features=features, opt=2, jit=True)
