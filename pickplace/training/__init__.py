"""Training by PPO under a curriculum of tote heights."""
