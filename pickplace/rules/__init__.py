"""The rules of picking and placing: torch, and nothing else of pickplace but ``common``."""
