"""Rounds of inference or all simulations at once: nats over the prior for as many simulations.

    python recipes/sequential_refinement.py problem=cartpole,mountain_car rounds=8

One robot after another with parameters drawn from the prior, and one trajectory or a few of each,
as `posterior_recovery` has them. A single round simulates from the prior and answers for all robots
at once. Sequential inference simulates for one robot: in a smaller box around its posterior of the
round before, and learns from the pairs of all rounds in it. Both average as many networks.
Writes result.json, table.md and nats.png, the log-density of all parameters at the truth over the
prior's against the number of simulations; finished parts are kept in ``out``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import recipe
import torch
from intervals import interval
from posterior_recovery import Laboratory, chosen
from recovery_methods import bayessim
from recovery_problems import PROBLEMS
from tqdm.auto import tqdm
from workers import workers

from torchrl_bayessim import plots
from torchrl_bayessim.errors import message
from torchrl_bayessim.inference.ensemble import NETWORKS
from torchrl_bayessim.inference.sequential import sequential
from torchrl_bayessim.sources import draw
from torchrl_bayessim.whole_file import write_text

ONCE, IN_ROUNDS = "one round", "sequential"


@dataclass
class Refinement(recipe.Settings):
    """Settings; ``key=value`` on the command line overrides them."""

    problem: str = "cartpole,mountain_car"  # names of posterior_recovery, or all
    rounds: int = 8
    simulations: int = 1000  # of all rounds together
    truths: int = 16  # robots per problem
    processes: int = 2
    short: bool = False  # a smoke test: everything runs, little is learned


def job(settings: Refinement, out: Path) -> dict[str, Any]:
    """Run every problem and robot, and compare."""
    if settings.short:
        settings.rounds, settings.simulations, settings.truths = 2, 200, 2
        settings.problem = "pendulum"
    if settings.truths < 2:
        raise ValueError(message("truths=2 or more, for an interval", settings.truths))
    if settings.rounds < 1 or settings.simulations < 16 * settings.rounds:
        got = f"rounds={settings.rounds} simulations={settings.simulations}"
        raise ValueError(message("at least 16 simulations in each of at least 1 round", got))
    names = chosen(settings.problem)
    with workers(settings.processes, threads=settings.threads) as pool:
        found = {name: compared(settings, name, out / "parts", pool) for name in names}
    result = {"rounds": settings.rounds, "truths": settings.truths, "problems": found}
    draw_pictures(out, found)
    text = table(result)
    write_text(out / "table.md", text)
    print(text)
    return result


def compared(settings: Refinement, name: str, folder: Path, pool: Executor) -> dict[str, Any]:
    """Return the nats of both ways after each round's worth of simulations, per robot."""
    size = settings.simulations // settings.rounds
    kind = f"{name}_{settings.rounds}x{size}_{settings.truths}_{settings.seed}"
    once = pool.submit(part, folder / f"{kind}_once.json", all_at_once, settings, name)
    jobs = [
        pool.submit(part, folder / f"{kind}_{i}.json", in_rounds, settings, name, i)
        for i in range(settings.truths)
    ]
    bar = tqdm(jobs, desc=name, unit="robot", disable=not settings.progress)
    rows = [done.result()["nats"] for done in bar]
    counts = [size * (index + 1) for index in range(settings.rounds)]
    nats = {ONCE: once.result()["nats"], IN_ROUNDS: rows}
    return {
        "simulations": counts,
        "nats": nats,
        "mean": {
            way: [interval(list(column)) for column in zip(*each, strict=True)]
            for way, each in nats.items()
        },
        "gain": interval([b[-1] - a[-1] for a, b in zip(*nats.values(), strict=True)]),
        "as_many_as_once": fewest(counts, nats),
    }


def fewest(counts: list[int], nats: dict[str, list[list[float]]]) -> int | None:
    """Return after how many simulations rounds tell what one round tells with all of them."""
    mean = {way: torch.tensor(each, dtype=torch.float64).mean(0) for way, each in nats.items()}
    enough = (mean[IN_ROUNDS] >= mean[ONCE][-1]).nonzero().flatten()
    return counts[int(enough[0])] if len(enough) else None


def part(file: Path, way: Callable[..., list[Any]], *arguments: Any) -> dict[str, Any]:
    """Return what one job gave, from its file if it is there."""
    return recipe.kept(file, lambda: {"nats": way(*arguments)})


def robots(settings: Refinement, name: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the parameters of the robots ``(N, D)``, and what is observed of each ``(N, L)``."""
    truth = draw(PROBLEMS[name].prior, settings.truths, key=(settings.seed, "robots"))
    lab = laboratory(name, settings.truths, seed=settings.seed)
    observed = lab(truth, real=True)[:, 0]
    lab.close()
    return truth, observed


def laboratory(name: str, width: int, *, seed: int) -> Laboratory:
    """Return the simulator, so many at once at most."""
    return Laboratory(PROBLEMS[name], paper=False, environments=width, seed=seed)


def all_at_once(settings: Refinement, name: str) -> list[list[float]]:
    """Return the nats of one round per robot, with as many simulations as each round ends with."""
    prior, (truth, observed) = PROBLEMS[name].prior, robots(settings, name)
    size = settings.simulations // settings.rounds
    lab = laboratory(name, size, seed=settings.seed + 1)
    theta = draw(prior, size * settings.rounds, key=(settings.seed, "once"))
    x = lab(theta)[:, 0]
    lab.close()
    columns = []
    for end in range(size, len(theta) + 1, size):
        answer, _ = bayessim(
            prior, theta[:end], x[:end], networks=NETWORKS, pool=False, seed=settings.seed
        )
        log_prob = answer(truth, observed[:, None]).joint
        assert log_prob is not None  # of networks it is there
        columns.append((log_prob - prior.log_prob(truth)).tolist())
    return [list(row) for row in zip(*columns, strict=True)]


def in_rounds(settings: Refinement, name: str, index: int) -> list[float]:
    """Return the nats of sequential inference for one robot, after each round."""
    prior, (truth, observed) = PROBLEMS[name].prior, robots(settings, name)
    size = settings.simulations // settings.rounds
    lab = laboratory(name, size, seed=settings.seed + 2 + index)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # early rounds know few simulations like the robot's
        found = [
            (turn.posterior.log_prob(truth[index]) - prior.log_prob(truth[index])).item()
            for turn in sequential(
                lambda theta: lab(theta)[:, 0],
                prior,
                observed[index],
                rounds=settings.rounds,
                simulations=size,
                seed=settings.seed,
                progress=False,
            )
        ]
    lab.close()
    return found


def draw_pictures(out: Path, found: dict[str, Any]) -> None:
    """Draw the mean nats of each problem against the number of simulations."""
    for name, entry in found.items():
        x = torch.tensor(entry["simulations"])
        bands = {
            way: (x, torch.tensor([[e[end] for e in mean] for end in ("low", "mean", "high")]))
            for way, mean in entry["mean"].items()
        }
        figure = plots.learning_curves(
            bands, xlabel="simulations", ylabel=f"nats over the prior, {name.replace('_', ' ')}"
        )
        recipe.save_picture(figure, out / f"nats_{name}.png", dpi=100)


def table(result: dict[str, Any]) -> str:
    """Return the comparison in Markdown."""

    def cell(entry: dict[str, Any]) -> str:
        return f"{entry['mean']:.2f} [{entry['low']:.2f}, {entry['high']:.2f}]"

    lines = [
        f"Nats over the prior at the truth, mean and 95 % interval over {result['truths']} robots.",
        "",
    ]
    for name, entry in result["problems"].items():
        lines += [f"**{name}**", "", f"| simulations | {ONCE} | {IN_ROUNDS} |", "|---|---|---|"]
        pairs = zip(entry["mean"][ONCE], entry["mean"][IN_ROUNDS], strict=True)
        lines += [
            f"| {count} | {cell(once)} | {cell(rounds)} |"
            for count, (once, rounds) in zip(entry["simulations"], pairs, strict=True)
        ]
        some, last = entry["as_many_as_once"], entry["simulations"][-1]
        reached = f"after {some} simulations" if some else "not"
        lines += [
            "",
            f"{cell(entry['gain'])} nats more after {last}, paired; what one round tells with "
            f"{last}, rounds tell {reached}.",
            "",
        ]
    return "\n".join(lines)


if __name__ == "__main__":
    recipe.main(Refinement, job)
