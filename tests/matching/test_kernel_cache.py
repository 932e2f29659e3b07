"""A change of any source that a kernel may call makes Numba compile it anew."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import caching

from covis.matching import kernel_cache
from covis.matching.kernel_cache import KernelLocator, sources_digest, temporary_folder
from covis.matching.pose import _rodrigues


def put(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def test_digest_covers_a_package_and_those_before_it(tmp_path):
    def digests():
        sources_digest.cache_clear()
        return {name: sources_digest(name, tmp_path) for name in ("matching", "envs", "agents")}

    def changed(before):
        return {name for name, digest in digests().items() if digest != before[name]}

    put(tmp_path / "matching" / "a.py", "x = 1")
    put(tmp_path / "envs" / "camera" / "b.py", "x = 1")
    before = digests()
    assert not changed(before)
    put(tmp_path / "envs" / "camera" / "b.py", "x = 2")
    assert changed(before) == {"envs", "agents"}
    put(tmp_path / "matching" / "a.py", "x = 2")
    assert changed(before) == {"matching", "envs", "agents"}
    before = digests()
    put(tmp_path / "envs" / "c.py", "")
    assert changed(before) == {"envs", "agents"}
    sources_digest.cache_clear()


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_only_our_kernels_are_stamped():
    assert isinstance(_rodrigues._cache._impl.locator, KernelLocator)
    foreign = numba.njit(cache=True)(lambda x: x)
    assert not isinstance(foreign._cache._impl.locator, KernelLocator)


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_kernels_that_cannot_be_stored_last_as_long_as_the_process(monkeypatch):
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [KernelLocator])
    with pytest.warns(RuntimeWarning, match="set NUMBA_CACHE_DIR"):
        locator = KernelLocator.from_function(_rodrigues.py_func, kernel_cache.__file__)
    assert Path(temporary_folder()) in Path(locator.get_cache_path()).parents
    assert Path(locator.get_cache_path()).is_dir()
    kernel = numba.njit(cache=True)(_rodrigues.py_func)
    kernel(np.array([0.1, 0.2, 0.3]))
    assert list(Path(locator.get_cache_path()).parent.rglob("*.nbi"))


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_a_kernel_that_calls_a_changed_one_is_compiled_anew(tmp_path):
    package = tmp_path / "other" / "matching"
    kernel = "from numba import njit\n@njit(cache=True)\ndef {}(x):\n    return {}\n"
    put(package / "__init__.py", "from . import kernel_cache\n")
    shutil.copy(kernel_cache.__file__, package)
    put(package / "outer.py", "from .inner import inner\n" + kernel.format("outer", "inner(x)"))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    code = "from other.matching.outer import outer as f; print(f(1), sum(f.stats.cache_hits.values()))"

    def run(factor):
        put(package / "inner.py", kernel.format("inner", f"{factor} * x"))
        command = [sys.executable, "-B", "-c", code]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()

    assert run(2) == ["2", "0"]
    assert run(2) == ["2", "1"]
    assert run(3) == ["3", "0"]
