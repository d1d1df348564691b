"""`benchmark solvers`: every method and peer, time against residual, gradients against the truth."""
