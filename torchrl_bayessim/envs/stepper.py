"""N MuJoCo simulations of one model, each with its own physics, advanced in one native call.

The simulations are rows of arrays: `Stepper.state` holds everything that decides what follows
(``mjSTATE_INTEGRATION``: time, positions, velocities, activations, warm start, controls, forces,
mocap poses; and the pose from which a weld's next command starts), `Stepper.models` the physics.
Threads work through the rows; see `native`.
"""

from __future__ import annotations

__all__ = ["Drive", "Stepper"]

import copy
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import SimulationError, message
from . import native
from .model_batch import ModelBatch

_SIGNATURE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_COMPONENTS = (
    "time",
    "qpos",
    "qvel",
    "act",
    "history",
    "warmstart",
    "ctrl",
    "qfrc_applied",
    "xfrc_applied",
    "eq_active",
    "mocap_pos",
    "mocap_quat",
    "userdata",
    "plugin",
)


@dataclass(frozen=True)
class Drive:
    """How a command enters the simulation, and what follows each control step.

    A command is ``ctrl`` (``nu`` numbers) and, with ``weld``, the step of the first mocap body
    from that body's present pose (3 + 4 numbers), which is how the Fetch arms are moved.

    Attributes:
        relative: Actuators whose control is added to the position of their joint.
        weld: The body that the mocap body drags.
        pinned: Joints whose position is set to zero after each control step; the places of bodies
            and sites, but no forces, are then evaluated anew.
        contact_forces: Compute ``cfrc_ext`` after each control step (``mj_rnePostConstraint``).
    """

    relative: tuple[int, ...] = ()
    weld: str | None = None
    pinned: tuple[str, ...] = ()
    contact_forces: bool = False


class _Worker:
    """What one thread owns: a model, data, and where their numbers are."""

    def __init__(self, model: mujoco.MjModel, outputs: tuple[str, ...]) -> None:
        self.model = copy.copy(model)
        self.data = mujoco.MjData(self.model)
        self.jacobian = np.empty((6, model.nv))
        arrays = [getattr(self.data, name).ctypes.data for name in native.OWNED[3:]]
        warning = self.data.warning.number.ctypes.data
        self.owned = np.array(
            [self.model._address, self.data._address, warning, *arrays], dtype=np.int64
        )
        read = [_array(self.data, name) for name in outputs]
        self.blocks = np.array(
            [(array.ctypes.data, array.size) for array in read], dtype=np.int64
        ).reshape(-1, 2)
        self.addresses = np.empty(0, dtype=np.int64)


def _array(data: mujoco.MjData, name: str) -> NDArray[np.float64]:
    array = getattr(data, name, None)
    if not isinstance(array, np.ndarray) or array.dtype != np.float64:
        names = [n for n in dir(data) if isinstance(getattr(data, n), np.ndarray)]
        raise ValueError(message("an array of MjData that holds doubles", name, available=names))
    return array


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
        SimulationError: The model has too little memory to be evaluated at all.
        ValueError: ``drive.weld`` names a body, but the model has no mocap body.

    Attributes:
        models: The physics of each simulation.
        state: States, shape ``(N, S)``.
        components: Where ``qpos``, ``qvel``, … are in a state; ``stepper["qpos"]`` is a view.
        initial: The model's initial state, shape ``(S,)``.
        status: Of the last call: 0, `native.DIVERGED` or `native.OVERFLOW`, shape ``(N,)``.
        command_size: Numbers in a command.
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
        drive = Drive() if drive is None else drive
        sites = [name for name in outputs if name.startswith("site_velocity[")]
        arrays = tuple(name for name in outputs if name not in sites)
        self._threads = threads or len(os.sched_getaffinity(0))
        self._hire = lambda: _Worker(model, arrays)
        self._workers = [self._hire()]
        self._pool = ThreadPoolExecutor(max(1, self._threads - 1))
        self._queue = np.zeros(1, dtype=np.int64)
        self._drive = _resolve(model, drive, sites)
        self._sharing = sharing
        self.command_size = model.nu + (0 if drive.weld is None else 7)
        self.layout = _layout(self._workers[0].data, arrays + tuple(sites))
        self.output_size = sum(int(np.prod(shape)) for _, shape in self.layout.values())
        self.components = _components(model, welded=drive.weld is not None)
        self.initial = np.zeros(max(part.stop for part in self.components.values()))
        size = mujoco.mj_stateSize(model, _SIGNATURE)
        data = mujoco.MjData(model)
        mujoco.mj_getState(model, data, self.initial[:size], _SIGNATURE)
        _try_out(model, data)
        self.models = ModelBatch(model, num_envs // sharing, threads=self._threads)
        self.resize(num_envs)

    def resize(self, num_envs: int) -> None:
        """Change the number of simulations; all start anew, and new physics are nominal."""
        self.num_envs = num_envs
        while len(self._workers) < min(self._threads, num_envs):
            self._workers.append(self._hire())
        self.models.resize(num_envs // self._sharing)
        self.state = np.tile(self.initial, (num_envs, 1))
        self.outputs = np.zeros((num_envs, 1, self.output_size))
        self.status = np.zeros(num_envs, dtype=np.int64)
        self._all = np.arange(num_envs)

    def use(self, models: ModelBatch) -> None:
        """Step with these physics from now on, one row per ``sharing`` simulations."""
        if models.num_envs * self._sharing != self.num_envs:
            expected = f"the physics of {self.num_envs // self._sharing} environments"
            raise ValueError(message(expected, models.num_envs))
        self.models = models
        for worker in self._workers:  # the columns may be others
            worker.addresses = np.empty(0, dtype=np.int64)

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
        """Start the simulations ``rows`` in the states written to them (``mj_forward``)."""
        rows = self._all if rows is None else rows
        outputs = self.outputs[:, 0] if outputs is None else outputs
        self._run(native.begin, rows, outputs)

    def rollout(
        self,
        commands: NDArray[np.float64],
        *,
        substeps: int,
        sequence: NDArray[np.int64] | None = None,
        rows: NDArray[np.int64] | None = None,
        outputs: NDArray[np.float64] | None = None,
    ) -> NDArray[np.float64]:
        """Apply sequences of commands, each held for ``substeps`` steps.

        Args:
            commands: Shape ``(B, T, C)``.
            substeps: Steps of the model's time step per command.
            sequence: Which of the ``B`` sequences each simulation follows, shape ``(N,)``; default
                its own.
            rows: Which simulations to advance; default all.
            outputs: Where to write; default a new array.

        Returns:
            The outputs after each command, shape ``(N, T, M)``: NaN after a divergence, anything in
            rows that were not advanced.

        Raises:
            ValueError: ``commands`` has another shape.
            SimulationError: MuJoCo ran out of memory for contacts or constraints.
        """
        if commands.ndim != 3 or commands.shape[2] != self.command_size:
            expected = f"commands of shape (B, T, {self.command_size})"
            raise ValueError(message(expected, commands.shape))
        if outputs is None:
            outputs = np.empty((self.num_envs, commands.shape[1], self.output_size))
        rows = self._all if rows is None else rows
        sequence = self._all if sequence is None else sequence
        self._run(native.advance, rows, outputs, commands, sequence, substeps, self.status)
        full = rows[self.status[rows] == native.OVERFLOW].tolist()
        if full:
            expected = "room for all contacts and constraints"
            hint = "raise <size memory='…'/> in the MJCF"
            raise SimulationError(message(expected, f"environments {full} without", hint=hint))
        return outputs

    def _run(self, kernel: Callable[..., None], *arguments: object) -> None:
        """Let all threads work through the rows, this one among them."""
        self._queue[0] = 0
        batch = self.models.table, self._sharing, self.state, _SIGNATURE
        calls = []
        for worker in self._workers:
            if len(worker.addresses) != self.models.table.shape[1]:
                worker.addresses = self.models.addresses(worker.model)
            owned = worker.owned, worker.blocks, worker.addresses, worker.jacobian
            calls.append((owned, batch, self._drive, self._queue, *arguments))
        futures = [self._pool.submit(kernel, *call) for call in calls[1:]]
        kernel(*calls[0])
        for future in futures:
            future.result()


def _try_out(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Evaluate the model once from Python, where a fatal error of MuJoCo is an exception.

    In compiled code it would end the process.
    """
    data.warning.number[:] = 1  # MuJoCo prints a warning only while its count is zero
    try:
        mujoco.mj_forward(model, data)
    except mujoco.FatalError as error:
        expected = "a model with room for its computations"
        hint = "raise <size memory='…'/> in the MJCF"
        raise SimulationError(message(expected, str(error).split("\n")[0], hint=hint)) from None


def _resolve(
    model: mujoco.MjModel, drive: Drive, sites: list[str]
) -> tuple[NDArray[np.int64], int, NDArray[np.int64], NDArray[np.int64], bool]:
    """Return the ``drive`` argument of the kernels: names replaced by addresses."""
    relative = np.full(model.nu, -1, dtype=np.int64)
    for actuator in drive.relative:
        relative[actuator] = model.jnt_qposadr[model.actuator_trnid[actuator, 0]]
    if drive.weld is not None and not model.nmocap:
        expected = f"a model with a mocap body, to which {drive.weld!r} is welded"
        raise ValueError(message(expected, "none", hint='<body mocap="true"> in the MJCF'))
    weld = -1 if drive.weld is None else model.body(drive.weld).id
    pinned = [model.joint(name).qposadr[0] for name in drive.pinned]
    site_ids = [model.site(name[len("site_velocity[") : -1]).id for name in sites]
    return (
        relative,
        weld,
        np.array(pinned, dtype=np.int64),
        np.array(site_ids, dtype=np.int64),
        drive.contact_forces,
    )


def _layout(
    data: mujoco.MjData, outputs: tuple[str, ...]
) -> dict[str, tuple[int, tuple[int, ...]]]:
    """Return where each output starts, and its shape."""
    layout, start = {}, 0
    for name in outputs:
        shape = (6,) if name.startswith("site_velocity[") else getattr(data, name).shape
        layout[name] = start, shape
        start += int(np.prod(shape))
    return layout


def _components(model: mujoco.MjModel, *, welded: bool) -> dict[str, slice]:
    """Return where each component is in a state."""
    sizes = {name: mujoco.mj_stateSize(model, 1 << i) for i, name in enumerate(_COMPONENTS)}
    if welded:
        sizes["weld_pose"] = 7
    ends = np.cumsum(list(sizes.values())).tolist()
    return {
        name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)
    }
