"""Where numbers come from: command line, commit, versions, machine."""

from __future__ import annotations

import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("covis", "numpy", "scipy", "numba", "pyarrow", "pettingzoo", "highway-env", "pybullet", "torch")
RENDERER = "covis.envs.camera rasteriser (backend raster)"
"""Renderers differ in pixels; the benchmark's scenes use this one."""


def provenance() -> dict[str, Any]:
    """One session of a run: what was called, with which code, on what."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "commit": commit(),
        "versions": {"python": platform.python_version()} | versions(),
        "machine": f"{platform.system()} {platform.machine()}",
        "renderer": RENDERER,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def commit() -> str | None:
    """The commit of this code, `+` appended when files differ from it; None outside a git checkout."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():  # installed into somebody else's checkout
        return None
    try:
        head = _git(root, "rev-parse", "--short=10", "HEAD")
        changed = _git(root, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError):
        return None
    return head + ("+" if changed else "")


def versions() -> dict[str, str]:
    """Versions of the packages that can alter results, of those installed."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _git(folder: Path, *arguments: str) -> str:
    return subprocess.run(
        ["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True, timeout=10
    ).stdout.strip()
