"""Kill -9 at any moment: a rerun that resumes ends with the results of an undisturbed run.

Half of the kill points are moments drawn at random, half are the renames by which files appear, where a run is most
vulnerable. All are real SIGKILLs. Some of the recordings and benchmarks, and all trainings of eyes, are of two
processes.
"""

import importlib.util
import json
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from covis.evaluation.dataset_check import check

pytestmark = pytest.mark.slow
KILLS = 7
"""Of each kind of run."""
STARTING_S = 4.0


class Runs:
    """Talks to `killed_runs.py`."""

    def __init__(self, *arguments):
        here = Path(__file__).resolve()
        path = [str(here.parents[2] / "docs" / "examples"), *sys.path]
        self.process = subprocess.Popen(
            [sys.executable, str(here.with_name("killed_runs.py")), *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(path)},
        )
        assert self.process.stdout.readline() == "ready\n"

    def run(self, out, **moment):
        """Exit status (-9: killed), number of renames, seconds."""
        print(json.dumps({"out": str(out)} | moment), file=self.process.stdin, flush=True)
        status, renames, seconds = self.process.stdout.readline().split()
        return int(status), int(renames), float(seconds)

    def close(self):
        self.process.stdin.close()
        self.process.wait(30)


def recorded(out):
    """Every file of the dataset, byte by byte; nothing else is left."""
    assert check(out).verified
    return {file.name: file.read_bytes() for file in out.iterdir()}


def benchmarked(out):
    """Rows and records without what depends on the clock."""
    rows = json.loads((out / "rows.json").read_text())["rows"]
    records = [
        pq.read_table(file).drop_columns("match_ms").to_pylist() for file in sorted(out.glob("records/*.parquet"))
    ]
    assert len(records) == 12
    return [{k: v for k, v in row.items() if k != "match_ms"} for row in rows], records


def trained_eyes(out):
    """The weights as they ship, and everything that a further training would go on from."""
    import torch

    from covis.agents.perception.training import LOG
    from covis.agents.perception.training_step import CHECKPOINT

    state = torch.load(out / CHECKPOINT, weights_only=True)
    del state["seconds"]
    steps = [json.loads(line)["step"] for line in (out / LOG).read_text().splitlines()]
    assert steps[-1] == 6
    return (out / "eyes.safetensors").read_bytes(), plain(state)


def trained_policy(out):
    """The policy's weights, and the log of its training."""
    from stable_baselines3 import PPO

    weights = PPO.load(out / "policy.zip", device="cpu").policy.state_dict()
    return plain(weights), json.loads((out / "log.json").read_text())


def plain(value):
    """Tensors as arrays of bytes, so that they compare."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return np.asarray(value).tobytes() if hasattr(value, "detach") else value


RESULTS = {
    "record": recorded,
    "benchmark": benchmarked,
    "train perception": trained_eyes,
    "train policy": trained_policy,
}
NEEDS = {
    "train perception": ("torch", "safetensors", "pybullet"),
    "train policy": ("stable_baselines3", "supersuit", "pybullet"),
}


@pytest.mark.parametrize("what", RESULTS)
def test_killed_runs_resume_to_the_same_results(what, tmp_path, dataset_writer, request):
    if not all(map(importlib.util.find_spec, NEEDS.get(what, ()))):
        pytest.skip(f"needs {', '.join(NEEDS[what])}")
    dataset_writer(tmp_path / "data", n_frames=36)
    runs = Runs(what, str(tmp_path / "warm"))
    request.addfinalizer(runs.close)
    result = RESULTS[what]
    status, renames, seconds = runs.run(tmp_path / "undisturbed")
    assert status == 0
    expected = result(tmp_path / "undisturbed")

    rng = random.Random(f"kill {what}")
    plans = [[{"die_at": 1}], [{"die_at": 2 * renames}]]  # the first and the last rename, then at random
    kills = trial = 0
    while kills < KILLS:
        assert trial < 5 * KILLS, "most runs were over before they were killed"
        plan = plans[trial] if trial < len(plans) else random_moments(rng, seconds, renames, "train" in what)
        trial += 1
        out = tmp_path / f"killed-{trial}"
        for moment in plan:
            status, _, _ = runs.run(out, **moment)
            assert status in (0, -signal.SIGKILL)
            kills += status != 0
        assert runs.run(out)[0] == 0
        assert result(out) == expected, f"trial {trial} of {what}"
    print(f"{what}: {kills} kills in {trial} runs, each of {seconds:.1f} s and {renames} renames")


def random_moments(rng, seconds, renames, alone):
    """When to kill one run, up to three times; unless it runs `alone`, some of the times with two workers."""
    moments = []
    for _ in range(rng.randint(1, 3)):
        if rng.random() < 0.5:
            moments.append({"die_at": rng.randint(1, 2 * renames)})
        elif alone or rng.random() < 0.5:
            moments.append({"kill_after": rng.uniform(0, seconds)})
        else:  # which take their time to start
            moments.append({"kill_after": rng.uniform(0, seconds + STARTING_S), "workers": 2})
    return moments
