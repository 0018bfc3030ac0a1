"""Whether whole runs show a gap that short segments do not: small forces add up."""

from __future__ import annotations

__all__ = ["whole_run_alarm"]

from .modes import MODES, Mode
from .objective import Point
from .preparation import Prepared
from .refit import refit

_MOST = 12  # windows
_GAP = 3.0  # mean squared innovation: what parameters that are a little off do not leave


def whole_run_alarm(prepared: Prepared, point: Point) -> list[str]:
    """Return an alarm if no parameters explain whole test runs, or windows as long as chaos allows.

    Args:
        prepared: Split, noise, horizon.
        point: The simulator with fitted parameters, from which they are fitted to these runs.
    """
    if prepared.mode.name != Mode.name:
        return []
    predictor, logs, noise = prepared.predictor, prepared.logs, prepared.noise
    history, whole = prepared.sets["test"].segments.history, MODES["trajectories"]()
    steps = whole.horizon(predictor, logs, units=(), noise=noise, history=history)
    if steps <= prepared.horizon:
        return []
    windows = whole.cut(logs["test"], steps, history=history, most=_MOST)
    prior = predictor.system.prior
    objective = whole.objective(predictor, prior, windows, z=point.z, noise=noise)
    left = refit(objective, [point], iterations=4)[0].mean_square
    if not left > _GAP:
        return []
    return [
        f"over {steps} control steps no parameters explain the test runs: {left:.2g} times the "
        f"noise floor is left, though {prepared.horizon} steps show no gap. Diagnose with "
        f"horizon={steps}, or with mode='{whole.name}'"
    ]
