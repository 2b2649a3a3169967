"""Meshes of the authors' and our objects beside the objects themselves: what lies flat, floats, is hollow."""
