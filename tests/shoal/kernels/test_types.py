"""Kernels with records: signatures from annotations, calls from Python and from other kernels, and what a wrong call gives."""

import math
import os
from typing import Any, NamedTuple

import numpy as np
import pytest
from numba.core.sigutils import normalize_signature

from shoal.kernels.decorator import CHECK_EVERY, Kernel, kernel
from shoal.kernels.stamp import stamp_of
from shoal.kernels.types import Floats, Ints, Table, signature_of


class Pair(NamedTuple):
    """Two numbers."""

    along: float
    across: float


class Rows(NamedTuple):
    """A record with a record and an array in it."""

    mass: Pair
    rows: Table
    used: int


class OtherPair(NamedTuple):
    """As large as `Pair`, and something else."""

    along: float
    across: float


@kernel(part=True)
def scaled(axes: Pair, factor: float) -> Pair:
    """A record for a record."""
    return Pair(axes.along * factor, axes.across * factor)


@kernel
def moved(body: Rows, by: Pair, turns: bool) -> tuple[Pair, float]:
    """Sum of rows, scaled; and a root."""
    total = scaled(by, 2.0)
    for i in range(body.used):
        total = Pair(total.along + body.rows[i, 0], total.across + body.rows[i, 1])
    return (Pair(-total.across, total.along) if turns else total), math.sqrt(body.mass.along)


@kernel
def of_numbers(a: float, b: float) -> float:
    """Calls a kernel with records."""
    return scaled(Pair(a, b), 3.0).across


BODY = Rows(Pair(4.0, 1.0), np.array([[1.0, 2.0], [3.0, 4.0], [9.0, 9.0]]), 2)
BY = Pair(0.5, 0.25)
HALF: Any = 2.5
NONE: Any = None
LISTED: Any = BODY.rows.tolist()
TRUE: Any = np.True_


def test_records_go_in_and_come_out() -> None:
    assert moved(BODY, BY, False) == (Pair(5.0, 6.5), 2.0)
    turned, root = moved(BODY, Pair(np.float64(0.5), 0.25), TRUE)
    assert (turned, root) == (Pair(-6.5, 5.0), 2.0)
    assert type(turned) is Pair
    assert of_numbers(1.0, 2.0) == 6.0
    assert scaled(BY, 2) == Pair(1.0, 0.5)  # a part can be called by itself


@pytest.mark.skipif("NUMBA_DISABLE_JIT" in os.environ, reason="nothing is compiled, so nothing is checked")
@pytest.mark.parametrize(
    "arguments, message",
    [
        ((BODY, OtherPair(0.5, 0.25), False), r"moved: by: is OtherPair, must be Pair of 2"),
        ((BODY, (0.5, 0.25), False), r"moved: by: is tuple, must be Pair of 2"),
        ((BODY, Pair(0.5, NONE), False), r"moved: by.across: is None, must be float64"),
        ((BODY._replace(used=HALF), BY, False), r"moved: body.used: is 2.5, must be int64"),
        ((BODY._replace(rows=np.asfortranarray(BODY.rows)), BY, False), r"body.rows: is array\(float64, 2d, F\), must be"),
        ((BODY._replace(rows=BODY.rows.astype(np.int64)), BY, False), r"body.rows: is array\(int64, 2d, C\), must be"),
        ((BODY._replace(rows=BODY.rows[0]), BY, False), r"body.rows: is array\(float64, 1d, C\), must be"),
        ((BODY._replace(rows=LISTED), BY, False), r"body.rows: is list, must be array"),
        ((BODY, BY, 1), r"moved: turns: is 1, must be bool"),
        ((BODY, BY), r"moved: 2 arguments, takes 3"),
    ],
)
def test_wrong_argument_is_named(arguments: tuple[object, ...], message: str) -> None:
    assert isinstance(moved, Kernel)
    with pytest.raises(TypeError, match=message):
        moved(*arguments)


@pytest.mark.skipif("NUMBA_DISABLE_JIT" in os.environ, reason="nothing is compiled, so nothing is checked")
@pytest.mark.parametrize(
    "wrong, within",
    [((BODY, OtherPair(0.5, 0.25)), 1), ((BODY._replace(rows=np.asfortranarray(BODY.rows)), BY), CHECK_EVERY)],
)
def test_wrong_argument_is_noticed_where_many_right_ones_went_before(wrong: tuple[Any, Any], within: int) -> None:
    """Of another class at once; of the right class, with something wrong in it, soon."""
    went = 0
    with pytest.raises(TypeError, match="moved: b"):
        for body, by in [(BODY, BY)] * 40 + [wrong] * within:
            moved(body, by, False)
            went += 1
    assert went >= 40


def test_signature_is_that_of_the_annotations() -> None:
    def fine(rows: Table, counts: Ints, parts: tuple[float, complex], work: Floats) -> None: ...

    arguments, result = normalize_signature("void(f8[:,::1], i8[::1], Tuple((f8, c16)), f8[::1])")  # type: ignore[no-untyped-call]
    assert signature_of(fine) == result(*arguments)

    def many(a: int, b: int, c: int, d: int, e: int, f: int, g: int, h: int, i: int) -> None: ...

    with pytest.raises(TypeError, match=r"many: 9 parameters \(at most 8\): group them in records"):
        signature_of(many)

    def bare(a, b: float) -> float: ...  # type: ignore[no-untyped-def, empty-body]

    with pytest.raises(TypeError, match="bare: a has no annotation"):
        signature_of(bare)

    def text_taker(a: str) -> None: ...

    with pytest.raises(TypeError, match="a kernel takes float"):
        signature_of(text_taker)


def test_stamp_notices_a_record_and_a_kernel_of_another_module() -> None:
    def stamp(record: type, called: str) -> str:
        def callee() -> None: ...

        callee.py_func = callee  # type: ignore[attr-defined]
        space: dict[str, object] = {"Row": record, "other": callee}
        exec("def f(x):\n    return other(Row(x, x))\n", space)
        return stamp_of(space["f"], "", {callee: called})  # type: ignore[arg-type]

    class _Renamed(NamedTuple):
        along: float
        aside: float

    _Renamed.__qualname__ = Pair.__qualname__
    here = stamp(Pair, "1")
    assert here == stamp(Pair, "1")
    assert here != stamp(Pair, "2")
    assert here != stamp(_Renamed, "1")
