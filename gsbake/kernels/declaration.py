"""Declaration of the compiled kernels: each has one signature, so that it can be compiled before anything calls it.

    @kernel("f4[:, ::1], i8[::1], f8", nogil=True)
    def sums(values, rows, factor): ...

Numba compiles a function for the types that it is first called with, inside the call. A declared kernel is an ordinary Numba dispatcher
beside its signature: `compile_module` compiles all kernels of a module, or loads them from Numba's cache on the disk. Types are Numba's,
as text: `f4[:, ::1]` is a contiguous float32 array of two dimensions, `i8` a 64-bit integer, `b1` a boolean.

Functions that only kernels call need no declaration; they are compiled with the kernel, and take over its fast-math flags unless they name
their own. What kernels with and without such flags call must name them: its rounding would depend on which is compiled first.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numba
from numba.core import types
from numba.core.sigutils import normalize_signature

#: {module: its kernels with their signatures}, in the order of the declarations.
_DECLARED: dict[str, list[tuple[Any, str | tuple[Any, ...]]]] = {}
#: {module: functions that build its kernels for the usual numbers of channels}.
_FACTORIES: dict[str, list[Callable[[], object]]] = {}


def kernel(signature: str | tuple[Any, ...], **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorator of a compiled kernel with one signature: the types of its arguments, as text or as a tuple of Numba types.

    `options` are those of `numba.njit`; the kernel is kept in Numba's cache.
    """

    def declare(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**({"cache": True} | options))(function)
        _DECLARED.setdefault(function.__module__, []).append((dispatcher, signature))
        return dispatcher

    return declare


def also_built_by(module: str, *factories: Callable[[], object]) -> None:
    """Say that `factories` declare kernels of `module` when they are called, such as one for each number of channels."""
    _FACTORIES.setdefault(module, []).extend(factories)


def argument_types(signature: str | tuple[Any, ...]) -> tuple[Any, ...]:
    """The Numba types of a signature. Raises TypeError or NameError for one that Numba does not understand."""
    if not isinstance(signature, str):
        return signature
    names = {name: value for name, value in vars(types).items() if not name.startswith("_")}
    parsed = eval(f"({signature},)", {"__builtins__": {}}, names)  # the text is our own source code
    arguments, _ = normalize_signature(tuple(parsed))
    return tuple(arguments)


def declared(module: str) -> list[tuple[Any, tuple[Any, ...]]]:
    """The kernels of `module`, which is imported, as (dispatcher, types of the arguments)."""
    importlib.import_module(module)
    for factory in _FACTORIES.get(module, []):
        factory()
    return [(dispatcher, argument_types(signature)) for dispatcher, signature in _DECLARED.get(module, [])]


def compile_module(module: str) -> int:
    """Compile the kernels of `module` or load them from the cache; returns their number."""
    kernels = declared(module)
    for dispatcher, arguments in kernels:
        dispatcher.compile(arguments)
    return len(kernels)

