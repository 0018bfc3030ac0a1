import multiprocessing

import mujoco
import numpy as np
import pytest

from torchrl_bayessim.envs import native
from torchrl_bayessim.envs.stepper import Stepper
from torchrl_bayessim.envs.tasks.catalogue import known_task
from torchrl_bayessim.errors import SimulationError

BOX = "<body pos='{} {} 1.3'><freejoint/><geom type='box' size='.1 .1 .1'/></body>"

BALL = "<body><freejoint/><geom size='.1'/></body>"


def falling_boxes(memory):
    """Sixteen boxes that land after 0.5 s, when contacts and constraints need room."""
    boxes = "".join(BOX.format(3 * (i % 4), 3 * (i // 4)) for i in range(16))
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><size memory='{memory}'/><worldbody><geom type='plane' size='9 9 1'/>{boxes}"
        "</worldbody></mujoco>"
    )


@pytest.fixture
def empty_folder(tmp_path, monkeypatch):
    """A working directory that must stay empty: MuJoCo likes to write MUJOCO_LOG.TXT there."""
    monkeypatch.chdir(tmp_path)
    yield
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("memory", "match"),
    [
        ("20K", r"not environments \[0, 2\], got 'mj_stackAlloc: out of memory.*Try: raise <size"),
        ("40K", r"room for all contacts and constraints, got 'environments \[0, 2\] without'"),
        ("80K", r"room for all contacts and constraints, got 'environments \[0, 2\] without'"),
    ],
)
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.usefixtures("empty_folder")
def test_a_model_that_runs_out_of_memory_is_an_error(memory, match, threads):
    """The first is fatal to MuJoCo: it would end the process."""
    stepper = Stepper(falling_boxes(memory), 3, threads=threads)
    stepper["qpos"][1, 2::7] = 100.0  # these do not land
    stepper.begin()
    before = stepper.state.copy()
    for _ in range(2):  # the second time in data that a failure has left behind
        stepper.state[1] = before[1]
        with pytest.raises(SimulationError, match=match):
            stepper.rollout(np.zeros((3, 300, 0)), substeps=1)
        np.testing.assert_array_equal(stepper.state[[0, 2]], before[[0, 2]])
        assert stepper["qpos"][1, 2] == pytest.approx(100 - 9.81 * 0.6**2 / 2, abs=0.01)


def test_a_model_without_room_to_start_is_an_error():
    boxes = "".join(BOX.format(0.05 * i, 0) for i in range(12))
    crowded = f"<mujoco><size memory='8K'/><worldbody>{boxes}</worldbody></mujoco>"
    with pytest.raises(SimulationError, match=r"not environments \[0, 1\].*stack overflow"):
        Stepper(mujoco.MjModel.from_xml_string(crowded), 2).begin()


def test_a_fatal_error_in_python_is_still_the_bindings_own():
    """The log handler of the thread is put back after every call."""
    model = falling_boxes("20K")
    stepper = Stepper(model, 1, threads=1)
    stepper.begin()
    stepper.rollout(np.zeros((1, 1, 0)), substeps=1)
    data = mujoco.MjData(model)
    with pytest.raises(mujoco.FatalError, match="stack overflow"):
        mujoco.mj_step(model, data, nstep=300)


def test_bodies_that_sleep_are_refused():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><option><flag sleep='enable'/></option><worldbody/></mujoco>"
    )
    with pytest.raises(ValueError, match=r"bodies never sleep.*Try: model.opt.enableflags"):
        Stepper(model, 1)


@pytest.mark.parametrize("name", ["efc_force", "efc_J", "contact", "ncon", "geom_rbound"])
def test_outputs_without_a_fixed_size_are_refused(name):
    expected = rf"doubles, of a size that the model fixes, got '{name}'. Available: .*qpos"
    with pytest.raises(ValueError, match=expected):
        Stepper(falling_boxes("1M"), 1, outputs=("qpos", name))


def test_a_diverged_open_loop_leaves_the_whole_state_as_it_was():
    """The pose of the weld too, from which the next command starts."""
    task = known_task("FetchReach-v4")
    stepper = Stepper(task.model, 2, drive=task.drive, threads=1)
    for name, value in task.initial.items():
        stepper[name][:] = value
    stepper.begin()
    stepper["xfrc_applied"][0, 6 * task.model.body("robot0:gripper_link").id] = 1e9
    before = stepper.state.copy()
    commands = np.zeros((2, 20, stepper.command_size))
    after = stepper.rollout(commands, substeps=1)
    assert stepper.status.tolist() == [1, 0]
    assert np.isfinite(after[0, 0]).all()  # it went well at first
    np.testing.assert_array_equal(stepper.state[0], before[0])
    assert (stepper["weld_pose"][1] != before[1, -7:]).any()


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"rows": np.array([0, 3])}, r"integers of 3 simulations, got \[0, 3\]"),
        ({"rows": np.array([-1])}, r"integers of 3 simulations, got \[-1\]"),
        ({"sequence": np.array([0, 1, 2])}, r"integers of 2 sequences of commands"),
        ({"sequence": np.array([0, 1])}, r"a sequence for each of 3, got \(2,\)"),
        ({"outputs": np.zeros((3, 5, 14))}, r"outputs of doubles, shape \(3, …\)"),
        ({"outputs": np.zeros((2, 4, 13))}, r"outputs of doubles, shape \(3, …\)"),
    ],
)
def test_compiled_code_is_given_only_what_is_there(change, match):
    xml = f"<mujoco><worldbody>{BALL}</worldbody></mujoco>"
    stepper = Stepper(mujoco.MjModel.from_xml_string(xml), 3)
    given = {"sequence": np.array([0, 1, 0])} | change
    with pytest.raises(ValueError, match=match):
        stepper.rollout(np.zeros((2, 4, 0)), substeps=1, **given)


def test_shared_physics_must_divide_the_simulations():
    with pytest.raises(ValueError, match="sharing to divide the number of simulations, 3, got 2"):
        Stepper(falling_boxes("1M"), 3, sharing=2)


def test_an_output_is_read_once():
    with pytest.raises(ValueError, match="outputs, each once"):
        Stepper(falling_boxes("1M"), 1, outputs=("qpos", "qpos"))


def test_a_forked_process_steps_and_refreshes_with_threads_of_its_own():
    """It inherits none of its parent's, and would wait for them for ever."""
    size = 128  # enough for threads to share a refresh
    xml = f"<mujoco><worldbody>{BALL}</worldbody></mujoco>"
    balls = Stepper(mujoco.MjModel.from_xml_string(xml), size, threads=2)

    def fall():
        balls.state[:] = balls.initial
        balls.models.write("body_mass", (1,), np.linspace(1, 2, size))
        balls.models.refresh()
        balls.begin()
        return balls.rollout(np.zeros((size, 3, 0)), substeps=1)

    expected = fall()

    def child():
        np.testing.assert_array_equal(fall(), expected)

    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    process.join(timeout=60)
    finished = process.exitcode
    process.kill()
    assert finished == 0
    np.testing.assert_array_equal(fall(), expected)  # and the parent goes on


def test_a_fatal_error_without_a_message_is_still_an_error():
    stepper = Stepper(falling_boxes("1M"), 2, threads=1)
    stepper.status[:] = native.FAILED, 0
    with pytest.raises(SimulationError, match=r"environments \[0\], got 'a fatal error without"):
        stepper._raise_failures(np.arange(2))


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"outputs": "qpos"}, TypeError, "outputs= to be a sequence of keys, got 'qpos'"),
        ({"threads": 0}, ValueError, "threads to be a positive integer, got 0"),
    ],
)
def test_settings_that_mean_nothing_are_refused(change, error, match):
    with pytest.raises(error, match=match):
        Stepper(falling_boxes("1M"), 1, **change)
