"""Logs of numbers that cannot be, or that are in other units: in one log, or in all."""

import numpy as np
from case import ROWS, RUNS, Case, rows
from one_joint_arm import save

T, Q, V, U = range(4)
NAMES = ("t", "q", "qd", "tau")


def change(edit, *, runs=(2,)):
    """Return what edits the runs' arrays, shape ``(rows, 4)``."""

    def spoil(folder):
        for run in runs:
            array = np.array(rows(run))
            edited = edit(array)
            save(folder / f"logs/run{run}.csv", (array if edited is None else edited).tolist())

    return spoil


def every(edit):
    return change(edit, runs=range(RUNS))


def assign(part, columns, value):
    """Return an edit that sets rows of columns."""

    def edit(array):
        array[part, columns] = value

    return edit


def scale(columns, factor):
    def edit(array):
        array[:, columns] *= factor

    return edit


def found(name, spoil, *kinds):
    return Case(name=name, spoil=spoil, found=kinds)


def refused(name, spoil, said):
    return Case(name=name, spoil=spoil, said=said)


def bursts():
    """Put values that are no measurements into one log."""
    for value in np.nan, np.inf, -np.inf, 1e300, -1e300, 1e39, 1e9:
        for column in Q, V, U:
            name = f"a burst of {value:g} in {NAMES[column]}"
            yield found(name, change(assign(slice(40, 45), column, value)), "run2.csv missing")
    for value in np.nan, np.inf, 1e300:
        name = f"all of {value:g}"
        yield refused(name, every(assign(slice(None), slice(1, None), value)), "logs that can be")
        name = f"one log of {value:g}"
        yield found(name, change(assign(slice(None), slice(1, None), value)), "run2.csv short")
    burst = assign(slice(20, 140), slice(1, None), np.nan)
    yield found("a long burst", change(burst), "run2.csv missing")
    sparse = assign(slice(None, None, 2), Q, np.nan)
    yield found("every other sample lost", change(sparse), "run2.csv missing")
    spike = assign(slice(80, 81), Q, 30.0)
    yield found("a spike of q", change(spike), "run2.csv glitch")


def times():
    """Spoil the times of one log, or of all."""
    backward, repeated = "run2.csv backward_time", "run2.csv repeated_time"
    clock = "run2.csv clock_set"
    edits = {
        "one time backwards": (assign(slice(80, 81), T, 0.305), backward),
        "a time before the start": (assign(slice(80, 81), T, -5.0), backward),
        "the clock set back": (lambda a: np.r_[a[:80], a[80:] - [0.505, 0, 0, 0]], backward),
        "rows in reverse": (lambda a: a[::-1], backward),
        "rows shuffled": (lambda a: np.random.default_rng(0).permutation(a), backward),
        "two logs in one": (lambda a: np.r_[a, a], repeated),
        "a time twice": (assign(slice(80, 81), T, 0.79), repeated),
        "each row twice": (lambda a: a.repeat(2, axis=0), repeated),
        "time stands still": (assign(slice(None), T, 0.0), repeated),
        "no time": (assign(slice(None), T, np.nan), "run2.csv not_finite_time"),
        "infinite times": (assign(slice(50, 60), T, np.inf), "run2.csv not_finite_time"),
        "a time of NaN": (assign(slice(50, 51), T, np.nan), "run2.csv not_finite_time"),
        "many gaps": (lambda a: a[(np.arange(ROWS) % 20) < 15], "run2.csv short"),
        "a huge time": (assign(slice(ROWS - 1, None), T, 1e300), "run2.csv not_finite_time"),
        "a huge time within": (assign(slice(80, 81), T, 1e300), "run2.csv not_finite_time"),
        "a time as of an epoch": (assign(slice(90, None), T, 1.7e9), "run2.csv repeated_time"),
        "a clock set on": (lambda a: a + np.outer(a[:, T] > 0.8, [1e6, 0, 0, 0]), clock),
    }  # fmt: skip
    for name, (edit, kind) in edits.items():
        yield found(name, change(edit), kind)
        if kind.endswith(("backward_time", "repeated_time", "finite_time")) and name in {
            *("rows in reverse", "time stands still", "no time"),
        }:
            yield refused(f"{name} in all", every(edit), "logs that can be used")
    yield refused("rows a day apart", every(scale(T, 8.64e6)), "logs that can be used")
    for unit, factor in ("ms", 1e3), ("us", 1e6), ("ns", 1e9):
        yield found(f"one log in {unit}", change(scale(T, factor)), "run2.csv time_unit")
        yield refused(f"all logs in {unit}", every(scale(T, factor)), "seconds?")


def units():
    """Log in other units or signs."""
    degree = 180 / np.pi
    both = {
        "q in degrees": (scale(Q, degree), "positions are in degrees"),
        "qd in degrees": (scale(V, degree), "velocities are in degrees"),
        "qd in rpm": (scale(V, 30 / np.pi), "revolutions per minute"),
        "qd in turns": (scale(V, 0.5 / np.pi), "velocities are in revolutions"),
        "qd of opposite sign": (scale(V, -1), "opposite sign"),
        "q of opposite sign": (scale(Q, -1), "opposite sign"),
        "q in thousandths": (scale(Q, 1e3), "thousandths"),
        "qd in thousandths": (scale(V, 1e3), "thousandths"),
    }
    for name, (edit, said) in both.items():
        kind = "velocity_sign" if "sign" in said else "velocity_scale"
        yield found(f"one log with {name}", change(edit), f"run2.csv {kind}")
        yield refused(f"all logs with {name}", every(edit), said)
    whole = slice(Q, V + 1)
    alone = {
        "q and qd in degrees": (scale(whole, degree), "motion_scale"),
        "q and qd in turns": (scale(whole, 0.5 / np.pi), "motion_scale"),
        "q and qd of opposite sign": (scale(whole, -1), "motion_sign"),
        "tau of opposite sign": (scale(U, -1), "motion_sign"),  # which looks the same
        "tau in N mm": (scale(U, 1e3), "action_scale"),
        "q far away": (lambda a: np.add(a, [0, 1e6, 0, 0]), "offset"),
    }
    for name, (edit, kind) in alone.items():
        yield found(f"one log with {name}", change(edit), f"run2.csv {kind}")
    yield refused("tau of opposite sign", every(scale(U, -1)), "opposite sign")
    yield found("tau in N mm", every(scale(U, 1e3)), "action_scale")
    yield found("tau in kN m", every(scale(U, 1e-3)), "action_scale")
    yield found("all in degrees", every(scale(slice(Q, V + 1), degree)), "effort")


def constants():
    """Log channels that stand still, or one in place of another."""
    kinds = {Q: "frozen", V: "velocity_mismatch"}
    for column, kind in kinds.items():
        name = f"{NAMES[column]} of one log stands still"
        yield found(name, change(assign(slice(None), column, 0.25)), f"run2.csv {kind}")
    frozen = change(lambda a: assign(slice(60, 110), Q, a[60, Q])(a))
    yield found("q freezes for a while", frozen, "run2.csv frozen")
    yield found("q and qd stand still", every(assign(slice(None), slice(1, 3), 0.0)), "no_motion")
    yield refused("q stands still in all", every(assign(slice(None), Q, 0.25)), "frozen")
    swaps = {
        "q and qd swapped": (Q, V),
        "q and tau swapped": (Q, U),
        "qd and tau swapped": (V, U),
        "t and q swapped": (T, Q),
    }
    for name, (a, b) in swaps.items():
        order = [0, 1, 2, 3]
        order[a], order[b] = b, a
        kind = "backward_time" if a == T else "velocity_mismatch"
        yield found(
            f"{name} in one log", change(lambda x, order=order: x[:, order]), f"run2.csv {kind}"
        )
        yield refused(
            f"{name} in all", every(lambda x, order=order: x[:, order]), "logs that can be used"
        )
    copied = lambda folder: save(folder / "logs/run2.csv", rows(1))
    yield found("a copy of a log", copied, "run2.csv copy")


def lengths():
    for count in 1, 2, 4, 9:
        yield found(f"{count} rows in one log", change(lambda a, n=count: a[:n]), "run2.csv short")
        yield refused(f"{count} rows", every(lambda a, n=count: a[:n]), "logs that can be used")
    yield refused("shorter than the horizon", every(lambda a: a[:15]), "21 are needed")


CASES = [*bursts(), *times(), *units(), *constants(), *lengths()]
