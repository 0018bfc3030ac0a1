r"""What does an experiment tell about an inverted pendulum's physics: excited, random, or at work?

The mass of the pole and the damping of its hinge are unknown. Four kinds of actions are played
from the same start: those that `excite` chooses under the prior; random ones that are linear
between as many uniformly random knots as `excite` has; uniformly random ones at every step; and
those of a controller that balances the pole at the nominal parameters. Positions are measured with
noise of 0.1 (m, rad), velocities with 1. The figure is the information gained, the divergence of
the exact posterior from the prior, in nats, over true parameters drawn from the prior; the
posterior is computed on grids that close in on it, so that none is too coarse. `expected` is what
`expected_information` says of the same actions beforehand, to be compared with `mean`. Prints one
JSON line per kind::

    python recipes/benchmarks/excitation.py [truths=20] [steps=50]
"""

from __future__ import annotations

import math
import sys
from statistics import mean

import torch
from measuring import options, report
from torch import Tensor

from torchrl_bayessim.excitation import between_knots, excite, replayed
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.information import Simulate, expected_information
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.randomness import generator

PRIOR = BoxPrior({"body_mass[pole]": (3.0, 7.0), "dof_damping[hinge]": (0.2, 2.0)})
NOMINAL = torch.tensor([[5.02, 1.0]])
NOISE = torch.tensor([0.1, 0.1, 1.0, 1.0])
GAIN = torch.tensor([1.0, 10.0, 1.0, 2.0])  # of cart and pole, positions then velocities
START = torch.tensor([0.0, 0.02, 0.0, 0.0], dtype=torch.float64)
BOUNDS = (torch.tensor([-3.0]), torch.tensor([3.0]))
KNOTS = 10
GRIDS = (25, 25, 51)  # points per parameter, each closing in; contacts make densities jagged
FAR = 12.0  # nats below the mode: what has less density than e^-12 of its is left out


def information(simulate: Simulate, actions: Tensor, truth: Tensor, *, seed: int) -> float:
    """Return the nats that one noisy experiment gives, by quadrature on grids that close in."""
    y = simulate(truth, actions[None])[0, 0]
    measured = y + NOISE * torch.randn(y.shape, generator=generator(seed, "noise"))
    low, high = torch.zeros(2), torch.ones(2)
    for points in GRIDS:
        cell = (high - low) / points
        middles = [
            first + width * (torch.arange(points) + 0.5)
            for first, width in zip(low, cell, strict=True)
        ]
        unit = torch.cartesian_prod(*middles)
        y = simulate(PRIOR.low + unit * (PRIOR.high - PRIOR.low), actions[None])[:, 0]
        log_likelihood = -0.5 * ((y - measured) / NOISE).square().sum((-1, -2))
        share = cell.prod().item()  # of the prior in each cell
        near = unit[log_likelihood > log_likelihood.max() - FAR]
        low = (near.amin(0) - 1.5 * cell).clamp(min=0)  # and one cell more on each side
        high = (near.amax(0) + 1.5 * cell).clamp(max=1)
    weight = log_likelihood.softmax(0)
    log_ratio = log_likelihood.log_softmax(0) - math.log(share)  # posterior to prior
    return (weight * log_ratio).sum().item()


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
    theta = PRIOR.sample((32,), generator=generator(0, "beliefs"))
    found = excite(simulate, theta, noise=NOISE, bounds=BOUNDS, steps=steps, knots=KNOTS)
    count = given["truths"]
    random = 6 * torch.rand(count, steps, 1, generator=generator(0, "random")) - 3
    points = 2 * torch.rand(count, KNOTS, 1, generator=generator(0, "smooth")) - 1
    cases = {
        "excited": found.actions.expand(count, -1, -1),
        "smooth random": between_knots(points, *BOUNDS, steps),
        "random": random,
        "task policy": balanced(simulate, steps).expand(count, -1, -1),
    }
    truths = PRIOR.sample((count,), generator=generator(0, "truths"))
    nats = {
        case: [
            information(simulate, actions[i], truth[None], seed=i) for i, truth in enumerate(truths)
        ]
        for case, actions in cases.items()
    }
    for case, values in nats.items():
        gained = mean(a - b for a, b in zip(nats["excited"], values, strict=True))
        told = expected_information(simulate, theta, cases[case], noise=NOISE).mean().item()
        figures = {"mean": mean(values), "expected": told, "excited_gains": gained}
        rounded = {name: round(value, 3) for name, value in figures.items()}
        context = {"seed": f"0 to {len(values) - 1}", "threads": 1}
        report("excitation", case, values, unit="nats", **rounded, **context)


if __name__ == "__main__":
    main(*sys.argv[1:])
