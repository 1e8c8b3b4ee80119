"""The content stamp of a kernel: a digest of its byte code, its constants and all kernels and records that it uses.

Machine code is kept under this stamp, so that a change in another module that a kernel depends on is noticed, and lines that
merely move are not.
"""

import hashlib
from collections.abc import Callable, Iterator
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

from shoal.kernels.types import fields_of, is_record

LIBRARIES = {"math", "cmath", "numpy"}
PLAIN = (int, float, complex, bool, str, bytes, tuple, type(None))


def stamp_of(function: Callable[..., Any], compiled_for: str, stamps: dict[object, str]) -> str:
    """Stamp of a kernel that is compiled for a signature and options. `stamps` has those of the kernels before it, by their
    Python functions. Raises TypeError for a name in the function that a kernel cannot depend on."""
    digest = hashlib.sha256(compiled_for.encode())
    for code in _codes(function.__code__):
        constants = [part for part in code.co_consts if not isinstance(part, CodeType) and part != function.__doc__]
        digest.update(code.co_code)
        digest.update(repr((constants, code.co_names, code.co_varnames)).encode())
        for name in code.co_names:
            if name in function.__globals__:
                digest.update(f"{name}={_content(function, name, stamps)}".encode())
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        digest.update(f"{name}={cell.cell_contents!r}".encode())
    return digest.hexdigest()


def record_content(kind: Any) -> str:
    """Text of a type: of a record (NamedTuple) its name and all its fields, also of records in it."""
    if not is_record(kind):
        return repr(kind)
    fields = ", ".join(f"{name}: {record_content(field)}" for name, field in fields_of(kind).items())
    return f"{kind.__module__}.{kind.__qualname__}({fields})"


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Code of a function and of the functions within it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _content(function: Callable[..., Any], name: str, stamps: dict[object, str]) -> str:
    """Text of a global name's value, as far as machine code depends on it."""
    value = function.__globals__[name]
    kernel = getattr(value, "py_func", None)
    if kernel in stamps:
        return stamps[kernel]
    if isinstance(value, ModuleType) and value.__name__.partition(".")[0] in LIBRARIES:
        return value.__name__
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape}{value.tobytes().hex()}"
    if isinstance(value, type):
        return record_content(value)
    if isinstance(value, PLAIN):
        return repr(value)
    if isinstance(value, BuiltinFunctionType | np.ufunc):
        return value.__name__
    kind = "a function that is no kernel" if isinstance(value, FunctionType) else type(value).__name__
    raise TypeError(f"{function.__module__}.{function.__qualname__}: uses {name}, {kind}: kernels use numbers and kernels")
