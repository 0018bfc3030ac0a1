import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_bayessim.diagnosis.tangent import Tangent

XML = """
<mujoco><worldbody>
  <body><freejoint/><geom size=".1"/></body>
  <body><joint type="ball"/><geom size=".1" pos=".3 0 0"/>
    <body pos=".6 0 0"><joint type="hinge"/><joint type="slide"/><geom size=".1"/></body></body>
</worldbody></mujoco>
"""
MODEL = mujoco.MjModel.from_xml_string(XML)
TANGENT = Tangent(MODEL)


def position(seed):
    qpos = np.random.default_rng(seed).normal(size=MODEL.nq)
    mujoco.mj_normalizeQuat(MODEL, qpos)
    return qpos


@pytest.mark.parametrize("seed", range(5))
def test_difference_is_mujocos(seed):
    a, b, expected = position(seed), position(seed + 100), np.zeros(MODEL.nv)
    mujoco.mj_differentiatePos(MODEL, expected, 1.0, a, b)
    np.testing.assert_allclose(TANGENT.difference(a, b), expected, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_displacement_is_mujocos(seed):
    start, step = position(seed), np.random.default_rng(seed).normal(size=MODEL.nv)
    expected = start.copy()
    mujoco.mj_integratePos(MODEL, expected, step, 1.0)
    np.testing.assert_allclose(TANGENT.displace(start, step), expected, atol=1e-12)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000), st.floats(1e-9, 1.8))
def test_displacement_undoes_difference(seed, size):
    # a ball turns by less than half a turn: 1.8 √3 < π
    step = size * np.random.default_rng(seed).uniform(-1, 1, size=(3, MODEL.nv))
    start = position(seed)
    there = TANGENT.displace(start, step)
    np.testing.assert_allclose(TANGENT.difference(start, there), step, atol=1e-9)


def test_nothing_moves_without_a_step():
    start = position(0)
    np.testing.assert_array_equal(TANGENT.displace(start, np.zeros(MODEL.nv)), start)
