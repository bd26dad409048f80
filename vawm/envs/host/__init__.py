"""Environments that run on the host: simulators in separate processes.

    simulator          the interface of one environment
    pool               many environments, stepped in parallel; failures, resuming
    crew, worker       the processes that run them, and the code of one such process
    channel            messages and shared memory between processes
    usable             what an agent can use of what an environment returns
    gymnasium          any Gymnasium environment as a simulator
    gymnasium_check    the requirements for a Gymnasium environment
    reading            how observations of a Gymnasium space become vectors and images
    atari, frames      a game of the Arcade Learning Environment, and its pixels
    vision, rendering  a task of the DeepMind Control Suite from pixels, without a display

Nothing here initialises JAX.
"""
