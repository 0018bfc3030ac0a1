"""N MuJoCo simulations of one model, each with its own physics, advanced in one native call.

The simulations are rows of arrays: `Stepper.state` holds everything that decides what follows
(``mjSTATE_INTEGRATION``: time, positions, velocities, activations, warm start, controls, forces,
mocap poses; and the pose from which a weld's next command starts), `Stepper.models` the physics.
Threads work through the rows; see `native`.
"""

from __future__ import annotations

__all__ = ["Stepper"]

import os
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import SimulationError, message
from . import native
from .components import check_counts, components_of, names_of
from .drive import Drive, Resolved, resolved
from .fatal_errors import fault_text
from .model_batch import ModelBatch
from .threads import Threads
from .untimed import untimed
from .worker import Worker, layout

_SIGNATURE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_HANDING_OVER = 2e-4  # s: less work than this is not worth another thread


class Stepper:
    """N simulations of one model as rows of arrays.

    Example:
        >>> model = mujoco.MjModel.from_xml_string(
        ...     "<mujoco><worldbody><body name='ball'><freejoint/><geom size='.1'/></body>"
        ...     "</worldbody></mujoco>")
        >>> balls = Stepper(model, 2, outputs=("qpos",), threads=1)
        >>> balls.models.write("opt.gravity", (2,), np.array([-1.0, -2.0]))
        >>> balls.begin()
        >>> fallen = balls.rollout(np.zeros((2, 1, 0)), substeps=10)
        >>> balls["qvel"][:, 2].round(3)
        array([-0.02, -0.04])

    Args:
        model: The nominal model.
        num_envs: The number of simulations ``N``.
        outputs: Arrays of ``MjData`` to read after each control step, such as ``qpos``, ``xpos``,
            ``sensordata``; ``site_velocity[name]`` is the velocity of a site, linear then angular.
        drive: How commands enter.
        sharing: How many consecutive simulations share one physics; it divides ``N``.
        threads: Threads to step with; default all cores that this process may use.

    Raises:
        TypeError: ``outputs`` is one string.
        ValueError: ``num_envs`` or ``threads`` is no positive integer; ``drive.weld`` names a body,
            but the model has no mocap body; ``outputs`` names what cannot be read, or something
            twice; the model lets bodies sleep; ``sharing`` does not divide ``num_envs``.

    Attributes:
        models: The physics of each simulation.
        state: States, shape ``(N, S)``.
        components: Where ``qpos``, ``qvel``, … are in a state; ``stepper["qpos"]`` is a view.
        initial: The model's initial state, shape ``(S,)``.
        status: What became of each simulation in the last call that included it: 0, or
            `native.DIVERGED`, ``OVERFLOW`` or ``FAILED`` (which are errors too), shape ``(N,)``.
        threads: Threads to step with.
        sharing: How many simulations share one physics.
        command_size: Numbers in a command.
        relative: Where in ``qpos`` is what each control is added to, -1 for none, shape ``(nu,)``.
        welded: Whether commands step a mocap body from the pose of the body that it drags.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        *,
        outputs: tuple[str, ...] = ("qpos", "qvel"),
        drive: Drive | None = None,
        sharing: int = 1,
        threads: int | None = None,
    ) -> None:
        check_counts(num_envs=num_envs, threads=threads)
        if sharing < 1 or num_envs % sharing:
            expected = f"sharing to divide the number of simulations, {num_envs}"
            raise ValueError(message(expected, sharing))
        if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
            expected = "a model whose bodies never sleep, since sleep is not part of a state"
            hint = "model.opt.enableflags &= ~mujoco.mjtEnableBit.mjENBL_SLEEP"
            raise ValueError(message(expected, '<flag sleep="enable"/>', hint=hint))
        drive = Drive() if drive is None else drive
        outputs = names_of(outputs)
        sites = [name for name in outputs if name.startswith("site_velocity[")]
        arrays = tuple(name for name in outputs if name not in sites)
        self.threads = threads or len(os.sched_getaffinity(0))
        self._hire = lambda: Worker(model, arrays)
        self._workers = [self._hire()]
        self._pool = Threads(self.threads)
        self._running: list[Future[float]] = []
        self._pace = 1e-5  # s per time step, as last seen
        self._queue = np.zeros(1, dtype=np.int64)
        self._drive = resolved(model, drive, sites)
        self._inside = resolved(model, replace(drive, pinned=(), contact_forces=False), sites)
        self.relative, self.welded = self._drive[0], drive.weld is not None
        self.sharing = sharing
        self.command_size = model.nu + (0 if drive.weld is None else 7)
        self.layout = layout(self._workers[0].data, arrays + tuple(sites))
        self.output_size = sum(int(np.prod(shape)) for _, shape in self.layout.values())
        self.components = components_of(model, welded=drive.weld is not None)
        self.initial = np.zeros(max(part.stop for part in self.components.values()))
        size = mujoco.mj_stateSize(model, _SIGNATURE)
        data = mujoco.MjData(model)
        mujoco.mj_getState(model, data, self.initial[:size], _SIGNATURE)
        self.models = ModelBatch(model, num_envs // sharing, threads=self.threads)
        self.resize(num_envs)

    def resize(self, num_envs: int) -> None:
        """Change the number of simulations; all start anew, and new physics are nominal."""
        self.num_envs = num_envs
        while len(self._workers) < min(self.threads, num_envs):
            self._workers.append(self._hire())
        self.models.resize(num_envs // self.sharing)
        self.state = np.tile(self.initial, (num_envs, 1))
        self.outputs = np.zeros((num_envs, 1, self.output_size))
        self.status = np.zeros(num_envs, dtype=np.int64)
        self._all = np.arange(num_envs)

    def use(self, models: ModelBatch) -> None:
        """Step with these physics from now on, one row per ``sharing`` simulations."""
        if models.num_envs * self.sharing != self.num_envs:
            expected = f"the physics of {self.num_envs // self.sharing} environments"
            raise ValueError(message(expected, models.num_envs))
        if not models.overrides(self.models):
            # what the former physics override stands in the models of the workers
            self._workers = [self._hire() for _ in self._workers]
        elif not models.same_columns(self.models):
            for worker in self._workers:
                worker.addresses = np.empty(0, dtype=np.int64)
        self.models = models

    def __getitem__(self, component: str) -> NDArray[np.float64]:
        """Return a view of a component of the states, such as ``qpos``, shape ``(N, size)``."""
        if component not in self.components:
            raise KeyError(
                message("a component of the state", component, available=self.components)
            )
        return self.state[:, self.components[component]]

    def view(self, outputs: NDArray[np.float64], name: str) -> NDArray[np.float64]:
        """Return one output, shape ``(*batch, *shape)``, of an array ``(*batch, M)``."""
        start, shape = self.layout[name]
        stop = start + int(np.prod(shape))
        return outputs[..., start:stop].reshape(*outputs.shape[:-1], *shape)

    def begin(
        self, rows: NDArray[np.int64] | None = None, *, outputs: NDArray[np.float64] | None = None
    ) -> None:
        """Start the simulations ``rows`` in the states written to them (``mj_forward``).

        Where something is not finite the ``status`` says so, and the outputs have zeros there.

        Raises:
            SimulationError: The model has too little memory, or cannot be evaluated at all.
        """
        rows = self._all if rows is None else _within(rows, self.num_envs, "simulations")
        outputs = self.outputs[:, 0] if outputs is None else outputs
        _check_room(outputs, rows, (self.output_size,))
        self._run(native.begin, rows, outputs, drive=self._drive, steps=len(rows))

    def rollout(
        self,
        commands: NDArray[np.float64],
        *,
        substeps: int,
        sequence: NDArray[np.int64] | None = None,
        rows: NDArray[np.int64] | None = None,
        outputs: NDArray[np.float64] | None = None,
        meanwhile: Callable[[], None] | None = None,
        ends: bool = True,
    ) -> NDArray[np.float64]:
        """Apply sequences of commands, each held for ``substeps`` steps.

        Args:
            commands: Shape ``(B, T, C)``.
            substeps: Steps of the model's time step per command.
            sequence: Which of the ``B`` sequences each simulation follows, shape ``(N,)``; default
                its own.
            rows: Which simulations to advance; default all.
            outputs: Where to write; default a new array.
            meanwhile: What this thread does while others step; None to step with them.
            ends: Whether what follows a control step does: pinning joints, contact forces. Not
                where this is a part of one that goes on.

        Returns:
            The outputs after each command, shape ``(N, T, M)``: NaN after a divergence, anything in
            rows that were not advanced.

        Raises:
            ValueError: ``commands`` or ``outputs`` has another shape; ``rows`` or ``sequence``
                names what there is not.
            SimulationError: The model has too little memory, or MuJoCo gave another fatal error;
                the environments that are named are as before, the others have advanced.
        """
        if commands.ndim != 3 or commands.shape[2] != self.command_size:
            expected = f"commands of shape (B, T, {self.command_size})"
            raise ValueError(message(expected, commands.shape))
        if outputs is None:
            outputs = np.empty((self.num_envs, commands.shape[1], self.output_size))
        rows = self._all if rows is None else _within(rows, self.num_envs, "simulations")
        _check_room(outputs, rows, (commands.shape[1], self.output_size))
        sequence = self._all if sequence is None else np.asarray(sequence, dtype=np.int64)
        if sequence.shape != (self.num_envs,) and len(sequence) <= rows.max(initial=-1):
            raise ValueError(message(f"a sequence for each of {self.num_envs}", sequence.shape))
        _within(sequence[rows], len(commands), "sequences of commands")
        commands = np.asarray(commands, dtype=np.float64)
        arguments = commands, sequence, substeps
        steps = len(rows) * commands.shape[1] * substeps
        drive = self._drive if ends else self._inside
        self._run(
            native.advance, rows, outputs, *arguments, drive=drive, steps=steps, meanwhile=meanwhile
        )
        return outputs

    def _run(
        self,
        kernel: Callable[..., None],
        rows: NDArray[np.int64],
        outputs: NDArray[np.float64],
        *arguments: object,
        drive: Resolved,
        steps: int,
        meanwhile: Callable[[], None] | None = None,
    ) -> None:
        """Let threads work through the rows, this one among them if it has nothing to do.

        As many as have enough to do, by the time that so many steps took before.
        """
        wait(self._running)  # after an interrupt
        self._queue[0] = 0
        batch = self.models.table, self.sharing, self.state, _SIGNATURE
        shared = drive, self._queue, rows, outputs, self.status, *arguments
        most = max(1, int(steps * self._pace / _HANDING_OVER))
        calls = []
        for worker in self._workers[:most]:
            if len(worker.addresses) != self.models.table.shape[1]:
                worker.addresses = self.models.addresses(worker.model)
            owned = worker.owned, worker.blocks, worker.addresses, worker.jacobian
            calls.append((owned, batch, *shared))
        own = calls[:1] if meanwhile is None else []
        others = calls[len(own) :]
        with untimed():
            self._running = [self._pool.submit(_seconds, kernel, *call) for call in others]
            try:
                spent = sum(_seconds(kernel, *call) for call in own)
                if meanwhile is not None:
                    meanwhile()
            finally:  # they write to the states
                wait(self._running)
        spent += sum(future.result() for future in self._running)
        if steps:
            self._pace = spent / steps
        self._raise_failures(rows)

    def _raise_failures(self, rows: NDArray[np.int64]) -> None:
        status = self.status[rows]
        if not (status > native.DIVERGED).any():
            return
        failed = rows[status == native.FAILED].tolist()
        texts = (fault_text(worker.fault) for worker in self._workers)
        said = next(filter(None, texts), "a fatal error without a message")
        for worker in self._workers:
            worker.fault[:] = 0
        if failed:
            expected = f"simulations that MuJoCo can compute, not environments {failed}"
            memory = "stack" in said or "memory" in said
            hint = "raise <size memory='…'/> in the MJCF" if memory else "check their physics"
            raise SimulationError(message(expected, said, hint=hint))
        full = rows[status == native.OVERFLOW].tolist()
        expected = "room for all contacts and constraints"
        hint = "raise <size memory='…'/> in the MJCF"
        raise SimulationError(message(expected, f"environments {full} without", hint=hint))


def _seconds(kernel: Callable[..., None], *call: object) -> float:
    """Return how long a thread was at it."""
    begun = time.perf_counter()
    kernel(*call)
    return time.perf_counter() - begun


def _within(rows: NDArray[np.int64], count: int, what: str) -> NDArray[np.int64]:
    """Return integers below ``count``: compiled code does not look whether they are."""
    rows = np.asarray(rows, dtype=np.int64)
    if rows.ndim != 1 or (rows.size and not 0 <= rows.min() <= rows.max() < count):
        raise ValueError(message(f"integers of {count} {what}", rows.tolist()))
    return rows


def _check_room(
    outputs: NDArray[np.float64], rows: NDArray[np.int64], shape: tuple[int, ...]
) -> None:
    count = rows.max(initial=-1) + 1
    if outputs.shape[1:] != shape or len(outputs) < count or outputs.dtype != np.float64:
        expected = f"outputs of doubles, shape ({count}, …) with {shape} after it"
        raise ValueError(message(expected, outputs.shape))
