"""`benchmark overhead`: what a call costs beside the solve."""
