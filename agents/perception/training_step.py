"""What one worker of a training does and keeps: its parameters, its frames, its state, one step, a checkpoint."""

from __future__ import annotations

import ctypes
import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .frames import Frame, FrameSource, Variant, joint_classes, training_variants
from .kinds import KIND, kind, network_params
from .losses import LossWeights, make_batch

CHECKPOINT = "checkpoint.pt"

Pair = tuple[Frame, Frame]


@dataclass(frozen=True)
class TrainingParams:
    """How to train.

    Attributes:
        minutes: of wall time over all sessions, unless `steps` is given; the learning rate follows what has passed.
        steps: number of steps instead of a time.
        seed: of frames, batches, dropout and first weights.
        pairs: pairs of frames per batch; None = that of the network, see `kinds.Kind`.
        workers: processes that learn side by side.
        meet_every: steps between two averagings of the workers' weights.
        pool_chunks: chunks of frames kept at hand, by each worker.
        steps_per_chunk: how often the oldest chunk is replaced by a new one.
        learning_rate: at its highest; None = that of the network, see `kinds.Kind`.
        warm_up: share of the training over which it rises.
        weight_decay: of AdamW.
        average: decay of the running mean of the weights, which is what ships.
        bf16: run the dense part in bfloat16.
        checkpoint_s: time between checkpoints.
        validate_s: time between validations.
        variants: scenes to learn from.
        network: what to train, see `kinds.kind`.
    """

    minutes: float | None = 40.0
    steps: int | None = None
    seed: int = 0
    pairs: int | None = None
    workers: int = 1
    meet_every: int = 16
    pool_chunks: int = 60
    steps_per_chunk: int = 3
    learning_rate: float | None = None
    warm_up: float = 0.04
    weight_decay: float = 0.02
    average: float = 0.998
    bf16: bool = True
    checkpoint_s: float = 60.0
    validate_s: float = 600.0
    weights: LossWeights = field(default_factory=LossWeights)
    variants: tuple[Variant, ...] = field(default_factory=training_variants)
    network: str = "compact"

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.steps is None):
            raise ValueError(f"give minutes or steps, got minutes={self.minutes} and steps={self.steps}")
        for name in (
            "minutes",
            "steps",
            "pairs",
            "workers",
            "meet_every",
            "pool_chunks",
            "steps_per_chunk",
            "learning_rate",
        ):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive, got {value}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


class Pool:
    """The last chunks of a source, so that each frame is seen a few times at the price of one rendering.

    Of the source's chunks every worker has its own share: each `workers`-th, from number `worker` on.
    """

    def __init__(self, source: FrameSource, size: int, worker: int = 0, workers: int = 1) -> None:
        self.source, self.size = source, size
        self.worker, self.workers = worker, workers
        self.chunks: dict[int, list[Pair]] = {}

    def draw(self, newest: int, number: int, rng: np.random.Generator) -> list[Pair]:
        """Different pairs of the chunks up to number `newest`, as many as there are at most.

        The same whether the pool has just begun or run for long; chunks are rendered when one of their pairs is drawn.
        """
        first, each = newest - self.size + 1, self.source.snapshots
        self.chunks = {n: pairs for n, pairs in self.chunks.items() if n >= first}
        drawn = rng.choice(self.size * each, min(number, self.size * each), replace=False)
        return [self._chunk(first + int(i) // each)[int(i) % each] for i in drawn]

    def _chunk(self, n: int) -> list[Pair]:
        if n not in self.chunks:
            self.chunks[n] = self.source.chunk(n * self.workers + self.worker)
        return self.chunks[n]


@dataclass
class State:
    """All that changes in training.

    Attributes:
        network: of this worker.
        averaged: running mean of its weights, which is what ships.
        others: (workers - 1, m) moments of the other workers' optimisers when all met last.
    """

    network: nn.Module
    averaged: nn.Module
    optimiser: torch.optim.Optimizer
    step: int = 0
    seconds: float = 0.0
    images: int = 0
    others: Tensor | None = None


def fresh(params: TrainingParams, network: Any = None) -> State:
    """A state to begin with; `network` gives other sizes than the usual ones."""
    build = kind(params.network).build
    network = network_params(params.network, joint_classes()) if network is None else network
    with torch.random.fork_rng():
        torch.manual_seed(params.seed)
        net = build(network)
    averaged = build(network)
    averaged.load_state_dict(net.state_dict())
    averaged.requires_grad_(False)
    return State(net, averaged, _optimiser(net, params))


def pool_of(params: TrainingParams, worker: int) -> Pool:
    """The frames of one worker."""
    return Pool(FrameSource(seed=params.seed, variants=params.variants), params.pool_chunks, worker, params.workers)


def train_step(state: State, pool: Pool, params: TrainingParams, done: float, worker: int = 0) -> dict[str, float]:
    """One step; which frames, augmentations and dropout it uses follows from seed, step and worker alone."""
    rng = np.random.default_rng([params.seed, 17, state.step, worker])
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    learner = kind(params.network)
    newest = params.pool_chunks - 1 + state.step // params.steps_per_chunk
    chosen = pool.draw(newest, params.pairs or learner.pairs, rng)
    batch = make_batch(chosen, rng, masks=learner.masks)
    for group in state.optimiser.param_groups:
        group["lr"] = (params.learning_rate or learner.learning_rate) * schedule(done, params.warm_up)
    state.optimiser.zero_grad(set_to_none=True)
    parts = learner.losses(state.network, batch, params.weights, generator, bf16=params.bf16)
    parts["total"].backward()
    nn.utils.clip_grad_norm_(state.network.parameters(), 10.0)
    state.optimiser.step()
    state.step += 1
    state.images += len(batch.images) * params.workers
    _average(state.averaged, state.network, min(params.average, (1 + state.step) / (10 + state.step)))
    return {name: float(value.detach()) for name, value in parts.items()}


def schedule(done: float, warm_up: float) -> float:
    """Share of the highest learning rate when a share `done` of the training is over: a line up, a cosine down."""
    if done < warm_up:
        return (0.05 + done) / (0.05 + warm_up)
    return 0.5 * (1 + math.cos(math.pi * (done - warm_up) / (1 - warm_up))) * 0.99 + 0.01


def progress(state: State, params: TrainingParams) -> float:
    """Share of the training that is over."""
    if params.steps is not None:
        return state.step / params.steps
    assert params.minutes is not None
    return state.seconds / (60 * params.minutes)


def _optimiser(network: nn.Module, params: TrainingParams) -> torch.optim.Optimizer:
    decayed = [p for p in network.parameters() if p.ndim > 1]
    plain = [p for p in network.parameters() if p.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": params.weight_decay}, {"params": plain, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, betas=(0.9, 0.99), fused=True)


@torch.no_grad()
def _average(averaged: nn.Module, network: nn.Module, decay: float) -> None:
    for mean, value in zip(averaged.state_dict().values(), network.state_dict().values(), strict=True):
        if mean.dtype.is_floating_point:
            mean.lerp_(value, 1 - decay)
        else:
            mean.copy_(value)


def save_checkpoint(path: Path, state: State) -> None:
    """Write everything that changes, all of it or nothing."""
    content = {
        "network": state.network.state_dict(),
        "averaged": state.averaged.state_dict(),
        "optimiser": state.optimiser.state_dict(),
        "params": state.network.params.to_dict(),
        "step": state.step,
        "seconds": state.seconds,
        "images": state.images,
        "others": state.others,
    }
    partial = path.with_suffix(".partial")
    torch.save(content, partial)
    os.replace(partial, path)


def load_checkpoint(path: Path, state: State) -> None:
    """Fill `state` from a checkpoint.

    Raises:
        ValueError: it belongs to another network.
    """
    content = torch.load(path, weights_only=True)
    params = kind(content["params"].get(KIND, "compact")).params(content["params"])
    if params != state.network.params:
        raise ValueError(f"{path} holds another network: {params}, expected {state.network.params}")
    state.network.load_state_dict(content["network"])
    state.averaged.load_state_dict(content["averaged"])
    state.optimiser.load_state_dict(content["optimiser"])
    state.step, state.seconds, state.images = content["step"], content["seconds"], content["images"]
    state.others = content.get("others")


def keep_memory() -> None:
    """Let the C library keep freed memory: giving large tensors back to the system at every step costs a fifth of it.

    Does nothing where the C library is not glibc.
    """
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return
    trim_threshold, mmap_max = -1, -4
    mallopt(mmap_max, 0)
    mallopt(trim_threshold, 2**31 - 1)
