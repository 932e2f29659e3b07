"""Eyes and the localisation pipeline. Importing it enters the scenes in Gymnasium's registry, see `gymnasium_env`."""

try:
    from .gymnasium_registry import register
except ImportError:  # without the extra `envs` there is no Gymnasium to register in
    pass
else:
    register()
    del register
