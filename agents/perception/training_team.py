"""Workers that learn side by side, each a process with one thread, and meet every few steps to average their weights.

On two cores that is twice as fast as one worker; threads inside the small tensor operations of one process are hardly
faster than one thread, and several times slower where other programs use the cores too.
"""

from __future__ import annotations

import os
import threading
from typing import Any

import torch
from torch import Tensor, nn

from .training_step import State, TrainingParams, fresh, keep_memory, pool_of, train_step

MEETING_TIMEOUT_S = 900.0
MOMENTS = ("exp_avg", "exp_avg_sq")


class Team:
    """The other workers, and where all of them put their weights to be averaged, and their optimisers' moments.

    The moments are there for the checkpoint: a training that goes on from one ends like one that was never stopped.
    """

    def __init__(self, params: TrainingParams, state: State) -> None:
        self.params = params
        self.processes: list[Any] = []
        if params.workers == 1:
            return
        context = torch.multiprocessing.get_context("spawn")
        barrier = context.Barrier(params.workers, timeout=MEETING_TIMEOUT_S)
        self.board = _Board(params.workers, state, barrier)
        for worker in range(1, params.workers):
            arguments = (worker, params, state.network.params, state.step, self.board)
            process = context.Process(target=_work, args=arguments, daemon=True)
            process.start()
            self.processes.append(process)

    def __enter__(self) -> Team:
        return self

    def __exit__(self, kind: Any, *_: Any) -> None:
        if self.processes and kind is not None:
            self.board.barrier.abort()
        for process in self.processes:
            process.join()

    def begin(self, state: State, done: float) -> int:
        """Tell the workers how far the training is; the number of steps until the next meeting, 0 when it is over."""
        steps = self.params.meet_every if self.processes else 1
        if self.params.steps is not None:
            steps = min(steps, self.params.steps - state.step)
        if done >= 1:
            steps = 0
        if self.processes:
            self.board.plan[0], self.board.plan[1] = done, steps
            self.board.barrier.wait()
        return steps

    def meet(self, state: State) -> None:
        """Average the weights of all workers."""
        if self.processes:
            state.others = self.board.meet(0, state)


class _Board:
    """Memory that all workers share: a row of each for its weights and for its moments, and the plan of this round."""

    def __init__(self, workers: int, state: State, barrier: Any) -> None:
        self.weights = torch.stack([_flat(state.network)] * workers).share_memory_()
        self.moments = torch.stack([_moments(state.optimiser)] * workers).share_memory_()
        if state.others is not None:
            rows = min(workers - 1, len(state.others))
            self.moments[1 : 1 + rows] = state.others[:rows]
        self.plan = torch.zeros(2, dtype=torch.float64).share_memory_()  # share done, steps until the next meeting
        self.barrier = barrier

    def meet(self, worker: int, state: State) -> Tensor:
        """Leave here what this worker has and take the mean of all weights; moments of all workers but the first."""
        self.weights[worker] = _flat(state.network)
        self.moments[worker] = _moments(state.optimiser)
        self.barrier.wait()
        mean, others = self.weights.mean(0), self.moments[1:].clone()
        self.barrier.wait()  # nobody writes before all have read
        _unflatten(mean, state.network)
        return others


def _work(worker: int, params: TrainingParams, network: Any, step: int, board: _Board) -> None:
    """The life of a worker but the first."""
    torch.set_num_threads(1)
    keep_memory()
    threading.Thread(target=_die_with_parent, daemon=True).start()
    state = fresh(params, network)
    state.step = step
    _unflatten(board.weights[0], state.network)
    if step > 0:
        _set_moments(board.moments[worker], state.optimiser, step)
    pool = pool_of(params, worker)
    state.network.train()
    try:
        while True:
            board.barrier.wait()
            done, steps = board.plan.tolist()
            if steps == 0:
                return
            for _ in range(int(steps)):
                train_step(state, pool, params, done, worker)
            board.meet(worker, state)
    except threading.BrokenBarrierError:
        return


def _die_with_parent() -> None:
    """A killed training leaves no workers behind."""
    parent = torch.multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


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


def _parameters(optimiser: torch.optim.Optimizer) -> list[Tensor]:
    return [p for group in optimiser.param_groups for p in group["params"]]


def _moments(optimiser: torch.optim.Optimizer) -> Tensor:
    """First and second moments of all parameters as one vector; zeros before the first step."""
    parts = []
    for p in _parameters(optimiser):
        kept = optimiser.state.get(p, {})
        parts += [kept[name].flatten() if name in kept else torch.zeros(p.numel()) for name in MOMENTS]
    return torch.cat(parts)


def _set_moments(flat: Tensor, optimiser: torch.optim.Optimizer, step: int) -> None:
    start = 0
    for p in _parameters(optimiser):
        kept: dict[str, Tensor] = {"step": torch.tensor(float(step))}
        for name in MOMENTS:
            kept[name] = torch.empty_like(p, requires_grad=False).copy_(flat[start : start + p.numel()].view(p.shape))
            start += p.numel()
        optimiser.state[p] = kept
