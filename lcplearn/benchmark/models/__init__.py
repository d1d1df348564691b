"""`benchmark models`: learned formulations."""
