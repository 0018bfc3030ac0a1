"""What the diagnosis says of logs of real robots whose cause is documented.

The logs are not part of the project: TORCHRL_BAYESSIM_REALDATA names their folder.
"""

import os
from pathlib import Path

import pytest

from torchrl_bayessim.diagnosis.diagnose import diagnose
from torchrl_bayessim.logs.read import read_records
from torchrl_bayessim.logs.sanity import check, usable_logs
from torchrl_bayessim.logs.system import System

REAL = os.environ.get("TORCHRL_BAYESSIM_REALDATA", "")
SYSTEMS = Path(__file__).parents[2] / "recipes" / "systems"
FRICTION = {
    *("coulomb_friction", "stribeck_friction", "load_dependent_friction", "directional_friction"),
}

pytestmark = pytest.mark.skipif(
    not Path(REAL).is_dir() or not REAL,
    reason="TORCHRL_BAYESSIM_REALDATA does not name the folder of the real logs",
)


def report(name, keep=lambda log: True):
    system = System.load(SYSTEMS / name / "system.yaml")
    records = [r for r in read_records(Path(REAL) / name, system) if keep(r.name)]
    findings = check(records, system, horizon=10)
    return diagnose(system, None, usable_logs(records, system, findings), findings=findings)


def test_dry_friction_is_found_in_the_pendulum_and_mends_runs_that_were_not_fitted():
    found = report("dfki_simple_pendulum", keep=lambda name: "1kg" not in name)
    assert found.verdict in {"named", "named_partial", "ambiguous"}
    assert found.confusion_set[0] in FRICTION
    assert any("ilqr_anomaly.csv" in alarm for alarm in found.alarms)
    errors = found.gap.rollout_rmse
    assert errors["raw"]["q"] > 4 * errors["with_effects"]["q"]
    assert errors["refit"]["q"] > 2 * errors["with_effects"]["q"]


def test_the_pendulum_rubs_without_the_run_that_somebody_pushed():
    found = report("dfki_simple_pendulum", keep=lambda n: "1kg" not in n and "anomaly" not in n)
    assert found.confusion_set[0] in FRICTION
    errors = found.gap.rollout_rmse
    assert errors["raw"]["q"] > 4 * errors["with_effects"]["q"]


def test_a_kilogram_more_is_a_payload_or_as_much_less_torque():
    found = report("dfki_simple_pendulum", keep=lambda name: "1kg" in name)
    assert "payload" in found.confusion_set
    assert found.verdict != "named"


def test_stiction_and_dead_band_of_the_hobby_servo_are_not_told_apart():
    found = report("sage_so101_arm")
    assert found.verdict == "ambiguous"
    assert "dead_band" in found.confusion_set
    assert FRICTION & set(found.confusion_set)
    assert found.next_experiment


def test_dry_friction_explains_the_legs():
    found = report("unitree_go2_legs")
    assert found.effects[0].name in FRICTION
    assert found.confusion_set[0] in FRICTION
    assert found.gap.explained_fraction > 0.5


def test_the_cube_slides_more_easily():
    found = report("contactnets_cube")
    assert found.confusion_set == ("contact_friction",)
    assert found.effects[0].strength == pytest.approx(-0.8, abs=0.1)
