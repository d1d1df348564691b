"""`benchmark engines`, the Stick Bench: twelve scenes with an exact answer, ours beside every installed engine."""
