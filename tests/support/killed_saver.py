"""Starts a child that saves without a pause, kills it, and checks the files. Repeats.

    python killed_saver.py LOGDIR

Prints the env steps of the newest checkpoint after each kill; fails if one is damaged.
"""

import os
import random
import signal
import sys
import time

import numpy as np
import tiny
import toy

from vawm.runs import checkpoint

KILLS, FIRST, LONGEST = 10, 8, 0.8


def state(env_steps):
    """Numpy arrays only, so that no child waits for JAX to compile."""
    rng = np.random.default_rng(env_steps)
    params = {"kernel": rng.normal(size=(64, 32)).astype(np.float32)}
    replay = rng.integers(0, 255, (4, 10_000)).astype(np.uint8)
    return toy.State(toy.Learner(params, ()), replay, (), np.int32(env_steps).reshape(()))


def save_for_ever(logdir, ready):
    newest = checkpoint.latest(logdir)
    env_steps = FIRST if newest is None else int(newest.name) + FIRST
    with checkpoint.Saver(logdir, tiny.CONFIG, toy.SPEC) as saver:
        while True:
            saver.save(state(env_steps), env_steps=env_steps, progress={})
            if checkpoint.latest(logdir):  # from now on there must always be one
                os.write(ready, b"1")
            env_steps += FIRST


def main(logdir):
    rng = random.Random(0)
    for _ in range(KILLS):  # forks before JAX starts threads
        reader, writer = os.pipe()
        child = os.fork()
        if not child:
            save_for_ever(logdir, writer)
        os.read(reader, 1)
        time.sleep(rng.uniform(0, LONGEST))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        found = checkpoint.find(logdir)
        assert not found.damaged, found.damaged
        print(found.manifest.env_steps, flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
