"""The rules of picking and placing: they use torch, and of pickplace only ``common``."""
