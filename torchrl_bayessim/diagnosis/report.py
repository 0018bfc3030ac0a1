"""What a diagnosis says: the verdict in one line, its evidence, and the simulator that follows.

The JSON form is a stable interface, ``"schema": 1``.
"""

from __future__ import annotations

__all__ = ["Candidate", "Finding", "Gap", "Parameter", "Report"]

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from torchrl.envs import Compose, EnvBase, TransformedEnv

from ..effects.effect import Effect, SensorEffect
from ..effects.robot import Robot
from ..effects.sequence import forces_in_stages, in_stages
from ..effects.units import unit_at
from ..errors import message
from ..inference.priors import BoxPrior
from ..physics.protocol import Physics
from ..transforms.apply_effect import ApplyEffect
from ..transforms.apply_physics import ApplyPhysics
from ..transforms.effect_physics import EffectPhysics
from ..whole_file import write_text

Verdict = Literal["none", "named", "named_partial", "ambiguous", "unknown", "not_testable"]


@dataclass(frozen=True, kw_only=True)
class Finding:
    """An effect that the data need.

    Attributes:
        name: Its name in the catalogue.
        where: Joint, actuator or channel, or ``all``.
        strength: In ``unit``; where it sits at several targets, their mean, or the largest where
            they are in proportion to their ranges.
        unit: SI unit, or ``fraction``.
        ci95: Interval of the strength.
        p_value: Of the test that nothing was missing, when it was found.
        share_of_gap: Share of the explainable error that it removes, over all orders of adding.
        strengths: By target.
        form: What its law has beside the strength, by the names of the effect's options, such as
            the ``frequency`` of a ``periodic_disturbance`` in Hz; of the strongest target's.
        rivals: Names that these data cannot tell from it, beside what else was found.
    """

    name: str
    where: str
    strength: float
    unit: str
    ci95: tuple[float, float]
    p_value: float
    share_of_gap: float
    strengths: Mapping[str, float]
    form: Mapping[str, float] = field(default_factory=dict)
    rivals: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """What the data say about one effect at one place.

    Attributes:
        name: Its name.
        where: Its target.
        strength: The most likely one, alone; of what is named, beside the others.
        ci95: Its interval where it was fitted, else ``None``.
        likelihood_ratio: Of the screen at the nominal fit.
        p_value: Of that ratio among all that were tried.
        held_out_gain: Validation deviance that it removed alone; ``None`` where it was not fitted.
        explained_fraction: Of the explainable error, alone.
        explained_by_parameters: Share of its signature that parameters would swallow.
        minimal_detectable_strength: What the runs would have shown, trained on or not; ``None``
            where not even the largest plausible strength.
        status: What became of it.
        form: What its law has beside the strength, as in :class:`Finding`.
        unit: Of the strength.
    """

    name: str
    where: str
    strength: float
    ci95: tuple[float, float] | None
    likelihood_ratio: float
    p_value: float
    held_out_gain: float | None
    explained_fraction: float
    explained_by_parameters: float
    minimal_detectable_strength: float | None
    status: Literal["named", "rejected", "ruled_out", "not_excited", "confounded"]
    form: Mapping[str, float] = field(default_factory=dict)
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """A parameter before and after.

    Attributes:
        name: Its name.
        prior: Its bounds.
        without_effects: Fitted alone.
        with_effects: Fitted together with the effects.
        sd: Standard deviation of the latter.
        at_bound: Whether the fit alone left the bulk of the prior.
    """

    name: str
    prior: tuple[float, float]
    without_effects: float
    with_effects: float
    sd: float
    at_bound: bool


@dataclass(frozen=True, kw_only=True)
class Gap:
    """How large the error is, in mean squares of innovations: a perfect simulator has 1.

    Attributes:
        horizon_steps: Control steps predicted.
        raw: At the prior's mean.
        refit: With the parameters fitted.
        with_effects: With the effects too.
        floor: Of a perfect simulator.
        explained_fraction: ``(refit - with_effects) / (refit - floor)`` on the test split; where
            that hardly shows the gap, and the sentence says so, on the validation split.
        ci95: Its interval for motions that were not recorded: by bootstrap over trajectories, and
            wider by what robots whose cause was known had.
        by_parameters: ``(raw - refit) / (raw - floor)``.
        rollout_rmse: Open-loop error over whole test runs, by channel, SI units.
    """

    horizon_steps: int
    raw: float
    refit: float
    with_effects: float
    floor: float
    explained_fraction: float
    ci95: tuple[float, float]
    by_parameters: float
    rollout_rmse: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True, kw_only=True, eq=False)
class Report:
    """The outcome of a diagnosis; ``print(report)`` shows the one line.

    Attributes:
        verdict: ``none``: nothing is missing. ``named``: the effects explain the gap.
            ``named_partial``: they explain most of it, and the rest is located, or test runs show
            too little of it to say how much they explain. ``ambiguous``:
            several effects explain it equally well. ``unknown``: the gap is real, and nothing in
            the catalogue explains it. ``not_testable``: these data cannot say.
        summary: One sentence.
        effects: What was found, largest share first.
        confusion_set: Effects that explain the data as well as the first, itself included.
        where: Channel, outputs, joints and time of the error, and the regimes in which the first
            cause acts (``regimes_of``) or else the error sits.
        remainder: The same for what the effects leave.
        gap: How large it is.
        candidates: Every effect at every place.
        parameters: The parameters.
        alarms: What the reader must know before believing any of it.
        next_experiment: What to record next.
        audit: Split, simulations, noise floor, seconds.
        strengths: The effects' strengths by target, as `apply` sets them.
        figures: Numbers behind the pictures of the page.
    """

    verdict: Verdict
    summary: str
    effects: tuple[Finding, ...]
    confusion_set: tuple[str, ...]
    where: Mapping[str, Any]
    remainder: Mapping[str, Any]
    gap: Gap
    candidates: tuple[Candidate, ...]
    parameters: tuple[Parameter, ...]
    alarms: tuple[str, ...]
    next_experiment: tuple[Mapping[str, Any], ...]
    audit: Mapping[str, Any]
    strengths: Mapping[Effect, Mapping[str, float]] = field(default_factory=dict)
    figures: Mapping[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return self.summary

    def to_dict(self) -> dict[str, Any]:
        """Return the report as the JSON interface has it."""
        gap = asdict(self.gap)
        rollout = dict(gap.pop("rollout_rmse"))
        return {
            "schema": 1,
            "verdict": self.verdict,
            "summary": self.summary,
            "effects": [asdict(effect) for effect in self.effects],
            "confusion_set": list(self.confusion_set),
            "where": self.where,
            "remainder": self.remainder,
            "gap": {
                "metric": "mean squared innovation, 1 for a perfect simulator",
                **gap,
                "rollout_rmse": {**rollout, "unit": "SI, held-out, open loop"},
            },
            "candidates": [asdict(candidate) for candidate in self.candidates],
            "parameters": [asdict(parameter) for parameter in self.parameters],
            "alarms": list(self.alarms),
            "next_experiment": [dict(step) for step in self.next_experiment],
            "audit": dict(self.audit),
        }

    def to_json(self, path: str | Path) -> None:
        """Write the report as JSON, wholly or not at all."""
        write_text(path, self.as_json())

    def as_json(self) -> str:
        """Return the report as JSON."""
        return json.dumps(_plain(self.to_dict()), indent=1, allow_nan=False)

    def apply(
        self, env: EnvBase, physics: Physics | None = None, *, channels: Sequence[str] = ()
    ) -> EnvBase:
        """Return the environment with the effects that were found.

        Of several effects on commands those of a lower `ActionEffect.stage` act first, as in the
        diagnosis. Of several transforms the last one is the first that an action meets.

        With ``physics``, strengths are parameters too: the environment's θ has the columns of
        ``physics``, then one for each strength, in the order of `prior`. A reset without θ brings
        back the nominal parameters and the fitted strengths.

        Args:
            env: An environment of the simulator that was diagnosed.
            physics: Its parameters; default none, and strengths stay as they were fitted.
            channels: What the report calls the entries of ``observation``, for effects on sensors;
                any name for those that were not logged. What is not observed is left out.

        Raises:
            ValueError: An effect on sensors was found, and no channels are given.
        """
        strengths, named = self._strengths(channels), tuple(channels)
        effects = {
            e: ApplyEffect(e, dict(s), channels=named if isinstance(e, SensorEffect) else ())
            for e, s in strengths.items()
        }
        # the last of several transforms is the first that an action meets
        last, first = in_stages(effects)[::-1], forces_in_stages(effects)
        others = [e for e in effects if e not in last and e not in first]
        chain: list[Any] = [effects[e] for e in (*last, *first, *others)]
        if physics is None:
            for effect in chain:
                env = TransformedEnv(env, effect, auto_unwrap=True)
            return env
        columns = [
            (effects[e], target) for e, by_target in strengths.items() for target in by_target
        ]
        if columns:
            physics = EffectPhysics(physics, *columns)
        chain = [ApplyPhysics(physics), *chain]
        return TransformedEnv(env, Compose(*chain), auto_unwrap=True)

    def _strengths(self, channels: Sequence[str]) -> dict[Effect, Mapping[str, float]]:
        """Return strengths by target, of channels those that an environment observes."""
        result: dict[Effect, Mapping[str, float]] = {}
        for effect, by_target in self.strengths.items():
            seen = by_target
            if isinstance(effect, SensorEffect):
                if not channels:
                    expected = f"the names of the observation's entries, for {effect.name}"
                    hint = f"channels=({', '.join(map(repr, by_target))}, ...)"
                    raise ValueError(message(expected, "none", hint=hint))
                seen = {name: s for name, s in by_target.items() if name in channels}
            if seen:
                result[effect] = seen
        return result

    def prior(
        self, prior: BoxPrior | None, robot: Robot, *, channels: Sequence[str] = ()
    ) -> BoxPrior:
        """Return the prior over parameters and strengths of an environment of `apply`.

        A strength is uniform over what the catalogue has as plausible on this robot, or twice that
        where the fit lies beyond. The interval of the diagnosis does not narrow it: the same logs
        would count twice.

        Args:
            prior: Over the parameters; ``None`` if there are none.
            robot: Such as `System.robot`.
            channels: As given to `apply`.

        Raises:
            TypeError: The prior is another than a `BoxPrior`.
            ValueError: There are neither parameters nor effects.

        Example::

            theta = report.prior(system.prior, system.robot)  # …, action_delay[motor]
            env = report.apply(env, system.physics)
            env.append_transform(DomainRandomizer(theta))
        """
        bounds, log, units = _described(prior)
        for effect, by_target in self._strengths(channels).items():
            targets = effect.targets(robot)
            low, high = (bound.tolist() for bound in effect.bounds(robot))
            for target, strength in by_target.items():
                name, i = f"{effect.name}[{target}]", targets.index(target)
                reach = 1.0 if low[i] <= strength <= high[i] else 2.0
                bounds.append((name, (reach * low[i], reach * high[i])))
                units[name] = unit_at(effect, robot, i)
        return BoxPrior(bounds, log=log, units=units)


def _described(
    prior: BoxPrior | None,
) -> tuple[list[tuple[str, tuple[float, float]]], list[str], dict[str, str]]:
    """Return what a prior was made of: bounds, names of logarithmic parameters, units."""
    if prior is None:
        return [], [], {}
    if not isinstance(prior, BoxPrior):
        hint = "the bounds that the diagnosis started from"
        raise TypeError(message("a BoxPrior", type(prior).__name__, hint=hint))
    box = zip(prior.low.tolist(), prior.high.tolist(), strict=True)
    log = [name for name, flag in zip(prior.names, prior.log.tolist(), strict=True) if flag]
    units = dict(zip(prior.names, prior.units, strict=True))
    return list(zip(prior.names, box, strict=True)), log, units


def _plain(value: Any) -> Any:
    """Return the value with what JSON does not know (NaN, infinity, tuples) replaced."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(entry) for entry in value]
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
