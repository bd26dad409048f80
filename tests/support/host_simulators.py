"""Small simulators for tests of pools, and their stream from a plain loop."""

import ctypes
import os
import signal
import subprocess
import sys
import time

import numpy as np

from vawm.envs.host.pool import episode_seed
from vawm.envs.host.simulator import Outcome
from vawm.types import image, vector


class Walk:
    """A walk of 3 to 6 steps. It returns the same arrays every time."""

    obs = {"state": vector(3), "picture": image(4, channels=1)}  # noqa: RUF012
    action_size = 2
    discrete = False
    episode_length = None

    def __init__(self):
        self.seen = {
            "picture": np.zeros((4, 4, 1), np.uint8),
            "state": np.zeros(3, np.float32),
        }

    def reset(self, seed):
        self.seed, self.steps = seed, 0
        self.random = np.random.default_rng(seed)
        self.seen["picture"][:] = seed % 256
        self.seen["state"][:] = self.random.normal(size=3)
        return self.seen

    def step(self, action):
        self.steps += 1
        self.seen["picture"] += 1
        self.seen["state"][:2] += action
        self.seen["state"][2] = self.random.normal()
        is_last = self.steps == 3 + self.seed % 4
        return Outcome(
            self.seen, self.seen["state"][0], is_last, is_last and self.seed % 2 == 0
        )

    def close(self):
        pass


class Troubled(Walk):
    """A walk with trouble at a given step of every episode, or of the episodes of some seeds.

    `trouble` is the name of a method below, or a dict of names by seed.
    """

    def __init__(self, trouble, *, step):
        super().__init__()
        self.trouble, self.at = trouble, step

    def step(self, action):
        outcome = super().step(action)
        trouble = self.trouble
        if isinstance(trouble, dict):
            trouble = trouble.get(self.seed)
        if self.steps != self.at or trouble is None:
            return outcome
        return getattr(self, trouble)(outcome) or outcome

    def boom(self, outcome):
        raise ValueError("boom,\nand more")

    def leave(self, outcome):
        raise SystemExit(1)

    def exit(self, outcome):
        os._exit(3)

    def crash(self, outcome):
        ctypes.string_at(0)

    def hang(self, outcome):
        time.sleep(1000)

    def hang_deaf(self, outcome):
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        while True:
            time.sleep(1000)

    def lose_reward(self, outcome):
        return outcome._replace(reward=float("nan"))


class BadEnd(Troubled):
    """A troubled walk that also does not survive being closed."""

    def __init__(self, trouble, *, step, end):
        super().__init__(trouble, step=step)
        self.end = end

    def close(self):
        if self.seed in self.trouble:
            getattr(self, self.end)(None)


class Echo:
    """Its observation is the last action."""

    obs = vector(3)
    action_size = 3
    episode_length = 2

    def __init__(self, discrete):
        self.discrete = discrete

    def reset(self, seed):
        return np.zeros(3, np.float32)

    def step(self, action):
        assert type(action) is int if self.discrete else action.dtype == np.float32
        return Outcome(np.full(3, action, np.float32), 0, False, False)

    def close(self):
        pass


class Chance(Walk):
    """A walk that cannot replay its episodes of odd seeds."""

    def step(self, action):
        if self.seed % 2:
            self.seen["state"][2] = int.from_bytes(os.urandom(2), "big")
            return super().step(action)._replace(reward=self.seen["state"][1])
        return super().step(action)

    def reset(self, seed):
        obs = super().reset(seed)
        if seed % 2:
            obs["state"][1] = int.from_bytes(os.urandom(2), "big")
        return obs


class Changed(Walk):
    """A walk with trouble in its second step, if a file exists; the file names the trouble."""

    def __init__(self, path):
        super().__init__()
        self.path = path

    def step(self, action):
        outcome = super().step(action)
        if self.steps != 2 or not os.path.exists(self.path):
            return outcome
        with open(self.path) as file:
            if (what := file.read()) == "end":
                return outcome._replace(is_last=True)
        return getattr(Troubled, what)(self, outcome)


class Slow(Walk):
    def step(self, action):
        time.sleep(0.5)
        return super().step(action)


class Loud(Walk):
    """Prints, from Python and to the file descriptor."""

    def step(self, action):
        print("chatter")
        os.write(1, b"chatter\n")
        return super().step(action)


class Parent(Walk):
    """Has a child process; its observation is the process id."""

    obs = vector(1)

    def reset(self, seed):
        super().reset(seed)
        self.child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(1000)"])
        return np.array([self.child.pid], np.float32)


def serial_stream(make, seed, actions):
    """The expected stream for `[T, N, A]` actions, from a plain loop.

    `T + 1` lists of N tuples (obs, reward, is_first, is_last, is_terminal).
    """
    envs = [Stream(make(), seed, env) for env in range(actions.shape[1])]
    rows = [[env.begin() for env in envs]]
    rows += [[env.step(a) for env, a in zip(envs, row, strict=True)] for row in actions]
    return rows


class Stream:
    """One environment of `serial_stream`."""

    def __init__(self, simulator, seed, env):
        self.simulator, self.seed, self.env = simulator, seed, env
        self.episode, self.over = -1, False

    def begin(self):
        self.episode, self.over = self.episode + 1, False
        obs = self.simulator.reset(episode_seed(self.seed, self.env, self.episode))
        return {key: x.copy() for key, x in obs.items()}, 0.0, True, False, False

    def step(self, action):
        if self.over:
            return self.begin()
        action = np.where(np.isnan(action), 0, np.clip(action, -1, 1))
        obs, reward, is_last, is_terminal = self.simulator.step(action)
        self.over = is_last
        return {k: x.copy() for k, x in obs.items()}, float(reward), False, is_last, is_terminal
