"""SHELL: compile numeric kernels: plain loops over float64 arrays, written like the equations and as fast as C.

A kernel is a function of numbers, arrays and records at module level; its annotations say which (`types.py`). Its
class checks inputs and owns memory; the kernel checks nothing.

    @kernel
    def deliver(pulse: Ints, legs: ThrusterLegs, wrench: Floats) -> None: ...

Rules: at most 8 parameters, the others grouped in records (NamedTuple) of at most 16 numbers, or of arrays. Constants are
records that are built once and kept; what changes at each call is built at the call. Memory that changes is an array in a
kept record. Small results are returned as records, large ones written into arrays that the caller passes. A kernel calls only
kernels, of any module, and raises nothing. `NUMBA_DISABLE_JIT=1` runs all of them as Python.
"""

import functools
import os
import pickle
import sys
from collections.abc import Callable
from typing import Any, TypeVar, cast, get_type_hints, overload

import llvmlite
import numba
from numba.core import caching, compiler, config, serialize, types
from numba.core.runtime.nrt import rtsys
from numba.extending import typeof_impl

from shoal.kernels import build as kernel_build
from shoal.kernels import cache as kernel_cache
from shoal.kernels.stamp import record_content, stamp_of
from shoal.kernels.types import misfits, signature_of

F = TypeVar("F", bound=Callable[..., Any])

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False, "no_cfunc_wrapper": True}
VERSIONS = f"numba {numba.__version__}, llvmlite {llvmlite.__version__}"
CHECK_ALL = os.environ.get("SHOAL_CHECK_KERNELS") == "1"  # more than the first call: tests/conftest.py sets it
CHECK_EVERY = 16  # calls: of these one is checked whatever its line has passed before; all of them cost a third of a flight

stamps: dict[object, str] = {}  # of each kernel, by its Python function
listeners: list[Callable[[str, bool], None]] = []  # called when a kernel is ready: with its file ("" for a part), if compiled


@overload
def kernel(function: F) -> F: ...


@overload
def kernel(*, inline: bool = False, part: bool = False) -> Callable[[F], F]: ...


def kernel(function: Any = None, *, inline: bool = False, part: bool = False) -> Any:
    """Compile a function for the types of its annotations.

    Compilation happens when the module is imported, never at a call; machine code is kept on disk (`shoal/kernels/cache.py`).
    The first kernel that is missing there has all kernels of its package compiled (`shoal/kernels/build.py`).
    Without the interpreter's lock; IEEE arithmetic: division by zero gives infinity, as in NumPy, and sums are never
    reordered. With `inline` the kernel becomes part of those that call it, so that their loops can run in vector registers.

    A kernel that is only a `part` of others is compiled with them, for its signature, and neither kept nor loaded by itself:
    half of a robot's kernels are, and each would take up to 3 MB more.
    """
    if function is None:
        return lambda decorated: _compiled(decorated, inline, part)
    return _compiled(function, inline, part)


def _compiled(function: F, inline: bool, part: bool) -> F:
    """The kernel of a function, from the cache or compiled now."""
    if config.DISABLE_JIT:  # type: ignore[attr-defined]
        return function
    signature = signature_of(function)
    compiled_for = ", ".join(map(record_content, get_type_hints(function, include_extras=True).values()))
    stamps[function] = stamp_of(function, f"{compiled_for} {inline}", stamps)
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
    return cast(F, Kernel(function, dispatcher, signature))


class Kernel:
    """A compiled function. From Python it is called by the entry of its machine code, which looks at no types and is several
    times faster than Numba's choice among signatures: so the first call is checked."""

    def __init__(self, function: Callable[..., Any], dispatcher: Any, signature: Any) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self.dispatcher = dispatcher
        self._signature = signature
        self._entry: Callable[..., Any] | None = None
        self._is_checked = False
        self._checked: dict[int, tuple[Any, ...]] = {}  # the last record in each place
        self._passed: set[tuple[Any, ...]] = set()  # calling lines, each with the classes of its arguments
        self._calls = 0

    def __call__(self, *arguments: Any) -> Any:
        """Run the machine code."""
        if not self._is_checked:
            if CHECK_ALL:
                self._check_if_unlike_others(arguments)
            else:
                self.check(arguments)
                self._is_checked = True
        return self._entry(*arguments)  # type: ignore[misc]

    def _check_if_unlike_others(self, arguments: tuple[Any, ...]) -> None:
        """Check the first call from a place in the code with arguments of these classes, and one call of many."""
        caller = sys._getframe(2)
        call = (caller.f_code, caller.f_lasti, *map(type, arguments))
        self._calls += 1
        if call not in self._passed or not self._calls % CHECK_EVERY:
            self.check(arguments)
            self._passed.add(call)

    def check(self, arguments: tuple[Any, ...]) -> None:
        """Raises TypeError unless the arguments are of the types that the kernel is compiled for."""
        if not self.dispatcher.overloads:  # a part that somebody calls by itself
            self.dispatcher.compile(self._signature)
            self.dispatcher.disable_compile()
        (self._entry,) = (result.entry_point for result in self.dispatcher.overloads.values())
        names = self.py_func.__code__.co_varnames[: self.py_func.__code__.co_argcount]
        if len(arguments) != len(names):
            raise TypeError(f"{self.py_func.__qualname__}: {len(arguments)} arguments, takes {len(names)}")
        for place, value in enumerate(arguments):
            if value is self._checked.get(place):
                continue
            for misfit in misfits(value, self._signature.args[place], names[place]):
                raise TypeError(f"{self.py_func.__qualname__}: {misfit}")
            if isinstance(value, tuple):  # a record never changes: one that is kept and passed again is not looked at again
                self._checked[place] = value


@typeof_impl.register(Kernel)
def _type_in_other_kernels(value: Kernel, context: object) -> Any:
    return types.Dispatcher(value.dispatcher)


def _compile_when_called(dispatcher: Any, signature: Any) -> None:
    """Have Numba compile a kernel for its declared `signature` when another kernel that calls it is compiled.

    Numba would compile it for the types of that call. It asks the dispatcher for a template of the call first: so the
    compilation for the signature stands before that.
    """
    numbas_template = dispatcher.get_call_template
    if kernel_build.is_worker():
        dispatcher.targetoptions["no_cpython_wrapper"] = True  # no test calls it here: 4 % less time

    def compile_then_template(*call_types: Any) -> Any:
        if not dispatcher.overloads:
            dispatcher.compile(signature)
            dispatcher.disable_compile()
        return numbas_template(*call_types)

    dispatcher.get_call_template = compile_then_template


class KernelFile(caching.NullCache):
    """The file of a kernel's machine code, as Numba's dispatcher asks for it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self._full_name = f"{function.__module__}.{function.__qualname__}"
        self.name = ""  # of the file; known when it is looked for
        self.was_missing = False

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compiled kernel, or None if it has to be compiled here."""
        rtsys.initialize(target)  # names that machine code refers to; target.refresh() would also import the compiler's parts
        built_for = f"{stamps[self._function]} {VERSIONS} {target.codegen().magic_tuple()}"
        self.name = kernel_cache.file_name(self._full_name, built_for)
        loaded = self._load(target)
        if loaded is None and kernel_build.build_package_of(self.name, self._function.__code__.co_filename):
            loaded = self._load(target)
        return loaded

    def _load(self, target: Any) -> Any:
        """The machine code from disk; None if there is none that can be loaded."""
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
