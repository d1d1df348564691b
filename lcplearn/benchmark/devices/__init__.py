"""`benchmark devices`: problems a second on a CUDA device, beside the CPU kernel."""
