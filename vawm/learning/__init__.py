"""Learning: the loss, one update, replay, and the training step."""
