"""The loop that closes, as users run it in its shortest setting; and what its figures mean."""

import dataclasses
import json
import shutil
import sys
from pathlib import Path

import pytest
import torch

RECIPES = Path(__file__).parent.parent / "recipes"
SHORT = ["short=true", "progress=false", "seeds=2"]
PARAMETERS = ["body_mass[link]", "dof_damping[hinge]"]
STRENGTH = "action_delay[motor]"


@pytest.fixture(scope="module")
def modules():
    sys.path.insert(0, str(RECIPES))
    import close_the_loop
    import close_the_loop_report
    import recipe
    import upright_arm

    yield close_the_loop, close_the_loop_report, recipe, upright_arm
    sys.path.remove(str(RECIPES))


@pytest.fixture(scope="module")
def run(modules):
    close_the_loop, _, recipe, _ = modules

    def run(*arguments):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["close_the_loop.py", *arguments])
            recipe.main(close_the_loop.CloseTheLoop, close_the_loop.job)

    return run


@pytest.fixture(scope="module")
def finished(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("closed")
    run(*SHORT, f"out={folder}")
    return folder


@pytest.mark.slow
def test_the_same_seed_gives_the_same_numbers(finished, run, same_numbers, tmp_path):
    """Both are diagnosed again, and a policy of each source is trained again."""
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    for gone in ("with_0", "without_1"):
        (tmp_path / "parts" / f"{gone}.json").unlink()
    run(f"resume={tmp_path}", "progress=false")
    same_numbers(tmp_path, finished)


def test_the_effect_is_named_and_becomes_one_more_parameter(finished):
    result = json.loads((finished / "result.json").read_text())
    assert [told["verdict"] for told in result["diagnoses"]] == ["named", "named"]
    for told in result["diagnoses"]:
        (effect,) = told["effects"]
        assert (effect["name"], effect["where"]) == ("action_delay", "motor")
        assert effect["strength"] == pytest.approx(result["effect"]["strength"], rel=0.05)
    assert result["parameters"] == PARAMETERS
    for one in result["runs"]:
        more = [STRENGTH] if one["source"] == "with" else []
        assert one["names"] == list(one["z"]) == PARAMETERS + more
        assert one["frames"] == result["frames"]


def test_sources_are_compared_seed_by_seed(finished):
    result = json.loads((finished / "result.json").read_text())
    returns = {s: entry["real_return"]["values"] for s, entry in result["sources"].items()}
    pairs = zip(returns["with"], returns["without"], strict=True)
    assert result["gain"]["values"] == pytest.approx([one - other for one, other in pairs])
    assert {"task", "true", "effect", "seeds", "provenance"} <= result.keys()


def test_table_and_figure_are_there(finished):
    from matplotlib.image import imread

    text = (finished / "table.md").read_text()
    assert "| action_delay[motor]: posterior mean | 0.06 |  | 0.0" in text
    assert "with minus without, paired" in text
    assert imread(finished / "close_the_loop.png")[..., :3].std() > 0.01


def test_where_nothing_is_named_the_recipe_stops_and_says_so(modules, run, tmp_path, capsys):
    close_the_loop, *_ = modules
    unknown = close_the_loop.diagnosed

    def doubtful(real, *, seed):
        return dataclasses.replace(unknown(real, seed=seed), verdict="unknown")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(close_the_loop, "diagnosed", doubtful)
        run(*SHORT, f"out={tmp_path}")
    assert "Stopped: no effect was named on 2 of 2 seeds: [0, 1]" in capsys.readouterr().out
    result = json.loads((tmp_path / "result.json").read_text())
    assert "stopped" in result
    assert "runs" not in result
    assert "true" not in result


def test_one_seed_is_refused(run, tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        run("seeds=1", f"out={tmp_path}")
    assert "expected at least 2 seeds, for an interval, got 1" in capsys.readouterr().err


def test_the_robot_is_late_by_what_it_hides(modules):
    """Its logs are those of the simulator with the true parameters, three commands later."""
    *_, upright_arm = modules
    real = upright_arm.record(seed=3)
    _, _, strength = upright_arm.TRUE_EFFECT
    late = round(strength / upright_arm.make_task().dt)
    assert late == 3
    env = upright_arm.simulator(len(real), seed=0)
    theta = upright_arm.TRUE_PARAMETERS.double().expand(len(real), -1)
    mask = torch.ones(len(real), dtype=torch.bool)
    upright_arm.PHYSICS.write(env, theta, mask=mask, tensordict=real[:, 0])
    start = real["encoder"][:, 0].double()
    env.place({"qpos": start[:, :1], "qvel": start[:, 1:]})
    commands = real["action"]
    shifted = torch.cat([commands[:, :1].expand(-1, late, -1), commands[:, :-late]], 1)
    apart = env.open_loop(shifted)["encoder"] - real["next", "encoder"]
    # for a second: what is left is the encoder's noise, of the start and of every row
    assert apart[:, :50, 0].square().mean().sqrt() < 0.01
    env.place({"qpos": start[:, :1], "qvel": start[:, 1:]})
    prompt = env.open_loop(commands)["encoder"] - real["next", "encoder"]
    assert prompt[:, :50, 0].square().mean().sqrt() > 0.05


def test_what_a_policy_earns_is_the_same_twice(modules):
    from torchrl_bayessim.agents.ppo import PPO

    *_, upright_arm = modules
    env = upright_arm.observed(upright_arm.real_robot(2, seed=0), seed=0)
    policy = PPO(env, seed=0).policy
    one, two = (upright_arm.returns_at_robot(policy, episodes=3) for _ in range(2))
    assert torch.equal(one, two)
