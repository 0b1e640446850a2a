"""Training of a policy under a curriculum."""
