"""A scenario at many points: designs, workers near and far, one table, one page."""
