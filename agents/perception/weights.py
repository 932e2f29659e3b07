"""Weights of the learned eyes: a folder with `eyes.safetensors` and `eyes.json` (its hash, classes, calibration)."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...matching.pose import Array

TENSORS = "eyes.safetensors"
MANIFEST = "eyes.json"
FORMAT, VERSION = "covis-eyes", 3
SHIPPED = Path(__file__).parent / "weights"
"""The folder of the weights that come with the package."""


class WeightsError(RuntimeError):
    """Weights that are missing, altered or of another format; the message names the file."""


QUANTITIES = {"variance": 0.003, "epistemic": 0.2, "confidence": 1.0, "depth": 8.0, "pixels": 300.0}
"""Of what the correction of a depth's variance is a function, each with a usual value, see `variance_features`."""
VARIANCE_TERMS = (len(QUANTITIES) + 1) * (len(QUANTITIES) + 2) // 2
FARTHEST = 3.0
"""Quantities are held within a factor e^3 of the usual: a square is no guide beyond what calibration has seen."""


@dataclass(frozen=True)
class Calibration:
    """What makes depths unbiased and the reported uncertainty true, found on validation seeds.

    Attributes:
        scale, exponent: a depth of z m is corrected to scale * z ** exponent.
        depth: coefficients of the `variance_features` in the log of the factor on its variance.
        centre: factor on the variance of the projected centre.
        class_temperature: logits are divided by it.
    """

    scale: float = 1.0
    exponent: float = 1.0
    depth: tuple[float, ...] = (0.0,) * VARIANCE_TERMS
    centre: float = 1.0
    class_temperature: float = 1.0

    def __post_init__(self) -> None:
        for name in ("scale", "exponent", "centre", "class_temperature"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"Calibration.{name} must be positive, got {value}")
        object.__setattr__(self, "depth", tuple(self.depth))
        if len(self.depth) != VARIANCE_TERMS or not np.isfinite(self.depth).all():
            raise ValueError(f"Calibration.depth must be {VARIANCE_TERMS} finite numbers, got {self.depth}")

    def variance_factor(self, features: Array) -> Array:
        """Factor (n,) on variances with such features (n, VARIANCE_TERMS)."""
        return np.exp(features @ np.array(self.depth))


def variance_features(
    relative: Array, epistemic: Array, confidence: Array, depth: Array, pixels: NDArray[np.int64]
) -> Array:
    """What is known of how sure n depths are (n, VARIANCE_TERMS): 1, five logarithms, and all products of two of them.

    Args:
        relative: (n,) reported variance over the squared depth.
        epistemic: (n,) share of the variance between samples in that.
        confidence: (n,) that this is an object.
        depth: (n,) m.
        pixels: (n,) visible.
    """
    raw = (relative, np.maximum(epistemic, 0.02), np.maximum(confidence, 0.05), depth, pixels.astype(np.float64))
    logs = [np.log(np.maximum(x, 1e-8) / usual) for x, usual in zip(raw, QUANTITIES.values(), strict=True)]
    x = np.clip(logs, -FARTHEST, FARTHEST)
    products = [x[i] * x[j] for i in range(len(x)) for j in range(i, len(x))]
    return np.stack([np.ones(len(relative)), *x, *products], axis=1)


@dataclass(frozen=True, eq=False)
class Weights:
    """A trained network as it is stored.

    Attributes:
        tensors: by name.
        network: sizes, as `NetworkParams.to_dict` gives them; the classes are among them.
        calibration: of its uncertainty.
        notes: how it was trained and what was measured, for people.
    """

    tensors: Mapping[str, Any]
    network: Mapping[str, Any]
    calibration: Calibration = Calibration()
    notes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def classes(self) -> tuple[str, ...]:
        return tuple(self.network["classes"])


def save(weights: Weights, folder: Path) -> None:
    """Write both files; the manifest last, so that it never vouches for a half-written file."""
    from safetensors.torch import save as to_bytes

    folder.mkdir(parents=True, exist_ok=True)
    content = to_bytes({name: tensor.detach().contiguous().clone() for name, tensor in weights.tensors.items()})
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "sha256": hashlib.sha256(content).hexdigest(),
        "network": dict(weights.network),
        "calibration": vars(weights.calibration),
        "notes": dict(weights.notes),
    }
    _replace(folder / TENSORS, content)
    _replace(folder / MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())


def load(folder: Path | None = None) -> Weights:
    """The weights in a folder; None = those that come with the package.

    Raises:
        WeightsError: a file is missing, the tensors are not those that the manifest vouches for, another format.
    """
    from safetensors.torch import load as from_bytes

    folder = SHIPPED if folder is None else folder
    for name in (MANIFEST, TENSORS):
        if not (folder / name).is_file():
            raise WeightsError(f"learned perception needs {folder / name}: train it with `covis train perception`")
    manifest = read_manifest(folder)
    content = (folder / TENSORS).read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != manifest["sha256"]:
        raise WeightsError(f"{folder / TENSORS} has been altered: SHA-256 {found}, expected {manifest['sha256']}")
    return Weights(
        from_bytes(content), manifest["network"], Calibration(**manifest["calibration"]), manifest.get("notes", {})
    )


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a folder.

    Raises:
        WeightsError: it cannot be read, or is of another format or version.
    """
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise WeightsError(f"{path} cannot be read: {error}") from error
    stated = manifest.get("format"), manifest.get("version")
    if stated != (FORMAT, VERSION):
        raise WeightsError(f"{path} must be of format {FORMAT!r} version {VERSION}, got {stated}")
    missing = [key for key in ("sha256", "network", "calibration") if key not in manifest]
    if missing:
        raise WeightsError(f"{path} lacks {missing[0]!r}")
    return manifest


def _replace(path: Path, content: bytes) -> None:
    partial = path.with_suffix(".partial")
    partial.write_bytes(content)
    os.replace(partial, path)
