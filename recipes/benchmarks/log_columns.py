"""What a simulated robot did, under the names that its logs have."""

from __future__ import annotations

__all__ = ["by_columns"]

from tensordict import TensorDict
from torch import Tensor

from torchrl_bayessim.logs.system import System


def by_columns(system: System, state: Tensor, commands: Tensor) -> TensorDict:
    """Return runs by the columns of the system, all of whose logged joints have one coordinate.

    Args:
        system: The robot.
        state: Positions and velocities, shape ``(*runs, rows, nq + nv)``.
        commands: In the order of the actuators, shape ``(*runs, rows, nu)``.
    """
    columns, model = system.columns, system.task.model
    table = {}
    for joint, names in columns.qpos.items():
        table[names[0]] = state[..., model.joint(joint).qposadr[0]].double()
    for joint, names in columns.qvel.items():
        table[names[0]] = state[..., model.nq + model.joint(joint).dofadr[0]].double()
    for column, name in enumerate(columns.ctrl.values()):
        table[name] = commands[..., column].double()
    return TensorDict(table, commands.shape[:-1])
