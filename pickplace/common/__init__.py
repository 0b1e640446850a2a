"""Validators, files and the machine; nothing else of pickplace."""
