import gymnasium
import gymnasium_robotics
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage
from torchrl.data.replay_buffers.her import HERReplayBuffer

from torchrl_bayessim.agents.hindsight import HindsightReplayBuffer
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.tasks.fetch import goal_reward

gymnasium.register_envs(gymnasium_robotics)


def near(achieved, desired):
    return -((achieved - desired).norm(dim=-1) > 0.5).float()


def tagged(first, *, lengths, rows=1, stops=None):
    """Return episodes whose goals are (episode, step reached); theta is the episode too."""
    parts = []
    for row in range(rows):
        for i, length in enumerate(lengths):
            time = torch.arange(length + 1.0)
            tag = torch.full_like(time, first + row * len(lengths) + i)
            place = torch.stack([tag, time if stops is None else time.clamp(max=stops)], -1)
            goal = torch.full((length, 2), -7.0)
            parts.append(
                TensorDict(
                    {
                        "achieved_goal": place[:-1],
                        "desired_goal": goal,
                        "time": time[:-1],
                        "theta": tag[:-1, None],
                        "next": {
                            "achieved_goal": place[1:],
                            "desired_goal": goal,
                            "theta": tag[1:, None],
                            "reward": torch.full((length, 1), -1.0),
                            "done": time[1:, None] == length,
                        },
                    },
                    [length],
                )
            )
    return torch.cat(parts).reshape(rows, -1)


@pytest.mark.parametrize("name", ["FetchPush-v4", "FetchReach-v4"])
def test_relabelled_rewards_are_those_of_gymnasium_robotics(name):
    env = BatchedMujocoEnv(name, 8, threads=1, dtype=torch.float64)
    episodes = env.rollout(50)
    own = goal_reward(episodes["next", "achieved_goal"], episodes["desired_goal"])
    assert torch.equal(own.unsqueeze(-1), episodes["next", "reward"])
    buffer = HindsightReplayBuffer(goal_reward, capacity=1000, share=1.0, moving=None)
    buffer.extend(episodes)
    sample = buffer.sample(2000)
    achieved, desired = sample["next", "achieved_goal"], sample["desired_goal"]
    original = gymnasium.make(name).unwrapped
    expected = original.compute_reward(achieved.numpy(), desired.numpy(), {})
    assert sample["next", "reward"][:, 0].tolist() == expected.tolist()
    if name == "FetchReach-v4":  # the gripper moves, so both rewards occur
        assert 0.05 < (sample["next", "reward"] == 0).double().mean() < 0.95


@pytest.mark.parametrize("capacity", [40, 37, 1000])
def test_goals_come_from_the_future_of_the_same_episode_also_when_full(capacity):
    buffer = HindsightReplayBuffer(near, capacity=capacity, share=1.0)
    for first in range(0, 60, 6):  # 15 steps each time: it is full after the third
        buffer.extend(tagged(first, lengths=(5, 2, 8)))
        sample = buffer.sample(500)
        episode, reached = sample["desired_goal"].unbind(-1)
        assert torch.equal(episode, sample["theta"][:, 0])
        assert torch.equal(episode, sample["next", "theta"][:, 0])
        assert (reached > sample["time"]).all()
        assert torch.equal(sample["desired_goal"], sample["next", "desired_goal"])
        expected = near(sample["next", "achieved_goal"], sample["desired_goal"])
        assert torch.equal(sample["next", "reward"][:, 0], expected)
    assert len(buffer) == min(capacity, 150)


def test_every_future_goal_is_as_likely_as_any_other():
    buffer = HindsightReplayBuffer(near, capacity=100, share=1.0)
    buffer.extend(tagged(0, lengths=(4,), rows=5))
    sample = buffer.sample(20_000)
    for time in range(4):
        reached = sample["desired_goal"][sample["time"] == time, 1]
        counts = torch.bincount(reached.long(), minlength=5)[time + 1 :]
        expected = len(reached) / (4 - time)
        assert (counts - expected).abs().max() < 5 * expected**0.5


def test_the_share_is_relabelled_and_the_rest_is_as_it_was():
    buffer = HindsightReplayBuffer(near, capacity=100, share=0.75)
    buffer.extend(tagged(0, lengths=(4,), rows=5))
    sample = buffer.sample(200)
    kept = (sample["desired_goal"] == -7).all(-1)
    assert kept.tolist() == [False] * 150 + [True] * 50
    assert (sample["next", "reward"][150:] == -1).all()
    assert (buffer.sample(200)["desired_goal"][150:] == -7).all()  # nothing is written back


def test_only_moving_transitions_are_relabelled():
    episodes = torch.cat(
        [tagged(0, lengths=(8,), stops=3), tagged(1, lengths=(8,), stops=0)]
    )  # one object stops after three steps, the other never moves
    picky = HindsightReplayBuffer(near, capacity=100, share=0.5, moving=0.1)
    picky.extend(episodes)
    sample = picky.sample(1000)
    assert set(sample["time"][:500].tolist()) == {0.0, 1.0, 2.0}
    assert (sample["theta"][:500] == 0).all()
    assert set(sample["time"][500:].tolist()) == set(range(8))
    plain = HindsightReplayBuffer(near, capacity=100, share=0.5, moving=None)
    plain.extend(episodes)
    assert set(plain.sample(1000)["time"][:500].tolist()) == set(range(8))


def test_without_any_movement_all_transitions_are_relabelled_alike():
    buffer = HindsightReplayBuffer(near, capacity=100, share=1.0, moving=0.1)
    buffer.extend(tagged(0, lengths=(8,), stops=0))
    assert set(buffer.sample(500)["time"].tolist()) == set(range(8))


def test_restored_it_gives_the_same_samples():
    buffer = HindsightReplayBuffer(near, capacity=37, share=0.8)
    for first in range(5):
        buffer.extend(tagged(first, lengths=(10,)))
    twin = HindsightReplayBuffer(near, capacity=37, share=0.8)
    twin.extend(tagged(99, lengths=(3,)))
    twin.restore(buffer.contents())
    for held in (buffer, twin):
        held.extend(tagged(7, lengths=(9,)))
    samples = []
    for held in (buffer, twin):
        torch.manual_seed(1)
        samples.append(held.sample(100))
    assert (samples[0] == samples[1]).all()


def test_unfinished_episodes_are_refused():
    buffer = HindsightReplayBuffer(near, capacity=100)
    with pytest.raises(ValueError, match=r"end with their row, got 'unfinished ones in rows \[1\]"):
        buffer.extend(torch.cat([tagged(0, lengths=(5,)), tagged(1, lengths=(9,))[:, :5]]))
    with pytest.raises(ValueError, match="at most 100 transitions at once, got 101"):
        buffer.extend(tagged(0, lengths=(101,)))


@pytest.mark.parametrize(
    "key",
    [
        "achieved_goal",
        "desired_goal",
        ("next", "achieved_goal"),
        ("next", "reward"),
        ("next", "done"),
    ],
)
def test_what_is_no_goal_environments_episodes_is_refused(key):
    buffer = HindsightReplayBuffer(near, capacity=100)
    episodes = tagged(0, lengths=(5,))
    with pytest.raises(ValueError, match=r"a goal environment's episodes, got .no .*Available"):
        buffer.extend(episodes.exclude(key))
    if key != ("next", "done"):
        episodes[key][0, 2] = torch.nan
        with pytest.raises(ValueError, match=r"finite .*, got 'NaN or infinity"):
            buffer.extend(episodes)
    with pytest.raises(ValueError, match=r"batch size \[N, T\], got \[5\]"):
        buffer.extend(tagged(0, lengths=(5,))[0])
    assert len(buffer) == 0
    with pytest.raises(ValueError, match=r"episodes to sample from, got 'an empty replay.*Try"):
        buffer.sample(3)


def test_a_goal_that_is_not_a_number_is_not_reached():
    place = torch.zeros(2, 3)
    place[1, 0] = torch.nan
    assert goal_reward(place, torch.zeros(2, 3)).tolist() == [0, -1]


@pytest.mark.parametrize(("capacity", "held"), [(20, "full"), (100, "full"), (12, "larger")])
def test_contents_of_a_buffer_of_another_capacity_are_refused(capacity, held):
    buffer = HindsightReplayBuffer(near, capacity=37)
    for first in range(5 if held == "full" else 2):
        buffer.extend(tagged(first, lengths=(10,)))
    other = HindsightReplayBuffer(near, capacity=capacity)
    other.extend(tagged(9, lengths=(10,)))
    with pytest.raises(ValueError, match=rf"capacity={capacity}, got '\d+ of a {held} one"):
        other.restore(buffer.contents())
    assert len(other) == 10


def far(achieved, desired):
    return -near(achieved, desired)


@pytest.mark.parametrize(
    ("reward", "match"),
    [
        (far, r"own reward, -1 for a transition, got '1; 10 of 10 differ'.*Try: a reward"),
        (lambda a, d: -(a - d).norm(dim=-1), "10 of 10 differ"),
        (lambda a, d: near(a, d) * torch.nan, "got 'nan; 10 of 10 differ'"),
        (lambda a, d: near(a, d).mean(), r"tensor of shape \(2, 5\), got \(\)"),
        (lambda a, d: a - d, r"a reward for each transition.*got \(2, 5, 2\)"),
        (
            lambda a, d: -torch.ones(a.shape[:-1]),  # which agrees until a goal is reached
            "greater where the goal is reached, got '-1 there, -1 far from it'",
        ),
        (lambda a, d: -1.0, "a reward for each transition.*got 'float'"),
    ],
)
def test_a_reward_that_is_not_the_environments_is_refused(reward, match):
    buffer = HindsightReplayBuffer(reward, capacity=100)
    with pytest.raises(ValueError, match=match):
        buffer.extend(tagged(0, lengths=(5,), rows=2))
    assert len(buffer) == 0


def test_a_reward_may_have_a_column_or_differ_where_a_goal_lies_at_the_threshold():
    episodes = tagged(0, lengths=(10,), rows=20)
    buffer = HindsightReplayBuffer(lambda a, d: near(a, d).unsqueeze(-1), capacity=1000)
    episodes["next", "reward"][:2] = 0.0
    buffer.extend(episodes)
    assert buffer.sample(10)["next", "reward"].shape == (10, 1)
    episodes["next", "reward"][2, 0] = 0.0
    with pytest.raises(ValueError, match="own reward, 0 for a transition, got '-1; 21 of 200 dif"):
        buffer.extend(episodes)


def test_a_reward_with_another_threshold_is_told_by_the_few_goals_that_are_reached():
    episodes = tagged(0, lengths=(10,), rows=100)
    episodes["next", "reward"][:6] = 0.0
    with pytest.raises(ValueError, match="own reward, 0 for a transition, got '-1; 60 of 1000"):
        HindsightReplayBuffer(near, capacity=1000).extend(episodes)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"share": 1.1}, r"share of relabelled transitions .* at most 1, got 1\.1"),
        ({"capacity": 0}, "transitions of capacity to be positive, got 0"),
        ({"moving": -1.0}, r"distance moved of at least 0, got -1\.0"),
    ],
)
def test_impossible_settings_are_refused(options, match):
    with pytest.raises(ValueError, match=match):
        HindsightReplayBuffer(near, **({"capacity": 10} | options))


def test_torchrls_own_buffer_still_fails_when_full():
    """Once it does not, most of ours can go."""
    theirs = HERReplayBuffer(
        lambda step: near(step["achieved_goal"], step["desired_goal"]).unsqueeze(-1),
        storage=LazyTensorStorage(40),
    )
    for first in range(4):
        theirs.extend(tagged(first, lengths=(15,)).reshape(-1))
        if first == 2:
            theirs.sample(10)  # full for the first time
    with pytest.raises(RuntimeError):
        theirs.sample(10)
