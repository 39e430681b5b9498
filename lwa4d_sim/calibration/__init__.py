"""Calibration of an arm's geometry: from measured poses of its tool to small errors of its frames, and a better arm."""
