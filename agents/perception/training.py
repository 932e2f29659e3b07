"""Training of the learned eyes: frames rendered on the fly, atomic checkpoints, resumable at any point."""

from __future__ import annotations

import ctypes
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from .frames import Frame, FrameSource, Variant, joint_classes, training_variants
from .losses import LossWeights, losses, make_batch
from .network import Eyes, NetworkParams

CHECKPOINT = "checkpoint.pt"
LOG = "training.jsonl"

Pair = tuple[Frame, Frame]


@dataclass(frozen=True)
class TrainingParams:
    """How to train.

    Attributes:
        minutes: of wall time over all sessions, unless `steps` is given; the learning rate follows what has passed.
        steps: number of steps instead of a time.
        seed: of frames, batches, dropout and first weights.
        pairs: pairs of frames per batch.
        pool_chunks: chunks of frames kept at hand.
        steps_per_chunk: how often the oldest chunk is replaced by a new one.
        learning_rate: at its highest.
        warm_up: share of the training over which it rises.
        weight_decay: of AdamW.
        average: decay of the running mean of the weights, which is what ships.
        bf16: run the dense part in bfloat16.
        checkpoint_s: time between checkpoints.
        validate_s: time between validations.
        variants: scenes to learn from.
    """

    minutes: float | None = 40.0
    steps: int | None = None
    seed: int = 0
    pairs: int = 4
    pool_chunks: int = 60
    steps_per_chunk: int = 2
    learning_rate: float = 1.5e-3
    warm_up: float = 0.04
    weight_decay: float = 0.02
    average: float = 0.998
    bf16: bool = True
    checkpoint_s: float = 60.0
    validate_s: float = 300.0
    weights: LossWeights = field(default_factory=LossWeights)
    variants: tuple[Variant, ...] = field(default_factory=training_variants)

    def __post_init__(self) -> None:
        if (self.minutes is None) == (self.steps is None):
            raise ValueError(f"give minutes or steps, got minutes={self.minutes} and steps={self.steps}")
        for name in ("minutes", "steps", "pairs", "pool_chunks", "steps_per_chunk", "learning_rate"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} must be positive, got {value}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


class Pool:
    """The last chunks of a source, so that each frame is seen a few times at the price of one rendering."""

    def __init__(self, source: FrameSource, size: int) -> None:
        self.source, self.size = source, size
        self.chunks: dict[int, list[Pair]] = {}

    def at(self, newest: int) -> list[Pair]:
        """All pairs of the chunks up to number `newest`; the same whether the pool has just begun or run for long."""
        wanted = range(newest - self.size + 1, newest + 1)
        self.chunks = {n: self.chunks[n] if n in self.chunks else self.source.chunk(n % 2**31) for n in wanted}
        return [pair for n in wanted for pair in self.chunks[n]]


@dataclass
class State:
    """All that changes in training."""

    network: Eyes
    averaged: Eyes
    optimiser: torch.optim.Optimizer
    step: int = 0
    seconds: float = 0.0
    images: int = 0


def fresh(params: TrainingParams, network: NetworkParams | None = None) -> State:
    """A state to begin with."""
    with torch.random.fork_rng():
        torch.manual_seed(params.seed)
        net = Eyes(network or NetworkParams(joint_classes())).to(memory_format=torch.channels_last)
    averaged = Eyes(net.params).to(memory_format=torch.channels_last)
    averaged.load_state_dict(net.state_dict())
    averaged.requires_grad_(False)
    return State(net, averaged, _optimiser(net, params))


def train(
    params: TrainingParams,
    out: Path,
    *,
    resume: bool = False,
    network: NetworkParams | None = None,
    validate: Callable[[Eyes], dict[str, float]] | None = None,
    report: Callable[[dict[str, Any]], None] = lambda row: None,
    report_s: float = 10.0,
) -> State:
    """Train until the time or the steps are spent; with `resume` go on from the checkpoint in `out`, if there is one.

    Args:
        validate: figures of the averaged network, every `validate_s` and at the end.
        report: takes rows of progress: step, share done, images per second, mean losses, and validation figures.

    Raises:
        FileExistsError: `out` holds a checkpoint and `resume` is not given.
        ValueError: the checkpoint belongs to another network.
    """
    keep_memory()
    out.mkdir(parents=True, exist_ok=True)
    path = out / CHECKPOINT
    if path.exists() and not resume:
        raise FileExistsError(f"{path} is there already: resume it, or choose another folder")
    state = fresh(params, network)
    if path.exists():
        load_checkpoint(path, state)
    pool = Pool(FrameSource(seed=params.seed, variants=params.variants), params.pool_chunks)
    loggers = [_json_logger(out / LOG), *_tensorboard(out)]
    began, before = time.monotonic(), state.seconds
    saved = validated = reported = state.seconds
    sums: dict[str, float] = {}
    since = 0
    state.network.train()
    while (done := _progress(state, params)) < 1:
        values = train_step(state, pool, params, done)
        state.seconds = before + time.monotonic() - began
        since += 1
        for name, value in values.items():
            sums[name] = sums.get(name, 0.0) + value
        if state.seconds - reported >= report_s or _progress(state, params) >= 1:
            row: dict[str, Any] = {"step": state.step, "seconds": round(state.seconds, 1), "done": round(done, 4)}
            row["images"] = state.images
            row["images_per_s"] = round(2 * params.pairs * since / max(state.seconds - reported, 1e-9), 2)
            row |= {name: round(value / since, 5) for name, value in sums.items()}
            if validate is not None and (
                state.seconds - validated >= params.validate_s or _progress(state, params) >= 1
            ):
                row |= {f"val_{k}": v for k, v in validate(state.averaged).items()}
                validated = state.seconds = before + time.monotonic() - began
            for log in [*loggers, report]:
                log(row)
            reported, sums, since = state.seconds, {}, 0
        if state.seconds - saved >= params.checkpoint_s:
            save_checkpoint(path, state)
            saved = state.seconds
    save_checkpoint(path, state)
    return state


def train_step(state: State, pool: Pool, params: TrainingParams, done: float) -> dict[str, float]:
    """One step; which frames, augmentations and dropout it uses follows from seed and step alone."""
    rng = np.random.default_rng([params.seed, 17, state.step])
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    pairs = pool.at(params.pool_chunks - 1 + state.step // params.steps_per_chunk)
    chosen = [pairs[i] for i in rng.choice(len(pairs), min(params.pairs, len(pairs)), replace=False)]
    batch = make_batch(chosen, rng)
    for group in state.optimiser.param_groups:
        group["lr"] = params.learning_rate * schedule(done, params.warm_up)
    state.optimiser.zero_grad(set_to_none=True)
    parts = losses(state.network, batch, params.weights, generator, bf16=params.bf16)
    parts["total"].backward()
    nn.utils.clip_grad_norm_(state.network.parameters(), 10.0)
    state.optimiser.step()
    state.step += 1
    state.images += len(batch.images)
    _average(state.averaged, state.network, min(params.average, (1 + state.step) / (10 + state.step)))
    return {name: float(value.detach()) for name, value in parts.items()}


def schedule(done: float, warm_up: float) -> float:
    """Share of the highest learning rate when a share `done` of the training is over: a line up, a cosine down."""
    if done < warm_up:
        return (0.05 + done) / (0.05 + warm_up)
    return 0.5 * (1 + math.cos(math.pi * (done - warm_up) / (1 - warm_up))) * 0.99 + 0.01


def _progress(state: State, params: TrainingParams) -> float:
    if params.steps is not None:
        return state.step / params.steps
    assert params.minutes is not None
    return state.seconds / (60 * params.minutes)


def _optimiser(network: Eyes, params: TrainingParams) -> torch.optim.Optimizer:
    decayed = [p for p in network.parameters() if p.ndim > 1]
    plain = [p for p in network.parameters() if p.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": params.weight_decay}, {"params": plain, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=params.learning_rate, betas=(0.9, 0.99), fused=True)


@torch.no_grad()
def _average(averaged: Eyes, network: Eyes, decay: float) -> None:
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
    params = NetworkParams.from_dict(content["params"])
    if params != state.network.params:
        raise ValueError(f"{path} holds another network: {params}, expected {state.network.params}")
    state.network.load_state_dict(content["network"])
    state.averaged.load_state_dict(content["averaged"])
    state.optimiser.load_state_dict(content["optimiser"])
    state.step, state.seconds, state.images = content["step"], content["seconds"], content["images"]


def _json_logger(path: Path) -> Callable[[dict[str, Any]], None]:
    def log(row: dict[str, Any]) -> None:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    return log


def _tensorboard(out: Path) -> list[Callable[[dict[str, Any]], None]]:
    """A logger for TensorBoard, where that is installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        return []
    writer = SummaryWriter(str(out / "tensorboard"))

    def log(row: dict[str, Any]) -> None:
        for name, value in row.items():
            if name != "step" and isinstance(value, (int, float)):
                writer.add_scalar(name, value, row["step"])
        writer.flush()

    return [log]


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
