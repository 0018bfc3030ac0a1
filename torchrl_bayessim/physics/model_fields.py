"""Entries of a MuJoCo model by name: ``field[selector]``, ``field[selector,column]``.

``body_mass[torso]``           the mass of body ``torso``
``geom_friction[floor,0]``     the sliding friction of geom ``floor``
``geom_friction[body:leg,0]``  of all geoms of body ``leg``, named or not
``dof_damping[knee]``          of all degrees of freedom of joint ``knee``
``actuator_gear[*,0]``         of all actuators
``geom_size[3,1]``             of geom number 3, where names are missing
``opt.gravity[2]``, ``opt.timestep``  of the options
``-actuator_biasprm[servo,1]`` the negative of the entry (a position servo's gain ``kp`` is both
``actuator_gainprm[servo,0]`` and this)

Fields are those of ``mjModel`` (https://mujoco.readthedocs.io/en/stable/APIreference/APItypes.html)
that hold floating-point numbers and whose first axis counts objects.
"""

from __future__ import annotations

__all__ = ["Entries", "field_array", "resolve"]

import re
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import PhysicsError, message

_OBJECTS = {  # the field's prefix: the kind of object, and mjModel's count of them
    "body": (mujoco.mjtObj.mjOBJ_BODY, "nbody"),
    "jnt": (mujoco.mjtObj.mjOBJ_JOINT, "njnt"),
    "dof": (mujoco.mjtObj.mjOBJ_JOINT, "nv"),
    "geom": (mujoco.mjtObj.mjOBJ_GEOM, "ngeom"),
    "site": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
    "tendon": (mujoco.mjtObj.mjOBJ_TENDON, "ntendon"),
    "actuator": (mujoco.mjtObj.mjOBJ_ACTUATOR, "nu"),
    "pair": (mujoco.mjtObj.mjOBJ_PAIR, "npair"),
    "eq": (mujoco.mjtObj.mjOBJ_EQUALITY, "neq"),
}
_KINDS = {"jnt": "joint", "dof": "joint", "pair": "contact pair", "eq": "equality"}
_PATTERN = re.compile(r"(-?)([a-z][\w.]*)(?:\[(.+)\])?")


@dataclass(frozen=True)
class Entries:
    """Numbers of a model that one parameter sets, all to ``sign`` times its value.

    Attributes:
        field: The attribute of ``MjModel``, ``opt.`` included.
        indices: Where in the field, one tuple for each number.
        sign: 1.0 or -1.0.
    """

    field: str
    indices: tuple[tuple[int, ...], ...]
    sign: float = 1.0


def resolve(model: mujoco.MjModel, target: str) -> Entries:
    """Return the entries of ``model`` that ``target`` names.

    Raises:
        PhysicsError: The model has no such field, object or column.

    Example:
        >>> import mujoco
        >>> model = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body name='ball'><freejoint name='free'/><geom size='.1'/>"
        ...     "</body></worldbody></mujoco>")
        >>> resolve(model, "geom_friction[body:ball,0]")
        Entries(field='geom_friction', indices=((0, 0),), sign=1.0)
    """
    match = _PATTERN.fullmatch(target.strip())
    if match is None:
        expected = "field, field[selector] or field[selector,column]"
        raise PhysicsError(message(expected, target, hint="body_mass[torso]"))
    minus, field, selector = match.groups()
    array = field_array(model, field)
    sign = -1.0 if minus else 1.0
    if field.startswith("opt."):
        columns = () if array.ndim == 0 else (_column(field, array.shape, selector or ""),)
        if array.ndim == 0 and selector is not None:
            raise PhysicsError(message(f"{field} alone, a single number", target))
        return Entries(field, (columns,), sign)
    name, column = _split(field, selector, array)
    rows = _rows(model, field.split("_")[0], name)
    return Entries(field, tuple((row, *column) for row in rows), sign)


def field_array(model: mujoco.MjModel, field: str) -> NDArray[np.float64]:
    """Return a model's field by its name.

    Raises:
        PhysicsError: There is no such field, or it does not hold floating-point numbers.
    """
    owner, _, last = field.rpartition(".")
    value = getattr(model.opt if owner else model, last, None)
    if not _is_float(value) or not (owner == "opt" or last.split("_")[0] in _OBJECTS):
        names = [name for name in dir(model) if name.split("_")[0] in _OBJECTS]
        names = [name for name in names if _is_float(getattr(model, name))]
        names += [f"opt.{name}" for name in dir(model.opt) if _is_float(getattr(model.opt, name))]
        what = "a field of floating-point numbers of MjModel"
        raise PhysicsError(message(what, field, available=names))
    return np.asarray(value)


def _is_float(value: object) -> bool:
    return isinstance(value, float) or (
        isinstance(value, np.ndarray) and np.issubdtype(value.dtype, np.floating)
    )


def _split(
    field: str, selector: str | None, array: NDArray[np.float64]
) -> tuple[str, tuple[int, ...]]:
    """Return the object's name, and the column if the field has columns."""
    if selector is None:
        raise PhysicsError(message(f"{field}[selector]", field, hint=f"{field}[*] for all"))
    if array.ndim == 1:
        return selector, ()
    name, comma, column = selector.rpartition(",")
    if not comma:
        width = array.shape[1]
        raise PhysicsError(
            message(
                f"a column, 0 to {width - 1}, of {field}",
                f"{field}[{selector}]",
                hint=f"{field}[{selector},0]",
            )
        )
    return name.strip(), (_column(field, array.shape[1:], column.strip()),)


def _column(field: str, shape: tuple[int, ...], column: str) -> int:
    if not column.isdecimal() or int(column) >= shape[0]:
        raise PhysicsError(message(f"a column of {field}, 0 to {shape[0] - 1}", column))
    return int(column)


def _rows(model: mujoco.MjModel, prefix: str, name: str) -> list[int]:
    """Return the rows of a ``prefix_…`` field that a selector stands for."""
    _, count = _OBJECTS[prefix]
    if name == "*":
        rows = list(range(getattr(model, count)))
    elif name.startswith("body:") and prefix == "geom":
        body = _identify(model, "body", name.removeprefix("body:"))
        rows = np.flatnonzero(model.geom_bodyid == body).tolist()
    else:
        row = _identify(model, prefix, name)
        rows = np.flatnonzero(model.dof_jntid == row).tolist() if prefix == "dof" else [row]
    if not rows:
        raise PhysicsError(message(f"at least one {_KINDS.get(prefix, prefix)} selected by", name))
    return rows


def _identify(model: mujoco.MjModel, prefix: str, name: str) -> int:
    """Return an object's number, from its name or number."""
    kind, count = _OBJECTS[prefix]
    number = mujoco.mj_name2id(model, kind, name)
    total = model.njnt if prefix == "dof" else getattr(model, count)
    if number < 0 and name.isdecimal() and int(name) < total:
        number = int(name)
    if number < 0:
        what = _KINDS.get(prefix, prefix)
        names = [mujoco.mj_id2name(model, kind, i) for i in range(total)]
        raise PhysicsError(
            message(
                f"the name, or a number below {total}, of a {what}",
                name,
                available=[n for n in names if n],
            )
        )
    return number
