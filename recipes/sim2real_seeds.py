"""The main job over several seeds: what the posterior gains, with paired intervals.

    python recipes/sim2real_seeds.py task=cartpole seeds=5 out=recipes/results/sim2real_cartpole

Runs ``sim2real_ppo.py`` once per seed (two at a time), and writes result.json and table.md: nats
over the prior per parameter and round, and the return at the robot against training under the
prior. ``resume=FOLDER`` goes on after a break.
"""

from __future__ import annotations

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import recipe
from intervals import interval

from torchrl_bayessim.errors import SimulationError, message
from torchrl_bayessim.whole_file import write_text


@dataclass
class Seeds(recipe.Settings):
    """Settings; ``key=value`` on the command line overrides them."""

    task: str = "cartpole"
    truth: str = "nominal"
    seeds: int = 5
    updates: int = 0  # PPO updates per round; 0 for the task's own number
    short: bool = False
    processes: int = 2
    resume: str = ""  # folder of a run that was broken off


def job(settings: Seeds, out: Path) -> dict[str, Any]:
    """Run every seed, and compare."""
    if settings.seeds < 2:
        raise ValueError(message("at least 2 seeds, for an interval", settings.seeds))
    first = settings.seed
    with ThreadPoolExecutor(settings.processes) as pool:
        runs = list(pool.map(lambda i: one(settings, out, first + i), range(settings.seeds)))
    parameters = runs[0]["parameters"]
    rounds = []
    for index in range(len(runs[0]["rounds"])):
        turns = [run["rounds"][index] for run in runs]
        nats = [turn["nats_over_prior"] / len(parameters) for turn in turns]
        rounds.append(
            {
                "round": index + 1,
                "nats_per_parameter": interval(nats),
                "real_return": interval([turn["real_return"] for turn in turns]),
            }
        )
    gains = [run["rounds"][-1]["real_return"] - run["baseline"]["real_return"] for run in runs]
    result = {
        "task": settings.task,
        "parameters": parameters,
        "seeds": settings.seeds,
        "frames": runs[0]["rounds"][-1]["frames"],
        "rounds": rounds,
        "baseline": interval([run["baseline"]["real_return"] for run in runs]),
        "gain": interval(gains),
        "runs": runs,
    }
    write_text(out / "table.md", table(result))
    print(table(result))
    return result


def one(settings: Seeds, out: Path, seed: int) -> dict[str, Any]:
    """Run one seed in a process of its own, and return its result without its provenance."""
    folder = out / f"seed{seed}"
    script = Path(__file__).with_name("sim2real_ppo.py")
    arguments = {
        "task": settings.task,
        "truth": settings.truth,
        "updates": settings.updates,
        "short": settings.short,
        "seed": seed,
        "threads": settings.threads,
        "out": folder,
    }
    if (folder / "settings.json").exists():
        arguments = {"resume": folder}
    command = [sys.executable, str(script), *(f"{k}={v}" for k, v in arguments.items())]
    file = folder / "result.json"
    if not file.exists():
        command.append("progress=false")
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SimulationError(f"seed {seed} failed: {done.stderr.strip().splitlines()[-1]}")
    run = json.loads(file.read_text())
    return {key: run[key] for key in ("parameters", "true", "rounds", "baseline", "gain")}


def table(result: dict[str, Any]) -> str:
    """Return the comparison in Markdown."""

    def cell(entry: dict[str, float]) -> str:
        return f"{entry['mean']:.2f} [{entry['low']:.2f}, {entry['high']:.2f}]"

    lines = [
        f"{result['task']}, {result['seeds']} seeds, {result['frames']:,} frames, mean and 95 % "
        "interval over seeds",
        "",
        "| | nats over the prior per parameter | return at the robot |",
        "|---|---|---|",
    ]
    lines += [
        f"| round {row['round']} | {cell(row['nats_per_parameter'])} | {cell(row['real_return'])} |"
        for row in result["rounds"]
    ]
    lines.append(f"| prior only, as many frames | 0 | {cell(result['baseline'])} |")
    lines.append(f"| posterior minus prior, paired | | {cell(result['gain'])} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    recipe.main(Seeds, job)
