"""How far a loop is from shaking: linearised arm, exact sampled-data loop, margins, maps."""
