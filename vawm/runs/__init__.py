"""Runs on disk: validation, the loop, checkpoints, resuming, reports."""
