"""Excitation: a motion that tells as much about an arm as its limits allow."""
