"""docs/how-to/own-method-in-the-table.md, done as a reader does it: write the file, run the command."""

import re
import shlex
import sys
from pathlib import Path

from typer.testing import CliRunner

from covis.scripts.main import app

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "own-method-in-the-table.md"


def test_the_example_runs_as_printed(tmp_path, monkeypatch):
    text = PAGE.read_text()
    (code,) = re.findall(r"```python\n# mine.py\n(.*?)```", text, re.DOTALL)
    (command,) = re.findall(r"```sh\ncovis (.*?)\n```", text, re.DOTALL)
    (tmp_path / "mine.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    # Other pages have a mine.py of their own: forget theirs now, and this one afterwards.
    monkeypatch.setitem(sys.modules, "mine", None)
    del sys.modules["mine"]
    result = CliRunner().invoke(app, shlex.split(command))
    assert result.exit_code == 0, result.output
    assert result.stdout.count("mine:match:height_m=0.3") == 3  # in every experiment of the suite
    assert "to best" in result.stdout


def test_a_suite_refuses_what_it_fixes_itself():
    runner = CliRunner()
    for arguments, message in (
        (["quick", "--pose", "known"], "the suite quick fixes pose"),
        (["quick", "multi_robot"], "a suite is run alone"),
    ):
        result = runner.invoke(app, ["benchmark", *arguments])
        assert result.exit_code == 2
        assert message in result.stderr
