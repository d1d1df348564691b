"""Models of the scalar velocity of a block on a line."""
