"""Training of the learned eyes: frames rendered on the fly, atomic checkpoints, resumable at any point.

Several workers, each a process with one thread and frames of its own, meet every few steps to average their weights.
On two cores that is twice as fast as one worker; threads inside the small tensor operations of one process are hardly
faster than one thread, and several times slower where other programs use the cores too.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import threading
import time
from collections.abc import Callable, Sequence
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
        workers: processes that learn side by side.
        meet_every: steps between two averagings of the workers' weights.
        pool_chunks: chunks of frames kept at hand, by each worker.
        steps_per_chunk: how often the oldest chunk is replaced by a new one.
        learning_rate: at its highest.
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
    pairs: int = 4
    workers: int = 1
    meet_every: int = 16
    pool_chunks: int = 60
    steps_per_chunk: int = 3
    learning_rate: float = 1.5e-3
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

    def at(self, newest: int) -> list[Pair]:
        """All pairs of the chunks up to number `newest`; the same whether the pool has just begun or run for long."""
        wanted = range(newest - self.size + 1, newest + 1)
        self.chunks = {
            n: self.chunks[n] if n in self.chunks else self.source.chunk(n * self.workers + self.worker) for n in wanted
        }
        return [pair for n in wanted for pair in self.chunks[n]]


@dataclass
class State:
    """All that changes in training."""

    network: nn.Module
    averaged: nn.Module
    optimiser: torch.optim.Optimizer
    step: int = 0
    seconds: float = 0.0
    images: int = 0


def fresh(params: TrainingParams, network: Any = None) -> State:
    """A state to begin with; `network` gives other sizes than the usual ones."""
    build = kind(params.network).build
    network = network_params(params.network, joint_classes()) if network is None else network
    with torch.random.fork_rng():
        torch.manual_seed(params.seed)
        net = build(network).to(memory_format=torch.channels_last)
    averaged = build(network).to(memory_format=torch.channels_last)
    averaged.load_state_dict(net.state_dict())
    averaged.requires_grad_(False)
    return State(net, averaged, _optimiser(net, params))


def train(
    params: TrainingParams,
    out: Path,
    *,
    resume: bool = False,
    network: Any = None,
    validate: Callable[[nn.Module], dict[str, float]] | None = None,
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
    pool = _pool(params, 0)
    book = _Book(params, state, path, [_json_logger(out / LOG), *_tensorboard(out), report], validate, report_s)
    with _Team(params, state) as team:
        while team.begin(done := _progress(state, params)):
            for _ in range(team.steps(state)):
                book.enter(train_step(state, pool, params, done), done)
            team.meet(0, state.network)
    save_checkpoint(path, state)
    return state


class _Book:
    """Keeps time, means of the losses, reports, validations and checkpoints of one session."""

    def __init__(
        self,
        params: TrainingParams,
        state: State,
        path: Path,
        logs: Sequence[Callable[[dict[str, Any]], None]],
        validate: Callable[[nn.Module], dict[str, float]] | None,
        report_s: float,
    ) -> None:
        self.params, self.state, self.path = params, state, path
        self.logs, self.validate, self.report_s = logs, validate, report_s
        self.began, self.before = time.monotonic(), state.seconds
        self.saved = self.validated = self.reported = state.seconds
        self.sums: dict[str, float] = {}
        self.since = 0

    def enter(self, values: dict[str, float], done: float) -> None:
        """After every step."""
        self._tell_time()
        self.since += 1
        for name, value in values.items():
            self.sums[name] = self.sums.get(name, 0.0) + value
        over = _progress(self.state, self.params) >= 1
        if over or self.state.seconds - self.reported >= self.report_s:
            self._report(done, over)
        if self.state.seconds - self.saved >= self.params.checkpoint_s:
            save_checkpoint(self.path, self.state)
            self.saved = self.state.seconds

    def _tell_time(self) -> None:
        self.state.seconds = self.before + time.monotonic() - self.began

    def _report(self, done: float, over: bool) -> None:
        state, params = self.state, self.params
        images = 2 * params.pairs * params.workers * self.since
        row: dict[str, Any] = {
            "step": state.step,
            "seconds": round(state.seconds, 1),
            "done": round(done, 4),
            "images": state.images,
            "images_per_s": round(images / max(state.seconds - self.reported, 1e-9), 2),
            **{name: round(value / self.since, 5) for name, value in self.sums.items()},
        }
        if self.validate is not None and (over or state.seconds - self.validated >= params.validate_s):
            row |= {f"val_{k}": v for k, v in self.validate(state.averaged).items()}
            self._tell_time()
            self.validated = state.seconds
        for log in self.logs:
            log(row)
        self.reported, self.sums, self.since = state.seconds, {}, 0


class _Team:
    """The other workers, and where all of them put their weights to be averaged."""

    def __init__(self, params: TrainingParams, state: State) -> None:
        self.params = params
        self.processes: list[Any] = []
        if params.workers == 1:
            return
        context = torch.multiprocessing.get_context("spawn")
        self.flat = torch.stack([_flat(state.network)] * params.workers).share_memory_()
        self.plan = torch.zeros(2, dtype=torch.float64).share_memory_()  # share done, steps until the next meeting
        self.barrier = context.Barrier(params.workers, timeout=MEETING_TIMEOUT_S)
        for worker in range(1, params.workers):
            arguments = (worker, params, state.network.params, state.step, self.flat, self.plan, self.barrier)
            process = context.Process(target=_work, args=arguments, daemon=True)
            process.start()
            self.processes.append(process)

    def __enter__(self) -> _Team:
        return self

    def __exit__(self, kind: Any, *_: Any) -> None:
        if self.processes and kind is not None:
            self.barrier.abort()
        for process in self.processes:
            process.join()

    def steps(self, state: State) -> int:
        """How many steps until the next meeting."""
        if not self.processes:
            return 1
        return int(self.plan[1])

    def begin(self, done: float) -> bool:
        """Tell the workers how far the training is; False when it is over."""
        if self.processes:
            self.plan[0] = done
            self.plan[1] = self.params.meet_every
            self.barrier.wait()
        return done < 1

    def meet(self, worker: int, network: nn.Module) -> None:
        """Average the weights of all workers."""
        if self.processes:
            _meet(worker, network, self.flat, self.barrier)


MEETING_TIMEOUT_S = 900.0


def _work(
    worker: int, params: TrainingParams, network: Any, step: int, flat: Tensor, plan: Tensor, barrier: Any
) -> None:
    """The life of a worker but the first."""
    torch.set_num_threads(1)
    keep_memory()
    threading.Thread(target=_die_with_parent, daemon=True).start()
    state = fresh(params, network)
    state.step = step
    _unflatten(flat[0], state.network)
    pool = _pool(params, worker)
    state.network.train()
    try:
        while True:
            barrier.wait()
            done, steps = plan.tolist()
            if done >= 1:
                return
            for _ in range(int(steps)):
                train_step(state, pool, params, done, worker)
            _meet(worker, state.network, flat, barrier)
    except threading.BrokenBarrierError:
        return


def _die_with_parent() -> None:
    """A killed training leaves no workers behind."""
    parent = torch.multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _meet(worker: int, network: nn.Module, flat: Tensor, barrier: Any) -> None:
    flat[worker] = _flat(network)
    barrier.wait()
    mean = flat.mean(0)
    barrier.wait()  # nobody writes before all have read
    _unflatten(mean, network)


def _flat(network: nn.Module) -> Tensor:
    """All weights and running means as one vector."""
    return torch.cat([v.detach().flatten() for v in network.state_dict().values() if v.dtype.is_floating_point])


@torch.no_grad()
def _unflatten(flat: Tensor, network: nn.Module) -> None:
    start = 0
    for value in network.state_dict().values():
        if value.dtype.is_floating_point:
            value.copy_(flat[start : start + value.numel()].view(value.shape))
            start += value.numel()


def _pool(params: TrainingParams, worker: int) -> Pool:
    return Pool(FrameSource(seed=params.seed, variants=params.variants), params.pool_chunks, worker, params.workers)


def train_step(state: State, pool: Pool, params: TrainingParams, done: float, worker: int = 0) -> dict[str, float]:
    """One step; which frames, augmentations and dropout it uses follows from seed, step and worker alone."""
    rng = np.random.default_rng([params.seed, 17, state.step, worker])
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    pairs = pool.at(params.pool_chunks - 1 + state.step // params.steps_per_chunk)
    chosen = [pairs[i] for i in rng.choice(len(pairs), min(params.pairs, len(pairs)), replace=False)]
    learner = kind(params.network)
    batch = make_batch(chosen, rng, masks=learner.masks)
    for group in state.optimiser.param_groups:
        group["lr"] = params.learning_rate * schedule(done, params.warm_up)
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


def _progress(state: State, params: TrainingParams) -> float:
    if params.steps is not None:
        return state.step / params.steps
    assert params.minutes is not None
    return state.seconds / (60 * params.minutes)


def _optimiser(network: nn.Module, params: TrainingParams) -> torch.optim.Optimizer:
    decayed = [p for p in network.parameters() if p.ndim > 1]
    plain = [p for p in network.parameters() if p.ndim <= 1]
    groups = [{"params": decayed, "weight_decay": params.weight_decay}, {"params": plain, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=params.learning_rate, betas=(0.9, 0.99), fused=True)


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
