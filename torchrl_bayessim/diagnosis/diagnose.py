"""Diagnose the sim-to-real gap: where it lies, which effect causes it, how far it shrinks."""

from __future__ import annotations

__all__ = ["diagnose"]

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from ..counts import check_count
from ..effects.catalogue import CATALOGUE, each_once, effect
from ..effects.effect import Effect
from ..effects.sensors import SensorDropout
from ..envs.task import Task
from ..envs.tasks.catalogue import as_task
from ..errors import message
from ..inference.priors import BoxPrior
from ..kinds import check_choice, check_kind
from ..logs.log import Log
from ..logs.sanity import Finding as SanityFinding
from ..logs.system import System
from ..physics.mujoco import MujocoPhysics
from .assembly import assemble
from .holds import bridged
from .late_sensors import LATE, free_riders, without_free_riders
from .modes import MODES
from .objective import Point, Unit, pushes_of, units_of
from .onsets import with_onsets
from .preparation import Prepared, prepare
from .prepared_anew import with_less_noise, with_less_trust
from .report import Report
from .searching import Searching
from .selection import Selection, select
from .shapes import SHAPED, shaped, with_shapes
from .with_chance import with_chance

_ALPHA = 0.01
_SURELY = 1e-3  # the same, where what varies counts as noise
_TOO_SHORT = (
    "sensors that are late were left out: over {} control steps they show what was measured before"
)
_NEARLY = 2.0  # mean squared innovation of what seems to leave noise alone
_JITTER = 0.05  # of the control step; times since 1970 are rounded


def diagnose(
    simulator: str | Task | System,
    prior: BoxPrior | None,
    logs: Sequence[Log],
    *,
    effects: Sequence[str | Effect] | None = None,
    findings: Sequence[SanityFinding] = (),
    mode: str | None = None,
    horizon: int | None = None,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> Report:
    """Say what the simulator lacks, or that it lacks nothing, or that the data cannot say.

    Args:
        simulator: A name such as ``Hopper-v5``, a `Task`, or a `System`.
        prior: Over entries of the model, by their names, such as ``body_mass[torso]``; ``None``
            where a system has its own, or nothing is uncertain.
        logs: What the real robot did. They are taken as they are: `checked_logs` gives them,
            malformed ones refused.
        effects: Names from the catalogue, or effects of your own; default the system's, or all.
        findings: Of `checked_logs`, to be repeated in the report.
        mode: What is predicted and compared: ``segments`` from measured states, the default;
            ``trajectories`` from their first row on, where states cannot be set or hidden ones live
            long, the default where a joint that matters was not logged; ``summaries``,
            statistics of windows, where clocks are not synchronised or chaos rules.
        horizon: Control steps that are predicted at a time; default chosen from the data.
        seed: Of the bootstrap and of the null distribution's draws.
        progress: Told what is done.

    Raises:
        TypeError: The simulator, the prior, a log or an effect is of another kind.
        ValueError: There are no logs, none is long enough, one is of another robot or control
            step, of other columns, not finite or not in order, an effect is asked for twice, there
            is no such mode, or the simulator's actuators have dynamics of their own.
        KeyError: An effect is not in the catalogue.
    """
    begun = time.perf_counter()
    if mode is not None:
        check_choice("a mode of the diagnosis", mode, MODES)
    if horizon is not None:
        check_count("horizon", horizon)
    check_kind("a whole number as the seed", seed, int)
    check_count("seed", seed, least=0)
    check_kind("a sequence of logs", logs, list, tuple)
    check_kind("a sequence of findings", findings, list, tuple)
    system = _system(simulator, prior)
    _check_actuators(system)
    for log in logs:
        _check_log(log, system)
    chosen = _effects(system, effects, logs)
    every = units_of(chosen, system.robot)
    told = None if mode is None else MODES[mode]()
    hopeless = () if told is None else told.untestable
    units = [u for u in every if not u.effect.random and u.name not in hopeless]
    generator = np.random.default_rng(seed)
    # many small matrices: threads of their own cost more than they bring
    with threadpool_limits(1, user_api="blas"):
        progress("fitting the parameters")
        asked = _asks_for_holds(every)
        bridges, holds, slow = bridged(logs, system.robot) if asked else (logs, [], [])
        prepared = prepare(
            system, bridges, units, generator=generator, mode=told, horizon=horizon
        ).alarmed(*slow)
        search = partial(_searched, system, units=units, generator=generator, progress=progress)
        alarms, prepared, selection = _beside_noise(search, prepared, generator)
        progress("looking for scatter")
        prepared, selection, scatter = with_chance(
            prepared,
            selection,
            logs=logs,
            units=every,
            holds=holds,
            alarms=alarms,
            search=search,
            generator=generator,
        )
        progress("opening the test runs")
        return assemble(
            system,
            prepared=prepared,
            selection=selection,
            scatter=scatter,
            findings=findings,
            generator=generator,
            begun=begun,
            alpha=_ALPHA,
        )


def _beside_noise(
    search: Searching,
    prepared: Prepared,
    generator: np.random.Generator,
) -> tuple[tuple[str, ...], Prepared, Selection]:
    """Search for effects that last, and on where they leave noise alone, and less than was thought.

    And on where contacts are met by chance beside them, so that little can be told from there.

    Returns:
        Alarms before the last search, what it started from, and what it found.
    """
    alarms = prepared.alarms
    prepared, selection = search(prepared)
    if selection.best.mean_square >= _NEARLY:
        less = with_less_trust(prepared, selection.best.fit.point, generator=generator)
        if less is not None:
            prepared, selection = search(less, known=selection)
    if selection.best.mean_square < _NEARLY:
        quieter = with_less_noise(prepared, selection.best.fit.point, generator=generator)
        if quieter is not None:
            return quieter.alarms, *search(quieter, known=selection)
    return alarms, prepared, selection


def _searched(
    system: System,
    prepared: Prepared,
    *,
    units: Sequence[Unit],
    generator: np.random.Generator,
    progress: Callable[[str], None],
    known: Selection | None = None,
    varied: bool = False,
    pairs: bool = True,
) -> tuple[Prepared, Selection]:
    """Search for effects that last; an alarm where sensors that are late had to be left out."""
    shapes = partial(_shapes, system, prepared, units)
    if known is None:
        units = with_shapes(units, shapes(prepared.nominal.point))
        units = with_onsets(prepared.sets["train"], prepared.nominal.point, units)
    else:
        units = known.offered
    search = partial(
        select,
        prepared.sets["train"],
        prepared.sets["validation"],
        prepared.nominal,
        known=known,
        varied=varied,
        pairs=pairs,
        shapes=shapes,
        alpha=_SURELY if varied else _ALPHA,
        generator=generator,
        progress=progress,
    )
    selection = search(units)
    seen = prepared.sets["train"], prepared.noise
    if free_riders(*seen, selection.nominal, [selection.best]):
        prepared = prepared.alarmed(_TOO_SHORT.format(prepared.horizon))
        selection = search([unit for unit in units if unit.name not in LATE], known=None)
    return prepared, without_free_riders(*seen, selection)


def _check_actuators(system: System) -> None:
    """Refuse activations: a segment starts in a measured state, and no log measures those."""
    model = system.task.model
    if model.na:
        moved = [
            model.actuator(i).name or f"actuator{i}"
            for i, kind in enumerate(model.actuator_dyntype)
            if kind
        ]
        raise ValueError(
            message(
                "actuators without dynamics of their own (logs do not hold their activations)",
                f"{model.na} activations, of {', '.join(moved)}",
                hint="actuators without timeconst or dyntype, and the effect action_lag for them",
            )
        )


def _check_log(log: Log, system: System) -> None:
    check_kind("a Log, as read_logs gives", log, Log)
    hint = "read_logs(source, system) with this system"
    check_kind(f"a tensor as time of {log.name}", log.time, torch.Tensor, hint=hint)
    model, length = system.task.model, log.time.numel()
    sizes = {
        "time": (length,),
        "qpos": (length, model.nq),
        "qvel": (length, model.nv),
        "ctrl": (length, len(system.task.action_names)),
        "velocity_gain": (model.nv,),
        "measured": (2 * model.nv,),
    }
    for name, size in sizes.items():
        value = getattr(log, name)
        check_kind(f"a tensor as {name} of {log.name}", value, torch.Tensor, hint=hint)
        if value.shape != size:
            expected = f"logs of this simulator, {name} of shape {size}"
            raise ValueError(message(expected, f"{tuple(value.shape)} in {log.name}", hint=hint))
        if name != "measured" and not value.is_floating_point():
            expected = f"{name} of {log.name} in floating-point numbers"
            raise TypeError(message(expected, str(value.dtype), hint=hint))
    measured = log.measured.nonzero()[:, 0].tolist()
    if measured != sorted(system.channel_index):
        expected = f"logs in which {', '.join(system.robot.channels)} were measured"
        got = f"{len(measured)} measured coordinates in {log.name}"
        raise ValueError(message(expected, got, hint=hint))
    for name in ("time", "qpos", "qvel", "ctrl"):
        if not bool(getattr(log, name).isfinite().all()):
            got = f"NaN or infinity in {name} of {log.name}"
            raise ValueError(message("logs of finite numbers", got, hint=hint))
    steps = log.time.diff()
    if not bool((steps > 0).all()):
        got = f"{log.name}, where it does not"
        raise ValueError(message("logs whose time increases", got))
    if not bool(((steps / system.control_dt - 1).abs() < _JITTER).all()):
        expected = f"logs with rows {system.control_dt:g} s apart, the control step"
        got = f"{float(steps.min()):g} to {float(steps.max()):g} s in {log.name}"
        raise ValueError(message(expected, got, hint=hint))


def _asks_for_holds(units: Sequence[Unit]) -> bool:
    return any(unit.name == SensorDropout.name for unit in units)


def _shapes(system: System, prepared: Prepared, units: Sequence[Unit], point: Point) -> list[Unit]:
    """Return those of the units whose frequencies, phases and steps the data suggest at a point."""
    names = {unit.name for unit in units} & set(SHAPED)
    if not names or not prepared.mode.synchronised:
        return []
    found = shaped(
        prepared.predictor,
        prepared.logs["train"],
        point=point,
        noise=prepared.noise,
        pushes=pushes_of(system.robot),
    )
    return [unit for unit in found if unit.name in names]


def _system(simulator: str | Task | System, prior: BoxPrior | None) -> System:
    system = simulator if isinstance(simulator, System) else System(task=as_task(simulator))
    if prior is None:
        return system
    if system.prior is not None:
        raise ValueError(message("one prior", "the system's and another", hint="pass None"))
    check_kind("a BoxPrior or None", prior, BoxPrior)
    return replace(system, physics=MujocoPhysics(*prior.names), prior=prior)


def _effects(
    system: System, effects: Sequence[str | Effect] | None, logs: Sequence[Log]
) -> list[Effect]:
    if effects is None:
        effects = list(CATALOGUE) if system.effects is None else system.effects
    each_once(effects)
    seconds = max((len(log) for log in logs), default=1) * system.control_dt
    forms = [effect(e).forms(seconds) if isinstance(e, str) else (e,) for e in effects]
    return [form for some in forms for form in some]
