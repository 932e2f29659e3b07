"""Who is who: correspondence between the detections of two robots.

    from covis.matching import METHODS, ObjectGraph, hungarian, reid

Every matcher is a function `(source, target, *, prior=None, rng=None, **options) -> Matching`.
"""

from . import kernel_cache as kernel_cache  # first: the others load kernels
from .bayes import bayes
from .bcagm import bcagm
from .clipper import clipper
from .graph import Hypothesis, Matcher, Matching, ObjectGraph, PriorRequiredError
from .hungarian import hungarian
from .icp import icp
from .mos import mos
from .pose import RelativePose
from .registry import METHODS, load_matcher
from .reid import reid
from .rgm import rgm
from .rrwhm import rrwhm
from .rrwm import rrwm

__all__ = [
    "METHODS",
    "Hypothesis",
    "Matcher",
    "Matching",
    "ObjectGraph",
    "PriorRequiredError",
    "RelativePose",
    "bayes",
    "bcagm",
    "clipper",
    "hungarian",
    "icp",
    "load_matcher",
    "mos",
    "reid",
    "rgm",
    "rrwhm",
    "rrwm",
]
