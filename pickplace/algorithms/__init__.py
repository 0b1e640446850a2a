"""Learning algorithms: what a training does with a batch."""
