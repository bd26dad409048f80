"""Runs on disk: what may run, the loop, checkpoints, resuming, reports."""
