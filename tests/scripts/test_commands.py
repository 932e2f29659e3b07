"""The command line, as a person calls it."""

import json
import subprocess
import sys
from importlib import metadata

import pytest
from typer.testing import CliRunner

from covis.evaluation import extras
from covis.scripts.main import app

runner = CliRunner()


def test_benchmark_prints_json(small_dataset):
    result = runner.invoke(
        app,
        [
            "benchmark",
            str(small_dataset),
            "--method",
            "oracle",
            "--method",
            "hungarian:gate_m=2",
            "--pose",
            "known",
            "--json",
            "-",
        ],
    )
    assert result.exit_code == 0, result.output
    rows = json.loads(result.stdout)["rows"]
    assert [row["method"] for row in rows] == ["oracle", "hungarian"]
    assert rows[0]["f1"] == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["localize", "team", "--json", "nowhere/rows.json"], "there is no folder nowhere"),
        (["localize", "scenes", "--figure", "error.png"], "--figure draws the part team, got scenes"),
        (["localize", "team", "--figure", "error.gift"], "not as 'error.gift'"),
        (["tune", "reid", ".", "--json", "nowhere/rows.json"], "there is no folder nowhere"),
        (["sensitivity", ".", "--json", "nowhere/rows.json"], "there is no folder nowhere"),
        (["sensitivity", ".", "--figure", "weights.gift"], "not as 'weights.gift'"),
        (["speed", "matching", "--json", "nowhere/rows.json"], "there is no folder nowhere"),
        (["speed", "matching", "--figure", "time.gift"], "not as 'time.gift'"),
        (["demo", "--out", __file__], "File exists"),
    ],
)
def test_what_cannot_be_written_is_found_out_before_the_work(arguments, message):
    result = runner.invoke(app, arguments)
    assert result.exit_code == 2, result.output
    assert message in " ".join(result.output.split())
    assert "Traceback" not in result.output


def test_benchmark_writes_a_file_and_a_table(small_dataset, tmp_path):
    file = tmp_path / "rows.json"
    result = runner.invoke(app, ["benchmark", str(small_dataset), "--method", "reid", "--json", str(file)])
    assert result.exit_code == 0, result.output
    assert "reid" in result.stdout
    assert json.loads(file.read_text())["rows"][0]["target"] == "small"


def test_version():
    assert runner.invoke(app, ["--version"]).output.split() == ["covis", metadata.version("covis")]


def test_a_demo_that_cannot_run_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(extras, "find_spec", lambda module: None)
    result = runner.invoke(app, ["demo", "--out", str(tmp_path / "demo")])
    assert (result.exit_code, list(tmp_path.iterdir())) == (2, [])
    monkeypatch.undo()
    (tmp_path / "file").touch()
    result = runner.invoke(app, ["demo", "--out", str(tmp_path / "file")])
    assert result.exit_code == 2
    assert "file" in result.stderr


def test_datasets_of_one_name_are_told_apart(dataset_writer, tmp_path):
    folders = [str(dataset_writer(tmp_path / name, n_frames=2)) for name in ("a", "b")]
    result = runner.invoke(app, ["benchmark", *folders, "--method", "oracle"])
    assert result.exit_code == 0, result.output
    assert all(folder in result.stdout for folder in folders)


def test_a_method_that_fails_costs_no_other_its_row(small_dataset, tmp_path):
    out = tmp_path / "run"
    methods = ["--method", f"{__name__}:fails", "--method", "oracle"]
    result = runner.invoke(app, ["benchmark", str(small_dataset), *methods, "--out", str(out), "--json", "-"])
    assert result.exit_code == 1
    rows = json.loads(result.stdout)["rows"]
    assert [(row["f1"], row["n_failed"]) for row in rows] == [(0.0, 6), (1.0, 0)]
    first, last = result.stderr.splitlines()
    assert f"method '{__name__}:fails' on small, frame 0, robot_0 and robot_1: KeyError: 'no'" in first
    assert "fails failed on 6 of 6 pairs of small, and counts as having found nothing there" in last
    assert runner.invoke(app, ["report", str(out)]).exit_code == 0
    assert "| Failed |" in (out / "report.md").read_text()


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_method_of_the_folder_where_it_is_called(small_dataset, tmp_path, workers):
    """The command is not a module of that folder, as `python -m` would make it: hence -P."""
    (tmp_path / "mine_here.py").write_text(
        "from covis.matching import Matching\n\n\n"
        "def match(source, target, *, prior=None, rng=None):\n    return Matching.empty()\n"
    )
    command = [sys.executable, "-P", "-m", "covis.scripts", "benchmark", str(small_dataset), "--workers", workers]
    command += ["--method", "mine_here:match", "--json", "-"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["rows"][0]["n_failed"] == 0


def fails(source, target, *, prior=None, rng=None):
    raise KeyError("no")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--method", "hungarian"], "hungarian needs a relative pose"),
        (["--method", "nope"], "no matcher is called 'nope'"),
        (["--method", "reid:colour=3"], "colour"),
        (["--pose", "maybe"], "pose must be one of"),
        (["--resume"], "--resume needs --out"),
        (["--json", "nowhere/rows.json"], "there is no folder nowhere to write rows.json into"),
        (["--json", "."], "is a folder, not a file"),
        (["--figure", "figure.gift"], "not as 'figure.gift'"),
        (["--method", "reid", "--workers", "0"], "workers must be at least 1, got 0"),
    ],
)
def test_mistakes_are_one_line_and_status_2(small_dataset, arguments, message):
    result = runner.invoke(app, ["benchmark", str(small_dataset), *arguments])
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.output


def test_the_command_is_a_module_too(small_dataset):
    command = [sys.executable, "-m", "covis.scripts", "check", str(small_dataset)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "frames" in done.stdout


def test_matching_imports_neither_simulators_nor_torch():
    code = (
        "import sys, covis.matching, covis.fusion, covis.evaluation.benchmark, covis.scripts.main; "
        "print([m for m in ('torch', 'pybullet', 'highway_env', 'pettingzoo', 'gymnasium', 'cv2') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.slow
def test_demo_makes_a_report(tmp_path):
    from covis.evaluation.demo import METHODS
    from covis.evaluation.settings import SCENE_NAMES

    result = runner.invoke(app, ["demo", "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert len(rows) == len(METHODS) * len(SCENE_NAMES)
    assert all(row["displacement_fused_m"] is not None for row in rows if row["method"] == "oracle")
    report = (tmp_path / "report.md").read_text()
    for scene in SCENE_NAMES:
        assert (tmp_path / "pictures" / f"{scene}-oracle.png").stat().st_size > 10_000
        assert f"pictures/{scene}-oracle.png" in report


def test_view_writes_a_recording(small_dataset, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install covis[viz]")
    file = tmp_path / "small.rrd"
    result = runner.invoke(app, ["view", str(small_dataset), "--out", str(file), "--episodes", "1"])
    assert result.exit_code == 0, result.output
    assert file.read_bytes().startswith(b"RRF2")
    assert "3 frames" in result.stdout
    result = runner.invoke(app, ["view", "nowhere", "--out", str(file)])
    assert result.exit_code == 2
    assert "neither a dataset folder nor a scene" in result.stderr
