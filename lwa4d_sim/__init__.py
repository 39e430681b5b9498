"""A testbed for robot-arm controllers that must live on a CAN bus."""
