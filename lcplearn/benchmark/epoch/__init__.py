"""`benchmark epoch`: where the time of a training's epoch goes."""
