"""Where it is: fusing the robots' measurements of the same object."""
