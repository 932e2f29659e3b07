"""From a name to a matcher: built in, installed by another package, or anywhere as `package.module:callable`."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import EntryPoint, entry_points

from .adapters import adapter, is_adapter
from .bayes import bayes
from .bcagm import bcagm
from .clipper import clipper
from .graph import Matcher
from .hungarian import hungarian
from .icp import icp
from .mos import mos
from .reid import reid
from .rgm import rgm, rgm_no_covisibility, rgm_no_uncertainty
from .rrwhm import rrwhm
from .rrwm import rrwm

METHODS: dict[str, Matcher] = {
    "bayes": bayes,
    "hungarian": hungarian,
    "reid": reid,
    "rgm": rgm,
    "rgm-no-uncertainty": rgm_no_uncertainty,
    "rgm-no-covisibility": rgm_no_covisibility,
    "rrwm": rrwm,
    "icp": icp,
    "bcagm": bcagm,
    "rrwhm": rrwhm,
    "mos": mos,
    "clipper": clipper,
}

ENTRY_POINT_GROUP = "covis.matchers"


class UnknownMatcherError(ValueError):
    """No matcher of that name."""


def load_matcher(name: str) -> Matcher:
    """The matcher called `name`: in METHODS, in the entry-point group `covis.matchers`, or `package.module:callable`.

    `pygm:<solver>` and `kiss-matcher` name matchers of those packages, if installed (`covis.matching.adapters`).

    Raises:
        UnknownMatcherError: there is none, or it is not callable; the message lists the known names.
    """
    if name in METHODS:
        return METHODS[name]
    if is_adapter(name):
        try:
            return adapter(name)
        except (ImportError, ValueError) as error:
            raise UnknownMatcherError(str(error)) from error
    installed = {point.name: point for point in entry_points(group=ENTRY_POINT_GROUP)}
    if name in installed:
        return _callable(_loaded(installed[name]), name)
    if ":" in name:
        return _callable(_import(name), name)
    known = ", ".join(sorted({*METHODS, *installed}))
    raise UnknownMatcherError(f"no matcher is called {name!r}; known are {known}, or package.module:callable")


def _loaded(point: EntryPoint) -> object:
    try:
        return point.load()
    except (ImportError, AttributeError) as error:
        package = point.dist.name if point.dist else "a package"
        raise UnknownMatcherError(
            f"matcher {point.name!r} of {package} cannot be loaded from {point.value!r}: {error}"
        ) from error


def _import(name: str) -> object:
    module_name, _, attribute = name.partition(":")
    try:
        module = import_module(module_name)
    except ImportError as error:
        raise UnknownMatcherError(f"cannot import {module_name!r} of matcher {name!r}: {error}") from error
    try:
        return getattr(module, attribute)
    except AttributeError as error:
        raise UnknownMatcherError(f"module {module_name!r} has no {attribute!r} (matcher {name!r})") from error


def _callable(candidate: object, name: str) -> Matcher:
    if not callable(candidate):
        raise UnknownMatcherError(f"{name!r} is not callable: {candidate!r}")
    return candidate
