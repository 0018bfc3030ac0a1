"""What one thread needs to step simulations of a model."""

from __future__ import annotations

__all__ = ["Worker", "layout"]

import copy

import mujoco
import numpy as np
from mujoco.introspect import structs
from mujoco.introspect.ast_nodes import ArrayType, PointerType, ValueType
from numpy.typing import NDArray

from ..errors import message
from . import native
from .fatal_errors import FAULT_SIZE


class Worker:
    """A model, data, and where their numbers are.

    Args:
        model: The nominal model, which is copied.
        outputs: Arrays of ``MjData`` to read.

    Raises:
        ValueError: There is no such array of a size that does not change, or one is named twice.
    """

    def __init__(self, model: mujoco.MjModel, outputs: tuple[str, ...]) -> None:
        if len(set(outputs)) != len(outputs):
            raise ValueError(message("outputs, each once", outputs))
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self.jacobian = np.empty((6, model.nv))
        self.fault = np.zeros(FAULT_SIZE, dtype=np.uint8)
        arrays = [self.fault, self.data.warning.number]
        arrays += [getattr(self.data, name) for name in native.OWNED[4:]]
        fault, warning, *owned = (array.ctypes.data for array in arrays)
        self.owned = np.array(
            [fault, self.model._address, self.data._address, warning, *owned], dtype=np.int64
        )
        read = [_array(self.data, name) for name in outputs]
        self.blocks = np.array(
            [(array.ctypes.data, array.size) for array in read], dtype=np.int64
        ).reshape(-1, 2)
        self.addresses = np.empty(0, dtype=np.int64)


def _array(data: mujoco.MjData, name: str) -> NDArray[np.float64]:
    names = _readable(data.model)
    if name not in names:
        expected = "an array of MjData that holds doubles, of a size that the model fixes"
        raise ValueError(message(expected, name, available=names))
    return getattr(data, name)


def _readable(model: mujoco.MjModel) -> list[str]:
    """Return the arrays of doubles in ``MjData`` that stay where they are, and as large."""
    return [
        field.name
        for field in structs.STRUCTS["mjData"].fields
        if isinstance(field.type, PointerType | ArrayType)
        and field.type.inner_type == ValueType("mjtNum")
        and all(isinstance(n, int) or hasattr(model, n) for n in field.array_extent or ())
    ]


def layout(data: mujoco.MjData, outputs: tuple[str, ...]) -> dict[str, tuple[int, tuple[int, ...]]]:
    """Return where each output starts, and its shape."""
    layout, start = {}, 0
    for name in outputs:
        shape = (6,) if name.startswith("site_velocity[") else getattr(data, name).shape
        layout[name] = start, shape
        start += int(np.prod(shape))
    return layout
