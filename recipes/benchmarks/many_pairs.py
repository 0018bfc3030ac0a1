"""What do 1,000 to 1,000,000 pairs take, from simulation through summaries to a fit?

CartPole with random actions, in episodes of 20 steps; pairs go to files as they come, and the fit
reads minibatches from there, twice through. Every size has a process of its own. Prints one JSON
line per size and stage: pairs per second and, in the context, the most memory that is the process's
own (``own``) and that with the pages of files that it reads, which the system may take back
(``peak``), both in MiB::

    python recipes/benchmarks/many_pairs.py [most=1000000] [environments=1024] [memory=0]

``memory=1`` keeps the pairs in memory instead, for comparison.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from measuring import options, report
from torchrl.envs import Compose, TransformedEnv

from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.inference.fit import fit
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.simulate import simulate
from torchrl_bayessim.summaries import SummaryStatistics, linear_dynamics
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

STEPS, EPOCHS, BATCH = 20, 2, 1024
PRIOR = BoxPrior({"length": (0.1, 2.0), "masspole": (0.1, 2.0)})


def memory() -> tuple[float, float]:
    """Return this process's own memory, and that with what it maps, in MiB."""
    lines = dict(x.split(":", 1) for x in Path("/proc/self/status").read_text().splitlines())
    own, whole = (int(lines[name].split()[0]) / 1024 for name in ("RssAnon", "VmRSS"))
    return own, whole


@contextmanager
def watched() -> Iterator[dict[str, float]]:
    """Look at the memory every 20 ms, and note the most."""
    most, ended = {"own": 0.0, "peak": 0.0}, threading.Event()

    def look() -> None:
        while not ended.wait(0.02):
            for name, value in zip(most, memory(), strict=True):
                most[name] = max(most[name], round(value, 1))

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield most
    finally:
        ended.set()
        thread.join()


def measure(pairs: int, environments: int, *, stored: bool) -> None:
    """Simulate and fit once, and print both."""
    torch.set_num_threads(1)
    randomizer = DomainRandomizer(PRIOR)
    physics = ApplyPhysics(AttributePhysics(*PRIOR.names))
    env = TransformedEnv(CartPoleEnv(environments), Compose(physics, randomizer))
    given = {"pairs": pairs, "max_steps": STEPS, "progress": False}
    told = {"unit": "pairs/s", "seed": 0, "threads": 1, "pairs": pairs, "stored": stored}
    told["before"] = round(memory()[0], 1)
    with tempfile.TemporaryDirectory(dir=".") as folder:
        place = Path(folder, "pairs") if stored else None
        with watched() as most:
            begun = time.perf_counter()
            statistics = SummaryStatistics(linear_dynamics)
            data = simulate(env, None, statistics, randomizer, folder=place, **given)
            seconds = time.perf_counter() - begun
        rate = [pairs / seconds]
        report("many_pairs", "simulate and summarise", rate, seconds=seconds, **told, **most)
        posterior = MixtureDensityPosterior(PRIOR, data["summary"].shape[-1])
        with watched() as most:
            begun = time.perf_counter()
            done = fit(posterior, data, epochs=EPOCHS, batch_size=BATCH, progress=False)
            seconds = time.perf_counter() - begun
        told |= {"epochs": EPOCHS, "loss": round(done.best, 3)}
        rate = [EPOCHS * pairs / seconds]
        report("many_pairs", "fit", rate, seconds=seconds, **told, **most)


def main(*arguments: str) -> None:
    """Measure the sizes in turn, each in a process of its own."""
    given = options(list(arguments), optional=["memory", "only"], most=1_000_000, only=0,
                    environments=1024, memory=0)  # fmt: skip
    if given["only"]:
        measure(given["only"], given["environments"], stored=not given["memory"])
        return
    pairs = 1000
    while pairs <= given["most"]:
        rest = [f"{name}={given[name]}" for name in ("environments", "memory")]
        subprocess.run([sys.executable, __file__, f"only={pairs}", *rest], check=True)
        pairs *= 10


if __name__ == "__main__":
    main(*sys.argv[1:])
