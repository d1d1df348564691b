"""Pushes: gradients, times, how many pushes a model needs, and planning with a learned one."""
