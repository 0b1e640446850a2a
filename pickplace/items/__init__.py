"""Items: distributions, their streams, and the arrival in the bin."""
