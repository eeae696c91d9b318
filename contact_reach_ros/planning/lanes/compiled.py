"""Functions of candidates compiled for this CPU, as operations of XLA's programs."""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import math
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import llvmlite
import llvmlite.binding as llvm
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from contact_reach_ros.planning.lanes.emit import module
from contact_reach_ros.planning.lanes.trace import Trace, UnknownOperationError
from contact_reach_ros.resources import kept

_log = logging.getLogger(__name__)

Function = Callable[[Any, jax.Array], Any]
"""Any tree of arrays (..., B), of what is the same for all candidates, any tree of arrays, and of candidates (n, B)."""


class Compiled:
    """A function, compiled for the CPU that it runs on; programs of JAX may call it, but not differentiate it.

    It stays what it is, for XLA to compile, on another device and, with a warning, where it has an operation that the
    compiler does not know or is too large for it.

    Parameters
    ----------
    function
        To compile.
    source
        What the function differentiates, with the first of what it is given. It returns as much, and is traced in a
        quarter of the time: if its derivative is in the cache, the function is not traced at all.
    """

    def __init__(self, function: Function, source: Compiled | None = None) -> None:
        self._function = function
        self._source = source
        self._found = functools.cache(self._find)

    def __call__(self, given: Any, candidates: jax.Array) -> Any:
        """What the function returns for what it is given and candidates (n, B)."""
        if jax.default_backend() != "cpu":
            return self._function(given, candidates)
        found = self._target(given, len(candidates))
        if found is None:
            return self._function(given, candidates)
        name, results = found
        leaves = [jnp.asarray(leaf, jnp.float32) for leaf in jax.tree.leaves(given)]
        shapes = [each.shape[:-1] for each in jax.tree.leaves(results)]
        count, ends = candidates.shape[1], np.cumsum([math.prod(shape) for shape in shapes])
        filled = jnp.pad(candidates, ((0, 0), (0, -count % _lanes())))
        rows = jax.ShapeDtypeStruct((int(ends[-1]), filled.shape[1]), jnp.float32)
        parts = jnp.split(jax.ffi.ffi_call(name, rows)(*leaves, filled)[:, :count], ends[:-1])
        arrays = [part.reshape(*shape, count) for part, shape in zip(parts, shapes, strict=True)]
        return jax.tree.unflatten(jax.tree.structure(results), arrays)

    def _target(self, given: Any, size: int) -> tuple[str, Any] | None:
        """The name under which XLA finds the compiled function, and the shapes of its results; None without lanes.

        `given` may be shapes; `size` is that of a candidate.
        """
        leaves, tree = jax.tree.flatten(given)
        return self._found(tree, tuple(jax.ShapeDtypeStruct(np.shape(leaf), jnp.float32) for leaf in leaves), size)

    def _find(self, tree: Any, leaves: tuple[Any, ...], size: int) -> tuple[str, Any] | None:
        given = jax.tree.unflatten(tree, leaves)
        try:
            if self._source is None:
                jaxpr, results = self._trace(given, size)
                return _compile(_digest(jaxpr), lambda: jaxpr), results
            found = self._source._target(given[0], size)
            return found and (_compile(f"derivative of {found[0]}", lambda: self._trace(given, size)[0]), found[1])
        except UnknownOperationError as error:
            _warn_once(str(error))
            return None

    def _trace(self, given: Any, size: int) -> tuple[Any, Any]:
        """The closed jaxpr, and the shapes of its results.

        JAX keeps it as long as the object that it traced, which is a passing one here: it would keep constants, too, in
        the precision that they have now.
        """
        candidate = jax.ShapeDtypeStruct((size, 1), jnp.float32)
        return jax.make_jaxpr(functools.partial(self._function), return_shape=True)(given, candidate)


@functools.cache
def _warn_once(reason: str) -> None:
    """Of the cost, its derivative and what a plan shows of it."""
    _log.warning("%s: XLA compiles it, and plans take two to three times as long", reason)


_compiling = threading.Lock()
"""LLVM's objects are for one thread."""
_engines: dict[str, llvm.ExecutionEngine] = {}
"""Hold the code that XLA may call until the process ends, by its name."""


def _compile(digest: str, make: Callable[[], Any]) -> str:
    """The name under which XLA finds a compiled closed jaxpr; its last argument is one candidate.

    `digest` stands for what it computes; `make` returns the jaxpr.
    """
    versions = f"{_compiler()} {llvmlite.__version__} {jax.__version__} {_cpu()} {digest}"
    name = f"contact_reach_{hashlib.sha256(versions.encode()).hexdigest()[:32]}"
    with _compiling:
        if name not in _engines:
            _engines[name] = _engine(name, make)
    return name


def _engine(name: str, make: Callable[[], Any]) -> llvm.ExecutionEngine:
    code = kept((name,), lambda: _machine().emit_object(llvm.parse_assembly(_module(make()))))
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    address = ctypes.c_void_p(engine.get_function_address("handler"))
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")
    return engine


def _module(jaxpr: Any) -> str:
    """LLVM code of a closed jaxpr, for the version of the interface that the installed JAX has."""
    header = (Path(jax.ffi.include_dir()) / "xla/ffi/api/c_api.h").read_text(encoding="utf-8")
    major, minor = re.findall(r"#define XLA_FFI_API_(?:MAJOR|MINOR) (\d+)", header)
    return module(Trace(jaxpr), _lanes(), len(jaxpr.jaxpr.invars) - 1, (int(major), int(minor)))


def _digest(closed: Any) -> str:
    """Hash of all that a closed jaxpr computes, and of its own rules of differentiation."""
    return hashlib.sha256(repr([str(closed), *_unwritten(closed)]).encode()).hexdigest()


def _unwritten(closed: Any) -> Iterator[Any]:
    """What the text of a closed jaxpr lacks: values of constants, and rules of differentiation."""
    yield [np.asarray(each).tolist() for each in closed.consts]
    for equation in closed.jaxpr.eqns:
        if equation.primitive.name == "custom_jvp_call":
            rule = _rule(equation)
            yield str(rule), [np.asarray(each).tolist() for each in rule.consts]
        for value in equation.params.values():
            if isinstance(value, ClosedJaxpr):
                yield from _unwritten(value)


def _rule(equation: Any) -> Any:
    """The closed jaxpr by which an equation is differentiated that has a rule of its own."""
    variables = [each for each in equation.invars if not isinstance(each, Literal)]
    about = equation.params["call_jaxpr"].jaxpr.debug_info
    alone = ClosedJaxpr(Jaxpr((), variables, equation.outvars, [equation], debug_info=about), ())
    own = [jax.ShapeDtypeStruct(each.aval.shape, each.aval.dtype) for each in variables]
    return jax.make_jaxpr(functools.partial(jax.jvp, jaxpr_as_fun(alone)))(own, own)


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
