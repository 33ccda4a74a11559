"""Compile plain Python functions with Numba, for loops of millions of steps.

The motion model, the filter and the rules of the simulated town are plain Python functions on
numbers and arrays. A replay calls them uncompiled. The Monte Carlo studies call ``kept(f)``, which
compiles ``f`` and every crosscue function that it calls. Numba is imported only then.
"""

import hashlib
import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., object])

_PACKAGE = __name__.rpartition(".")[0].partition(".")[0]


def compile_function(function: Function) -> Function:
    """Compile a function and every crosscue function that it calls."""
    return cast("Function", _dispatcher(function))


def kept(function: Function) -> Function:
    """Like ``compile_function``, with a cache on disk, valid until one of the sources changes."""
    return cast("Function", _kept(function))


@cache
def _dispatcher(function: FunctionType) -> Any:
    from numba import njit

    return njit(nogil=True, error_model="numpy", forceinline=True)(_bound(function))


@cache
def _kept(function: FunctionType) -> Any:
    from numba import njit

    bound = _bound(function)
    # Numba's cache identifies a function by its own file and name only.
    bound.__qualname__ += f"_{fingerprint(function)[:16]}"
    try:
        return njit(cache=True, nogil=True, error_model="numpy")(bound)
    except RuntimeError:  # no writable cache folder
        return njit(nogil=True, error_model="numpy")(bound)


def _bound(function: FunctionType) -> FunctionType:
    """Return a copy of the function that calls the compiled versions of crosscue functions."""
    names = function.__globals__ | {
        name: _dispatcher(called) for name, called in _called(function).items()
    }
    bound = FunctionType(function.__code__, names, function.__name__, function.__defaults__)
    bound.__module__, bound.__qualname__ = function.__module__, function.__qualname__
    return bound


def _called(function: FunctionType) -> dict[str, FunctionType]:
    """Return the functions of this package that ``function`` calls by a global name."""
    found = {name: function.__globals__.get(name) for name in _names(function.__code__)}
    return {
        name: value
        for name, value in found.items()
        if isinstance(value, FunctionType) and value.__module__.partition(".")[0] == _PACKAGE
    }


def _names(code: CodeType) -> list[str]:
    inner = [const for const in code.co_consts if isinstance(const, CodeType)]
    return sorted({*code.co_names, *(name for one in inner for name in _names(one))})


@cache
def fingerprint(function: FunctionType) -> str:
    """Return the SHA-256 of the source files of a function and of all crosscue code it calls."""
    files = {__file__}
    waiting, seen = [function], {function}
    while waiting:
        one = waiting.pop()
        files.add(inspect.getfile(one))
        more = set(_called(one).values()) - seen
        seen |= more
        waiting += more
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(hashlib.sha256(Path(path).read_bytes()).digest())
    return digest.hexdigest()
