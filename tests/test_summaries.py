import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import Compose, TransformedEnv

from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.randomness import generator
from torchrl_bayessim.summaries import (
    SummaryStatistics,
    autocorrelation,
    cross_correlation,
    differences,
    duration,
    encode_actions,
    linear_dynamics,
    moments,
    waypoints,
)
from torchrl_bayessim.trajectories import first_trajectories, pad
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

SUMMARIES = {
    "cross_correlation": cross_correlation,
    "moments": moments,
    "duration": duration,
    "autocorrelation": autocorrelation(1, 2, 5),
    "waypoints": waypoints(3),
    "linear_dynamics": linear_dynamics,
}
every_summary = pytest.mark.parametrize("summary", SUMMARIES.values(), ids=SUMMARIES.keys())
seeds = st.integers(0, 2**31)


def noise(*shape, key=0):
    return torch.randn(*shape, generator=generator("summaries", key))


def trajectory(*batch, steps=20, states=3, actions=2, key=0):
    """A stable linear system under random actions: state, action, next state, full mask."""
    action = noise(*batch, steps, actions, key=(key := str(key)) + "a")
    push = noise(actions, states, key="push")
    state = [noise(*batch, states, key=key)]
    for t in range(steps):
        state.append(0.9 * state[-1] + 0.3 * action[..., t, :] @ push)
    state = torch.stack(state, -2)
    mask = torch.ones(*batch, steps, dtype=torch.bool)
    return state[..., :-1, :], action, state[..., 1:, :], mask


# --- the paper's statistics


def test_differences_run_over_time_and_not_over_the_columns_of_the_state():
    state = torch.tensor([[0.0, 100.0], [1.0, 100.0]])
    following = torch.tensor([[1.0, 100.0], [3.0, 100.0]])
    value = cross_correlation(state, torch.ones(2, 1), following, torch.ones(2).bool())
    assert value.tolist() == [1.5, 0.0, 1.5, 0.0, 0.5, 0.0]


def test_the_paper_s_formula_written_out():
    state, action, following, mask = trajectory()
    tau = (following - state).double().numpy()
    products = [(tau[:, i] * action[:, j].numpy()).mean() for i in range(3) for j in range(2)]
    expected = [*products, *tau.mean(0), *tau.var(0, ddof=1)]
    assert cross_correlation(state, action, following, mask).tolist() == pytest.approx(
        expected, rel=1e-4, abs=1e-6
    )


def test_an_action_is_aligned_with_the_difference_it_caused():
    """With s' = s + a the product is E[a^2]; one step late it would be nearly 0."""
    action = noise(400, 1)
    state = torch.cat([torch.zeros(1, 1), action.cumsum(0)])
    mask = torch.ones(400).bool()
    caused = cross_correlation(state[:-1], action, state[1:], mask)[0]
    late = cross_correlation(state[:-1], action.roll(1, 0), state[1:], mask)[0]
    assert caused.item() == pytest.approx(action.square().mean().item(), rel=1e-4)
    assert abs(late.item()) < 0.15


def test_the_variance_of_the_differences_is_unbiased():
    zero = torch.zeros(20_000, 3, 1)
    tau = noise(20_000, 3, 1)
    variance = moments(zero, zero, tau, torch.ones(20_000, 3).bool())[:, 1]
    assert variance.mean().item() == pytest.approx(1.0, abs=0.03)  # 2/3 if divided by 3


@pytest.mark.parametrize("summary", [cross_correlation, moments, linear_dynamics])
def test_statistics_do_not_tell_how_long_an_episode_was(summary):
    """The same steps ten times over have the same statistics, but for the unbiased variance."""
    state, action, following, mask = trajectory(steps=50)
    repeated = [x.repeat(10, 1) for x in (state, action, following)]
    once, often = summary(state, action, following, mask), summary(*repeated, mask.repeat(10))
    torch.testing.assert_close(once, often, rtol=0.03, atol=1e-3)


def test_duration_is_the_logarithm_of_the_number_of_steps():
    mask = torch.tensor([[1, 1, 1], [1, 0, 0]]).bool()
    zero = torch.zeros(2, 3, 1)
    torch.testing.assert_close(duration(zero, zero, zero, mask)[:, 0].exp(), torch.tensor([3.0, 1]))


# --- laws that every summary obeys


@every_summary
@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=4),
    filler=st.sampled_from([math.nan, math.inf, -math.inf, 1e30, 0.0]),
    seed=seeds,
)
@settings(deadline=None, max_examples=25)
def test_what_stands_behind_the_mask_never_matters(summary, lengths, filler, seed):
    each = [trajectory(steps=t, key=(seed, i)) for i, t in enumerate(lengths)]
    alone = torch.stack([summary(*one) for one in each])
    longest = max(lengths) + 2
    padded = [
        torch.stack(
            [torch.cat([x, x.new_full((longest - len(x), x.shape[-1]), filler)]) for x in s]
        )
        for s in list(zip(*each, strict=True))[:3]
    ]
    mask = torch.arange(longest) < torch.tensor(lengths)[:, None]
    together = summary(*padded, mask)
    assert together.isfinite().all()
    torch.testing.assert_close(together, alone, rtol=1e-3, atol=1e-4)


@every_summary
def test_every_row_has_its_own_summary(summary):
    batch = trajectory(2, 4)
    value = summary(*batch)
    assert value.shape[:2] == (2, 4)
    torch.testing.assert_close(value[1, 3], summary(*(x[1, 3] for x in batch)))
    order = torch.tensor([2, 0, 3, 1])
    torch.testing.assert_close(summary(*(x[:, order] for x in batch)), value[:, order])


@every_summary
def test_one_step_is_enough_for_a_finite_summary(summary):
    one, more = trajectory(steps=1), trajectory(steps=30)
    assert summary(*one).isfinite().all()
    assert summary(*one).shape == summary(*more).shape


@every_summary
@pytest.mark.parametrize("value", [0.0, 7.0, -1e4])
def test_constant_columns_are_harmless(summary, value):
    state, action, following, mask = trajectory()
    state, following = state.clone(), following.clone()
    state[:, 1] = following[:, 1] = value
    action[:, 0] = value
    assert summary(state, action, following, mask).isfinite().all()


@pytest.mark.parametrize("unit", [1e-3, 57.3, 1e3])
def test_other_units_of_a_state_scale_its_statistics(unit):
    state, action, following, mask = trajectory()
    scale = torch.tensor([1.0, unit, 1.0])
    plain = cross_correlation(state, action, following, mask)
    scaled = cross_correlation(state * scale, action, following * scale, mask)
    factors = torch.cat([scale.repeat_interleave(2), scale, scale**2])
    torch.testing.assert_close(scaled, plain * factors)


@pytest.mark.parametrize("unit", [1e-3, 57.3, 1e3])
def test_autocorrelations_and_residuals_have_no_unit(unit):
    state, action, following, mask = trajectory()
    following = following + 0.1 * noise(*following.shape, key="disturbance")
    changed = state * unit, action, following * unit, mask
    plain = autocorrelation(1, 2)(state, action, following, mask)[3:]
    torch.testing.assert_close(autocorrelation(1, 2)(*changed)[3:], plain, rtol=1e-3, atol=1e-4)
    plain = linear_dynamics(state, action, following, mask)[-3:]
    torch.testing.assert_close(linear_dynamics(*changed)[-3:], plain, rtol=1e-3, atol=1e-3)


# --- other families


def test_autocorrelation_of_a_first_order_process():
    steps, rho = 20_000, 0.8
    tau = [noise(1)]
    shocks = noise(steps, key="shocks") * math.sqrt(1 - rho**2)
    for shock in shocks:
        tau.append(rho * tau[-1] + shock)
    tau = torch.stack(tau)
    mask = torch.ones(len(tau)).bool()
    power, *found = autocorrelation(1, 2, 4)(torch.zeros_like(tau), tau, tau, mask)
    assert power.item() == pytest.approx(0.0, abs=0.1)
    assert [x.item() for x in found] == pytest.approx([rho, rho**2, rho**4], abs=0.05)


def test_a_lag_beyond_the_trajectory_is_no_correlation():
    assert autocorrelation(50)(*trajectory(steps=20))[3:].tolist() == [0.0] * 3


@pytest.mark.parametrize("lags", [(), (0,), (1, -2)])
def test_lags_must_be_positive(lags):
    with pytest.raises(ValueError, match=r"expected (positive lags|steps of a lag to be positive)"):
        autocorrelation(*lags)


def test_waypoints_are_spread_over_each_trajectory_s_own_length():
    states = torch.arange(1.0, 13.0).reshape(1, 12, 1).repeat(2, 1, 1)
    mask = torch.arange(12) < torch.tensor([[12], [6]])
    value = waypoints(3)(states - 1, states, states, mask)
    assert value.tolist() == [[4.0, 8.0, 12.0], [2.0, 4.0, 6.0]]


def test_ordered_summaries_of_trajectories_together_are_averages_of_each():
    env = CartPoleEnv(4, seed=2)
    batch = first_trajectories(env.rollout(30, break_when_any_done=False))
    for function in (waypoints(3), autocorrelation(1, 2)):
        statistics = SummaryStatistics(moments, function, duration)
        each = SummaryStatistics(function)(batch)["summary"]
        together = statistics.together(batch)
        torch.testing.assert_close(together[8:-1], each.mean(0))
        torch.testing.assert_close(together[:8], SummaryStatistics(moments).together(batch))
        torch.testing.assert_close(statistics.together(batch.flip(0))[8:-1], each.mean(0))


def test_a_summary_says_what_it_depends_on():
    shown = repr(SummaryStatistics(moments, autocorrelation(1, 4), waypoints(2), angles=[0]))
    assert shown == (
        "SummaryStatistics(moments, autocorrelation(1, 4), waypoints(2), angles=(0,), "
        "'observation', 'action' -> 'summary')"
    )


def test_parameters_are_handed_on_under_their_own_key():
    env = CartPoleEnv(3)
    batch = env.rollout(5, break_when_any_done=False).set("physics", torch.rand(3, 5, 2))
    found = SummaryStatistics(moments, theta_key="physics")(batch)
    assert torch.equal(found["physics"], batch["physics"][:, 0])
    assert "theta" not in found


COUNTING = {
    "end": torch.arange(20) < 13,
    "begin": torch.arange(20) >= 7,
    "hole": (torch.arange(20) < 5) | (torch.arange(20) >= 8),
}


@pytest.mark.parametrize("counting", COUNTING.values(), ids=COUNTING.keys())
@every_summary
def test_steps_outside_the_mask_are_never_read_wherever_they_are(summary, counting):
    state, action, following, _ = trajectory(4)
    steps = {"observation": state, "action": action, "next": {"observation": following}}
    mask = counting.expand(4, 20)
    theta = torch.where(mask, 0.7, torch.nan).unsqueeze(-1)
    data = TensorDict(steps | {"mask": mask, "theta": theta}, [4, 20])
    other = data.clone()
    for key in ("observation", "action", ("next", "observation")):
        other.set(key, torch.where(mask.unsqueeze(-1), data[key], 1e3))
    statistics = SummaryStatistics(summary)
    assert torch.equal(statistics(data)["summary"], statistics(other)["summary"])
    assert torch.equal(statistics.together(data), statistics.together(other))
    assert statistics(data)["theta"].tolist() == 4 * [[torch.tensor(0.7).item()]]


def test_waypoints_are_states_that_count():
    state, action, following, mask = trajectory()
    mask = mask & (torch.arange(20) >= 8)
    found = waypoints(2)(state, action, following, mask)
    assert torch.equal(found, following[[13, 19]].flatten())


@pytest.mark.parametrize("angles", ["0", 1, (0.0,), ["angle"]])
def test_angles_are_a_sequence_of_columns(angles):
    with pytest.raises(TypeError, match=r"a sequence of columns .* that are angles.*angles=\(0,\)"):
        SummaryStatistics(moments, angles=angles)


def test_waypoints_must_be_some():
    with pytest.raises(ValueError, match="waypoints to be positive, got 0"):
        waypoints(0)


def linear_system(policy, *, steps=400, key=0):
    """s' = A s + B a + c, with actions from ``policy(t, state)``."""
    A = torch.tensor([[0.9, 0.1], [-0.2, 0.8]])
    B, c = torch.tensor([[0.0], [0.5]]), torch.tensor([0.05, -0.02])
    state, action = [noise(2, key=key)], []
    for t in range(steps):
        action.append(policy(t, state[-1]))
        state.append(A @ state[-1] + B @ action[-1] + c)
    state, action = torch.stack(state), torch.stack(action)
    expected = torch.cat([A - torch.eye(2), B, c[:, None]], -1)
    return (state[:-1], action, state[1:], torch.ones(steps).bool()), expected


POLICIES = {
    "random": lambda t, state: noise(1, key=("action", t).__repr__()),
    "sine": lambda t, state: torch.tensor([math.sin(0.3 * t) + 0.5 * math.sin(1.7 * t)]),
    "feedback": lambda t, state: -0.5 * state[:1] + noise(1, key=("dither", t).__repr__()),
}


@pytest.mark.parametrize("policy", POLICIES.values(), ids=POLICIES.keys())
def test_linear_dynamics_are_those_of_the_system_under_any_policy(policy):
    steps, expected = linear_system(policy)
    found = linear_dynamics(*steps)
    torch.testing.assert_close(found[:8].reshape(2, 4), expected, rtol=0, atol=2e-4)
    assert (found[8:] < math.log(1e-6)).all()


@pytest.mark.parametrize("origin", [1.0, 300.0])
def test_linear_dynamics_do_not_depend_on_where_a_state_is_counted_from(origin):
    (state, action, following, mask), expected = linear_system(POLICIES["random"])
    shifted = linear_dynamics(state + origin, action, following + origin, mask)[:8].reshape(2, 4)
    torch.testing.assert_close(shifted[:, :3], expected[:, :3], rtol=0, atol=1e-3)


def test_the_residual_of_linear_dynamics_is_the_share_of_noise():
    steps, spread = 20_000, 0.5
    state, action = noise(steps, 1, key="s"), noise(steps, 1, key="a")
    following = state + action + spread * noise(steps, 1, key="n")
    left = linear_dynamics(state, action, following, torch.ones(steps).bool())[-1]
    assert left.exp().item() == pytest.approx(spread**2 / (1 + spread**2), rel=0.05)


# --- actions and angles


def test_choices_of_two_are_minus_one_and_one():
    assert encode_actions(torch.tensor([[1, 0], [0, 1]])).tolist() == [[-1.0], [1.0]]
    assert encode_actions(torch.tensor([[True, False]])).tolist() == [[-1.0]]


def test_choices_of_more_stay_one_hot_and_torques_stay_torques():
    hot = torch.eye(3, dtype=torch.long)
    assert encode_actions(hot).tolist() == torch.eye(3).tolist()
    torque = torch.tensor([[0.3, -0.2]])
    assert torch.equal(encode_actions(torque), torque)


def test_both_choices_of_a_discrete_action_are_seen():
    """Coded 0 and 1, whatever the first choice does would vanish from the products."""
    hot = torch.nn.functional.one_hot(torch.randint(2, (50,), generator=generator(0)), 2)
    for choice in (0, 1):
        moved = 2.0 * hot[:, choice : choice + 1]
        batch = {"observation": torch.zeros(50, 1), "action": hot}
        batch |= {"next": {"observation": moved, "done": torch.zeros(50, 1).bool()}}
        product = SummaryStatistics(cross_correlation)(TensorDict(batch, [50]))["summary"][0]
        assert abs(product) > 0.5


@pytest.mark.parametrize("before", [3.1, -3.1])
def test_an_angle_that_passes_pi_moves_a_little(before):
    step = math.copysign(0.2, before)
    after = math.remainder(before + step, 2 * math.pi)
    state, following = torch.tensor([[before, before]]), torch.tensor([[after, after]])
    tau = differences(state, following, angles=[0])[0]
    assert tau[0].item() == pytest.approx(step, abs=1e-5)
    assert abs(tau[1].item()) > 6


@given(st.floats(-20, 20), st.floats(-3.1, 3.1))
@settings(deadline=None, max_examples=50)
def test_wrapped_differences_are_those_of_the_unwrapped_angle(angle, step):
    wrap = lambda x: torch.tensor([[math.remainder(x, 2 * math.pi)]])
    assert differences(wrap(angle), wrap(angle + step), [0]).item() == pytest.approx(step, abs=1e-4)


def test_an_angle_may_be_counted_from_the_last_column():
    state, following = torch.tensor([[0.0, 3.1]]), torch.tensor([[5.0, -3.1]])
    assert differences(state, following, [-1])[0].tolist() == pytest.approx([5.0, 0.0832], abs=1e-3)


# --- the module, and in a collector


def batch_of(lengths, *, key=0, **changes):
    each = []
    for i, t in enumerate(lengths):
        state, action, following, _ = trajectory(steps=t, key=(key, i))
        done = torch.zeros(t, 1).bool()
        entries = {"observation": state, "action": action}
        entries |= {"next": {"observation": following, "done": done}} | changes
        each.append(TensorDict(entries, [t]))
    return pad(each)


def test_statistics_are_a_module_with_keys():
    statistics = SummaryStatistics(moments, duration)
    assert statistics.in_keys == [
        "observation",
        "action",
        ("next", "observation"),
        ("next", "done"),
    ]
    assert statistics.out_keys == ["summary"]
    batch = batch_of([5, 9])
    expected = torch.stack(
        [moments(*trajectory(steps=t, key=(0, i))) for i, t in enumerate((5, 9))]
    )
    torch.testing.assert_close(statistics(batch)["summary"][:, :6], expected)


def test_other_keys_may_be_named():
    plain = batch_of([5, 9])
    named = plain.clone()
    named["robot", "joints"] = named.pop("observation")
    named["next", "robot", "joints"] = named["next"].pop("observation")
    named["command"] = named.pop("action")
    keys = {"observation_key": ("robot", "joints"), "action_key": "command", "out_key": "x"}
    value = SummaryStatistics(cross_correlation, **keys)(named)["x"]
    assert torch.equal(value, SummaryStatistics(cross_correlation)(plain)["summary"])


def test_no_summary_is_refused():
    with pytest.raises(ValueError, match="at least one summary"):
        SummaryStatistics()
    with pytest.raises(TypeError, match=r"functions of .* got 'moments'\. Try: summaries\."):
        SummaryStatistics("moments")


def test_trajectories_that_lack_an_entry_or_a_step_are_refused():
    rows = CartPoleEnv(2).rollout(5, break_when_any_done=False)
    with pytest.raises(KeyError, match=r"with an entry, got 'obs'\. Available: observation"):
        SummaryStatistics(moments, observation_key="obs")(rows)
    with pytest.raises(ValueError, match=r"at least one step, got 'batch size \(2, 0\)'"):
        SummaryStatistics(moments)(rows[:, :0])


def test_angles_are_wrapped_for_every_summary():
    turning = torch.arange(40.0)[:, None] * 0.5
    wrapped = torch.remainder(turning + math.pi, 2 * math.pi) - math.pi
    batch = TensorDict({"observation": wrapped[:-1], "action": torch.zeros(39, 1)}, [39])
    batch["next"] = {"observation": wrapped[1:], "done": torch.zeros(39, 1).bool()}
    value = SummaryStatistics(moments, autocorrelation(1), angles=[0])(batch)["summary"]
    expected = [0.5, 0.0, math.log(0.25), 1.0]
    assert value.tolist() == pytest.approx(expected, abs=1e-4)


ADDITIVE = [cross_correlation, moments, linear_dynamics, duration]


@given(lengths=st.lists(st.integers(1, 15), min_size=1, max_size=5), seed=seeds)
@settings(deadline=None, max_examples=15)
def test_trajectories_together_count_as_one_of_all_their_steps(lengths, seed):
    batch = batch_of(lengths, key=seed)
    each = zip(*(trajectory(steps=t, key=(seed, i)) for i, t in enumerate(lengths)), strict=True)
    joined = [torch.cat(parts) for parts in each]
    expected = torch.cat([summary(*joined) for summary in ADDITIVE])
    together = SummaryStatistics(*ADDITIVE).together
    torch.testing.assert_close(together(batch), expected, rtol=1e-3, atol=1e-4)
    backwards = batch[list(range(len(lengths)))[::-1]]
    torch.testing.assert_close(together(backwards), expected, rtol=1e-3, atol=1e-4)


def test_several_systems_are_summarised_at_once():
    batch = batch_of([5, 9, 2, 7])
    statistics = SummaryStatistics(*ADDITIVE)
    both = statistics.together(batch.unflatten(0, (2, 2)))
    torch.testing.assert_close(both[1], statistics.together(batch[2:]))


def test_actions_that_are_indices_are_refused():
    env = CartPoleEnv(12, categorical_action_encoding=True)
    with pytest.raises(ValueError, match="one-hot actions"):
        SummaryStatistics(cross_correlation)(env.rollout(12, break_when_any_done=False))


def test_the_first_episode_of_every_row_counts():
    steps = CartPoleEnv(16, seed=1).rollout(120, break_when_any_done=False)
    statistics = SummaryStatistics(cross_correlation, duration)
    ends = steps["next", "done"].squeeze(-1).long().argmax(-1) + 1
    assert steps["next", "done"].any(1).all()
    value = statistics(steps)["summary"]
    torch.testing.assert_close(value[:, -1].exp(), ends.float())
    for row in (0, 7):
        torch.testing.assert_close(statistics(steps[row, : ends[row]])["summary"], value[row])


@pytest.mark.filterwarnings("ignore:split_trajs=True:UserWarning")
@pytest.mark.parametrize("split", [False, True])
def test_statistics_are_a_collector_s_postproc(split):
    randomizer = DomainRandomizer(BoxPrior({"length": (0.1, 2.0)}))
    physics = ApplyPhysics(AttributePhysics("length"))
    env = TransformedEnv(CartPoleEnv(8, seed=0), Compose(physics, randomizer))
    collector = Collector(
        env,
        None,
        frames_per_batch=8 * 40,
        total_frames=8 * 80,
        reset_at_each_iter=True,
        split_trajs=split,
        postproc=SummaryStatistics(cross_correlation, duration),
        auto_register_policy_transforms=False,
    )
    batches = list(collector)
    collector.shutdown()
    assert len(batches) == 2
    for batch in batches:
        assert batch["summary"].shape == (*batch.batch_size, 13)
        assert batch["theta"].shape == (*batch.batch_size, 1)
        assert batch["summary"].isfinite().all()
        # every trajectory has the physics of its own episode
        assert len(batch["theta"].unique()) == len(batch) >= 8


def rows(**entries):
    """Two trajectories of six steps, with other entries where given."""
    state, action, following, mask = trajectory(2, steps=6)
    data = {"observation": state, "action": action, "mask": mask}
    data |= {"next": {"observation": following, "done": torch.zeros(2, 6, 1, dtype=torch.bool)}}
    return TensorDict(data | entries, [2, 6])


def test_no_bit_of_a_multi_binary_action_is_lost():
    action = torch.randint(2, (2, 6, 2), generator=generator("bits"))
    other = torch.stack([1 - action[..., 0], action[..., 1]], -1)
    with pytest.raises(ValueError, match=r"one-hot actions, got \[.*one_hot=False"):
        SummaryStatistics(cross_correlation)(rows(action=action))
    statistics = SummaryStatistics(cross_correlation, one_hot=False)
    one, two = (statistics(rows(action=a))["summary"] for a in (action, other))
    assert one.shape == (2, 3 * 2 + 6)
    assert (one != two).any()
    single = torch.randint(5, (2, 6, 1), generator=generator("choice"))  # of a multi-discrete space
    assert statistics(rows(action=single))["summary"].shape == (2, 3 + 6)
    assert "one_hot=False" in repr(statistics)


@every_summary
def test_a_trajectory_without_steps_or_with_nan_has_no_summary(summary):
    statistics = SummaryStatistics(summary)
    mask = torch.ones(2, 6, dtype=torch.bool)
    mask[0] = False
    state = rows()["observation"].clone()
    state[0, 3, 1] = torch.nan
    for data in (rows(mask=mask), rows(observation=state)):
        found = statistics(data)["summary"]
        assert found[0].isnan().all()
        assert torch.equal(found[1], statistics(rows())["summary"][1])


def test_trajectories_together_need_no_mask_of_the_user():
    data, statistics = rows(), SummaryStatistics(moments, waypoints(2))
    assert torch.equal(statistics.together(data.exclude("mask")), statistics.together(data))


@pytest.mark.parametrize("shape", [(2, 6), (2, 6, 3, 3)])
def test_observations_are_vectors(shape):
    matrices = torch.zeros(shape)
    data = rows().set("observation", matrices).set(("next", "observation"), matrices)
    with pytest.raises(ValueError, match=r"vectors in 'observation', shape \(\*, T, D\), got"):
        SummaryStatistics(moments)(data)


@pytest.mark.parametrize("angles", [(7,), (-4,)])
def test_angles_in_no_column_are_refused(angles):
    with pytest.raises(ValueError, match=r"angles among the 3 columns of 'observation', got \("):
        SummaryStatistics(moments, angles=angles)(rows())


def test_a_mask_of_floats_is_refused():
    statistics = SummaryStatistics(moments)
    for call in (statistics, statistics.together):
        with pytest.raises(TypeError, match=r"booleans in 'mask', got 'torch.float32'"):
            call(rows(mask=torch.ones(2, 6)))


# --- the policy


class Push(torch.nn.Module):
    """Pushes to the right with this probability."""

    def __init__(self, right):
        super().__init__()
        self.right = right

    def forward(self, observation):
        right = torch.rand(observation.shape[:-1]) < self.right
        return torch.nn.functional.one_hot(right.long(), 2)


def test_statistics_depend_on_the_policy_so_that_pairs_of_two_must_not_be_mixed():
    """Another policy moves the summaries of the same physics, as another physics would."""

    def summaries(right, length):
        env = CartPoleEnv(256, seed=1)
        env.set_parameters({"length": torch.full((256,), length)}, torch.ones(256).bool())
        policy = TensorDictModule(Push(right), ["observation"], ["action"])
        steps = env.rollout(30, policy, break_when_any_done=False)
        assert (env.parameters["length"] == length).all()
        return SummaryStatistics(cross_correlation)(steps)["summary"]

    def distance(first, second):
        """Largest difference of means, in standard errors."""
        error = ((first.var(0) + second.var(0)) / 256).sqrt()
        return ((first.mean(0) - second.mean(0)).abs() / error.clamp_min(1e-9)).max().item()

    robot, again = summaries(0.5, 0.5), summaries(0.5, 0.5)
    other_policy, other_physics = summaries(0.8, 0.5), summaries(0.5, 0.7)
    assert distance(robot, again) < 4
    assert distance(robot, other_physics) > 20
    assert distance(robot, other_policy) > 20


@every_summary
def test_encoder_counts_are_numbers_like_others(summary):
    counts = torch.randint(-50, 50, (3, 21, 2), generator=generator(0))
    action = torch.randn(3, 20, 1, generator=generator(1))
    mask = torch.ones(3, 20, dtype=torch.bool)
    found = []
    for state in (counts, counts.float()):
        steps = {"observation": state[:, :-1], "next": {"observation": state[:, 1:]}}
        rows = TensorDict(steps | {"action": action, "mask": mask}, [3, 20])
        found.append(SummaryStatistics(summary)(rows)["summary"])
    torch.testing.assert_close(*found, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("own", "said"),
    [
        (lambda state, *_: state.mean((-1, -2)), r"shape \(3, 'L'\) .*, got \(3,\).*unsqueeze"),
        (lambda *_: torch.tensor(1.0), r"got \(\)"),
        (lambda state, *_: state, r"got \(3, 5, 4\)"),
        (lambda state, *_: state[:1].mean(1), r"got \(1, 4\)"),
        (lambda *_: None, "a tensor from <lambda>, got 'NoneType'"),
    ],
)
def test_a_summary_of_another_shape_is_not_broadcast(own, said):
    rows = CartPoleEnv(3).rollout(5, break_when_any_done=False)
    with pytest.raises((ValueError, TypeError), match=said):
        SummaryStatistics(own)(rows)
