"""Recorded actions again, from recorded states, under many physics: what would have happened.

Given ``S`` segments of logs, each a start state and ``T`` actions, and ``P`` parameter vectors,
`Replay` simulates all ``P × S`` combinations in one native call, ``y[p, s, t] = f(x_s, a_{s,:t};
θ_p)``. It is the inner loop of fitting a simulator to logs, so whatever does not depend on θ is set
up once. A `Hook` adds what the simulator leaves out: forces, or actuators with dynamics.
"""

from __future__ import annotations

__all__ = ["Hook", "Replay", "replay"]

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from tensordict import TensorDict
from torch import Tensor

from .envs.components import check_counts, finite_rows, names_of
from .envs.draws import Draws
from .envs.model_batch import ModelBatch
from .envs.recorded import checked_actions, copies, substeps_of, vectors
from .envs.stepper import Stepper
from .envs.task import Readings, Task
from .envs.tasks.catalogue import as_task
from .errors import message
from .kinds import check_function, check_kind
from .physics.protocol import Physics

Hook = Callable[[Readings], Mapping[str, Tensor]]
"""``readings -> {"qfrc_applied": …, "ctrl": …}``, called with the whole batch before every step.

Readings are tensors ``(P, S, size)``: the components of the state (``time``, ``qpos``, ``qvel``,
``act``, …) and ``ctrl``, the recorded command; they are views, to be read and not kept. What is
returned is written, broadcast to ``(P, S, size)``: a ``ctrl`` to use instead of the recorded one in
this step, generalised forces ``qfrc_applied`` or other components, which stay until written again.
"""


class Replay:
    """Segments of logs, ready to be simulated under any physics.

    Example:
        >>> segments = {
        ...     "qpos": torch.tensor([[0.0, 1.25, 0, 0, 0, 0]]),
        ...     "qvel": torch.zeros(1, 6),
        ...     "action": torch.zeros(1, 20, 3),
        ... }
        >>> from torchrl_bayessim.physics.mujoco import MujocoPhysics
        >>> hop = Replay("Hopper-v5", segments, physics=MujocoPhysics("opt.gravity[2]"))
        >>> y = hop(torch.tensor([[-9.81], [-1.6]]))
        >>> y["qpos"].shape
        torch.Size([2, 1, 20, 6])
        >>> y["qpos"][:, 0, -1, 1].round(decimals=2)  # it falls less on the moon
        tensor([1.2000, 1.2300], dtype=torch.float64)

    Args:
        task: A name or a `Task`; of a task, the model, ``frame_skip``, ``command``, ``drive`` and
            ``observation`` are used.
        segments: ``action``, shape ``(S, T, A)``, each held for ``dt`` seconds, and the components
            of the start states, shape ``(S, size)``: ``qpos``, ``qvel`` and where known ``act``,
            ``time``, ``warmstart``, ``mocap_pos``, ``mocap_quat``; the others start at the model's
            defaults. All are copied. A tensordict will do. Fetch also needs ``weld_pose``, from
            which the next action moves the hand: ``xpos`` and ``xquat`` of
            ``robot0:gripper_link``, as they stood in ``MjData`` when the start was recorded.
        physics: What the columns of theta set; default nothing.
        outputs: Arrays of ``MjData`` to return, and ``observation`` for the task's observation.
        threads: Threads to step with; default all cores that this process may use.
        dt: Seconds for which the recorded actions were held, a multiple of the model's nominal time
            step; default the task's.

    Raises:
        ValueError: The segments disagree in number, lack what they need, or are not finite;
            ``dt`` is not a multiple of the time step; ``threads`` is no positive integer.
        TypeError: ``task`` or ``physics`` is none; ``outputs`` is no sequence of names; the
            segments are no numbers by name, or ``dt`` is none.

    Attributes:
        task: The task.
        physics: What the columns of theta set.
        num_segments: The number of segments ``S``.
        steps: Actions per segment ``T``.
    """

    def __init__(
        self,
        task: str | Task,
        segments: Mapping[str, ArrayLike],
        *,
        physics: Physics | None = None,
        outputs: tuple[str, ...] = ("qpos", "qvel"),
        threads: int | None = None,
        dt: float | None = None,
    ) -> None:
        self.task = as_task(task)
        if dt is not None:
            self.task = replace(self.task, frame_skip=substeps_of(self.task, dt))
        if physics is not None:
            check_kind("physics with names, write and read", physics, Physics)
        self.physics = physics
        check_counts(threads=threads)
        self._names = names_of(outputs)
        read = tuple(name for name in self._names if name != "observation")
        if "observation" in self._names:
            read += tuple(name for name in self.task.outputs if name not in read)
        given = copies(segments)
        action = checked_actions(given, self.task)
        self.num_segments, self.steps = action.shape[:2]
        # commands in the precision of the actions, as in an environment
        command = action if self.task.command is None else self.task.command(action)
        self._commands = command.to(torch.float64).contiguous().numpy()
        self._stepper = Stepper(
            self.task.model,
            self.num_segments,
            outputs=read,
            drive=self.task.drive,
            sharing=self.num_segments,
            threads=threads,
        )
        self._starts = np.tile(self._stepper.initial, (self.num_segments, 1))
        self._extras: dict[str, Tensor] = {}
        self._place(given)

    @property
    def models(self) -> ModelBatch:
        """The physics, one row per parameter vector."""
        return self._stepper.models

    @property
    def batch_size(self) -> torch.Size:
        """The number of parameter vectors that there is room for; it grows as needed."""
        return torch.Size([self.models.num_envs])

    def __call__(
        self, theta: ArrayLike | None = None, *, hook: Hook | None = None, every: str = "control"
    ) -> TensorDict:
        """Simulate all segments under every parameter vector.

        Args:
            theta: Parameter vectors, shape ``(P, D)``, without NaN (which to `MujocoPhysics` means
                nominal); no gradient goes through them. Default the physics in force.
            hook: What the simulator leaves out.
            every: Call the hook before every ``control`` step, or before every ``time`` step.

        Returns:
            The outputs after each action, batch size ``(P, S, T)``, in double precision; NaN from
            a divergence on.

        Raises:
            ValueError: ``theta`` has another shape, is not finite, or there is no ``physics`` to
                set; ``every`` is unknown.
            TypeError: ``theta`` is no numbers, or the hook no function.
        """
        if hook is not None:
            check_function("a hook, a function of readings", hook)
        count = 1 if theta is None else self._write(theta)
        rows = np.arange(count * self.num_segments)
        stepper = self._stepper
        stepper.state.reshape(-1, *self._starts.shape)[:count] = self._starts
        outputs = np.empty((len(rows), self.steps, stepper.output_size))
        if hook is not None:
            self._hooked(hook, every, rows, outputs)
        else:
            sequence = rows % self.num_segments
            substeps = self.task.frame_skip
            stepper.rollout(
                self._commands, substeps=substeps, sequence=sequence, rows=rows, outputs=outputs
            )
        return self._collect(outputs.reshape(count, self.num_segments, self.steps, -1))

    def _write(self, theta: ArrayLike) -> int:
        if self.physics is None:
            expected = "physics, to say what theta sets"
            hint = 'Replay(…, physics=MujocoPhysics("body_mass[torso]"))'
            raise ValueError(message(expected, "none", hint=hint))
        values = vectors(theta, self.physics.names)
        count = len(values)
        if count > self.models.num_envs:
            self._stepper.resize(count * self.num_segments)
        room = self.models.num_envs
        mask = torch.arange(room) < count
        padded = torch.cat([values, values[-1:].expand(room - count, -1)])
        anything: Any = self  # what physics needs of an environment are its models
        empty = TensorDict(batch_size=self.batch_size)
        self.physics.write(anything, padded, mask=mask, tensordict=empty)
        return count

    def _hooked(
        self, hook: Hook, every: str, rows: NDArray[np.int64], outputs: NDArray[np.float64]
    ) -> None:
        """Step one command at a time, with the hook between."""
        parts = {"control": 1, "time": self.task.frame_skip}.get(every)
        if parts is None or (parts > 1 and self._commands.shape[2] != self.task.model.nu):
            expected = "every='control', or 'time' for a task whose commands are its controls"
            raise ValueError(message(expected, every))
        stepper, batch = self._stepper, (-1, self.num_segments)
        command = np.empty((stepper.num_envs, 1, self._commands.shape[2]))
        readings = Readings()
        for name in stepper.components:
            tensor = torch.from_numpy(stepper[name][: len(rows)])
            setattr(readings, name, tensor.unflatten(0, batch))
        control = torch.from_numpy(command[: len(rows), 0, : self.task.model.nu])
        readings.ctrl = control.unflatten(0, batch)
        outputs[:] = np.nan
        for t in range(self.steps):
            for _ in range(parts):
                command[: len(rows), 0].reshape(-1, *self._commands[:, t].shape)[:] = (
                    self._commands[:, t]
                )
                for name, value in hook(readings).items():
                    if name not in vars(readings):
                        known = vars(readings)
                        raise KeyError(message("a component of the state", name, available=known))
                    getattr(readings, name).copy_(value)
                stepper.rollout(
                    command,
                    substeps=self.task.frame_skip // parts,
                    rows=rows,
                    outputs=stepper.outputs,
                )
                rows = rows[stepper.status[rows] == 0]
            outputs[rows, t] = stepper.outputs[rows, 0]

    def _place(self, given: Mapping[str, Tensor]) -> None:
        components = self._stepper.components
        reset = self.task.reset
        own = {} if reset is None else reset(Draws(0, np.zeros(1, int), np.zeros(1, int)))
        for name, value in {**self.task.initial, **given}.items():
            if name in components:
                part = self._starts[:, components[name]]
                rows = np.broadcast_to(value, part.shape) if name not in given else value
                part[:] = finite_rows(name, rows, part.shape)
            elif name in own:
                self._extras[name] = torch.as_tensor(value).unsqueeze(1)
            elif name != "action":
                available = [*components, *own, "action"]
                raise KeyError(message("a component of the state", name, available=available))

    def _collect(self, outputs: NDArray[np.float64]) -> TensorDict:
        view = self._stepper.view
        read = {name: torch.from_numpy(view(outputs, name)) for name in self._stepper.layout}
        result = {name: read[name] for name in self._names if name != "observation"}
        if "observation" in self._names:
            step = self.models.read("opt.timestep", ())[: len(outputs)] * self.task.frame_skip
            dt = torch.from_numpy(step)[:, None, None]
            observed = self.task.observation(Readings(**read, **self._extras, dt=dt))
            result |= observed if isinstance(observed, dict) else {"observation": observed}
        return TensorDict(result, batch_size=outputs.shape[:3])


def replay(
    task: str | Task,
    segments: Mapping[str, ArrayLike],
    theta: ArrayLike | None = None,
    *,
    physics: Physics | None = None,
    outputs: tuple[str, ...] = ("qpos", "qvel"),
    hook: Hook | None = None,
    dt: float | None = None,
) -> TensorDict:
    """Simulate segments once under every parameter vector; see `Replay` for the arguments.

    Example:
        >>> still = {"qpos": torch.zeros(1, 2), "qvel": torch.zeros(1, 2)}
        >>> y = replay("InvertedPendulum-v5", {**still, "action": torch.ones(1, 5, 1)})
        >>> bool((y["qpos"][0, 0, :, 0].diff() > 0).all())  # the cart goes the way it is pushed
        True
    """
    return Replay(task, segments, physics=physics, outputs=outputs, dt=dt)(theta, hook=hook)
