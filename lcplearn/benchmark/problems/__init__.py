"""The catalogue of LCPs: random families, contact from geometry, textbook and published cases."""
