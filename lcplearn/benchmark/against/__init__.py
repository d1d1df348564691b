"""`benchmark against TREE`: the kernel's speed beside that of another checkout."""
