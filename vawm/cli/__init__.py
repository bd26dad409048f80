"""The command line of programs."""
