"""Files that appear whole or not at all, and JSON in them."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """Where to write what is to become `file`: it does by an atomic rename at the end, unless writing fails."""
    temporary = file.with_name(f"{file.name}.{os.getpid()}.tmp")
    try:
        yield temporary
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def write_atomically(file: Path, content: bytes) -> None:
    """Write a file whole."""
    with replacing(file) as temporary:
        temporary.write_bytes(content)


def write_json(file: Path, content: Any) -> None:
    """Write JSON whole. Raises ValueError for NaN and infinities, which JSON does not know."""
    write_atomically(file, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
