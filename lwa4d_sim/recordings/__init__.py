"""Recordings: what an experiment left behind, read from a run, a table or a CAN log."""
