"""The robot that is diagnosed: a stepping loop with causes, on a finer grid than the simulator's.

In every control step the sensors are read, the command is chosen and logged, and the model runs
through its time steps; causes change the command that arrives, add generalised forces, alter the
model, or alter what the sensors say.
"""

from __future__ import annotations

__all__ = ["Cause", "Motion", "Plant", "Truth"]

from collections.abc import Callable, Collection, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from .coordinates import coordinates, displaced, positions

Array = NDArray[np.float64]
Policy = Callable[[int, Array], Array]  # control step and measurements to commands


class Cause:
    """Something that the nominal simulator lacks; subclasses override what they change.

    Attributes:
        memory: Hidden state, empty at the start of every trajectory.
    """

    def __init__(self) -> None:
        self.memory: dict[str, Any] = {}

    def write(self, model: mujoco.MjModel) -> None:
        """Alter the model, once."""

    def command(self, u: Array, plant: Plant) -> Array:  # noqa: ARG002
        """Return what arrives of the commands ``u``, at every time step."""
        return u

    def force(self, plant: Plant) -> Array | float:  # noqa: ARG002
        """Return generalised forces, at every time step."""
        return 0.0

    def sense(self, y: Array, plant: Plant) -> Array:  # noqa: ARG002
        """Return what the sensors say of the state ``y``, at every control step."""
        return y


@dataclass(frozen=True)
class Motion:
    """One trajectory; rows are control steps.

    Attributes:
        clean: Measured tangent coordinates without noise, ``(T, 2 nv)``.
        measured: With noise.
        qpos: Where ``clean`` begins from: positions of the model, with what the sensors add.
        ctrl: Logged commands, ``(T, nu)``.
        acts: How much each cause changes, the largest in every control step, ``(T, causes)``:
            of commands, of forces, of what is measured; 0 throughout for a change of the model.
        sensed: What each cause adds to what is measured, ``(T, causes, 2 nv)``.
    """

    clean: Array
    measured: Array
    qpos: Array
    ctrl: Array
    acts: Array
    sensed: Array


@dataclass
class Plant:
    """A model that runs with causes.

    Attributes:
        model: Finer time step, true physics; it is altered by the causes.
        control_dt: Seconds between commands.
        causes: In the order in which they act.
        noise: Standard deviations of the tangent coordinates' noise, ``(2 nv,)``.
        rng: Of noise and of random causes.
    """

    model: mujoco.MjModel
    control_dt: float
    causes: Sequence[Cause]
    noise: Array
    rng: np.random.Generator
    data: mujoco.MjData = field(init=False)
    commands: list[Array] = field(init=False, default_factory=list)
    states: list[Array] = field(init=False, default_factory=list)
    acts: list[Array] = field(init=False, default_factory=list)
    sensed: list[Array] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        for cause in self.causes:
            cause.write(self.model)
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        self.data = mujoco.MjData(self.model)
        self.substeps = round(self.control_dt / self.model.opt.timestep)

    @property
    def dt(self) -> float:
        """Seconds of a time step."""
        return self.model.opt.timestep

    @property
    def time(self) -> float:
        """Seconds since the start."""
        return self.data.time

    @property
    def q(self) -> Array:
        """Positions, of hinges and slides first, each where its degree of freedom is."""
        return self.data.qpos

    @property
    def v(self) -> Array:
        """Velocities."""
        return self.data.qvel

    def run(self, q: Array, v: Array, policy: Policy, *, steps: int) -> Motion:
        """Return a trajectory from a state in tangent coordinates.

        Raises:
            FloatingPointError: The simulation diverged.
        """
        self.begin(np.concatenate([q, v]))
        clean, measured = [], []
        for k in range(steps):
            clean.append(self._read())
            measured.append(self._noisy(clean[-1]))
            self.commands.append(np.asarray(policy(k, measured[-1]), dtype=np.float64))
            self.go()
        rows, nv = np.array(clean), self.model.nv
        if not np.isfinite(rows).all() or np.abs(rows).max() > 1e3:
            raise FloatingPointError("the simulation diverged")
        acts = np.array(self.acts).reshape(steps, len(self.causes))
        sensed = np.array(self.sensed).reshape(steps, len(self.causes), 2 * nv)
        commands = np.array(self.commands)
        return Motion(rows, np.array(measured), rows[:, :nv], commands, acts, sensed)

    def follow(self, states: Array, commands: Array, at: Collection[int]) -> Array:
        """Return what is measured along another robot's motion, in pieces.

        What causes remember goes on from piece to piece; a piece ends with the row at which the
        next one begins.

        Args:
            states: Of the other robot, ``(T, 2 nv)``.
            commands: That it was given, ``(T, nu)``.
            at: Control steps at which this robot is put into the other's state, beside the first.

        Returns:
            Shape ``(T, 2 nv)``.
        """
        self.begin(states[0])
        nv, rows = self.model.nv, []
        for k, command in enumerate(commands):
            rows.append(self._aside() if k in at else self._read())
            if k in at:
                self._place(states[k, :nv], states[k, nv:])
                self._read()  # what sensors remember of the row is the state that follows
            self.commands.append(command)
            self.go()
        return np.array(rows)

    def _aside(self) -> Array:
        """Return what is measured, which no cause remembers."""
        memories = [deepcopy(cause.memory) for cause in self.causes]
        row = self._read()
        for cause, memory in zip(self.causes, memories, strict=True):
            cause.memory.clear()
            cause.memory.update(memory)
        for rows in (self.states, self.acts, self.sensed):
            rows.pop()
        return row

    def begin(self, state: Array) -> None:
        """Start a trajectory: nothing was commanded, and no cause remembers anything."""
        self.commands, self.states, self.acts, self.sensed = [], [], [], []
        for cause in self.causes:
            cause.memory.clear()
        self._reset(*np.split(state, 2))

    def go(self) -> None:
        """Go on by a control step, with the last command."""
        for _ in range(self.substeps):
            self._step()

    def _reset(self, q: Array, v: Array) -> None:
        """Put the robot into a state, at time zero."""
        mujoco.mj_resetData(self.model, self.data)
        self._place(q, v)

    def _place(self, q: Array, v: Array) -> None:
        """Put the robot into a state, now."""
        self.data.qpos[:], self.data.qvel[:] = positions(self.model, q), v
        mujoco.mj_forward(self.model, self.data)

    def _advance(self, u: Array, force: Array) -> None:
        """Go on by a time step, with the commands that arrive and generalised forces."""
        self.data.ctrl[:], self.data.qfrc_applied[:] = u, force
        mujoco.mj_step(self.model, self.data)

    def _noisy(self, y: Array) -> Array:
        nv, noise = self.model.nv, self.noise * self.rng.standard_normal(len(self.noise))
        return np.concatenate([displaced(self.model, y[:nv], noise[:nv]), y[nv:] + noise[nv:]])

    def _read(self) -> Array:
        y = np.concatenate([coordinates(self.model, self.q), self.v])
        self.states.append(y)
        self.acts.append(np.zeros(len(self.causes)))
        self.sensed.append(np.zeros((len(self.causes), len(y))))
        for i, cause in enumerate(self.causes):
            seen = cause.sense(y, self)
            self._acted(i, seen - y)
            self.sensed[-1][i] = seen - y
            y = seen
        return y

    def _step(self) -> None:
        u = self.commands[-1]
        for i, cause in enumerate(self.causes):
            arrives = cause.command(u, self)
            self._acted(i, arrives - u)
            u = arrives
        total = np.zeros(self.model.nv)
        for i, cause in enumerate(self.causes):
            force = cause.force(self)
            self._acted(i, force)
            total += force
        self._advance(u, total)

    def _acted(self, cause: int, change: Array | float) -> None:
        """Note how much a cause changed."""
        largest = float(np.max(np.abs(change)))
        self.acts[-1][cause] = max(self.acts[-1][cause], largest)


@dataclass(frozen=True)
class Truth:
    """What a cause is called by the sealed labels.

    Attributes:
        name: In the language of the report; a name of its own where the report has none.
        form: ``same`` as the catalogue's, or ``other``.
        joint: Where it acts; ``all`` where it acts on everything.
        channel: ``actuation``, ``body``, ``contact`` or ``sensing``.
        strength: By unit, where the report has the same definition.
    """

    name: str
    form: str
    joint: str
    channel: str
    strength: Mapping[str, float] = field(default_factory=dict)
