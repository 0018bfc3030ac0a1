"""Dead bands of position servos, with the damping within the band or beside it."""

import numpy as np
import pytest
from test_diagnose import ARM, logs, system

from torchrl_bayessim.diagnosis.diagnose import diagnose

KP, KV, BAND = 25.0, 1.0, 0.03
SERVO = ARM.replace(
    '<motor name="motor" joint="hinge" ctrlrange="-4 4"/>',
    f'<position name="servo" joint="hinge" kp="{KP}" kv="{KV}"/>',
)


def banded(*, damped, held):
    """Return the commands, and what a band takes from a servo: at all times or per command."""
    now = {}

    def act(u, k):
        now.update(target=0.4 * u[k], lost=None)
        u[k] = now["target"]
        return u[k]

    def push(q, v):
        if now["lost"] is None or not held:
            error = now["target"] - q - damped * KV / KP * v
            now["lost"] = np.clip(error, -BAND, BAND)
        return -KP * now["lost"]

    return {"act": act, "push": push, "xml": SERVO}


@pytest.mark.parametrize(
    ("damped", "held"),
    [
        pytest.param(True, True, marks=pytest.mark.slow),
        (True, False),
        (False, True),
        pytest.param(False, False, marks=pytest.mark.slow),
    ],
)
def test_the_dead_band_of_a_servo_is_told_from_friction(damped, held):
    report = diagnose(
        system(SERVO),
        None,
        logs(**banded(damped=damped, held=held)),
        effects=["dead_band", "coulomb_friction", "stribeck_friction", "action_gain"],
    )
    assert report.confusion_set == ("dead_band",)
    (found,) = report.effects
    assert found.form == {"damped": damped}
    # held and with damping it is a band that acts late, of which half is found
    assert found.strength == pytest.approx(BAND, rel=0.6 if held and damped else 0.1)
    assert report.gap.explained_fraction > 0.8


def test_a_softer_servo_is_told_from_friction_and_mass():
    """Its damping is what it was: if that were less too, it were all the rest that is heavier."""
    softer = SERVO.replace(f'kp="{KP}"', f'kp="{0.8 * KP}"')

    def act(u, k):
        u[k] *= 0.4
        return u[k]

    some = ["action_gain", "viscous_friction", "payload", "armature"]
    report = diagnose(system(SERVO), None, logs(act=act, xml=softer), effects=some)
    (found,) = report.effects
    assert found.name == "action_gain"
    assert found.form == {"servo": True, "damped": False}
    assert found.strength == pytest.approx(-0.2, abs=0.02)
