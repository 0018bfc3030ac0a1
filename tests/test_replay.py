import gymnasium
import gymnasium_robotics
import mujoco
import numpy as np
import pytest
import torch

from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.replay import Replay, replay

SLIDER = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0"/>
      <geom size=".1" mass="2"/>
    </body>
  </worldbody>
  <actuator>
    <general name="motor" joint="x" dyntype="filter" dynprm="0.05" gainprm="1"/>
  </actuator>
</mujoco>
"""


def slider(frame_skip=5):
    return Task(model=mujoco.MjModel.from_xml_string(SLIDER), frame_skip=frame_skip)


def pushes(segments=3, steps=8):
    generator = torch.Generator().manual_seed(0)
    return {
        "qpos": torch.randn(segments, 1, generator=generator),
        "qvel": torch.randn(segments, 1, generator=generator),
        "act": torch.randn(segments, 1, generator=generator),
        "time": torch.rand(segments, 1, generator=generator),
        "action": torch.randn(segments, steps, 1, generator=generator),
    }


def test_every_pair_of_physics_and_segment_is_a_simulation_of_its_own():
    segments, theta = pushes(), torch.tensor([[0.0, 2.0], [3.0, 1.0]])
    physics = MujocoPhysics("dof_damping[x]", "body_mass[cart]")
    got = replay(slider(), segments, theta, physics=physics, outputs=("qpos", "qvel", "act"))
    assert got.batch_size == (2, 3, 8)
    for p, (damping, mass) in enumerate(theta.tolist()):
        model = slider().model
        model.dof_damping[0] = damping
        model.body_inertia[1] *= mass / model.body_mass[1]
        model.body_mass[1] = mass
        mujoco.mj_setConst(model, mujoco.MjData(model))
        for s in range(3):
            data = mujoco.MjData(model)
            for name in ("qpos", "qvel", "act"):
                getattr(data, name)[:] = segments[name][s]
            for t in range(8):
                data.ctrl[:] = segments["action"][s, t]
                mujoco.mj_step(model, data, nstep=5)
                for name in ("qpos", "qvel", "act"):
                    np.testing.assert_array_equal(got[name][p, s, t], getattr(data, name))


@pytest.mark.parametrize("name", ["Walker2d-v5", "FetchPush-v4", "FetchPickAndPlace-v4"])
def test_a_recorded_episode_is_replayed_exactly(name):
    env = BatchedMujocoEnv(name, 2, dtype=torch.float64)
    env.reset()
    action = torch.rand(2, 20, env.action_spec.shape[-1]) * 2 - 1
    env.open_loop(action[:, :5])
    wanted = ("time", "qpos", "qvel", "act", "warmstart", "mocap_pos", "mocap_quat")
    segments = {c: torch.from_numpy(env.stepper[c].copy()) for c in wanted}
    if name.startswith("Fetch"):
        segments["weld_pose"] = torch.from_numpy(env.stepper["weld_pose"].copy())
        segments["goal"] = env.readings.goal
    recorded = env.open_loop(action[:, 5:])
    segments["action"] = action[:, 5:]
    again = replay(name, segments, outputs=("observation", "qpos"))
    assert (again["observation"][0] == recorded["observation"]).all()
    np.testing.assert_array_equal(again["qpos"][0, :, -1], env.stepper["qpos"])


@pytest.mark.parametrize("name", ["FetchReach-v4", "FetchPush-v4", "FetchPickAndPlace-v4"])
def test_a_log_of_gymnasium_robotics_is_replayed_exactly(name):
    """From the middle of an episode; ``weld_pose`` is as old as MjData's other poses."""
    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(name).unwrapped
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(5):
        env.step(rng.uniform(-1, 1, 4).astype(np.float32))
    data = env.data
    hand = data.body("robot0:gripper_link")
    start = {
        "qpos": data.qpos,
        "qvel": data.qvel,
        "warmstart": data.qacc_warmstart,
        "mocap_pos": data.mocap_pos.ravel(),
        "mocap_quat": data.mocap_quat.ravel(),
        "weld_pose": np.concatenate([hand.xpos, hand.xquat]),
    }
    segments = {key: torch.tensor(value)[None] for key, value in start.items()}
    actions = rng.uniform(-1, 1, (1, 10, 4)).astype(np.float32)
    log = []
    for action in actions[0]:
        env.step(action)
        log.append(np.concatenate([data.qpos, data.qvel]))
    y = replay(name, {**segments, "action": torch.from_numpy(actions)})
    np.testing.assert_array_equal(torch.cat([y["qpos"], y["qvel"]], -1)[0, 0], np.stack(log))
    del segments["weld_pose"]
    with pytest.raises(ValueError, match=r"weld_pose.*Try: xpos and xquat of data.body\('robot0"):
        replay(name, {**segments, "action": torch.from_numpy(actions)})


def test_actions_may_have_been_held_for_another_time():
    expected = replay(slider(frame_skip=2), pushes())
    assert (replay(slider(), pushes(), dt=0.02)["qpos"] == expected["qpos"]).all()
    for dt in (0.015, 0.001, -0.02):
        with pytest.raises(ValueError, match=r"a multiple of the model's time step, 0.01 s"):
            replay(slider(), pushes(), dt=dt)


def test_speeds_in_a_replay_are_over_the_time_step_in_force():
    env = BatchedMujocoEnv("FetchReach-v4", 2, dtype=torch.float64)
    env.models.write("opt.timestep", (), np.array([0.001, 0.002]))
    env.reset()
    wanted = ("qpos", "qvel", "mocap_pos", "mocap_quat", "weld_pose", "warmstart", "time")
    start = {name: torch.from_numpy(env.stepper[name][:1].copy()) for name in wanted}
    start["goal"] = env.readings.goal[:1]
    env.stepper.state[1] = env.stepper.state[0]
    action = torch.full((1, 5, 4), 0.5)
    recorded = env.open_loop(action.expand(2, 5, 4))["observation"]
    model = Replay(
        "FetchReach-v4",
        {**start, "action": action},
        physics=MujocoPhysics("opt.timestep"),
        outputs=("observation",),
    )
    again = model(torch.tensor([[0.001], [0.002]], dtype=torch.float64))["observation"]
    assert (again[:, 0] == recorded).all()


def test_room_for_more_parameters_is_made_and_reused():
    segments, physics = pushes(), MujocoPhysics("dof_damping[x]")
    model = Replay(slider(), segments, physics=physics)
    theta = torch.tensor([[0.5], [1.0], [2.0], [4.0]])
    one, four, two = model(theta[:1]), model(theta), model(theta[2:])
    assert (one["qvel"] == four["qvel"][:1]).all()
    assert (two["qvel"] == four["qvel"][2:]).all()
    assert model.batch_size == (4,)
    kept = four["qpos"].clone()
    model(theta * 2)
    assert (four["qpos"] == kept).all()


@pytest.mark.parametrize("every", ["control", "time"])
def test_a_hook_that_does_nothing_changes_nothing(every):
    plain = replay(slider(), pushes())
    hooked = Replay(slider(), pushes())(hook=lambda now: {}, every=every)
    assert (plain["qpos"] == hooked["qpos"]).all()


def test_a_force_is_a_generalised_force():
    segments = pushes()
    segments["action"].zero_()
    segments["act"].zero_()
    model = Replay(slider(), segments)
    push = torch.tensor([1.0, 2.0, 0.0]).reshape(1, 3, 1)
    velocity = model(hook=lambda now: {"qfrc_applied": push})["qvel"][0, :, -1, 0]
    expected = segments["qvel"][:, 0] + push[0, :, 0] / 2.0 * 0.05 * 8  # F t / m
    torch.testing.assert_close(velocity, expected.double())


def test_a_hook_every_time_step_sees_the_state_of_that_step():
    damping = 3.0
    exact = replay(
        slider(frame_skip=10),
        pushes(),
        torch.tensor([[damping]]),
        physics=MujocoPhysics("dof_damping[x]"),
    )["qvel"]
    model = Replay(slider(frame_skip=10), pushes())

    def drag(now):
        return {"qfrc_applied": -damping * now.qvel}

    errors = {
        every: (model(hook=drag, every=every)["qvel"] - exact).abs().max()
        for every in ("control", "time")
    }
    assert errors["time"] < 0.3 * errors["control"]


def test_a_hook_may_replace_the_recorded_control():
    segments = pushes()
    halved = segments | {"action": segments["action"] / 2}
    expected = replay(slider(), halved)["qpos"]
    got = Replay(slider(), segments)(hook=lambda now: {"ctrl": now.ctrl / 2}, every="time")["qpos"]
    assert (got == expected).all()


def test_a_divergence_stays_with_its_simulation():
    theta = torch.tensor([[1.0], [-1e6]])
    physics = MujocoPhysics("dof_damping[x]")
    model = Replay(slider(), pushes(steps=40), physics=physics)
    for hook in (None, lambda now: {}):
        y = model(theta, hook=hook)["qvel"]
        assert y[0].isfinite().all()
        assert y[1, :, -1].isnan().all()


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"qpos": torch.zeros(2, 1)}, ValueError, r"finite numbers for 3 segments in 'qpos'"),
        ({"qpos": torch.zeros(3, 2)}, ValueError, r"shape \(3, 1\) for qpos, got \(3, 2\)"),
        ({"qvel": torch.full((3, 1), torch.nan)}, ValueError, "finite numbers .* 'qvel'"),
        ({"action": torch.zeros(3, 1)}, ValueError, r"actions of shape \(S, T, A\)"),
        ({"action": torch.zeros(3, 0, 1)}, ValueError, r"T at least 1, got \(3, 0, 1\)"),
        ({"action": torch.zeros(3, 4, 2)}, ValueError, r"commands of shape \(B, T, 1\)"),
        ({"qpso": torch.zeros(3, 1)}, KeyError, r"qpos \(did you mean this\?\)"),
    ],
)
def test_bad_segments_are_refused(change, error, match):
    with pytest.raises(error, match=match):
        replay(slider(), pushes() | change)


def test_bad_calls_are_refused():
    model = Replay(slider(), pushes(), physics=MujocoPhysics("dof_damping[x]"))
    with pytest.raises(ValueError, match=r"theta of shape \(P, 1\), .*got \(2, 2\)"):
        model(torch.zeros(2, 2))
    with pytest.raises(ValueError, match=r"P at least 1, .*got \(0, 1\)"):
        model(torch.zeros(0, 1))
    with pytest.raises(ValueError, match=r"got \(1,\). Try: theta\[None\] for a single vector"):
        model(torch.zeros(1))
    with pytest.raises(ValueError, match=r"physics, to say what theta sets, got 'none'"):
        Replay(slider(), pushes())(torch.zeros(1, 1))
    with pytest.raises(ValueError, match="every='control', or 'time'"):
        model(hook=lambda now: {}, every="day")
    with pytest.raises(KeyError, match=r"ctrl \(did you mean this\?\)"):
        model(hook=lambda now: {"ctr": now.ctrl})
    with pytest.raises(ValueError, match="segments with qpos, qvel and action"):
        replay(slider(), {"qpos": torch.zeros(1, 1)})


def test_segments_are_copied():
    segments = {name: value.double() for name, value in pushes().items()}
    model = Replay(slider(), segments)
    before = model()["qpos"]
    for value in segments.values():
        value.add_(1.0)
    assert (model()["qpos"] == before).all()
    arrays = {name: value.numpy() - 1.0 for name, value in segments.items()}
    model = Replay(slider(), arrays)
    before = model()["qpos"]
    arrays["action"][:] = 7.0
    assert (model()["qpos"] == before).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_parameters_that_are_not_finite_are_refused_and_nothing_is_written(bad):
    """To `MujocoPhysics` NaN means nominal; in a fit it would pass for the robot's own physics."""
    model = Replay(slider(), pushes(), physics=MujocoPhysics("dof_damping[x]"))
    expected = model(torch.tensor([[3.0], [4.0]]))["qpos"]
    with pytest.raises(
        ValueError, match=rf"finite parameters, in row 1 .*dof_damping\[x\] = {bad}"
    ):
        model(torch.tensor([[1.0], [bad]]))
    assert (model()["qpos"][0] == expected[0]).all()


def test_parameters_may_be_arrays_and_need_a_gradient():
    model = Replay(slider(), pushes(), physics=MujocoPhysics("dof_damping[x]"))
    theta = torch.tensor([[3.0], [4.0]], requires_grad=True)
    expected = model(theta.detach())["qpos"]
    for given in (theta, theta.detach().numpy(), [[3.0], [4.0]], torch.tensor([[3], [4]])):
        assert (model(given)["qpos"] == expected).all()


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        (
            {"outputs": "qpos"},
            TypeError,
            r"a sequence of keys, got 'qpos'. Try: \('qpos',",
        ),
        ({"threads": 0}, ValueError, "threads to be a positive integer, got 0"),
        ({"threads": -1}, ValueError, "threads to be a positive integer, got -1"),
        ({"dt": np.nan}, ValueError, "dt to be a multiple of .*, got nan"),
        ({"dt": np.inf}, ValueError, "dt to be a multiple of .*, got inf"),
    ],
)
def test_bad_settings_are_refused(change, error, match):
    with pytest.raises(error, match=match):
        Replay(slider(), pushes(), **change)


def test_a_replay_is_of_a_task():
    with pytest.raises(TypeError, match=r"got 'MjModel'. Try: Task\(model=..., frame_skip=...\)"):
        Replay(slider().model, pushes())
