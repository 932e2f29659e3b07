"""Eyes and the localisation pipeline. Importing it enters the scenes in Gymnasium's registry, see `gymnasium_env`."""

from typing import Any

try:
    from .gymnasium_registry import register
except ImportError:  # without the extra `envs` there is no Gymnasium to register in
    pass
else:
    register()
    del register


def __getattr__(name: str) -> Any:
    """`LocalizeWrapper` comes with the environments, which need the extra `envs`: not before it is asked for."""
    if name == "LocalizeWrapper":
        from .wrapper import LocalizeWrapper

        return LocalizeWrapper
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
