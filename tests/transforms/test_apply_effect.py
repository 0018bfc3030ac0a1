import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, GymEnv, ParallelEnv, SerialEnv, TransformedEnv, check_env_specs
from torchrl.envs.libs.dm_control import DMControlEnv

from torchrl_bayessim.effects.backlash import Backlash
from torchrl_bayessim.effects.catalogue import CATALOGUE, effect
from torchrl_bayessim.effects.effect import ActionEffect, ForceEffect, ModelEffect, SensorEffect
from torchrl_bayessim.effects.robot import Robot
from torchrl_bayessim.effects.sensors import SensorLag
from torchrl_bayessim.effects.sequence import command_sequence, measured_sequence
from torchrl_bayessim.envs.mujoco import BatchedMujocoEnv
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.errors import PhysicsError
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.physics.mujoco import MujocoPhysics
from torchrl_bayessim.transforms import ApplyEffect, ApplyPhysics

torch.set_num_threads(1)
NAME = "Hopper-v5"


def batched(*transforms, count=2, name=NAME):
    return TransformedEnv(BatchedMujocoEnv(name, count, threads=1), Compose(*transforms))


def single(*transforms, name=NAME):
    return TransformedEnv(GymEnv(name), Compose(*transforms))


def start(env, batch, row):
    """Put a Gymnasium simulator into the state of one row of a batched one."""
    stepper = batch.base_env.stepper
    env.base_env._env.unwrapped.set_state(stepper["qpos"][row], stepper["qvel"][row])


def actions(env, steps, seed=0):
    size = env.action_spec.shape[-1]
    noise = torch.rand(steps, size, generator=torch.Generator().manual_seed(seed))
    return env.base_env.action_spec.space.high.reshape(-1, size)[0] * (2 * noise - 1)


def act(env, action):
    batch = env.batch_size
    step = TensorDict({"action": action.expand(*batch, -1)}, batch_size=batch)
    return env.step(step)["next"]


def run(env, sequence, key="observation"):
    return torch.stack([act(env, a)[key] for a in sequence], -2)


@pytest.mark.parametrize("name", CATALOGUE)
def test_batched_and_gymnasium_simulators_agree_and_zero_is_exactly_off(name):
    simulators_agree(name, NAME)


@pytest.mark.parametrize(
    "law", [Backlash(rotor=True), Backlash(rotor=True, wind=3.0), SensorLag(0.5)], ids=repr
)
def test_simulators_agree_on_other_laws_of_a_robot_with_rotors(law):
    simulators_agree(law, "HalfCheetah-v5")


def simulators_agree(law, robot):
    """Check that an effect does the same around one environment and in a batch, and off nothing."""
    probe = ApplyEffect(law, 0.0)
    env = single(probe, name=robot)
    high = probe.effect.bounds(probe.robot)[1]
    if isinstance(probe.effect, ForceEffect | ModelEffect):
        high = 0.5 * high
    probe.strength = high
    env.reset()
    both = ApplyEffect(law, torch.stack([torch.zeros_like(high), high]))
    batch, plain = batched(both, name=robot), batched(name=robot)
    batch.reset(), plain.reset()
    start(env, batch, 1)
    if isinstance(probe.effect, SensorEffect):
        probe._memory = both._memory = None  # the reset's own reading was of another state
    sequence = actions(env, 8)
    with_effect = run(batch, sequence)
    assert torch.equal(with_effect[0], run(plain, sequence)[0])
    assert not torch.equal(with_effect[0], with_effect[1])
    if not probe.effect.random or "quantization" in probe.effect.name:
        # observations are float32, and solvers start from other warm starts after a reset
        alone = run(env, sequence).float()
        torch.testing.assert_close(alone, with_effect[1], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", [n for n in CATALOGUE if CATALOGUE[n].random])
def test_random_effects_depend_on_their_seed_alone(name):
    def rollout(seed):
        random = ApplyEffect(name, 0.1, seed=seed)
        env = batched(random)
        env.reset()
        return run(env, actions(env, 6))

    state = torch.random.get_rng_state()
    assert torch.equal(rollout(0), rollout(0))
    assert torch.equal(torch.random.get_rng_state(), state)
    if "quantization" not in name:
        assert not torch.equal(rollout(0), rollout(1))


@pytest.mark.parametrize(
    "name", ["action_delay", "backlash", "coulomb_friction", "sensor_lag", "sensor_noise"]
)
def test_specs_hold(name):
    check_env_specs(single(ApplyEffect(name, 0.02)))
    check_env_specs(batched(ApplyEffect(name, 0.02)))


@pytest.mark.parametrize("name", ["action_delay", "action_lag", "battery_sag"])
def test_actions_change_as_in_a_whole_sequence(name):
    class Seen(ActionEffect):
        name, unit, group = "seen", "1", "gain"

        def command(self, action, strength, memory, now):
            self.record.append(action.clone())
            return action, memory

        def bounds(self, robot):
            return robot.command_scale, robot.command_scale

    seen, changed = Seen(), ApplyEffect(name, 0.011)
    seen.record = []
    env = single(ApplyEffect(seen, 0.0), changed)  # inverse transforms run backwards
    env.reset()
    sequence = actions(env, 6)
    run(env, sequence)
    expected = command_sequence(changed.effect, sequence, changed.strength, changed.robot)
    torch.testing.assert_close(torch.stack(seen.record), expected)


@pytest.mark.parametrize("name", ["sensor_delay", "sensor_lag", "sensor_drift", "sensor_gain"])
def test_observations_change_as_in_a_whole_record(name):
    sensor = ApplyEffect(name, 0.013)
    env, plain = batched(sensor), batched()
    first = torch.stack([plain.reset()["observation"], env.reset()["observation"]])
    sequence = actions(env, 6)
    true, measured = run(plain, sequence), run(env, sequence)
    record = torch.cat([first[0].unsqueeze(-2), true], -2)
    expected = measured_sequence(sensor.effect, record, sensor.strength, sensor.robot)
    torch.testing.assert_close(first[1], expected[:, 0])
    torch.testing.assert_close(measured, expected[:, 1:])


@pytest.mark.parametrize("name", ["action_delay", "backlash", "series_elasticity", "sensor_delay"])
def test_hidden_state_starts_anew_only_where_environments_reset(name):
    hidden = ApplyEffect(name, 0.02)
    # one that asks what comes before it, for which TorchRL clones the first
    env = batched(hidden, ApplyEffect("sensor_gain", 0.0))
    env.set_seed(1)
    last = env.reset()
    held = lambda: dict(hidden._memory or hidden._acting.memory)
    for action in actions(env, 4):
        last = act(env, action)
    before = held()
    assert before
    env.reset(last.clone().set("_reset", torch.tensor([[False], [True]])))
    for key, value in held().items():
        assert torch.equal(value[0], before[key][0])
        assert not torch.equal(value[1], before[key][1])


def test_effects_add_to_the_parameters_and_never_compound():
    for make in (single, batched):
        payload = ApplyEffect("payload", {"torso": 1.0})
        friction = ApplyEffect("coulomb_friction", {"foot_joint": 0.5})
        env = make(ApplyPhysics(MujocoPhysics("body_mass[torso]")), payload, friction)
        models = env.base_env.models if "Batched" in type(env.base_env).__name__ else None
        for mass in (3.0, 3.0, 5.0, 4.0):
            shape = env.full_state_spec["theta"].shape
            theta = env.full_state_spec.zero().set("theta", torch.full(shape, mass))
            reset = env.reset(theta)
            torch.testing.assert_close(reset["theta"], torch.full(shape, mass))
            if models is None:
                model = env.base_env._env.unwrapped.model
                held, loss = model.body_mass[1:2], model.dof_frictionloss[5:6]
            else:
                held, loss = models.read("body_mass", (1,)), models.read("dof_frictionloss", (5,))
            np.testing.assert_allclose(held, mass + 1.0)
            np.testing.assert_allclose(loss, 0.5)
        payload.strength = 0.0
        env.reset(theta)
        payload.strength = {"torso": 1.0}


def test_model_effects_heed_a_new_strength_from_the_next_reset_of_an_environment_on():
    spring = ApplyEffect("parallel_spring", {"leg_joint": torch.tensor([1.0, 2.0])})
    env = batched(spring)
    env.reset()
    held = lambda: env.base_env.models.read("jnt_stiffness", (4,)).tolist()
    assert held() == [1.0, 2.0]
    spring.strength = {"leg_joint": 5.0}
    assert held() == [1.0, 2.0]
    env.reset(TensorDict({"_reset": torch.tensor([[False], [True]])}, [2]))
    assert held() == [1.0, 5.0]
    spring.strength = 0.0
    env.reset()
    assert held() == [0.0, 0.0]


def test_other_strengths_act_at_once():
    gain = ApplyEffect("action_gain", 0.0)
    env, plain = batched(gain), batched()
    env.reset(), plain.reset()
    sequence = actions(env, 2)
    assert torch.equal(run(env, sequence[:1]), run(plain, sequence[:1]))
    gain.strength = -1.0
    zeroed = run(env, sequence[1:])
    assert torch.equal(zeroed, run(plain, torch.zeros(1, 3)))


def test_what_forces_add_is_gone_after_the_step():
    drag = ApplyEffect("quadratic_drag", 1.0)
    push = ApplyEffect("constant_force", 3.0)
    env = batched(drag, push)
    env.reset()
    stepper = env.base_env.stepper
    before = [stepper.models.read("dof_damping", (d,)) for d in range(6)]
    run(env, actions(env, 2))
    after = [stepper.models.read("dof_damping", (d,)) for d in range(6)]
    np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(stepper["qfrc_applied"], 0.0)


def test_two_forces_add_up_and_clones_do_not_double_them():
    def travelled(*forces):
        env = batched(*forces)
        env.set_seed(0)
        env.reset()
        return run(env, actions(env, 4))

    one, half = (ApplyEffect("constant_force", {"rootx": s}) for s in (4.0, 2.0))
    other = ApplyEffect("constant_force", {"rootx": 2.0})
    together = travelled(half, other)
    torch.testing.assert_close(travelled(one), together)
    env = BatchedMujocoEnv(NAME, 2, threads=1)
    force = ApplyEffect("constant_force", {"rootx": 4.0})
    TransformedEnv(env, force)
    env = TransformedEnv(env, force.clone())
    env.set_seed(0)
    env.reset()
    torch.testing.assert_close(run(env, actions(env, 4)), together)


def test_whole_sequences_of_actions_meet_the_same_forces():
    force = ApplyEffect("stribeck_friction", 2.0)
    env = batched(force)
    env.set_seed(0)
    env.reset()
    sequence = actions(env, 5)
    steps = run(env, sequence)
    env.set_seed(0)
    env.reset()
    whole = env.base_env.open_loop(sequence.expand(2, -1, -1))["observation"]
    torch.testing.assert_close(steps, whole)


def test_a_diverging_environment_does_not_disturb_the_others():
    force = ApplyEffect("constant_force", torch.zeros(2, 6))
    env, plain = batched(force), batched()
    env.reset(), plain.reset()
    sequence = actions(env, 3)
    strength = torch.zeros(2, 6)
    strength[0, 3] = 1e14
    force.strength = strength
    next_, expected = act(env, sequence[0]), act(plain, sequence[0])
    assert next_["diverged"][:, 0].tolist() == [True, False]
    assert torch.equal(next_["observation"][1], expected["observation"][1])


@pytest.mark.parametrize("name", ["coulomb_friction", "constant_force", "stribeck_friction"])
def test_control_suite_tasks_feel_the_same_forces(name):
    def rollout(strength):
        env = TransformedEnv(
            DMControlEnv("cartpole", "swingup"),
            ApplyEffect(name, strength),
        )
        check_env_specs(env)
        env.reset()
        physics = env.base_env._env.physics
        with physics.reset_context():
            physics.data.qpos[:] = [0.0, 3.0]
            physics.data.qvel[:] = [0.3, -0.2]
        return run(env, actions(env, 5), "position")

    plain = TransformedEnv(DMControlEnv("cartpole", "swingup"))
    plain.reset()
    with plain.base_env._env.physics.reset_context():
        plain.base_env._env.physics.data.qpos[:] = [0.0, 3.0]
        plain.base_env._env.physics.data.qvel[:] = [0.3, -0.2]
    assert torch.equal(rollout(0.0), run(plain, actions(plain, 5), "position"))
    assert not torch.equal(rollout(0.5), rollout(0.0))


def test_robotics_tasks_feel_forces():
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)

    def rollout(strength):
        force = ApplyEffect("constant_force", {"robot0:shoulder_pan_joint": strength})
        env = TransformedEnv(GymEnv("FetchReach-v4"), force)
        env.set_seed(0)
        env.reset()
        return run(env, torch.zeros(3, 4))

    assert not torch.equal(rollout(0.0), rollout(200.0))


def test_effects_on_actions_and_observations_need_no_mujoco():
    delay = ApplyEffect("action_delay", 0.05)
    bias = ApplyEffect("sensor_bias", {"cos": 0.5}, channels=("cos", "sin", "rate"))
    env = TransformedEnv(GymEnv("Pendulum-v1"), Compose(delay, bias))
    check_env_specs(env)
    assert delay.robot.dt == bias.robot.dt == 0.05
    assert delay.robot.command_scale.tolist() == [2.0]
    plain = GymEnv("Pendulum-v1")
    env.set_seed(0), plain.set_seed(0)
    shift = env.reset()["observation"] - plain.reset()["observation"]
    torch.testing.assert_close(shift, torch.tensor([0.5, 0.0, 0.0]))


def test_effects_live_in_the_workers_of_a_parallel_environment():
    def make():
        torch.set_num_threads(1)
        effects = ApplyEffect("coulomb_friction", 2.0), ApplyEffect("action_delay", 0.01)
        physics = ApplyPhysics(MujocoPhysics("body_mass[torso]"))
        return TransformedEnv(GymEnv(NAME), Compose(physics, *effects))

    env = ParallelEnv(2, make)
    try:
        env.set_seed(0)
        rollout = env.rollout(4)
        assert rollout["next", "observation"].isfinite().all()
    finally:
        env.close()


def test_errors_say_what_is_wrong():
    with pytest.raises(KeyError, match="an effect of the catalogue"):
        ApplyEffect("fricton", 0.1)
    with pytest.raises(KeyError, match="a target of coulomb_friction"):
        single(ApplyEffect("coulomb_friction", {"knee": 0.1}))
    with pytest.raises(ValueError, match="one strength of action_gain for each"):
        single(ApplyEffect("action_gain", [0.1, 0.2]))
    with pytest.raises(ValueError, match="strengths of action_gain of shape \\(2, 3\\)"):
        batched(ApplyEffect("action_gain", torch.zeros(5, 3)))
    with pytest.raises(ValueError, match="finite strengths of action_gain"):
        single(ApplyEffect("action_gain", float("nan")))
    with pytest.raises(PhysicsError, match="an environment with an MjModel"):
        TransformedEnv(GymEnv("Pendulum-v1"), ApplyEffect("coulomb_friction", 0.1))
    with pytest.raises(PhysicsError, match="an environment with an MjModel"):
        TransformedEnv(GymEnv("Pendulum-v1"), ApplyEffect("stribeck_friction", 0.1))
    with pytest.raises(ValueError, match="something that action_gain can act on"):
        TransformedEnv(GymEnv("CartPole-v1"), ApplyEffect("action_gain", 0.1))
    with pytest.raises(ValueError, match="how long a control step is"):
        TransformedEnv(GymEnv("MountainCarContinuous-v0"), ApplyEffect("action_gain", 0.1))
    with pytest.raises(ValueError, match="an environment or a robot for action_gain"):
        _ = ApplyEffect("action_gain", 0.1).targets
    gain = ApplyEffect("action_gain", 0.1)
    single(gain)
    with pytest.raises(ValueError, match="finite strengths"):
        gain.strength = float("inf")


def test_effects_on_the_simulator_do_not_go_around_batched_environments():
    serial = SerialEnv(2, lambda: GymEnv(NAME))
    with pytest.raises(TypeError, match="coulomb_friction beside each simulator"):
        TransformedEnv(serial, ApplyEffect("coulomb_friction", 0.1))
    with pytest.raises(TypeError, match="robot= for action_gain"):
        TransformedEnv(serial, ApplyEffect("action_gain", 0.1))
    robot = Robot(dt=0.008, actuators=("a", "b", "c"), command_scale=torch.ones(3),
                  joint_of_actuator=(-1, -1, -1))  # fmt: skip
    env = TransformedEnv(serial, ApplyEffect("action_delay", 0.008, robot=robot))
    assert env.rollout(3).batch_size == (2, 3)


@pytest.mark.parametrize("name", ["action_delay", "action_gain", "dead_band"])
def test_effects_on_actions_that_move_a_hand_are_the_same_around_both_simulators(name):
    actions = torch.rand(8, 4, generator=torch.Generator().manual_seed(0)) * 2 - 1
    seen = []
    for make in (lambda: BatchedMujocoEnv("FetchReach-v4", 1, threads=1),
                 lambda: GymEnv("FetchReach-v4")):  # fmt: skip
        transform = ApplyEffect(name, 0.06 if name == "action_delay" else 0.2)
        env = TransformedEnv(make(), transform)
        assert transform.robot.actuators == ("action0", "action1", "action2", "action3")
        env.reset()
        batch = env.batch_size
        for action in actions:
            after = env.step(TensorDict({"action": action.expand(*batch, 4).clone()}, batch))
        seen.append(after["next", "observation"].flatten().double())
    torch.testing.assert_close(*seen, atol=1e-6, rtol=0.0)


def test_an_environment_stepped_in_another_way_has_no_place_for_forces():
    class Bare(GymEnv):
        pass

    env = Bare(NAME)
    inner = env._env.unwrapped
    hidden = type("Hidden", (), {"model": inner.model, "data": inner.data, "frame_skip": 4})()
    env.__dict__["_env"] = hidden
    with pytest.raises(PhysicsError, match="stepped by MuJoCo"):
        TransformedEnv(env, ApplyEffect("constant_force", 0.1))


def test_attribute_physics_and_action_effects_go_together():
    chain = Compose(ApplyPhysics(AttributePhysics("m")), ApplyEffect(effect("action_lag"), 0.1))
    env = TransformedEnv(GymEnv("Pendulum-v1"), chain)
    assert env.rollout(3)["theta"].shape == (3, 1)
    assert "action_lag" in repr(env.transform)


SERVO = """
<mujoco><option timestep="0.002" gravity="0 0 0"/>
  <worldbody><body><joint name="hinge" axis="0 1 0" damping="1"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".03" mass="0.1"/></body></worldbody>
  <actuator><position name="servo" joint="hinge" kp="5" ctrlrange="-1 1" ctrllimited="true"/>
  </actuator></mujoco>
"""


@pytest.mark.parametrize(("target", "rest"), [(0.04, 0.0), (0.3, 0.25), (-0.3, -0.25)])
def test_a_servo_rests_at_the_edge_of_its_dead_band(target, rest):
    task = Task(
        model=mujoco.MjModel.from_xml_string(SERVO),
        frame_skip=10,
        observation=lambda now: now.qpos,
    )
    env = TransformedEnv(BatchedMujocoEnv(task, 1, threads=1), ApplyEffect("dead_band", 0.05))
    env.reset()
    seen = run(env, torch.full((300, 1), target))
    assert env.transform.effect.channel == "actuation"
    assert seen[0, -1].item() == pytest.approx(rest, abs=1e-3)


def test_the_dead_band_of_a_motor_is_around_no_command():
    band = ApplyEffect("dead_band", 0.05)
    TransformedEnv(GymEnv(NAME), band)
    assert isinstance(band.effect, ActionEffect)


def test_motors_of_a_task_that_scales_its_actions_stay_motors():
    one = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint name='x' type='slide'/><geom size='.1'/></body>"
        "</worldbody><actuator><motor name='m' joint='x' ctrlrange='-2 2'/></actuator></mujoco>"
    )
    bounds = -np.ones(1), np.ones(1)
    task = Task(model=one, frame_skip=1, command=lambda action: 2 * action, bounds=bounds)
    limit = ApplyEffect("torque_speed_limit", 0.5)
    TransformedEnv(BatchedMujocoEnv(task, 1, threads=1), limit)
    assert limit.targets == ("m",)
