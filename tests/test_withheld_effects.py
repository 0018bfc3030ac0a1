"""The blind check: its generator is a path of its own, its causes do what they say, it runs."""

import ast
import hashlib
import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

RECIPES = Path(__file__).parent.parent / "recipes"
GENERATOR = {
    *("robots", "plant", "laws", "classes", "excitation", "detectability", "cases", "plans"),
    *(
        "causes_actuation",
        "causes_body",
        "causes_foreign",
        "causes_sensing",
        *("causes_chance", "plant_bullet"),
        *("coordinates", "fetch_push", "plant_fetch", "pushing"),
        "folders",
        "renaming",
    ),
}


@pytest.fixture(autouse=True)
def recipes_on_path(monkeypatch):
    monkeypatch.syspath_prepend(RECIPES)


@pytest.fixture
def at_rest(recipes_on_path, monkeypatch):
    """Cases without motions: what is drawn before them is all that is asked for."""
    from withheld import cases

    monkeypatch.setattr(cases, "_motions", lambda *_, **__: [])
    monkeypatch.setattr(cases, "detectability", lambda *_, **__: 1.0)


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from ((0, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.level, node.module or ""


def test_the_generator_imports_nothing_of_the_package():
    for name in GENERATOR:
        for level, module in imported(RECIPES / "withheld" / f"{name}.py"):
            if level:
                assert level == 1
                assert module in GENERATOR, f"{name} imports {module}"
            else:
                assert module.split(".")[0] in {
                    *("__future__", "collections", "copy", "dataclasses", "hashlib", "io", "math"),
                    *("functools", "gymnasium_robotics"),
                    *(
                        "pathlib",
                        "re",
                        "tempfile",
                        "typing",
                        "gymnasium",
                        "mujoco",
                        "numpy",
                        "yaml",
                    ),
                    "pybullet_utils",
                }, f"{name} imports {module}"


def test_the_generator_runs_without_the_package():
    code = (
        "import sys; from withheld import folders, plans\n"
        "assert not [m for m in sys.modules if m.split('.')[0] in ('torch', 'torchrl_bayessim')]"
    )
    environment = os.environ | {"PYTHONPATH": str(RECIPES), "PYTHONWARNINGS": "ignore"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)


def site(form="same", **changes):
    from withheld.laws import Site
    from withheld.robots import ROBOTS, nominal_model

    model = nominal_model(ROBOTS["arm"])
    values = {
        "model": model, "actuator": 0, "dof": 0, "joint": "hinge", "limit": 4.0, "torque": 4.0,
        "control_dt": 0.02, "form": form, "rng": np.random.default_rng(0),
    }  # fmt: skip
    return Site(**(values | changes))


def plant(*causes, timestep=0.000625, still=False):
    from withheld.plant import Plant
    from withheld.robots import ROBOTS, nominal_model

    model = nominal_model(ROBOTS["arm"])
    model.opt.timestep = timestep
    if still:  # a free rotor: no gravity, no damping
        model.opt.gravity[:], model.dof_damping[:] = 0.0, 0.0
    return Plant(model, 0.02, causes, np.zeros(2), np.random.default_rng(0))


def inertia():
    model = plant().model
    data, full = mujoco.MjData(model), np.zeros((1, 1))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    return full[0, 0]


def run(*causes, commands, v=0.0, q=0.0, **options):
    robot = plant(*causes, **options)
    values = np.broadcast_to(commands, 50)
    return robot.run(np.array([q]), np.array([v]), lambda k, _: values[k : k + 1], steps=50)


def test_without_causes_it_is_the_nominal_simulator():
    wave = np.sin(np.arange(50) / 4)
    fine, coarse = run(commands=wave), run(commands=wave, timestep=0.0025)
    assert np.abs(fine.clean - coarse.clean).max() < 1e-5
    np.testing.assert_array_equal(fine.ctrl[:, 0], wave)


def test_constant_torque_accelerates_as_newton_says():
    motion = run(commands=0.1, still=True)
    t = 0.02 * np.arange(50)
    np.testing.assert_allclose(motion.clean[:, 1], 0.1 / inertia() * t, rtol=1e-6)


def test_coulomb_friction_stops_a_rotor_after_its_time():
    from withheld.causes_body import coulomb

    for form in ("same", "other"):
        cause, truth = coulomb(site(form))
        strength = coulomb(site())[1].strength["N m"]
        motion = run(cause, commands=0.0, v=0.7 * strength / inertia(), still=True)
        after = int(0.7 / 0.02)
        drop = motion.clean[0, 1] - motion.clean[after // 2, 1]
        assert drop == pytest.approx(strength / inertia() * 0.02 * (after // 2), rel=0.05)
        assert abs(motion.clean[-1, 1]) < 0.02 * motion.clean[0, 1]
        assert truth.name == "coulomb_friction"


def test_bristles_hold_a_load_below_the_level_and_let_go_above():
    from withheld.causes_body import coulomb

    strength = coulomb(site())[1].strength["N m"]
    held = run(coulomb(site("other"))[0], commands=0.5 * strength, still=True)
    moved = run(coulomb(site("other"))[0], commands=2.0 * strength, still=True)
    assert abs(held.clean[-1, 0]) < 0.01
    assert moved.clean[-1, 0] > 0.1


@pytest.mark.parametrize("form", ["same", "other"])
def test_delay_moves_a_step_by_its_time(form):
    from withheld.causes_actuation import delay

    cause, truth = delay(site(form))
    seconds = delay(site())[1].strength["s"]
    step = np.where(np.arange(50) < 10, 0.0, 1.0)
    late, prompt = run(cause, commands=step, still=True), run(commands=step, still=True)
    # a constant torque that begins later by s lacks the momentum of that time
    lost = (prompt.clean[-1, 1] - late.clean[-1, 1]) * inertia()
    assert lost == pytest.approx(seconds, rel=0.01 if form == "same" else 0.3)
    assert truth.joint == "all"


def test_viscous_friction_decays_exponentially():
    from withheld.causes_body import viscous

    cause, truth = viscous(site())
    rate = truth.strength["N m s/rad"] / inertia()
    motion = run(cause, commands=0.0, v=1.0, still=True)
    np.testing.assert_allclose(motion.clean[:, 1], np.exp(-rate * 0.02 * np.arange(50)), rtol=1e-2)


def test_saturation_dead_band_gain_and_bias_are_what_the_label_says():
    from withheld import causes_actuation as actuation

    def arrives(made, u):
        return made[0].command(np.array([u]), plant())[0]

    cut = actuation.saturation(site())
    assert arrives(cut, 4.0) == pytest.approx(4.0 * (1 - cut[1].strength["fraction"]))
    band = actuation.dead_band(site())
    width = band[1].strength["command"]
    assert arrives(band, width / 2) == 0.0
    assert arrives(band, -1 - width) == pytest.approx(-1.0)
    louder = actuation.gain(site())
    assert arrives(louder, 2.0) == pytest.approx(2.0 * (1 + louder[1].strength["fraction"]))
    pushed = actuation.bias(site())
    assert arrives(pushed, 2.0) == pytest.approx(2.0 + pushed[1].strength["command"])


def test_a_rotor_behind_a_spring_reaches_the_same_momentum():
    from withheld.causes_actuation import series_elasticity

    # the rotor's inertia is the armature, so the sum is the nominal inertia
    motion = run(series_elasticity(site("other"))[0], commands=0.1, still=True)
    assert motion.clean[-1, 1] == pytest.approx(0.1 * 0.98 / inertia(), rel=0.1)


def test_backlash_leaves_play_and_nothing_else():
    from withheld.causes_actuation import backlash

    motion = run(backlash(site("other"))[0], commands=0.1, still=True)
    stiff = run(commands=0.1, still=True)
    lag = stiff.clean[-1, 0] - motion.clean[-1, 0]
    assert 0.0 < lag < 0.2 * stiff.clean[-1, 0]


def test_tilt_turns_the_rest_position_by_its_angle():
    from withheld.causes_body import tilt

    cause, truth = tilt(site())
    robot = plant(cause)
    steps = 600
    motion = robot.run(np.zeros(1), np.zeros(1), lambda *_: np.zeros(1), steps=steps)
    assert abs(motion.clean[-1, 0]) == pytest.approx(abs(truth.strength["rad"]), rel=1e-3)


def test_sensors_say_what_the_label_says():
    from withheld import causes_sensing as sensing

    for make, expected in (
        (sensing.bias, lambda s, q, v, t: (q + s["rad"], v)),
        (sensing.gain, lambda s, q, v, t: (q, v * (1 + s["fraction"]))),
        (sensing.drift, lambda s, q, v, t: (q + s["rad/s"] * t, v)),
    ):
        cause, truth = make(site())
        seen, true = run(cause, commands=1.0), run(commands=1.0)
        q, v = true.clean.T
        expectation = np.stack(expected(truth.strength, q, v, 0.02 * np.arange(50)), 1)
        np.testing.assert_allclose(seen.clean, expectation, atol=1e-9)


@pytest.mark.parametrize("form", ["same", "other"])
def test_as_much_is_lost_as_the_label_says(form):
    from withheld.causes_chance import packet_drop, sensor_dropout

    wave = 1e-3 * (np.arange(4000.0) % 7 - 3)
    drop, truth = packet_drop(site(form))
    robot = plant(drop, still=True, timestep=0.02)
    share = packet_drop(site())[1].strength["probability"]
    robot.run(np.zeros(1), np.zeros(1), lambda k, _: wave[k : k + 1], steps=4000)
    lost = np.array(robot.acts)[:, 0] > 0  # the wave changes in every step
    assert lost.mean() == pytest.approx(share, rel=0.1)
    again = (lost[1:] & lost[:-1]).mean() / lost.mean()
    assert again == pytest.approx(share if form == "same" else 0.5, abs=0.05)
    assert truth.name == "packet_drop"
    stale, truth = sensor_dropout(site(form))
    share = sensor_dropout(site())[1].strength["probability"]
    seen = plant(stale, still=True, timestep=0.02).run(
        np.zeros(1), np.array([0.5]), lambda *_: np.zeros(1), steps=4000
    )
    assert (np.diff(seen.clean[:, 0]) == 0).mean() == pytest.approx(share, rel=0.1)


def test_jitter_is_late_by_half_its_range_on_average_and_torque_noise_is_white():
    from withheld.causes_chance import action_jitter, torque_noise

    ramp = 0.001 * np.arange(4000.0)
    for form in ("same", "other"):
        cause, _ = action_jitter(site(form))
        seconds = action_jitter(site())[1].strength["s"]
        robot, arrived = plant(cause, still=True, timestep=0.02), []
        for k in range(2000):
            robot.commands.append(ramp[k : k + 1])
            arrived.append(cause.command(ramp[k : k + 1], robot)[0])
        late = 0.02 * (ramp[100:2000] - arrived[100:]) / 0.001
        assert late.mean() == pytest.approx(seconds / 2, rel=0.05)
        assert late.max() == pytest.approx(seconds, rel=0.01)
    cause, truth = torque_noise(site())
    robot, forces = plant(cause, timestep=0.02), []
    for _ in range(2000):
        robot.commands.append(np.zeros(1))
        forces.append(cause.force(robot)[0])
        assert cause.force(robot)[0] == forces[-1]  # until the next control step
    assert abs(np.corrcoef(forces[1:], forces[:-1])[0, 1]) < 0.07
    assert 0.02 * 4 < np.std(forces) < 0.2 * 4 * 1.1
    assert truth.strength == {}


def test_payload_at_the_tip_has_the_inertia_of_a_point():
    from withheld.causes_body import payload

    cause, _ = payload(site("other"))
    share = 0.02 * math.exp(np.random.default_rng(0).uniform() * math.log(30.0))
    before, model = inertia(), plant(cause).model
    data, full = mujoco.MjData(model), np.zeros((1, 1))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, full)
    # at twice the distance of the centre, and half of that to the side
    assert full[0, 0] - before == pytest.approx(share * 1.0 * (0.4**2 + 0.1**2), rel=1e-6)


@pytest.mark.parametrize("form", ["same", "other"])
def test_friction_under_load_is_the_motors_in_the_usual_form_only(form):
    from withheld.causes_body import load_dependent

    cause, truth = load_dependent(site(form))
    held = plant(cause)
    held.data.qfrc_actuator[0], held.data.qfrc_bias[0] = 2.0, -1.5
    held.data.qvel[0] = 1.0
    share = 0.0125 * math.exp(np.random.default_rng(0).uniform() * math.log(0.35 / 0.0125))
    load = 2.0 if form == "same" else 0.5
    assert cause.force(held)[0] == pytest.approx(-share * load, rel=1e-6)
    assert truth.strength == ({"fraction": pytest.approx(share)} if form == "same" else {})


def test_tilted_gravity_has_the_sign_of_the_report():
    from withheld.causes_body import tilt

    cause, truth = tilt(site())
    model, angle = plant().model, truth.strength["rad"]
    model.opt.gravity[:] = 0.0, 0.0, -9.81
    cause.write(model)
    # as the catalogue turns it about y, see test_laws.test_entries
    expected = [-9.81 * math.sin(angle), 0.0, -9.81 * math.cos(angle)]
    np.testing.assert_allclose(model.opt.gravity, expected, atol=1e-9)


def test_every_cause_changes_the_motion_and_is_called_what_it_is():
    from withheld.cases import CAUSES
    from withheld.plans import applicable

    wave = 3.0 * np.sin(np.arange(50) / 3)
    plain = run(commands=wave, v=9.0).clean
    for form in ("same", "other"):
        for name in applicable("arm", form):
            cause, truth = CAUSES[name](site(form))
            assert (truth.name, truth.form) == (name, form)
            assert np.abs(run(cause, commands=wave, v=9.0).clean - plain).max() > 1e-5, (name, form)


def test_the_arm_moves_alike_in_another_engine():
    pytest.importorskip("pybullet_utils")
    from withheld.causes_body import armature, coulomb
    from withheld.plant_bullet import BulletPlant

    wave = 2.0 * np.sin(np.arange(60) / 9)
    start = np.array([0.3]), np.array([0.5]), lambda k, _: wave[k : k + 1]
    for make in (None, coulomb, armature):
        causes = [] if make is None else [make(site())[0]]
        expected = plant(*causes).run(*start, steps=60).clean
        errors = []
        for timestep in (0.000625, 0.00015625):
            model = plant(timestep=timestep).model
            robot = BulletPlant(model, 0.02, causes, np.zeros(2), np.random.default_rng(0))
            errors.append(np.abs(robot.run(*start, steps=60).clean - expected).max(0))
        assert np.abs(expected).max() > 0.3
        assert (errors[0] < [4e-3, 4e-2]).all(), make
        assert (errors[1] < [1e-3, 1e-2]).all(), make  # of first order: a quarter


def test_another_engine_is_asked_for_what_it_can_do(monkeypatch):
    from withheld.cases import make
    from withheld.plans import plans

    drawn = plans({"T6B": 80}, ["arm", "two_links"], np.random.default_rng(0))
    assert len(drawn) == 80
    assert {(plan.robot, plan.engine) for plan in drawn} == {("arm", "bullet")}
    causes = {name for plan in drawn for name in plan.causes}
    assert "load_dependent_friction" not in causes
    assert len(causes) > 20
    for module in ("pybullet_utils", "pybullet_utils.bullet_client"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match="expected PyBullet for tier T6B, got none; try pip"):
        make(drawn[0], np.random.default_rng(0))


def test_what_another_engine_cannot_describe_is_refused():
    from withheld.plant_bullet import urdf
    from withheld.robots import ROBOTS, nominal_model

    with pytest.raises(ValueError, match="expected one hinge about the second axis, got 2 joints"):
        urdf(nominal_model(ROBOTS["two_links"]))


def test_detectability_is_nothing_without_a_cause_and_grows_with_it():
    from withheld.cases import Plan, make

    none = make(Plan("T0", "arm"), np.random.default_rng(3))
    some = make(Plan("T1", "arm", ("coulomb_friction",)), np.random.default_rng(3))
    assert none.detectability < 0.5
    assert some.detectability > 100


@pytest.mark.parametrize(
    ("robot", "least", "most"),
    [("arm", 0.95, 1.01), pytest.param("hopper", 0.0, 0.9, marks=pytest.mark.slow)],
)
def test_where_contacts_amplify_noise_a_cause_is_less_visible_than_derivatives_say(
    robot, least, most, monkeypatch
):
    from withheld import detectability
    from withheld.cases import Plan, make

    plan = Plan("T1", robot, ("com_shift" if robot == "hopper" else "coulomb_friction",))
    seen = make(plan, np.random.default_rng(5)).detectability
    ones = lambda predict, whiten, x, **_: np.ones(len(x))
    monkeypatch.setattr(detectability, "_excess", ones)
    assert least < seen / make(plan, np.random.default_rng(5)).detectability < most


@pytest.mark.slow
def test_a_pair_is_as_visible_as_the_less_visible_of_its_causes(monkeypatch):
    from withheld import cases

    found = []

    def spy(*args, **options):
        found.append((detectability(*args, **options), options["known"] is not None))
        return found[-1][0]

    detectability = cases.detectability
    monkeypatch.setattr(cases, "detectability", spy)
    plan = cases.Plan("T5", "arm", ("coulomb_friction", "sensor_drift"))
    case = cases.make(plan, np.random.default_rng(0))
    assert [beside for _, beside in found] == [False, False, True, True]
    values = [value for value, _ in found]
    assert case.detectability == min(values) < max(values)


def _moved(*names):
    """Return a plant of the two links with causes, those causes, and a motion of it."""
    from withheld import cases
    from withheld.plant import Plant
    from withheld.robots import ROBOTS, nominal_model

    robot, rng = ROBOTS["two_links"], np.random.default_rng(4)
    model = nominal_model(robot)
    causes = [cases._cause(name, "same", model=model, robot=robot, rng=rng)[0] for name in names]
    plant = lambda some: Plant(
        nominal_model(robot), robot.control_dt, some, np.zeros(4), np.random.default_rng(0)
    )
    whole = plant(causes)
    commands = np.random.default_rng(1).normal(size=(60, 2)).cumsum(0) / 10
    motion = whole.run(np.full(2, 0.3), np.zeros(2), lambda k, _: commands[k], steps=60)
    return plant, causes, whole, motion


def test_a_robot_that_follows_its_own_motion_measures_the_same_again():
    # each of these remembers something, which has to go on where the robot is put into a state
    *_, whole, motion = _moved("action_lag", "sensor_lag", "sensor_bias", "backlash")
    states = motion.clean - motion.sensed.sum(1)
    again = whole.follow(states, motion.ctrl, range(6, 40, 20))
    np.testing.assert_allclose(again, motion.clean, rtol=0, atol=1e-12)
    assert motion.sensed[:, [0, 3]].max() == 0  # neither command nor force is measured
    assert all(abs(motion.sensed[:, i]).max() > 0 for i in (1, 2))


def test_a_cause_is_invisible_beside_another_where_it_does_nothing():
    from withheld.detectability import beside, detectability
    from withheld.robots import ROBOTS, nominal_model

    model = nominal_model(ROBOTS["two_links"])
    options = {
        "substeps": round(ROBOTS["two_links"].control_dt / model.opt.timestep),
        "noise": np.array([1e-3, 1e-3, 1e-2, 1e-2]), "measured": np.ones(4, dtype=bool),
        "parameters": [],
    }  # fmt: skip
    plant, causes, _, motion = _moved("coulomb_friction")
    # the other cause is none: all that is missing is known
    alone = detectability(model, [motion], **options)
    known = beside(plant(causes), [motion], 0)
    assert detectability(model, [motion], **options, known=known) < 1e-6 * alone
    # what a spring does no friction can imitate
    plant, causes, _, motion = _moved("coulomb_friction", "parallel_spring")
    known = beside(plant(causes[:1]), [motion], 0)
    assert detectability(model, [motion], **options, known=known) > 100


def test_nobody_knows_what_chance_would_have_done():
    from withheld.detectability import beside

    plant, causes, _, motion = _moved("packet_drop")
    assert beside(plant(causes), [motion], 0) is None


def test_a_sensor_of_velocities_has_velocities_logged_and_a_withheld_case_a_list(at_rest):
    from withheld.cases import Plan, make

    for seed in range(3):
        plan = Plan("T3", "arm", ("sensor_gain",))
        case = make(plan, np.random.default_rng(seed))
        assert case.velocities
        assert "sensor_gain" not in case.effects
        assert "coulomb_friction" in case.effects


def test_of_two_causes_both_act(at_rest):
    from withheld import cases

    def chain(*names):
        case = cases.make(cases.Plan("T5", "arm", names), np.random.default_rng(1))
        return [truth.name for truth in case.truths]

    assert chain("backlash", "action_bias") == ["action_bias", "backlash"]
    assert chain("action_bias", "action_delay") == ["action_delay", "action_bias"]
    from withheld import causes_actuation as actuation

    rotor, pushed = actuation.backlash(site("other"))[0], actuation.bias(site())[0]
    plain, both = run(rotor, commands=0.0), run(pushed, rotor, commands=0.0)
    assert np.abs(plain.clean).max() < 1e-9
    assert np.abs(both.clean[:, 0]).max() > 1e-3


def test_a_label_knows_what_a_joint_its_motor_and_its_body_are_called():
    from withheld.cases import Plan, make
    from withheld.folders import label

    case = make(Plan("T1", "cart_pole", ("dead_band",)), np.random.default_rng(0))
    assert label(case)["truths"][0]["places"] == ["rail", "drive", "cart"]


def test_a_renamed_case_is_the_same_case_and_told_from_another(tmp_path):
    from dataclasses import replace

    from withheld.cases import Plan, make
    from withheld.folders import handed_over
    from withheld.renaming import renamed, same_answer

    from torchrl_bayessim.diagnosis.diagnose import diagnose
    from torchrl_bayessim.logs.read import read_logs
    from torchrl_bayessim.logs.system import System

    case = make(Plan("renamed", "two_links", ("action_bias",)), np.random.default_rng(4))
    short = [replace(m, measured=m.measured[:90], ctrl=m.ctrl[:90]) for m in case.motions[:3]]
    few = replace(case, motions=tuple(short), effects=("action_bias", "coulomb_friction"))
    plain = handed_over(few)
    other, names = renamed(plain, np.random.default_rng(0))
    assert not any(name in text for text in other.values() for name in names if len(name) > 3)
    reports = []
    for folder, files in (("plain", plain), ("other", other)):
        (tmp_path / folder).mkdir()
        for file, text in files.items():
            (tmp_path / folder / file).write_text(text)
        system = System.load(tmp_path / folder / "system.yaml")
        logs = read_logs(tmp_path / folder, system)
        reports.append(diagnose(system, None, logs).to_dict())
    found, again = reports
    assert [e["name"] for e in found["effects"]] == ["action_bias"]
    assert found["effects"][0]["where"] != again["effects"][0]["where"]
    assert same_answer(found, again, names)
    elsewhere = {name: name[::-1] for name in names}
    assert not same_answer(found, again, elsewhere)
    assert not same_answer(found, found | {"verdict": "none"}, {})
    weaker = [found["effects"][0] | {"strength": 0.5 * found["effects"][0]["strength"]}]
    assert not same_answer(found, found | {"effects": weaker}, {})


def test_it_is_noted_when_a_cause_acts():
    from withheld.causes_actuation import dead_band, saturation
    from withheld.causes_body import directional, tilt

    wave = 4.0 * np.sin(np.arange(50) / 4)
    cut, truth = saturation(site())
    motion = run(cut, commands=wave, still=True)
    top = 4.0 * (1 - truth.strength["fraction"])
    np.testing.assert_allclose(motion.acts[:, 0], np.maximum(np.abs(wave) - top, 0.0), atol=1e-9)
    both = run(dead_band(site())[0], directional(site())[0], commands=wave, still=True)
    assert both.acts.shape == (50, 2)
    assert (both.acts.max(0) > 0).all()
    assert not run(tilt(site())[0], commands=wave).acts.any()


def test_rules_overlap_with_when_a_cause_acts(tmp_path):
    import torch
    from withheld.regime_overlap import overlap, rows_of_rule, times_of_action

    from torchrl_bayessim.envs.tasks.catalogue import known_task
    from torchrl_bayessim.logs.log import Log
    from torchrl_bayessim.logs.system import System

    rows = rows_of_rule("|v| < 2 & t >= 1", {"|v|": np.r_[1.0, 3, 1, 2], "t": np.r_[0.0, 1, 2, 3]})
    assert rows.tolist() == [False, False, True, False]
    with pytest.raises(ValueError, match="expected a rule"):
        rows_of_rule("w < 2", {"v": np.zeros(2)})
    assert times_of_action([np.array([0.0, 0.1]), np.array([1.0, 0.2])])[0].tolist() == [False] * 2

    system = System(task=known_task("InvertedPendulum-v5"))
    zeros = torch.zeros(101, 2).double()
    time = system.control_dt * torch.arange(101).double()
    log = Log(
        name="run00", time=time, qpos=zeros, qvel=zeros, ctrl=zeros[:, :1],
        velocity_gain=torch.zeros(2).double(), measured=torch.ones(4).bool(),
    )  # fmt: skip
    np.savez(tmp_path / "acts.npz", acts0=(np.arange(101) >= 50.0)[:, None])
    for begins, iou in ((50, 1.0), (75, 0.5), (0, 0.5)):
        # a rule speaks of the row after the step
        rule = f"time >= {system.control_dt * (begins + 0.5):.6g}"
        report = {"where": {"regimes": [{"rule": rule}]}}
        found = overlap(system, [log], tmp_path / "acts.npz", report)
        assert found["iou"] == pytest.approx(iou, abs=0.02)
        assert found["of_no_rule"] == 0.5
    assert overlap(system, [log], tmp_path / "acts.npz", {"where": {"regimes": []}}) is None


def test_p_values_are_tested_for_uniformity():
    from withheld.scoring import uniform

    even = (np.arange(100) + 0.5) / 100
    assert uniform(even.tolist())["statistic"] == pytest.approx(0.005)
    assert uniform((even**3).tolist())["p_value"] < 1e-6
    assert uniform([0.5])["p_value"] is None


def test_wilson_intervals():
    from withheld.scoring import wilson

    assert wilson(0, 0) == (0.0, 1.0)
    low, high = wilson(45, 50)  # Newcombe (1998), by the formula
    assert (low, high) == (pytest.approx(0.7864, abs=1e-4), pytest.approx(0.9565, abs=1e-4))
    assert wilson(0, 300)[1] == pytest.approx(0.0126, abs=1e-4)


def _label(tier: str, robot: str, truth: dict) -> dict:
    return {
        "tier": tier, "robot": robot, "form": "same", "engine": "fine", "detectability": 500.0,
        "excitation": "open", "velocities": True, "runs": 8, "noise_told": True, "truths": [truth],
    }  # fmt: skip


def _finding(name: str, where: str, strength: float) -> dict:
    return {
        "name": name, "where": where, "strength": strength, "unit": "N m",
        "ci95": [0.1, 0.3], "strengths": {where: strength},
    }  # fmt: skip


def test_a_wrong_name_counts_only_where_the_verdict_stands_by_it():
    from withheld.scoring import record, scores

    truth = {
        "name": "coulomb_friction", "joint": "hinge", "channel": "body",
        "strength": {"N m": 0.2}, "places": ["hinge", "motor"],
    }  # fmt: skip
    label = _label("T3", "arm", truth)
    found = _finding("viscous_friction", "hinge", 0.25)
    report = {
        "effects": [found], "confusion_set": ["viscous_friction"], "seconds": 1.0,
        "gap": {"explained_fraction": 0.9, "ci95": [0.8, 0.95]},
    }  # fmt: skip
    wrong = record(label, report | {"verdict": "named"}, 0.7)
    unsure = record(label, report | {"verdict": "unknown"}, 0.7)
    result = scores([wrong, unsure], threshold=100.0)
    assert result["tiers"]["T3"]["wrong_named"]["value"] == 0.5
    assert result["shrinkage"]["mae"] == pytest.approx(0.2)
    assert result["shrinkage"]["ci_cover"]["value"] == 0.0
    assert wrong["top1_class"]
    assert not wrong["top1"]
    assert wrong["joint"]
    assert not unsure["top1_class"]
    right = found | {"name": "coulomb_friction"}
    one = record(label | {"tier": "T1"}, report | {"verdict": "named", "effects": [right]})
    assert one["top1"]
    assert one["strength_error"] == pytest.approx(0.25)
    assert one["strength_covered"]


def test_who_names_nothing_has_found_no_place_and_reserve_is_told():
    from withheld.scoring import record, scores

    truth = {
        "name": "coulomb_friction", "joint": "elbow", "channel": "body", "strength": {},
        "places": ["elbow"],
    }  # fmt: skip
    label = _label("T1", "two_links", truth)
    effect = _finding("coulomb_friction", "elbow", 0.2)
    report = {
        "effects": [effect], "confusion_set": ["coulomb_friction", "stribeck_friction"],
        "seconds": 1.0, "where": {"channel": {"body": 0.9, "actuation": 0.1}},
        "audit": {"p_values": [0.25, 1.0]}, "candidates": [{"p_value": 1.0}],
    }  # fmt: skip
    found = record(label, report | {"verdict": "ambiguous"})
    lost = record(label, report | {"verdict": "unknown", "confusion_set": []})
    crashed = record(label, {"verdict": "crash", "seconds": 1.0})
    assert (found["channel"], found["joint"]) == (True, True)
    assert found["p_value"] == 0.25
    assert (lost["channel"], lost["joint"]) == (False, False)
    motor = record(
        label | {"truths": [truth | {"channel": "actuation"}]}, report | {"verdict": "ambiguous"}
    )
    assert (motor["channel"], motor["channel_among"], motor["channels"]) == (False, True, 2)
    assert not lost["channel_among"]
    every = [found, lost, crashed]
    result = scores([*every, *(one | {"tier": "T3"} for one in every)], threshold=100.0)
    assert result["where"]["joint"]["value"] == pytest.approx(1 / 3)
    assert result["where"]["joint_of_right_class"]["value"] == 1.0
    assert result["where"]["channel_among_reported"]["n"] == 3
    assert result["where"]["channel_where_one_is_reported"]["n"] == 0
    t1, t3 = result["tiers"]["T1"], result["tiers"]["T3"]
    assert t1["right_as_ambiguous"]["value"] == pytest.approx(1 / 3)
    assert t1["set_size"] == 2.0
    assert t1["no_set"]["value"] == pytest.approx(2 / 3)
    assert t3["wrong_named"]["value"] == pytest.approx(1 / 3)  # the crash
    assert t3["wrong_with_any_reserve"]["value"] == pytest.approx(2 / 3)


def test_no_name_is_in_two_classes_and_the_true_one_is_withheld():
    from withheld.classes import NAMES, class_of, without_class_of

    assert len(set(NAMES)) == len(NAMES) == 39
    for name in NAMES:
        left = without_class_of(name)
        assert name not in left
        assert class_of(name) not in {class_of(other) for other in left}


def test_bad_settings_are_explained(tmp_path, monkeypatch, capsys):
    import recipe
    import withheld_effects

    monkeypatch.chdir(tmp_path)
    for argument, said in (
        ("robots=arms", "got 'arms'. Available: arm (did you mean this?)"),
        ("tiers=T0", "expected tiers such as T0=4,T2=10, got 'T0'"),
        ("tiers=T9=1", "expected a tier, got 'T9'"),
    ):
        monkeypatch.setattr(sys, "argv", ["withheld_effects.py", argument])
        with pytest.raises(SystemExit, match="2"):
            recipe.main(withheld_effects.Withheld, withheld_effects.job)
        assert said in capsys.readouterr().err


def test_a_run_says_what_the_methods_were_set_on_and_what_it_scores():
    from withheld.frozen import lists, told

    blind = lists(1, ["arm"], {"T0": 3, "T4": 1})
    assert blind["blind"]
    assert "soft_stop" in blind["scored"]["causes"]
    assert not set(blind["scored"]["causes"]) & set(blind["set_on"]["causes"])
    assert lists(1, ["arm"], {"T0": 3})["scored"]["causes"] == []
    assert "dead_band" in lists(1, ["arm"], {"T5": 1})["scored"]["causes"]
    known = lists(2214, ["arm"], {"T1": 1})
    assert not known["blind"]
    assert told(known).startswith("methods were set on: seeds 2211, 2213")
    assert told(blind).splitlines()[1].startswith("scored: seeds 1; robots arm; causes ")
    assert told(blind).endswith("no case of this seed was seen before")
    assert told(known).endswith("its figures are not those of a blind run")
    for folder in (RECIPES / "results" / "withheld_effects").glob("seed_*"):
        assert not lists(int(folder.name.removeprefix("seed_")), ["arm"], {"T0": 1})["blind"]


SHORT = ["robots=arm", "tiers=T0=1,T1=1", "progress=false", "seed=5", "oracle=false"]


def test_it_seals_diagnoses_and_scores_and_does_so_again(
    tmp_path, same_numbers, monkeypatch, capsys
):
    command = [sys.executable, str(RECIPES / "withheld_effects.py"), *SHORT, "out=run"]
    environment = os.environ | {"PYTHONWARNINGS": "ignore"}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    import recipe
    import withheld_effects
    from withheld import frozen

    again = tmp_path / "again"
    kept = json.loads((tmp_path / "run/sealed/labels.json").read_text())
    (kept,) = (name for name, label in kept.items() if label["tier"] == "T1")
    (again / "reports").mkdir(parents=True)  # all is done again but one diagnosis, to save its time
    shutil.copy(tmp_path / f"run/reports/{kept}.json", again / "reports")
    monkeypatch.setattr(sys, "argv", ["withheld_effects.py", *SHORT, f"out={again}"])
    recipe.main(withheld_effects.Withheld, withheld_effects.job)
    same_numbers(again, tmp_path / "run")
    assert capsys.readouterr().out.splitlines()[0] == done.stdout.splitlines()[0]
    first, *_, last = done.stdout.splitlines()
    sealed = tmp_path / "run" / "sealed" / "labels.json"
    digest = hashlib.sha256(sealed.read_bytes()).hexdigest()
    assert first == f"labels sealed: sha256 {digest}"
    result = json.loads(last.removeprefix("RESULT "))
    assert result["labels_sha256"] == digest
    before = done.stdout.splitlines()[1:4]
    assert before == frozen.told(result["frozen"]).splitlines()
    assert all(line in (tmp_path / "run/page.md").read_text() for line in before)
    assert {"tiers", "where", "shrinkage", "seconds_per_case"} <= result.keys()
    assert result["tiers"]["T0"]["n"] == 1
    assert result["crashes"]["value"] == 0.0
    for case in (tmp_path / "run" / "cases").iterdir():
        handed = {path.name for path in case.iterdir()}
        assert handed - {path.name for path in case.glob("run*.csv")} == {
            "system.yaml", "robot.xml"
        }  # fmt: skip
    unseen = next((tmp_path / "run" / "sealed").glob("*/unseen.npz"))
    withheld_effects.check_sealed(sealed, digest)
    unseen.write_bytes(b"another")
    with pytest.raises(ValueError, match=r"expected the motions of .* as they were sealed"):
        withheld_effects.check_sealed(sealed, digest)
    with pytest.raises(ValueError, match="expected labels as they were sealed"):
        withheld_effects.check_sealed(sealed, "0" * 64)
    said = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"page.md", "confusion.png", "calibration.png", "records.json"} <= said
