"""The paper's own eyes: Mask R-CNN with dropout in its box head, and depth from a second ResNet-50 with dropout.

Sections 3.1, 3.3.1 and 3.3.2 on torchvision's building blocks, trained from nothing (no weights are downloaded). It is
far larger than `network.py` and far slower on a CPU: it is here to compare with.
Backbones, proposals and the first layer of each head run once per image; T samples are drawn of what follows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torchvision.models import get_model
from torchvision.models.detection import MaskRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import BackboneWithFPN
from torchvision.models.detection.roi_heads import paste_masks_in_image
from torchvision.ops import batched_nms, clip_boxes_to_image

from ...matching.pose import Array
from . import weights as stored
from .decode import spread_pixels, tight_boxes
from .learned import Clock, LearnedPerception, Objects, View, class_uncertainty, depth_uncertainty
from .losses import Batch, LossWeights, gaussian_loss
from .network import REFERENCE_FOCAL_PX, bilinear, dropout

STRIDE = 4
"""Of the features from which depth is read."""
CHANNELS = 256
"""Of torchvision's feature pyramid."""
GROUPS = 32
"""Of group normalisation."""
ANCHORS_PX = (12, 24, 48, 96, 192)
"""At strides 4 to 64: half of the objects are less than 20 px across, where torchvision's own anchors begin at 32."""
ASPECTS = (0.5, 1.0, 2.0)
NMS_IOU = 0.5
CENTRE_STD = 0.1
"""1 sigma of the projected centre before calibration, in sizes of the box."""


@dataclass(frozen=True)
class MaskRCNNParams:
    """Sizes of the network.

    Attributes:
        classes: names, in the order of the class head (which has the background before them).
        backbone: of torchvision's ResNets, for detection and for depth.
        image_size: (width, height) at which the network looks; other images are scaled to it.
        proposals: regions that reach the box head of one image; in training half of them are learned from.
        representation: width of the box head.
        dropout: rate in the box head and in the depth head.
    """

    kind: ClassVar[str] = "maskrcnn"

    classes: tuple[str, ...]
    backbone: str = "resnet50"
    image_size: tuple[int, int] = (320, 240)
    proposals: int = 128
    representation: int = 1024
    dropout: float = 0.3

    def __post_init__(self) -> None:
        if not self.classes or len(set(self.classes)) != len(self.classes):
            raise ValueError(f"classes must be distinct and at least one, got {self.classes!r}")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout must be in [0, 1), got {self.dropout}")

    def to_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self) | {"kind": self.kind}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> MaskRCNNParams:
        plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items() if k != "kind"}
        return cls(**plain)


class BoxHead(nn.Module):
    """Two layers, dropout before and after the second; what comes before all dropout is computed once."""

    def __init__(self, width: int, rate: float) -> None:
        super().__init__()
        self.first = nn.Linear(CHANNELS * 7 * 7, width)
        self.second = nn.Linear(width, width)
        self.rate = rate

    def forward(self, pooled: Tensor) -> Tensor:
        """Training: one draw from the dropout posterior, by torch's global generator."""
        return self.sample(self.before(pooled), self.rate if self.training else 0.0, None)

    def before(self, pooled: Tensor) -> Tensor:
        return F.relu(self.first(pooled.flatten(1)))

    def sample(self, hidden: Tensor, rate: float, generator: torch.Generator | None) -> Tensor:
        hidden = F.relu(self.second(dropout(hidden, rate, generator)))
        return dropout(hidden, rate, generator)


class DepthNetwork(nn.Module):
    """Log depth of the object that a pixel belongs to, over the focal length, and its log-variance."""

    def __init__(self, backbone: str, rate: float) -> None:
        super().__init__()
        self.features = _pyramid(backbone)
        self.smooth = nn.Sequential(nn.Conv2d(CHANNELS, 128, 3, padding=1), nn.ReLU(inplace=True))
        self.hidden = nn.Linear(128, 128)
        self.out = nn.Linear(128, 2)
        self.rate = rate
        nn.init.normal_(self.out.weight, std=0.02)
        with torch.no_grad():
            self.out.bias.copy_(torch.tensor([2.0, -2.0]))

    def forward(self, images: Tensor) -> Tensor:
        """Maps (b, H/4, W/4, 128)."""
        return self.smooth(self.features(images)["0"]).permute(0, 2, 3, 1)

    def read(self, seen: Tensor, sample: bool, generator: torch.Generator | None, draws: int) -> tuple[Tensor, Tensor]:
        """Log depth and log-variance (draws, k) of map values (k, 128)."""
        rate = self.rate if sample else 0.0
        hidden = F.relu(self.hidden(dropout(seen.expand(draws, *seen.shape), rate, generator)))
        out = self.out(dropout(hidden, rate, generator))
        return out[..., 0], out[..., 1].clamp(-12, 3)


class PaperNetwork(nn.Module):
    """Both networks; see the module's docstring."""

    def __init__(self, params: MaskRCNNParams) -> None:
        super().__init__()
        self.params = params
        width, height = params.image_size
        self.detector = MaskRCNN(
            _pyramid(params.backbone),
            1 + len(params.classes),
            min_size=min(width, height),
            max_size=max(width, height),
            image_mean=[0.5] * 3,
            image_std=[0.5] * 3,
            rpn_anchor_generator=AnchorGenerator(tuple((a,) for a in ANCHORS_PX), (ASPECTS,) * len(ANCHORS_PX)),
            rpn_pre_nms_top_n_test=4 * params.proposals,
            rpn_post_nms_top_n_test=params.proposals,
            rpn_post_nms_top_n_train=4 * params.proposals,
            box_batch_size_per_image=params.proposals // 2,
        )
        self.detector.roi_heads.box_head = BoxHead(params.representation, params.dropout)
        predictor = self.detector.roi_heads.box_predictor
        for layer in ("cls_score", "bbox_pred"):
            setattr(predictor, layer, nn.Linear(params.representation, getattr(predictor, layer).out_features))
        nn.init.normal_(self.detector.roi_heads.mask_predictor.mask_fcn_logits.weight, std=0.001)
        self.depth = DepthNetwork(params.backbone, params.dropout)


def _pyramid(backbone: str) -> nn.Module:
    """Pyramid whose every convolution is normalised: from nothing, features that grow with depth never settle.

    By groups, not batches: a batch is one pair of views of one scene, and its statistics are no guide to another's.
    """
    norm = partial(nn.GroupNorm, GROUPS)
    body = get_model(backbone, weights=None, norm_layer=norm, zero_init_residual=True)
    stages = {f"layer{i + 1}": str(i) for i in range(4)}
    widths = [body.inplanes // 8 * 2**i for i in range(4)]
    return BackboneWithFPN(body, stages, widths, CHANNELS, norm_layer=norm)


def losses(
    network: PaperNetwork, batch: Batch, weights: LossWeights, generator: torch.Generator | None, *, bf16: bool = False
) -> dict[str, Tensor]:
    """torchvision's losses of detection, that of depth at pixels of the objects, and their weighted sum as `total`.

    All in float32, whatever `bf16` says: torchvision's pooling of regions knows nothing else on a CPU.
    """
    assert batch.masks is not None
    images = batch.images.permute(0, 3, 1, 2).contiguous().float() / 255
    targets = [
        {
            "boxes": batch.boxes[batch.image == i],
            "labels": batch.object_class[batch.image == i] + 1,
            "masks": batch.masks[batch.image == i],
        }
        for i in range(len(images))
    ]
    with torch.random.fork_rng(devices=[]):
        if generator is not None:
            torch.manual_seed(generator.initial_seed())
        found = network.detector(list(images), targets)
    parts = {
        "heat": found["loss_objectness"],
        "box": found["loss_rpn_box_reg"] + found["loss_box_reg"],
        "classes": found["loss_classifier"],
        "mask": found["loss_mask"],
    }
    if len(batch.image):
        parts["depth"] = _depth_loss(network.depth, images, batch, generator)
    parts["total"] = torch.stack([getattr(weights, name) * value for name, value in parts.items()]).sum()
    return parts


def _depth_loss(depth: DepthNetwork, images: Tensor, batch: Batch, generator: torch.Generator | None) -> Tensor:
    k, points = batch.depth_points.shape[:2]
    image = batch.image[:, None].expand(k, points).reshape(-1)
    seen = bilinear(depth(2 * images - 1), image, batch.depth_points.reshape(-1, 2), STRIDE)
    log_depth, log_variance = depth.read(seen, True, generator, 1)
    wanted = torch.log(batch.depth / (batch.geometry.focal[batch.image] / REFERENCE_FOCAL_PX))
    error = log_depth.view(k, points) - wanted[:, None]
    return gaussian_loss(error, log_variance.view(k, points), batch.located[:, None])


class MaskRCNNPerception(LearnedPerception):
    """A perceptor with the paper's network; like `LearnedPerception`, without appearance vectors."""

    network: PaperNetwork

    def _build(self, weights: stored.Weights) -> PaperNetwork:
        network = PaperNetwork(MaskRCNNParams.from_dict(weights.network))
        network.load_state_dict(dict(weights.tensors))
        return network.eval().requires_grad_(False)

    def _objects(self, view: View, generator: torch.Generator, clock: Clock) -> Objects:
        pixels = torch.from_numpy(view.image).permute(2, 0, 1).float() / 255
        scores, masks, attributes, v, v_epistemic = self._detect(pixels, generator)
        tight, visible = tight_boxes(masks), masks.sum(axis=(1, 2))
        clock.lap("objects")
        at = torch.from_numpy(spread_pixels(masks, visible, tight, self.params.depth_pixels))
        depth, variance, epistemic, spread = self._object_depths(pixels, at, float(view.intrinsics[0, 0]), generator)
        clock.lap("depth")
        return Objects(
            scores=scores,
            pixels=visible,
            masks=masks,
            tight=tight,
            attributes=attributes,
            attribute_variance=v,
            attribute_epistemic=v_epistemic,
            pixel=_centroids(masks),
            size=tight[:, 2:] - tight[:, :2],
            centre_variance=np.full(len(masks), CENTRE_STD**2),
            depth=depth,
            depth_variance=variance,
            depth_epistemic=epistemic,
            depth_spread=spread,
            box_overlap=np.ones(len(masks)),
        )

    def _detect(
        self, image: Tensor, generator: torch.Generator
    ) -> tuple[Array, NDArray[np.bool_], Array, Array, Array]:
        """Confidence (n,), mask (n, H, W), class distribution (n, c), its uncertainty (n,), epistemic part of that."""
        detector, p = self.network.detector, self.params
        roi = detector.roi_heads
        scaled, _ = detector.transform([image])
        features = detector.backbone(scaled.tensors)
        (proposals,), _ = detector.rpn(scaled, features)
        hidden = roi.box_head.before(roi.box_roi_pool(features, [proposals], scaled.image_sizes))
        T = p.samples
        rate = self.network.params.dropout if T > 1 else 0.0
        logits, moves = roi.box_predictor(
            roi.box_head.sample(hidden.expand(T, *hidden.shape).flatten(0, 1), rate, generator)
        )
        foreground = torch.cat([torch.zeros(1, dtype=torch.int64), 1 + self._class_index])
        shares = torch.softmax(logits.view(T, len(proposals), -1)[..., foreground], dim=2)
        scores = 1 - shares.mean(0)[:, 0]
        label = 1 + self._class_index[shares.mean(0)[:, 1:].argmax(1)]
        moved = roi.box_coder.decode(moves.view(T, len(proposals), -1).mean(0), [proposals])
        boxes = clip_boxes_to_image(moved[torch.arange(len(label)), label], scaled.image_sizes[0])
        keep = batched_nms(boxes, scores, torch.zeros_like(label), NMS_IOU)
        keep = keep[scores[keep] >= p.score][: p.candidates]
        likely = self._masks(features, boxes[keep], label[keep], scaled.image_sizes[0], image.shape[1:])
        masks = apart(likely, scores[keep])
        seen = masks.sum((1, 2)) >= p.min_pixels
        keep, masks = keep[seen], masks[seen]
        attributes, v, v_epistemic = class_uncertainty(
            logits.view(T, len(proposals), -1)[:, keep][..., 1 + self._class_index], self.calibration.class_temperature
        )
        return scores[keep].double().numpy(), masks.numpy(), attributes, v, v_epistemic

    def _masks(
        self, features: dict[str, Tensor], boxes: Tensor, label: Tensor, seen: tuple[int, int], size: Any
    ) -> Tensor:
        """How likely each pixel is to be of each object (n, H, W)."""
        height, width = size
        if len(boxes) == 0:
            return torch.zeros((0, height, width))
        roi = self.network.detector.roi_heads
        logits = roi.mask_predictor(roi.mask_head(roi.mask_roi_pool(features, [boxes], [seen])))
        small = torch.sigmoid(logits[torch.arange(len(label)), label])[:, None]
        scale = torch.tensor([width / seen[1], height / seen[0]]).repeat(2)
        return paste_masks_in_image(small, boxes * scale, (height, width))[:, 0]

    def _object_depths(
        self, image: Tensor, at: Tensor, focal: float, generator: torch.Generator
    ) -> tuple[Array, Array, Array, Array]:
        """As `LearnedPerception` does it, at pixels (n, D, 2)."""
        (n, D), T = at.shape[:2], self.params.samples
        if n == 0:
            return np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0)
        maps = self.network.depth(2 * image[None] - 1)
        seen = bilinear(maps, torch.zeros(n * D, dtype=torch.int64), at.reshape(-1, 2), STRIDE)
        log_depth, log_variance = self.network.depth.read(seen, T > 1, generator, T)
        return depth_uncertainty(log_depth.view(T, n, D), log_variance.view(T, n, D), focal)


def apart(likely: Tensor, scores: Tensor) -> Tensor:
    """Masks (n, H, W) bool of objects as likely at each pixel as (n, H, W) says, none on another.

    A pixel that several claim goes to the surest, by mask and by detection: what is hardly an object takes nothing
    away from one that is.
    """
    claimed = likely > 0.5
    if len(likely) == 0:
        return claimed
    owner = torch.where(claimed, likely * scores[:, None, None], 0.0).argmax(0)
    return claimed & (owner == torch.arange(len(likely))[:, None, None])


def _centroids(masks: NDArray[np.bool_]) -> Array:
    """Mean pixel (n, 2) of each mask."""
    out = np.zeros((len(masks), 2))
    for i, mask in enumerate(masks):
        v, u = np.nonzero(mask)
        out[i] = u.mean() + 0.5, v.mean() + 0.5
    return out
