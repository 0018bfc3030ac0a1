"""Effects on whole records of commands or measurements, in as few calls as their laws allow."""

from __future__ import annotations

__all__ = [
    "command_sequence",
    "forces_in_stages",
    "in_stages",
    "measured_sequence",
    "restored_sequence",
]

from collections.abc import Iterable
from types import SimpleNamespace

import torch
from torch import Tensor

from ..randomness import generator
from .effect import ActionEffect, Effect, ForceEffect, Now, SensorEffect
from .robot import Robot


def in_stages(effects: Iterable[Effect]) -> list[ActionEffect]:
    """Return the effects on commands in the order in which they act (`ActionEffect.stage`).

    Example:
        >>> from torchrl_bayessim.effects.catalogue import effect
        >>> some = map(effect, ["saturation", "coulomb_friction", "action_bias", "action_delay"])
        >>> [one.name for one in in_stages(some)]
        ['action_delay', 'action_bias', 'saturation']
    """
    kinds = [one for one in effects if isinstance(one, ActionEffect)]
    return sorted(kinds, key=lambda one: (one.stage, one.name))


def forces_in_stages(effects: Iterable[Effect]) -> list[ForceEffect]:
    """Return the effects on forces in the order in which they are asked (`ForceEffect.stage`).

    Example:
        >>> from torchrl_bayessim.effects.drive_timing import DriveDelay, DriveLag
        >>> from torchrl_bayessim.effects.friction import QuadraticDrag
        >>> [one.name for one in forces_in_stages([QuadraticDrag(), DriveLag(), DriveDelay()])]
        ['action_delay', 'action_lag', 'quadratic_drag']
    """
    kinds = [one for one in effects if isinstance(one, ForceEffect)]
    return sorted(kinds, key=lambda one: (one.stage, one.name, repr(one)))


def command_sequence(
    effect: ActionEffect,
    actions: Tensor,
    strength: Tensor,
    robot: Robot,
    *,
    time: Tensor | None = None,
    noise: Tensor | None = None,
    seed: int = 0,
) -> Tensor:
    """Return what reaches the actuators of a sequence of commands.

    Args:
        effect: The effect.
        actions: Shape ``(*batch, T, A)``.
        strength: Shape ``(*batch, A)``; batches are broadcast.
        robot: The robot.
        time: Seconds since the episode began, shape ``(*batch, T)``; default ``0, Δ, 2 Δ, …``.
        noise: For random effects, uniform numbers in [0, 1), shape ``(*batch, T, A)``; default
            from ``seed``, the same along all but the last of the batch dimensions.
        seed: Of the default noise.

    Returns:
        Shape ``(*batch, T, A)``.

    Example:
        >>> from torchrl_bayessim.effects.catalogue import effect
        >>> robot = Robot(dt=0.1, actuators=("motor",), command_scale=torch.ones(1))
        >>> actions = torch.tensor([[0.0], [1.0], [1.0]])
        >>> command_sequence(effect("action_delay"), actions, torch.tensor([0.05]), robot)[:, 0]
        tensor([0.0000, 0.5000, 1.0000])
    """
    now = _now(actions, robot, time, _noise(effect, actions, noise, seed))
    return _whole(effect, actions, strength, now)


def measured_sequence(
    effect: SensorEffect,
    readings: Tensor,
    strength: Tensor,
    robot: Robot,
    *,
    time: Tensor | None = None,
    noise: Tensor | None = None,
    seed: int = 0,
) -> Tensor:
    """Return what is measured of a record of true values, shape ``(*batch, T, C)``.

    The arguments are those of `command_sequence`, with channels in place of actuators.

    Example:
        >>> from torchrl_bayessim.effects.catalogue import effect
        >>> robot = Robot(dt=0.1, channels=("q",), channel_scale=torch.ones(1))
        >>> q = torch.tensor([[0.0], [1.0], [2.0]])
        >>> measured_sequence(effect("sensor_drift"), q, torch.tensor([0.5]), robot)[:, 0]
        tensor([0.0000, 1.0500, 2.1000])
    """
    now = _now(readings, robot, time, _noise(effect, readings, noise, seed))
    return _whole(effect, readings, strength, now)


def restored_sequence(
    effect: SensorEffect,
    measured: Tensor,
    strength: Tensor,
    robot: Robot,
    *,
    time: Tensor | None = None,
) -> Tensor:
    """Return the true values behind a record, as far as they can be known, ``(*batch, T, C)``."""
    return effect.restore(measured, strength, _now(measured, robot, time, None))


def _noise(effect: Effect, record: Tensor, noise: Tensor | None, seed: int) -> Tensor | None:
    if noise is None and effect.random:
        own = generator(seed, effect.name)
        noise = torch.rand(record.shape[-3:], generator=own, dtype=torch.float64)
    return noise


def _now(record: Tensor, robot: Robot, time: Tensor | None, noise: Tensor | None) -> Now:
    if time is None:
        time = robot.dt * torch.arange(record.shape[-2], dtype=torch.float64)
    noise = None if noise is None else noise.to(record)
    return SimpleNamespace(robot=robot, time=time.unsqueeze(-1), noise=noise)


def _whole(
    effect: ActionEffect | SensorEffect, record: Tensor, strength: Tensor, now: Now
) -> Tensor:
    """Apply a law to all steps: at once if it can, else one by one."""
    law = effect.command if isinstance(effect, ActionEffect) else effect.measure
    strength = strength.to(record)
    shape = torch.broadcast_shapes(record.shape, strength.unsqueeze(-2).shape)
    record = record.expand(shape)
    if effect.memoryless:
        return law(record, strength.unsqueeze(-2), {}, now)[0]
    whole = getattr(effect, "whole", None)
    if whole is not None:
        return whole(record, strength, now)
    memory = effect.start(record[..., 0, :])
    steps = []
    for t in range(shape[-2]):
        noise = None if now.noise is None else now.noise[..., t, :]
        step = SimpleNamespace(robot=now.robot, time=now.time[..., t, :], noise=noise)
        value, memory = law(record[..., t, :], strength, memory, step)
        steps.append(value)
    return torch.stack(steps, -2)
