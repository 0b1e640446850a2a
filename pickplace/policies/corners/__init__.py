"""``corners``: scores of corner footprints on fine grids."""
