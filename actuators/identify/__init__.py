"""How good a fitted actuator model is, and where it fails: scores of free runs, regimes, verdict, pictures, the page."""
