"""Two observers, two moving targets, look-alike obstacles (the paper's case study); pybullet moves them."""

from functools import partial

from .scenes import aec_env, register
from .scenes import parallel_env as make_parallel_env

parallel_env = partial(make_parallel_env, "target_localization")
env = partial(aec_env, "target_localization")
raw_env = env
register("target_localization")

__all__ = ["env", "parallel_env", "raw_env"]
