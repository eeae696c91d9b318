"""Compiled programs that are kept whole between processes: where one is known, it is neither traced nor compiled.

JAX's own cache spares a process the compilation, but not the tracing and lowering before it, which take most of a
start. Here a program is found by what it is made of: the sources of the package, the values that its function holds,
its arguments' shapes, JAX and the machine. A function that holds anything of unknown kind, such as a cost term or a
solver from elsewhere, is compiled by JAX in each process. So is one that calls other libraries than LAPACK.

Equal operations of a program are merged before XLA sees it. XLA does so itself, first of all for several cores and late
for one, and simplifies in between: without this, programs for one and for several cores would round differently.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import os
import platform
import threading
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar, copy_context
from enum import Enum
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax.experimental import serialize_executable
from jax.experimental.compilation_cache import compilation_cache
from jax.extend.mlir.passmanager import PassManager

from contact_reach_ros.planning.cores import on_each
from contact_reach_ros.planning.terms import TERMS
from contact_reach_ros.resources import PACKAGE, KeptFile

_ROOMS = ("arm", "control", "planning")
"""Folders of the package that the functions and types of programs come from."""

_FOLDER = "programs"
_CACHE = "jax_enable_compilation_cache"


class UnknownValueError(Exception):
    """A function holds a value of which it is not known how to tell it from others."""


_preparing = ContextVar("preparing", default=False)


@contextlib.contextmanager
def preparing() -> Iterator[None]:
    """Within it, programs that are called for the first time are loaded, or compiled and stored."""
    token = _preparing.set(True)
    try:
        yield
    finally:
        _preparing.reset(token)


def at_once(*calls: Callable[[], Any]) -> list[Any]:
    """What these calls return, each made in a thread of its own: XLA compiles on as many cores as there are threads."""
    with ThreadPoolExecutor(len(calls)) as threads:
        return [done.result() for done in [threads.submit(copy_context().run, call) for call in calls]]


class Program:
    """A function of arrays as a compiled program, for one core or for several; calls are those of `jax.jit`."""

    def __init__(self, function: Callable[..., Any], cores: int = 1) -> None:
        self._function = function
        self._cores = cores
        self._compile = jax.jit(on_each(function, cores))
        self._ready: dict[tuple[Any, ...], Callable[..., Any]] = {}

    def __call__(self, *arguments: Any) -> Any:
        """Run the program; for shapes that it was not prepared for, it is compiled first."""
        shapes = tuple(getattr(argument, "shape", None) for argument in arguments)
        if shapes not in self._ready:
            ready = self._prepare(*arguments) if _preparing.get() else None
            self._ready[shapes] = ready or self._lower(*arguments).compile()
        with contextlib.suppress(TypeError):  # the arrays within the arguments have other shapes
            return self._ready[shapes](*arguments)
        return self._compile(*arguments)

    def _lower(self, *arguments: Any) -> jax.stages.Lowered:
        """The program for arguments of these shapes, without repetitions."""
        lowered = self._compile.lower(*arguments)
        module: Any = lowered.compiler_ir("stablehlo")
        with module.context:
            PassManager.parse("builtin.module(cse)").run(module.operation)
        return lowered

    def _prepare(self, *arguments: Any) -> Callable[..., Any] | None:
        """Load the program for arguments of these shapes, or compile and store it; None if it is none to be kept."""
        try:
            known = KeptFile(_FOLDER, str(self._cores), *_parts(self._function, arguments))
        except UnknownValueError:
            return None
        text = known.load()
        ready = None if text is None else _load(text, self._cores)
        if ready is not None:
            return ready
        lowered = self._lower(*arguments)
        source = lowered.as_text()
        if source.count("custom_call @") > source.count("custom_call @lapack_"):
            return None
        # Other sources often make the same program.
        text = hashlib.sha256(source.encode()).hexdigest()
        ready = _load(text, self._cores)
        if ready is None:
            # XLA cannot serialise a program that came from JAX's cache.
            with _without_cache:
                ready = lowered.compile()
            _compiled(text).store(serialize_executable.serialize(ready))
        known.store(text)
        return ready


def _compiled(text: str) -> KeptFile:
    """The file of the program with this digest of its text."""
    return KeptFile(_FOLDER, *_surroundings(), text)


def _load(text: str, cores: int) -> Callable[..., Any] | None:
    """The program with this digest of its text, for so many cores; None if it is not there, or cannot be loaded."""
    content = _compiled(text).load()
    if content is None:
        return None
    _start_lapack()
    try:
        payload, in_tree, out_tree = content
        program: Callable[..., Any] = serialize_executable.deserialize_and_load(
            payload, in_tree, out_tree, execution_devices=jax.devices()[:cores]
        )
    except Exception:  # XLA raises whatever another machine's program leads to
        return None
    return program


@functools.cache
def _start_lapack() -> None:
    """Have JAX start LAPACK for programs that are loaded: it does so while it lowers one that calls it."""
    jax.jit(jnp.linalg.cholesky).lower(np.eye(1, dtype=np.float32))


class _WithoutCache:
    """Keeps JAX's own cache out of compilations, of which several may go on at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._count = 0
        self._before = True

    def __enter__(self) -> None:
        with self._lock:
            if not self._count:
                self._before = jax.config.values[_CACHE]
                self._use(False)
            self._count += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._count -= 1
            if not self._count:
                self._use(self._before)

    @staticmethod
    def _use(use: bool) -> None:
        jax.config.update(_CACHE, use)
        compilation_cache.reset_cache()


_without_cache = _WithoutCache()


def _parts(function: Callable[..., Any], arguments: Sequence[Any]) -> tuple[Any, ...]:
    """All that a program is made of, the same on any day.

    Raises
    ------
    UnknownValueError
        If the function holds a value of unknown kind.
    """
    leaves, structure = jax.tree.flatten(arguments)
    shapes = [str(jax.typeof(leaf)) for leaf in leaves]
    return *_surroundings(), _sources(), describe(function), describe(dict(TERMS)), str(structure), shapes


def _surroundings() -> tuple[Any, ...]:
    """What programs depend on besides their functions."""
    config = sorted((name, repr(value)) for name, value in jax.config.values.items() if "cache" not in name)
    return _machine(), jax.__version__, jaxlib.__version__, config, os.environ.get("XLA_FLAGS", "")


@functools.cache
def _sources() -> str:
    """Digest of the package's sources, all of them: constants of any may have gone into a program."""
    digest = hashlib.sha256()
    for file in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()


@functools.cache
def _machine() -> tuple[str, ...]:
    """The machine that programs are compiled for: its processor's features too, which caches on shared disks mix up."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    features = next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
    return platform.machine(), features, jax.devices()[0].device_kind, str(len(jax.devices()))


def describe(value: Any) -> Any:
    """A value as nested tuples of texts, equal for equal values only.

    Raises
    ------
    UnknownValueError
        If the value is of unknown kind.
    """
    match value:
        case None | bool() | int() | float() | str() | bytes():
            return repr(value)
        case np.ndarray() | np.generic() | jax.Array():
            array = np.asarray(value)
            return (str(array.dtype), array.shape, hashlib.sha256(array.tobytes()).hexdigest())
        case Enum():
            return (describe(type(value)), value.name)
        case Mapping():
            return tuple((describe(key), describe(entry)) for key, entry in value.items())
        case tuple() | list():
            return (_name(type(value)), *(describe(entry) for entry in value))
        case types.MethodType():
            return (describe(value.__func__), describe(value.__self__))
        case types.FunctionType():
            held = [cell.cell_contents for cell in value.__closure__ or ()]
            # Functions without a name are told apart by their place.
            place = (_name(value), value.__code__.co_firstlineno)
            return (*place, describe(held), describe(value.__defaults__), describe(value.__kwdefaults__))
        case functools.partial():
            return (describe(value.func), describe(value.args), describe(value.keywords))
        case type():
            return _name(value)
    if dataclasses.is_dataclass(value):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    else:
        fields = {name: held for name, held in vars(value).items() if not isinstance(held, Program)}
    return (_name(type(value)), describe(fields))


def _name(kind: type | types.FunctionType) -> str:
    """Name of a type or function whose source is known."""
    room = kind.__module__.removeprefix(f"{PACKAGE}.").partition(".")[0]
    if kind.__module__ != "builtins" and (not kind.__module__.startswith(PACKAGE) or room not in _ROOMS):
        raise UnknownValueError(f"{kind.__module__}.{kind.__qualname__}")
    return f"{kind.__module__}.{kind.__qualname__}"
