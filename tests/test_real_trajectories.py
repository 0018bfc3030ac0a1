import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv, PendulumEnv, StepCounter, TransformedEnv

from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.real_trajectories import check_columns, check_cut, simulated_columns
from torchrl_bayessim.summaries import SummaryStatistics, moments

STATISTICS = SummaryStatistics(moments)


def batch(truncated, terminated=()):
    """Three environments, eight steps; which end where they are told to."""
    flags = torch.zeros(2, 3, 8, dtype=torch.bool)
    for kind, ends in enumerate((truncated, terminated)):
        for row, step in ends:
            flags[kind, row, step] = True
    names = {"truncated": flags[0], "terminated": flags[1], "done": flags.any(0)}
    return TensorDict({"next": {k: v.unsqueeze(-1) for k, v in names.items()}}, [3, 8])


def real(*lengths):
    return TensorDict({"mask": torch.arange(8) < torch.tensor(lengths)[:, None]}, [len(lengths), 8])


def test_a_limit_counts_where_it_cuts_a_first_episode_before_the_real_ones_end():
    with pytest.raises(ValueError, match=r"last the 7 steps of .*, got '2 of 3 cut, after 5 steps"):
        check_cut(batch([(0, 4), (2, 5)]), real(7, 3))
    check_cut(batch([(0, 4), (2, 5)]), real(5, 3))  # a real episode that ended is no longer
    check_cut(batch([(0, 7)]), real(8))  # at the horizon
    check_cut(batch([(0, 6)], terminated=[(0, 3)]), real(8))  # not in its first episode
    check_cut(batch([(0, 4)], terminated=[(0, 4)]), real(8))  # it would have ended anyway
    check_cut(batch([]).exclude(("next", "truncated")), real(8))


def test_indices_are_told_to_be_one_hot():
    rows = TensorDict({"action": torch.zeros(1, 8, 1, dtype=torch.long)}, [1, 8])
    with pytest.raises(ValueError, match=r"2 columns of 'action', .*got '1 from.*Try: one-hot act"):
        check_columns(rows, {"action": 2})


@pytest.mark.parametrize(
    ("env", "sizes"),
    [
        (lambda: CartPoleEnv(5), (4, 2)),
        (lambda: GymEnv("CartPole-v1"), (4, 2)),
        (lambda: GymEnv("CartPole-v1", categorical_action_encoding=True), (4, None)),
        (lambda: GymEnv("Pendulum-v1"), (3, 1)),
    ],
)
def test_the_simulator_knows_its_columns(env, sizes):
    columns = simulated_columns(env(), STATISTICS, replayed=True)
    entries = ("observation", ("next", "observation"), "action")
    assert tuple(columns.get(key) for key in entries) == (sizes[0], *sizes)


def test_an_action_may_be_measured_but_a_recorded_one_must_be_the_simulator_s():
    env = TransformedEnv(PendulumEnv(), StepCounter())
    measured = SummaryStatistics(moments, observation_key="step_count", action_key="th")
    assert simulated_columns(env, measured, replayed=False)["step_count"] == 1
    with pytest.raises(ValueError, match=r"statistics of an action .*'th'\. Available: action"):
        simulated_columns(env, measured, replayed=True)
