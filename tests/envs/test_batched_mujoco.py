import dataclasses

import mujoco
import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv, check_env_specs

from torchrl_bayessim.envs.drive import Drive
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.task import Task, uniform_reset
from torchrl_bayessim.envs.tasks.catalogue import known_task

PENDULUM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="pole">
      <joint name="hinge" type="hinge" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/>
      <site name="tip" pos="0 0 -.5"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator>
  <sensor><framepos objtype="site" objname="tip"/></sensor>
</mujoco>
"""


def pendulum(**changes):
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    task = Task(
        model=model,
        frame_skip=2,
        outputs=("qpos", "qvel", "sensordata"),
        observation=lambda now: torch.cat([now.qpos, now.qvel, now.sensordata], -1),
        reward=lambda before, after, action: after.sensordata[..., 2] - action[..., 0].abs(),
        reset=uniform_reset(model, 0.5),
    )
    return dataclasses.replace(task, **changes)


def acted(env, td, scale=1.0):
    td["action"] = scale * env.action_spec.rand()
    return env.step(td)["next"]


@pytest.mark.parametrize("name", ["Hopper-v5", "FetchReach-v4"])
def test_specs_hold(name):
    check_env_specs(BatchedMujocoEnv(name, 3))
    check_env_specs(BatchedMujocoEnv(name, 1, dtype=torch.float64))


def test_a_model_of_ones_own_with_sensors():
    env = BatchedMujocoEnv(pendulum(), 2)
    check_env_specs(env)
    td = env.place({"qpos": torch.tensor([[0.0], [torch.pi / 2]]), "qvel": torch.zeros(2, 1)})
    expected = torch.tensor([[0.0, 0.0, -0.5], [-0.5, 0.0, 0.0]])
    torch.testing.assert_close(td["observation"][:, 2:], expected)


def test_a_collector_resets_what_is_done_and_nothing_else():
    env = TransformedEnv(
        BatchedMujocoEnv("Hopper-v5", 4), Compose(StepCounter(max_steps=15), RewardSum())
    )
    collector = Collector(env, frames_per_batch=4 * 60, total_frames=4 * 60, trajs_per_batch=None)
    (batch,) = list(collector)
    done = batch["next", "done"][:, :-1, 0]
    count = batch["next", "step_count"][..., 0]
    assert done.any()
    assert not done.all(0).all()
    fresh = batch["step_count"][:, 1:, 0] == 0
    assert (fresh == done).all()
    carried = batch["observation"][:, 1:] == batch["next", "observation"][:, :-1]
    assert carried.all(-1)[~done].all()
    assert not carried.all(-1)[done].any()
    assert count.max() <= 15


def test_the_nth_episode_of_an_environment_depends_on_nothing_else():
    one = BatchedMujocoEnv("Reacher-v5", 3, seed=5)
    other = BatchedMujocoEnv("Reacher-v5", 8, seed=5)
    first = one.reset()
    second = one.reset()
    assert (first["observation"] != second["observation"]).any(-1).all()
    other.reset()
    mask = torch.zeros(8, 1, dtype=torch.bool)
    mask[1] = True
    td = other.reset(other.reset().set("_reset", mask))
    third = one.reset()
    torch.testing.assert_close(td["observation"][1], third["observation"][1], rtol=0, atol=0)
    one.set_seed(5)
    torch.testing.assert_close(one.reset()["observation"], first["observation"], rtol=0, atol=0)


def test_threads_do_not_change_the_numbers():
    runs = []
    for threads in (1, 3):
        env = BatchedMujocoEnv("HalfCheetah-v5", 7, threads=threads, dtype=torch.float64)
        env.reset()
        actions = torch.rand(7, 20, 6, generator=torch.Generator().manual_seed(0)) * 2 - 1
        runs.append(env.open_loop(actions)["observation"])
    assert (runs[0] == runs[1]).all()


@pytest.mark.parametrize("name", ["Ant-v5", "FetchPickAndPlace-v4", "FetchPush-v4"])
def test_open_loop_equals_closed_loop(name):
    closed, opened = (BatchedMujocoEnv(name, 3, dtype=torch.float64) for _ in range(2))
    td, _ = closed.reset(), opened.reset()
    size = closed.action_spec.shape[-1]
    actions = torch.rand(3, 12, size, generator=torch.Generator().manual_seed(0)) * 2 - 1
    ahead = opened.open_loop(actions)
    for t in range(12):
        td["action"] = actions[:, t]
        td = closed.step(td)["next"]
        for key in sorted(td.keys()):
            torch.testing.assert_close(ahead[key][:, t], td[key], rtol=0, atol=1e-12)
    assert (closed.stepper.state == opened.stepper.state).all()


def test_a_divergence_is_flagged_and_contained(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    envs = [BatchedMujocoEnv("HalfCheetah-v5", 3, threads=1) for _ in range(2)]
    tds = [env.reset() for env in envs]
    envs[0].stepper["qvel"][1] = 1e11
    action = envs[0].action_spec.zero()
    before = tds[0]["observation"][1].clone()
    sick = envs[0].step(tds[0].set("action", action))["next"]
    well = envs[1].step(tds[1].set("action", action))["next"]
    assert sick["diverged"][:, 0].tolist() == [False, True, False]
    assert sick["terminated"][:, 0].tolist() == [False, True, False]
    assert sick["reward"][1] == 0
    assert (sick["observation"][1] == before).all()
    for row in (0, 2):
        assert (sick["observation"][row] == well["observation"][row]).all()
    mask = torch.tensor([[False], [True], [False]])
    healed = envs[0].reset(sick.exclude("reward").set("_reset", mask))
    after = acted(envs[0], healed)
    assert not after["diverged"].any()
    assert after["observation"].isfinite().all()
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")


def test_impossible_physics_harm_only_their_environment(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sick, well = (BatchedMujocoEnv("Hopper-v5", 3, threads=1) for _ in range(2))
    for body in range(1, 5):
        sick.models.write("body_mass", (body,), np.array([3.0, 0.0, 3.0]))
        well.models.write("body_mass", (body,), np.full(3, 3.0))
        for axis in range(3):
            sick.models.write("body_inertia", (body, axis), np.array([0.1, 0.0, 0.1]))
            well.models.write("body_inertia", (body, axis), np.full(3, 0.1))
    rows = []
    for env in (sick, well):
        env.models.refresh()
        td = env.reset()
        td["action"] = env.action_spec.zero()
        rows.append(env.step(td)["next"])
    assert rows[0]["diverged"][:, 0].tolist() == [False, True, False]
    for row in (0, 2):
        assert (rows[0]["observation"][row] == rows[1]["observation"][row]).all()
    assert not list(tmp_path.iterdir())


def test_a_divergence_in_an_open_loop_leaves_nan():
    env = BatchedMujocoEnv("HalfCheetah-v5", 2, threads=1)
    env.reset()
    env.stepper["qvel"][0] = 1e11
    ahead = env.open_loop(torch.zeros(2, 4, 6))
    assert ahead["observation"][0].isnan().any(-1).all()
    assert ahead["observation"][1].isfinite().all()
    assert ahead["diverged"][..., 0].tolist() == [[True] * 4, [False] * 4]
    assert ahead["terminated"][0].all()


def test_the_last_of_max_steps_truncates():
    env = BatchedMujocoEnv(pendulum(), 2, max_steps=5)
    rollout = env.rollout(10)
    assert rollout.shape == (2, 5)
    assert rollout["next", "truncated"][:, -1].all()
    assert not rollout["next", "terminated"].any()
    assert BatchedMujocoEnv(pendulum(), 2).done_keys == ["done", "terminated"]


def test_observations_are_not_overwritten_by_later_steps():
    env = BatchedMujocoEnv(pendulum(observation=lambda now: now.qpos), 2, dtype=torch.float64)
    td = env.reset()
    start = td["observation"].clone()
    for _ in range(3):
        acted(env, td)
    assert (td["observation"] == start).all()


def test_goals_of_fetch_stay_apart_from_the_object():
    env = BatchedMujocoEnv("FetchPush-v4", 64)
    td = env.reset()
    hand, thing = td["observation"][:, :2], td["achieved_goal"][:, :2]
    assert ((thing - hand).norm(dim=-1) >= 0.1 - 1e-6).all()
    assert ((td["desired_goal"][:, :2] - hand).abs() <= 0.15 + 1e-6).all()


def test_bad_input_is_refused():
    env = BatchedMujocoEnv(pendulum(), 3)
    td = env.reset()
    td["action"] = torch.tensor([[0.0], [torch.nan], [0.0]])
    with pytest.raises(ValueError, match=r"finite actions, got 'others in environments \[1\]'"):
        env.step(td)
    with pytest.raises(ValueError, match=r"actions of shape \(3, T, 1\), .*got \(2, 4, 1\)"):
        env.open_loop(torch.zeros(2, 4, 1))
    with pytest.raises(RuntimeError, match="batch"):
        env.step(td[:2])
    for number in (0, 2.5):
        with pytest.raises(ValueError, match=f"num_envs to be a positive integer, got {number}"):
            BatchedMujocoEnv(pendulum(), number)
    with pytest.raises(TypeError, match=r"a task or the name of one, got 'MjModel'\. Try: Task"):
        BatchedMujocoEnv(pendulum().model, 2)
    with pytest.raises(KeyError, match=r"qvel \(did you mean this\?\)"):
        env.place({"qvl": torch.zeros(3, 1)})
    with pytest.raises(ValueError, match=r"finite numbers of shape \(3, 1\) for qvel"):
        env.place({"qvel": torch.full((3, 1), torch.inf)})
    with pytest.raises(ValueError, match=r"Hopper-v5 \(did you mean this\?\)"):
        known_task("Hoper-v5")
    with pytest.raises(KeyError, match="a component of the state"):
        env.stepper["position"]
    with pytest.raises(ValueError, match=r"an array of MjData .*xpos \(did you mean this"):
        BatchedMujocoEnv(pendulum(outputs=("qpos", "xposs")), 2)


def test_start_states_are_taken_as_they_are_or_refused():
    env = BatchedMujocoEnv("FetchReach-v4", 3, dtype=torch.float64)
    before = env.reset()
    goal = torch.tensor([[1.0, 0.7, 0.5]]).expand(3, 3)  # single precision
    td = env.place({"goal": goal}, mask=torch.tensor([True, False, True]))
    assert torch.equal(td["desired_goal"][[0, 2]], goal[[0, 2]].double())
    assert torch.equal(td["desired_goal"][1], before["desired_goal"][1])
    pose = torch.arange(21.0).reshape(3, 7)
    env.place({"weld_pose": pose})
    np.testing.assert_array_equal(env.stepper["weld_pose"], pose)
    for name, shape in {"qpos": (3, 1), "goal": (3, 2), "time": (3,), "qvel": (1, 13)}.items():
        with pytest.raises(ValueError, match=rf"finite numbers of shape \(3, .*\) for {name}"):
            env.place({name: torch.zeros(shape)})
    for mask in (torch.ones(2, dtype=torch.bool), torch.ones(3), torch.ones(3, 1).bool()):
        with pytest.raises(ValueError, match=r"a boolean mask of shape \(3,\), got"):
            env.place({"goal": goal}, mask=mask)


def test_physics_that_have_no_forward_dynamics_are_flagged_at_reset():
    env = BatchedMujocoEnv(pendulum(), 3)
    env.models.write("opt.gravity", (2,), np.array([-1.0, -1e308, -1.0]))
    env.models.write("body_mass", (1,), np.array([1.0, 1e10, 1.0]))  # a weight beyond doubles
    td = env.reset()
    assert td["diverged"][:, 0].tolist() == [False, True, False]
    assert td["observation"].isfinite().all()
    following = acted(env, td)
    for key in ("diverged", "terminated"):
        assert following[key][:, 0].tolist() == [False, True, False]
    assert following["observation"].isfinite().all()


def test_a_reset_that_returns_nonsense_is_refused():
    nan = np.array([[np.nan]])
    for value in (nan, np.zeros((1, 2)), np.zeros(1)):
        with pytest.raises(ValueError, match=r"finite numbers of shape \(1, 1\) for qpos"):
            BatchedMujocoEnv(pendulum(reset=lambda draws, v=value: {"qpos": v}), 1)


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        (
            {"reward": lambda before, after, action: after.qpos},
            ValueError,
            r"a reward of one value per environment, shape \(2,\), got \(2, 1\)",
        ),
        (
            {"termination": lambda now: now.qpos > 0},
            ValueError,
            r"a termination of one value per environment, shape \(2,\), got \(2, 1\)",
        ),
        (
            {"termination": lambda now: now.qpos[..., 0]},
            ValueError,
            r"a boolean termination, got torch.float64",
        ),
        (
            {"outputs": ("qvel", "sensordata")},
            AttributeError,
            r"something that the task reads, got 'qpos'.*Try: outputs=\(…, 'qpos'\)",
        ),
    ],
)
def test_functions_of_a_task_are_checked_at_the_start(change, error, match):
    with pytest.raises(error, match=match):
        BatchedMujocoEnv(pendulum(**change), 2)


def test_a_task_is_checked_when_it_is_made():
    for number in (0, 1.5):
        with pytest.raises(ValueError, match=f"frame_skip to be a positive integer, got {number}"):
            pendulum(frame_skip=number)
    with pytest.raises(KeyError, match=r"qpos \(did you mean this\?\)"):
        pendulum(initial={"qpso": np.zeros(1)})


def test_a_task_is_made_of_a_model():
    for model in (None, "robot.xml"):
        with pytest.raises(TypeError, match=r"an MjModel, got .*Try: mujoco.MjModel.from_xml_path"):
            Task(model=model, frame_skip=1)
    with pytest.raises(TypeError, match=r"a sequence of keys, got 'qpos'. Try: \('qpos',\)"):
        pendulum(outputs="qpos")


def test_a_misspelt_component_in_a_reset_is_refused_and_own_names_are_readings():
    def reset(draws, name):
        return {name: np.full((len(draws), 1), 0.25)}

    with pytest.raises(KeyError, match=r"a name of your own .*got 'qpso'.*qpos \(did you mean"):
        BatchedMujocoEnv(pendulum(reset=lambda draws: reset(draws, "qpso")), 2)
    env = BatchedMujocoEnv(pendulum(reset=lambda draws: reset(draws, "wanted_height")), 2)
    env.reset()
    assert env.readings.wanted_height.tolist() == [[0.25], [0.25]]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"dtype": torch.int64}, r"a floating dtype, .*got torch.int64. Available: torch"),
        ({"seed": 1.5}, "an integer as seed, got 1.5"),
        ({"threads": -1}, "threads to be a positive integer, got -1"),
        ({"max_steps": True}, "max_steps to be a positive integer, got True"),
    ],
)
def test_settings_of_another_kind_are_refused(change, match):
    with pytest.raises(ValueError, match=match):
        BatchedMujocoEnv(pendulum(), 2, **change)


def test_numbers_and_actions_may_be_numpys():
    env = BatchedMujocoEnv(pendulum(), np.int64(2), seed=np.int64(3))
    twin = BatchedMujocoEnv(pendulum(), 2, seed=3)
    assert env.batch_size == (2,)
    actions = np.linspace(-1, 1, 8).reshape(2, 4, 1)
    assert torch.equal(env.reset()["observation"], twin.reset()["observation"])
    ahead = [e.open_loop(a) for e, a in ((env, actions), (twin, torch.from_numpy(actions)))]
    assert torch.equal(ahead[0]["observation"], ahead[1]["observation"])


def test_a_step_needs_an_action():
    env = BatchedMujocoEnv(pendulum(), 2)
    with pytest.raises((ValueError, KeyError), match="action"):
        env.step(env.reset())


def test_a_sequence_of_no_actions_is_refused():
    with pytest.raises(ValueError, match=r"T at least 1, got \(2, 0, 1\)"):
        BatchedMujocoEnv(pendulum(), 2).open_loop(torch.zeros(2, 0, 1))


@pytest.mark.parametrize("domain", ["cartpole", "walker", "manipulator"])
def test_models_of_the_control_suite_run_open_loop(domain):
    suite = pytest.importorskip("dm_control.suite")
    task = dict(suite.ALL_TASKS)[domain]
    physics = suite.load(domain, task).physics
    model = physics.model.ptr
    env = BatchedMujocoEnv(
        Task(
            model=model,
            frame_skip=2,
            observation=lambda now: torch.cat([now.qpos, now.qvel], -1),
            reward=lambda before, after, action: after.qvel[..., 0],
        ),
        2,
        dtype=torch.float64,
    )
    env.reset()
    actions = torch.rand(2, 10, model.nu, generator=torch.Generator().manual_seed(0)) - 0.5
    ahead = env.open_loop(actions)["observation"]
    for i in range(2):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        for t in range(10):
            data.ctrl[:] = actions[i, t]
            mujoco.mj_step(model, data, nstep=2)
            expected = np.concatenate([data.qpos, data.qvel])
            np.testing.assert_array_equal(ahead[i, t].numpy(), expected)


@pytest.mark.parametrize("name", ["Hopper-v5", "FetchPickAndPlace-v4"])
def test_a_refused_action_leaves_no_trace(name):
    disturbed, twin = (BatchedMujocoEnv(name, 2, seed=5, dtype=torch.float64) for _ in range(2))
    steps = [env.reset() for env in (disturbed, twin)]
    size = twin.action_spec.shape[-1]
    actions = torch.linspace(-0.5, 0.5, 6 * size, dtype=torch.float64).reshape(3, 2, size)
    for action in actions:
        wrong = steps[0].clone().set("action", torch.zeros(2, size + 1, dtype=torch.float64))
        with pytest.raises(ValueError, match=rf"actions of shape \(2, {size}\)"):
            disturbed.step(wrong)
        steps = [
            env.step(td.set("action", action))["next"]
            for env, td in zip((disturbed, twin), steps, strict=True)
        ]
        assert torch.equal(steps[0]["reward"], steps[1]["reward"])


def test_a_weld_needs_a_mocap_body():
    task = pendulum(drive=Drive(weld="pole"), bounds=(-np.ones(8), np.ones(8)))
    with pytest.raises(ValueError, match="a mocap body, to which 'pole' is welded"):
        BatchedMujocoEnv(task, 1)
