"""The networks that can be trained and looked with, by the names that `--network` and stored weights give them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from . import weights as stored
from .learned import LearnedPerception, LearnedPerceptionParams
from .losses import losses
from .network import Eyes, NetworkParams

KIND = "kind"
"""Key under which the manifest of weights names the network; without it they are of `compact`."""


@dataclass(frozen=True)
class Kind:
    """One kind of network.

    Attributes:
        params: its sizes from a dict, the other way round `to_dict`.
        build: the network of such params, in the memory format in which it learns fastest; it keeps them as `params`.
        losses: `(network, batch, weights, generator, *, bf16) -> {part: loss}`, their sum as `total`.
        perceptor: eyes with such a network.
        learning_rate: of AdamW, at its highest.
        pairs: pairs of frames per batch.
        masks: training needs whole masks in its batches.
    """

    params: Callable[[Mapping[str, Any]], Any]
    build: Callable[[Any], nn.Module]
    losses: Callable[..., dict[str, Tensor]]
    perceptor: type[LearnedPerception]
    learning_rate: float
    pairs: int
    masks: bool = False


def kind(name: str) -> Kind:
    """The kind of that name: `compact`, ours, or `maskrcnn`, the paper's.

    Raises:
        ValueError: no such kind.
        ImportError: `maskrcnn` without torchvision.
    """
    if name == "compact":
        return Kind(
            lambda d: NetworkParams.from_dict(dict(d)),
            lambda params: Eyes(params).to(memory_format=torch.channels_last),
            losses,
            LearnedPerception,
            learning_rate=1.5e-3,
            pairs=4,
        )
    if name == "maskrcnn":
        try:
            from . import maskrcnn
        except ImportError as error:
            raise ImportError(f"the paper's network needs torchvision: install covis[torchvision] ({error})") from error
        return Kind(
            maskrcnn.MaskRCNNParams.from_dict,
            maskrcnn.PaperNetwork,
            maskrcnn.losses,
            maskrcnn.MaskRCNNPerception,
            learning_rate=3e-4,
            pairs=1,  # an image costs seconds: many small steps rather than a few large ones
            masks=True,
        )
    raise ValueError(f"no network is called {name!r}; there are compact, maskrcnn")


def network_params(name: str, classes: Sequence[str]) -> Any:
    """Sizes of a network of that kind, for these classes."""
    return kind(name).params({"classes": list(classes)})


def open_eyes(
    weights: stored.Weights,
    classes: Sequence[str],
    params: LearnedPerceptionParams | None = None,
    image_size: tuple[int, int] | None = None,
) -> LearnedPerception:
    """Eyes with these weights, whichever network they are of.

    Raises:
        ValueError: a class that the network does not know, or an unknown kind of network.
        WeightsError: what that kind needs is not installed.
    """
    try:
        needed = kind(weights.network.get(KIND, "compact"))
    except ImportError as error:
        raise stored.WeightsError(str(error)) from error
    return needed.perceptor(classes, weights, params, image_size)
