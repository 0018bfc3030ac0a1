"""Name what the simulator lacks, put it in, infer again, and train a policy that the robot thanks.

    python recipes/close_the_loop.py seeds=5 out=recipes/results/close_the_loop

A surrogate robot hides its parameters and an effect that its simulator does not have
(`upright_arm.py`). From six logs of three seconds: `diagnose` names the effect, and the report puts
it into the simulator. Then twice the same, with the simulator as it was and with the effect, whose
strength is one more dimension of the posterior: infer from the logs, train PPO under the posterior,
and score it at the robot. Each seed has logs, networks and policies of its own; both policies
have as many frames. If a diagnosis names nothing, the recipe says so and stops. Writes result.json,
table.md and close_the_loop.png; ``resume=FOLDER`` goes on after a break, with the policies that are
done.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import recipe
import torch
import upright_arm
from close_the_loop_report import SOURCES, draw_figure, summarised, table
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv
from tqdm.auto import tqdm

from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.report import Report
from torchrl_bayessim.errors import message
from torchrl_bayessim.inference.marginals import marginal_log_prob
from torchrl_bayessim.inference.physics_posterior import PhysicsPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.loop import SimToRealLoop
from torchrl_bayessim.robots import RecordedLogs
from torchrl_bayessim.summaries import SummaryStatistics, linear_dynamics, waypoints
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer
from torchrl_bayessim.whole_file import write_text

NAMED = ("named", "named_partial")
PPO_SETTINGS: dict[str, Any] = {
    "minibatch_size": 600,
    "epochs": 8,
    "gamma": 0.97,
    "reward_scale": 0.3,
}


@dataclass
class CloseTheLoop(recipe.Settings):
    """Settings; ``key=value`` on the command line overrides them."""

    seeds: int = 5
    rounds: int = 3  # of inference and training, under each simulator
    simulations: int = 640  # pairs per round
    updates: int = 20  # of PPO per round
    horizon: int = 30  # steps of each environment per batch
    environments: int = 120  # in multiples of the six logs, whose actions they replay
    episodes: int = 100  # at the robot, for the score
    short: bool = False  # a smoke test: everything runs, little is learned
    resume: str = ""  # folder of a run that was broken off


def job(settings: CloseTheLoop, out: Path) -> dict[str, Any]:
    """Diagnose on every seed; then infer, train and score under both simulators."""
    if settings.seeds < 2:
        raise ValueError(message("at least 2 seeds, for an interval", settings.seeds))
    if settings.short:
        settings.rounds, settings.simulations, settings.updates = 1, 48, 2
        settings.environments, settings.episodes = 60, 8
        settings.horizon = upright_arm.STEPS  # so that episodes end
    seeds = range(settings.seed, settings.seed + settings.seeds)
    logs = {seed: upright_arm.record(seed=seed) for seed in seeds}
    reports = {seed: diagnosed(logs[seed], seed=seed) for seed in seeds}
    told: dict[str, Any] = {
        "task": "upright_arm",
        "parameters": list(upright_arm.PRIOR.names),
        "diagnoses": [described(report, seed=seed) for seed, report in reports.items()],
    }
    unnamed = [seed for seed, report in reports.items() if report.verdict not in NAMED]
    if unnamed:
        told["stopped"] = f"no effect was named on {len(unnamed)} of {len(seeds)} seeds: {unnamed}"
        print(f"Stopped: {told['stopped']}; there is nothing to put into the simulator.")
        return told
    runs = []
    for seed in tqdm(seeds, desc="seeds", disable=not settings.progress):
        for source in SOURCES:
            part = partial(trained, source, reports[seed], logs[seed], settings=settings, seed=seed)
            runs.append(recipe.kept(out / "parts" / f"{source}_{seed}.json", part))
            print(sentence(runs[-1]))
    result = told | revealed() | summarised(runs)
    write_text(out / "table.md", table(result))
    draw_figure(out / "close_the_loop.png", result)
    print(table(result))
    return result


def revealed() -> dict[str, Any]:
    """Return what the robot has hidden, now that everything is done."""
    name, where, strength = upright_arm.TRUE_EFFECT
    return {
        "true": upright_arm.TRUE_PARAMETERS.tolist(),
        "effect": {"name": name, "where": where, "strength": strength},
    }


def diagnosed(real: TensorDictBase, *, seed: int) -> Report:
    """Return what the logs say about the simulator."""
    system = upright_arm.make_system()
    report = diagnose(system, None, upright_arm.logs_of(real, system), seed=seed)
    print(f"seed {seed}: {report}")
    return report


def described(report: Report, *, seed: int) -> dict[str, Any]:
    """Return a diagnosis as result.json has it."""
    whole = report.to_dict()
    kept = ("verdict", "summary", "effects", "confusion_set", "parameters", "alarms")
    return {"seed": seed, **{key: whole[key] for key in kept}}


def trained(
    source: str, report: Report, real: TensorDictBase, *, settings: CloseTheLoop, seed: int
) -> dict[str, Any]:
    """Infer and train under one of the simulators, and score the policy at the robot."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loop, learner, prior = make_loop(source, report, real, settings=settings, seed=seed)
        turns = list(loop)
    returns = upright_arm.returns_at_robot(learner.policy, episodes=settings.episodes)
    posterior = turns[-1].posterior
    texts = [str(warning.message) for warning in caught]
    ended = [p["return"] for t in turns for p in t.curve if math.isfinite(p["return"])]
    return {
        "seed": seed,
        "source": source,
        "names": list(prior.names),
        "units": list(prior.units),
        "posterior_mean": posterior.mean.tolist(),
        "posterior_sd": posterior.stddev.tolist(),
        **at_truth(posterior, prior),
        "doubts": [text for text in texts if "real summaries" in text],
        "real_return": returns.mean().item(),
        "sim_return": ended[-1],
        "frames": turns[-1].frames,
        "simulations": sum(turn.simulations for turn in turns),
        "seconds": sum(turn.seconds for turn in turns),
    }


def make_loop(
    source: str, report: Report, real: TensorDictBase, *, settings: CloseTheLoop, seed: int
) -> tuple[SimToRealLoop, PPO, BoxPrior]:
    """Return the loop under one of the simulators, its learner, and the prior."""
    bare = upright_arm.simulator(settings.environments, seed=seed)
    if source == "without":
        prior = upright_arm.PRIOR
        env: Any = TransformedEnv(bare, ApplyPhysics(upright_arm.PHYSICS))
    else:
        prior = report.prior(upright_arm.PRIOR, upright_arm.make_system().robot)
        env = report.apply(bare, upright_arm.PHYSICS)
    randomizer = DomainRandomizer(prior, seed=seed)
    env = upright_arm.observed(env, seed=seed, randomizer=randomizer)
    learner = PPO(env, seed=seed, **PPO_SETTINGS)
    loop = SimToRealLoop(
        env,
        learner,
        RecordedLogs(real),
        refinement=PosteriorRefinement(
            prior,
            simulations=settings.simulations,
            seed=seed,
            fit_options={"progress": settings.progress},
        ),
        statistics=SummaryStatistics(linear_dynamics, waypoints(10)),
        randomizer=randomizer,
        horizon=settings.horizon,
        updates=settings.updates,
        rounds=settings.rounds,
        seed=seed,
        progress=settings.progress,
    )
    return loop, learner, prior


def at_truth(posterior: PhysicsPosterior, prior: BoxPrior) -> dict[str, Any]:
    """Return how far the posterior is from what the robot hides, for each of its parameters.

    ``z`` is the distance of its mean from the truth in its standard deviations; nats are those of
    the marginal density at the truth over the prior's. A strength counts where the effect is the
    hidden one, and is left out where it is not.
    """
    name, where, strength = upright_arm.TRUE_EFFECT
    true = dict(zip(upright_arm.PRIOR.names, upright_arm.TRUE_PARAMETERS.tolist(), strict=True))
    true[f"{name}[{where}]"] = strength
    theta = torch.tensor([true.get(n, m) for n, m in zip(prior.names, posterior.mean, strict=True)])
    z = (posterior.mean - theta) / posterior.stddev
    nats = marginal_log_prob(posterior, theta) + (prior.high - prior.low).log()
    rows = zip(prior.names, z.tolist(), nats.tolist(), strict=True)
    found = {n: (distance, gained) for n, distance, gained in rows if n in true}
    return {
        "z": {n: distance for n, (distance, _) in found.items()},
        "nats_over_prior": {n: gained for n, (_, gained) in found.items()},
    }


def sentence(run: dict[str, Any]) -> str:
    """Return a run in one line."""
    rows = zip(run["names"], run["posterior_mean"], run["posterior_sd"], strict=True)
    physics = ", ".join(f"{name} {mean:.3g} ± {sd:.2g}" for name, mean, sd in rows)
    return (
        f"seed {run['seed']}, {run['source']} the effect: {physics}; the policy earns "
        f"{run['sim_return']:.1f} in simulation, at the robot {run['real_return']:.1f}, "
        f"after {run['frames']:,} frames, {run['seconds']:.0f} s"
    )


if __name__ == "__main__":
    recipe.main(CloseTheLoop, job)
