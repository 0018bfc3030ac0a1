import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv

from torchrl_bayessim.envs.additions import rollout_with, steps_with
from torchrl_bayessim.envs.drive import Drive
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.stepper import Stepper
from torchrl_bayessim.transforms.simulators import add_every_time_step

SLEDGE = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body>
<joint name="rail" type="slide" axis="1 0 0" frictionloss="0"/>
<geom type="box" size=".1 .1 .1" mass="2"/></body></worldbody>
<actuator><motor joint="rail"/></actuator></mujoco>
"""


def sledge():
    return mujoco.MjModel.from_xml_string(SLEDGE)


def test_a_force_and_a_command_move_a_mass_as_newton_says():
    def push(now):
        return {"qfrc_applied": torch.full_like(now.qvel, 3.0), "ctrl": torch.ones_like(now.ctrl)}

    model = sledge()
    data = mujoco.MjData(model)
    data.ctrl[:] = 2.0
    steps_with(model, data, [push], count=10)
    assert data.qvel[0] == pytest.approx((3 + 1 + 2) / 2 * 0.1)
    assert (data.ctrl[0], data.qfrc_applied[0]) == (2.0, 0.0)
    stepper = Stepper(sledge(), 2, threads=1)
    outputs = rollout_with(stepper, [push], np.full((2, 5, 1), 2.0), substeps=2)
    np.testing.assert_allclose(outputs[:, -1, 1], data.qvel[0])
    assert (stepper["qfrc_applied"] == 0).all()


def test_additions_see_the_commands_of_those_before_and_every_time_step():
    seen = []

    def double(now):
        return {"ctrl": now.ctrl.clone()}

    def watch(now):
        seen.append((round(float(now.time.max()), 3), float(now.ctrl.max())))
        return {}

    rollout_with(Stepper(sledge(), 1, threads=1), [double, watch], np.ones((1, 1, 1)), substeps=3)
    assert seen == [(0.0, 2.0), (0.01, 2.0), (0.02, 2.0)]


def test_friction_and_damping_are_added_to_what_each_simulation_has():
    def resist(now):
        return {"dof_damping": now.qvel.abs(), "dof_frictionloss": torch.ones_like(now.qvel)}

    stepper = Stepper(sledge(), 2, threads=1)
    stepper.models.write("dof_frictionloss", (0,), np.array([0.0, 2.0]))
    outputs = rollout_with(stepper, [resist], np.full((2, 1, 1), 2.5), substeps=1)
    # under 2.5 N the first slides with 1 N of friction; 3 N hold the second, but for the tenth of
    # the motion that the constraint, which is its own and soft, lets through (solimp 0.9)
    assert outputs[0, 0, 1] == pytest.approx((2.5 - 1.0) / 2 * 0.01, rel=0.05)
    assert outputs[1, 0, 1] == pytest.approx(0.1 * 2.5 / 2 * 0.01, rel=0.05)
    np.testing.assert_array_equal(stepper.models.read("dof_frictionloss", (0,)), [0.0, 2.0])
    np.testing.assert_array_equal(stepper.models.read("dof_damping", (0,)), [0.0, 0.0])


def test_an_addition_of_nothing_changes_no_bit():
    plain, other = (BatchedMujocoEnv("Hopper-v5", 2, threads=1) for _ in range(2))
    other.add("nothing", lambda now: {"qfrc_applied": torch.zeros_like(now.qvel)})
    plain.reset(), other.reset()
    action = TensorDict({"action": torch.full((2, 3), 0.4)}, [2])
    for _ in range(5):
        one, two = (env.step(action.clone())["next"] for env in (plain, other))
        assert torch.equal(one["observation"], two["observation"])


@pytest.mark.parametrize("name", ["FetchPush-v4", "FetchPickAndPlace-v4"])
def test_a_command_is_held_over_all_time_steps_of_a_hand_that_is_dragged(name):
    """It steps from where hand and fingers were when it came; fingers are pinned at the end."""
    plain, other = (BatchedMujocoEnv(name, 2, threads=1) for _ in range(2))
    other.add("nothing", lambda now: {"qfrc_applied": torch.zeros_like(now.qvel)})
    plain.reset(), other.reset()
    actions = torch.rand(10, 2, 4, generator=torch.Generator().manual_seed(0)) * 2 - 1
    for action in actions:
        some = TensorDict({"action": action}, [2])
        one, two = (env.step(some.clone())["next"] for env in (plain, other))
        assert torch.equal(one["observation"], two["observation"])


def test_a_force_on_a_dragged_arm_is_that_of_the_single_simulator():
    arm, force = "robot0:elbow_flex_joint", 40.0
    batch = BatchedMujocoEnv("FetchReach-v4", 1, threads=1)
    single = GymEnv("FetchReach-v4")
    push = torch.zeros(1, batch.task.model.nv)
    push[0, batch.task.model.joint(arm).dofadr[0]] = force
    first = batch.reset()["observation"].clone()
    batch.add("push", lambda now: {"qfrc_applied": push.double()})
    add_every_time_step(single, "push", lambda now: {"qfrc_applied": push[0].double()})
    single.reset()
    action = torch.tensor([0.2, -0.5, 0.1, 0.0])
    for _ in range(4):
        one = batch.step(TensorDict({"action": action[None]}, [1]))["next", "observation"][0]
        two = single.step(TensorDict({"action": action}, []))["next", "observation"]
    assert (one - first[0]).abs().max() > 1e-3
    torch.testing.assert_close(one.double(), two.double(), atol=1e-6, rtol=0.0)


def test_an_addition_sees_the_control_and_not_what_it_is_relative_to():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='x' type='slide'/><geom size='.1'/></body>"
        "</worldbody><actuator><position joint='x' kp='10'/></actuator></mujoco>"
    )
    stepper = Stepper(model, 1, drive=Drive(relative=(0,)), threads=1)
    stepper["qpos"][:] = 1.0
    seen = []

    def look(now):
        seen.append(float(now.ctrl))
        return {}

    rollout_with(stepper, [look], np.full((1, 1, 1), 0.1), substeps=3)
    assert seen == [pytest.approx(1.1)] * 3
