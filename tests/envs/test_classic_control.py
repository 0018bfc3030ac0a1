import gymnasium
import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import OneHot
from torchrl.envs import SerialEnv, check_env_specs

from torchrl_bayessim.envs.classic_control.acrobot import AcrobotEnv
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.classic_control.mountain_car import (
    MountainCarContinuousEnv,
    MountainCarEnv,
)
from torchrl_bayessim.envs.classic_control.pendulum import PendulumEnv

SYSTEMS = {
    "CartPole-v1": CartPoleEnv,
    "Pendulum-v1": PendulumEnv,
    "MountainCar-v0": MountainCarEnv,
    "MountainCarContinuous-v0": MountainCarContinuousEnv,
    "Acrobot-v1": AcrobotEnv,
}
N = 4
EVERY = torch.ones(2, dtype=torch.bool)


@pytest.fixture(params=SYSTEMS, ids=SYSTEMS)
def system(request):
    return SYSTEMS[request.param]


def varied(env):
    """Give every environment parameters within 40 % of the defaults, each its own."""
    factor = lambda: 0.6 + 0.8 * torch.rand(N, dtype=torch.float64)
    values = {name: factor() * value for name, value in env.defaults.items()}
    env.set_parameters(values, torch.ones(N, dtype=torch.bool))
    return values


def gymnasium_twins(name, values, states):
    twins = []
    for row, state in enumerate(states):
        twin = gymnasium.make(name).unwrapped
        twin.reset(seed=0)
        for parameter, value in values.items():
            setattr(twin, parameter, value[row].item())
        if name == "CartPole-v1":
            twin.total_mass = twin.masspole + twin.masscart
            twin.polemass_length = twin.masspole * twin.length
        twin.state = state.numpy().copy()
        twins.append(twin)
    return twins


def for_gymnasium(env, action):
    if isinstance(env.action_spec, OneHot):
        return action.argmax(-1).tolist()
    return list(action.numpy())


def pump(name, state):
    """Return the action index (or sign) that brings each system to a long or a finished episode."""
    if name == "CartPole-v1":
        return (state @ torch.tensor([0.05, 0.2, 1.0, 0.3]).double() > 0).long()
    if name == "Acrobot-v1":
        return 1 + state[:, 3].sign().long()
    return 1 + torch.where(state[:, 1] >= 0, 1, -1)


def act(env, name, td, step):
    if step % 7 == 0:
        return env.rand_action(td)
    index = pump(name, env.state) if step < 300 else torch.ones(N).long()  # in the end, fall
    if isinstance(env.action_spec, OneHot):
        action = torch.nn.functional.one_hot(index, env.action_spec.n)
    else:
        action = (index - 1).double()[:, None] * 1.5  # saturates
    return td.set("action", action)


def compare(name, steps, *, resynchronise):
    """Step both with the same actions; return the largest differences and how many ended."""
    env = SYSTEMS[name](N, dtype=torch.float64)
    values = varied(env)
    td = env.reset()
    twins = gymnasium_twins(name, values, env.state)
    alive, worst, compared = torch.ones(N, dtype=torch.bool), 0.0, 0
    for step in range(steps):
        if resynchronise:
            for twin, state in zip(twins, env.state, strict=True):
                twin.state = state.numpy().copy()
        out = env._step(act(env, name, td, step))
        for row, action in enumerate(for_gymnasium(env, td["action"])):
            if alive[row]:
                obs, reward, terminated, _, _ = twins[row].step(action)
                np.testing.assert_allclose(out["observation"][row], obs, rtol=1e-6, atol=1e-6)
                ours, theirs = env.state[row].numpy(), np.asarray(twins[row].state)
                # MountainCarContinuous rounds its state to float32; the others keep float64.
                gap = np.abs(ours.astype(theirs.dtype) - theirs).max()
                worst = max(worst, gap, abs(out["reward"][row].item() - reward))
                assert out["terminated"][row].item() == terminated
                alive[row], compared = not terminated, compared + 1
    return worst, compared, (~alive).sum().item()


LENGTH = {
    "CartPole-v1": 500,
    "Pendulum-v1": 200,
    "MountainCar-v0": 500,
    "MountainCarContinuous-v0": 999,
    "Acrobot-v1": 500,
}


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_step_equals_gymnasium_from_the_same_state(name):
    worst, compared, _ = compare(name, LENGTH[name], resynchronise=True)
    assert compared > 100
    assert worst < 1e-12


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", "MountainCar-v0", "Acrobot-v1"])
def test_a_free_running_episode_equals_gymnasium(name):
    # Rounding differs in the last bit, and Acrobot is chaotic: hence more than 1e-12.
    worst, compared, ended = compare(name, LENGTH[name], resynchronise=False)
    assert worst < 1e-7
    assert compared > 100
    assert ended == (0 if name == "Pendulum-v1" else N)


def test_acrobot_rods_depend_on_the_second_length_and_literal_gymnasium_does_not():
    for coupled in (False, True):
        env = AcrobotEnv(2, coupled=coupled)
        env.set_parameters({"LINK_LENGTH_2": torch.tensor([0.6, 1.4])}, EVERY)
        td = env.reset().set("action", torch.tensor([[0, 0, 1], [0, 0, 1]]))
        env.state = env.state[:1].expand(2, -1)
        first, second = env._step(td)["observation"]
        assert torch.equal(first, second) == (not coupled)


def test_coupled_rod_has_gymnasiums_dynamics_with_its_centre_and_inertia():
    length, mass = torch.full((1,), 1.3).double(), torch.full((1,), 0.8).double()
    everywhere = torch.ones(1, dtype=torch.bool)
    rod = AcrobotEnv(1, coupled=True, dtype=torch.float64)
    literal = AcrobotEnv(1, dtype=torch.float64)
    both = {"LINK_LENGTH_1": length, "LINK_MASS_1": mass}
    both |= {"LINK_LENGTH_2": length, "LINK_MASS_2": mass}
    rod.set_parameters(both, everywhere)
    rest = {"LINK_COM_POS_1": length / 2, "LINK_COM_POS_2": length / 2}
    literal.set_parameters(both | rest | {"LINK_MOI": mass * length**2 / 12}, everywhere)
    action = rod.action_spec.rand()
    results = []
    for env in (rod, literal):
        td = env.reset().set("action", action)
        env.state = torch.tensor([[0.3, -0.2, 0.5, 1.0]]).double()
        results.append(env._step(td)["observation"])
    torch.testing.assert_close(*results, rtol=0, atol=0)


def test_specs_hold(system):
    check_env_specs(system(3, max_steps=5))


def test_categorical_actions():
    env = CartPoleEnv(3, categorical_action_encoding=True)
    check_env_specs(env)
    assert env.rollout(4)["action"].shape == (3, 4)


def test_same_seed_same_run_and_another_seed_another(system):
    def run(seed, n=3):
        return system(n, seed=seed).reset()["observation"]

    assert torch.equal(run(0), run(0))
    assert not torch.equal(run(0), run(1))
    # A draw belongs to (environment, episode): more environments do not change it.
    assert torch.equal(run(0), run(0, n=8)[:3])


def test_global_generators_are_neither_used_nor_moved(system):
    before = torch.random.get_rng_state()
    system(3).reset()
    assert torch.equal(before, torch.random.get_rng_state())


def test_reset_noise_is_uniform():
    observation = CartPoleEnv(20_000, dtype=torch.float64).reset()["observation"]
    unit = observation / 0.1 + 0.5
    assert unit.min() >= 0
    assert unit.max() < 1
    for column in unit.T:
        ranked, grid = column.sort().values, torch.linspace(0, 1, 20_000).double()
        assert (ranked - grid).abs().max() < 0.0138  # Kolmogorov, 0.1 %
    assert (torch.corrcoef(unit.T) - torch.eye(4)).abs().max() < 0.03


def test_partial_reset_touches_only_the_masked_rows():
    env = CartPoleEnv(3)
    env.rollout(4)
    before = env.state
    mask = torch.tensor([[False], [True], [False]])
    td = env.rollout(1)[:, -1].select().set("_reset", mask)
    state = env.state
    env._reset(td)
    assert torch.equal(env.state[[0, 2]], state[[0, 2]])
    assert not torch.equal(env.state[1], state[1])
    assert before.shape == state.shape


def test_max_steps_truncates_each_environment_by_its_own_clock():
    env = PendulumEnv(2, max_steps=3)
    td = env.rollout(2, break_when_any_done=False)
    assert not td["next", "done"].any()
    env._reset(td[:, -1].select().set("_reset", torch.tensor([[True], [False]])))
    out = env._step(td[:, -1])
    assert out["truncated"].tolist() == [[False], [True]]
    assert out["done"].tolist() == [[False], [True]]
    assert not out["terminated"].any()


def test_collector_resets_on_its_own():
    env = CartPoleEnv(8, max_steps=20)
    policy = TensorDictModule(
        lambda obs: torch.nn.functional.one_hot((obs[..., 2] > 0).long(), 2),
        in_keys=["observation"],
        out_keys=["action"],
    )
    collector = Collector(
        env,
        policy,
        frames_per_batch=8 * 50,
        total_frames=8 * 50,
        auto_register_policy_transforms=True,
    )
    (batch,) = list(collector)
    done = batch["next", "done"][:, :-1, 0]
    after = batch["observation"][:, 1:][done]
    assert done.any()
    assert after.abs().max() <= 0.05
    running = batch["next", "observation"][:, :-1][~done]
    assert torch.equal(batch["observation"][:, 1:][~done], running)


def test_inside_a_serial_env():
    check_env_specs(SerialEnv(2, lambda: PendulumEnv(3)))


def test_written_parameters_are_read_back_and_only_where_masked():
    env = PendulumEnv(3)
    env.set_parameters({"m": torch.tensor([2.0, 3.0, 4.0])}, torch.tensor([True, False, True]))
    assert env.parameters["m"].tolist() == [2.0, 1.0, 4.0]
    assert env.parameters["l"].tolist() == [1.0, 1.0, 1.0]
    env.parameters["m"].zero_()
    assert env.parameters["m"].tolist() == [2.0, 1.0, 4.0]


def test_unmasked_values_may_be_anything():
    env = PendulumEnv(2)
    env.set_parameters({"m": torch.tensor([2.0, torch.nan])}, torch.tensor([True, False]))
    assert env.parameters["m"].tolist() == [2.0, 1.0]


def test_a_diverged_environment_ends_and_the_rest_go_on():
    env = AcrobotEnv(2, max_steps=500, dtype=torch.float32)
    env.set_parameters({"LINK_MOI": torch.tensor([1.0, -1e30])}, torch.tensor([True, True]))
    env.set_parameters({"LINK_MASS_2": torch.tensor([1.0, 1e38])}, torch.tensor([True, True]))
    out = env.rollout(30)["next"][:, -1]
    assert out["observation"].isfinite().all()
    assert out["terminated"].tolist() == [[False], [True]]
    assert out["diverged"].tolist() == [[False], [True]]
    assert out["reward"].tolist() == [[-1.0], [0.0]]


@pytest.mark.parametrize(
    ("values", "mask", "error", "match"),
    [
        ({"masspol": torch.ones(2)}, EVERY, KeyError, r"masspole \(did you mean"),
        ({"masspole": torch.ones(3)}, EVERY, ValueError, r"masspole to have shape \(2,\)"),
        ({"masspole": torch.tensor([1.0, torch.nan])}, EVERY, ValueError, "finite and positive"),
        ({"masspole": torch.tensor([1.0, 0.0])}, EVERY, ValueError, "finite and positive"),
        ({"gravity": torch.tensor([1.0, torch.inf])}, EVERY, ValueError, "gravity to be finite"),
        ({"masspole": torch.ones(2)}, torch.ones(2), ValueError, "mask to be torch.bool"),
        ({"masspole": torch.ones(2)}, torch.ones(3).bool(), ValueError, r"of shape \(2,\)"),
    ],
)
def test_bad_parameters_are_refused_and_nothing_is_written(values, mask, error, match):
    env = CartPoleEnv(2)
    with pytest.raises(error, match=match):
        env.set_parameters({"tau": torch.full((2,), 0.5)} | values, mask)
    assert env.parameters["tau"].tolist() == pytest.approx([0.02, 0.02])


@pytest.mark.parametrize(
    ("env", "action", "match"),
    [
        (PendulumEnv(2), torch.tensor([[0.0], [torch.nan]]), r"finite actions.*environments \[1\]"),
        (PendulumEnv(2), torch.zeros(2), r"actions of shape \(2, 1\)"),
        (CartPoleEnv(2), torch.tensor([[1, 0], [1, 1]]), "one-hot actions"),
        (CartPoleEnv(2), torch.tensor([[1, 0], [0, 2]]), "one-hot actions"),
        (
            AcrobotEnv(2, categorical_action_encoding=True),
            torch.tensor([0, 3]),
            "actions from 0 to 2",
        ),
    ],
)
def test_bad_actions_are_refused(env, action, match):
    td = env.reset().set("action", action)
    with pytest.raises(ValueError, match=match):
        env._step(td)


@pytest.mark.parametrize("options", [{"num_envs": 0}, {"num_envs": 2, "max_steps": 0}])
def test_bad_sizes_are_refused(options):
    with pytest.raises(ValueError, match="positive integer"):
        CartPoleEnv(**options)


def test_state_must_fit():
    env = PendulumEnv(2)
    with pytest.raises(ValueError, match=r"finite state of shape \(2, 2\)"):
        env.state = torch.zeros(2, 3)
