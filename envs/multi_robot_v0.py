"""A team of identical robots watched by robots with cameras (the paper's S-MRC); pybullet moves them."""

from functools import partial

from .scenes import aec_env, register
from .scenes import parallel_env as make_parallel_env

parallel_env = partial(make_parallel_env, "multi_robot")
env = partial(aec_env, "multi_robot")
raw_env = env
register("multi_robot")

__all__ = ["env", "parallel_env", "raw_env"]
