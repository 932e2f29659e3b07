"""`covis record`, `check` and `export`, as a person calls them."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from covis.scripts.main import app

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
RECORD = ["record", "box_world:BoxWorld", "--perception", "simulated", "--episodes"]
runner = CliRunner()


def covis(*words):
    result = runner.invoke(app, [str(word) for word in words])
    assert "Traceback" not in result.output
    return result.exit_code, result.output


def test_record_check_export(tmp_path):
    folder = tmp_path / "boxes"
    assert covis(*RECORD, 1, "--out", folder) == (0, f"1 episodes of box_world:BoxWorld in {folder}\n")
    assert covis("check", folder) == (0, f"{folder}: 25 frames, checksums agree\n")
    code, said = covis("export", "coco", folder, tmp_path / "coco")
    assert code == 0
    assert "50 images" in said
    for again in ([*RECORD, 1, "--out", folder], ["export", "coco", folder, tmp_path / "coco"]):
        code, said = covis(*again)
        assert code == 2
        assert "give --overwrite to replace" in said
        assert covis(*again, "--overwrite")[0] == 0
    (folder / "checksums.json").unlink()
    assert "no checksums.json to compare with" in covis("check", folder)[1]


@pytest.mark.parametrize("command", ["check", "benchmark"])
def test_a_corrupt_folder_is_one_line_and_status_2(small_dataset, command):
    file = small_dataset / "robots.parquet"
    file.write_bytes(file.read_bytes()[:-20])
    code, said = covis(command, small_dataset, *(["--method", "reid"] if command == "benchmark" else []))
    assert code == 2
    assert f"{file} cannot be read as Parquet (truncated or corrupt?)" in said
    assert said.count("\n") == 1


def test_a_file_in_the_place_of_the_folder_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    code, said = covis(*RECORD, 1, "--out", tmp_path / "file")
    assert code == 2
    assert "file" in said


def test_unfinished_recordings_are_not_benchmarked(small_dataset):
    (small_dataset / "dataset.json").rename(small_dataset / "recording.json")
    code, said = covis("benchmark", small_dataset, "--method", "reid")
    assert code == 2
    assert "is an unfinished recording: go on with covis record --resume" in said


def test_resume_and_overwrite_exclude_each_other(tmp_path):
    code, said = covis(*RECORD, 1, "--out", tmp_path / "boxes", "--resume", "--overwrite")
    assert (code, said) == (2, "covis: give --resume or --overwrite, not both\n")


def test_ctrl_c_says_what_is_kept(tmp_path):
    folder = tmp_path / "boxes"
    process = subprocess.Popen(
        [sys.executable, "-c", "from covis.scripts.main import main; main()", *RECORD, "200", "--out", str(folder)],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(EXAMPLES), *sys.path])},
    )
    while not list(folder.glob("parts/objects-*.parquet")):
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    kept = len(list(folder.glob("parts/objects-*.parquet")))
    assert process.returncode == 130
    assert said == f"stopped; {kept} of 200 episodes are kept: the same command with --resume goes on\n"
    assert json.loads((folder / "recording.json").read_text())["scene"] == "box_world:BoxWorld"
