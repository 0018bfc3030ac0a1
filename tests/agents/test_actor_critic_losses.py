"""The losses of DDPG and TD3 against TorchRL's own, and what they add."""

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.objectives import SoftUpdate

from torchrl_bayessim.agents.actor_critic_losses import (
    BoundedDDPGLoss,
    BoundedTD0,
    BoundedTD3Loss,
    SoftUpdateAtOnce,
)
from torchrl_bayessim.agents.goal_networks import Actor, Critic
from torchrl_bayessim.randomness import isolated

LOSSES = {  # with TorchRL's own losses of the critic and of the actor
    BoundedDDPGLoss: (BoundedDDPGLoss.loss_value, BoundedDDPGLoss.loss_actor),
    BoundedTD3Loss: (BoundedTD3Loss.value_loss, BoundedTD3Loss.actor_loss),
}


def made(kind, *, action_l2=0.0, updated=False):
    """Return a loss with parameters and target parameters of its own, all away from zero."""
    with isolated("networks"):
        loss = kind(
            TensorDictModule(Actor(5, (8,), 2), ["state"], ["action"]),
            TensorDictModule(Critic(8, (8,)), ["state", "action"], ["state_action_value"]),
            gamma=0.98,
            rewards=(-1.0, 0.0),
            action_l2=action_l2,
        )
        if updated:
            SoftUpdate(loss, tau=0.1)  # TorchRL's losses warn without
        for name, value in (*loss.named_parameters(), *loss.named_buffers()):
            if "network_params" in name:
                value.data.add_(0.1 * torch.randn_like(value))
    return loss


@pytest.fixture
def batch():
    with isolated("batch"):
        ended = (torch.rand(20, 1) < 0.3).expand(20, 1)
        after = {"state": torch.randn(20, 6), "reward": -torch.rand(20, 1)}
        step = {"state": torch.randn(20, 6), "action": torch.rand(20, 2) * 2 - 1}
        after |= {"done": ended, "terminated": ended}
        return TensorDict(step | {"next": after}, [20])


def gradients(loss, value):
    found = torch.autograd.grad(value, list(loss.parameters()), allow_unused=True)
    return dict(zip(dict(loss.named_parameters()), found, strict=True))


@pytest.mark.parametrize("kind", LOSSES)
def test_losses_and_gradients_are_torchrls(kind, batch):
    loss = made(kind, updated=True)
    for own, theirs in zip((kind.critic_loss, kind.policy_loss), LOSSES[kind], strict=True):
        values = []
        with isolated("target noise"):
            noise = torch.randn_like(batch["action"])
        for function in (own, theirs):
            with isolated("target noise"):
                found = function(loss, batch.clone().update({"noise": noise}))
            values.append(found if torch.is_tensor(found) else found[0])
        torch.testing.assert_close(*values, rtol=1e-6, atol=1e-7)
        ours, expected = (gradients(loss, value) for value in values)
        for name, gradient in ours.items():
            if gradient is None:
                assert expected[name] is None or not expected[name].any()
            else:
                torch.testing.assert_close(gradient, expected[name], rtol=1e-5, atol=1e-7)
        learned = {name.split("_network")[0] for name, g in ours.items() if g is not None}
        critic = "qvalue" if kind is BoundedTD3Loss else "value"
        assert learned == {"actor" if own is kind.policy_loss else critic}


@pytest.mark.parametrize("kind", LOSSES)
def test_gradients_that_nobody_uses_are_not_worked_out(kind, batch):
    loss = made(kind)
    loss.policy_loss(batch).backward()
    networks = loss._networks
    assert all(p.grad is not None for p in networks.actor.parameters())
    idle = [networks.judge, networks.critic, networks.target_actor, networks.target_critic]
    assert all(p.grad is None for network in idle for p in network.parameters())


@pytest.mark.parametrize("kind", LOSSES)
def test_target_networks_follow_as_torchrls(kind):
    loss, twin = made(kind), made(kind)
    updaters = SoftUpdateAtOnce(loss, tau=0.1), SoftUpdate(twin, tau=0.1)
    before = copy.deepcopy(dict(loss.named_buffers()))
    for updater, one in zip(updaters, (loss, twin), strict=True):
        for parameter in one.parameters():
            parameter.data.add_(1.0)
        updater.step()
        updater.step()
    after, expected = dict(loss.named_buffers()), dict(twin.named_buffers())
    targets = [name for name in after if name.startswith("target_")]
    assert targets
    for name in targets:
        assert torch.equal(after[name], expected[name])
        assert not torch.equal(after[name], before[name])


@pytest.mark.parametrize(
    ("value", "terminated", "target"),
    [(-10.0, False, -1 + 0.98 * -10), (30.0, False, 0.0), (-1e6, False, -50.0), (-10.0, True, -1)],
)
def test_targets_are_bounded_by_what_returns_can_be(value, terminated, target):
    step = {
        "reward": torch.full((3, 1), -1.0),
        "done": torch.full((3, 1), terminated),
        "terminated": torch.full((3, 1), terminated),
        "state_value": torch.full((3, 1), value),
    }
    estimator = BoundedTD0(gamma=0.98, rewards=(-1.0, 0.0))
    found = estimator.value_estimate(TensorDict({"next": step}, [3]))
    assert found.flatten().tolist() == pytest.approx([target] * 3)
    in_training = estimator.bounded(TensorDict(step, [3]), step["state_value"])
    assert in_training.flatten().tolist() == pytest.approx([target] * 3)


@pytest.mark.parametrize("kind", LOSSES)
def test_the_actor_pays_for_the_square_of_its_actions(kind, batch):
    free, paying = (made(kind, action_l2=weight) for weight in (0.0, 3.0))
    with free.actor_network_params.to_module(free.actor_network), torch.no_grad():
        action = free.actor_network.module(batch["state"])
    paid = 3 * action.square().mean().item()
    gap = paying.policy_loss(batch).item() - free.policy_loss(batch).item()
    assert gap == pytest.approx(paid, rel=1e-4)
