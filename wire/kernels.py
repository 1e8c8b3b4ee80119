"""Compile numeric kernels: plain loops over float64 arrays, written like the equations and as fast as C.

A kernel is a function of arrays and numbers at module level. Its class checks inputs and owns memory; the kernel checks
nothing.
Rules: it calls only kernels of its own module (Numba's cache notices a change of the kernel's file alone), it raises nothing,
and it writes its results into arrays that the caller passes. `NUMBA_DISABLE_JIT=1` runs all of them as Python.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(signature: str) -> Callable[[F], F]:
    """Compile a function for the argument types of `signature`, for example ``"void(f8[:,::1], f8)"``.

    Compilation happens when the module is imported for the first time, never at a call; the machine code is kept on disk
    (in `NUMBA_CACHE_DIR`, else beside the module). Without the interpreter's lock; IEEE arithmetic: division by zero gives
    infinity, as in NumPy, and sums are never reordered.
    """
    return cast(Callable[[F], F], numba.njit(signature, cache=True, nogil=True, error_model="numpy", fastmath=False))
