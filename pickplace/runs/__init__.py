"""Run folders: configs, checkpoints, resuming, loggers."""
