"""Speed against error: seeded problems, solvers and scenes side by side; see `python -m lcplearn.benchmark --help`."""
