"""dm_control's C physics as the reference of the environment tests."""

from typing import NamedTuple

import mujoco
import numpy as np
from dm_control import suite

from vawm.envs import split

RANDOM, BANG_BANG, POSED = "random", "bang-bang", "posed"


class Transitions(NamedTuple):
    """States of C MuJoCo, an action in each, and the results; all float64 `[B, ...]`."""

    qpos: np.ndarray
    qvel: np.ndarray
    qacc_warmstart: np.ndarray
    target: np.ndarray
    action: np.ndarray
    next_qpos: np.ndarray
    next_qvel: np.ndarray
    obs: np.ndarray
    reward: np.ndarray


def load(name: str, seed: int = 0):
    """dm_control's environment, without the deprecation warning that it writes to a file."""
    mujoco.set_mju_user_warning(lambda message: None)
    domain, task = split(name)
    return suite.load(domain, task, task_kwargs={"random": seed})


def flat(observation) -> np.ndarray:
    """dm_control's entries in dm_control's order."""
    return np.concatenate([np.ravel(entry) for entry in observation.values()])


def target(env, name: str) -> np.ndarray:
    """What the task randomises outside qpos."""
    model = env.physics.named.model
    if name.startswith("reacher"):
        return model.geom_pos["target", ["x", "y"]].copy()
    if name.startswith("finger_turn"):
        return model.site_pos["target", ["x", "z"]].copy()
    return np.zeros(0)


def set_target(env, name: str, value: np.ndarray) -> None:
    """Puts the target at `value`."""
    model = env.physics.named.model
    if name.startswith("reacher"):
        model.geom_pos["target", ["x", "y"]] = value
    if name.startswith("finger_turn"):
        model.site_pos["target", ["x", "z"]] = value


def place(env, name: str, qpos, qvel, goal) -> np.ndarray:
    """Starts an episode at a given state and returns the first observation."""
    env.reset()
    with env.physics.reset_context():
        env.physics.data.qpos[:], env.physics.data.qvel[:] = qpos, qvel
        set_target(env, name, goal)
    return flat(env.task.get_observation(env.physics))


def pose(env, name: str, rng: np.random.RandomState) -> None:
    """Puts the environment near a reward, which random actions rarely reach."""
    physics = env.physics
    qpos, qvel, goal = physics.data.qpos.copy(), np.zeros(physics.model.nv), target(env, name)
    if name == "finger_spin":
        qvel[2] = rng.uniform(-25, -10)
    elif name.startswith("finger_turn"):
        qpos[2] = -np.arctan2(goal[0] - 0.2, goal[1] - 0.4) + rng.uniform(-0.7, 0.7)
    elif name.startswith("reacher"):
        goal = physics.named.data.geom_xpos["finger", ["x", "y"]] + rng.uniform(-0.05, 0.05, 2)
    elif name == "ball_in_cup_catch":
        qpos = np.array([0, 0, rng.uniform(-0.03, 0.03), rng.uniform(0.3, 0.45)])
    else:
        qpos = physics.model.ptr.qpos0 + rng.uniform(-0.1, 0.1, physics.model.nq)
    place(env, name, qpos, qvel, goal)


def hold(name: str, seen: Transitions, action: np.ndarray, *, steps: int):
    """Last observations and summed rewards of `steps` steps of C from the states of `seen`.

    Each holds its row of the actions `[B, nu]`, which C clips to the range of its actuators.
    """
    env, obs, reward = load(name), [], []
    for start, held in zip(zip(*seen, strict=True), action, strict=True):
        start = Transitions(*start)
        place(env, name, start.qpos, start.qvel, start.target)
        env.physics.data.qacc_warmstart[:] = start.qacc_warmstart
        taken = [env.step(held) for _ in range(steps)]
        obs.append(flat(taken[-1].observation))
        reward.append(sum(step.reward for step in taken))
    return np.stack(obs), np.stack(reward)


def transitions(name: str, *, each: int = 100, seed: int = 0) -> Transitions:
    """`each` transitions along random and along full-amplitude actions, half as many posed.

    Random and full-amplitude actions are held for 5 steps, over 5 episodes of 200 steps.
    """
    env, rng = load(name, seed), np.random.RandomState(seed)
    kept = []
    for kind, episodes, length, count in [
        (RANDOM, 5, 200, each),
        (BANG_BANG, 5, 200, each),
        (POSED, each // 2, 4, each // 2),
    ]:
        rows = [
            row
            for _ in range(episodes)
            for row in episode(env, name, kind, length=length, rng=rng)
        ]
        kept += [rows[i] for i in rng.choice(len(rows), count, replace=False)]
    return Transitions(*map(np.stack, zip(*kept, strict=True)))


def episode(env, name: str, kind: str, *, length: int, rng: np.random.RandomState):
    """Steps C through one episode and yields its transitions."""
    env.reset()
    if kind == POSED:
        pose(env, name, rng)
    data, nu = env.physics.data, env.physics.model.nu
    for index in range(length):
        if index % 5 == 0:
            action = (
                rng.choice([-1.0, 1.0], nu) if kind == BANG_BANG else rng.uniform(-1, 1, nu)
            )
        before = data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()
        step = env.step(action)
        after = data.qpos.copy(), data.qvel.copy()
        yield (
            *before,
            target(env, name),
            action.copy(),
            *after,
            flat(step.observation),
            np.float64(step.reward),
        )
