"""Configs: registry, composition, allowlist; everything that knows Hydra."""
