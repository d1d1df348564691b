"""Real tosses of a cube: what is learned, beside baselines and a tuned simulator."""
