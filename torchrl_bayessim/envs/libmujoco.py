"""MuJoCo's C functions and raw memory, as seen by compiled code.

Addresses travel as integers. Symbols are resolved by name in the library that the ``mujoco``
package loads, so compiled code can be cached on disk. Functions that compute, and may therefore
meet a fatal error, are `guarded`.
"""
# ruff: noqa: ANN001, ANN202, ARG001 - numba infers types, and types intrinsics by example

from __future__ import annotations

__all__ = [
    "address_of",
    "compiled",
    "doubles",
    "integers",
    "mj_com_pos",
    "mj_forward",
    "mj_get_state",
    "mj_jac_site",
    "mj_kinematics",
    "mj_reset",
    "mj_rne",
    "mj_set_const",
    "mj_set_state",
    "mj_step",
    "take",
]

import glob
import os
from typing import Any

import llvmlite.binding as llvm
import mujoco
import numba
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from ..errors import message
from .fatal_errors import guarded

for _library in glob.glob(os.path.join(os.path.dirname(mujoco.__file__), "libmujoco*")):
    llvm.load_library_permanently(_library)

compiled = numba.njit(nogil=True, cache=True)

_pointer = types.intp
_numbers = types.CPointer(types.float64)


def address_of(symbol: str) -> int:
    """Return where a function or variable of the library is.

    Raises:
        ImportError: This MuJoCo has none of that name.
    """
    address = llvm.address_of_symbol(symbol)
    if address is None:
        expected = f"a symbol of MuJoCo {mujoco.__version__}"
        raise ImportError(message(expected, symbol, hint="a version of MuJoCo that is tested"))
    return address


def _external(name: str, *arguments: types.Type) -> types.ExternalFunction:
    return types.ExternalFunction(name, types.void(*arguments))


mj_step = guarded("mj_step")
mj_forward = guarded("mj_forward")
mj_kinematics = guarded("mj_kinematics")
mj_com_pos = guarded("mj_comPos")
mj_set_const = guarded("mj_setConst")
mj_rne = guarded("mj_rnePostConstraint")
mj_reset = _external("mj_resetData", _pointer, _pointer)
mj_set_state = _external("mj_setState", _pointer, _pointer, _numbers, types.int32)
mj_get_state = _external("mj_getState", _pointer, _pointer, _numbers, types.int32)
mj_jac_site = _external("mj_jacSite", _pointer, _pointer, _numbers, _numbers, types.int32)


def _doubles(_typing, address):
    def build(_context, builder, _signature, arguments):
        return builder.inttoptr(arguments[0], ir.DoubleType().as_pointer())

    return types.CPointer(types.float64)(types.intp), build


def _integers(_typing, address):
    def build(_context, builder, _signature, arguments):
        return builder.inttoptr(arguments[0], ir.IntType(32).as_pointer())

    return types.CPointer(types.int32)(types.intp), build


def _take(_typing, queue):
    def build(_context, builder, _signature, arguments):
        pointer = builder.inttoptr(arguments[0], ir.IntType(64).as_pointer())
        return builder.atomic_rmw("add", pointer, ir.Constant(ir.IntType(64), 1), "seq_cst")

    return types.int64(types.intp), build


doubles: Any = intrinsic(_doubles)  # the doubles at an address, to index
integers: Any = intrinsic(_integers)  # the 32-bit integers at an address, to index
take: Any = intrinsic(_take)  # add one to the 64-bit integer at an address, return what it was
