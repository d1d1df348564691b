"""`benchmark fuzz`: the hunt for wrong answers."""
