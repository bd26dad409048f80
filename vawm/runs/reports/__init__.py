"""Reports of a run: metrics, trackers, videos, the progress bar."""
