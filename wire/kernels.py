"""Compile numeric kernels: plain loops over float64 arrays, written like the equations and as fast as C.

A kernel is a function of arrays and numbers at module level. Its class checks inputs and owns memory; the kernel checks
nothing.
Rules: it calls only kernels, it raises nothing, and it writes its results into arrays that the caller passes.
`NUMBA_DISABLE_JIT=1` runs all of them as Python.
"""

import pickle
from collections.abc import Callable
from typing import Any, TypeVar, cast

import llvmlite
import numba
from numba.core import caching, compiler, config, serialize

from wire import kernel_build, kernel_cache
from wire.kernel_stamp import stamp_of

F = TypeVar("F", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False, "no_cfunc_wrapper": True}
VERSIONS = f"numba {numba.__version__}, llvmlite {llvmlite.__version__}"

stamps: dict[object, str] = {}  # of each kernel, by its Python function
listeners: list[Callable[[str, bool], None]] = []  # called when a kernel is ready: with its file ("" for a part), if compiled


def kernel(signature: str, inline: bool = False, part: bool = False) -> Callable[[F], F]:
    """Compile a function for the argument types of `signature`, for example ``"void(f8[:,::1], f8)"``.

    Compilation happens when the module is imported, never at a call; machine code is kept on disk (`wire/kernel_cache.py`).
    The first kernel that is missing there has all kernels of its package compiled (`wire/kernel_build.py`).
    Without the interpreter's lock; IEEE arithmetic: division by zero gives infinity, as in NumPy, and sums are never
    reordered. With `inline` the kernel becomes part of those that call it, so that their loops can run in vector registers.

    A kernel that is only a `part` of others is compiled with them, for its signature, and neither kept nor loaded by itself:
    half of a robot's kernels are, and each would take up to 3 MB more.
    """

    def compiled(function: F) -> F:
        if config.DISABLE_JIT:  # type: ignore[attr-defined]
            return function
        stamps[function] = stamp_of(function, f"{signature} {inline}", stamps)
        dispatcher: Any = numba.njit(forceinline=inline, **OPTIONS)(function)
        file = KernelFile(function)
        if part:
            _compile_when_called(dispatcher, signature)
        else:
            dispatcher._cache = file
            dispatcher.compile(signature)
            dispatcher.disable_compile()
        for listener in listeners:
            listener(file.name, file.was_missing)
        return cast(F, dispatcher)

    return compiled


def _compile_when_called(dispatcher: Any, signature: str) -> None:
    """Have a kernel compiled when one that calls it is, for its own signature rather than for the call's types."""
    template = dispatcher.get_call_template
    if kernel_build.is_worker():
        dispatcher.targetoptions["no_cpython_wrapper"] = True  # no test calls it here: 4 % less time

    def declared(*call_types: Any) -> Any:
        if not dispatcher.overloads:
            dispatcher.compile(signature)
            dispatcher.disable_compile()
        return template(*call_types)

    dispatcher.get_call_template = declared


class KernelFile(caching.NullCache):
    """The file of a kernel's machine code, as Numba's dispatcher asks for it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._full_name = f"{function.__module__}.{function.__qualname__}"
        self.name = ""  # of the file; known when it is looked for
        self.was_missing = False

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compiled kernel, or None if it has to be compiled here."""
        target.refresh()
        built_for = f"{stamps[self._function]} {VERSIONS} {target.codegen().magic_tuple()}"
        self.name = kernel_cache.file_name(self._full_name, built_for)
        loaded = self._load(target)
        if loaded is None and kernel_build.build_package_of(self.name, self._function.__code__.co_filename):
            loaded = self._load(target)
        return loaded

    def _load(self, target: Any) -> Any:
        content = kernel_cache.read(self.name)
        if content is None:
            return None
        try:
            return compiler.CompileResult._rebuild(target, *pickle.loads(content))  # type: ignore[no-untyped-call]
        except Exception as error:  # whatever it is that cannot be loaded: compiled again, it can
            kernel_cache.discard(self.name, f"cannot be loaded ({type(error).__name__}: {error})")
            return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep a kernel that has just been compiled."""
        self.was_missing = True
        kernel_cache.write(self.name, serialize.dumps(result._reduce()))  # type: ignore[no-untyped-call]
