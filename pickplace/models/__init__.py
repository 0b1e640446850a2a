"""The networks: depth preprocessing, the paper's 4D convolutions, actors and critics."""
