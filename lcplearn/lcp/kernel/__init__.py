"""What numba compiles: the CPU kernel, in one file for each method.

numba's cache sees the file of a cached function, and the closure of that function. So only the two entries,
`cascade.solve_range` and `adjoint.adjoint_range`, are cached, and their closure holds a digest of all these files.
"""
