"""Cases of the blind check: what is drawn, what the diagnosis is given, what is sealed."""

from __future__ import annotations

__all__ = ["Case", "Plan", "make", "sites"]

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from .causes_actuation import ACTUATION
from .causes_body import BODY, CONTACT
from .causes_chance import CHANCE
from .causes_foreign import FOREIGN
from .causes_sensing import SENSING
from .classes import without_class_of
from .detectability import beside, detectability
from .excitation import KINDS, open_loop, proportional
from .fetch_push import ARM, OBJECT
from .laws import Made, Site
from .plant import Cause, Motion, Plant, Policy, Truth
from .plant_bullet import BulletPlant
from .plant_fetch import FetchPlant, dragged
from .pushing import pushes
from .robots import ROBOTS, Robot, nominal_model, write_entry

Array = NDArray[np.float64]
CAUSES = ACTUATION | BODY | CONTACT | SENSING | CHANCE | FOREIGN
# What no data can tell from a parameter: the prior then is over the others.
_LIKE_MASSES = {"action_gain", "payload", "armature", "com_shift", "link_length"}
_LIKE_DAMPINGS = {"viscous_friction"}
_OF_VELOCITIES = {"sensor_gain", "sensor_lag"}  # they act on velocities, so those are logged


@dataclass(frozen=True)
class Plan:
    """What kind of case to draw.

    Attributes:
        tier: ``T0`` to ``T6``, ``T6B`` or a control's name.
        robot: Its name.
        causes: Names of the causes.
        form: ``same`` as the catalogue's, or ``other``.
        engine: ``fine``; ``other``: another integrator, cone and solver; or ``bullet``: PyBullet.
        control: ``parameters`` at the edge of the prior, ``noise`` twice that of the data sheet,
            actions ``shuffled`` between trajectories, handed over once more with all names
            ``renamed``, or nothing.
    """

    tier: str
    robot: str
    causes: tuple[str, ...] = ()
    form: str = "same"
    engine: str = "fine"
    control: str = ""


@dataclass(frozen=True)
class Case:
    """A robot's logs and what is true of them.

    Attributes:
        plan: What was asked for.
        truths: Of the causes.
        theta: True parameters, by entry of the model.
        priors: Bounds of those that the diagnosis may refit.
        motions: Logs.
        unseen: Noise-free motions of the same robot with new inputs.
        noise: Standard deviations told by the data sheet, ``(2 nv,)``, or nothing.
        real_noise: Those of the sensors.
        velocities: Whether velocities are logged.
        effects: Names that the diagnosis may consider; nothing for all.
        detectability: See `detectability`; of two causes, the least that one of them has, in the
            same data without the other or beside it.
        excitation: How it was moved.
    """

    plan: Plan
    truths: tuple[Truth, ...]
    theta: dict[str, float]
    priors: dict[str, tuple[float, float]]
    motions: tuple[Motion, ...]
    unseen: tuple[Motion, ...]
    noise: Array | None
    real_noise: Array
    velocities: bool
    effects: tuple[str, ...] | None
    detectability: float
    excitation: str


def make(plan: Plan, rng: np.random.Generator) -> Case:
    """Return a case; one whose simulation diverges is drawn again."""
    for _ in range(20):
        try:
            return _make(plan, rng)
        except FloatingPointError:
            continue
    raise ValueError(f"expected a case that can be simulated, got {plan} diverging 20 times")


def _make(plan: Plan, rng: np.random.Generator) -> Case:
    robot = ROBOTS[plan.robot]
    nominal = nominal_model(robot)
    priors = _priors(robot, plan.causes, rng)
    theta = {}
    for entry, (low, high) in priors.items():
        share = rng.uniform(0.1, 0.9) if plan.control != "parameters" else rng.choice([0.03, 0.97])
        theta[entry] = low + (high - low) * float(share)
        write_entry(nominal, entry, theta[entry])
    order = sorted(plan.causes, key=_place_in_chain)
    made = [_cause(name, plan.form, model=nominal, robot=robot, rng=rng) for name in order]
    nv = nominal.nv
    noise = np.repeat([_log(rng, 1e-3, 3e-3), _log(rng, 1e-2, 3e-2)], nv)
    noise *= np.tile(np.broadcast_to(robot.noise, nv), 2)
    kind = BulletPlant if plan.engine == "bullet" else FetchPlant if robot.commands else Plant

    def plant_with(causes: list[Cause], rng: np.random.Generator) -> Plant:
        return kind(_true_model(nominal, robot, plan.engine), robot.control_dt, causes, noise, rng)

    plant = plant_with([c for c, _ in made], rng)
    loops = str(rng.choice(["open", "open", "closed", "mixed"]))
    velocities = bool(rng.random() < 0.75) or bool(_OF_VELOCITIES & set(plan.causes))
    # differences of positions are too coarse for speeds in the dampers that hold a dragged arm
    velocities |= bool(robot.commands)
    told = noise if rng.random() < 0.5 else None
    if plan.control == "noise":
        told, plant.noise = noise, 2.0 * noise
    count, steps = int(rng.integers(6, 13)), int(rng.integers(*robot.steps, endpoint=True))
    before = deepcopy(rng)
    motions = _motions(plant, robot, loops, count=count, steps=steps, rng=rng)
    real, plant.noise = plant.noise, 0.0 * noise
    unseen = _motions(plant, robot, loops, count=3, steps=steps, rng=rng)
    measured = np.repeat([True, velocities], nv)
    seen: list[tuple[list[Motion], list[Array] | None]] = [(motions, None)]
    if len(made) > 1:
        lone = [plant_with([cause], deepcopy(before)) for cause, _ in made]
        seen = [(_motions(p, robot, loops, count=count, steps=steps, rng=p.rng), None)
                for p in lone]  # fmt: skip
        known = [beside(p, motions, i) for i, p in enumerate(lone)]
        seen += [(motions, shown) for shown in known if shown is not None]
    visible = min(
        detectability(
            nominal, some, substeps=round(robot.control_dt / nominal.opt.timestep),
            noise=real, measured=measured, parameters=list(priors), known=shown,
            simulate=dragged if robot.commands else None,
        )
        for some, shown in seen
    )  # fmt: skip
    if plan.control == "shuffled":
        motions = [replace(m, ctrl=motions[i - 1].ctrl) for i, m in enumerate(motions)]
    return Case(
        plan=plan, truths=tuple(t for _, t in made), theta=theta, priors=priors,
        motions=tuple(motions), unseen=tuple(unseen), noise=told, real_noise=real,
        velocities=velocities, effects=_considered(plan, robot), detectability=visible,
        excitation=loops,
    )  # fmt: skip


def _considered(plan: Plan, robot: Robot) -> tuple[str, ...] | None:
    """Return the names that the diagnosis may consider; nothing for all."""
    if plan.tier != "T3":
        return robot.effects
    left = without_class_of(plan.causes[0])
    return tuple(name for name in left if robot.effects is None or name in robot.effects)


def _place_in_chain(name: str) -> int:
    """Return 0 for what delays the logged command, 2 for what hands it to a rotor, else 1."""
    return 0 if name == "action_delay" else 2 if name in {"backlash", "series_elasticity"} else 1


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _priors(
    robot: Robot, causes: Sequence[str], rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    """Return bounds of masses, dampings or both; never of what a cause cannot be told from."""
    kinds = []
    if robot.masses and not _LIKE_MASSES & set(causes):
        kinds.append(robot.masses)
    if robot.dampings and not _LIKE_DAMPINGS & set(causes):
        kinds.append(robot.dampings)
    if len(kinds) == 2 and rng.random() < 0.5:
        kinds = [kinds[int(rng.integers(2))]]
    return {entry: bounds for kind in kinds for entry, bounds in kind.items()}


def _true_model(nominal: mujoco.MjModel, robot: Robot, engine: str) -> mujoco.MjModel:
    """Return the nominal model with its parameters, on a finer grid or as another engine."""
    model = nominal_model(robot)
    for body in range(model.nbody):
        model.body_mass[body] = nominal.body_mass[body]
        model.body_inertia[body] = nominal.body_inertia[body]
    model.dof_damping[:] = nominal.dof_damping
    if engine in {"fine", "bullet"}:  # Bullet's integrator is of first order
        model.opt.timestep /= robot.refinement * (2 if engine == "bullet" else 1)
    else:
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        model.opt.solver = mujoco.mjtSolver.mjSOL_CG
    return model


def sites(model: mujoco.MjModel) -> list[tuple[int, int]]:
    """Return pairs of an actuator and the degree of freedom that it drives."""
    return [(a, int(model.jnt_dofadr[model.actuator_trnid[a, 0]])) for a in range(model.nu)]


def _cause(
    name: str, form: str, *, model: mujoco.MjModel, robot: Robot, rng: np.random.Generator
) -> Made:
    """Return a cause at a random place."""
    if robot.commands:
        return CAUSES[name](_site_about_a_hand(name, form, model=model, robot=robot, rng=rng))
    actuator, dof = sites(model)[int(rng.integers(model.nu))]
    torque = float(model.actuator_ctrlrange[actuator, 1] * model.actuator_gear[actuator, 0])
    if robot.name == "cart_pole" and name in BODY and rng.random() < 0.5:
        dof, torque = 1, 0.7  # the pole's, with about its weight times its half length
    joint = next(model.joint(j).name for j in range(model.njnt) if model.jnt_dofadr[j] == dof)
    site = Site(
        model=model, actuator=actuator, dof=dof, joint=joint, torque=torque,
        limit=float(model.actuator_ctrlrange[actuator, 1]), control_dt=robot.control_dt,
        form=form, rng=rng,
    )  # fmt: skip
    return CAUSES[name](site)


def _site_about_a_hand(
    name: str, form: str, *, model: mujoco.MjModel, robot: Robot, rng: np.random.Generator
) -> Site:
    """Return a place for a cause: one of the commands, the object, or an encoder of the arm."""
    actuator, dof = int(rng.integers(3)), int(rng.choice(ARM))  # the fourth command does nothing
    if name in BODY:
        dof = OBJECT
    joint = model.joint(int(model.dof_jntid[dof])).name
    if name not in {*BODY, *SENSING, "sensor_dropout"}:
        joint = robot.commands[actuator]
    return Site(
        model=model, actuator=actuator, dof=dof, joint=joint, torque=1.0, limit=1.0,
        control_dt=robot.control_dt, form=form, rng=rng,
    )  # fmt: skip


def _motions(
    plant: Plant, robot: Robot, loops: str, *, count: int, steps: int, rng: np.random.Generator
) -> list[Motion]:
    model, motions = plant.model, []
    loop = [loops == "closed" or (loops == "mixed" and i % 2 == 1) for i in range(count)]
    if robot.commands:
        return pushes(plant, nominal_model(robot), loop, steps=steps, rng=rng)
    limit = model.actuator_ctrlrange[:, 1] * robot.amplitude
    dofs = np.array([dof for _, dof in sites(model)])
    for i, closed in enumerate(loop):
        kind = KINDS[i % len(KINDS)]
        waves = open_loop(kind, steps=steps, dt=robot.control_dt, limit=limit, rng=rng)
        policy: Policy = lambda k, _, waves=waves: waves[k]
        if closed:
            reference = waves / limit * robot.reach + model.qpos0[dofs]
            full = model.actuator_ctrlrange[:, 1]
            policy = proportional(reference, dofs, limit=full, reach=1.2 * robot.reach)
        q = model.qpos0 + robot.spread * rng.uniform(-1, 1, model.nq)
        v = 0.5 * robot.spread * rng.uniform(-1, 1, model.nv)
        motions.append(plant.run(q, v, policy, steps=steps))
    return motions
