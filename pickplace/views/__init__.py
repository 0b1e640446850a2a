"""Recordings, the replay page and figures."""
