"""Simulations on Ray: a cluster of two processors, begun here, whose workers are killed."""

import gc
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv

from torchrl_bayessim import ray_collectors
from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.envs.classic_control.cartpole import CartPoleEnv
from torchrl_bayessim.episode_draws import EpisodeDraws
from torchrl_bayessim.errors import SimulationError
from torchrl_bayessim.inference.posterior import MixtureDensityPosterior
from torchrl_bayessim.inference.priors import BoxPrior
from torchrl_bayessim.inference.refinement import PosteriorRefinement
from torchrl_bayessim.loop import SimToRealLoop
from torchrl_bayessim.physics.attributes import AttributePhysics
from torchrl_bayessim.ray_collectors import RayCollectors
from torchrl_bayessim.robots import RecordedLogs, SurrogateRobot
from torchrl_bayessim.simulate import simulate
from torchrl_bayessim.summaries import SummaryStatistics, duration, moments
from torchrl_bayessim.trajectories import first_trajectories
from torchrl_bayessim.transforms import ApplyPhysics, DomainRandomizer

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray's own

PRIOR = BoxPrior({"length": (0.2, 1.5)})
NARROW = BoxPrior({"length": (0.7, 0.8)})
N, STEPS = 6, 10


def make(environments, randomizer=None):
    physics = ApplyPhysics(AttributePhysics("length"))
    transforms = [physics, randomizer or DomainRandomizer(PRIOR), StepCounter(50), RewardSum()]
    return TransformedEnv(CartPoleEnv(environments), Compose(*transforms))


def learner():
    return PPO(make(N), hidden=(4,), minibatch_size=30, epochs=1)


@pytest.fixture(scope="module")
def cluster():
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install '.[ray]'")
    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    options = {"num_cpus": 2, "object_store_memory": 100 * 2**20, "include_dashboard": False}
    ray.init(**options, logging_level="error")
    yield ray
    ray.shutdown()
    gc.collect()  # handles of its processes, which warn when they go


@pytest.fixture(scope="module")
def collectors(cluster):
    with RayCollectors(make, learner().policy, environments=N, steps=STEPS) as collectors:
        yield collectors


def workers():
    """Return the processes of the workers on this machine."""
    lines = {path: path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline")}
    return [int(path.parent.name) for path, line in lines.items() if b"ray::RayWorker" in line]


class Fatal:
    """A statistic that kills the process that computes it, as often as ``deaths`` says."""

    def __init__(self, folder, deaths=1):
        self.folder, self.deaths, self.home = folder, deaths, os.getpid()

    def __call__(self, state, action, following, mask):
        died = len(list(self.folder.iterdir()))
        if os.getpid() != self.home and died < self.deaths:
            (self.folder / str(died)).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return moments(state, action, following, mask)


def pairs(statistics, **options):
    randomizer = DomainRandomizer(PRIOR)
    given = {"pairs": 31, "max_steps": STEPS, "progress": False} | options
    policy = given.pop("policy", None)
    return simulate(make(N, randomizer), policy, statistics, randomizer, **given)


@pytest.mark.parametrize("trajectories", [1, 4])  # the pairs of 4 do not end where a batch does
def test_the_pairs_are_those_of_one_process(collectors, trajectories):
    statistics = SummaryStatistics(moments, duration)
    for policy in (None, learner().policy):
        given = {"trajectories": trajectories, "policy": policy, "seed": 3}
        here, there = (pairs(statistics, **given, collectors=c) for c in (None, collectors))
        assert torch.equal(here["theta"], there["theta"])
        assert torch.equal(here["summary"], there["summary"])
        assert len(there["summary"].unique(dim=0)) == 31


def test_a_worker_that_dies_while_it_simulates_changes_no_pair(collectors, tmp_path):
    statistics = SummaryStatistics(Fatal(tmp_path))
    before = set(workers())
    there = pairs(statistics, collectors=collectors)
    assert [path.name for path in tmp_path.iterdir()] == ["0"]  # it died, once
    assert len(before - set(workers())) == 1
    assert len(workers()) == 2
    assert torch.equal(pairs(statistics)["summary"], there["summary"])


def training(collectors, sources, *, killed=(), batches=3):
    """Return batches under each source, and how many episodes each environment began."""
    randomizer, ppo = DomainRandomizer(PRIOR, seed=5), learner()
    found = []
    for number, source in enumerate(sources):
        randomizer.source = source
        collectors.begin(randomizer, key=(0, "block", number))
        for step in range(batches):
            if (number, step) in killed:
                os.kill(workers()[0], signal.SIGKILL)
            found.append(collectors.batch(ppo.policy))
            ppo.update(found[-1], key=(number, step))
    return found, randomizer.get_extra_state()["episodes"]


def test_a_new_source_reaches_the_workers_and_draws_as_one_process_does(collectors):
    batches, episodes = training(collectors, [PRIOR, NARROW])
    assert all(batch.shape == (N, STEPS) for batch in batches)
    drawn = [EpisodeDraws(source, seed=5) for source in (PRIOR, NARROW)]
    numbers = torch.arange(N)
    assert torch.equal(batches[0]["theta"][:, 0], drawn[0](numbers, torch.zeros(N).long()))
    begun = 1 + sum(batch["next", "done"].sum((1, 2)) for batch in batches[:3])
    assert torch.equal(batches[3]["theta"][:, 0], drawn[1](numbers, begun))
    assert all(NARROW.contains(batch["theta"]).all() for batch in batches[3:])
    assert torch.equal(
        episodes, begun + 1 + sum(b["next", "done"].sum((1, 2)) for b in batches[3:])
    )
    assert (begun > 1).any()


def test_new_weights_reach_the_workers(collectors):
    ppo, randomizer = learner(), DomainRandomizer(PRIOR)
    collectors.begin(randomizer, key=(0,))
    free = collectors.batch(ppo.policy)["action"][..., 0].float().mean()
    assert 0.2 < free < 0.8
    state = ppo.policy.state_dict()
    (last,) = (name for name, value in state.items() if value.shape == (2,))
    state[last].copy_(torch.tensor([100.0, -100.0]))
    assert collectors.batch(ppo.policy)["action"][..., 0].all()


def test_workers_that_die_between_batches_change_no_batch(collectors):
    unbroken, counted = training(collectors, [PRIOR, NARROW])
    killed = {(0, 2), (1, 1)}
    broken, counted_again = training(collectors, [PRIOR, NARROW], killed=killed)
    for one, other in zip(unbroken, broken, strict=True):
        assert (one.exclude("collector") == other.exclude("collector")).all()
    assert torch.equal(counted, counted_again)


def loop(collectors, *, robot=None, **options):
    randomizer = DomainRandomizer(PRIOR)
    robot_env = TransformedEnv(CartPoleEnv(2), ApplyPhysics(AttributePhysics("length")))
    return SimToRealLoop(
        make(N, randomizer),
        learner(),
        robot or SurrogateRobot(robot_env, [0.6], max_steps=STEPS),
        refinement=PosteriorRefinement(
            PRIOR,
            simulations=24,
            make_posterior=lambda prior, size: MixtureDensityPosterior(prior, size, components=1),
            networks=1,
            fit_options={"epochs": 3, "progress": False},
        ),
        statistics=SummaryStatistics(moments, duration),
        randomizer=randomizer,
        horizon=STEPS,
        episodes=2,
        updates=2,
        shared_batches=1,
        rounds=2,
        checkpoint_every=1,
        collectors=collectors,
        progress=False,
        **options,
    )


def said(turn):
    """Return everything that a round says, but its wall time."""
    mixture = turn.posterior.mixture
    return [mixture.logits, mixture.loc, mixture.scale_tril], turn.curve, turn.frames


def test_the_loop_infers_the_same_and_goes_on_to_the_same_after_a_death(collectors, tmp_path):
    here, there = list(loop(None)), list(loop(collectors))
    assert str(said(here[0])[0]) == str(said(there[0])[0])
    assert str(here[0].curve[0]) == str(there[0].curve[0])  # from the batch simulated for inference
    file = tmp_path / "checkpoint.pt"
    for turn in loop(collectors, checkpoint_file=file):
        assert str(said(turn)) == str(said(there[0]))
        os.kill(workers()[-1], signal.SIGKILL)
        break
    resumed = loop(collectors, checkpoint_file=file)
    assert resumed.resume()
    assert [str(said(turn)) for turn in resumed] == [str(said(turn)) for turn in there]


def test_logs_are_replayed_on_ray_as_here(collectors):
    randomizer = DomainRandomizer(PRIOR)
    real = first_trajectories(make(3, randomizer).rollout(STEPS, break_when_any_done=False))
    here, there = (next(iter(loop(c, robot=RecordedLogs(real)))) for c in (None, collectors))
    assert str(said(here)[0]) == str(said(there)[0])


def test_a_recipe_simulates_on_ray(cluster, tmp_path):
    recipe = Path(__file__).parent.parent / "recipes" / "sim2real_ppo.py"
    short = ["short=true", "progress=false", "rounds=1", "episodes=2", "simulations=48"]
    begun, results = [], []
    for kind in ("direct", "ray"):
        given = [*short, "baseline=false", f"collector={kind}", f"out={tmp_path / kind}"]
        command = [sys.executable, "-W", "ignore", str(recipe), *given]
        begun.append(subprocess.Popen(command, stdout=subprocess.DEVNULL))
    for kind, process in zip(("direct", "ray"), begun, strict=True):
        assert process.wait(timeout=120) == 0
        results.append(json.loads((tmp_path / kind / "result.json").read_text()))
    for name in ("posterior_mean", "posterior_sd", "log_prob_true", "frames"):
        here, there = (result["rounds"][0][name] for result in results)
        assert here == there


def test_what_a_worker_raises_is_raised_here(collectors):
    def wrong(state, action, following, mask):
        raise ArithmeticError("no such statistic")

    with pytest.raises(ArithmeticError, match="no such statistic"):
        pairs(SummaryStatistics(wrong), collectors=collectors)


class Unsendable(Exception):  # noqa: N818
    """An error that no process can read from another."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


def test_an_error_that_cannot_be_sent_is_told(collectors):
    def wrong(state, action, following, mask):
        raise Unsendable("this", "that")

    with pytest.raises(SimulationError, match=r"workers without errors, got '.*this and that"):
        pairs(SummaryStatistics(wrong), collectors=collectors)


def test_a_worker_that_always_dies_ends_the_run(cluster, tmp_path):
    mortal = {"max_restarts": 1, "max_task_retries": 1, "num_cpus": 0}
    policy = learner().policy
    made = RayCollectors(make, policy, environments=N, steps=STEPS, workers=1, worker=mortal)
    with made, pytest.raises(SimulationError, match="workers that begin and live, got 'The actor"):
        pairs(SummaryStatistics(Fatal(tmp_path, deaths=9)), collectors=made)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_worker_that_cannot_begin_says_why(cluster):
    def missing(environments):
        raise ModuleNotFoundError("no simulator here")

    policy, few = learner().policy, {"num_cpus": 0}
    with pytest.raises(SimulationError, match="ModuleNotFoundError: no simulator here"):
        RayCollectors(missing, policy, environments=N, steps=STEPS, workers=1, worker=few)


def test_a_worker_whose_environment_is_never_made_is_not_waited_for(cluster):
    def endless(environments):
        time.sleep(1000)

    given = {"environments": N, "steps": STEPS, "workers": 1, "worker": {"num_cpus": 0}}
    said = r"begin within timeout=0\.5 seconds, got '1 of 1 that have not'.*does make\(\) end"
    with pytest.raises(SimulationError, match=said):
        RayCollectors(endless, learner().policy, timeout=0.5, **given)


DEATH = """
import os, signal, sys, threading, time
from pathlib import Path
import ray
from torchrl_bayessim.ray_waiting import Waiting

def kill():
    for file in Path("/proc").glob("[0-9]*/stat"):
        name, rest = file.read_text().split("(", 1)[1].rsplit(")", 1)
        if name == "raylet" and int(rest.split()[1]) == os.getpid():
            os.kill(int(file.parent.name), signal.SIGKILL)

ray.init(num_cpus=1, object_store_memory=100 * 2**20, include_dashboard=False)
waiting = Waiting(ray, 60.0)
class Sleeper:
    def sleep(self, seconds):
        time.sleep(seconds)

asked = ray.remote(Sleeper).remote().sleep.remote(waiting.put(60))
threading.Timer(2.0, kill).start()
for ask in (lambda: waiting.answers({asked: None}), lambda: waiting.put(0)):
    try:
        ask()
    except Exception as error:
        print(type(error).__name__, error, flush=True)
os._exit(0)  # rather than wait for what is dead
"""


def test_the_death_of_ray_itself_is_told(cluster):
    command = [sys.executable, "-W", "ignore", "-c", DEATH]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    told = [line for line in ended.stdout.splitlines() if line.startswith("Sim")]
    assert len(told) == 2
    assert all("SimulationError expected Ray's node manager on this m" in line for line in told)


def test_what_cannot_be_done_is_refused(cluster, collectors):
    policy = learner().policy
    with pytest.raises(ValueError, match="workers that divides the 6 environments, got 4"):
        RayCollectors(make, policy, environments=6, steps=3, workers=4)
    with pytest.raises(ValueError, match="a cluster with 6 processors for the workers, got '2'"):
        RayCollectors(make, policy, environments=6, steps=3, workers=6)
    for wrong, error, said in (
        ({"workers": 2.0}, TypeError, r"a whole number of workers, got 2\.0"),
        ({"workers": 0}, ValueError, "workers to be positive, got 0"),
        ({"environments": None}, TypeError, "a whole number of environments, got None"),
        ({"make": None}, TypeError, "make, a function of the number of environments"),
        ({"policy": "random"}, TypeError, "a policy, a TensorDictModule, got 'str'"),
    ):
        given = {"make": make, "policy": policy, "environments": 6, "steps": 3} | wrong
        with pytest.raises(error, match=said):
            RayCollectors(given.pop("make"), given.pop("policy"), **given)
    randomizer = DomainRandomizer(PRIOR)
    with pytest.raises(ValueError, match="6 environments of 10 steps, as on Ray, got '4 of 10'"):
        simulate(
            make(4, randomizer),
            None,
            SummaryStatistics(moments),
            randomizer,
            pairs=4,
            max_steps=3,
            collectors=collectors,
        )


def test_an_environment_with_other_physics_is_refused(collectors):
    randomizer = DomainRandomizer(BoxPrior({"masspole": (0.1, 1.0)}))
    physics = ApplyPhysics(AttributePhysics("masspole"))
    other = TransformedEnv(CartPoleEnv(N), Compose(physics, randomizer, StepCounter(50)))
    asked = {"pairs": 4, "max_steps": STEPS, "collectors": collectors}
    with pytest.raises(ValueError, match=r"as make\(\) gives on Ray, with columns of 'episode_r"):
        simulate(other, None, SummaryStatistics(moments), randomizer, **asked)
    whole = TransformedEnv(other, RewardSum())
    with pytest.raises(ValueError, match=r"with parameters in 'theta': length, got 'masspole'"):
        simulate(whole, None, SummaryStatistics(moments), randomizer, **asked)


def limited(environments, randomizer=None, steps=5):
    """The same environments whose episodes end earlier."""
    physics = ApplyPhysics(AttributePhysics("length"))
    transforms = [physics, randomizer or DomainRandomizer(PRIOR), StepCounter(steps), RewardSum()]
    return TransformedEnv(CartPoleEnv(environments), Compose(*transforms))


def heavy(environments, randomizer=None):
    """The same environments whose poles are heavier."""
    env = make(environments, randomizer)
    env.base_env.set_parameters(
        {"masspole": torch.full((environments,), 0.2)}, torch.ones(environments).bool()
    )
    return env


@pytest.mark.parametrize(("other", "said"), [(limited, "step_count"), (heavy, "observation")])
def test_an_environment_that_simulates_anything_else_is_refused(collectors, other, said):
    randomizer = DomainRandomizer(PRIOR)
    before = randomizer.get_extra_state()
    with pytest.raises(
        ValueError, match=f"simulates what make.. does on Ray, bit for bit.*{said}.*in step"
    ):
        collectors.check(other(N, randomizer))
    after = randomizer.get_extra_state()
    assert str(before) == str(after)
    assert randomizer.source is PRIOR


def test_what_later_steps_show_is_compared_as_far_as_pairs_reach(collectors):
    collectors.check(longer := limited(N, steps=12))  # longer than T
    collectors.check(longer)
    with pytest.raises(ValueError, match="bit for bit"):
        collectors.check(longer, trajectory=20)


class Sleeping:
    """A statistic that never ends, in the first process that computes it."""

    def __init__(self, folder):
        self.folder, self.home = folder, os.getpid()

    def __call__(self, state, action, following, mask):
        if os.getpid() != self.home and not (self.folder / "slept").exists():
            (self.folder / "slept").touch()
            time.sleep(1000)
        return moments(state, action, following, mask)


def test_a_worker_that_hangs_is_ended_and_its_share_simulated_again(
    collectors, tmp_path, monkeypatch
):
    monkeypatch.setattr(collectors._waiting, "timeout", 1.0)  # less than a start takes
    monkeypatch.setattr(collectors._waiting, "start", 3.5)
    before = set(workers())
    there = pairs(SummaryStatistics(Sleeping(tmp_path)), collectors=collectors)
    assert (tmp_path / "slept").exists()
    assert before - set(workers())
    assert torch.equal(pairs(SummaryStatistics(moments))["summary"], there["summary"])


@pytest.mark.parametrize(
    ("wrong", "error", "said"),
    [
        ({"worker": 3}, TypeError, "worker= to be a mapping of Ray's options, got 'int'"),
        ({"cluster": 3}, TypeError, "cluster= to be a mapping of Ray's options, got 'int'"),
        ({"worker": {"num_cpus": None}}, TypeError, r"worker\['num_cpus'\]"),
        ({"worker": {"max_restarts": "x"}}, TypeError, r"worker\['max_restarts'\]"),
        ({"environments": 10**9}, ValueError, "batches of at most 100000000 frames"),
        ({"timeout": 0}, ValueError, "timeout"),
        ({"timeout": "long"}, TypeError, "timeout"),
    ],
)
def test_wrong_options_are_refused(cluster, wrong, error, said):
    given = {"environments": N, "steps": STEPS, "workers": 1} | wrong
    with pytest.raises(error, match=said):
        RayCollectors(make, learner().policy, **given)


def test_wrong_questions_are_refused(collectors):
    statistics = SummaryStatistics(moments)
    asked = {"steps": 3, "key": (0,), "progress": False}
    with pytest.raises(ValueError, match=r"theta of shape \(N, D\), at least one row, got \(0, 1"):
        collectors.summaries(None, statistics, torch.zeros(0, 1), **asked)
    with pytest.raises(TypeError, match="theta, a tensor"):
        collectors.summaries(None, statistics, [[0.5]], **asked)
    with pytest.raises(ValueError, match="steps to be positive, got 0"):
        collectors.summaries(None, statistics, torch.ones(2, 1), **(asked | {"steps": 0}))
    with pytest.raises(TypeError, match="a TorchRL environment, got 'NoneType'"):
        collectors.check(None)
    with pytest.raises(TypeError, match="a DomainRandomizer, got 'NoneType'"):
        collectors.begin(None, key=(0,))
    collectors.begin(DomainRandomizer(PRIOR), key=(0,))
    with pytest.raises(TypeError, match="a policy, a TensorDictModule, got 'NoneType'"):
        collectors.batch(None)


def test_options_that_ray_does_not_know_are_refused(monkeypatch):
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install '.[ray]'")
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    with pytest.raises(ValueError, match=r"cluster= to be options of ray.init, got .*processors"):
        RayCollectors(make, learner().policy, environments=N, steps=3, cluster={"processors": 2})


def test_without_ray_its_extra_is_named(monkeypatch):
    monkeypatch.setattr(ray_collectors, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"the package ray, got 'none'.*torchrl_bayessim\[ray\]"):
        RayCollectors(make, learner().policy, environments=6, steps=3)


def test_collectors_that_were_shut_down_say_so(collectors, monkeypatch):
    monkeypatch.setattr(collectors, "_ended", True)  # as shutdown() leaves them
    with pytest.raises(RuntimeError, match=r"workers, got 'collectors that were shut down'"):
        pairs(SummaryStatistics(moments), collectors=collectors)
