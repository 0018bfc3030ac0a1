import pytest
import torch
from apparatus import arm, commands, seen, simulated, values

from torchrl_bayessim.effects.catalogue import CATALOGUE, effect
from torchrl_bayessim.effects.effect import (
    ActionEffect,
    ModelEffect,
    SensorEffect,
)
from torchrl_bayessim.effects.robot import Robot
from torchrl_bayessim.effects.sequence import command_sequence, measured_sequence

NAMES = """
action_delay action_lag dead_band saturation action_gain action_bias torque_speed_limit battery_sag
packet_drop action_jitter action_quantization backlash coulomb_friction stribeck_friction
viscous_friction quadratic_drag load_dependent_friction directional_friction parallel_spring
series_elasticity gravity_tilt constant_force periodic_disturbance cogging payload com_shift
armature contact_friction contact_softness link_length time_scale sensor_delay sensor_bias
sensor_gain sensor_noise sensor_quantization sensor_lag sensor_drift sensor_dropout
""".split()  # noqa: SIM905
GROUPS = {
    "timing", "friction", "gain", "offset", "elasticity", "inertia", "contact", "geometry",
    "noise", "disturbance", "dead zone",
}  # fmt: skip
every = pytest.mark.parametrize("name", NAMES)


@pytest.fixture(scope="module")
def robot():
    return arm()


def test_the_catalogue_has_exactly_the_published_names():
    assert list(CATALOGUE) == NAMES


def test_an_unknown_name_is_an_error_that_suggests_a_near_one():
    with pytest.raises(KeyError, match="coulomb_friction \\(did you mean this"):
        effect("colomb_friction")


def test_options_make_another_effect_and_equal_ones_are_equal():
    assert effect("cogging", number=4) == effect("cogging", number=4)
    assert hash(effect("cogging", number=4)) == hash(effect("cogging", number=4))
    assert effect("cogging", number=4) != effect("cogging", number=5)
    assert effect("sensor_bias") != effect("action_bias")


@every
def test_an_effect_says_what_it_is(name, robot):
    known = effect(name)
    assert known.name == name
    assert known.unit
    assert known.group in GROUPS
    assert known.channel in {"sensing", "actuation", "body", "contact"}
    targets = known.targets(robot)
    low, high = known.bounds(robot)
    assert len(targets) == len(set(targets)) == len(low) == len(high) > 0
    assert ((low <= 0) & (high >= 0)).all()
    assert (high > 0).any()
    assert all(-1 <= known.joint(robot, i) < len(robot.joints) for i in range(len(targets)))


@every
def test_zero_strength_changes_no_bit(name, robot):
    known = effect(name)
    zero = torch.zeros(1, len(known.targets(robot)), dtype=torch.float64)
    if isinstance(known, ActionEffect):
        expected = commands()
    elif isinstance(known, SensorEffect):
        expected = values(robot)
    else:  # what the simulator does without any effect
        expected = simulated(robot)
    assert torch.equal(seen(known, zero, robot)[0], expected)


@every
def test_every_strength_within_bounds_is_stable_and_changes_something(name, robot):
    known = effect(name)
    low, high = known.bounds(robot)
    result = seen(known, torch.stack([low, torch.zeros_like(low), high]), robot)
    assert result.isfinite().all()
    assert not torch.equal(result[2], result[1])
    if (low < 0).any():
        assert not torch.equal(result[0], result[1])


@every
def test_small_strengths_change_little(name, robot):
    known = effect(name)
    low, high = known.bounds(robot)
    factors = torch.tensor([0.0, 1e-8, 1e-3, 0.3]).double()[:, None]
    off, tiny, small, medium = seen(known, factors * high, robot)
    changes = [float((x - off).abs().mean()) for x in (tiny, small, medium)]
    assert changes[0] <= 1e-3 * changes[2] + 1e-9
    assert changes[1] <= 0.5 * changes[2] + 1e-9
    if (low < 0).any():
        backwards = seen(known, 1e-8 * low[None], robot)[0]
        assert float((backwards - off).abs().mean()) <= 1e-3 * changes[2] + 1e-9


@every
def test_the_same_seed_gives_the_same_result(name, robot):
    known = effect(name)
    _, high = known.bounds(robot)
    state = torch.random.get_rng_state()
    first, second = (seen(known, high[None], robot, seed=3) for _ in range(2))
    assert torch.equal(first, second)
    assert torch.equal(torch.random.get_rng_state(), state)
    if known.random and "quantization" not in name:
        assert not torch.equal(seen(known, high[None], robot, seed=4), first)


@pytest.mark.parametrize(
    "name", [n for n in NAMES if issubclass(CATALOGUE[n], ActionEffect | SensorEffect)]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_strengths_broadcast_against_records_and_keep_their_kind(name, dtype, robot):
    known = effect(name)
    _, high = known.bounds(robot)
    p, s, t = 3, 2, 9
    apply = command_sequence if isinstance(known, ActionEffect) else measured_sequence
    generator = torch.Generator().manual_seed(0)
    record = torch.randn(p, s, t, len(high), generator=generator).to(dtype)
    noise = torch.rand(s, t, len(high), generator=generator)
    strength = (torch.tensor([0.0, 0.4, 1.0])[:, None, None] * high).to(dtype)
    time = torch.arange(s * t).reshape(s, t).double() * robot.dt
    result = apply(known, record, strength, robot, noise=noise, time=time)
    assert result.shape == record.shape
    assert result.dtype == dtype
    for i in range(p):
        for j in range(s):
            alone = apply(known, record[i, j], strength[i, 0], robot, noise=noise[j], time=time[j])
            torch.testing.assert_close(result[i, j], alone, rtol=1e-6, atol=1e-6)


def test_effects_without_a_place_on_the_robot_have_no_targets():
    free = Robot(dt=0.01)
    for name, kind in CATALOGUE.items():
        assert kind().targets(free) == (), name


def test_only_the_random_and_model_kinds_are_marked_so():
    assert {n for n, kind in CATALOGUE.items() if kind.random} == {
        "packet_drop", "action_jitter", "sensor_noise",
        "sensor_quantization", "sensor_dropout",
    }  # fmt: skip
    assert all(
        kind.channel in {"body", "contact"}
        for kind in CATALOGUE.values()
        if issubclass(kind, ModelEffect)
    )
