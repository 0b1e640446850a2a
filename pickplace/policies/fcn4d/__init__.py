"""The paper's network: a 4D convolution over pick and place cells."""
