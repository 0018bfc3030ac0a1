"""MuJoCo's own calls, for models from elsewhere: out of memory in words, and nothing on disk."""

from __future__ import annotations

__all__ = ["room"]

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco

from ..errors import message


@contextmanager
def room(model: str) -> Iterator[None]:
    """Say which model has too little memory for a call of MuJoCo inside the block.

    Warnings, which MuJoCo would print and append to ``MUJOCO_LOG.TXT``, are dropped.

    Args:
        model: What messages call it.

    Raises:
        ValueError: The model reserves less memory than it needs.

    Example:
        >>> small = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><size memory='1K'/><worldbody><geom type='plane' size='1 1 1'/>"
        ...     "<body><freejoint/><geom size='.1'/></body></worldbody></mujoco>")
        >>> with room("robot.xml"):
        ...     mujoco.mj_forward(small, mujoco.MjData(small))
        Traceback (most recent call last):
        ValueError: expected enough <size memory> in robot.xml, got 'mj_stackAlloc: out of memory...
    """
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    except mujoco.FatalError as error:
        hint = "leave out <size memory>, and MuJoCo chooses one"
        reason = " ".join(str(error).split())[:200]
        raise ValueError(message(f"enough <size memory> in {model}", reason, hint=hint)) from None
    finally:
        mujoco.set_mju_user_warning(before)
