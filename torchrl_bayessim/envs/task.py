"""What turns a MuJoCo model into a task: observation, reward, termination, reset, as functions.

All functions act on a whole batch. They receive `Readings`: tensors by name, the outputs that the
task asks the simulator for (arrays of ``MjData``, shape ``(*batch, *shape)``), whatever its reset
returned beside the state (a goal), and ``dt``, the seconds per control step, which broadcasts to
``batch`` and differs between environments whose physics set ``opt.timestep``. Positions and forces
that MuJoCo derives from the state are as old as in any program that calls ``mj_step``: of the start
of the last time step.
"""

from __future__ import annotations

__all__ = ["Readings", "Task", "uniform_reset"]

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import SimpleNamespace

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..errors import message
from .components import components_of, names_of
from .draws import Draws
from .drive import Drive


class Readings(SimpleNamespace):
    """Tensors by name; one that the task did not ask for is an error that says so."""

    def __getattr__(self, name: str) -> Tensor:
        expected = "something that the task reads"
        hint = f"outputs=(…, {name!r}) in the Task"
        raise AttributeError(message(expected, name, available=vars(self), hint=hint))


Reset = Callable[[Draws], Mapping[str, NDArray[np.float64]]]


def _positions_and_velocities(now: Readings) -> Tensor:
    return torch.cat([now.qpos, now.qvel], -1)


def _no_reward(_: Readings, after: Readings, action: Tensor) -> Tensor:  # noqa: ARG001
    return action.new_zeros(action.shape[:-1])


@dataclass(frozen=True, kw_only=True)
class Task:
    """A model and the functions that make a decision problem of it.

    Example:
        >>> ball = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body><joint name='x' type='slide'/><geom size='.1'/></body>"
        ...     "</worldbody><actuator><motor joint='x' ctrlrange='-1 1'/></actuator></mujoco>")
        >>> task = Task(
        ...     model=ball,
        ...     frame_skip=5,
        ...     observation=lambda now: torch.cat([now.qpos, now.qvel], -1),
        ...     reward=lambda before, now, action: -now.qpos[..., 0].abs(),
        ...     termination=lambda now: now.qpos[..., 0].abs() > 1.0,
        ...     reset=uniform_reset(ball, 0.1),
        ... )

    Attributes:
        model: The model, in its nominal physics.
        frame_skip: Time steps per control step.
        observation: ``readings -> (*batch, O)``, or a dictionary of such tensors; default
            positions and velocities.
        reward: ``(before, after, action) -> (*batch,)``; default zero.
        termination: ``readings -> (*batch,)`` boolean; default never.
        reset: ``draws -> {name: (B, size)}``; default the model's initial state. A component of
            the state (``qpos``, ``act``, ``mocap_pos``, …) is set; any other name, such as
            ``goal``, is the task's own and appears in the readings. Own names that are nearly a
            component's are an error.
        outputs: What to read, see `Stepper`.
        max_steps: Control steps before truncation.
        drive: How commands enter, see `Drive`.
        command: ``action (*batch, A) -> (*batch, C)``; default the action itself.
        bounds: Lowest and highest action, shape ``(A,)`` each; default those of the actuators.
        initial: Components of the state at the start of every episode, before ``reset``.

    Raises:
        TypeError: ``model`` is no MjModel, or ``outputs`` is one string.
        ValueError: ``frame_skip`` is not a positive integer.
        KeyError: ``initial`` has something that is no component of the state.
    """

    model: mujoco.MjModel
    frame_skip: int
    observation: Callable[[Readings], Tensor | dict[str, Tensor]] = _positions_and_velocities
    reward: Callable[[Readings, Readings, Tensor], Tensor] = _no_reward
    termination: Callable[[Readings], Tensor] | None = None
    reset: Reset | None = None
    outputs: tuple[str, ...] = ("qpos", "qvel")
    max_steps: int | None = None
    drive: Drive = field(default_factory=Drive)
    command: Callable[[Tensor], Tensor] | None = None
    bounds: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
    initial: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.model, mujoco.MjModel):
            hint = "mujoco.MjModel.from_xml_path(…)"
            raise TypeError(message("an MjModel", self.model, hint=hint))
        names_of(self.outputs)
        if not isinstance(self.frame_skip, int) or self.frame_skip < 1:
            raise ValueError(message("frame_skip to be a positive integer", self.frame_skip))
        known = components_of(self.model, welded=self.drive.weld is not None)
        for name in self.initial:
            if name not in known:
                raise KeyError(message("a component of the state", name, available=known))

    @property
    def dt(self) -> float:
        """Seconds per control step in the nominal physics; ``readings.dt`` are those in force."""
        return self.model.opt.timestep * self.frame_skip

    @property
    def converts(self) -> bool:
        """Whether an action is something else than the controls of the actuators."""
        return self.command is not None or self.drive.weld is not None

    @property
    def of_actuators(self) -> bool:
        """Whether there is one action for each actuator, whatever becomes of it on its way."""
        return self.drive.weld is None and len(self.action_bounds[0]) == self.model.nu

    @property
    def action_names(self) -> tuple[str, ...]:
        """What the numbers of an action are called: the actuators, or ``action0`` and so on.

        Example:
            >>> from torchrl_bayessim.envs.tasks.catalogue import known_task
            >>> known_task("InvertedPendulum-v5").action_names
            ('slide',)
            >>> known_task("FetchPush-v4").action_names
            ('action0', 'action1', 'action2', 'action3')
        """
        if not self.of_actuators:
            return tuple(f"action{i}" for i in range(len(self.action_bounds[0])))
        named = (self.model.actuator(i).name for i in range(self.model.nu))
        return tuple(name or f"actuator{i}" for i, name in enumerate(named))

    @property
    def action_bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lowest and highest action, infinite where there is no bound, shape ``(A,)`` each."""
        if self.bounds is not None:
            return self.bounds
        unlimited = self.model.actuator_ctrllimited == 0
        low, high = (np.array(end) for end in self.model.actuator_ctrlrange.T)
        low[unlimited], high[unlimited] = -np.inf, np.inf
        return low, high

    def verify(self, now: Readings, action: Tensor) -> None:
        """Evaluate reward and termination once, to see whether they are as they should be.

        Raises:
            ValueError: One of them does not return one value per environment.
        """
        batch = action.shape[:-1]
        values = {"reward": self.reward(now, now, action.double())}
        if self.termination is not None:
            values["termination"] = self.termination(now)
        for name, value in values.items():
            if value.shape != batch:
                expected = f"a {name} of one value per environment, shape {tuple(batch)}"
                hint = "index or reduce the last axis: now.qpos[..., 0]"
                raise ValueError(message(expected, tuple(value.shape), hint=hint))
        if self.termination is not None and values["termination"].dtype != torch.bool:
            raise ValueError(message("a boolean termination", values["termination"].dtype))


def uniform_reset(model: mujoco.MjModel, scale: float, *, velocity: str = "uniform") -> Reset:
    """Return a reset that adds noise to ``qpos0`` and to zero velocity.

    Args:
        model: The model.
        scale: Positions get ``U(-scale, scale)``, in their own units (quaternions too).
        velocity: ``uniform``, the same for velocities, or ``normal``, ``N(0, scale²)``.
    """

    def reset(draws: Draws) -> dict[str, NDArray[np.float64]]:
        qpos = model.qpos0 + draws.uniform(-scale, scale, size=model.nq)
        if velocity == "normal":
            return {"qpos": qpos, "qvel": scale * draws.normal(size=model.nv)}
        return {"qpos": qpos, "qvel": draws.uniform(-scale, scale, size=model.nv)}

    return reset
