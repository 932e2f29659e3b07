"""The packaging list is kept by hand: it must match the folders."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TOP = ("matching", "fusion", "envs", "agents", "evaluation", "scripts")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_folder_with_code_is_packaged():
    found = {
        "covis." + ".".join(path.parent.relative_to(ROOT).parts) for top in TOP for path in (ROOT / top).rglob("*.py")
    }
    listed = PROJECT["tool"]["setuptools"]["packages"]
    assert sorted(found) == sorted(listed)
    mapping = PROJECT["tool"]["setuptools"]["package-dir"]
    assert mapping == {name: name.removeprefix("covis.").replace(".", "/") for name in listed}


def test_every_package_is_typed_and_linked_for_type_checkers():
    for top in TOP:
        assert (ROOT / top / "py.typed").exists()
        assert (ROOT / ".typing" / "covis" / top).resolve() == ROOT / top


def test_every_dependency_is_pinned_for_tests():
    pinned = {
        line.split("==")[0].lower() for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line
    }
    extras = PROJECT["project"]["optional-dependencies"]
    wanted = [*PROJECT["project"]["dependencies"], *extras["envs"], *extras["learned"], *extras["dev"]]
    names = {d.split(">")[0].split("[")[0].lower() for d in wanted} - {"covis"}
    assert names <= pinned
