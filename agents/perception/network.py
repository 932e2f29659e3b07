"""The network behind the learned eyes: one backbone pass per image, then small heads on the objects' cells alone.

A residual backbone (strides 2 to 32) and a light feature pyramid give features at strides 4, 8 and 16. From the finest
come a heat map of visible centres at stride 2 (by pixel shuffle), and mask features at stride 2. At each centre a small
head, which reads all three (fine ones for small objects in a crowd, coarse ones for what is near and cut up), gives
class, box, place of the projected 3-D centre, appearance, and the weights of that object's own mask head (dynamic
masks, since grouping pixels by predicted offsets was the bottleneck of earlier trials). At pixels of each object
another small head gives the depth of the object's centre and its log-variance.

Monte Carlo dropout (section 3.3) sits in these late heads only: the backbone runs once, and T samples of the
heads are one batch over the objects' cells.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

STRIDES = (4, 8, 16)
"""Of the features that the heads read."""
FINE_STRIDE = 2
"""Of heat map and masks."""
DENSE_PARTS = (
    "stem",
    "stages",
    "context",
    "lateral",
    "smooth",
    "to_heat",
    "to_fine",
    "from_stem",
    "mask_mix",
)
"""Attributes of `Eyes` that run once per image; the others run per object."""
GEOMETRY_CHANNELS = 4
REFERENCE_FOCAL_PX = 200.0
CENTRE_GEOMETRY = 3
OBJECT_GEOMETRY = 14
LOWEST_CAMERA_M = 0.05


@dataclass(frozen=True)
class NetworkParams:
    """Sizes of the network.

    Attributes:
        classes: names, in the order of the class head.
        widths: channels at strides 2, 4, 8, 16, 32.
        blocks: residual blocks at strides 4, 8, 16, 32.
        neck: channels of the pyramid.
        mask_channels: features at stride 2 that mask heads read.
        mask_hidden: width of each object's own mask head.
        head: width of the class and depth heads; the head of boxes and masks is twice as wide.
        embedding: length of the appearance vector.
        dropout: rate in the class head.
        depth_dropout: rate in the depth head.
    """

    classes: tuple[str, ...]
    widths: tuple[int, ...] = (16, 32, 64, 128, 192)
    blocks: tuple[int, ...] = (1, 2, 3, 2)
    neck: int = 64
    mask_channels: int = 16
    mask_hidden: int = 8
    head: int = 128
    embedding: int = 32
    dropout: float = 0.3
    depth_dropout: float = 0.3

    def __post_init__(self) -> None:
        if not self.classes or len(set(self.classes)) != len(self.classes):
            raise ValueError(f"classes must be distinct and at least one, got {self.classes!r}")
        if len(self.widths) != 5 or len(self.blocks) != 4:
            raise ValueError(f"5 widths and 4 numbers of blocks are needed, got {self.widths} and {self.blocks}")
        for name in ("dropout", "depth_dropout"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} must be in [0, 1), got {getattr(self, name)}")

    @property
    def mask_weights(self) -> int:
        """Numbers that make one object's mask head: two hidden layers on features and two coordinates."""
        h = self.mask_hidden
        return (self.mask_channels + 2) * h + h + h * h + h + h + 1

    def to_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkParams:
        plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        return cls(**plain)


@dataclass(frozen=True, eq=False)
class DenseFeatures:
    """What one backbone pass gives for b images.

    Attributes:
        heat: (b, H/2, W/2) logits: is the visible centre of an object here?
        cells: (b, H/4, W/4, c), (b, H/8, W/8, c) and (b, H/16, W/16, c) features of the heads.
        mask: (b, H/2, W/2, m) features of the mask heads.
    """

    heat: Tensor
    cells: tuple[Tensor, ...]
    mask: Tensor


@dataclass(frozen=True, eq=False)
class Geometry:
    """Where b cameras look.

    Attributes:
        focal: (b,) px.
        centre: (b, 2) principal point, px.
        up: (b, 3) unit vector against gravity, camera frame.
        height: (b,) m above the ground, as the robot's own pose says.
        height_std: (b,) m, 1 sigma of that; infinite where nothing is known.
    """

    focal: Tensor
    centre: Tensor
    up: Tensor
    height: Tensor
    height_std: Tensor

    @classmethod
    def of(cls, intrinsics: Tensor, up: Tensor, height: Tensor, height_std: Tensor) -> Geometry:
        """From intrinsics (b, 3, 3), up (b, 3), height (b,) and its deviation (b,)."""
        focal = 0.5 * (intrinsics[:, 0, 0] + intrinsics[:, 1, 1])
        return cls(focal.float(), intrinsics[:, :2, 2].float(), up.float(), height.float(), height_std.float())

    def rays(self, image: Tensor, pixels: Tensor) -> Tensor:
        """Directions (k, 3) with unit z of pixels (k, 2) of images (k,)."""
        xy = (pixels - self.centre[image]) / self.focal[image, None]
        return torch.cat([xy, torch.ones_like(xy[:, :1])], dim=1)

    def elevation(self, image: Tensor, rays: Tensor) -> Tensor:
        """Sine of the angle (k,) of rays (k, 3) above the horizon."""
        return (rays * self.up[image]).sum(1) / rays.norm(dim=1)

    def log_height(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Log of the height (k,), and how far it can be trusted (k,), from 0 (unknown) to 1 (exact)."""
        height = self.height[image].clamp(min=LOWEST_CAMERA_M)
        return torch.log(height), 1 / (1 + (self.height_std[image] / height) ** 2)

    def maps(self, height: int, width: int) -> Tensor:
        """Channels (b, 4, height, width): ray x and y, sine of elevation, log focal length."""
        b, device = len(self.focal), self.focal.device
        v = (torch.arange(height, device=device) + 0.5)[None, :, None]
        u = (torch.arange(width, device=device) + 0.5)[None, None, :]
        x = ((u - self.centre[:, 0, None, None]) / self.focal[:, None, None]).expand(b, height, width)
        y = ((v - self.centre[:, 1, None, None]) / self.focal[:, None, None]).expand(b, height, width)
        up = self.up[:, :, None, None]
        elevation = (x * up[:, 0] + y * up[:, 1] + up[:, 2]) / torch.sqrt(x * x + y * y + 1)
        log_focal = torch.log(self.focal / REFERENCE_FOCAL_PX)[:, None, None].expand(b, height, width)
        return torch.stack([x, y, 2 * elevation, log_focal], dim=1)


@dataclass(frozen=True, eq=False)
class ObjectOutputs:
    """What the centre head gives for k objects; everything but the class is the same in every sample.

    Attributes:
        box: (k, 4) log of the distances from the centre to the box's left, top, right, bottom edge, px / 16.
        centre: (k, 2) from the visible to the projected 3-D centre, in units of the box's size.
        centre_log_variance: (k,) of that, per axis.
        overlap: (k,) logit of the IoU that the mask is expected to have with the object.
        mask: (k, NetworkParams.mask_weights).
        embedding: (k, e) unit vectors.
    """

    box: Tensor
    centre: Tensor
    centre_log_variance: Tensor
    overlap: Tensor
    mask: Tensor
    embedding: Tensor


class Eyes(nn.Module):
    """The network; see the module's docstring."""

    def __init__(self, params: NetworkParams) -> None:
        super().__init__()
        self.params = params
        w, c = params.widths, params.neck
        self.stem = _conv(3 + GEOMETRY_CHANNELS, w[0], stride=2)
        self.stages = nn.ModuleList(
            nn.Sequential(_conv(w[i], w[i + 1], stride=2), *(_Residual(w[i + 1]) for _ in range(n)))
            for i, n in enumerate(params.blocks)
        )
        self.context = nn.Linear(w[4], w[4])
        self.lateral = nn.ModuleList(nn.Conv2d(n, c, 1) for n in w[1:])
        self.smooth = nn.ModuleList(_conv(c, c) for _ in range(2))
        self.to_heat = nn.Sequential(_conv(c, 32), nn.Conv2d(32, FINE_STRIDE**2, 1))
        self.to_fine = nn.Conv2d(c, FINE_STRIDE**2 * params.mask_channels, 1)
        self.from_stem = nn.Conv2d(w[0], params.mask_channels, 1)
        self.mask_mix = nn.Sequential(_conv(params.mask_channels, 16), nn.Conv2d(16, params.mask_channels, 1))
        n_in = len(STRIDES) * c + CENTRE_GEOMETRY
        self.object_in = nn.Linear(n_in, 2 * params.head)
        self.object_out = nn.Linear(2 * params.head, 4 + 4 + params.mask_weights + params.embedding)
        self.class_in = nn.Linear(n_in, params.head)
        self.class_out = nn.Linear(params.head, len(params.classes))
        self.depth_in = nn.Linear(len(STRIDES) * c + OBJECT_GEOMETRY, params.head)
        self.depth_mid = nn.Linear(params.head, params.head)
        self.depth_out = nn.Linear(params.head, 2)
        self._initialise()

    def _initialise(self) -> None:
        heat = self.to_heat[-1]
        assert isinstance(heat, nn.Conv2d)
        assert heat.bias is not None
        nn.init.constant_(heat.bias, -5.0)
        nn.init.normal_(heat.weight, std=0.01)
        nn.init.normal_(self.object_out.weight, std=0.02)
        nn.init.zeros_(self.object_out.bias)
        nn.init.normal_(self.depth_out.weight, std=0.02)
        with torch.no_grad():
            self.depth_out.bias.copy_(torch.tensor([2.0, -2.0]))

    def dense_to(self, dtype: torch.dtype) -> None:
        """Let the part that runs once per image compute in `dtype`; the heads stay as they are."""
        for name in DENSE_PARTS:
            getattr(self, name).to(dtype)

    def forward(self, image: Tensor, geometry: Geometry) -> DenseFeatures:
        """Dense features of images (b, 3, H, W) in [-1, 1], float32 whatever the part that runs once computes in."""
        x = torch.cat([image, geometry.maps(*image.shape[2:])], dim=1)
        x = x.to(self.lateral[0].weight.dtype, memory_format=torch.channels_last)
        stem = self.stem(x)
        levels, y = [], stem
        for stage in self.stages:
            y = stage(y)
            levels.append(y)
        levels[3] = levels[3] + self.context(levels[3].mean((2, 3)))[:, :, None, None]
        top = self.lateral[3](levels[3])
        coarse = self.lateral[2](levels[2]) + _twice(top, levels[2])
        middle = self.smooth[0](self.lateral[1](levels[1]) + _twice(coarse, levels[1]))
        cells = self.smooth[1](self.lateral[0](levels[0]) + _twice(middle, levels[0]))
        heat = F.pixel_shuffle(self.to_heat(cells), FINE_STRIDE)[:, 0]
        mask = self.mask_mix(F.relu(F.pixel_shuffle(self.to_fine(cells), FINE_STRIDE) + self.from_stem(stem)))
        read = tuple(level.permute(0, 2, 3, 1).float() for level in (cells, middle, coarse))
        return DenseFeatures(heat.float(), read, mask.permute(0, 2, 3, 1).float())

    def objects(self, found: Tensor) -> ObjectOutputs:
        """Of centre features (k, 3 c + CENTRE_GEOMETRY), see `centre_features`."""
        out = self.object_out(F.relu(self.object_in(found)))
        box, centre, log_variance, overlap, mask, embedding = out.split(
            [4, 2, 1, 1, self.params.mask_weights, self.params.embedding], dim=1
        )
        embedding = F.normalize(embedding, dim=1)
        return ObjectOutputs(box, centre, log_variance[:, 0].clamp(-10, 2), overlap[:, 0], mask, embedding)

    def class_logits(self, found: Tensor, sample: bool, generator: torch.Generator | None = None) -> Tensor:
        """Logits (..., classes) of centre features; with `sample` a draw from the dropout posterior."""
        p = self.params.dropout if sample else 0.0
        hidden = F.relu(self.class_in(dropout(found, p / 2, generator)))
        return self.class_out(dropout(hidden, p, generator))

    def depth(
        self, seen: Tensor, sample: bool, generator: torch.Generator | None = None, draws: int = 1
    ) -> tuple[Tensor, Tensor]:
        """Log depth of the object's centre over focal length, and log-variance of it, (draws, k) each.

        `seen` (k, 3 c + OBJECT_GEOMETRY) as `depth_features` makes it; with `sample` every draw is one from the dropout
        posterior. The first layer is before all dropout and computed once.
        """
        p = self.params.depth_dropout if sample else 0.0
        hidden = F.relu(self.depth_in(seen)).expand(draws, len(seen), self.params.head)
        hidden = F.relu(self.depth_mid(dropout(hidden, p, generator)))
        out = self.depth_out(dropout(hidden, p, generator))
        return out[..., 0], out[..., 1].clamp(-12, 3)

    @property
    def n_parameters(self) -> int:
        return sum(p.numel() for p in self.parameters())


def centre_features(dense: DenseFeatures, geometry: Geometry, image: Tensor, pixels: Tensor) -> Tensor:
    """Input (k, 3 c + CENTRE_GEOMETRY) of the heads at centres: features there, elevation and ray."""
    rays = geometry.rays(image, pixels)
    geometric = torch.stack([4 * geometry.elevation(image, rays), rays[:, 0], rays[:, 1]], dim=1)
    return torch.cat([*_features_at(dense, image, pixels), geometric], dim=1)


def _features_at(dense: DenseFeatures, image: Tensor, pixels: Tensor) -> list[Tensor]:
    return [bilinear(cells, image, pixels, stride) for cells, stride in zip(dense.cells, STRIDES, strict=True)]


def depth_features(dense: DenseFeatures, geometry: Geometry, image: Tensor, pixels: Tensor, box: Tensor) -> Tensor:
    """Input (k, 3 c + OBJECT_GEOMETRY) of the depth head at pixels (k, 2) of objects with boxes (k, 4) px.

    With the features go what a surveyor would use: where the box ends against the horizon (a body on the ground is as
    far as its foot is low, in units of the camera's height) and how large it looks.
    """
    focal = geometry.focal[image]
    log_focal = torch.log(focal / REFERENCE_FOCAL_PX)
    log_height, trust = geometry.log_height(image)
    rays = geometry.rays(image, pixels)
    size = (box[:, 2:] - box[:, :2]).clamp(min=1.0)
    middle = 0.5 * (box[:, 0] + box[:, 2])
    foot = geometry.elevation(image, geometry.rays(image, torch.stack([middle, box[:, 3]], dim=1)))
    head = geometry.elevation(image, geometry.rays(image, torch.stack([middle, box[:, 1]], dim=1)))
    log_foot = torch.log(foot.abs().clamp(min=0.01))
    place = (pixels - box[:, :2]) / size
    geometric = torch.stack(
        [
            4 * geometry.elevation(image, rays),
            rays[:, 0],
            rays[:, 1],
            4 * foot,
            4 * head,
            log_foot,
            log_focal,
            trust,
            trust * log_height,
            trust * (log_height - log_foot - log_focal),  # a foot on level ground, in units of the answer
            torch.log(size[:, 0] / focal),
            torch.log(size[:, 1] / focal),
            place[:, 0].clamp(-1, 2),
            place[:, 1].clamp(-1, 2),
        ],
        dim=1,
    )
    return torch.cat([*_features_at(dense, image, pixels), geometric], dim=1)


def boxes_from(log_edges: Tensor, pixels: Tensor) -> Tensor:
    """Boxes (k, 4) px from the centre head's `box` (k, 4) at pixels (k, 2)."""
    edges = 16.0 * torch.exp(log_edges.clamp(-5, 4))
    return torch.cat([pixels - edges[:, :2], pixels + edges[:, 2:]], dim=1)


def mask_logits(weights: Tensor, features: Tensor, coordinates: Tensor, params: NetworkParams) -> Tensor:
    """Logits (k, s) of k objects' own mask heads (k, mask_weights) at s points each.

    Args:
        features: (k, s, mask_channels).
        coordinates: (k, s, 2) of the points from the visible centre, in units of half the box's size.
    """
    h, m = params.mask_hidden, params.mask_channels + 2
    w1, b1, w2, b2, w3, b3 = weights.split([m * h, h, h * h, h, h, 1], dim=1)
    x = torch.cat([features, coordinates], dim=2)
    x = F.relu(torch.baddbmm(b1[:, None], x, w1.view(-1, m, h)))
    x = F.relu(torch.baddbmm(b2[:, None], x, w2.view(-1, h, h)))
    return torch.baddbmm(b3[:, None], x, w3.view(-1, h, 1))[..., 0]


def bilinear(maps: Tensor, image: Tensor, pixels: Tensor, stride: int) -> Tensor:
    """Values (k, c) of maps (b, h, w, c) with a stride, at pixels (k, 2) of images (k,)."""
    b, h, w, c = maps.shape
    xy = pixels / stride - 0.5
    x = xy[:, 0].clamp(0, w - 1)
    y = xy[:, 1].clamp(0, h - 1)
    x0, y0 = x.floor().clamp(max=w - 2), y.floor().clamp(max=h - 2)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    flat = maps.reshape(b * h * w, c)
    at = (image * h + y0.long()) * w + x0.long()
    upper = flat[at] * (1 - fx) + flat[at + 1] * fx
    lower = flat[at + w] * (1 - fx) + flat[at + w + 1] * fx
    return upper * (1 - fy) + lower * fy


def dropout(x: Tensor, rate: float, generator: torch.Generator | None) -> Tensor:
    """Dropout that draws from its own generator, so that samples are reproducible.

    One random byte per number, eight of a draw: drawing is most of the cost. The rate is that of the nearest 1/256.
    """
    dropped = min(round(256 * rate), 255)
    if dropped == 0:
        return x
    n = x.numel()
    draws = torch.empty((n + 7) // 8, dtype=torch.int64).random_(-(2**63), None, generator=generator)
    keep = draws.view(torch.uint8)[:n].view(x.shape) >= dropped
    return x * keep / (1 - dropped / 256)


def normalised(images: Tensor) -> Tensor:
    """uint8 images (b, H, W, 3) as the network takes them (b, 3, H, W)."""
    return images.permute(0, 3, 1, 2).float() / 127.5 - 1.0


def _conv(n_in: int, n_out: int, *, stride: int = 1, kernel: int = 3) -> nn.Sequential:
    conv = nn.Conv2d(n_in, n_out, kernel, stride, kernel // 2, bias=False)
    nn.init.kaiming_normal_(conv.weight, mode="fan_out", nonlinearity="relu")
    return nn.Sequential(conv, nn.BatchNorm2d(n_out), nn.ReLU(inplace=True))


class _Residual(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = _conv(channels, channels)
        self.second = nn.Sequential(nn.Conv2d(channels, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels))
        norm = self.second[1]
        assert isinstance(norm, nn.BatchNorm2d)
        nn.init.constant_(norm.weight, 1 / math.sqrt(2))

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.second(self.first(x)))


def _twice(x: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(x, size=like.shape[2:], mode="nearest")
