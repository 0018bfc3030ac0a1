"""Is each effect of the catalogue found, one at a time, on three simulators?

A robot is the simulator with parameters drawn from their prior and one effect put on by
`ApplyEffect`, at a given share of its largest plausible strength; its logs are motions (chirps,
multisines, steps, …) with noise, open-loop but for a cart that is held on its rail. A diagnosis
then considers the whole catalogue. Where a mass could stand for the effect, the prior is over
dampings. The simulators are Gymnasium's Hopper, an arm of two links in MJCF and dm_control's
cart-pole. One JSON line per case says what came out:

- ``named``: the effect is named, at its place;
- ``in the set``: it is in the set of confusion, or named at another place;
- ``not shown``: the verdict is ``none`` and says that so weak an effect would not have been seen;
- ``missed``: anything else.

The effects on the noise of a sensor are part of the noise floor, and so left out. The last line
counts::

    python recipes/benchmarks/each_effect.py [hopper=1] [two_links=1] [cartpole=1] [percent=50]
        [places=1] [seed=0] [action_quantization ...]

``places`` is the number of targets per effect; ``hopper=0`` leaves Hopper out; names of effects
leave out the others.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import torch
from arm import TWO_LINKS
from log_columns import by_columns
from measuring import options
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.diagnosis.excitation_library import excitations
from torchrl_bayessim.diagnosis.report import Report
from torchrl_bayessim.effects.catalogue import CATALOGUE
from torchrl_bayessim.effects.effect import Effect
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.task import Task, uniform_reset
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.kinds import check_choice
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.read import read_logs
from torchrl_bayessim.logs.simulators import simulator_task
from torchrl_bayessim.logs.system import System
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.randomness import generator
from torchrl_bayessim.transforms.apply_effect import ApplyEffect
from torchrl_bayessim.transforms.apply_physics import ApplyPhysics
from torchrl_bayessim.transforms.domain_randomizer import DomainRandomizer

NOISE = (0.001, 0.02)  # rad or m, and per second
RUNS, STEPS = 6, 300
FLOOR = {"sensor_noise", "sensor_quantization"}
LIKE_MASSES = {"inertia", "gain", "geometry"}  # groups of effects for which a mass could stand
MASSES: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "two_links": {"body_mass[upper]": (0.8, 1.8), "body_mass[fore]": (0.4, 1.1)},
    "cartpole": {"body_mass[cart]": (0.6, 1.6), "body_mass[pole_1]": (0.06, 0.16)},
    "hopper": {"body_mass[torso]": (2.5, 5.0), "body_mass[foot]": (3.5, 7.0)},
}
DAMPINGS: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "two_links": {"dof_damping[shoulder]": (0.3, 1.2), "dof_damping[elbow]": (0.1, 0.4)},
    "cartpole": {"dof_damping[slider]": (0.0, 0.3), "dof_damping[hinge_1]": (0.0, 0.002)},
    "hopper": {"dof_damping[leg_joint]": (0.5, 2.0), "dof_damping[foot_joint]": (0.5, 2.0)},
}
AMPLITUDE = {"two_links": 0.7, "cartpole": 0.6, "hopper": 0.6}  # of the range of commands
# commands per unit of what is observed: the cart is held away from the ends of its rail
FEEDBACK = {"cartpole": (-1.0, 0.0, -0.5, 0.0)}


def simulators() -> dict[str, Task]:
    """Return the nominal simulators; all that moves is observed, and nothing ends a run."""
    arm = mujoco.MjModel.from_xml_string(TWO_LINKS)
    cartpole = simulator_task("dm_control:cartpole/swingup", Path(), None)
    hopper = known_task("Hopper-v5")
    return {
        "two_links": Task(model=arm, frame_skip=4, reset=uniform_reset(arm, 0.5)),
        "cartpole": replace(cartpole, reset=uniform_reset(cartpole.model, 0.3)),
        "hopper": Task(model=hopper.model, frame_skip=hopper.frame_skip, reset=hopper.reset),
    }


def recorded(
    system: System, name: str, effect: Effect, strengths: Mapping[str, float], *, seed: int
) -> list[Log]:
    """Return logs of a robot with an effect, its parameters drawn from the prior."""
    assert system.prior is not None
    assert system.physics is not None
    randomizer = DomainRandomizer(system.prior)
    env = TransformedEnv(
        BatchedMujocoEnv(system.task, RUNS, seed=seed), ApplyPhysics(system.physics)
    )
    env = env.append_transform(randomizer)
    env = env.append_transform(ApplyEffect(effect, dict(strengths), robot=system.robot, seed=seed))
    randomizer.pin(system.prior.sample(torch.Size([1]), generator=generator(seed, "theta"))[0])
    waves = iter(commands(system, AMPLITUDE[name], seed=seed).unbind(1))
    gains = torch.tensor(FEEDBACK.get(name, (0.0,)))

    def excite(tensordict: TensorDictBase) -> TensorDictBase:
        held = (tensordict["observation"] * gains).sum(-1, keepdim=True)
        return tensordict.set("action", env.action_spec.project(next(waves) + held))

    seen = env.rollout(STEPS, excite, break_when_any_done=False)
    noise = torch.tensor(NOISE).repeat_interleave(system.task.model.nv)
    observation = seen["observation"]
    white = torch.randn(observation.shape, generator=generator(seed, "noise"))
    return read_logs(by_columns(system, observation + noise * white, seen["action"]), system)


def commands(system: System, amplitude: float, *, seed: int) -> torch.Tensor:
    """Return one motion of the library of excitations per run, shape ``(runs, steps, A)``."""
    reach = amplitude * system.robot.command_scale.numpy()
    rng = np.random.default_rng(seed)
    kinds = excitations(-reach, reach, steps=STEPS, dt=system.control_dt, generator=rng)
    return torch.from_numpy(np.stack([*kinds.values()][:RUNS])).float()


def cases(
    name: str, task: Task, *, share: float, places: int, seed: int, only: Collection[str] = ()
) -> Iterator[tuple[System, Effect, str, float]]:
    """Return for each effect that applies the described system, a place and a strength."""
    for kind in CATALOGUE.values():
        if kind.name in FLOOR or (only and kind.name not in only):
            continue
        bounds = (DAMPINGS if kind.group in LIKE_MASSES else MASSES)[name]
        system = System(task=task, physics=MujocoPhysics(*bounds), prior=BoxPrior(bounds))
        effect = kind().on(system.robot)
        targets = effect.targets(system.robot)
        highest = dict(zip(targets, effect.bounds(system.robot)[1], strict=True)) if targets else {}
        plausible = [place for place, most in highest.items() if most > 0]
        order = torch.randperm(len(plausible), generator=generator(seed, "place", kind.name))
        for i in order[:places].tolist():
            yield system, effect, plausible[i], share * float(highest[plausible[i]])


def outcome(report: Report, name: str, where: str, strength: float) -> str:
    """Return what the report says of the effect."""
    if any(effect.name == name and where in effect.strengths for effect in report.effects):
        return "named"
    if name in {*report.confusion_set, *(effect.name for effect in report.effects)}:
        return "in the set"
    said = next((c for c in report.candidates if (c.name, c.where) == (name, where)), None)
    seen = None if said is None else said.minimal_detectable_strength
    if report.verdict == "none" and (seen is None or strength < seen):
        return "not shown"
    return "missed"


def main(*arguments: str) -> None:
    """Diagnose one robot per effect and simulator."""
    known, only = simulators(), [argument for argument in arguments if "=" not in argument]
    for name in only:
        check_choice("an effect", name, list(CATALOGUE))
    given = options(
        [argument for argument in arguments if "=" in argument],
        optional=[*known, "seed"],
        **dict.fromkeys(known, 1),
        percent=50,
        places=1,
        seed=0,
    )
    torch.set_num_threads(1)
    counts: Counter[str] = Counter()
    for name, task in known.items():
        if not given[name]:
            continue
        share, some = given["percent"] / 100, {n: given[n] for n in ("places", "seed")}
        every = cases(name, task, share=share, only=only, **some)
        for system, effect, where, strength in every:
            logs = recorded(system, name, effect, {where: strength}, seed=given["seed"])
            begun = time.perf_counter()
            report = diagnose(system, None, logs)
            came = outcome(report, effect.name, where, strength)
            counts[came] += 1
            line = {
                "benchmark": "each_effect",
                "case": f"{name}, {effect.name} at {where}",
                "value": came,
                "strength": float(f"{strength:.3g}"),
                "verdict": report.verdict,
                "effects": {f"{e.name} at {e.where}": e.strength for e in report.effects},
                "confusion_set": list(report.confusion_set),
                "seconds": round(time.perf_counter() - begun, 1),
            }
            print(json.dumps(line), flush=True)
    total = counts.total()
    print(json.dumps({"benchmark": "each_effect", "case": "all", "value": counts, "unit": total}))


if __name__ == "__main__":
    main(*sys.argv[1:])
