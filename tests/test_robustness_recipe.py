"""The figure of robustness as users make it, in its shortest setting."""

import json
import shutil
import sys
from pathlib import Path

import pytest
import torch

from torchrl_bayessim import checkpoint
from torchrl_bayessim.agents.ppo import PPO
from torchrl_bayessim.sources import Grid

RECIPES = Path(__file__).parent.parent / "recipes"
TINY = ["short=true", "progress=false", "seeds=2", "points=3", "video=false"]
SOURCES = ["task=fetch_reach", "sources=prior,posterior,oracle"]


@pytest.fixture(scope="module")
def run():
    sys.path.insert(0, str(RECIPES))
    import recipe
    import robustness

    def run(*arguments):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["robustness.py", *arguments])
            recipe.main(robustness.Robustness, robustness.job)

    yield run
    sys.path.remove(str(RECIPES))


@pytest.fixture(scope="module")
def finished(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("robustness")
    run(*TINY, *SOURCES, f"out={folder}")
    return folder


def test_curves_and_paired_differences_are_there(finished):
    from matplotlib.image import imread

    result = json.loads((finished / "result.json").read_text())
    assert {"task", "curves", "at_real"} <= result.keys()
    assert [curve["source"] for curve in result["curves"]] == ["prior", "posterior", "oracle"]
    for curve in result["curves"]:
        assert curve["grid"] == pytest.approx([10, 50, 105, 200])  # with the robot's own
        assert len(curve["return_mean"]) == len(curve["return_sd"]) == 4
        assert curve["return_mean"][1] == pytest.approx(result["at_real"][curve["source"]]["mean"])
        assert all(0 <= mean <= 1 for mean in curve["return_mean"])
        assert curve["seeds"] == 2
    assert result["under_prior"].keys() == result["at_real"].keys()
    real = result["at_real"]
    pairs = zip(real["posterior"]["values"], real["prior"]["values"], strict=True)
    assert real["posterior minus prior"]["values"] == pytest.approx([a - b for a, b in pairs])
    assert {"provenance", "posteriors"} <= result.keys()
    assert result["preset"] == "fast"
    assert all(f"out={finished}" in run["provenance"]["command"] for run in result["runs"])
    kept = {f"{source}_policy.pt" for source in ("prior", "posterior", "oracle")}
    assert {path.name for path in finished.glob("seed1/*.pt")} == kept | {"posterior_state.pt"}
    assert "| posterior minus prior |" in (finished / "table.md").read_text()
    assert imread(finished / "robustness_damping.png")[..., :3].std() > 0.01


def test_finished_policies_are_not_trained_again(finished, run, capsys):
    before = json.loads((finished / "result.json").read_text())
    run(f"resume={finished}", "progress=false")
    assert "RESULT" in capsys.readouterr().out
    after = json.loads((finished / "result.json").read_text())
    assert after["runs"] == before["runs"]


@pytest.mark.slow
def test_policies_trained_after_a_break_are_the_same(finished, run, same_numbers, tmp_path):
    """As they are whenever the seed is the same: each source's once more, of one seed or other."""
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    for gone in ("seed0/prior*", "seed1/posterior*", "seed1/oracle*"):
        for path in tmp_path.glob(gone):
            path.unlink()
    run(f"resume={tmp_path}", "progress=false")
    same_numbers(tmp_path, finished)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["task=cartpol"], "got 'cartpol'. Available: cartpole (did you mean this?)"),
        (["sources=prior,posteriori"], "got 'posteriori'. Available: posterior (did you mean"),
        (["sources=posterior"], "expected the prior among the sources"),
        (["algorithm=td3"], "algorithm or a critic's view for Fetch tasks only, got 'td3'"),
        (["critic_sees_physics=true"], "for Fetch tasks only, got 'critic_sees_physics=True'"),
        (["preset=weak"], "expected a preset, got 'weak'. Available: paper, strong"),
        (["task=fetch_push", "preset=strong"], "got 'strong'. Available: fast, wide, paper"),
        (
            ["task=fetch_slide", "preset=wide"],
            "that changes something, got 'wide on FetchSlide",
        ),
        (["truth=0.5"], "truth= as numbers within the prior, length in [0.1, 2], masspole in [0.1"),
        (["truth=0.5,3"], "as numbers within the prior, length in [0.1, 2], masspole in [0.1, 2]"),
        (["truth=0.5,heavy"], "got '0.5,heavy'"),
        (["domains=-2"], "expected at least -1 domains=, got -2"),
        (["real_episodes=0"], "expected real_episodes= to be positive, got 0"),
        (["episodes=0"], "expected episodes= to be positive, got 0"),
        (["simulations=1"], "expected at least 8 simulations=, got 1"),
        (["refinements=-1"], "expected refinements= not to be negative, got -1"),
        (["checkpoint=first"], "expected a checkpoint, got 'first'. Available: best, last"),
        (["points=-1"], "expected points= to be positive, got -1"),
        (["seeds=-1"], "expected seeds= not to be negative, got -1"),
        (["task=fetch_push", "batches=-1"], "expected batches= not to be negative, got -1"),
    ],
)
def test_bad_settings_are_explained(arguments, said, run, tmp_path, capsys):  # noqa: PLR0917
    with pytest.raises(SystemExit, match="2"):
        run("short=true", *arguments, f"out={tmp_path}")
    (line,) = [x for x in capsys.readouterr().err.splitlines() if x.startswith("robustness")]
    assert said in line


def test_the_table_says_what_the_critic_sees(run, tmp_path):
    asked = ["task=fetch_reach", "sources=oracle", "critic_sees_physics=true"]
    run(*TINY, *asked, f"out={tmp_path}")
    assert "DDPG+HER, critic sees theta" in (tmp_path / "table.md").read_text()


def test_the_robot_replaces_a_point_of_the_grid_that_is_its_own(run):
    import robustness_report

    grids = {"a": {"grid": [0.1, 0.2, 0.30000001], "score": [1.0, 2.0, 3.0]}}
    (curve,) = robustness_report.curves(
        [{"source": "prior", "grids": grids, "at_real": 9.0}], {"a": 0.3}
    )
    assert curve["grid"] == [0.1, 0.2, 0.3]
    assert curve["return_mean"] == [1.0, 2.0, 9.0]


CARTPOLE = ["seeds=1", "batches=3", "simulations=16", "episodes=2", "points=2", "grid_episodes=2"]
CARTPOLE += ["domains=0"]


@pytest.fixture(scope="module")
def cartpole(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cartpole")
    run(*CARTPOLE, "real_episodes=4", "progress=false", f"out={folder}")
    return json.loads((folder / "result.json").read_text()), folder


@pytest.mark.slow
def test_a_policy_of_cartpole_is_the_best_of_its_looks(cartpole):
    import robustness
    import robustness_study
    from scoring import Score

    result, folder = cartpole
    (oracle,) = [entry for entry in result["runs"] if entry["source"] == "oracle"]
    assert [point["frames"] for point in oracle["curve"]] == [256, 512, 768]
    task = robustness.chosen(robustness.Robustness())
    looks = Score(
        task, Grid(torch.tensor([[0.5, 0.1]])), episodes=robustness_study.CHOOSING, seed=7
    )
    learner = PPO(task.make(2, seed=0, randomizer=None), **task.ppo)
    learner.policy.load_state_dict(checkpoint.load(folder / "seed0" / "oracle_policy.pt"))
    best = max(point["score"] for point in oracle["curve"])
    assert looks(learner.policy).mean().item() == pytest.approx(best)
    told = (folder / "table.md").read_text()
    assert "policies are each the best of its looks under its own physics" in told


def test_the_last_policy_can_be_asked_for(run, tmp_path):
    run(*CARTPOLE, "sources=oracle", "checkpoint=last", "progress=false", f"out={tmp_path}")
    (oracle,) = json.loads((tmp_path / "result.json").read_text())["runs"]
    assert all("score" not in point for point in oracle["curve"])
    assert "policies are each the last" in (tmp_path / "table.md").read_text()


@pytest.mark.slow
def test_cartpoles_posterior_is_refined_once(cartpole, run, tmp_path):
    result, folder = cartpole
    assert result["inference_frames"] == 2 * 16 * 2 * 128
    for name in ("prior.json", "prior_policy.pt"):  # which collects: the same real trajectories
        (tmp_path / "seed0").mkdir(exist_ok=True)
        shutil.copy(folder / "seed0" / name, tmp_path / "seed0" / name)
    sources = ["sources=prior,posterior", "refinements=1", "progress=false"]
    run(*CARTPOLE, "real_episodes=4", *sources, f"out={tmp_path}")
    unrefined = json.loads((tmp_path / "result.json").read_text())
    assert unrefined["inference_frames"] == 16 * 2 * 128
    first, refined = (found["posteriors"][0]["posterior"] for found in (unrefined, result))
    assert refined["mean"] != pytest.approx(first["mean"], rel=1e-3)


@pytest.mark.parametrize(("score", "told"), [("success", "0.9 [0.8, 1]"), ("return", "[0.8, 1.2]")])
def test_intervals_of_shares_end_at_one(run, score, told):
    import robustness_report

    entry = {"mean": 0.9, "low": 0.8, "high": 1.2, "values": [0.9], "sd": 0.1}
    result = {"task": "t", "algorithm": "a", "seeds": 1, "frames": 1, "score": score, "runs": []}
    result |= {"real_episodes": 1, "parameters": [], "true": [], "posteriors": []}
    result |= {"at_real": {"prior": entry}, "under_prior": {"prior": entry}, "inference_frames": 0}
    assert told in robustness_report.table(result)
    assert "besides" not in robustness_report.table(result)


def test_a_short_run_says_that_its_policies_are_the_last(finished):
    assert json.loads((finished / "result.json").read_text())["checkpoint"] == "last"
    assert "policies are each the last" in (finished / "table.md").read_text()


@pytest.mark.slow
def test_a_table_says_what_its_intervals_leave_out(finished, cartpole):
    runs = json.loads((finished / "result.json").read_text())["runs"]
    shares = [entry[where] for entry in runs for where in ("at_real", "under_prior")]
    error = max((p * (1 - p) / 8) ** 0.5 for p in shares)
    assert f"by a standard error of {error:.3f} at most" in (finished / "table.md").read_text()
    assert "other episodes would move them together" in (cartpole[1] / "table.md").read_text()


def test_a_finished_run_takes_the_users_own_words_again(finished, run):
    run(f"resume={finished}", "points=3", "simulations=512", "progress=false")


def test_what_the_posterior_costs_beside_training_is_told(finished):
    assert "took 2,400 frames of simulation besides" in (finished / "table.md").read_text()


def test_intervals_are_students(run):
    import robustness_report

    runs = [
        {"source": source, "at_real": score, "under_prior": -score}
        for source, scores in {"prior": (1, 2, 3), "posterior": (3, 3, 6)}.items()
        for score in scores
    ]
    found = robustness_report.compared(runs, "at_real")["posterior minus prior"]
    assert found["values"] == [2, 1, 3]
    elsewhere = robustness_report.compared(runs, "under_prior")
    assert elsewhere["posterior minus prior"]["values"] == [-2, -1, -3]
    # mean 2, standard deviation 1, and the 97.5 % quantile of t with 2 degrees of freedom, 4.3027
    assert found["high"] - found["mean"] == pytest.approx(4.3027 / 3**0.5, rel=1e-4)


ROBOT = torch.tensor([1.5, 1.2])  # a half-length and a mass that are not nominal


@pytest.mark.slow
def test_seeds_that_ran_by_themselves_become_one_figure(finished, run, same_numbers, tmp_path):
    asked = [*TINY[:2], *TINY[3:], "task=fetch_reach", "sources=oracle"]
    for seed in ("seed0", "seed1"):  # which ran one after the other
        (tmp_path / "together" / seed).mkdir(parents=True)
        for path in finished.glob(f"{seed}/oracle*"):
            shutil.copy(path, tmp_path / "together" / seed)
    run(*asked, "seeds=2", f"out={tmp_path / 'together'}")
    run(*asked, "seeds=1", f"out={tmp_path / 'apart'}")
    for more in (["seed=1"], ["seed=0", "seeds=2"]):
        run(f"resume={tmp_path / 'apart'}", *more, "progress=false")
    same_numbers(tmp_path / "apart", tmp_path / "together")


@pytest.mark.slow
def test_the_robot_may_be_another(run, tmp_path):
    asked = ["task=fetch_reach", "sources=oracle", "truth=120", f"out={tmp_path}"]
    run(*TINY, *asked)
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["true"] == [120]
    (curve,) = result["curves"]
    assert curve["grid"] == [10, 105, 120, 200]
    assert curve["return_mean"][2] == pytest.approx(result["at_real"]["oracle"]["mean"])


def test_a_table_tells_the_code_of_policies_from_several_commits(finished, run):
    import robustness_report

    result = json.loads((finished / "result.json").read_text())
    assert "at commits" not in robustness_report.table(result)
    for entry in result["runs"]:
        if entry["source"] == "oracle":
            del entry["provenance"]
        else:
            entry["provenance"]["commit"] = "abc"
    told = "Policies were trained at commits abc (prior, posterior), older code (oracle)."
    assert told in robustness_report.table(result)


def a_study(folder, **settings):
    import robustness
    from robustness_study import Study

    small = {"short": True, "progress": False, "video": False, "points": 2, "real_episodes": 8}
    given = robustness.Robustness(**(small | {"grid_episodes": 2} | settings))
    task = robustness.chosen(given)
    given.refinements, given.episodes = 1, 2
    return Study(task, ROBOT, given, folder, seed=0)


@pytest.mark.slow
def test_a_policy_is_trained_under_the_source_that_its_name_says(run, tmp_path):
    del run
    study = a_study(tmp_path, simulations=128, domains=0)
    trained_under, seen = {}, []

    class Watching(PPO):
        def update(self, batch, **options):
            seen.append(batch["theta"])
            return super().update(batch, **options)

    study._learner = lambda: Watching(study.env, seed=0, **study.task.ppo)
    for source in ("prior", "posterior", "oracle", "nominal"):
        seen.clear()
        study.scored(source)
        trained_under[source] = torch.cat(seen).flatten(0, -2).unique(dim=0)
    assert study.task.prior.log_prob(trained_under["prior"]).isfinite().all()
    assert trained_under["prior"].std(0).min() > 0.3  # all of the box
    for source, physics in {"oracle": ROBOT, "nominal": torch.tensor([0.5, 0.1])}.items():
        assert (trained_under[source] == physics).all()
    moments = json.loads((tmp_path / "posterior.json").read_text())["posterior"]
    away = trained_under["posterior"].mean(0) - torch.tensor(moments["mean"])
    spread = torch.tensor(moments["sd"])
    assert (away.abs() < 4 * spread / len(trained_under["posterior"]) ** 0.5).all()
    assert spread[0] < 0.7 * trained_under["prior"].std(0)[0]  # which prior draws would not have
    assert trained_under["posterior"].std(0)[0] < 0.7 * trained_under["prior"].std(0)[0]


@pytest.mark.slow
def test_domains_are_drawn_once_and_told(run, tmp_path):
    run(*CARTPOLE, "domains=2", "sources=prior", "progress=false", "video=false", f"out={tmp_path}")
    assert "each policy saw 2 domains" in (tmp_path / "table.md").read_text()
    study, seen = a_study(tmp_path / "own", domains=2), []

    class Watching(PPO):
        def update(self, batch, **options):
            seen.append(batch["theta"])
            return super().update(batch, **options)

    study._learner = lambda: Watching(study.env, seed=0, **study.task.ppo)
    study._trained("prior", study._learner())
    assert len(torch.cat(seen).flatten(0, -2).unique(dim=0)) == 2


def test_no_episode_that_is_reported_chose_a_checkpoint(run, tmp_path, monkeypatch):
    del run
    import robustness_study

    asked = []

    class Noted(robustness_study.Score):
        def __init__(self, *task_and_source, seed, **options):
            asked.append(seed)
            super().__init__(*task_and_source, seed=seed, **options)

    monkeypatch.setattr(robustness_study, "Score", Noted)
    study = a_study(tmp_path)
    study._select()
    (choosing,) = asked
    study._scores(study._learner().policy)
    assert len(asked) > 3
    assert choosing not in asked[1:]
    assert study.seed not in asked


def test_the_priors_own_policy_collects_at_the_robot(run, tmp_path, monkeypatch):
    del run
    import robustness_study

    acting = []

    class Watched(robustness_study.SurrogateRobot):
        def rollouts(self, policy, **options):
            acting.append({n: v.clone() for n, v in policy.state_dict().items()})
            return super().rollouts(policy, **options)

    monkeypatch.setattr(robustness_study, "SurrogateRobot", Watched)
    study = a_study(tmp_path, simulations=32)
    with pytest.raises(ValueError, match=r"prior's policy, which collects, got .*NotFound.*Try"):
        study._posterior()
    study.scored("prior")
    study._posterior()
    kept = checkpoint.load(tmp_path / "prior_policy.pt")
    assert kept.keys() == acting[0].keys()
    assert all(torch.equal(kept[name], acting[0][name]) for name in kept)
    (tmp_path / "posterior_state.pt").unlink()
    checkpoint.save(
        tmp_path / "prior_policy.pt", {n: v.repeat(2) for n, v in kept.items() if v.ndim == 1}
    )
    with pytest.raises(ValueError, match=r"which collects, got .*RuntimeError.*delete prior\.json"):
        study._posterior()


def test_scores_stand_at_their_own_point_of_the_grid(run, tmp_path):
    """Of a task whose score tells its physics, every score is known."""
    del run
    from tasks import Task

    class Told(Task):
        def scores(self, env, policy):
            del policy
            return env.reset()["theta"] @ torch.tensor([1.0, 100.0])

    study = a_study(tmp_path, points=4, grid_episodes=3)
    study.task = Told(**{name: getattr(study.task, name) for name in study.task.__match_args__})
    found = study._scores(None)
    for name, (length, mass) in {"length": (1.0, 0.0), "masspole": (0.0, 1.0)}.items():
        grid = found["grids"][name]["grid"]
        assert grid == pytest.approx(torch.linspace(0.1, 2.0, 4).tolist())
        others = 100 * 1.2 if length else 1.5
        expected = [length * value + 100 * mass * value + others for value in grid]
        assert found["grids"][name]["score"] == pytest.approx(expected)
    assert found["at_real"] == pytest.approx(1.5 + 100 * 1.2)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["task=fetch_reach", "points=4"], "a run with points=4, got 3"),
        (["task=fetch_reach", "algorithm=td3"], "a run with algorithm=TD3+HER, got 'DDPG+HER'"),
        (["task=fetch_push"], "a run with task=fetch_push, got 'fetch_reach'"),
        (["task=fetch_reach", "matmul_precision=medium"], "matmul_precision=medium, got 'highest'"),
        (["task=fetch_reach", "batches=5"], "a run with frames=1000, got 4800"),
    ],
)
def test_policies_of_another_run_are_refused(arguments, said, finished, run, tmp_path, capsys):  # noqa: PLR0917
    shutil.copytree(finished / "seed0", tmp_path / "seed0")
    with pytest.raises(SystemExit, match="2"):
        run(*TINY, "sources=prior,posterior", *arguments, f"out={tmp_path}")
    assert said in capsys.readouterr().err


def test_a_posterior_of_another_run_is_refused(finished, run, tmp_path, capsys):
    shutil.copytree(finished / "seed0", tmp_path / "seed0")
    (tmp_path / "seed0" / "posterior.json").unlink()
    state = checkpoint.load(tmp_path / "seed0" / "posterior_state.pt")
    state["made_by"]["simulations"] = 99
    checkpoint.save(tmp_path / "seed0" / "posterior_state.pt", state)
    with pytest.raises(SystemExit, match="2"):
        run(*TINY, *SOURCES, f"out={tmp_path}")
    assert "posterior_state.pt of a run with simulations=24, got 99" in capsys.readouterr().err


@pytest.mark.parametrize(
    "damage", [{"at_real": None}, {"curve": []}, {"grids": {}}, {"under_prior": "0.3"}]
)
def test_a_file_without_scores_is_refused(damage, finished, run, tmp_path, capsys):  # noqa: PLR0917
    shutil.copytree(finished / "seed0", tmp_path / "seed0")
    kept = tmp_path / "seed0" / "prior.json"
    kept.write_text(json.dumps(json.loads(kept.read_text()) | damage))
    with pytest.raises(SystemExit, match="2"):
        run(*TINY, *SOURCES, f"out={tmp_path}")
    assert "expected the scores of a policy" in capsys.readouterr().err


@pytest.mark.slow
def test_the_first_seeds_policies_are_filmed(cartpole, moves):
    result, folder = cartpole
    for entry in result["runs"]:
        moves(folder / entry["video"])


def test_nominal_physics_that_are_true_are_trained_once(run, capsys):
    import robustness

    settings = robustness.Robustness()
    same, other = torch.tensor([0.5, 0.1]), torch.tensor([0.6, 0.1])
    assert robustness.chosen_sources(settings, same, same) == ["prior", "posterior", "oracle"]
    assert robustness.chosen_sources(settings, same, other)[0] == "nominal"
