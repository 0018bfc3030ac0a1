r"""What does an experiment tell about an inverted pendulum's physics: excited, random, or at work?

The mass of the pole and the damping of its hinge are unknown. Three kinds of actions are played
from the same start: those that `excite` chooses under the prior, uniformly random ones, and those
of a controller that balances the pole at the nominal parameters. Positions are measured with noise
of 0.1 (m, rad), velocities with 1. The figure is the information gained, the divergence of the
exact posterior on a grid from the prior, in nats, over true parameters drawn from the prior. Prints
one JSON line per kind::

    python recipes/benchmarks/excitation.py [truths=20] [steps=50]
"""

from __future__ import annotations

import math
import sys

import torch
from measuring import options, report
from torch import Tensor

from torchrl_bayessim.excitation import Simulate, excite, replayed
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.randomness import generator

PRIOR = BoxPrior({"body_mass[pole]": (3.0, 7.0), "dof_damping[hinge]": (0.2, 2.0)})
NOMINAL = torch.tensor([[5.02, 1.0]])
NOISE = torch.tensor([0.1, 0.1, 1.0, 1.0])
GAIN = torch.tensor([1.0, 10.0, 1.0, 2.0])  # of cart and pole, positions then velocities
START = torch.tensor([0.0, 0.02, 0.0, 0.0], dtype=torch.float64)
POINTS = 41  # of the grid, per parameter


def information(simulate: Simulate, actions: Tensor, truth: Tensor, *, seed: int) -> float:
    """Return the nats that one noisy experiment gives, by quadrature on a grid."""
    axes = [torch.linspace(0, 1, POINTS) for _ in PRIOR.names]
    unit = torch.cartesian_prod(*axes)
    grid = PRIOR.low + unit * (PRIOR.high - PRIOR.low)
    y = simulate(torch.cat([truth, grid]), actions[None])[:, 0]
    measured = y[0] + NOISE * torch.randn(y[0].shape, generator=generator(seed, "noise"))
    log_likelihood = -0.5 * ((y[1:] - measured) / NOISE).square().sum((-1, -2))
    log_posterior = log_likelihood.log_softmax(0)
    return (log_posterior.exp() * (log_posterior + math.log(len(grid)))).sum().item()


def balanced(simulate: Simulate, steps: int) -> Tensor:
    """Return the actions of a controller that balances the pole at the nominal parameters."""
    actions = torch.zeros(1, steps, 1)
    state = START
    for t in range(steps):
        actions[0, t] = (GAIN @ state.float()).clamp(-3, 3)
        state = simulate(NOMINAL, actions[:, : t + 1])[0, 0, -1]
    return actions[0]


def main(*arguments: str) -> None:
    """Measure every kind of actions."""
    given = options(list(arguments), truths=20, steps=50)
    torch.set_num_threads(1)
    steps = given["steps"]
    start = {"qpos": START[:2], "qvel": START[2:]}
    simulate = replayed("InvertedPendulum-v5", start, MujocoPhysics(*PRIOR.names))
    bounds = (torch.tensor([-3.0]), torch.tensor([3.0]))
    theta = PRIOR.sample((32,), generator=generator(0, "beliefs"))
    found = excite(simulate, theta, noise=NOISE, bounds=bounds, steps=steps)
    random = 6 * torch.rand(given["truths"], steps, 1, generator=generator(0, "random")) - 3
    work = balanced(simulate, steps)
    truths = PRIOR.sample((given["truths"],), generator=generator(0, "truths"))
    cases = {
        "excited": lambda _: found.actions,
        "random": lambda i: random[i],
        "task policy": lambda _: work,
    }
    nats = {
        case: [
            information(simulate, actions(i), truth[None], seed=i) for i, truth in enumerate(truths)
        ]
        for case, actions in cases.items()
    }
    for case, values in nats.items():
        gained = sum(a - b for a, b in zip(nats["excited"], values, strict=True)) / len(values)
        context = {"seed": f"0 to {len(values) - 1}", "threads": 1}
        report("excitation", case, values, unit="nats", excited_gains=round(gained, 3), **context)


if __name__ == "__main__":
    main(*sys.argv[1:])
