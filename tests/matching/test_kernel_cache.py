import os

from covis.matching.kernel_cache import forget_stale_kernels


def test_kernels_older_than_a_source_they_may_call_are_forgotten(tmp_path):
    matching, envs = tmp_path / "matching" / "a.py", tmp_path / "envs" / "camera" / "b.py"
    stored = [x.parent / "__pycache__" / f"{x.stem}.kernel.nbi" for x in (matching, envs)]

    def touch(path, at):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
        os.utime(path, (at, at))

    def left():
        forget_stale_kernels(tmp_path)
        return [x.exists() for x in stored]

    touch(matching, 10)
    touch(envs, 20)
    touch(stored[0], 15)
    touch(stored[1], 25)
    assert left() == [True, True]
    touch(envs, 30)
    assert left() == [True, False]
    touch(stored[1], 40)  # compiled again
    assert left() == [True, True]
    touch(matching, 50)  # which the cameras may call
    assert left() == [False, False]
