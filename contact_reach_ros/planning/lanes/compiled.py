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
from contact_reach_ros.planning.lanes.evaluate import Evaluation
from contact_reach_ros.planning.lanes.symbols import UnknownPrimitiveError
from contact_reach_ros.planning.settings import XLA
from contact_reach_ros.resources import cache_directory

_log = logging.getLogger(__name__)

Function = Callable[[Any, jax.Array], jax.Array]
"""(B,) of what is the same for all candidates, any tree of numbers, and of candidates (n, B)."""


def by_lanes(function: Function, backend: str) -> Function:
    """The function, compiled for the CPU that it is called on, for use inside of programs of JAX.

    It stays as it is for another device, with the backend "xla", and, with a warning, where it has an operation that
    the compiler does not know. The compiled one cannot be differentiated.
    """

    @functools.cache
    def target(tree: Any, shapes: tuple[tuple[int, ...], ...], size: int) -> str | None:
        def of_one(leaves: list[jax.Array], candidate: jax.Array) -> jax.Array:
            return function(jax.tree.unflatten(tree, leaves), candidate)

        given = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
        try:
            return _target(jax.make_jaxpr(of_one)(given, jax.ShapeDtypeStruct((size, 1), jnp.float32)))
        except UnknownPrimitiveError as error:
            _log.warning("%s; the cost runs in XLA, which takes three times as long", error)
            return None

    def call(given: Any, points: jax.Array) -> jax.Array:
        if backend == XLA or jax.default_backend() != "cpu":
            return function(given, points)
        leaves, tree = jax.tree.flatten(given)
        leaves = [jnp.asarray(leaf, jnp.float32) for leaf in leaves]
        name = target(tree, tuple(leaf.shape for leaf in leaves), points.shape[0])
        if name is None:
            return function(given, points)
        count = points.shape[1]
        filled = jnp.pad(points, ((0, 0), (0, -count % _lanes())))
        result = jax.ShapeDtypeStruct(filled.shape[1:], jnp.float32)
        values: jax.Array = jax.ffi.ffi_call(name, result)(*leaves, filled)
        return values[:count]

    return call


def _target(jaxpr: Any) -> str:
    """Name under which XLA finds the compiled function of a closed jaxpr, whose last argument is a candidate (n, 1)."""
    key = hashlib.sha256(f"{llvmlite.__version__} {_sources()} {_cpu()} {_lanes()}".encode())
    _fingerprint(jaxpr, key)
    name = f"contact_reach_{key.hexdigest()[:32]}"
    if name not in _engines:
        code = _kept(name, lambda: _machine().emit_object(llvm.parse_assembly(_module(jaxpr))))
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        _engines[name] = engine
        address = ctypes.c_void_p(engine.get_function_address("handler"))
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")
    return name


_engines: dict[str, llvm.ExecutionEngine] = {}
"""What holds the code, by the name of the function; XLA calls it until the process ends."""


def _module(jaxpr: Any) -> str:
    *given, candidate = (variable.aval for variable in jaxpr.jaxpr.invars)
    evaluation = Evaluation(jaxpr, given, candidate)
    return module(evaluation.result, evaluation.graph.root, _lanes(), len(given), _interface_version())


def _fingerprint(jaxpr: Any, key: Any) -> None:
    """Everything that a closed jaxpr computes, into a hash."""
    names: dict[Any, int] = {}

    def name(variable: Any) -> str:
        if isinstance(variable, Literal):
            return f"{variable.val!r}" if np.ndim(variable.val) == 0 else f"{np.asarray(variable.val).tolist()}"
        return str(names.setdefault(variable, len(names)))

    def digest(closed: Any) -> None:
        own = closed.jaxpr
        key.update(f"{[(name(each), str(each.aval)) for each in (*own.constvars, *own.invars)]}".encode())
        for constant in closed.consts:
            key.update(np.asarray(constant).tobytes())
        for equation in own.eqns:
            key.update(f"{equation.primitive.name} {[name(each) for each in equation.invars]}".encode())
            for option, value in equation.params.items():
                if hasattr(value, "jaxpr"):
                    digest(value)
                elif not callable(value):
                    key.update(f"{option} {value}".encode())
            key.update(f"{[(name(each), str(each.aval)) for each in equation.outvars]}".encode())
        key.update(f"{[name(each) for each in own.outvars]}".encode())

    digest(jaxpr)


def _kept(name: str, make: Callable[[], bytes]) -> bytes:
    """The code of this name out of the user's cache, else made and kept there; code that is damaged is made anew."""
    try:
        file = cache_directory() / f"{name}.lanes"
    except ContactReachError:
        return make()
    with contextlib.suppress(OSError):
        digest, code = (content := file.read_bytes())[:32], content[32:]
        if digest == hashlib.sha256(name.encode() + code).digest():
            return code
    code = make()
    with contextlib.suppress(OSError):
        new = file.with_suffix(f".{os.getpid()}")
        new.write_bytes(hashlib.sha256(name.encode() + code).digest() + code)
        new.replace(file)
    return code


@functools.cache
def _cpu() -> tuple[str, str]:
    """Name and features of this CPU, as LLVM has them."""
    features = llvm.get_host_cpu_features()
    # Else vectors of 16 lanes would be two of 8 on some CPUs.
    return llvm.get_host_cpu_name(), ",".join((features.flatten(), "-prefer-256-bit") if features.get("avx512f") else (features.flatten(),))


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


@functools.cache
def _interface_version() -> tuple[int, int]:
    """Version of XLA's foreign function interface in the JAX that is installed."""
    header = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text(encoding="utf-8")
    major, minor = (re.search(rf"#define XLA_FFI_API_{part} (\d+)", header) for part in ("MAJOR", "MINOR"))
    assert major is not None and minor is not None
    return int(major[1]), int(minor[1])


@functools.cache
def _sources() -> str:
    """Hash of this compiler."""
    files = sorted(Path(__file__).parent.glob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
