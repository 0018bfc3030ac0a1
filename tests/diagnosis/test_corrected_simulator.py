"""The simulator that follows from a report: its effects, and their strengths as parameters."""

import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv, check_env_specs

from torchrl_bayessim.diagnosis.commands import commanded
from torchrl_bayessim.diagnosis.report import Report
from torchrl_bayessim.diagnosis.segments import Segments
from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.effects.robot import robot_of
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.inference.priors import BoxPrior, GaussianPrior
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.transforms import DomainRandomizer

NAME = "InvertedPendulum-v5"
ROBOT = robot_of(known_task(NAME))
MASS = BoxPrior({"body_mass[pole]": (3.0, 6.0)}, log=["body_mass[pole]"], units={
    "body_mass[pole]": "kg"})  # fmt: skip
DELAY = {effect("action_delay"): {"slide": ROBOT.dt}}
BOTH = {**DELAY, effect("coulomb_friction"): {"slider": 100.0, "hinge": 1.0}}


def report(strengths):
    """Return a report of these strengths; nothing else of it matters here."""
    nothing = dict.fromkeys(Report.__dataclass_fields__, ())
    return Report(**{**nothing, "verdict": "named", "strengths": strengths})


def make(found, physics=None):
    return found.apply(BatchedMujocoEnv(NAME, 3, threads=1), physics)


def test_the_prior_has_the_plausible_range_of_each_strength():
    prior = report(BOTH).prior(MASS, ROBOT)
    slider, hinge = (0.3 * ROBOT.force_scale).tolist()
    assert slider < 100.0 < 2 * slider
    assert hinge > 1.0
    assert prior.names == (
        *("body_mass[pole]", "action_delay[slide]"),
        *("coulomb_friction[slider]", "coulomb_friction[hinge]"),
    )
    assert prior.units == ("kg", "s", "N", "N m")
    assert prior.log.tolist() == [True, False, False, False]
    assert prior.low.tolist() == [3.0, 0.0, 0.0, 0.0]
    # a fit beyond the plausible range doubles it
    expected = [6.0, min(5 * ROBOT.dt, 0.1), 2 * slider, hinge]
    assert prior.high.tolist() == pytest.approx(expected)
    assert report(DELAY).prior(None, ROBOT).names == ("action_delay[slide]",)


def test_one_theta_drives_parameters_and_strengths():
    found, physics = report(DELAY), MujocoPhysics("body_mass[pole]")
    prior = found.prior(MASS, ROBOT)
    env = TransformedEnv(make(found, physics), DomainRandomizer(prior), auto_unwrap=True)
    check_env_specs(env)
    theta = env.reset()["theta"]
    assert len(theta.unique(dim=0)) == 3
    assert prior.contains(theta).all()
    delay = next(t for t in env.transform if hasattr(t, "strength"))
    torch.testing.assert_close(delay.strength.float(), theta[:, 1:])
    masses = torch.from_numpy(env.base_env.models.read("body_mass", (2,))).float()
    torch.testing.assert_close(masses, theta[:, 0])


def test_a_reset_without_parameters_has_the_fitted_strengths():
    env = make(report(DELAY), MujocoPhysics("body_mass[pole]"))
    nominal = float(known_task(NAME).model.body("pole").mass[0])
    expected = torch.tensor([nominal, ROBOT.dt]).expand(3, 2)
    torch.testing.assert_close(env.reset()["theta"], expected)
    env.reset(env.full_state_spec.zero().set("theta", torch.tensor([[4.0, 0.01]] * 3)))
    torch.testing.assert_close(env.reset()["theta"], expected)


def path(env, commands):
    """Return what is observed under commands, shape ``(3, T, 4)``."""
    env.set_seed(0)
    now, seen = env.reset(), []
    for command in commands.unbind(1):
        now = env.step(now.set("action", command))["next"]
        seen.append(now["observation"])
    return torch.stack(seen, 1)


@pytest.mark.parametrize("physics", [None, MujocoPhysics("body_mass[pole]")])
def test_fitted_strengths_act_with_and_without_parameters(physics):
    commands = torch.randn(3, 8, 1, generator=torch.Generator().manual_seed(0)).clamp(-3, 3)
    late = torch.cat([commands[:, :1], commands[:, :-1]], 1)  # one control step
    clean = BatchedMujocoEnv(NAME, 3, threads=1)
    torch.testing.assert_close(path(make(report(DELAY), physics), commands), path(clean, late))


@pytest.mark.parametrize("names", [("action_bias", "saturation"), ("saturation", "action_bias")])
@pytest.mark.parametrize("physics", [None, MujocoPhysics("body_mass[pole]")])
def test_a_bias_reaches_a_limit_whichever_was_found_first(names, physics):
    """The same in the replay that a diagnosis looks at and in the simulator that it gives."""
    strengths = {"action_bias": 1.5, "saturation": 0.4}
    found = {effect(name): {"slide": strengths[name]} for name in names}
    sent = torch.randn(3, 8, 1, generator=torch.Generator().manual_seed(0)).clamp(-1, 1) * 3
    reached = (sent + 1.5).clamp(-1.8, 1.8)
    clean = BatchedMujocoEnv(NAME, 3, threads=1)
    torch.testing.assert_close(path(make(report(found), physics), sent), path(clean, reached))
    known = {one: np.array([[strengths[one.name]]]) for one in found}
    ctrl = sent.double().numpy()
    time, at = ROBOT.dt * np.tile(np.arange(8.0), (3, 1)), np.arange(3)
    states = np.zeros((3, 8, 2))
    segments = Segments(
        8, 0, 1 + np.arange(8), at, at, time, states, states, ctrl, *np.zeros((2, 2))
    )
    sequences, which = commanded(ROBOT, segments, known, 1)
    np.testing.assert_allclose(sequences[which], reached.numpy(), atol=1e-6)


def test_several_effects_are_each_a_transform():
    env = make(report(BOTH))
    assert [t.effect.name for t in env.transform] == ["action_delay", "coulomb_friction"]
    env.reset()
    losses = [env.base_env.models.read("dof_frictionloss", (i,)).tolist() for i in (0, 1)]
    assert losses == [[100.0] * 3, [1.0] * 3]


def test_effects_on_forces_are_asked_in_their_stages_however_they_were_found():
    name = "HalfCheetah-v5"  # which is fast: what is late acts within a control step
    robot = robot_of(known_task(name))
    late = [effect("action_lag", held=False), effect("action_delay", inside=True)]
    found = [effect("load_dependent_friction"), *(one.on(robot) for one in late)]
    strengths = {one: {one.targets(robot)[-1]: 0.02} for one in found}
    env = report(strengths).apply(BatchedMujocoEnv(name, 1, threads=1))
    names = ["action_delay", "action_lag", "load_dependent_friction"]
    assert [t.effect.name for t in env.transform] == names


def test_without_effects_only_the_parameters_are_left():
    clean = report({})
    env = make(clean, MujocoPhysics("body_mass[pole]"))
    assert env.reset()["theta"].shape == (3, 1)
    assert clean.prior(MASS, ROBOT).names == MASS.names
    assert make(clean).batch_size == (3,)


def test_other_priors_are_refused():
    with pytest.raises(TypeError, match="expected a BoxPrior, got 'GaussianPrior'"):
        report(DELAY).prior(GaussianPrior({"body_mass[pole]": (4.0, 1.0)}), ROBOT)
    with pytest.raises(ValueError, match="at least one named parameter"):
        report({}).prior(None, ROBOT)


def test_an_effect_on_sensors_is_put_on_what_is_observed_of_them():
    found = report({effect("sensor_bias"): {"hinge position": 0.1, "motor current": 0.4}, **DELAY})
    with pytest.raises(ValueError, match=r"names of the observation's entries, for sensor_bias"):
        make(found)
    with pytest.raises(ValueError, match=r"channels=\('hinge position', 'motor current', ...\)"):
        found.prior(None, ROBOT)
    channels = ("slider position", "hinge position", "slider velocity", "hinge velocity")
    bare = BatchedMujocoEnv(NAME, 3, threads=1)
    both = [bare, found.apply(BatchedMujocoEnv(NAME, 3, threads=1), channels=channels)]
    for env in both:
        env.set_seed(0)
    plain, biased = (env.reset()["observation"] for env in both)
    torch.testing.assert_close(biased - plain, torch.tensor([0.0, 0.1, 0.0, 0.0]).expand(3, 4))
    names = found.prior(None, ROBOT, channels=channels).names
    assert names == ("sensor_bias[hinge position]", "action_delay[slide]")
    physics = MujocoPhysics("body_mass[pole]")
    env = found.apply(BatchedMujocoEnv(NAME, 3, threads=1), physics, channels=channels)
    prior = found.prior(MASS, ROBOT, channels=channels)
    env = TransformedEnv(env, DomainRandomizer(prior), auto_unwrap=True)
    env.set_seed(0)
    now = env.reset()
    torch.testing.assert_close(now["observation"][:, 1] - plain[:, 1], now["theta"][:, 1])
