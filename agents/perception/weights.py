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

from ...matching.pose import Array

TENSORS = "eyes.safetensors"
MANIFEST = "eyes.json"
FORMAT, VERSION = "covis-eyes", 4
SAME_TENSORS = (3, 4)
"""Versions that differ in their calibration alone."""
SHIPPED = Path(__file__).parent / "weights"
"""The folder of the weights that come with the package."""


class WeightsError(RuntimeError):
    """Weights that are missing, altered or of another format; the message names the file."""


QUANTITIES = {
    "depth variance": 0.003,
    "epistemic": 0.2,
    "centre variance": 0.02,
    "confidence": 1.0,
    "depth": 8.0,
    "width": 30.0,
    "height": 30.0,
}
"""Of what the corrections are functions, each with a usual value, see `calibration_features`."""
TERMS = (len(QUANTITIES) + 1) * (len(QUANTITIES) + 2) // 2
FARTHEST = 3.0
"""Quantities are held within a factor e^3 of the usual: a square is no guide beyond what calibration has seen."""
CORRECTIONS = ("depth", "along", "horizontal", "vertical")


@dataclass(frozen=True)
class Calibration:
    """What makes depths unbiased and the reported uncertainty true, found on validation seeds.

    Attributes:
        depth: coefficients of the `calibration_features` in the log of the factor on the depth.
        along, horizontal, vertical: the same for the factors on the variance along the viewing ray, beyond the square
            of that on the depth, and on the variances of the projected centre along the image's two axes.
        class_temperature: logits are divided by it.
    """

    depth: tuple[float, ...] = (0.0,) * TERMS
    along: tuple[float, ...] = (0.0,) * TERMS
    horizontal: tuple[float, ...] = (0.0,) * TERMS
    vertical: tuple[float, ...] = (0.0,) * TERMS
    class_temperature: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.class_temperature) and self.class_temperature > 0):
            raise ValueError(f"Calibration.class_temperature must be positive, got {self.class_temperature}")
        for name in CORRECTIONS:
            value = tuple(getattr(self, name))
            object.__setattr__(self, name, value)
            if len(value) != TERMS or not np.isfinite(value).all():
                raise ValueError(f"Calibration.{name} must be {TERMS} finite numbers, got {value}")

    def factors(self, features: Array) -> Array:
        """Factors (n, 4) of the CORRECTIONS for objects with such features (n, TERMS)."""
        return np.exp(features @ np.array([getattr(self, name) for name in CORRECTIONS]).T)


def calibration_features(
    *,
    depth: Array,
    depth_variance: Array,
    depth_epistemic: Array,
    centre_variance: Array,
    confidence: Array,
    size: Array,
) -> Array:
    """What is known of how sure n objects are (n, TERMS): 1, seven logarithms, and all products of two of them.

    Args:
        depth: (n,) m, uncalibrated like all the others.
        depth_variance, depth_epistemic: (n,) m^2, the whole and the part between samples.
        centre_variance: (n,) of the projected centre per axis, in squares of the box's size along it.
        confidence: (n,) that this is an object.
        size: (n, 2) px, width and height of the box.
    """
    share = np.maximum(depth_epistemic / depth_variance, 0.02)
    share = np.where(depth_epistemic == 0, QUANTITIES["epistemic"], share)  # a single sample: unknown
    raw = (depth_variance / depth**2, share, centre_variance, np.maximum(confidence, 0.05), depth, *size.T)
    logs = [np.log(np.maximum(x, 1e-8) / usual) for x, usual in zip(raw, QUANTITIES.values(), strict=True)]
    x = np.clip(logs, -FARTHEST, FARTHEST)
    products = [x[i] * x[j] for i in range(len(x)) for j in range(i, len(x))]
    return np.stack([np.ones(len(depth)), *x, *products], axis=1)


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


def load(folder: Path | None = None, *, calibrated: bool = True) -> Weights:
    """The weights in a folder; None = those that come with the package.

    Without `calibrated` their calibration is not read, and may be one of an older version.

    Raises:
        WeightsError: a file is missing, the tensors are not those that the manifest vouches for, another format.
    """
    from safetensors.torch import load as from_bytes

    folder = SHIPPED if folder is None else folder
    for name in (MANIFEST, TENSORS):
        if not (folder / name).is_file():
            raise WeightsError(f"learned perception needs {folder / name}: train it with `covis train perception`")
    manifest = read_manifest(folder, (VERSION,) if calibrated else SAME_TENSORS)
    content = (folder / TENSORS).read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != manifest["sha256"]:
        raise WeightsError(f"{folder / TENSORS} has been altered: SHA-256 {found}, expected {manifest['sha256']}")
    calibration = Calibration(**manifest["calibration"]) if calibrated else Calibration()
    return Weights(from_bytes(content), manifest["network"], calibration, manifest.get("notes", {}))


def read_manifest(folder: Path, versions: tuple[int, ...] = (VERSION,)) -> dict[str, Any]:
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
    if stated not in [(FORMAT, version) for version in versions]:
        hint = ""
        if stated in [(FORMAT, version) for version in SAME_TENSORS]:
            hint = f": calibrate them anew by `covis train perception --out {folder} --calibrate`"
        raise WeightsError(f"{path} must be of format {FORMAT!r} version {VERSION}, got {stated}{hint}")
    missing = [key for key in ("sha256", "network", "calibration") if key not in manifest]
    if missing:
        raise WeightsError(f"{path} lacks {missing[0]!r}")
    return manifest


def _replace(path: Path, content: bytes) -> None:
    partial = path.with_suffix(".partial")
    partial.write_bytes(content)
    os.replace(partial, path)
