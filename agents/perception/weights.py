"""Weights of the learned eyes: a folder with `eyes.safetensors`, `eyes.json` (its hash, classes, calibration) and
`familiar.safetensors` (what features look like on validation scenes).
"""

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
FAMILIAR = "familiar.safetensors"
FORMAT, VERSION = "covis-eyes", 5
SAME_TENSORS = (3, 4, 5)
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
"""Of what the corrections are quadratic functions, each with a usual value, see `calibration_features`."""
ADDED = {"class epistemic": 1e-4, "depth spread": 0.001, "box overlap": 0.8, "strangeness": 1.0}
"""Of what they are linear functions besides; the last column of the features is of the strangeness."""
TERMS = (len(QUANTITIES) + 1) * (len(QUANTITIES) + 2) // 2 + len(ADDED)
FARTHEST = 3.0
"""Quantities are held within a factor e^3 of the usual: a square is no guide beyond what calibration has seen."""
CORRECTIONS = ("depth", "along", "horizontal", "vertical")


@dataclass(frozen=True, eq=False)
class Familiar:
    """What the backbone's features at objects look like on validation scenes.

    Attributes:
        mean: (d,).
        whitening: (d, d), which turns deviations from the mean into uncorrelated ones of unit variance.
    """

    mean: NDArray[np.float32]
    whitening: NDArray[np.float32]

    @classmethod
    def of(cls, features: Array, share: Array, shrinkage: float = 0.05) -> Familiar:
        """Of features (k, d), each counting by its `share` (k,).

        `shrinkage` of the mean variance is added to every variance: directions that validation scenes hardly know do
        not decide alone.
        """
        mean = share @ features / share.sum()
        away = features - mean
        covariance = (away * share[:, None]).T @ away / share.sum()
        values, vectors = np.linalg.eigh(covariance + shrinkage * covariance.trace() / len(mean) * np.eye(len(mean)))
        return cls(mean.astype(np.float32), (vectors / np.sqrt(values)).astype(np.float32))

    def strangeness(self, features: Array) -> Array:
        """Squared Mahalanobis distances (n,) of features (n, d) over d: about 1 on validation scenes."""
        return (((features - self.mean) @ self.whitening) ** 2).mean(axis=1)


@dataclass(frozen=True)
class Calibration:
    """What makes depths unbiased and the reported uncertainty true, found on validation seeds.

    Attributes:
        depth: coefficients of the `calibration_features` in the log of the factor on the depth.
        along, horizontal, vertical: the same for the factors on the variance along the viewing ray, beyond the square
            of that on the depth, and on the variances of the projected centre along the image's two axes.
        class_temperature: logits are divided by it.
        familiar: against what strangeness is measured; None = it is not.
    """

    depth: tuple[float, ...] = (0.0,) * TERMS
    along: tuple[float, ...] = (0.0,) * TERMS
    horizontal: tuple[float, ...] = (0.0,) * TERMS
    vertical: tuple[float, ...] = (0.0,) * TERMS
    class_temperature: float = 1.0
    familiar: Familiar | None = field(default=None, compare=False)

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
    class_epistemic: Array,
    depth_spread: Array,
    box_overlap: Array,
    strangeness: Array,
) -> Array:
    """What is known of how sure n objects are (n, TERMS): 1, the logarithms of QUANTITIES, all products of two of them,
    and the logarithms of what is ADDED.

    Args:
        depth: (n,) m, uncalibrated like all the others.
        depth_variance, depth_epistemic: (n,) m^2, the whole and the part between samples.
        centre_variance: (n,) of the projected centre per axis, in squares of the box's size along it.
        confidence: (n,) that this is an object.
        size: (n, 2) px, width and height of the box.
        class_epistemic: (n,) the part of v that is variance between samples.
        depth_spread: (n,) variance of the log depth between the pixels of the mask.
        box_overlap: (n,) IoU of the box with that of the mask.
        strangeness: (n,) see `Familiar`; 1 where it is not measured.
    """
    single = depth_epistemic == 0  # a single sample: what differs between samples is unknown
    share = np.where(single, QUANTITIES["epistemic"], np.maximum(depth_epistemic / depth_variance, 0.02))
    raw = (depth_variance / depth**2, share, centre_variance, np.maximum(confidence, 0.05), depth, *size.T)
    x = [_log(values, usual) for values, usual in zip(raw, QUANTITIES.values(), strict=True)]
    products = [x[i] * x[j] for i in range(len(x)) for j in range(i, len(x))]
    between = np.where(single, ADDED["class epistemic"], class_epistemic)
    more = zip((between, depth_spread, box_overlap, strangeness), ADDED.values(), strict=True)
    return np.stack([np.ones(len(depth)), *x, *products, *(_log(values, usual) for values, usual in more)], axis=1)


def with_strangeness(features: Array, strangeness: Array) -> Array:
    """Features (n, TERMS) as they are for objects of that strangeness (n,)."""
    return np.concatenate([features[:, :-1], _log(strangeness, ADDED["strangeness"])[:, None]], axis=1)


def _log(values: Array, usual: float) -> Array:
    return np.clip(np.log(np.maximum(values, 1e-8) / usual), -FARTHEST, FARTHEST)


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
    """Write all files; the manifest last, so that it never vouches for a half-written file."""
    from safetensors.numpy import save as arrays_to_bytes
    from safetensors.torch import save as to_bytes

    folder.mkdir(parents=True, exist_ok=True)
    content = to_bytes({name: tensor.detach().contiguous().clone() for name, tensor in weights.tensors.items()})
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "sha256": hashlib.sha256(content).hexdigest(),
        "network": dict(weights.network),
        "calibration": {name: value for name, value in vars(weights.calibration).items() if name != "familiar"},
        "notes": dict(weights.notes),
    }
    familiar = weights.calibration.familiar
    if familiar is not None:
        arrays = arrays_to_bytes(vars(familiar))
        manifest["familiar_sha256"] = hashlib.sha256(arrays).hexdigest()
        _replace(folder / FAMILIAR, arrays)
    _replace(folder / TENSORS, content)
    _replace(folder / MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())


def load(folder: Path | None = None, *, calibrated: bool = True) -> Weights:
    """The weights in a folder; None = those that come with the package.

    Without `calibrated` only the class temperature of their calibration is read, which may be of an older version.

    Raises:
        WeightsError: a file is missing, the tensors are not those that the manifest vouches for, another format.
    """
    from safetensors.numpy import load as arrays_from_bytes
    from safetensors.torch import load as from_bytes

    folder = SHIPPED if folder is None else folder
    for name in (MANIFEST, TENSORS):
        if not (folder / name).is_file():
            raise WeightsError(f"learned perception needs {folder / name}: train it with `covis train perception`")
    manifest = read_manifest(folder, (VERSION,) if calibrated else SAME_TENSORS)
    tensors = from_bytes(_verified(folder / TENSORS, manifest["sha256"]))
    stated = manifest["calibration"]
    if calibrated:
        vouched = manifest.get("familiar_sha256")
        familiar = Familiar(**arrays_from_bytes(_verified(folder / FAMILIAR, vouched))) if vouched else None
        calibration = Calibration(**stated, familiar=familiar)
    else:
        calibration = Calibration(class_temperature=stated.get("class_temperature", 1.0))
    return Weights(tensors, manifest["network"], calibration, manifest.get("notes", {}))


def _verified(path: Path, expected: str) -> bytes:
    if not path.is_file():
        raise WeightsError(f"learned perception needs {path}, for which the manifest vouches")
    content = path.read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        raise WeightsError(f"{path} has been altered: SHA-256 {found}, expected {expected}")
    return content


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
