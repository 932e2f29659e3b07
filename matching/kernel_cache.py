"""Keeps Numba's stored kernels true to the sources.

Numba compiles a kernel together with those it calls, but looks only at its own file to tell whether what it stored
still holds: after a change of one file, kernels of others would go on computing what they did before. Importing this
module, which packages do before their kernels, deletes what is older than a source.
"""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("matching", "fusion", "envs", "agents")
"""Those with kernels; each calls itself and those before it."""


def forget_stale_kernels(root: Path = ROOT) -> None:
    """Delete stored kernels that are older than a source of their package, or of one that it calls.

    Looks beside the sources, where Numba stores them unless that is read-only or NUMBA_CACHE_DIR is set.
    """
    changed = 0.0
    for package in PACKAGES:
        changed = max([changed, *(x.stat().st_mtime for x in (root / package).rglob("*.py"))])
        for stored in (root / package).rglob("__pycache__/*.nbi"):
            try:
                if stored.stat().st_mtime < changed:
                    stored.unlink()
            except OSError:  # another process was faster, or it is not ours to delete
                continue


forget_stale_kernels()
