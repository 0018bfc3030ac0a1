"""Logs that are odd but honest: robots and loggers make such, and a report on them is told so."""

import numpy as np
from case import ROWS
from number_cases import Q, T, U, V, assign, change, every, found
from one_joint_arm import SYSTEM


def jittering(array):
    array[:, T] += np.random.default_rng(0).uniform(0, 0.006, ROWS)


def five_steps(folder):
    (folder / "robot.yaml").write_text(SYSTEM.replace("dt: 0.01", "dt: 0.05"))


def coarse(array):
    array[:, Q] = array[:, Q].round(1)


def bumped(array):
    array[80, Q] += 0.4


CASES = [
    found("a gap", change(lambda a: np.delete(a, slice(60, 80), axis=0)), "run2.csv gap"),
    found("every fifth row", change(lambda a: a[::5]), "run2.csv coarse_time"),
    found("jitter", change(jittering), "run2.csv jitter"),
    found("a control step of five rows", five_steps, "run2.csv fine_time"),
    found("q of few levels", every(coarse), "resolution"),
    # as of an impact within a row
    found("a jump of q", change(bumped), "run2.csv position_jump"),
    found("a spike of qd", change(assign(80, V, 90.0)), "run2.csv velocity_spike"),
    # as of who swings freely, or is moved by hand
    found("tau stands still", every(assign(slice(None), U, 0.0)), "constant_action"),
    found("no tau", change(assign(slice(None), U, 0.0)), "run2.csv no_actions"),
    found("tau stands still in one", change(assign(slice(None), U, 0.25)), "run2.csv no_actions"),
]
