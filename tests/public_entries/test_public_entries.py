"""Every public entry answers, or says in the project's words what it expected."""

import inspect
import re
from pathlib import Path

import pytest
import torch
from entries import ENTRIES
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from wrong_values import ANYWHERE, WRONG

import torchrl_bayessim

# What torch, TorchRL and TensorDict call, with what they have checked
HOOKS = {"forward", "inv", "clone", "default_keys", "extra_repr", "set_container"}
HOOKS |= {"get_extra_state", "set_extra_state"}
SPECS = re.compile(r"transform_\w+_spec")
ELSEWHERE = {
    "Physics": "a protocol",
    "Report": "made by diagnose: tests/diagnosis",
    "DomainRandomizer.drives": "takes any environment, or none",
    "DomainRandomizer.unpin": "takes nothing",
    "SimToRealLoop.state_dict": "takes nothing",
    "SimToRealLoop.resume": "takes nothing",
    "PosteriorRefinement.proposal": "takes nothing",
    "PosteriorRefinement.state_dict": "takes nothing",
    "ApplyEffect.know": "called by its container",
    "BatchedMujocoEnv.add": "called by transforms",
    "BatchedMujocoEnv.meanwhile": "called by next_batch: tests/test_overlapped.py",
    "AttributePhysics.read": "called by ApplyPhysics",
    "MujocoPhysics.read": "called by ApplyPhysics",
    "MujocoPhysics.entries": "takes a model of MuJoCo's: tests/physics/test_dry_friction.py",
    "StatePhysics.read": "called by ApplyPhysics",
    "StatePhysics.write": "called by ApplyPhysics",
}
ELSEWHERE["ray_collectors.RayCollectors"] = "needs an extra: tests/test_ray_collectors.py"
FLAGS = {"progress", "check"}  # whatever Python counts as true is


def entries():
    """Yield the public names, and the public methods of the classes among them."""
    for name in torchrl_bayessim.__all__:
        value = getattr(torchrl_bayessim, name)
        yield name
        if inspect.isclass(value) and name not in ELSEWHERE:
            own = [c for c in value.__mro__ if c.__module__.startswith("torchrl_bayessim")]
            for method in sorted({m for c in own for m in vars(c) if m[0] != "_"} - HOOKS):
                if callable(getattr(value, method)) and not SPECS.fullmatch(method):
                    yield f"{name}.{method}"


def refused(error):
    """Return whether an error is one of the package's own, in words."""
    return bool(error.args) and bool(re.match("expected .+, got ", str(error.args[0]), re.DOTALL))


def changed(name, argument, value):
    """Call an entry with one argument changed; return its answer, or the package's refusal."""
    arguments = ENTRIES[name].good()
    arguments[argument] = value
    try:
        return ENTRIES[name].call(**arguments), None
    except Exception as error:
        if not refused(error):
            raise
        return None, error


def test_every_public_entry_is_in_the_table():
    known = {*ENTRIES, *ELSEWHERE}
    assert [name for name in entries() if name not in known] == []
    text = (Path(__file__).parents[2] / "README.md").read_text()
    named = re.findall(r"`(\w+)`\s+of\s+`torchrl_bayessim\.([\w.]+)`", text)
    assert [f"{module}.{name}" for name, module in named if f"{module}.{name}" not in known] == []
    kinds = {kind for entry in ENTRIES.values() for kind in entry.kinds.values()}
    assert kinds == set(WRONG)


@pytest.mark.parametrize("name", ENTRIES)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_what_is_good_works_and_what_is_wrong_is_refused(name):
    entry = ENTRIES[name]
    entry.call(**entry.good())
    assert entry.kinds.keys() <= entry.good().keys()
    for argument, kind in entry.kinds.items():
        for value in WRONG[kind]:
            _, error = changed(name, argument, value)
            assert error is not None, f"{argument}={value!r} is taken"


numbers = st.floats(width=64) | st.integers(-5, 40) | st.complex_numbers() | st.booleans()
sizes = st.lists(st.integers(0, 3), max_size=3)
dtypes = st.sampled_from([torch.float32, torch.float64, torch.int64, torch.bool, torch.complex64])
tensors = st.builds(
    lambda size, dtype, value: torch.full(size, value).to(dtype),
    sizes,
    dtypes,
    st.sampled_from([0.0, 0.5, -3.0, 1e30, torch.nan, torch.inf]),
)
texts = st.text(max_size=4) | st.binary(max_size=3)
plain = st.none() | numbers | texts
anything = (
    st.sampled_from(ANYWHERE)
    | tensors
    | st.recursive(
        plain,
        lambda inner: (
            st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2)
        ),
        max_leaves=4,
    )
)
places = [
    (name, argument)
    for name, entry in ENTRIES.items()
    if not entry.carried
    for argument in sorted(entry.good().keys() - FLAGS)
]


@settings(max_examples=300, suppress_health_check=list(HealthCheck))
@given(st.sampled_from(places), anything)
@pytest.mark.filterwarnings("ignore")
def test_anything_is_answered_or_refused(place, value):
    name, argument = place
    kind = ENTRIES[name].kinds.get(argument, "")
    if callable(value) and kind.startswith(("object", "function")):
        return  # the errors of a caller's function are the caller's
    changed(name, argument, value)
