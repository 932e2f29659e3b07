"""Connected vehicles in traffic (the paper's CAD); highway-env moves it."""

from functools import partial

from .scenes import aec_env, register
from .scenes import parallel_env as make_parallel_env

parallel_env = partial(make_parallel_env, "connected_driving")
env = partial(aec_env, "connected_driving")
raw_env = env
register("connected_driving")

__all__ = ["env", "parallel_env", "raw_env"]
