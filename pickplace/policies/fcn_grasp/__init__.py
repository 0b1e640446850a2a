"""``fcn_grasp``: scores of footprints, by a convolutional network of the tote around each."""
