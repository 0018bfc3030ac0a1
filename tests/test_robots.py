import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, TensorDictModule
from torchrl.envs import (
    CatTensors,
    Compose,
    GymEnv,
    PendulumEnv,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    UnsqueezeTransform,
)

from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.physics.state import StatePhysics
from torchrl_bayessim.robots import RecordedLogs, SurrogateRobot
from torchrl_bayessim.trajectories import pad
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

HIDDEN = 0.7314159


def gym():
    return TransformedEnv(GymEnv("CartPole-v1"), ApplyPhysics(AttributePhysics("length")))


def batched(width=3, *more):
    physics = ApplyPhysics(AttributePhysics("length"))
    return TransformedEnv(CartPoleEnv(width), Compose(physics, *more))


def hopper():
    physics = ApplyPhysics(MujocoPhysics(torso="body_mass[torso]"))
    return TransformedEnv(BatchedMujocoEnv("Hopper-v5", 2), physics)


def stateless():
    """TorchRL's pendulum, whose parameters are entries of the tensordict."""
    return TransformedEnv(
        PendulumEnv(),
        Compose(
            ApplyPhysics(StatePhysics("m")),
            UnsqueezeTransform(dim=-1, in_keys=["th", "thdot"], out_keys=["angle", "rate"]),
            CatTensors(["angle", "rate"], "observation", del_keys=False),
        ),
    )


ROBOTS = {
    "batched": batched,
    "single": gym,
    "serial": lambda: SerialEnv(2, gym),
    "mujoco": hopper,
    "stateless": stateless,
}


@pytest.mark.parametrize("kind", ROBOTS)
@pytest.mark.parametrize("episodes", [1, 5])
def test_what_a_robot_returns_is_its_episodes_and_never_its_parameters(kind, episodes):
    robot = SurrogateRobot(ROBOTS[kind](), [HIDDEN], max_steps=8)
    real = robot.rollouts(None, episodes=episodes, key=(0,))
    assert real.batch_size == (episodes, 8)
    assert real["mask"][:, 0].all()
    names = {str(name) for name in real.keys(include_nested=True, leaves_only=True)}
    measured = {"observation", "action", "mask", "('next', 'observation')"}
    assert measured < names
    rest = ("reward", "done", "terminated", "truncated")
    assert names - measured <= {f"('next', '{name}')" for name in rest}
    for value in real.values(include_nested=True, leaves_only=True):
        assert not torch.isclose(value.double(), torch.tensor(HIDDEN).double(), atol=1e-6).any()


@pytest.mark.parametrize("kind", ROBOTS)
def test_real_episodes_differ_from_each_other_and_a_key_repeats_them(kind):
    robot = SurrogateRobot(ROBOTS[kind](), [0.6], max_steps=8)
    real, same, other = (
        robot.rollouts(None, episodes=5, key=key) for key in [(0, "a"), (0, "a"), (0, "b")]
    )
    assert len(real["observation"].flatten(1).unique(dim=0)) == 5
    assert torch.equal(real["observation"], same["observation"])
    assert torch.equal(real["action"], same["action"])
    assert not torch.equal(real["observation"], other["observation"])


def test_hidden_parameters_are_those_that_move_the_robot():
    """The half length of the pole, from the first step of each episode."""
    real = SurrogateRobot(batched(), [HIDDEN], max_steps=3).rollouts(None, episodes=6, key=(0,))
    now = real["observation"][:, 0].double()
    x_acc, turn = ((real["next", "observation"][:, 0].double() - now) / 0.02)[:, [1, 3]].unbind(-1)
    length = (9.8 * now[:, 2].sin() - x_acc * now[:, 2].cos()) / (4 / 3 * turn)
    torch.testing.assert_close(length, torch.full_like(length, HIDDEN), rtol=2e-3, atol=0)


def test_the_robot_follows_the_policy_and_its_episodes_end_where_they_end():
    def left(observation):
        return torch.tensor([1, 0]).expand(*observation.shape[:-1], 2)

    policy = TensorDictModule(left, in_keys=["observation"], out_keys=["action"])
    real = SurrogateRobot(batched(), [0.5], max_steps=30).rollouts(policy, episodes=3, key=(0,))
    assert (real["action"][..., 0] == 1).all()
    mask = real["mask"]
    assert (mask.sum(-1) < 15).all()  # an untended pole falls
    last = mask.sum(-1, keepdim=True) - 1
    done = real["next", "done"].squeeze(-1)
    assert done.gather(-1, last).all()
    assert not (done & mask).sum(-1).gt(1).any()


@pytest.mark.parametrize("default", ["DETERMINISTIC", "RANDOM"])
def test_the_robot_explores_as_collectors_do_whatever_the_policy_does_by_default(default):
    env = batched()
    policy = PPO(env, hidden=(4,)).policy
    policy[-1].default_interaction_type = InteractionType[default]
    real = SurrogateRobot(env, [0.5], max_steps=8).rollouts(policy, episodes=3, key=(0,))
    pushes = real["action"][..., 0].float()
    assert 0.2 < pushes.mean() < 0.8  # an untrained policy: any action is as likely


def test_a_policy_that_would_have_to_be_told_the_parameters_is_refused():
    env = batched()
    policy = PPO(env, observation_keys=("observation", "theta"), hidden=(4,)).policy
    robot = SurrogateRobot(env, [0.5], max_steps=4)
    with pytest.raises(ValueError, match=r"reads what is measured, got 'theta'. Available: obser"):
        robot.rollouts(policy, episodes=1, key=(0,))


def test_what_is_measured_can_be_chosen_and_must_exist():
    robot = SurrogateRobot(
        batched(3, StepCounter()), [0.5], max_steps=4, measured=("observation", "step_count")
    )
    real = robot.rollouts(None, episodes=2, key=(0,))
    assert real["step_count"][0].flatten().tolist() == [0, 1, 2, 3]
    with pytest.raises(ValueError, match=r"observation to measure, got 'observatio'.*did you mean"):
        SurrogateRobot(batched(), [0.5], max_steps=4, measured=("observatio",))


def log(length, **changes):
    steps = {
        "observation": torch.randn(length, 4),
        "action": torch.randn(length, 1),
        "next": {"observation": torch.randn(length, 4)},
    }
    return TensorDict(steps | changes, [length])


def test_logs_are_returned_as_they_are_whatever_is_asked():
    logs = pad([log(3), log(5)])
    real = RecordedLogs(logs).rollouts(None, episodes=7, key=(3,))
    assert (real == logs).all()
    assert real["mask"].sum(-1).tolist() == [3, 5]


@pytest.mark.parametrize("name", ["observation", "action", ("next", "observation"), "mask"])
def test_logs_without_an_entry_are_refused(name):
    with pytest.raises(
        ValueError, match=r"real trajectories with an entry.*Available: .*(action|obs)"
    ):
        RecordedLogs(pad([log(3)]).exclude(name))


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize("name", ["observation", "action"])
def test_a_value_that_is_not_finite_is_found(name, value):
    bad = log(5)
    bad[name][3, 0] = value
    with pytest.raises(ValueError, match=rf"finite.*{name}.*trajectory 1 at step 3.*Try: cut"):
        RecordedLogs(pad([log(5), bad]))
    RecordedLogs(pad([log(5), bad[:3]]))  # what is cut off does not matter


def test_empty_logs_are_refused():
    with pytest.raises(TypeError, match=r"\[n, T\] in a TensorDict, got 'list'\. Try: pad"):
        RecordedLogs([log(3)])
    logs = pad([log(3), log(2)])
    with pytest.raises(ValueError, match="at least one step each"):
        RecordedLogs(logs.set("mask", logs["mask"] & torch.tensor([[True], [False]])))
    with pytest.raises(ValueError, match=r"trajectories \[n, T\].*got \(3,\)"):
        RecordedLogs(logs[0])
    with pytest.raises(ValueError, match=r"trajectories \[n, T\].*got \(0, 3\)"):
        RecordedLogs(logs[:0])


def test_what_was_logged_may_have_other_names():
    steps = log(4)
    renamed = TensorDict(
        {
            "joints": {"angle": steps["observation"]},
            "torque": steps["action"],
            "next": {"joints": {"angle": steps["next", "observation"]}},
        },
        [4],
    )
    names = {"measured": [("joints", "angle")], "action_key": "torque"}
    logs = RecordedLogs(pad([renamed]), **names)
    assert logs.rollouts(None, episodes=1, key=(0,))["joints", "angle"].shape == (1, 4, 4)
    renamed["next", "joints", "angle"][2, 1] = torch.nan
    with pytest.raises(ValueError, match=r"'next', 'joints', 'angle'.*trajectory 0 at step 2"):
        RecordedLogs(pad([renamed]), **names)
    with pytest.raises(TypeError, match=r"measured= to be a sequence.*Try: \('angle',\)"):
        RecordedLogs(pad([log(3)]), measured="angle")


def test_robots_and_logs_tell_themselves_from_others():
    one, same, other = (SurrogateRobot(batched(), [t], max_steps=5) for t in (0.4, 0.4, 0.4001))
    assert one.settings == same.settings != other.settings
    assert "0.4" not in repr(other.settings)
    assert one.settings != SurrogateRobot(batched(), [0.4], max_steps=6).settings
    logs = [pad([log(3)]), pad([log(3)]), pad([log(4)])]
    first, again, longer = (RecordedLogs(rows).settings for rows in logs)
    assert (first == again) == torch.equal(logs[0]["action"], logs[1]["action"])
    assert first == RecordedLogs(logs[0].clone()).settings != longer


class Diverging(CartPoleEnv):
    """A cart-pole whose observations are lost after three steps."""

    def _step(self, tensordict):
        out = super()._step(tensordict)
        self.count = getattr(self, "count", 0) + 1
        return out.set("observation", out["observation"] / float(self.count <= 3))


def test_a_robot_that_diverges_is_named():
    env = TransformedEnv(Diverging(2), ApplyPhysics(AttributePhysics("length")))
    robot = SurrogateRobot(env, [0.5], max_steps=9)
    policy = PPO(batched(), hidden=(4,)).policy
    with pytest.raises(SimulationError, match=r"finite values of .*in episode 0 at step .*diverge"):
        robot.rollouts(policy, episodes=2, key=(0,))


def test_what_is_no_parameter_and_no_list_of_entries_is_refused():
    with pytest.raises(TypeError, match=r"numbers, the parameters θ of shape \(D,\), got 'long'"):
        SurrogateRobot(batched(), "long", max_steps=5)
    with pytest.raises(TypeError, match=r"measured= to be a sequence.*Try: \('observation',\)"):
        SurrogateRobot(batched(), [0.5], max_steps=5, measured="observation")


@pytest.mark.parametrize("steps", [0, -1])
def test_a_robot_takes_at_least_one_step(steps):
    with pytest.raises(ValueError, match=f"max_steps to be positive, got {steps}"):
        SurrogateRobot(batched(), [HIDDEN], max_steps=steps)


def test_a_robot_does_at_least_one_episode():
    robot = SurrogateRobot(batched(), [HIDDEN], max_steps=5)
    with pytest.raises(ValueError, match="episodes to be positive, got 0"):
        robot.rollouts(None, episodes=0, key=(0,))


@pytest.mark.parametrize("nested", [True, False])
def test_a_robot_does_not_draw_its_own_parameters(nested):
    randomizer = DomainRandomizer(BoxPrior({"length": (0.2, 1.5)}))
    env = batched() if nested else batched(3, randomizer)
    if nested:
        env = TransformedEnv(env, randomizer, auto_unwrap=False)
        env = TransformedEnv(env, StepCounter(), auto_unwrap=False)
    with pytest.raises(ValueError, match=r"the robot alone sets.*'a DomainRandomizer among"):
        SurrogateRobot(env, [HIDDEN], max_steps=5)
