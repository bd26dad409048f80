"""Returns computed by the recursions that define them, in float64."""

import numpy as np


def slow_lambda_returns(reward, discount, value, lambda_):
    reward, discount, value = (np.asarray(x, np.float64) for x in (reward, discount, value))
    result = np.zeros_like(reward)
    following = value[-1]
    for k in reversed(range(len(reward))):
        following = reward[k] + discount[k] * ((1 - lambda_) * value[k] + lambda_ * following)
        result[k] = following
    return result


def slow_replay_returns(reward, is_last, is_terminal, bootstrap, discount, lambda_):
    """Computes one episode and one step at a time, as the function's docstring defines it."""
    batch, length = reward.shape
    result = np.zeros((batch, length - 1))
    for b in range(batch):
        following = float(bootstrap[b, -1])
        for t in reversed(range(length - 1)):
            mix = 0.0 if is_last[b, t + 1] else lambda_
            future = 0.0
            if not is_terminal[b, t + 1]:
                future = (1 - mix) * float(bootstrap[b, t + 1]) + mix * following
            following = float(reward[b, t + 1]) + discount * future
            result[b, t] = following
    return result
