"""Training of the learned eyes: frames rendered on the fly, atomic checkpoints, resumable at any point."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torch import nn

from .training_step import (
    CHECKPOINT,
    State,
    TrainingParams,
    fresh,
    keep_memory,
    load_checkpoint,
    pool_of,
    progress,
    save_checkpoint,
    train_step,
)
from .training_team import Team

LOG = "training.jsonl"


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
    pool = pool_of(params, 0)
    book = _Book(params, state, path, [_json_logger(out / LOG), *_tensorboard(out), report], validate, report_s)
    with Team(params, state) as team:
        while steps := team.begin(state, done := progress(state, params)):
            for _ in range(steps):
                book.enter(train_step(state, pool, params, done), done)
            team.meet(state)
            book.keep()
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
        self.since, self.seen = 0, state.images

    def enter(self, values: dict[str, float], done: float) -> None:
        """After every step."""
        self._tell_time()
        self.since += 1
        for name, value in values.items():
            self.sums[name] = self.sums.get(name, 0.0) + value
        over = progress(self.state, self.params) >= 1
        if over or self.state.seconds - self.reported >= self.report_s:
            self._report(done, over)

    def keep(self) -> None:
        """After every meeting of the workers: only then does a checkpoint hold all of them."""
        if self.state.seconds - self.saved >= self.params.checkpoint_s:
            save_checkpoint(self.path, self.state)
            self.saved = self.state.seconds

    def _tell_time(self) -> None:
        self.state.seconds = self.before + time.monotonic() - self.began

    def _report(self, done: float, over: bool) -> None:
        state, params = self.state, self.params
        row: dict[str, Any] = {
            "step": state.step,
            "seconds": round(state.seconds, 1),
            "done": round(done, 4),
            "images": state.images,
            "images_per_s": round((state.images - self.seen) / max(state.seconds - self.reported, 1e-9), 2),
            **{name: round(value / self.since, 5) for name, value in self.sums.items()},
        }
        if self.validate is not None and (over or state.seconds - self.validated >= params.validate_s):
            row |= {f"val_{k}": v for k, v in self.validate(state.averaged).items()}
            self._tell_time()
            self.validated = state.seconds
        for log in self.logs:
            log(row)
        self.reported, self.sums, self.since, self.seen = state.seconds, {}, 0, state.images


def _json_logger(path: Path) -> Callable[[dict[str, Any]], None]:
    def log(row: dict[str, Any]) -> None:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    return log


def _tensorboard(out: Path) -> list[Callable[[dict[str, Any]], None]]:
    """A logger for TensorBoard, where that is installed (`covis[training]`)."""
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
