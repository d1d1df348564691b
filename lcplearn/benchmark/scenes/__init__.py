"""`benchmark scenes`: rows, step sizes, errors against exact motions."""
