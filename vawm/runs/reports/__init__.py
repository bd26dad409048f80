"""What a run tells: metrics, trackers, videos, the progress bar."""
