"""N MuJoCo environments with physics of their own, as one TorchRL environment.

One native call steps all of them, on all cores, without the interpreter: see `Stepper`. Physics are
written through ``env.models``, the interface behind `MujocoPhysics`.
"""

from __future__ import annotations

__all__ = ["BatchedMujocoEnv"]

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ..errors import message
from ..kinds import check_kind, real_numbers
from .additions import Addition, rollout_with
from .bias_forces import BiasForces
from .components import check_counts, check_own, check_settings, chosen_rows, finite_rows
from .draws import Draws
from .model_batch import ModelBatch
from .specs import specs
from .stepper import Stepper
from .task import Readings, Task
from .tasks.catalogue import as_task


class BatchedMujocoEnv(EnvBase):
    """N environments of one task, each with its own physics, stepped in one native call.

    Observations, rewards and terminations are those of the Gymnasium environment of the same name.
    A simulation that diverges terminates with the observation it had before, a reward of zero, and
    ``diverged`` set; the others do not notice.

    Example:
        >>> env = BatchedMujocoEnv("Hopper-v5", 4)
        >>> env.models.write("body_mass", (1,), np.array([3.0, 3.5, 4.0, 4.5]))
        >>> env.models.refresh()
        >>> env.rollout(10)["next", "reward"].shape
        torch.Size([4, 10, 1])

    Args:
        task: A name such as ``Hopper-v5`` or ``FetchPush-v4``, or a `Task`.
        num_envs: The number of environments ``N``.
        seed: Seed of the resets. The n-th episode of environment ``i`` starts in a state that
            depends on ``(seed, i, n)`` only.
        threads: Threads that step; default all cores that this process may use.
        max_steps: Control steps before truncation; default the task's.
        dtype: Of observations and rewards. Simulation is always in double precision.

    Attributes:
        task: The task.
        models: The physics of the environments.
        stepper: The simulations.
    """

    def __init__(
        self,
        task: str | Task,
        num_envs: int,
        *,
        seed: int = 0,
        threads: int | None = None,
        max_steps: int | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if num_envs is None:  # for which there is no default
            raise ValueError(message("num_envs to be a positive integer", num_envs))
        check_counts(num_envs=num_envs, max_steps=max_steps, threads=threads)
        check_settings(dtype, seed)
        super().__init__(batch_size=torch.Size([int(num_envs)]))
        self.task = as_task(task)
        self.num_envs = int(num_envs)
        self.max_steps = max_steps or self.task.max_steps
        self._dtype = dtype
        self.stepper = Stepper(
            self.task.model,
            self.num_envs,
            outputs=self.task.outputs,
            drive=self.task.drive,
            threads=threads,
        )
        self._additions: dict[object, Addition] = {}
        self._bias = BiasForces(self.stepper)
        self._work: Callable[[], None] | None = None
        self._seed = 0 if seed is None else int(seed)
        self._episodes = np.zeros(num_envs, dtype=np.int64)
        self._elapsed = torch.zeros(num_envs, 1, dtype=torch.int64)
        self._extras: dict[str, Tensor] = {}
        self._dt = torch.empty(num_envs, dtype=torch.float64)
        # outputs after the last control step and before it, exchanged at every step
        size = num_envs, 1, self.stepper.output_size
        self._outputs = [np.zeros(size), np.zeros(size)]
        self._start(np.arange(num_envs))
        self._episodes[:] = 0
        self._readings = [self._read(outputs[:, 0]) for outputs in self._outputs]
        observed, truncates = self._observe(self.readings), self.max_steps is not None
        for name, spec in specs(self.task, observed, self.batch_size, truncates=truncates).items():
            setattr(self, name, spec)
        self.task.verify(self.readings, self.action_spec.zero())

    @property
    def models(self) -> ModelBatch:
        """The physics of the environments."""
        return self.stepper.models

    @property
    def readings(self) -> Readings:
        """What the task's functions see now; the tensors share memory with the simulations."""
        return self._readings[0]

    def place(
        self, components: Mapping[str, Tensor], *, mask: Tensor | None = None
    ) -> TensorDictBase:
        """Start episodes in given states, all else being as after a reset.

        Args:
            components: Components of the state (``qpos``, ``qvel``, ``act``, ``time``, ``ctrl``,
                ``warmstart``, ``mocap_pos``, …) or of the task (``goal``), shape ``(N, size)``.
            mask: Which environments, boolean, shape ``(N,)``; default all.

        Returns:
            What a reset returns.

        Raises:
            KeyError: There is no such component.
            TypeError: They are not given by name.
            ValueError: A component or the mask has another shape, or is not finite.
        """
        check_kind("components of the state by name", components, Mapping, TensorDictBase)
        sizes = {name: self.stepper[name].shape[1] for name in self.stepper.components}
        sizes |= {name: value.shape[1] for name, value in self._extras.items()}
        given = {}
        for name, value in components.items():
            if name not in sizes:
                raise KeyError(message("a component of the state", name, available=sizes))
            given[name] = finite_rows(name, value, (self.num_envs, sizes[name]))
        rows = chosen_rows(mask, self.num_envs)
        self._start(rows, {name: value[rows] for name, value in given.items()})
        return self._started()

    def add(self, key: object, addition: Addition) -> None:
        """Call ``addition`` before every time step from now on, in place of the one of that key."""
        self._additions[key] = addition

    @contextmanager
    def meanwhile(self, work: Callable[[], None]) -> Iterator[None]:
        """Let this thread ``work`` once in each step within the block; other threads simulate it.

        For a learner that improves from former episodes while the next ones come in. ``work`` must
        not touch this environment. Where an `Addition` needs this thread, it works before the step.
        """
        before, self._work = self._work, work
        try:
            yield
        finally:
            self._work = before

    def open_loop(self, actions: Tensor) -> TensorDictBase:
        """Apply whole sequences of actions in one native call; nothing is reset on the way.

        Args:
            actions: Shape ``(N, T, A)``.

        Returns:
            The entries of ``next`` after each action, batch size ``(N, T)``. A simulation that
            diverges has NaN from there on, and stays in the state it had before the call.

        Raises:
            ValueError: The shape is another, or an action is not finite.
            TypeError: They are no numbers.
        """
        actions = real_numbers("actions of shape (N, T, A), numbers", actions)
        size = self.action_spec.shape[-1]
        if actions.ndim != 3 or actions.shape != (self.num_envs, actions.shape[1] or 1, size):
            expected = f"actions of shape ({self.num_envs}, T, {size}), T at least 1"
            raise ValueError(message(expected, tuple(actions.shape)))
        outputs = self._advance(self._commands(actions))
        before = self._read(np.concatenate([self._outputs[0], outputs[:, :-1]], axis=1))
        after = self._read(outputs)
        diverged = torch.from_numpy(np.isnan(outputs[..., :1]))
        steps = torch.arange(1, actions.shape[1] + 1).unsqueeze(-1)
        elapsed = self._elapsed.unsqueeze(1) + steps
        reward = self.task.reward(before, after, actions.double())
        last = np.where(diverged[:, -1], self._outputs[0][:, 0], outputs[:, -1])
        self._outputs[0][:, 0] = last
        self._elapsed = elapsed[:, -1]
        return self._result(after, reward, elapsed, diverged)

    def _set_seed(self, seed: int | None) -> None:
        check_settings(self._dtype, seed)
        self._seed = 0 if seed is None else int(seed)
        self._episodes[:] = 0

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self._start(chosen_rows(None if mask is None else mask.flatten(), self.num_envs))
        return self._started()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        if action is None or action.shape != self.action_spec.shape:
            got = "none" if action is None else tuple(action.shape)
            expected = f"actions of shape {tuple(self.action_spec.shape)}"
            raise ValueError(message(expected, got))
        commands = self._commands(action.unsqueeze(1))
        self._outputs.reverse()
        self._readings.reverse()
        self._advance(commands, self._outputs[0])
        after, before = self._readings
        diverged = torch.from_numpy(self.stepper.status != 0).unsqueeze(-1)
        if diverged.any():
            rows = diverged[:, 0].numpy()
            self._outputs[0][rows] = self._outputs[1][rows]
        self._elapsed += 1
        reward = self.task.reward(before, after, action.double())
        return self._result(after, reward, self._elapsed, diverged)

    def _advance(
        self, commands: NDArray[np.float64], outputs: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        substeps = self.task.frame_skip
        self._time()
        if not self._additions:
            return self.stepper.rollout(
                commands, substeps=substeps, outputs=outputs, meanwhile=self._work
            )
        if self._work is not None:
            self._work()
        added = rollout_with(
            self.stepper, self._additions.values(), commands, substeps=substeps, bias=self._bias
        )
        if outputs is not None:
            outputs[:] = added
        return added

    def _start(
        self, rows: NDArray[np.int64], given: Mapping[str, NDArray[np.float64]] | None = None
    ) -> None:
        """Begin the next episode of ``rows``, in the states that the task draws or ``given``."""
        stepper = self.stepper
        stepper.state[rows] = stepper.initial
        initial = self.task.initial
        components = {k: np.broadcast_to(v, (len(rows), len(v))) for k, v in initial.items()}
        if self.task.reset is not None:
            components |= self.task.reset(Draws(self._seed, rows, self._episodes[rows]))
        components |= given or {}
        for name, value in components.items():
            if name in stepper.components:
                part = stepper[name]
                part[rows] = finite_rows(name, value, (len(rows), part.shape[1]))
            else:
                check_own(name, stepper.components)
                size = np.shape(value)[-1]
                extra = self._extras.setdefault(name, torch.zeros(self.num_envs, size).double())
                extra[rows] = torch.from_numpy(finite_rows(name, value, (len(rows), size)))
        self._episodes[rows] += 1
        self._elapsed[rows] = 0
        self._time()
        stepper.begin(rows, outputs=self._outputs[0][:, 0])
        if "weld_pose" in components:  # it may be older than the positions, as in a recording
            stepper["weld_pose"][rows] = components["weld_pose"]

    def _time(self) -> None:
        """Let ``readings.dt`` follow the physics."""
        step = self.models.read("opt.timestep", ())
        self._dt.copy_(torch.from_numpy(step * self.task.frame_skip))

    def _started(self) -> TensorDictBase:
        no = torch.zeros(self.num_envs, 1, dtype=torch.bool)
        flags = {key: no.clone() for key in self.done_keys}
        diverged = torch.from_numpy(self.stepper.status != 0).unsqueeze(-1)
        source = {**self._observe(self.readings), **flags, "diverged": diverged}
        return TensorDict(source, batch_size=self.batch_size)

    def _commands(self, actions: Tensor) -> NDArray[np.float64]:
        if not actions.isfinite().all():
            rows = (~actions.isfinite()).flatten(1).any(1).nonzero()[:, 0].tolist()
            raise ValueError(message("finite actions", f"others in environments {rows}"))
        commands = actions if self.task.command is None else self.task.command(actions)
        return commands.detach().to(torch.float64).contiguous().numpy()

    def _read(self, outputs: NDArray[np.float64]) -> Readings:
        """Return outputs, shape ``(N, *T, M)``, by name, with the task's own entries."""
        readings = {
            name: torch.from_numpy(self.stepper.view(outputs, name)) for name in self.stepper.layout
        }
        for name, value in {**self._extras, "dt": self._dt}.items():
            readings[name] = value if outputs.ndim == 2 else value.unsqueeze(1)
        return Readings(**readings)

    def _observe(self, readings: Readings) -> dict[str, Tensor]:
        observed = self.task.observation(readings)
        observed = observed if isinstance(observed, dict) else {"observation": observed}
        # a copy, since an observation may be a view of what the next step overwrites
        return {name: value.to(self._dtype, copy=True) for name, value in observed.items()}

    def _result(
        self, after: Readings, reward: Tensor, elapsed: Tensor, diverged: Tensor
    ) -> TensorDictBase:
        terminated = diverged.clone()
        if self.task.termination is not None:
            terminated = self.task.termination(after).unsqueeze(-1) | diverged
        source = self._observe(after)
        source["reward"] = reward.unsqueeze(-1).masked_fill(diverged, 0.0).to(self._dtype)
        source["diverged"] = diverged
        source["terminated"] = terminated
        if self.max_steps is not None:
            source["truncated"] = elapsed >= self.max_steps
            source["done"] = terminated | source["truncated"]
        else:
            source["done"] = terminated.clone()
        return TensorDict(source, batch_size=elapsed.shape[:-1])
