"""Types of compiled kernels from their annotations, and a check of values against them.

A kernel takes numbers, arrays, tuples and records (NamedTuple, also nested), and returns numbers, tuples, records or nothing:

    Table = Annotated[NDArray[np.float64], 2]        # dimensions; in C order

    class ThrusterLegs(NamedTuple):
        place: Table
        idle_n: float
"""

import inspect
from collections.abc import Callable, Iterator
from functools import cache
from typing import Annotated, Any, cast, get_args, get_origin, get_type_hints

import numba
import numpy as np
from numba.core import types
from numba.np.numpy_support import as_dtype
from numpy.typing import NDArray

Floats = Annotated[NDArray[np.float64], 1]
Table = Annotated[NDArray[np.float64], 2]
Cube = Annotated[NDArray[np.float64], 3]
Ints = Annotated[NDArray[np.int64], 1]
IntTable = Annotated[NDArray[np.int64], 2]
SingleTable = Annotated[NDArray[np.float32], 2]
SingleCube = Annotated[NDArray[np.float32], 3]
Image = Annotated[NDArray[np.uint8], 3]
Bools = Annotated[NDArray[np.bool_], 1]
Complexes = Annotated[NDArray[np.complex128], 1]  # x + iy
ComplexTable = Annotated[NDArray[np.complex128], 2]

MOST_PARAMETERS = 8  # more have to be grouped in records, or nobody knows which number is which
SCALARS = {float: types.float64, int: types.int64, bool: types.boolean, complex: types.complex128, type(None): types.void}


def signature_of(function: Callable[..., Any]) -> Any:
    """Numba's signature of an annotated function. Raises TypeError for a parameter that a kernel cannot take."""
    name = f"{function.__module__}.{function.__qualname__}"
    hints = get_type_hints(function, include_extras=True)
    parameters = list(inspect.signature(function).parameters)
    if len(parameters) > MOST_PARAMETERS:
        raise TypeError(f"{name}: {len(parameters)} parameters (at most {MOST_PARAMETERS}): group them in records")
    for parameter in [*parameters, "return"]:
        if parameter not in hints:
            raise TypeError(f"{name}: {parameter} has no annotation")
    return _numba_type(hints["return"])(*(_numba_type(hints[parameter]) for parameter in parameters))


def is_record(kind: object) -> bool:
    """True for a NamedTuple's class."""
    return isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields")


@cache
def fields_of(record: Any) -> dict[str, Any]:
    """Annotations of a record's fields, in their order."""
    hints = get_type_hints(record, include_extras=True)
    return {field: hints[field] for field in record._fields}


@cache
def _numba_type(hint: Any) -> Any:
    """Numba's type for an annotation. Raises TypeError for one that no kernel takes."""
    tuple_of: Any = types.BaseTuple.from_types
    if hint in SCALARS:
        return SCALARS[hint]
    if is_record(hint):
        return tuple_of([_numba_type(field) for field in fields_of(hint).values()], hint)
    if get_origin(hint) is tuple and Ellipsis not in get_args(hint):
        return tuple_of([_numba_type(part) for part in get_args(hint)])
    if get_origin(hint) is Annotated and get_origin(get_args(hint)[0]) is np.ndarray:
        array, dimensions = get_args(hint)
        (number,) = get_args(get_args(array)[1])
        return types.Array(numba.from_dtype(np.dtype(number)), dimensions, "C")
    raise TypeError(f"{hint!r}: a kernel takes float, int, bool, complex, arrays with dimensions, tuples and NamedTuples")


@cache
def fit_of(numba_type: Any) -> Callable[[Any], bool]:
    """A quick check of a value against Numba's type: true where `misfits` has nothing to say."""
    if hasattr(numba_type, "types"):
        record = getattr(numba_type, "instance_class", tuple)
        parts = [fit_of(part) for part in numba_type.types]
        return lambda value: (
            type(value) is record
            and len(value) == len(parts)
            and all(fits(part) for fits, part in zip(parts, value, strict=True))
        )
    if isinstance(numba_type, types.Array):
        numbers, dimensions = as_dtype(numba_type.dtype), numba_type.ndim
        return lambda value: (
            type(value) is np.ndarray and value.dtype == numbers and value.ndim == dimensions and value.flags.carray
        )
    return lambda value: isinstance(value, _allowed(numba_type)) and (type(value) is not bool or numba_type == types.boolean)


def misfits(value: Any, numba_type: Any, name: str) -> Iterator[str]:
    """Differences of a value from Numba's type, each with the name of the field. Machine code itself looks at nothing: it
    reads another record's fields, or an array's bytes, as if they were right."""
    kind, typeof = type(value), cast(Any, numba.typeof)
    if fit_of(numba_type)(value):
        return
    if hasattr(numba_type, "types"):  # a tuple's or a record's
        record = getattr(numba_type, "instance_class", tuple)
        if kind is not record or len(value) != len(numba_type.types):
            yield f"{name}: is {kind.__name__}, must be {record.__name__} of {len(numba_type.types)}"
            return
        for field, part, part_type in zip(getattr(value, "_fields", range(len(value))), value, numba_type.types, strict=True):
            yield from misfits(part, part_type, f"{name}.{field}")
    elif isinstance(numba_type, types.Array):
        actual = typeof(value) if isinstance(value, np.ndarray) else kind.__name__
        if actual != numba_type:
            yield f"{name}: is {actual}, must be {numba_type}"
    else:
        yield f"{name}: is {value!r}, must be {numba_type}"


@cache
def _allowed(numba_type: Any) -> tuple[type, ...]:
    """Classes of Python's and NumPy's numbers that become a number of Numba's type."""
    if numba_type == types.boolean:
        return (bool, np.bool_)
    whole = (int, np.integer)
    return whole if isinstance(numba_type, types.Integer) else (*whole, float, np.floating, *_complex(numba_type))


def _complex(numba_type: Any) -> tuple[type, ...]:
    return (complex, np.complexfloating) if isinstance(numba_type, types.Complex) else ()
