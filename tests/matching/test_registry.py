"""A name, an entry point or package.module:callable."""

import pytest

from covis.matching import METHODS, load_matcher
from covis.matching.registry import UnknownMatcherError
from covis.matching.testing import check_matcher


def test_known_names():
    assert load_matcher("reid") is METHODS["reid"]


def test_any_callable_by_path():
    assert load_matcher("covis.matching.hungarian:hungarian") is METHODS["hungarian"]


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A package of somebody else's with three entry points, two of them broken."""
    (tmp_path / "acme.py").write_text(
        "from covis.matching import Matching\n"
        "def match(source, target, *, prior=None, rng=None):\n"
        "    return Matching.empty()\n"
        "number = 3\n"
    )
    info = tmp_path / "acme_matcher-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-matcher\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text(
        "[covis.matchers]\nacme = acme:match\nacme-gone = acme:gone\nacme-number = acme:number\n"
    )
    monkeypatch.syspath_prepend(tmp_path)


def test_an_installed_package_adds_a_name(installed):
    matcher = load_matcher("acme")
    assert matcher.__module__ == "acme"
    check_matcher(matcher, min_f1=None)
    with pytest.raises(UnknownMatcherError, match="known are acme, acme-gone, acme-number, bayes"):
        load_matcher("nope")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("acme-gone", "'acme-gone' of acme-matcher cannot be loaded from 'acme:gone': module 'acme' has no"),
        ("acme-number", "'acme-number' is not callable: 3"),
    ],
)
def test_a_broken_entry_point_names_its_package(installed, name, message):
    with pytest.raises(UnknownMatcherError, match=message):
        load_matcher(name)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nope", "no matcher is called 'nope'; known are .*hungarian"),
        ("no.such.module:f", "cannot import 'no.such.module'"),
        ("math:nothing", "module 'math' has no 'nothing'"),
        ("math:pi", "not callable"),
    ],
)
def test_unknown_names_say_what_is_wrong(name, message):
    with pytest.raises(UnknownMatcherError, match=message):
        load_matcher(name)
