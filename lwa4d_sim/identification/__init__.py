"""Identification: from a recording of joint motion and torque to the arm's parameters, their intervals and an MJCF."""
