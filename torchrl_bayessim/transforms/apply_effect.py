"""An effect of the catalogue on any environment, as a transform."""

from __future__ import annotations

__all__ = ["ApplyEffect"]

from types import SimpleNamespace
from typing import Any, Self

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, Transform

from ..effects.catalogue import effect as known_effect
from ..effects.effect import ActionEffect, Effect, ForceEffect, Memory, ModelEffect, SensorEffect
from ..effects.memory import renewed
from ..effects.overlay import Overlay
from ..effects.push import Push
from ..effects.robot import Robot
from ..effects.strength import Strength, strength_of
from ..errors import message
from ..kinds import check_kind
from ..physics.mujoco_models import models_of
from ..randomness import generator
from .resets import resets, simulator
from .simulators import add_every_time_step, robot_of_env


class ApplyEffect(Transform):
    """Lets an effect act: on actions, on what is observed, on forces or on the model.

    Effects on actions and observations act around any environment, those on forces at every time
    step (on a fast robot a drive's lag, and a delay within the control step) and those on the model
    at resets of a MuJoCo environment. Hidden state starts anew where an environment resets. Beside
    an `ApplyPhysics`, put it after that: at a reset the parameters are written first, and the
    effect changes what is then in force, never its own last change. Effects on the model are
    written after the simulator's own reset, whose observation is the one without them. Of several
    around one environment the last is the first that an action meets, and of those on forces the
    first is asked first.

    Args:
        effect: The effect, or its name in the catalogue.
        strength: One number for all targets, one for each, shape ``(N,)`` or ``(*batch, N)``, or
            by target. It may be set anew at any time; model effects heed it from the next reset
            of an environment on, the others at once. Clones share it.
        robot: What it acts on; default what the environment says of itself.
        key: The entry that holds the action or observation; default the environment's action,
            and ``observation``.
        channels: Names of the elements of the observation; default their numbers.
        seed: Of random effects.

    Raises:
        KeyError: The catalogue has no such effect, or the effect no such target.
        PhysicsError: The environment is not one of MuJoCo's, for effects on forces or the model.
        TypeError: The effect is none, nor a name; it is put around a ``SerialEnv`` or
            ``ParallelEnv``, for the same; or without ``robot``.
        ValueError: The robot has no target for it, or the strengths do not fit the targets.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> friction = ApplyEffect("coulomb_friction", {"hinge": 0.1})
        >>> env = TransformedEnv(GymEnv("InvertedPendulum-v5"), friction)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([3, 4])
        >>> friction.strength = {"hinge": 0.2}
    """

    def __init__(
        self,
        effect: Effect | str,
        strength: Strength,
        *,
        robot: Robot | None = None,
        key: NestedKey | None = None,
        channels: tuple[str, ...] = (),
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_kind("an effect or the name of one", effect, str, Effect)
        self.effect = known_effect(effect) if isinstance(effect, str) else effect
        self.key, self.channels = key, channels
        self._shared: dict[str, Any] = {"robot": robot, "strength": strength, "identity": object()}
        self._random = generator(seed, self.effect.name)
        self._memory: Memory | None = None
        self._action = torch.zeros(0)  # the last one, for its shape
        self._steps = torch.zeros(0)  # since the episode began, shape (*batch, 1)
        self._acting: Push | Overlay | None = None  # on the simulator
        if robot is not None:
            self.effect = self.effect.on(robot)
            self.strength = strength

    @property
    def robot(self) -> Robot:
        """What it acts on.

        Raises:
            ValueError: Nothing is known of it before it is put on an environment.
        """
        robot = self._shared["robot"]
        if robot is None:
            expected = f"an environment or a robot for {self.effect.name}"
            raise ValueError(message(expected, "none", hint="robot=robot_of(task)"))
        return robot

    @property
    def targets(self) -> tuple[str, ...]:
        """The names of what it acts on, in the order of strengths."""
        return self.effect.targets(self.robot)

    @property
    def strength(self) -> Tensor:
        """Strengths, shape ``(N,)`` or ``(*batch, N)``."""
        return self._shared["strength"]

    @strength.setter
    def strength(self, strength: Strength) -> None:
        self._shared["strength"] = strength
        if self._shared["robot"] is None:  # checked when it is put on an environment
            return
        values = strength_of(self.effect.name, strength, self.targets)
        if self.parent is not None:
            batch = self.parent.batch_size
            try:
                values.expand(*batch, len(self.targets))
            except RuntimeError:
                expected = f"strengths of {self.effect.name} of shape {(*batch, len(self.targets))}"
                raise ValueError(message(expected, tuple(values.shape))) from None
        self._shared["strength"] = values

    def clone(self) -> Self:
        """Return a copy with a hidden state of its own, and the same strength."""
        copy = super().clone()
        copy._shared, copy._memory = self._shared, None
        return copy

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach to the environment."""
        super().set_container(container)
        if self.parent is None:  # in a Compose that has no environment yet
            return
        env = simulator(self.parent)
        self._refuse_several(env)
        self.know(env, self.parent)
        self.effect = self.effect.on(self.robot)
        self._refuse_several(env)
        self.strength = self._shared["strength"]
        self._steps = torch.zeros(*env.batch_size, 1, dtype=torch.float64)
        if self.key is None:
            acts = isinstance(self.effect, ActionEffect)
            self.key = self.parent.action_key if acts else "observation"
        # Noted on the environment under what clones share, since TorchRL makes clones of transforms
        # to say what comes before others: they are the same effect, once, with one hidden state.
        acting, identity = env.__dict__.setdefault("_effects", {}), self._shared["identity"]
        if isinstance(self.effect, ForceEffect):
            if identity not in acting:
                shared = self._shared
                acting[identity] = Push(self.effect, self.robot, lambda: shared["strength"])
            add_every_time_step(env, identity, acting[identity])
        elif isinstance(self.effect, ModelEffect):
            models = models_of(env)
            acting.setdefault(identity, Overlay(models))
        self._acting = acting.get(identity)

    def _refuse_several(self, env: EnvBase) -> None:
        """Raise where an effect on a simulator would be put around several of them."""
        onto_simulator = isinstance(self.effect, ForceEffect | ModelEffect)
        if onto_simulator and isinstance(env, SerialEnv | ParallelEnv):
            name = self.effect.name
            hint = "put it inside the function that makes each environment"
            got = f"{name} around a {type(env).__name__}"
            raise TypeError(message(f"{name} beside each simulator", got, hint=hint))

    def know(self, env: EnvBase, outside: EnvBase | None = None) -> None:
        """Learn from a simulator what there is to act on, where no robot was given.

        Args:
            env: The simulator.
            outside: The environment with the transforms before this one; default none.

        Raises:
            TypeError: It is several simulators.
            PhysicsError: It is not one of MuJoCo's, for effects on forces or the model.
            ValueError: It does not say how long a control step is.
        """
        if self._shared["robot"] is not None:
            return
        if isinstance(env, SerialEnv | ParallelEnv):
            expected = f"robot= for {self.effect.name} around several simulators"
            raise TypeError(message(expected, "none"))
        if isinstance(self.effect, ForceEffect | ModelEffect):
            models_of(env)  # or an error
        robot = robot_of_env(env)
        if isinstance(self.effect, SensorEffect):
            key = self.key or "observation"
            size = (env if outside is None else outside).full_observation_spec[key].shape[-1]
            names = self.channels or tuple(f"{key}{i}" for i in range(size))
            robot = Robot(
                dt=robot.dt,
                channels=names,
                channel_scale=torch.ones(len(names), dtype=torch.float64),
                channel_joint=(-1,) * len(names),
                channel_kind=("other",) * len(names),
            )
        self._shared["robot"] = robot

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Lift the bounds of what a sensor effect changes."""
        if isinstance(self.effect, SensorEffect):
            assert isinstance(observation_spec, Composite)  # what TorchRL hands to transforms
            key = self.key or "observation"
            spec = observation_spec[key]
            observation_spec[key] = Unbounded(spec.shape, dtype=spec.dtype, device=spec.device)
        return observation_spec

    # What happens at a step.

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not isinstance(self.effect, ActionEffect):
            return tensordict
        assert self.key is not None  # set when it was put on an environment
        action = tensordict.get(self.key)
        if self._memory is None:
            self._memory = self.effect.start(action)
        self._action = action
        now, strength = self._now(action)
        changed, self._memory = self.effect.command(action, strength, self._memory, now)
        self._steps = self._steps + 1
        return tensordict.set(self.key, changed)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        del tensordict
        if isinstance(self.effect, SensorEffect):
            self._steps = self._steps + 1
            self._show(next_tensordict, None)
        return next_tensordict

    def _show(self, tensordict: TensorDictBase, mask: Tensor | None) -> None:
        """Replace the observation by what is measured of it, in ``mask`` or everywhere."""
        assert isinstance(self.effect, SensorEffect)
        assert self.key is not None  # set when it was put on an environment
        reading = tensordict.get(self.key)
        if self._memory is None:
            self._memory = self.effect.start(reading)
        elif mask is not None:
            self._memory = renewed(self._memory, self.effect.start(reading), mask)
        now, strength = self._now(reading)
        shown, memory = self.effect.measure(reading, strength, self._memory, now)
        # what environments that go on have seen is theirs, and their memory too
        self._memory = memory if mask is None else renewed(self._memory, memory, mask)
        tensordict.set(self.key, shown)

    def _now(self, value: Tensor) -> tuple[SimpleNamespace, Tensor]:
        """Return what the law may look at, and the strengths, of the kind of ``value``."""
        noise = None
        if self.effect.random:
            noise = torch.rand(value.shape, generator=self._random, dtype=torch.float64)
            noise = noise.to(value)
        time = self._steps * self.robot.dt
        return SimpleNamespace(robot=self.robot, time=time, noise=noise), self.strength.to(value)

    # What happens at a reset.

    def _reset_env_preprocess(self, tensordict: TensorDictBase | None) -> TensorDictBase | None:
        if isinstance(self._acting, Overlay):
            self._acting.remove(self._rows(tensordict))
        return tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        mask = resets(self.parent, tensordict)
        self._steps = torch.where(mask.unsqueeze(-1), 0.0, self._steps)
        if isinstance(self.effect, SensorEffect):
            self._show(tensordict_reset, mask)
        elif isinstance(self._acting, Push):
            self._acting.begin(mask)
        elif isinstance(self._acting, Overlay):
            assert isinstance(self.effect, ModelEffect)
            rows = self._rows(tensordict)
            strength = self.strength.expand(len(rows), -1)
            self._acting.put(self.effect, strength, self.robot, rows)
        elif self._memory is not None:
            assert isinstance(self.effect, ActionEffect)
            self._memory = renewed(self._memory, self.effect.start(self._action), mask)
        return tensordict_reset

    def _rows(self, tensordict: TensorDictBase | None) -> Any:
        """Return which models a reset concerns, shape ``(P,)``."""
        assert self.parent is not None
        if tensordict is None:
            return torch.ones(self.parent.batch_size, dtype=torch.bool).reshape(-1).numpy()
        return resets(self.parent, tensordict).reshape(-1).numpy()

    def __repr__(self) -> str:
        return f"ApplyEffect({self.effect.name}, strength={self.strength})"
