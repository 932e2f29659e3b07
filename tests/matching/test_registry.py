"""A name, an entry point or package.module:callable."""

import pytest

from covis.matching import METHODS, load_matcher
from covis.matching.registry import UnknownMatcherError


def test_known_names():
    assert load_matcher("reid") is METHODS["reid"]


def test_any_callable_by_path():
    assert load_matcher("covis.matching.hungarian:hungarian") is METHODS["hungarian"]


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
