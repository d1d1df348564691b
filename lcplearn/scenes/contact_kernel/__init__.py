"""Contact steps on the CPU, compiled, one element after the other: what is beside this folder in torch, fused.

Same rows, same iteration, same rest, same gradient. `steps.py` is the door; the LCPs go to the layer's kernel.
"""
