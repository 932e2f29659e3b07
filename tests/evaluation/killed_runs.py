"""Runs to be killed: a process that has everything loaded, and forks one child per job read from standard input.

Called with the kind of the runs (one of `JOBS`) and a folder for a first run, made here to warm up. A job is one line
of JSON: `{"out": folder, "workers": number, "kill_after": seconds, "die_at": number}`. After so many seconds the child
is killed, unless it is done; and it kills itself at the rename of a file with that number, odd ones before it and even
ones after. The answer is a line: exit status, renames made, seconds. `workers` is for recordings and benchmarks.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from covis.evaluation import experiments
from covis.evaluation.benchmark import benchmark
from covis.evaluation.methods import Method
from covis.evaluation.recording import record
from covis.evaluation.settings import Settings

experiments.FRAMES_PER_UNIT = 3


def record_job(out: Path, workers: int) -> None:
    record("box_world:BoxWorld", Settings(episodes=3, perception="simulated"), out, workers=workers, resume=True)


def benchmark_job(out: Path, workers: int) -> None:
    methods = [Method.parse(text) for text in ("rgm", "bayes", "random")]
    benchmark([str(out.parent / "data")], methods, Settings(), out=out, workers=workers, resume=True)


def perception_job(out: Path, workers: int) -> None:
    """Two processes that learn side by side, whatever `workers` says: their number is part of what is trained."""
    from covis.agents.perception.frames import Variant, joint_classes
    from covis.agents.perception.network import NetworkParams
    from covis.agents.perception.training import train
    from covis.agents.perception.training_step import TrainingParams
    from covis.evaluation.perception_training import finish

    network = NetworkParams(
        joint_classes(), widths=(8, 16, 16, 16, 16), blocks=(0, 0, 0, 0), neck=16, head=32, embedding=8
    )
    params = TrainingParams(
        minutes=None,
        steps=6,
        workers=2,
        meet_every=2,
        pairs=1,
        pool_chunks=1,
        steps_per_chunk=3,
        variants=(Variant("target_localization", "easy"),),
        checkpoint_s=0.0,
    )
    finish(train(params, out, resume=True, network=network), params, out, 0)


def policy_job(out: Path, workers: int) -> None:
    from covis.evaluation.policy_training import PolicyParams, train_policy

    small = (("width", 64), ("height", 48), ("min_pixels", 10), ("max_cycles", 4))
    train_policy(PolicyParams("multi_robot", "easy", steps=4 * 64, seed=1, options=small), out, resume=True)


JOBS = {
    "record": record_job,
    "benchmark": benchmark_job,
    "train perception": perception_job,
    "train policy": policy_job,
}


def count_renames(die_at: int, counter: Path) -> None:
    """Count `os.replace` in a file of one byte per call, and die at one of them."""
    replace = os.replace

    def counting(source: str, target: str) -> None:
        with counter.open("ab") as stream:
            stream.write(b".")
        number = counter.stat().st_size
        if die_at == 2 * number - 1:
            os.kill(os.getpid(), signal.SIGKILL)
        replace(source, target)
        if die_at == 2 * number:
            os.kill(os.getpid(), signal.SIGKILL)

    os.replace = counting


def serve(what: str, warm: str) -> None:
    JOBS[what](Path(warm), 1)
    print("ready", flush=True)
    for line in sys.stdin:
        job = json.loads(line)
        out = Path(job["out"])
        counter = out.with_name(f"{out.name}-renames-{time.monotonic_ns()}")
        counter.touch()
        child = os.fork()
        if child == 0:
            count_renames(job.get("die_at", 0), counter)
            JOBS[what](out, job.get("workers", 1))
            os._exit(0)
        start = time.monotonic()
        status = wait(child, start + job.get("kill_after", 1e9))
        print(status, counter.stat().st_size, time.monotonic() - start, flush=True)


def wait(child: int, deadline: float) -> int:
    """Exit status of the child, which is killed at the deadline."""
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() >= deadline:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.002)


if __name__ == "__main__":
    if sys.argv[1].startswith("train"):
        import torch

        torch.set_num_threads(1)
    serve(*sys.argv[1:])
