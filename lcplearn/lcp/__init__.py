"""The linear complementarity problem 0 <= z, w = M z + q >= 0, z.w = 0; nothing about physics."""
