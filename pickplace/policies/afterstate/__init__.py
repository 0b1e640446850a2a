"""``afterstate``: values of the tote after a placement."""
