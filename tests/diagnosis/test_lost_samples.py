"""Samples that were lost are interpolated, and what they hid is found beside them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrl_bayessim.diagnosis.lost_samples import _interpolated
from torchrl_bayessim.logs.log import Log
from torchrl_bayessim.logs.velocity import Windows, velocity


def wave(*, estimated):
    """A log of a smooth motion whose every tenth angle is the last one."""
    time = 0.01 * np.arange(200)
    angle, speed = np.sin(5 * time), 5 * np.cos(5 * time)
    lost = np.zeros(200, dtype=bool)
    lost[5::10] = True
    shown = np.where(lost, np.r_[angle[:1], angle[:-1]], angle)
    if estimated:
        speed = velocity(Windows(time), shown)[0]
    log = Log(
        name="wave",
        time=torch.from_numpy(time),
        qpos=torch.from_numpy(shown[:, None].copy()),
        qvel=torch.from_numpy(speed[:, None].copy()),
        ctrl=torch.zeros(200, 1, dtype=torch.float64),
        velocity_gain=torch.full((1,), 30.0 if estimated else 0.0, dtype=torch.float64),
        measured=torch.tensor([True, not estimated]),
    )
    return log, angle, lost


@pytest.mark.parametrize("estimated", [False, True])
def test_lost_angles_are_interpolated_and_velocities_estimated_from_them_again(estimated):
    log, angle, lost = wave(estimated=estimated)
    found = _interpolated(log, lost, 0)
    assert np.abs(log.qpos[:, 0].numpy() - angle).max() > 0.04
    assert np.abs(found.qpos[:, 0].numpy() - angle).max() < 1e-3
    assert torch.equal(found.qpos[~lost], log.qpos[~lost])
    inner = slice(20, -20)
    right = 5 * np.cos(5 * log.time.numpy())[inner]
    before, after = (np.abs(x.qvel[inner, 0].numpy() - right).max() for x in (log, found))
    if estimated:
        assert after < 0.2 * before
        assert torch.equal(found.qvel[0], log.qvel[0])  # the window has no rows before
    else:
        assert torch.equal(found.qvel, log.qvel)


def test_lost_velocities_are_interpolated():
    log, _, lost = wave(estimated=False)
    spoilt = log.qvel.clone()
    spoilt[lost] = 9.0
    found = _interpolated(replace(log, qvel=spoilt), lost, 1)
    assert (found.qvel - log.qvel).abs().max() < 0.03
    assert torch.equal(found.qpos, log.qpos)


def test_logs_of_which_nothing_or_nearly_everything_is_lost_stay():
    log, _, lost = wave(estimated=False)
    assert _interpolated(log, np.zeros_like(lost), 0) is log
    assert _interpolated(log, ~np.zeros_like(lost), 0) is log
