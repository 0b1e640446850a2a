"""Run folders: configs, checkpoints, resume, loggers."""
