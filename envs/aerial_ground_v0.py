"""A drone looking down, ground robots looking along (the paper's R-MRC); pybullet moves them."""

from functools import partial

from .scenes import aec_env, register
from .scenes import parallel_env as make_parallel_env

parallel_env = partial(make_parallel_env, "aerial_ground")
env = partial(aec_env, "aerial_ground")
raw_env = env
register("aerial_ground")

__all__ = ["env", "parallel_env", "raw_env"]
