"""Models with another effect in the place of one: what the data cannot tell from the best.

The first search tries what stands out of a screen at the nominal fit. What acts alike, and what
would do as well beside the effects that were found since, is fitted here.
"""

from __future__ import annotations

__all__ = ["alternatives", "kind", "stands_in"]

from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np

from ..effects.bodies import Payload
from ..effects.contacts import ContactFriction
from ..effects.effect import Effect
from ..effects.joints import CoulombFriction
from ..effects.transmission import ServoDeadBand
from .both_ways import both_ways
from .explanations import compare
from .form_fit import softened, with_fitted_forms, with_forms_anew
from .free_numbers import bendable, fitted_numbers
from .imitators import imitators
from .model import Model, as_good, best_by_effect, judged_fits
from .objective import Objective, Point, Unit
from .refit import WIDE, refit
from .screening import Screen

_ALIKE = 4  # models with an effect of the same group in its place
_RIVALS = 6  # models with another effect in the place of one
_LAWS = 2  # of those that bend
_NEARLY, _FORMS = 0.05, 3  # of what is explained; of those that explain all but that
_MORE, _LITTLE = 5.0, 0.05  # mean squared innovation; share of friction's range, to start from
_ALONG = (0.25, 0.5)  # of the range of friction in contacts, to start from


def alternatives(
    train: Objective,
    validation: Objective,
    best: Model,
    *,
    units: Sequence[Unit],
    tried: Sequence[Model],
    first: Screen,
    offered: Collection[Unit],
) -> dict[str, tuple[Model, ...]]:
    """Return models with another effect in the place of each effect of the best one.

    Args:
        train: Where models are fitted.
        validation: Where they are judged.
        best: Whose effects are replaced.
        units: The effects to consider.
        tried: Every model that was fitted, the first with parameters alone.
        first: All units, compared with that one.
        offered: The effects as they were offered, of which no number has been fitted.
    """
    start = tried[0]
    result: dict[str, tuple[Model, ...]] = {}
    for name in best.names:
        kept = {u: s for u, s in best.fit.point.strengths.items() if u.name != name}
        known = [m for m in tried if stands_in(m, kept, name)]
        if kept:
            base = judged_fits(train, validation, [Point(best.fit.point.z, kept)])[0]
            left = [u for u in units if u not in kept and u.name != name]
            strongest, most = compare(train, base.fit, left).seen.best(1.0), _RIVALS
        else:  # the search has tried those that stand out; what acts alike is a rival anyway
            base, most = start, _ALIKE
            groups = {kind(u.effect) for u in best.units}
            seen = {u.effect for m in known for u in m.units}
            strongest = {
                unit: found
                for unit, found in first.best(1.0).items()
                if kind(unit.effect) in groups and unit.name != name and unit.effect not in seen
            }
        additions: dict[Effect, dict[Unit, float]] = {}
        for unit, (_, strength) in strongest.items():
            if len(additions) < most:
                additions.setdefault(unit.effect, {unit: strength})
        starts = _with_each(base, additions.values())
        if not kept:
            starts += imitators(start, best, first, most=_ALIKE)
        known += _raced((train, validation), starts, best)
        known += _as_before((train, validation), best, name, tried)
        known += _bent((train, validation), best, known, offered)
        known += _of_one_law((train, validation), best, kept, offered)
        known += _sliding((train, validation), best, kept, units)
        known += _sticking((train, validation), best, name, units)
        known += both_ways((train, validation), best, name, units)
        if train.width > Objective.width:
            known += _nearer((train, validation), best, name, known)
        known += _in_their_forms((train, validation), best, known, offered, start=start)
        result[name] = tuple(known)
    return result


def _as_before(
    sets: tuple[Objective, Objective], best: Model, name: str, tried: Sequence[Model]
) -> list[Model]:
    """Return what was as good as an effect while that was alone, from its own parameters.

    What needs other parameters, as a payload does, is not seen from the best's.
    """
    strengths = best.fit.point.strengths
    mine = {unit for unit in strengths if unit.name == name}
    kept = {unit: s for unit, s in strengths.items() if unit.name != name}
    alone = [m for m in tried if set(m.units) == mine]
    if not kept or not alone:
        return []
    names = best.names
    others = [m for m in tried if len(m.names) == 1 and not m.names & names]
    starts = {
        m.units: Point(m.fit.point.z, {**kept, **m.fit.point.strengths})
        for m in others
        if as_good(alone[0], m)
    }
    return _raced(sets, list(starts.values()), best)


def _bent(
    sets: tuple[Objective, Objective],
    best: Model,
    known: Sequence[Model],
    offered: Collection[Unit],
) -> list[Model]:
    """Return laws that bend to the data, in the place of an effect at several places.

    With no more numbers: a payload that is held aside moves the centre of mass in two directions.
    """
    train, most = sets[0], fitted_numbers(best, offered)
    fewer = [m for m in known if len(m.units) < len(best.units)]
    laws = [m for m in fewer if bendable(train, m.beyond(best)) and not as_good(best, m)]
    plain = list(best_by_effect(laws, best).values())[:_LAWS]
    fitted = [with_fitted_forms(*sets, model, offered) for model in plain]
    return [m for m in fitted if m not in plain and fitted_numbers(m, offered) <= most]


def _of_one_law(
    sets: tuple[Objective, Objective],
    best: Model,
    kept: Mapping[Unit, float],
    offered: Collection[Unit],
) -> list[Model]:
    """Return bent laws of masses, beside others, in the place of such an effect at several places.

    Centres of mass that are shifted along several axes may be one payload, held aside, beside which
    a spring hardens: neither law alone comes near before both are bent.
    """
    mine = [unit for unit in best.units if unit not in kept]
    if not kept or len(mine) < 2 or {u.effect.group for u in mine} != {Payload.group}:
        return []  # friction at one joint is none at several
    names = {unit.name for unit in mine}
    alike = [u for u in offered if u.name not in names and u.effect.group == Payload.group]
    laws = [u for u in alike if u.where != "all" and bendable(sets[0], [u])]
    z = best.fit.point.z
    starts = [Point(z, {**kept, u: u.inside(_LITTLE * u.high)}) for u in laws]
    plain = sorted(judged_fits(*sets, starts), key=lambda m: m.mean_square)[:_LAWS]
    fitted = [with_fitted_forms(*sets, model, offered) for model in plain]
    most = fitted_numbers(best, offered) + 1
    return [m for m in fitted if fitted_numbers(m, offered) <= most]


def _in_their_forms(
    sets: tuple[Objective, Objective],
    best: Model,
    known: Sequence[Model],
    offered: Collection[Unit],
    *,
    start: Model,
) -> list[Model]:
    """Return what explains nearly as much with its laws, and those beside it, bent to the data.

    The best model's laws were bent beside its own effects: a cause in another form would lose to
    what imitates it.
    """
    explained = float((start.deviances() - best.deviances()).sum())
    near = [
        m for m in known if float((m.deviances() - best.deviances()).sum()) < _NEARLY * explained
    ]
    able = [m for m in near if bendable(sets[0], m.units)]
    plain = list(best_by_effect(able, best).values())[:_FORMS]
    fitted = [with_forms_anew(*sets, model, offered) for model in plain]
    sharp = [m for m in near if m not in able] if best.dispersion() > _MORE else []
    soft = softened(*sets, list(best_by_effect(sharp, best).values()), offered, most=_FORMS)
    return [m for m in fitted if m not in plain] + soft


def _sliding(
    sets: tuple[Objective, Objective], best: Model, kept: dict[Unit, float], units: Sequence[Unit]
) -> list[Model]:
    """Return friction in contacts in the place of an effect, fitted from the prior's mean.

    With another mass, and an armature beside it, all that slides moves as with another friction.
    Between the two lies a valley that no descent goes along; and what sticks and slips is rough.
    """
    unit = next((u for u in units if isinstance(u.effect, ContactFriction)), None)
    if unit is None or unit in best.units:
        return []
    centre = np.zeros_like(best.fit.point.z)
    ends = [share * end for end in (unit.low, unit.high) for share in _ALONG]
    starts = [Point(centre, {**kept, unit: unit.inside(strength)}) for strength in ends]
    wide = refit(sets[0].differing(WIDE), starts, race=best.fit.cost)
    nearest = min(wide, key=lambda fit: fit.cost).point
    return judged_fits(*sets, [nearest])


def _sticking(
    sets: tuple[Objective, Objective], best: Model, name: str, units: Sequence[Unit]
) -> list[Model]:
    """Return dry friction of every joint beside a servo's dead band that leaves more than noise.

    Both make a servo stand still: alone, one takes nearly all of what the other does.
    """
    mine = [u for u in best.units if u.name == name and isinstance(u.effect, ServoDeadBand)]
    dry = [u for u in units if isinstance(u.effect, CoulombFriction) and u.where != "all"]
    if not mine or best.names & {u.name for u in dry} or best.dispersion() < _MORE:
        return []
    more = {unit: unit.inside(_LITTLE * unit.high) for unit in dry}
    start = best.fit.point.beside(more)
    return judged_fits(*sets, [start])


def _nearer(
    sets: tuple[Objective, Objective], best: Model, name: str, known: Sequence[Model]
) -> list[Model]:
    """Return friction in contacts or joints, in the other's place, from the best's parameters.

    Where residuals are rough, a fit from afar ends anywhere: with what it had, and twice as much.
    """
    groups = {unit.effect.group for unit in best.units if unit.name == name}
    mine = {kind(unit.effect) for unit in best.units if unit.name == name}
    starts = []
    for model in known:
        added = model.beyond(best)
        other = {unit.effect.group for unit in added} != groups
        if other and {kind(unit.effect) for unit in added} == mine:
            strengths = model.fit.point.strengths
            for times in (1.0, 2.0):
                more = {u: u.inside(times * strengths[u]) for u in added}
                starts.append(Point(best.fit.point.z, {**strengths, **more}))
    return _raced(sets, starts, best)


def kind(effect: Effect) -> str:
    """Return what an effect acts like: its group; friction does alike in joints and in contacts."""
    return CoulombFriction.group if isinstance(effect, ContactFriction) else effect.group


def stands_in(model: Model, kept: Collection[Unit], name: str) -> bool:
    """Return whether a model has one other effect beside the kept ones."""
    others = {u.name for u in model.units if u not in kept}
    return set(kept) <= set(model.units) and len(others) == 1 and others != {name}


def _with_each(base: Model, additions: Iterable[Mapping[Unit, float]]) -> list[Point]:
    """Return the base with each addition."""
    return [base.fit.point.beside(more) for more in additions]


def _raced(sets: tuple[Objective, Objective], starts: Sequence[Point], best: Model) -> list[Model]:
    """Fit what can come near the best model's cost."""
    return judged_fits(*sets, starts, race=best.fit.cost) if starts else []
