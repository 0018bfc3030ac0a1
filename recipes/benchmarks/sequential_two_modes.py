r"""Sequential inference of a posterior with two modes: how near the exact one, and how surely?

:math:`x = \theta^2 + \varepsilon` with :math:`\theta \sim U[-2, 2]`, noise of deviation 0.2 and the
observation 1: modes at -1 and +1. Three rounds, fresh seeds; the figures are the total variation
between the last round's posterior and the exact one, and the Kullback-Leibler divergence from the
exact one, in nats, both by quadrature. ``finished`` is the share of seeds that give a posterior at
all, ``within_0.1`` the share at most 0.1 away; a seed without a posterior counts as distance 1, and
as infinitely far in nats. ``all=0`` leaves out all corrections but the default one, ``focused``.
With sbi installed, its NPE-A takes part with its own defaults and the same number of simulations
per round. Prints JSON lines, one for each distance and one for the seconds of each method::

    python recipes/benchmarks/sequential_two_modes.py [seeds=100] [simulations=2000]
        [all=1] [sbi=10]
"""

from __future__ import annotations

import io
import math
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import chdir, redirect_stdout
from importlib.util import find_spec
from tempfile import TemporaryDirectory

import torch
from measuring import options, report
from torch import Tensor
from tqdm.auto import tqdm

from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.sequential import CORRECTIONS, Correction, sequential
from torchrl_bayessim.randomness import generator, isolated

DEFAULTS = {"seeds": 100, "simulations": 2000, "all": 1, "sbi": 10}
NOISE, OBSERVED, ROUNDS = 0.2, 1.0, 3
# patience as long as the fit, so that the cosine of the learning rate reaches its end
FIT = {"epochs": 50, "patience": 50, "batch_size": 500, "lr": 5e-3}

LogDensity = Callable[[Tensor], Tensor]


def distances(log_density: LogDensity) -> tuple[float, float]:
    """Return total variation to the exact posterior p and KL(p || q), by the midpoint rule.

    Mass outside the prior's box counts as missing.
    """
    step = 4 / 8000
    theta = -2 + step * (torch.arange(8000, dtype=torch.float64) + 0.5)
    exact = torch.softmax(-0.5 * ((OBSERVED - theta**2) / NOISE) ** 2, 0)
    log_mass = log_density(theta[:, None].float()).detach().double() + math.log(step)
    outside = max(0.0, 1 - log_mass.exp().sum().item())
    nats = torch.xlogy(exact, exact) - torch.where(exact > 0, exact * log_mass, 0.0)
    return 0.5 * ((log_mass.exp() - exact).abs().sum().item() + outside), nats.sum().item()


def simulator(seed: int) -> Callable[[Tensor], Tensor]:
    """Return the simulator with noise of its own."""
    noise = generator(seed, "noise")
    return lambda theta: theta**2 + NOISE * torch.randn(theta.shape, generator=noise)


def ours(correction: Correction, seed: int, simulations: int) -> LogDensity:
    """Return the last round's log-density."""
    *_, last = sequential(
        simulator(seed),
        BoxPrior({"theta": (-2.0, 2.0)}),
        torch.full((1, 1), OBSERVED),
        rounds=ROUNDS,
        simulations=simulations,
        correction=correction,
        seed=seed,
        progress=False,
        **FIT,
    )
    return last.posterior.log_prob


def npe_a(seed: int, simulations: int) -> LogDensity:
    """Return the log-density of sbi's NPE-A after as many rounds, with sbi's defaults."""
    from sbi.inference import NPE_A
    from sbi.utils import BoxUniform

    # it writes its logs into the working directory
    with (
        TemporaryDirectory() as logs,
        chdir(logs),
        isolated(seed, "sbi"),
        redirect_stdout(io.StringIO()),
    ):
        prior = BoxUniform(torch.tensor([-2.0]), torch.tensor([2.0]))
        inference, posterior = NPE_A(prior, show_progress_bars=False), None
        simulate = simulator(seed)
        for _ in range(ROUNDS):
            theta = (posterior or prior).sample((simulations,))
            inference.append_simulations(theta, simulate(theta), proposal=posterior).train()
            posterior = inference.build_posterior().set_default_x(torch.tensor([[OBSERVED]]))
    return posterior.log_prob


def measure(case: str, method: Callable[[int], LogDensity], seeds: int) -> None:
    """Run a method with every seed and print its lines."""
    variation, nats = [1.0] * seeds, [math.inf] * seeds
    seconds, failures = [0.0] * seeds, []
    for seed in tqdm(range(seeds), desc=case, file=sys.stderr):
        start = time.perf_counter()
        try:
            variation[seed], nats[seed] = distances(method(seed))
        except Exception as error:
            failures.append(f"{type(error).__name__}: {error}"[:160])
        seconds[seed] = time.perf_counter() - start
    shares = {
        "finished": 1 - len(failures) / seeds,
        "within_0.1": sum(distance <= 0.1 for distance in variation) / seeds,
        "worst_seeds": sorted(range(seeds), key=variation.__getitem__)[-3:],
        "failures": sorted(set(failures)),
    }
    name, context = "sequential_two_modes", {"seed": f"0 to {seeds - 1}", "threads": 1}
    report(name, case, variation, unit="total variation", **context, **shares)
    report(name, f"{case}, KL", nats, unit="nats", **context)
    report(name, f"{case}, seconds", seconds, unit="s", **context)


def main(*arguments: str) -> None:
    """Measure every correction, then sbi."""
    given = options(list(arguments), optional=["all", "sbi"], **DEFAULTS)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # the counts of repairs, which the tests read
    for correction in CORRECTIONS if given["all"] else ("focused",):
        measure(
            correction,
            lambda seed, correction=correction: ours(correction, seed, given["simulations"]),
            given["seeds"],
        )
    if given["sbi"] and find_spec("sbi"):
        measure("sbi NPE_A", lambda seed: npe_a(seed, given["simulations"]), given["sbi"])


if __name__ == "__main__":
    main(*sys.argv[1:])
