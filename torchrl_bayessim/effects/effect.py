"""What an effect is: a change to commands, forces, the model or measurements, with one strength.

An effect is a law without state of its own. Strengths have shape ``(*batch, N)``, one for each of
its ``N`` targets (see `Effect.targets`), zero where it is off; batches are environments or the
candidates of a diagnosis. A law's hidden state (a delay line, the side of a backlash gap) is its
*memory*, a dictionary of tensors with leading dimensions ``batch``: `start` returns it for the
beginning of an episode, and each call returns the next one. Nothing is drawn inside a law: what is
random reads ``now.noise``. So a law runs in a transform around any environment and in the batched
replay of a diagnosis, with the same numbers.

An effect of one's own is a short class::

    class Hysteresis(ActionEffect):
        name, unit, group = "hysteresis", "fraction", "gain"

        def command(self, action, strength, memory, now):
            return action * (1 - strength * (memory["last"] * action < 0)), {"last": action}

        def start(self, action):
            return {"last": torch.zeros_like(action)}

        def bounds(self, robot):
            return torch.zeros(len(robot.actuators)), torch.ones(len(robot.actuators))
"""

from __future__ import annotations

__all__ = [
    "ActionEffect",
    "Effect",
    "Fields",
    "ForceEffect",
    "Memory",
    "ModelEffect",
    "Now",
    "Reach",
    "SensorEffect",
]

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple, Protocol

from torch import Tensor

from .robot import Robot

Memory = Mapping[str, Tensor]
Now = SimpleNamespace
"""What a law may look at; tensors ``(*batch, size)``.

``robot``: the `Robot`; ``time``: seconds since the episode began, ``(*batch, 1)``; ``noise``:
uniform numbers in [0, 1) of this control step, as many as there are targets, for random effects.
For forces, in joint order: ``position`` and ``velocity`` ``(*batch, J)``, and ``load``, the
generalised force that actuators exert ``(*batch, J)``, and ``bias``, what holds them against
gravity, Coriolis and centrifugal forces ``(*batch, J)``, or ``bias_of(some)``, in which only those
simulations ``(*batch,)`` count, and which takes less time; in actuator order: ``command``,
``actuator_velocity``, ``actuator_force``, ``demanded_force``, which is the same without limits, and
``actuator_gain``, the force per unit of command ``(*batch, A)``; and ``timestep``, the seconds that
a force is held (a float).
"""


class Reach(NamedTuple):
    """How far a robot went where an effect acts: what the smallest change that shows depends on.

    Attributes:
        position: Largest distance from zero, rad or m.
        velocity: Largest speed, rad/s or m/s.
        time: Seconds since the episode began, at most.
        slides: Whether the joint is a slide.
    """

    position: float
    velocity: float
    time: float
    slides: bool


class Effect(ABC):
    """One cause, with one strength per target.

    Attributes:
        name: Its name in the catalogue.
        unit: Of the strength: SI, for hinges where that differs from slides (`units`), or
            ``fraction``, ``command`` or ``channel`` for the command's or channel's own.
        group: Effects of one group act alike; where data cannot tell them apart they are reported
            together: ``timing``, ``friction``, ``gain``, ``offset``, ``elasticity``, ``inertia``,
            ``contact``, ``geometry``, ``noise``, ``disturbance``, ``dead zone``.
        channel: Where it sits: ``sensing``, ``actuation``, ``body`` or ``contact``.
        random: Whether it changes the distribution of what is seen rather than its mean.
        memoryless: Whether the law depends on this step only, so that sequences are one call.
        limit: Whether a small strength does nothing to a robot that stays far from the limit.
        search_power: Searches and fits count strengths by ``(s / s_max)^(1 / power)``: 2 where
            what shows is a period and ``s`` its square, so that fast ones are told apart too.
        graded: Whether twice the strength does about twice as much, so that searches may scale it:
            the step to which commands are rounded does not.
        nuisances: Options of `free` of which no value is the usual one: fitted like strengths, and
            what is not known of them widens the intervals of strengths in any case.
        placed: Options of `free` that are read off the data before the effect is offered, such as
            frequency and phase: numbers that it has beside its strength, and that it is priced for.
    """

    name: ClassVar[str]
    unit: ClassVar[str]
    group: ClassVar[str]
    channel: ClassVar[str]
    random: ClassVar[bool] = False
    memoryless: ClassVar[bool] = False
    limit: ClassVar[bool] = False
    search_power: ClassVar[float] = 1.0
    graded: ClassVar[bool] = True
    nuisances: tuple[str, ...] = ()
    placed: ClassVar[tuple[str, ...]] = ()

    def __eq__(self, other: object) -> bool:
        """Return whether the other is the same law with the same options."""
        return type(self) is type(other) and vars(self) == vars(other)

    def __hash__(self) -> int:
        return hash((type(self), *sorted(vars(self).items())))

    def __repr__(self) -> str:
        options = ", ".join(f"{name}={value!r}" for name, value in vars(self).items())
        return f"{type(self).__name__}({options})"

    @classmethod
    def law(cls, **options: Any) -> Effect:
        """Return the law of this name that has these options."""
        return cls(**options)

    @property
    def form(self) -> dict[str, Any]:
        """What the law has beside its strength, by the names of the options."""
        return dict(vars(self))

    def on(self, robot: Robot) -> Effect:
        """Return the law that this effect is on this robot: itself, unless actuators matter."""
        del robot
        return self

    def forms(self, seconds: float) -> tuple[Effect, ...]:
        """Return the laws that go by this name: a diagnosis that is given the name tries all.

        Args:
            seconds: How long runs are.
        """
        del seconds
        return (self,)

    def free(self, reach: Reach) -> Mapping[str, tuple[float, float, float]]:
        """Return the options that a diagnosis fits once the effect is in the model; default none.

        Args:
            reach: How far the robot went.

        Returns:
            By the option's name, a change that shows a little, its least and its largest value.
            What is neither in ``placed`` nor in ``nuisances`` bends the law from what was offered.
        """
        del reach
        return {}

    @abstractmethod
    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the names of what it can act on, empty where it does not apply."""

    @abstractmethod
    def bounds(self, robot: Robot) -> tuple[Tensor, Tensor]:
        """Return the lowest and highest plausible strength of each target, shape ``(N,)`` each.

        The lowest is zero, or negative where the sign is free.
        """

    def joint(self, robot: Robot, target: int) -> int:
        """Return the joint at which a target sits, -1 for none."""
        del robot, target
        return -1


class ActionEffect(Effect):
    """Changes the command, at every control step; targets are actuators.

    Attributes:
        stage: Where it is on the way from the controller to the joint: of several, those of a lower
            stage act first. An offset before a limit is not one behind it. Those of the catalogue
            have 0 (lost packets) to 10 (a lag); 6, the default, is behind offsets and gains, and
            before dead bands and limits.
    """

    channel = "actuation"
    stage: ClassVar[int] = 6

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the actuators' names."""
        return robot.actuators

    def joint(self, robot: Robot, target: int) -> int:
        """Return the joint that the actuator moves."""
        return robot.joint_of_actuator[target]

    def start(self, action: Tensor) -> Memory:
        """Return the memory at the beginning, for actions of this shape and kind.

        Only their shape and kind count: a transform asks before there is an action.
        """
        del action
        return {}

    @abstractmethod
    def command(
        self, action: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return what reaches the actuators, shape ``(*batch, A)``, and the new memory."""


class ForceEffect(Effect):
    """Adds to forces, friction, damping or commands at every time step of a MuJoCo model.

    Targets are joints unless `targets` says otherwise.

    Attributes:
        stage: As of `ActionEffect`: of several, those of a lower stage are asked first, and what
            they change of the commands is what the others see.
    """

    channel = "body"
    stage: ClassVar[int] = 20

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the joints' names, none without a MuJoCo model."""
        return () if robot.model is None else robot.joints

    def joint(self, robot: Robot, target: int) -> int:
        """Return the joint."""
        del robot
        return target

    def start(self, velocity: Tensor) -> Memory:
        """Return the memory at the beginning, for joint velocities of this shape and kind."""
        del velocity
        return {}

    @abstractmethod
    def forces(
        self, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Mapping[str, Tensor], Memory]:
        """Return what is added in this time step, and the new memory.

        Returns:
            Any of ``force``, ``frictionloss`` and ``damping``, shape ``(*batch, J)`` in N m or N
            (dry friction and damping are solved implicitly, and so stay stable), and ``command``,
            what is added to the commands, shape ``(*batch, A)``.
        """


class Fields(Protocol):
    """Entries of the model, by ``MjModel`` field and index, in every member of a batch."""

    def __getitem__(self, entry: tuple[str, tuple[int, ...]]) -> Tensor:
        """Return the value that holds without effects (or with those before), shape ``batch``."""
        ...

    def __setitem__(self, entry: tuple[str, tuple[int, ...]], value: Tensor) -> None:
        """Set the value, shape ``batch``."""
        ...


class ModelEffect(Effect):
    """Changes entries of a MuJoCo model, once, at the beginning."""

    channel = "body"

    @abstractmethod
    def write(self, fields: Fields, strength: Tensor, robot: Robot) -> None:
        """Set entries, given their values without the effect; masses bring their inertias along."""


class SensorEffect(Effect):
    """Changes what is measured, at every control step; targets are channels."""

    channel = "sensing"

    def targets(self, robot: Robot) -> tuple[str, ...]:
        """Return the channels' names."""
        return robot.channels

    def joint(self, robot: Robot, target: int) -> int:
        """Return the joint that the channel measures."""
        return robot.channel_joint[target]

    def start(self, reading: Tensor) -> Memory:
        """Return the memory at the beginning, for values of this shape and kind."""
        del reading
        return {}

    @abstractmethod
    def measure(
        self, reading: Tensor, strength: Tensor, memory: Memory, now: Now
    ) -> tuple[Tensor, Memory]:
        """Return what is measured of the true values, shape ``(*batch, C)``, and the new memory."""

    def restore(self, measured: Tensor, strength: Tensor, now: Now) -> Tensor:
        """Return the true values behind a whole record, as far as they can be known.

        Args:
            measured: The record, shape ``(*batch, T, C)``.
            strength: Shape ``(*batch, C)``.
            now: Its ``time`` has shape ``(*batch, T, 1)``; ``robot.dt`` are the seconds per step.
        """
        del strength, now
        return measured
