"""Two causes that a third law imitates alone, so that a search begins with neither."""

import pytest
from plain_models import A, C, Unit, plain
from test_diagnose import ARM, logs, system
from test_search import Scripted

from torchrl_bayessim.diagnosis.diagnose import diagnose

SPRING, ROTOR, PAYLOAD = Unit("spring"), Unit("rotor"), Unit("payload")


def test_a_spring_beside_a_heavier_rotor_is_no_payload():
    heavier = ARM.replace('<joint name="hinge"', '<joint name="hinge" armature="0.022"')
    data = logs(8, push=lambda q, v: -0.44 * q, xml=heavier)
    some = (
        "payload", "com_shift", "action_gain", "sensor_gain", "armature", "parallel_spring",
        "time_scale", "cogging", "coulomb_friction",
    )  # fmt: skip
    report = diagnose(system(), None, data, effects=some)
    assert report.verdict == "named"
    found = {effect.name: effect.strength for effect in report.effects}
    assert found == {
        "parallel_spring": pytest.approx(0.44, rel=0.03),
        "armature": pytest.approx(0.022, rel=0.05),
    }


class Begun(Scripted):
    """A search of which it is known what is found beside each effect."""

    def __init__(self, best, beside):
        super().__init__({}, {})
        self.tried = [best, *(plain([unit], 1e5 + i) for i, unit in enumerate(beside))]
        self.varied, self.beside, self.begun = False, beside, []

    def _two(self, one):
        self.begun.append(one.units[0])
        return self.beside[one.units[0]]


@pytest.mark.parametrize(
    ("best", "left", "others"),
    [
        ([PAYLOAD], 900.0, 2),
        ([PAYLOAD], 700.0, 0),  # a law in another form may leave as much
        ([PAYLOAD, C], 700.0, 2),
        ([PAYLOAD, C], 450.0, 0),
        ([], 900.0, 0),
    ],
)
def test_where_more_than_noise_is_left_a_search_goes_on_from_what_explains_less(best, left, others):
    two = plain([SPRING, ROTOR], 410.0)
    before = plain(best, left)
    search = Begun(before, {PAYLOAD: plain([PAYLOAD, A], 405.0), SPRING: None, ROTOR: two})
    assert search.or_two_others(before) is (two if others else before)
    assert search.begun == [SPRING, ROTOR][:others]


def test_nothing_else_is_looked_for_where_what_varies_counts_as_noise():
    before = plain([PAYLOAD], 900.0)
    search = Begun(before, {ROTOR: plain([SPRING, ROTOR], 410.0)})
    search.varied = True
    assert search.or_two_others(before) is before
