"""MuJoCo's fatal errors as return codes, for compiled code that calls it.

MuJoCo reports a fatal error, such as a full stack, to a log handler of the thread, and ends the
process if that returns. `guarded` calls a function of MuJoCo under a handler that never returns
from an error, but jumps back to before the call (``setjmp``, ``longjmp``); that is also what
MuJoCo's Python bindings do. Messages below an error, which MuJoCo would print and append to
``MUJOCO_LOG.TXT``, are dropped. The data of a failed call are fit for ``mj_resetData`` alone.
"""
# ruff: noqa: ANN001, ANN202, ARG001 - numba types intrinsics by example

from __future__ import annotations

__all__ = ["FAULT_SIZE", "fault_text", "guarded"]

import ctypes
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

_JUMP = 512  # bytes, more than a jmp_buf of any platform
_TEXT = 1024  # of mjLogMessage.subject
_SUBJECT = 8  # its offset
_ERROR = 3  # mjLOG_ERROR, in mjLogMessage.level at offset 0
FAULT_SIZE = _JUMP + _TEXT
_KEY = "torchrl_bayessim_fault_key"

# where the handler, which is given nothing else, finds what the thread's call has prepared
_key = ctypes.c_uint()
ctypes.CDLL(None).pthread_key_create(ctypes.byref(_key), None)
llvm.add_symbol(_KEY, ctypes.addressof(_key))

_byte, _int, _word = ir.IntType(8), ir.IntType(32), ir.IntType(64)
_pointer = _byte.as_pointer()


def fault_text(fault: NDArray[np.uint8]) -> str:
    """Return what MuJoCo said of the last fatal error, in one line."""
    text = fault[_JUMP:].tobytes().split(b"\0")[0].decode(errors="replace")
    return " ".join(text.split())


def _function(module: ir.Module, name: str, result: ir.Type, *arguments: ir.Type) -> Any:
    known = module.globals.get(name)
    return known or ir.Function(module, ir.FunctionType(result, arguments), name)


def _key_of(module: ir.Module, builder: ir.IRBuilder) -> Any:
    variable = module.globals.get(_KEY) or ir.GlobalVariable(module, _int, _KEY)
    return builder.load(variable)


def _handler(module: ir.Module) -> Any:
    """Return ``void handler(const mjLogMessage*)``: note the text and jump, if it is an error."""
    name = "torchrl_bayessim_fault_handler"
    if name in module.globals:
        return module.globals[name]
    handler = _function(module, name, ir.VoidType(), _pointer)
    handler.linkage = "internal"
    builder = ir.IRBuilder(handler.append_basic_block())
    level = builder.load(builder.bitcast(handler.args[0], _int.as_pointer()))
    with builder.if_then(builder.icmp_signed("==", level, _int(_ERROR))):
        get = _function(module, "pthread_getspecific", _pointer, _int)
        fault = builder.call(get, [_key_of(module, builder)])
        copy = _function(module, "strncpy", _pointer, _pointer, _pointer, _word)
        subject = builder.gep(handler.args[0], [_word(_SUBJECT)])
        builder.call(copy, [builder.gep(fault, [_word(_JUMP)]), subject, _word(_TEXT - 1)])
        jump = _function(module, "longjmp", ir.VoidType(), _pointer, _int)
        builder.call(jump, [fault, _int(1)])
    builder.ret_void()
    return handler


def _guard(module: ir.Module, name: str) -> Any:
    """Return ``int guard(char* fault, void* model, void* data)``: 1 after a fatal error, else 0."""
    if f"guarded_{name}" in module.globals:
        return module.globals[f"guarded_{name}"]
    guard = _function(module, f"guarded_{name}", _int, _pointer, _word, _word)
    guard.linkage = "internal"
    guard.attributes.add("noinline")  # setjmp marks this frame
    fault, model, data = guard.args
    builder = ir.IRBuilder(guard.append_basic_block())
    put = _function(module, "pthread_setspecific", _int, _int, _pointer)
    builder.call(put, [_key_of(module, builder), fault])
    install = _function(module, "_mjPRIVATE_setTlsLogHandler", _pointer, _pointer)
    before = builder.call(install, [builder.bitcast(_handler(module), _pointer)])
    mark = _function(module, "_setjmp", _int, _pointer)
    mark.attributes.add("returns_twice")
    code = builder.call(mark, [fault])
    with builder.if_then(builder.icmp_signed("==", code, _int(0))):
        builder.call(_function(module, name, ir.VoidType(), _word, _word), [model, data])
    builder.call(install, [before])
    builder.ret(code)
    return guard


def guarded(name: str) -> Any:
    """Return ``name(fault, model, data) -> int32`` for compiled code: 1 after a fatal error.

    Args:
        name: A function of MuJoCo of a model and data, such as ``mj_step``.

    ``fault``, the address of `FAULT_SIZE` bytes that no other thread uses meanwhile, receives the
    message, see `fault_text`; model and data are addresses.
    """

    def typed(_typing, fault, model, data):
        def build(_context, builder, _signature, arguments):
            address = builder.inttoptr(arguments[0], _pointer)
            return builder.call(_guard(builder.module, name), [address, *arguments[1:]])

        return types.int32(types.intp, types.intp, types.intp), build

    return intrinsic(typed)
