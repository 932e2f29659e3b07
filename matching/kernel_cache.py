"""Keeps Numba's stored kernels true to the sources.

Numba compiles a kernel together with those it calls, but stamps what it stores with its own file alone: after a change
of another file it would go on computing what that one did before. Importing this module, which packages do before
their kernels, puts a locator before Numba's own ones that adds the other sources to the stamp. Where kernels are stored
(`NUMBA_CACHE_DIR`, beside the sources, or in the user's cache where these are read-only) stays Numba's choice, and so
does everything about the kernels of other packages. Where none of these can be written, which Numba refuses, kernels
last as long as the process.
"""

from __future__ import annotations

import atexit
import shutil
import tempfile
import warnings
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

from numba.core import caching

ROOT = Path(__file__).parent.parent
PACKAGES = ("matching", "fusion", "envs", "agents")
"""Those with kernels; each calls itself and those before it."""


@lru_cache
def sources_digest(package: str, root: Path = ROOT) -> bytes:
    """SHA-256 of all sources that kernels of a package may call: its own, and those of the packages before it."""
    digest = sha256()
    for name in PACKAGES[: PACKAGES.index(package) + 1]:
        for path in sorted((root / name).rglob("*.py")):
            digest.update(f"{path.relative_to(root)}\n".encode() + path.read_bytes())
    return digest.digest()


@lru_cache
def temporary_folder() -> str:
    """A folder that goes with the process."""
    folder = tempfile.mkdtemp(prefix="covis-kernels-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    warnings.warn(
        "kernels cannot be stored beside covis nor in a user's cache, so every process compiles them anew: "
        "set NUMBA_CACHE_DIR to a folder that can be written",
        RuntimeWarning,
    )
    return folder


class TemporaryLocator(caching._SourceFileBackedLocatorMixin, caching._CacheLocator):
    """Stores in the `temporary_folder`."""

    def __init__(self, py_func: Any, py_file: str) -> None:
        self._py_file, self._lineno = py_file, py_func.__code__.co_firstlineno
        self._cache_path = str(Path(temporary_folder()) / self.get_suitable_cache_subpath(py_file))

    def get_cache_path(self) -> str:
        return self._cache_path


class KernelLocator(caching._CacheLocator):
    """The locator that Numba would take, with `sources_digest` in its stamp."""

    def __init__(self, chosen: Any, package: str) -> None:
        self.chosen, self.package = chosen, package

    def get_cache_path(self) -> str:
        return str(self.chosen.get_cache_path())

    def get_source_stamp(self) -> tuple[Any, bytes]:
        return self.chosen.get_source_stamp(), sources_digest(self.package)

    def get_disambiguator(self) -> str:
        return str(self.chosen.get_disambiguator())

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> KernelLocator | None:
        """None, which leaves the function to Numba's own locators, unless it is a kernel of these packages."""
        top, _, rest = py_func.__module__.partition(".")
        package = rest.partition(".")[0]
        if top != __name__.partition(".")[0] or package not in PACKAGES:
            return None
        others = (*(other for other in caching.CacheImpl._locator_classes if other is not cls), TemporaryLocator)
        found = (other.from_function(py_func, py_file) for other in others)
        return next((cls(chosen, package) for chosen in found if chosen is not None), None)


caching.CacheImpl._locator_classes.insert(0, KernelLocator)
