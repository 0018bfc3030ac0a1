"""The baselines of the blind check answer in the report's form, and find what they can find."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from torchrl_bayessim.effects.catalogue import effect
from torchrl_bayessim.envs.task import Task
from torchrl_bayessim.logs.read import read_logs
from torchrl_bayessim.logs.system import System

RECIPES = Path(__file__).parent.parent / "recipes"


@pytest.fixture(autouse=True, scope="module")
def recipes_on_path():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(RECIPES)
        yield


@pytest.fixture(scope="module")
def plain():
    return made()


@pytest.fixture(scope="module")
def rubbing():
    return made("coulomb_friction")


def made(*causes):
    """Return a case of the arm with five short runs."""
    from withheld.cases import Plan, make

    case = make(Plan("T1", "arm", causes), np.random.default_rng(3))
    cut = [replace(m, measured=m.measured[:90], ctrl=m.ctrl[:90]) for m in case.motions[:5]]
    return replace(case, motions=tuple(cut))


def written(case, path, **changes):
    """Write what the diagnosis is given."""
    from withheld.folders import handed_over

    for name, text in handed_over(replace(case, **changes)).items():
        (path / name).write_text(text)
    return path


def runs_of(path):
    from baselines.whole_runs import whole_runs

    system = System.load(path / "system.yaml")
    return whole_runs(system, read_logs(path, system))


def test_verdicts_follow_from_what_is_left():
    from baselines.answers import graded, share_explained

    assert share_explained(5.0, 2.0) == 0.75
    assert share_explained(1.0, 0.5) == 0.0
    assert [graded(*pair) for pair in ((1.01, 1.0), (30, 29), (30, 10), (30, 2))] == [
        "none", "unknown", "named_partial", "named"
    ]  # fmt: skip


def test_sparse_regression_keeps_the_columns_that_made_the_target():
    from baselines.sparse_regression import sparse

    rng = np.random.default_rng(0)
    rows = rng.standard_normal((600, 6))
    rows[:, 5] = rows[:, 0]  # like the first, a parameter's
    target = rows @ np.array([3.0, 0, 2.0, 0, -1.5, 0]) + rng.standard_normal(600)
    kept, weights = sparse(rows[:400], target[:400], (rows[400:], target[400:]), always=1)
    assert kept == [2, 4]
    np.testing.assert_allclose(weights, [3.0, 2.0, -1.5], atol=0.2)


def test_logistic_regression_is_at_its_minimum_and_tells_classes_apart():
    from baselines.classifier import logistic

    rng = np.random.default_rng(0)
    labels = np.repeat([0, 1, 2], 100)
    centres = np.array([[0.0, 3.0], [3.0, -2.0], [-3.0, -2.0]])
    rows = centres[labels] + rng.standard_normal((300, 2))
    weights = logistic(rows, labels, 3)
    said = (np.c_[rows, np.ones(300)] @ weights).argmax(1)
    assert (said == labels).mean() > 0.97
    np.testing.assert_allclose(weights.sum(1), 0.0, atol=1e-3)  # as the ridge has it


def test_identification_without_effects_finds_the_parameters(tmp_path, plain):
    from baselines.parameters_only import fitted_parameters, parameters_only

    runs = runs_of(written(plain, tmp_path))
    found = runs.sets["train"].theta(fitted_parameters(runs))
    np.testing.assert_allclose(found, list(plain.theta.values()), rtol=0.05)
    assert parameters_only(runs)["verdict"] == "none"
    sag = next(unit.effect for unit in runs.units if unit.name == "battery_sag")
    assert sag.seconds == pytest.approx(90 * 0.02)  # as the diagnosis counts it


def test_columns_of_forces_are_what_the_simulator_does(tmp_path, plain):
    from baselines.forces import columns, forces

    runs = runs_of(written(plain, tmp_path, priors={"dof_damping[hinge]": (0.15, 0.6)}))
    steps = forces(runs.system, runs.logs["train"])
    found = columns(runs.system, steps)
    v = steps.v[:, 0]
    np.testing.assert_allclose(found["dof_damping[hinge]", -1][:, 0], -v, atol=1e-9)
    # one kilogram more, with its share of the inertia, about an axis 0.2 m away
    needed = 9.81 * 0.2 * np.sin(steps.q[:, 0]) + (0.014 + 0.2**2) * steps.a[:, 0]
    np.testing.assert_allclose(found["payload", 0][:, 0], -needed, rtol=2e-2, atol=1e-2)


def test_every_baseline_answers_as_the_diagnosis_does_from_the_folder_alone(tmp_path, rubbing):
    from baselines.methods import METHODS, answers
    from withheld.folders import label
    from withheld.scoring import record

    some = ("coulomb_friction", "stribeck_friction", "action_bias", "saturation", "sensor_bias")
    assert rubbing.detectability > 1000
    truth, case = label(rubbing), written(rubbing, tmp_path, effects=some)
    found = answers(case, budget=40_000, seed=0)
    assert set(found) == set(METHODS)
    for name, report in json.loads(json.dumps(found)).items():
        assert report["verdict"] != "crash", (name, report)
        assert report["seconds"] > 0
        assert record(truth, report)["truth"] == ["coulomb_friction"]
    refitted = record(truth, found["whole-run refit"])
    assert refitted["top1"]
    assert refitted["strength_error"] < 0.1
    assert record(truth, found["sparse regression"])["top1_class"]
    assert found["parameters only"]["effects"] == []


def test_baselines_are_told_the_noise_and_try_every_form(tmp_path, plain):
    from baselines.whole_runs import whole_runs

    system = System.load(written(plain, tmp_path) / "system.yaml")
    logs, channels = read_logs(tmp_path, system), system.robot.channels
    told = whole_runs(system, logs, noise=dict.fromkeys(reversed(channels), 0.5))
    assert told.noise.tolist() == [0.5] * len(channels)
    assert not np.any(whole_runs(system, logs).noise == 0.5)
    lags = {unit.effect for unit in told.units if unit.name == "action_lag"}
    assert {effect.held for effect in lags} == {True, False}


def test_two_that_explain_as_much_are_named_with_reserve():
    from baselines.answers import graded

    assert graded(30.0, 2.0, alike=2) == graded(30.0, 10.0, alike=2) == "ambiguous"
    assert graded(30.0, 29.0, alike=2) == "unknown"


def test_nothing_is_named_that_was_withheld(tmp_path, rubbing):
    from baselines.methods import answers

    case = written(rubbing, tmp_path, effects=("action_bias", "action_delay"))
    for report in answers(case, budget=20_000, seed=0).values():
        assert {e["name"] for e in report["effects"]} <= {"action_bias", "action_delay"}


def test_what_goes_wrong_is_the_answer(tmp_path):
    from baselines.methods import METHODS, answers

    found = answers(tmp_path, budget=0, seed=0)
    assert {report["verdict"] for report in found.values()} == {"crash"}
    assert set(found) == set(METHODS)


def test_a_named_effect_is_simulated_as_its_report_has_it(tmp_path, plain):
    from withheld.shrinkage import _named

    system = System.load(written(plain, tmp_path) / "system.yaml")
    logs = read_logs(tmp_path, system)
    found = {"name": "cogging", "where": "hinge", "strengths": {"hinge": 0.1}}
    report = {"effects": [found], "options": {"cogging": {"number": 12, "phase": 0.5}}}
    ((unit, strength),) = _named(system, report, logs).items()
    assert unit.effect == effect("cogging", number=12, phase=0.5)
    assert strength == 0.1
    lost = {"name": "packet_drop", "where": "motor", "strengths": {"motor": 0.1}}
    assert _named(system, {"effects": [lost]}, logs) == {}


def test_two_forms_of_an_effect_are_simulated_at_their_own_places():
    from withheld.robots import ROBOTS, nominal_model
    from withheld.shrinkage import _named

    system = System(task=Task(model=nominal_model(ROBOTS["cart_pole"]), frame_skip=8))
    found = {"name": "payload", "where": "all", "strengths": {"cart": 0.2, "pole": 0.1}}
    report = {"effects": [found], "options": {"payload": {"at_end": True}}}
    forms = {unit.where: unit.effect.at_end for unit in _named(system, report, [range(100)])}
    assert forms == {"cart": False, "pole": True}


def test_one_who_knows_all_strengths_names_the_cause(tmp_path, rubbing):
    from withheld.folders import label
    from withheld.oracle import named_by_oracle

    system = System.load(written(rubbing, tmp_path) / "system.yaml")
    said = named_by_oracle(system, read_logs(tmp_path, system), label(rubbing))
    assert said == "coulomb_friction"


def test_methods_are_compared_by_the_same_scores():
    from withheld.comparison import compared, comparison_table

    def case(said, **changes):
        return {
            "tier": "T1", "robot": "arm", "detectability": 500.0, "truth": ["payload"],
            "verdict": "named" if said else "none", "top1": said, "top1_class": said,
            "covered": said, "covered_class": said, "set_size": 1, "seconds": 2.0,
            "p_value": None, "removed": 0.5 if said else 0.1,
        } | changes  # fmt: skip

    none = {"tier": "T0", "truth": [], "detectability": 0.0}
    found = compared(
        {
            "diagnosis": [case(True), case(True), case(False, **none)],
            "other": [case(True), case(False), case(True, **none)],
        },
        threshold=100.0,
    )
    assert found["diagnosis"]["T1"]["value"] == 1.0
    assert found["other"]["T1"]["value"] == 0.5
    assert found["other"]["T0"]["value"] == 1.0
    assert found["other"]["gap_removed"]["median"] == pytest.approx(0.3)
    table = comparison_table(found).splitlines()
    assert table[0] == "| | score | diagnosis | other |"
    assert table[2].startswith("| T0 | false_alarm | 0.00 (0.00 to 0.79), n=1 | 1.00 ")
