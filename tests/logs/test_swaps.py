"""Columns of actions in another order than the actuators are named as such."""

from dataclasses import replace

import pytest
from test_sanity import FAST, arm, simulated

from torchrl_bayessim.logs.sanity import check, refuse_spoilt
from torchrl_bayessim.logs.system import System

SOME = [("arm", (1, 0), "m1 and m2 swapped"), ("swing", (2, 1, 0), "actuator0 and actuator2 swap")]
CYCLE = ("swing", (1, 2, 0), "actuator0, actuator1 and actuator2 in another order")


def ordered(record, order):
    return replace(record, ctrl=record.ctrl[:, list(order)])


def errors(findings):
    return [finding for finding in findings if finding.severity == "error"]


@pytest.mark.parametrize("noise", [(0.0, 0.0), (1e-3, 1e-2)])
@pytest.mark.parametrize(("name", "order", "said"), [*SOME, CYCLE])
def test_another_order_in_all_logs_is_one_finding(name, order, said, noise):
    system, records = simulated(name, noise=noise)
    (found,) = errors(check([ordered(record, order) for record in records], system))
    assert (found.kind, found.file) == ("action_order", "")
    assert said in found.message
    with pytest.raises(ValueError, match=said):
        refuse_spoilt([found])


@pytest.mark.parametrize(("name", "order", "said"), [*SOME, CYCLE])
def test_another_order_in_one_log_is_named_there(name, order, said):
    system, records = simulated(name)
    records = [*records[:2], ordered(records[2], order), *records[3:]]
    (found,) = errors(check(records, system))
    assert (found.kind, found.file, found.rows) == ("action_order", "2.csv", (0, 299))
    assert said in found.message


@pytest.mark.parametrize("change", ["alike", "weak", "heavy"])
def test_what_another_order_would_not_mend_is_none(change):
    """The same command to all motors, a weak one, or a model of other masses."""
    _, records = simulated("swing")
    system = System(task=arm(FAST))
    model = system.task.model
    if change == "alike":
        records = [replace(r, ctrl=r.ctrl[:, :1] * [1.0, 0.4, 0.06]) for r in records]
    elif change == "weak":
        records = [replace(r, ctrl=r.ctrl * [1.0, 3.0, 1.0]) for r in records]
    else:
        model.body_mass[1:] *= 3.0
        model.body_inertia[1:] *= 3.0
    assert "action_order" not in {finding.kind for finding in check(records, system)}
