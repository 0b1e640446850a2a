"""Validators, errors, files and the machine; nothing else of pickplace."""
