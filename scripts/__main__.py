"""`python -m covis.scripts`: the `covis` command where it is not on the path."""

from .main import main

main()
