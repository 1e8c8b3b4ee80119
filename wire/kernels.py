"""Compile numeric kernels: plain loops over float64 arrays, written like the equations and as fast as C.

A kernel is a function of arrays and numbers at module level. Its class checks inputs and owns memory; the kernel checks
nothing.
Rules: it calls only kernels of its own module (Numba's cache notices a change of the kernel's file alone), it raises nothing,
and it writes its results into arrays that the caller passes. `NUMBA_DISABLE_JIT=1` runs all of them as Python.
"""

import logging
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_log = logging.getLogger("shoal")


class KernelCache:
    """Machine code on disk. `writable` is False once there was no folder to keep it in."""

    writable = True


CACHE = KernelCache()


def kernel(signature: str, inline: bool = False, part: bool = False) -> Callable[[F], F]:
    """Compile a function for the argument types of `signature`, for example ``"void(f8[:,::1], f8)"``.

    Compilation happens when the module is imported for the first time, never at a call; the machine code is kept on disk
    (in `NUMBA_CACHE_DIR`, else beside the module, else in the user's cache). Where none of these can be written, kernels are
    compiled at every start, and the log says so once. Without the interpreter's lock; IEEE arithmetic: division by zero gives
    infinity, as in NumPy, and sums are never reordered. With `inline` the kernel becomes part of those that call it, so that
    their loops can run in vector registers.

    A kernel that is only a `part` of others is compiled with them, for its signature, and not loaded by itself: half of a
    robot's kernels are, and each would take up to 3 MB more.
    """

    def compiled(function: F) -> F:
        if CACHE.writable:
            try:
                return _compile(signature, function, inline, part, cache=True)
            except RuntimeError as error:
                if "no locator available" not in str(error):
                    raise
                CACHE.writable = False
                _log.warning("no folder to keep compiled kernels in: every start compiles them (set NUMBA_CACHE_DIR)")
        return _compile(signature, function, inline, part, cache=False)

    return compiled


def _compile(signature: str, function: F, inline: bool, part: bool, cache: bool) -> F:
    jit = partial(numba.njit, cache=cache, nogil=True, error_model="numpy", fastmath=False, forceinline=inline)
    if not part:
        return cast(F, jit(signature)(function))
    compiled: Any = jit()(function)
    if hasattr(compiled, "overloads"):  # not with NUMBA_DISABLE_JIT
        template = compiled.get_call_template

        def declared(*called_with: Any) -> Any:
            if not compiled.overloads:
                compiled.compile(signature)
                compiled.disable_compile()
            return template(*called_with)

        compiled.get_call_template = declared  # what a kernel that calls this one asks for
    return cast(F, compiled)
