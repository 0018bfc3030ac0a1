"""One description of a robot that inference, randomisation and diagnosis share: ``system.yaml``.

It names the simulator, the columns of the logs, the parameters with their prior bounds, the
sensors' noise, and the effects to consider::

    simulator: robot.xml              # beside this file; or gymnasium:NAME, dm_control:DOMAIN/TASK
    control_dt: 0.01                  # s
    columns:
      time: t
      qpos: {hinge: q}                # joint: column, of free joints 7 columns
      qvel: {hinge: qd}               # may be missing
      ctrl: {motor: tau}              # actuator: column
    parameters:
      body_mass[link]: [0.3, 1.2]     # an entry of the model: prior bounds, SI units
      friction:                       # several entries of one value
        entries: ["dof_damping[hinge]", "dof_damping[wrist]"]
        bounds: [0.001, 0.5]
        log: true
    noise: {q: 0.001, qd: 0.02}       # standard deviations
    effects: all                      # or a list of names
"""

from __future__ import annotations

__all__ = ["System"]

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import torch

from ..effects.catalogue import each_once
from ..effects.robot import Robot, robot_of
from ..envs.task import Task
from ..errors import message
from ..inference.priors import BoxPrior
from ..kinds import check_kind
from ..physics.model_fields import resolve
from ..physics.mujoco import MujocoPhysics
from ..scalars import check_number
from .columns import Channel, Columns, channels, default_columns, joint_names
from .description import Description, read_description
from .simulators import simulator_task

_LARGEST = 1e8  # of noise, as of what is logged


@dataclass(frozen=True, kw_only=True, eq=False)
class System:
    """A robot's simulator, what is uncertain about it, and what its logs hold.

    Example:
        >>> from torchrl_bayessim.envs.tasks.catalogue import known_task
        >>> system = System(
        ...     task=known_task("InvertedPendulum-v5"),
        ...     physics=MujocoPhysics("body_mass[pole]"),
        ...     prior=BoxPrior({"body_mass[pole]": (2.0, 8.0)}),
        ...     noise={"hinge position": 0.001},
        ... )
        >>> system.robot.channels
        ('slider position', 'hinge position', 'slider velocity', 'hinge velocity')
        >>> system.channel_index
        (0, 1, 2, 3)

    Attributes:
        task: The simulator; logs hold its actions.
        columns: What the columns of logs hold; default: names of joints and actuators.
        physics: What is uncertain but modelled.
        prior: The prior over it.
        noise: Standard deviations of the noise of channels, where known.
        effects: Names of the effects to consider; ``None`` for all.

    Raises:
        TypeError: A part is of another kind.
        ValueError: The columns or the noise do not fit the model, the prior is over other
            parameters than the physics or over the time step, or an effect is named twice.
        PhysicsError: The model has no such parameter.
    """

    task: Task
    columns: Columns = None  # type: ignore[assignment]  # set below, where the model is known
    physics: MujocoPhysics | None = None
    prior: BoxPrior | None = None
    noise: Mapping[str, float] = field(default_factory=dict)
    effects: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        check_kind("a task", self.task, Task)
        if self.columns is None:
            object.__setattr__(self, "columns", default_columns(self.task))
        check_kind("columns of logs", self.columns, Columns)
        for part, kind in (self.physics, MujocoPhysics), (self.prior, BoxPrior):
            if part is not None:
                check_kind(f"a {kind.__name__} or None", part, kind)
        check_kind("deviations of noise by channel", self.noise, Mapping)
        self.columns.check(self.task)
        names = None if self.prior is None else self.prior.names
        physics = None if self.physics is None else self.physics.names
        if names != physics:
            raise ValueError(message(f"a prior over the physics {physics}", names))
        if self.physics is not None and "opt.timestep" in self.physics.fields:
            hint = "the effect time_scale, for a clock that runs wrong"
            expected = "parameters of the robot, not of the simulation"
            raise ValueError(message(expected, "opt.timestep", hint=hint))
        known = [channel.name for channel in self._channels]
        for name, value in self.noise.items():
            if name not in known:
                raise ValueError(message("a channel in noise", name, available=known))
            check_number(f"standard deviation of {name}", value, least=0.0, most=_LARGEST)
        each_once(() if self.effects is None else self.effects)

    @classmethod
    def load(cls, path: str | Path) -> System:
        """Return the system that a ``system.yaml`` describes.

        Raises:
            TypeError: The path is none.
            ValueError: The file is not plain YAML, has unknown or missing keys, or says something
                that does not fit the model.
            PhysicsError: The model has no such parameter.
        """
        check_kind("the path of a system.yaml", path, str, Path)
        path = Path(path)
        read = read_description(path)
        read.only("simulator", "control_dt", "columns", "parameters", "noise", "effects")
        control_dt = read.number("control_dt") if "control_dt" in read else None
        task = simulator_task(read.text("simulator"), path.parent, control_dt)
        physics, prior = _parameters(task, read.inner("parameters"))
        noise = read.inner("noise")
        effects = read.texts("effects") if "effects" in read else ("all",)
        return cls(
            task=task,
            columns=_columns(read.inner("columns")) if "columns" in read else None,  # type: ignore[arg-type]
            physics=physics,
            prior=prior,
            noise={name: noise.number(name) for name in noise},
            effects=None if effects == ("all",) else effects,
        )

    @property
    def control_dt(self) -> float:
        """Seconds between actions."""
        return self.task.dt

    @cached_property
    def robot(self) -> Robot:
        """Names, places and scales; its channels are what was measured."""
        full = robot_of(self.task)
        names = joint_names(self.task.model)
        joints = [full.joints.index(n) if n in full.joints else -1 for n in names]
        nv = self.task.model.nv
        kinds, scales = [], []
        for channel in self._channels:
            j = joints[channel.joint]
            kind = "position" if channel.index < nv else "velocity"
            kinds.append(kind if j >= 0 else "other")
            # a radian or a metre, and that in a quarter of a second, as of joints without limits
            scale = {"position": full.position_scale, "velocity": full.velocity_scale}[kind]
            default = 1.0 if kind == "position" else 4.0
            scales.append(float(scale[j]) if j >= 0 else default)
        return replace(
            full,
            channels=tuple(channel.name for channel in self._channels),
            channel_scale=torch.tensor(scales, dtype=torch.float64),
            channel_joint=tuple(joints[channel.joint] for channel in self._channels),
            channel_kind=tuple(kinds),
        )

    @cached_property
    def channel_index(self) -> tuple[int, ...]:
        """Where each channel is among the ``2 nv`` tangent coordinates, positions first."""
        return tuple(channel.index for channel in self._channels)

    @cached_property
    def _channels(self) -> list[Channel]:
        return channels(self.task.model, self.columns)


def _columns(read: Description) -> Columns:
    read.only("time", "qpos", "qvel", "ctrl")
    qpos, qvel, ctrl = (read.inner(key) for key in ("qpos", "qvel", "ctrl"))
    return Columns(
        time=read.text("time") if "time" in read else None,
        qpos={joint: qpos.texts(joint) for joint in qpos},
        qvel={joint: qvel.texts(joint) for joint in qvel},
        ctrl={actuator: ctrl.text(actuator) for actuator in ctrl},
    )


def _parameters(task: Task, read: Description) -> tuple[MujocoPhysics | None, BoxPrior | None]:
    entries: dict[str, tuple[str, ...]] = {}
    bounds: dict[str, tuple[float, float]] = {}
    log, written = [], set()
    for name in read:
        entries[name] = (name,)
        inner = read
        key = name
        if read.is_mapping(name):
            inner = read.inner(name).only("entries", "bounds", "log")
            entries[name], key = inner.texts("entries"), "bounds"
            if "log" in inner and _truth(inner.text("log")):
                log.append(name)
        low, high = inner.numbers(key, 2)
        bounds[name] = low, high
        for entry in entries[name]:
            target = resolve(task.model, entry)
            places = {(target.field, index) for index in target.indices}
            if places & written:
                raise ValueError(message("each entry of the model in one parameter", entry))
            written |= places
    if not bounds:
        return None, None
    physics = MujocoPhysics(**entries)
    units = dict(zip(physics.names, physics.units, strict=True)) if physics.units else {}
    return physics, BoxPrior(bounds, log=log, units=units)


def _truth(text: str) -> bool:
    if text not in {"true", "false"}:
        raise ValueError(message("true or false under 'log'", text))
    return text == "true"
