"""Tests of a physics adapter, to be inherited, and a search for parameters without effect.

For a simulator of one's own, in a test file::

    class TestArmPhysics(PhysicsTests):
        physics = ArmPhysics()
        low, high = (0.5, 0.1), (2.0, 0.9)

        def make_env(self):
            return ArmEnv()
"""

from __future__ import annotations

__all__ = ["PhysicsTests", "unused_parameters"]

import warnings
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from ..errors import SimulationError, message
from ..randomness import generator, isolated
from .protocol import Physics
from .unused import differ, unused

Policy = Callable[[TensorDictBase], TensorDictBase]


def unused_parameters(
    make_env: Callable[[], EnvBase],
    physics: Physics,
    low: Sequence[float],
    high: Sequence[float],
    *,
    policy: Policy | None = None,
    steps: int = 100,
    seed: int = 0,
) -> tuple[str, ...]:
    """Return, and warn of, the parameters that leave a rollout exactly as it is.

    Each parameter goes from ``low`` to ``high`` at three random values of the others, under the
    same actions from the same start. No data can tell anything about one that changes nothing:
    its posterior is its prior.

    Args:
        make_env: Makes the environment, without transforms.
        physics: The adapter.
        low: The parameters' lower bounds, D numbers.
        high: Their upper bounds.
        policy: Chooses the actions, in the first rollout; they are replayed in the others. By
            default at random. It should visit what the parameters act on: contacts, say.
        steps: Length of the rollouts, unless an episode ends before.
        seed: Of the environment and of random actions.

    Raises:
        ValueError: There are not as many bounds as parameters.
        SimulationError: The same seed, parameters and actions gave two different rollouts.

    Example:
        >>> import warnings
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_bayessim.physics.attributes import AttributePhysics
        >>> physics = AttributePhysics("LINK_MASS_2", "LINK_LENGTH_2")
        >>> with warnings.catch_warnings(action="ignore"):
        ...     unused_parameters(lambda: GymEnv("Acrobot-v1"), physics, (0.5, 0.5), (2, 1.5))
        ('LINK_LENGTH_2',)
    """
    if not len(low) == len(high) == len(physics.names):
        expected = f"low and high for each of {physics.names}"
        raise ValueError(message(expected, f"{len(low)} and {len(high)} bounds"))
    env = make_env()
    bottom, top = torch.tensor(low, dtype=torch.float64), torch.tensor(high, dtype=torch.float64)
    draws = generator(seed, "others")
    others = [bottom + (top - bottom) * torch.rand(len(bottom), generator=draws) for _ in range(3)]
    actions = _record(env, physics, others[0], (policy, steps, seed))

    def replay(theta: Tensor) -> dict[str, Tensor]:
        return _replay(env, physics, theta, (actions, seed))

    if differ(replay(others[0]), replay(others[0])):
        expected = f"the same rollout from the same seed, parameters and actions ({seed=})"
        hint = "does set_seed reach everything random in the environment?"
        raise SimulationError(message(expected, "two that differ", hint=hint))
    found = unused(physics.names, (bottom, top), others, replay)
    if found:
        warnings.warn(
            f"{', '.join(found)}: {len(actions)} steps are exactly the same from the lower bound "
            "to the upper. Nothing can be learnt about a parameter without effect; is it hidden "
            "(MuJoCo takes the maximum of two frictions), unused by the simulator, or did the "
            "actions not reach what it acts on?",
            stacklevel=2,
        )
    env.close(raise_if_closed=False)
    return found


class PhysicsTests:
    """Tests that every adapter passes. Inherit, and give the four below.

    Attributes:
        physics: The adapter.
        low: Lower bounds of the parameters that the tests write, D numbers.
        high: Their upper bounds.
        unused: Names of parameters known to have no effect.
    """

    physics: Physics
    low: Sequence[float]
    high: Sequence[float]
    unused: tuple[str, ...] = ()

    def make_env(self) -> EnvBase:
        """Return a new environment, without transforms."""
        raise NotImplementedError

    def test_what_is_written_is_held_after_reset_and_through_the_episode(self) -> None:
        """Write, reset, read; then read after every step."""
        env = self.make_env()
        for theta in self._thetas(3):
            td = _start(env, self.physics, theta)
            _assert_held(env, self.physics, theta, td)
            for _ in range(10):
                td = env.step_mdp(env.rand_step(td))
                _assert_held(env, self.physics, theta, td)
                if td["done"].any():
                    break

    def test_writes_are_absolute(self) -> None:
        """Writing twice, or after other values, is writing once."""
        one, two = self._thetas(2)
        env = self.make_env()
        actions = _record(env, self.physics, one, (None, 20, 0))
        first = _replay(env, self.physics, one, (actions, 0))
        for theta in (one, one, two, one):
            again = _replay(env, self.physics, theta, (actions, 0))
        assert not differ(first, again), "writing other values in between changed the rollout"

    def test_nominal_values_can_be_restored(self) -> None:
        """What was read before the first write undoes every write."""
        env = self.make_env()
        empty = TensorDict(batch_size=env.batch_size)
        nominal = self.physics.read(env, tensordict=empty).reshape(-1, len(self.physics.names))[0]
        actions = _record(env, self.physics, nominal, (None, 20, 0))
        first = _replay(env, self.physics, nominal, (actions, 0))
        _start(env, self.physics, self._thetas(1)[0])
        again = _replay(env, self.physics, nominal, (actions, 0))
        assert not differ(first, again), "restoring nominal values did not restore the rollout"

    def test_environments_are_independent(self) -> None:
        """Writing one environment leaves another alone."""
        one, two = self._thetas(2)
        envs = [self.make_env(), self.make_env()]
        tds = [_start(e, self.physics, t) for e, t in zip(envs, (one, two), strict=True)]
        for env, theta, td in zip(envs, (one, two), tds, strict=True):
            _assert_held(env, self.physics, theta, td)

    def test_every_parameter_has_an_effect(self) -> None:
        """Only those in ``unused`` change nothing."""
        with warnings.catch_warnings(action="ignore"):
            found = unused_parameters(self.make_env, self.physics, self.low, self.high)
        assert set(found) == set(self.unused)

    def _thetas(self, count: int) -> Tensor:
        low, high = torch.tensor(self.low), torch.tensor(self.high)
        u = torch.rand(count, len(low), generator=generator("conformance"))
        return (low + (high - low) * u).to(torch.float64)


def _start(env: EnvBase, physics: Physics, theta: Tensor) -> TensorDictBase:
    """Write the same θ, shape ``(D,)``, into every environment, and reset."""
    td = TensorDict(batch_size=env.batch_size, device=env.device)
    mask = torch.ones(env.batch_size, dtype=torch.bool)
    physics.write(env, theta.expand(*env.batch_size, -1), mask=mask, tensordict=td)
    return env.reset(td, set_state=False)


def _record(
    env: EnvBase, physics: Physics, theta: Tensor, how: tuple[Policy | None, int, int]
) -> list[Tensor]:
    """Return the actions of ``steps`` steps, fewer if an episode ends."""
    policy, steps, seed = how
    env.set_seed(seed)
    actions = []
    with isolated(seed, "actions"):
        td = _start(env, physics, theta)
        for _ in range(steps):
            td = env.rand_action(td) if policy is None else policy(td)
            actions.append(td["action"].clone())
            td = env.step_mdp(env.step(td))
            if td["done"].any():
                break
    return actions


def _replay(
    env: EnvBase, physics: Physics, theta: Tensor, how: tuple[list[Tensor], int]
) -> dict[str, Tensor]:
    """Return what changes in time, shape ``(T, *)``, under given actions.

    Constant entries are left out: they only repeat the parameters.
    """
    actions, seed = how
    env.set_seed(seed)
    path = []
    with isolated(seed, "replay"):
        td = _start(env, physics, theta)
        for action in actions:
            td = env.step(td.set("action", action))
            path.append(td["next"].flatten_keys().clone())
            td = env.step_mdp(td)
            if td["done"].any():
                break
    entries = torch.stack(path).items()
    return {str(key): value for key, value in entries if (value != value[:1]).any()}


def _assert_held(env: EnvBase, physics: Physics, theta: Tensor, td: TensorDictBase) -> None:
    held = physics.read(env, tensordict=td).to(torch.float64)
    expected = theta.expand_as(held)
    assert torch.allclose(held, expected, rtol=1e-6, atol=1e-12), f"{held} is not {expected}"
