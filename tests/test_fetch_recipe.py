"""The Fetch job as users run it, on the smallest task."""

import dataclasses
import json
import sys
from pathlib import Path

import pytest
import torch

RECIPES = Path(__file__).parent.parent / "recipes"
TINY = ["task=fetch_reach", "short=true", "progress=false", "rounds=1", "simulations=8"]
LATER = {"collecting": False, "prior": True}  # whether its learning rate falls
LEARNER = ["critic_sees_physics=true", "algorithm=td3"]


@pytest.fixture(scope="module")
def recipes():
    """Make the recipes importable, and clean up after."""
    sys.path.insert(0, str(RECIPES))
    yield
    sys.path.remove(str(RECIPES))


@pytest.fixture(scope="module")
def run(recipes):
    import recipe
    import sim2real_ddpg_her

    def run(*arguments):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["sim2real_ddpg_her.py", *arguments])
            recipe.main(sim2real_ddpg_her.Sim2RealFetch, sim2real_ddpg_her.job)

    return run


@pytest.fixture(scope="module")
def finished(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fetch")
    run(*TINY, *LEARNER, f"out={folder}")
    return folder


@pytest.mark.slow
def test_the_same_seed_gives_the_same_numbers(finished, run, same_numbers, tmp_path):
    run(*TINY, *LEARNER, f"out={tmp_path / 'again'}")
    same_numbers(tmp_path / "again", finished)


def test_the_result_has_what_others_read(finished):
    result = json.loads((finished / "result.json").read_text())
    assert {"task", "parameters", "true", "rounds", "baseline", "checkpoint"} <= result.keys()
    assert result["algorithm"] == "TD3+HER, critic sees theta"
    assert result["parameters"] == ["damping"]
    (entry,) = result["rounds"]
    assert entry.keys() == {
        *("round", "posterior_mean", "posterior_sd", "log_prob_true", "nats_over_prior"),
        *("real_return", "real_return_ci", "sim_return", "frames", "simulations", "seconds"),
    }
    assert entry["frames"] == 8 * 50 * (2 + 1)  # two batches, and one that inference shared
    assert 10 <= entry["posterior_mean"][0] <= 200
    low, high = entry["real_return_ci"]
    assert 0 <= low <= entry["real_return"] <= high <= 1
    assert result["gain"].keys() == {"real_return", "real_return_ci"}


def test_the_loop_forgets_what_was_collected_under_the_prior(finished):
    from torchrl_bayessim.checkpoint import load

    frames = json.loads((finished / "result.json").read_text())["rounds"][-1]["frames"]
    replayed = {
        name: len(load(finished / f"{name}.pt")["learner"]["buffer"]["entries"]["action"])
        for name in ("collecting", "checkpoint", "prior")
    }
    assert replayed["collecting"] == 2 * 8 * 50
    assert replayed["checkpoint"] == frames
    assert replayed["prior"] == replayed["collecting"] + frames  # the same prior: kept


def test_the_learning_rate_of_the_baseline_falls_as_in_the_loop(finished):
    from torchrl_bayessim import checkpoint

    plans = {name: checkpoint.load(finished / f"{name}.pt")["plan"] for name in LATER}
    assert {name: plan["decays"] for name, plan in plans.items()} == LATER


def test_learning_curves_go_on_where_the_collecting_policy_ends(finished, recipes):
    from sim2real_ddpg_her import Run, Sim2RealFetch, chosen
    from torch import tensor

    task = chosen(Sim2RealFetch(task="fetch_reach", short=True))
    run = Run(task, tensor([50.0]), Sim2RealFetch(short=True), finished)
    kept = json.loads((finished / "rounds.json").read_text())
    curves = run.joined({"posterior": kept[-1]["curve"]})
    assert [point["frames"] for point in curves["prior, collecting"]] == [400, 800]
    assert [point["frames"] for point in curves["posterior"]] == [1200, 1600, 2000]


def rendered(name):
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    env = gymnasium.make(name, render_mode="rgb_array", width=64, height=64)
    env.reset()
    picture = env.render()
    env.close()
    return picture


def test_pictures_and_the_film_are_drawn(finished, moves):
    from matplotlib.image import imread

    for name in ("posterior", "posterior_zoom", "learning", "return"):
        assert imread(finished / f"{name}.png")[..., :3].std() > 0.01
    film = json.loads((finished / "result.json").read_text())["video"]
    if film is None:
        with pytest.raises(Exception, match=r"."):  # else the film's own code has failed
            rendered("FetchReach-v4")
        pytest.skip("nothing renders here")
    moves(film, pictures=50)


def test_a_finished_run_resumes_to_the_same_result(finished, run):
    earlier = json.loads((finished / "result.json").read_text())
    run(f"resume={finished}", "progress=false")
    again = json.loads((finished / "result.json").read_text())
    del earlier["provenance"], again["provenance"]
    assert again == earlier


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("task=fetch_pusk", "got 'fetch_pusk'. Available: fetch_push (did you mean this?)"),
        ("warmup=-3", "expected batches, warmup= not to be negative, got -3"),
        ("episodes=0", "expected episodes= to be positive, got 0"),
        ("preset=papr", "got 'papr'. Available: paper (did you mean this?)"),
        ("algorithm=td4", "got 'td4'. Available: td3 (did you mean this?)"),
        ("truth=true", "expected a truth, got 'True'"),
    ],
)
def test_bad_settings_are_explained(arguments, said, run, capsys, tmp_path_factory):  # noqa: PLR0917
    with pytest.raises(SystemExit, match="2"):
        run("short=true", arguments, f"out={tmp_path_factory.mktemp('bad')}")
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("sim2real")]
    assert said in line


def test_the_paper_preset_has_the_original_budget(recipes):
    from sim2real_ddpg_her import Sim2RealFetch, chosen

    task = chosen(Sim2RealFetch(preset="paper", rounds=2))
    batches = task.warmup + 2 * task.updates
    assert batches * task.environments == 200 * 100
    assert batches * task.environments * task.horizon * task.ddpg["updates_per_frame"] == 400_000
    assert (1 - task.ddpg["tau"]) ** 40 == pytest.approx(0.95)


def test_the_paper_preset_trains_from_its_first_batch_on(recipes):
    from fetch_tasks import FETCH, as_preset

    task = as_preset(FETCH["fetch_reach"], "paper")
    env = task.make(task.environments, seed=0, randomizer=None)
    learner = task.learner(env)
    with torch.no_grad():
        report = learner.update(env.rollout(task.horizon, learner.policy), key=(0,))
    assert report["updates"] == 160


def test_whether_the_critic_sees_the_physics_can_be_said_for_every_task(recipes):
    from fetch_tasks import FETCH, with_learner

    for task in FETCH.values():
        assert with_learner(task, critic_sees_physics=True).ddpg["critic_keys"] == ("theta",)
        assert with_learner(task, critic_sees_physics=False).ddpg["critic_keys"] == ()


def test_training_goes_on_from_its_checkpoint_to_the_same_numbers(recipes, tmp_path):
    from fetch_tasks import FETCH
    from training import Plan, train

    from torchrl_bayessim.transforms import DomainRandomizer

    task = FETCH["fetch_reach"]

    def trained(file, stop_at=None):
        randomizer = DomainRandomizer(task.prior)
        env = task.make(2, seed=0, randomizer=randomizer)
        small = {"hidden": (16,), "batch_size": 32, "updates_per_frame": 0.02}
        learner = task.learner(env, seed=0, **small)
        calls = []

        def score(policy):
            calls.append(policy)
            if len(calls) == stop_at:
                raise KeyboardInterrupt
            return -abs(len(calls) - 2.0)

        plan = Plan(5, task.horizon, keep_every=2, score_every=1, file=file)
        return train(learner, env, randomizer, plan, key=(0,), score=score, progress=False), learner

    whole, learner = trained(None)
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "kept.pt", stop_at=4)  # in the second chunk of two batches
    resumed, again = trained(tmp_path / "kept.pt")
    timed = ("seconds", "cpu_seconds", "score", "return")
    strip = [
        [{k: v for k, v in p.items() if k not in timed} for p in t.curve] for t in (whole, resumed)
    ]
    assert strip[0] == strip[1]
    assert len(whole.curve) == 5
    for name, value in learner.policy.state_dict().items():
        assert torch.equal(value, again.policy.state_dict()[name])
    # the second score was the best
    assert not all(torch.equal(v, learner.policy.state_dict()[n]) for n, v in whole.best.items())


def test_a_checkpoint_of_another_training_is_refused(recipes, tmp_path):
    from fetch_tasks import FETCH
    from training import Plan, train

    from torchrl_bayessim import checkpoint
    from torchrl_bayessim.transforms import DomainRandomizer

    task, file = FETCH["fetch_reach"], tmp_path / "kept.pt"

    def trained(key=(0,), plan=None, **options):
        randomizer = DomainRandomizer(task.prior)
        env = task.make(2, seed=0, randomizer=randomizer)
        small = {"hidden": (16,), "batch_size": 32, "updates_per_frame": 0.02, **options}
        learner = task.learner(env, seed=0, **small)
        plan = Plan(**{"batches": 1, "horizon": task.horizon, "file": file} | (plan or {}))
        return train(learner, env, randomizer, plan, key=key, progress=False).curve

    curve = trained()
    assert trained() == curve
    for options, match in (
        ({"gamma": 0.9}, r"kept\.pt made with gamma=0\.9, got 0\.98\. Try: the settings"),
        ({"hidden": (8,)}, r"kept\.pt made with hidden=\[8\], got \[16\]"),
        ({"plan": {"batches": 2}}, r"kept\.pt made with batches=2, got 1"),
        ({"plan": {"horizon": 100}}, r"kept\.pt made with horizon=100, got 50"),
        ({"plan": {"decays": False}}, r"kept\.pt made with decays=False, got True"),
        ({"key": (1,)}, r"kept\.pt made with key=\(1,\), got \(0,\)"),
    ):
        with pytest.raises(ValueError, match=match):
            trained(**options)
    older = checkpoint.load(file)
    del older["settings"], older["plan"], older["key"], older["learner"]["settings"]
    checkpoint.save(file, older)
    assert trained(gamma=0.9) == curve
    with pytest.raises(ValueError, match=r"kept\.pt made with this learner's networks, got.*size"):
        trained(hidden=(8,))


@pytest.mark.parametrize("decays", [True, False])
def test_the_learner_is_told_how_far_a_training_is_if_its_rate_decays(recipes, decays):
    from fetch_tasks import FETCH
    from training import Plan, train

    from torchrl_bayessim.transforms import DomainRandomizer

    task, told = FETCH["fetch_reach"], []
    randomizer = DomainRandomizer(task.prior)
    env = task.make(2, seed=0, randomizer=randomizer)
    learner = task.learner(env, seed=0, hidden=(16,), batch_size=32, updates_per_frame=0.02)
    begin = learner.begin
    learner.begin = lambda *batch, progress, **key: begin(
        *batch, progress=told.append(progress) or progress, **key
    )
    train(learner, env, randomizer, Plan(4, 50, decays=decays), key=(0,), progress=False)
    assert told == ([0.0, 0.25, 0.5, 0.75] if decays else [0.0] * 4)


def test_both_recipes_ask_whether_the_parameters_do_anything(recipes, tmp_path):
    import robustness
    import robustness_study
    import sim2real_ddpg_her
    from fetch_tasks import FETCH

    from torchrl_bayessim.errors import PhysicsError
    from torchrl_bayessim.physics.mujoco import MujocoPhysics

    alone = dataclasses.replace(  # the table's own friction is larger, and wins
        FETCH["fetch_push"],
        physics=lambda: MujocoPhysics(friction="geom_friction[object0,0]"),
        environments=2,
    )
    truth = torch.tensor([0.3])
    settings = robustness.Robustness(task="fetch_push", progress=False, domains=0)
    with pytest.raises(PhysicsError, match="friction"):
        robustness_study.Study(alone, truth, settings, tmp_path, seed=0)
    settings = sim2real_ddpg_her.Sim2RealFetch(task="fetch_push", progress=False)
    with pytest.raises(PhysicsError, match="friction"):
        sim2real_ddpg_her.Run(alone, truth, settings, tmp_path)


def test_a_score_is_of_the_same_episodes_for_every_policy(recipes):
    from scoring import Score
    from tasks import TASKS, Task

    class Told(Task):
        def scores(self, env, policy):
            del policy
            return env.reset()["theta"].sum(-1)

    task = TASKS["cartpole"]
    told = Told(**{name: getattr(task, name) for name in task.__match_args__})
    score = Score(told, told.prior, episodes=16, seed=3)
    first = score(None)
    assert first.std() > 0.1
    assert torch.equal(first, score(None))


def test_a_gain_is_the_posteriors_over_the_priors(recipes):
    from rounds import compare

    found = compare(torch.tensor([3.0, 5.0]), torch.tensor([1.0, 1.0]), real=(1.0, [0.0, 2.0]))
    assert found["gain"]["real_return"] == 3.0
    assert found["baseline"]["real_return"] == 1.0


def test_a_thinned_curve_has_means_and_carries_them_over_long_episodes(recipes):
    from training import first_solved, thinned

    returns = [1.0, 3.0, float("nan"), float("nan"), float("nan"), 9.0]
    curve = [
        {"frames": 10.0 * i, "return": value, "seconds": 0.0, "cpu_seconds": 0.0}
        for i, value in enumerate(returns)
    ]
    shown = thinned(curve, 3)
    assert [point["return"] for point in shown] == [2.0, 2.0, 9.0]
    assert [point["frames"] for point in shown] == [10.0, 30.0, 50.0]
    assert first_solved(shown, 8.5)["frames"] == 50.0
    assert first_solved(shown, 9.5) is None
    scored = [{**point, "score": 0.5} if point["frames"] == 20 else point for point in curve]
    assert [point["frames"] for point in thinned(scored, 3)] == [20.0]
