"""Environments that run on the host: real simulators in processes of their own.

    simulator          what one environment is
    pool               many of them, stepped side by side; failures, resuming
    crew, worker       the processes that run them, and what each of them does
    channel            messages and memory between processes
    gymnasium          any Gymnasium environment as a simulator
    gymnasium_check    what has to hold of it
    atari, frames      a game of the Arcade Learning Environment, and its pixels
    vision, rendering  a task of the DeepMind Control Suite from pixels, without a screen

Nothing here initialises JAX.
"""
