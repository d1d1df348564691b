"""`benchmark acceptance`: each figure that the layer must show."""
