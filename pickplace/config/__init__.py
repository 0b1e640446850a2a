"""Configs: registry, composition, allowlist, errors."""
