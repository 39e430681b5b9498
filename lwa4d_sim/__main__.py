"""`python -m lwa4d_sim` is `lwa4d-sim`."""

from lwa4d_sim.cli import main

if __name__ == "__main__":
    main()
