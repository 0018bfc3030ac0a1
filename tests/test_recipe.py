"""The main job from its command line, as users run it."""

import json
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest
from command_line import run_here

RECIPE = Path(__file__).parent.parent / "recipes" / "sim2real_ppo.py"
TINY = ["short=true", "progress=false", "rounds=2", "episodes=2", "simulations=48"]


def start(*arguments, folder):
    environment = os.environ | {"PYTHONWARNINGS": "ignore"}
    return subprocess.Popen(
        [sys.executable, str(RECIPE), *arguments],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(*arguments, folder):
    process = start(*arguments, folder=folder)
    out, err = process.communicate(timeout=300)
    return process.returncode, out, err


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Return the folder of an unbroken run, and what it printed."""
    folder = tmp_path_factory.mktemp("finished")
    status, out, err = run(*TINY, folder=folder)
    assert status == 0, err
    (made,) = (folder / "outputs" / "sim2real_ppo").iterdir()
    return made, out


def test_the_last_line_is_the_result_and_the_file_holds_the_same(finished):
    folder, out = finished
    *_, last = out.splitlines()
    name, _, text = last.partition(" ")
    assert name == "RESULT"
    assert json.loads(text) == json.loads((folder / "result.json").read_text())


def test_the_result_has_what_others_read(finished):
    folder, _ = finished
    result = json.loads((folder / "result.json").read_text())
    assert {"task", "parameters", "true", "rounds", "baseline", "checkpoint"} <= result.keys()
    assert result["task"] == "cartpole"
    assert result["parameters"] == ["length", "masspole"]
    assert result["true"] == pytest.approx([0.5, 0.1])
    assert [entry["round"] for entry in result["rounds"]] == [1, 2]
    for entry in result["rounds"]:
        assert entry.keys() == {
            *("round", "posterior_mean", "posterior_sd", "log_prob_true", "nats_over_prior"),
            *("real_return", "real_return_ci", "sim_return", "frames", "simulations", "seconds"),
        }
        assert entry["simulations"] == 48
        low, high = entry["real_return_ci"]
        assert low <= entry["real_return"] <= high
        for name, mean in zip(result["parameters"], entry["posterior_mean"], strict=True):
            assert 0.1 <= mean <= 2.0, name
    assert result["baseline"].keys() == {"source", "real_return", "real_return_ci"}
    assert result["baseline"]["source"] == "prior"
    told = result["provenance"]
    assert {"commit", "versions", "seed", "command", "machine", "seconds"} <= told.keys()
    assert {"cores", "threads", "matmul_precision"} <= told["machine"].keys()
    assert told["seed"] == 0
    assert "short=true" in told["command"]


def test_pictures_curves_and_checkpoint_are_there(finished):
    from matplotlib.image import imread

    from torchrl_bayessim.checkpoint import load

    folder, _ = finished
    pictures = {path.stem for path in folder.glob("*.png")}
    assert {"posterior", "return"} <= pictures
    for name in pictures:
        pixels = imread(folder / f"{name}.png")
        assert min(pixels.shape[:2]) > 100
        assert pixels[..., :3].std() > 0.01, name  # something is drawn
    assert load(folder / "checkpoint.pt")["loop"]["round"] == 2
    scalars = list(folder.rglob("*.csv"))
    assert any("loss_objective" in path.name for path in scalars)
    rounds = [path.read_text().split() for path in scalars if path.parent.name == "posterior"]
    assert len(rounds) == 4  # mean and deviation of both parameters
    assert all(len(lines) == 2 for lines in rounds)
    assert all(path.read_text().strip() for path in scalars)


def test_the_policy_is_filmed(finished, moves):
    folder, _ = finished
    moves(folder / "posterior.gif", pictures=5)


@pytest.mark.slow
def test_killed_in_mid_run_it_resumes_to_the_same_files(finished, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent / "benchmarks")
    from killed import Case, run
    from written_numbers import differing, read

    folder, _ = finished
    case, broken = Case(RECIPE, TINY), tmp_path / "run"  # a whole second run in two parts
    assert not run(case, broken, until=(broken / "rounds.json").exists)  # in the second round
    assert read(broken)["checkpoint.pt/loop/round"] < 2  # and every file is whole
    assert not (broken / "result.json").exists()
    assert run(case, broken)
    assert differing(read(broken), read(folder)) == []


def test_another_recipe_leaves_a_run_alone(finished, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    shutil.copytree(finished[0], folder)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    another = RECIPE.with_name("posterior_recovery.py")
    with pytest.raises(SystemExit, match="2"):
        run_here(monkeypatch, another, "Recovery", "short=true", f"out={folder}")
    assert "a folder without a run" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_seeds_are_compared_to_the_same_numbers(finished, same_numbers, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent)
    import recipe
    import sim2real_seeds

    result = json.loads((finished[0] / "result.json").read_text())
    for name in ("one", "again"):
        for seed in range(2):  # runs that are done; what one of them does is tested above
            folder = tmp_path / name / f"seed{seed}"
            folder.mkdir(parents=True)
            result["rounds"][1]["real_return"] += seed
            (folder / "result.json").write_text(json.dumps(result))
            result["rounds"][1]["real_return"] -= seed
        arguments = ["sim2real_seeds.py", "short=true", "seeds=2", f"out={tmp_path / name}"]
        monkeypatch.setattr(sys, "argv", arguments)
        recipe.main(sim2real_seeds.Seeds, sim2real_seeds.job)
    same_numbers(tmp_path / "again", tmp_path / "one")
    told = json.loads((tmp_path / "one/result.json").read_text())
    gain = result["gain"]["real_return"] + 0.5
    assert told["gain"]["mean"] == pytest.approx(gain)


@pytest.mark.parametrize(
    ("task", "expected"),
    [("cartpole", ()), ("acrobot", ("LINK_LENGTH_2",)), ("hopper", ()), ("mountain_car", ())],
)
def test_parameters_that_change_nothing_are_told(task, expected, monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent)
    import sim2real_ppo

    assert sim2real_ppo.idle(sim2real_ppo.TASKS[task]) == expected


def test_bad_settings_end_in_one_line_and_status_2(tmp_path):
    status, out, err = run("taks=pendulum", folder=tmp_path)
    assert status == 2
    assert out == ""
    (line,) = err.splitlines()
    assert line.startswith("sim2real_ppo: expected the name of a setting, got 'taks'.")
    assert "task (did you mean this?)" in line
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Return what runs the recipe in this process and returns the one line that it ends with."""
    monkeypatch.syspath_prepend(RECIPE.parent)
    monkeypatch.chdir(tmp_path)
    import recipe
    import sim2real_ppo

    def refuse(*arguments):
        monkeypatch.setattr(sys, "argv", ["sim2real_ppo.py", *arguments])
        with pytest.raises(SystemExit, match="2"):
            recipe.main(sim2real_ppo.Sim2Real, sim2real_ppo.job)
        (line,) = capsys.readouterr().err.splitlines()
        return line

    return refuse


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("task=pendulumm", "got 'pendulumm'. Available: pendulum (did you mean this?)"),
        ("truth=nominall", "got 'nominall'. Available: nominal (did you mean this?), random"),
        ("logger=cvs", "got 'cvs'. Available: csv (did you mean this?)"),
        ("rounds=three", "expected values of the settings' types"),
        ("rounds=2.5", "expected values of the settings' types"),
        ("rounds", "expected arguments of the form key=value, got 'rounds'"),
        ("rounds=0", "expected rounds to be positive, got 0"),
        ("threads=0", "expected threads from 1 to 1024, got 0"),
        ("matmul_precision=lowest", "got 'lowest'. Available: highest, high, medium"),
        ("updates=-1", "expected updates not to be negative, got -1"),
        ("resume=nowhere", "expected the folder of a run to resume, got 'nowhere'"),
    ],
)
def test_bad_settings_are_explained(arguments, said, refused, tmp_path):
    assert said in refused(arguments)
    assert not (tmp_path / "nowhere").exists()


def test_refused_input_leaves_no_run_behind(refused, tmp_path):
    for wrong in ("task=cartpol", "rounds=0"):  # refused by the recipe, and by the loop
        assert "expected" in refused(wrong, "out=run")
        assert not (tmp_path / "run").exists()


def test_a_folder_that_holds_a_run_is_not_taken_for_another(finished, refused):
    folder, _ = finished
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    for arguments in (TINY, ["task=cartpol"]):
        said = refused(*arguments, f"out={folder}")
        assert "out= to be a folder without a run" in said
        assert f"Try: another out=, or resume={folder}" in said
    assert "seed=0, as in the run to resume" in refused(f"resume={folder}", "seed=3")
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_of_runs_that_start_together_in_one_folder_one_goes_on(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent)
    import recipe
    import sim2real_ppo

    both, exists = Barrier(2, timeout=60), Path.exists

    def looked(path):
        found = exists(path)
        both.wait()  # neither has written yet
        return found

    def begin(seed):
        try:
            return recipe.begun(sim2real_ppo.Sim2Real(seed=seed), tmp_path)
        except ValueError as error:
            return str(error)

    with monkeypatch.context() as patched, ThreadPoolExecutor(2) as pool:
        patched.setattr(Path, "exists", looked)
        started = list(pool.map(begin, range(2)))
    (seed,) = (seed for seed in range(2) if started[seed] == [tmp_path / "settings.json"])
    assert "out= to be a folder without a run" in started[1 - seed]
    assert json.loads((tmp_path / "settings.json").read_text())["seed"] == seed


def test_who_loses_leaves_the_folders_of_the_other_run(tmp_path, monkeypatch, refused):
    monkeypatch.syspath_prepend(RECIPE.parent)
    import recipe

    begun = recipe.begun

    def other_first(settings, folder):
        (folder / "empty" / "inner").mkdir(parents=True)
        (folder / "settings.json").write_text("{}")
        return begun(settings, folder)

    monkeypatch.setattr(recipe, "begun", other_first)
    assert "out= to be a folder without a run" in refused(f"out={tmp_path / 'run'}")
    assert (tmp_path / "run" / "empty" / "inner").is_dir()
    with monkeypatch.context() as patched:
        patched.setattr(Path, "exists", lambda path: False)  # as before the other made them
        assert recipe.opened(tmp_path / "run" / "empty" / "mine") == [
            tmp_path / "run" / "empty" / "mine"
        ]


@pytest.mark.parametrize("logger", ["wandb", "mlflow", "tensorboard"])
def test_a_logger_without_its_package_is_refused(logger, refused, monkeypatch):
    import sim2real_ppo

    monkeypatch.setattr(sim2real_ppo, "find_spec", lambda name: None)
    assert f"Try: pip install {logger}" in refused(f"logger={logger}")


@pytest.mark.parametrize("debug", ["true", "True", "yes", "1"])
def test_debug_shows_the_traceback_however_it_is_spelt(debug, refused, monkeypatch):
    import recipe
    import sim2real_ppo

    monkeypatch.setattr(sys, "argv", ["sim2real_ppo.py", "task=cartpol", f"debug={debug}"])
    with pytest.raises(ValueError, match="cartpol"):
        recipe.main(sim2real_ppo.Sim2Real, sim2real_ppo.job)


@pytest.mark.parametrize("spoil", ["list", "empty", "infinite", "text", "cut"])
def test_settings_that_no_run_has_noted_are_not_resumed(spoil, finished, refused, tmp_path):
    text = (finished[0] / "settings.json").read_text()
    folder = tmp_path / "spoilt"
    folder.mkdir()
    spoilt = {
        "list": "[]",
        "empty": "{}",
        "infinite": json.dumps(json.loads(text) | {"seed": "1e400"}),
        "text": json.dumps(json.loads(text) | {"rounds": "many"}),
        "cut": text[: len(text) // 2],
    }
    (folder / "settings.json").write_text(spoilt[spoil])
    assert "expected the settings of a Sim2Real run" in refused(f"resume={folder}")


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("simulations=64", "expected simulations=48, as in the run to resume, got 64"),
        ("truth=random", "expected truth=nominal, as in the run to resume, got 'random'"),
        ("out=elsewhere", "as in the run to resume, got 'elsewhere'"),
    ],
)
def test_a_run_resumes_with_its_own_settings_only(setting, said, finished, refused):
    folder, _ = finished
    assert said in refused(f"resume={folder}", setting)
    assert not Path("elsewhere").exists()


def test_a_part_that_is_kept_is_not_done_again(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent)
    from recipe import kept

    done = []

    def work():
        done.append("once")
        return {"mean": float("nan"), "seeds": (1, 2)}

    first, again = (kept(tmp_path / "parts" / "seed1.json", work) for _ in range(2))
    assert first == again == {"mean": None, "seeds": [1, 2]}
    assert done == ["once"]


@pytest.mark.parametrize("content", [b'{"mean": 1', b"", b"[1]", b"\xff\xfe", b"[" * 10**5])
def test_a_part_that_is_damaged_is_named(content, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent)
    from recipe import kept

    (tmp_path / "seed1.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"an object in JSON.*seed1\.json: .*Try: delete the file"):
        kept(tmp_path / "seed1.json", dict)


def test_workers_calculate_as_the_recipe_does(monkeypatch):
    monkeypatch.syspath_prepend(RECIPE.parent)
    import torch
    from workers import workers

    before = torch.get_float32_matmul_precision()
    try:
        torch.set_float32_matmul_precision("high")
        with workers(1, threads=1) as pool:
            assert pool.submit(torch.get_float32_matmul_precision).result() == "high"
    finally:
        torch.set_float32_matmul_precision(before)
