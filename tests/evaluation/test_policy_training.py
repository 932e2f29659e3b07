"""A policy is trained for a moment, killed, resumed and compared."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from covis.evaluation import extras, policy_training
from covis.evaluation.policy_training import PolicyParams, evaluate_policy, load_policy, make_env, train_policy
from covis.scripts.main import app

torch = pytest.importorskip("torch", reason="torch is not installed: pip install covis[policy]")
sb3 = pytest.importorskip("stable_baselines3", reason="not installed: pip install covis[policy]")
pytest.importorskip("supersuit", reason="SuperSuit is not installed: pip install covis[policy]")

SMALL = (("width", 64), ("height", 48), ("min_pixels", 10), ("max_cycles", 4))
PARAMS = PolicyParams("multi_robot", "easy", steps=3 * 64, seed=1, options=SMALL)


def weights(file):
    return sb3.PPO.load(file, device="cpu").policy.state_dict()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    out = tmp_path_factory.mktemp("policy")
    rows = []
    file = train_policy(PARAMS, out, report=rows.append)
    return out, file, rows


def test_training_reports_and_learns_something(trained):
    out, file, rows = trained
    assert [r["steps"] for r in rows] == [64, 128, 192]
    assert rows[-1]["done"] == 1.0
    assert json.loads((out / "log.json").read_text())[2]["episode_return"] == rows[2]["episode_return"]
    first = sb3.PPO("MlpPolicy", policy_training._vector(PARAMS), seed=None, device="cpu").policy.state_dict()
    assert first.keys() == weights(file).keys()
    assert {p.name for p in out.iterdir()} == {"policy.zip", "checkpoint.zip", "log.json", "training.json"}


def test_a_killed_training_ends_with_the_same_weights(trained, tmp_path):
    class Killed(BaseException):
        pass

    def kill(row):
        if row["iteration"] == 1:
            raise Killed

    with pytest.raises(Killed):
        train_policy(PARAMS, tmp_path, report=kill)
    assert not (tmp_path / "policy.zip").exists()
    with pytest.raises(FileExistsError, match="--resume"):
        train_policy(PARAMS, tmp_path)
    with pytest.raises(FileExistsError, match="a training with seed 1, not 2"):
        train_policy(replace(PARAMS, seed=2), tmp_path, resume=True)
    rows = []
    file = train_policy(PARAMS, tmp_path, resume=True, report=rows.append)
    assert [r["iteration"] for r in rows] == [2]
    expected = weights(trained[1])
    assert all(torch.equal(w, expected[name]) for name, w in weights(file).items())
    assert (tmp_path / "log.json").read_text() == (trained[0] / "log.json").read_text()


def test_resuming_with_more_steps_goes_on(trained, tmp_path):
    train_policy(replace(PARAMS, steps=64), tmp_path)
    file = train_policy(PARAMS, tmp_path, resume=True)
    expected = weights(trained[1])
    assert all(torch.equal(w, expected[name]) for name, w in weights(file).items())


def test_controllers_are_compared_on_the_same_unseen_episodes(trained):
    rows = evaluate_policy(PARAMS, load_policy(trained[1]), 3)
    assert [r["controller"] for r in rows] == ["policy", "scripted", "random", "standing"]
    assert rows == evaluate_policy(PARAMS, load_policy(trained[1]), 3)
    assert rows[0]["policy_gain_low"] is None
    assert all(
        r["policy_gain_low"] <= rows[0]["episode_return"] - r["episode_return"] <= r["policy_gain_high"]
        for r in rows[1:]
    )
    for row in rows:
        assert row["return_low"] <= row["episode_return"] <= row["return_high"]
        assert 0 <= row["scene_recall"] <= 1
    assert len({r["episode_return"] for r in rows}) == 4
    standing = evaluate_policy(PARAMS, policy_training.standing, 3)
    assert standing[0]["episode_return"] == standing[3]["episode_return"] == rows[3]["episode_return"]


def test_the_policy_moves_every_robot_within_bounds(trained):
    env = make_env(PARAMS)
    observations, _ = env.reset(seed=0)
    controls = load_policy(trained[1])(env, observations)
    assert list(controls) == ["robot_0", "robot_1"]
    assert all(env.action_space(a).contains(c) for a, c in controls.items())
    assert not np.array_equal(controls["robot_0"], controls["robot_1"])


def test_mistakes_are_one_line(tmp_path, monkeypatch):
    def call(*arguments):
        return CliRunner().invoke(app, ["train", "policy", *arguments, "--out", str(tmp_path / "p")])

    result = call("nowhere")
    assert result.exit_code == 2
    assert "no scene is called 'nowhere'" in result.stderr
    result = call("multi_robot", "--steps", "0")
    assert "steps must be at least 1, got 0" in result.stderr
    monkeypatch.setattr(extras, "find_spec", lambda name: None if name == "supersuit" else name)
    assert "supersuit is missing: install covis[policy]" in call("multi_robot").stderr
