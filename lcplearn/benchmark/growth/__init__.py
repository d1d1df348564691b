"""`benchmark growth`: how time and memory of one problem grow with its size, to n = 400."""
