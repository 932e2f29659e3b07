"""Adapters without and with the packages behind them."""

import builtins
import sys

import pytest

from covis.matching import load_matcher
from covis.matching.adapters import MissingPackageError, adapter
from covis.matching.testing import check_matcher


@pytest.mark.parametrize(("name", "package"), [("pygm:rrwm", "pygmtools"), ("kiss-matcher", "kiss-matcher")])
def test_a_missing_package_is_named(monkeypatch, name, package):
    module = package.replace("-", "_")
    monkeypatch.setitem(sys.modules, module, None)  # makes an import of it fail
    with pytest.raises(MissingPackageError, match=f"pip install {package}"):
        adapter(name)
    with pytest.raises(ValueError, match=f"{name} needs {package}"):
        load_matcher(name)


def test_importing_the_library_needs_no_other_package(monkeypatch):
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        assert not name.startswith(("pygmtools", "kiss_matcher"))
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    monkeypatch.delitem(sys.modules, "covis.matching.adapters", raising=False)
    import covis.matching.adapters  # noqa: F401


def test_kiss_matcher_keeps_the_contract():
    pytest.importorskip("kiss_matcher", reason="kiss-matcher is not installed")
    check_matcher(load_matcher("kiss-matcher"), invariant=False, min_f1=None)
